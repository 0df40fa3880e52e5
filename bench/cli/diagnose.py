"""`latticebench diagnose`: find what a declared equation lacks."""

from __future__ import annotations

import json
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from latticebench.bench.cli.arguments import asked, told
from latticebench.bench.cli.options import AnyEnds, complete_methods, complete_systems
from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from latticebench.systems.lattice import Library, System

# The library of a system that has the terms of its own equation.
EQUATION = "equation"

EPILOG = (
    "Examples:  latticebench diagnose phi4.csv --system phi4 --html diagnosis.html\n\n"
    '           latticebench diagnose my.csv --terms "u\\[n+1]+u\\[n-1]-2*u\\[n]; sin(u\\[n])" --order 2 --holdout later.csv'
)


def diagnose(
    files: Annotated[list[Path], typer.Argument(help="One or more .csv, .npz or .parquet files.")],
    system: Annotated[
        str | None,
        typer.Option(help="Declare this system's equation, its coefficients free.", autocompletion=complete_systems),
    ] = None,
    terms: Annotated[
        str | None, typer.Option(help="Declare an equation of your own: its terms, with ; between them.")
    ] = None,
    order: Annotated[int | None, typer.Option(min=1, max=2, help="Order of the time derivative.")] = None,
    ends: Annotated[
        AnyEnds | None,
        typer.Option(help="How the chain ends: the system's own, with --terms unknown, if not given."),
    ] = None,
    effects: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A .toml file with effects of your own, tried beside the catalogue."),
    ] = None,
    holdout: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Judge forecasts on this file, not on the last 30 % of the record; may be given several times.",
        ),
    ] = None,
    json_out: Annotated[
        str | None, typer.Option("--json", metavar="OUT", help="Write it as JSON to a file, or - for the screen.")
    ] = None,
    html_out: Annotated[
        Path | None, typer.Option("--html", metavar="OUT", help="Write one HTML file with pictures.")
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="Take the declared equation's first coefficients from this method's fit (of `list methods`); whole trajectories otherwise.",
            autocompletion=complete_methods,
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated noise that evidence is judged by.")] = 1,
) -> None:
    """Say what a declared equation lacks: find the residual, trace it to an effect, add that, and show the error before and after."""
    from latticebench import methods
    from latticebench.bench.report.report import content, show, watching
    from latticebench.diagnosis.repair import diagnose as close_the_loop
    from latticebench.methods.method import make, solve
    from latticebench.systems.effects import CATALOGUE
    from latticebench.systems.files import write_text
    from latticebench.systems.readers import read_all
    from latticebench.systems.user_files import load_effects

    if system is not None and (terms is not None or order is not None):
        raise InputError(
            "--system declares an equation and its order: give it alone, or --terms and --order without it"
        )
    if system is None and terms is None:
        raise InputError(
            'give --system, or --terms and --order, such as --terms "u[n+1]+u[n-1]-2*u[n]; sin(u[n])" --order 2'
        )
    known, declared, order = declared_equation(system, terms, order)
    catalogue = (*CATALOGUE, *(load_effects(effects) if effects is not None else ()))
    ends = ends or ("unknown" if known is None else known.ends)
    data = read_all(files, ends)
    if known is not None and known.is_complex != data[0].is_complex:
        kinds = ("real", "complex")
        raise InputError(
            f"{data[0].source}: the field is {kinds[data[0].is_complex]}, that of {known.name} is {kinds[known.is_complex]}; "
            "choose another --system, or give --terms"
        )
    # Read together, since the two must be of the same chain.
    later = read_all([*files, *holdout], ends)[len(data) :] if holdout else []
    with told(data, method, "the diagnosis"), watching() as watcher, redirect_stdout(sys.stderr):
        start = (
            None if method is None else solve(make(methods.find(method), {}), data, declared, order, seed).coefficients
        )
        found = close_the_loop(declared, order, data, catalogue, seed, held_out=later, watcher=watcher, start=start)
    text = json.dumps(content(found), indent=2, allow_nan=False) + "\n"
    # Files first: whoever reads the screen may stop reading.
    if html_out is not None:
        from latticebench.bench.provenance import command_line, origin
        from latticebench.bench.report.page import write_page

        write_page(found, {"command": " ".join(["latticebench", *command_line()]), "seed": seed, **origin()}, html_out)
    if json_out == "-":
        print(text, end="")
        return
    if json_out is not None:
        write_text(Path(json_out), text)
    show(found)


def declared_equation(system: str | None, terms: str | None, order: int | None) -> tuple[System | None, Library, int]:
    """Make out which equation is declared: the system's own terms, or those given."""
    if system is not None:
        from latticebench import systems

        if EQUATION not in [one.name for one in systems.find(system).libraries]:
            raise InputError(
                f"--system {system}: it has no library {EQUATION!r} that says which coefficients are free; give it one, or give --terms"
            )
    return asked(system, EQUATION if terms is None else None, terms, order)
