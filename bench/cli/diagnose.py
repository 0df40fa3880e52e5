"""`latticebench diagnose`: find what a declared equation lacks."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from latticebench.bench.cli.arguments import asked, kept
from latticebench.bench.cli.options import AnyEnds, HtmlOut, JsonOut, Order, check_places, complete_systems
from latticebench.bench.cli.reading import (
    Between,
    Columns,
    Files,
    Scale,
    Sort,
    Time,
    TimeScale,
    Turn,
    layout_of,
    read_told,
)
from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from latticebench.bench.report.content import Report
    from latticebench.diagnosis.repair import Diagnosis
    from latticebench.systems.lattice import Library, System
    from latticebench.systems.samples import Samples

# The library of a system that has the terms of its own equation.
EQUATION = "equation"

EPILOG = (
    "Examples:  latticebench diagnose phi4.csv --system phi4 --html diagnosis.html\n\n"
    '           latticebench diagnose my.csv --terms "u\\[n+1]+u\\[n-1]-2*u\\[n]; sin(u\\[n])" --order 2 '
    "--holdout later.csv"
)


def diagnose(
    files: Files,
    system: Annotated[
        str | None,
        typer.Option(help="Declare this system's equation, its coefficients free.", autocompletion=complete_systems),
    ] = None,
    terms: Annotated[
        str | None, typer.Option(help="Declare an equation of your own: its terms, with ; between them.")
    ] = None,
    order: Order = None,
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
    time: Time = None,
    columns: Columns = None,
    scale: Scale = "1",
    time_scale: TimeScale = "1",
    sort: Sort = False,
    turn: Turn = 0.0,
    between: Between = None,
    json_out: JsonOut = None,
    html_out: HtmlOut = None,
) -> None:
    """Find what a declared equation lacks: trace its residual to an effect, add it, show the error before and after."""
    from latticebench.bench import calls
    from latticebench.bench.report.notes import doubts
    from latticebench.bench.report.screen import watching
    from latticebench.systems.readers import read_all

    check_places([*files, *(holdout or ()), effects, system], json=json_out, html=html_out)
    layout = layout_of(time, columns, scale, sort, turn, time_scale, between)
    known, declared, order = _declared(system, terms, order)
    ends = ends or ("unknown" if known is None else known.ends)
    data = read_told(files, ends, layout)
    _check_field(known, data)
    # Read together, since the two must be of the same chain.
    later = read_all([*files, *holdout], ends, layout)[len(data) :] if holdout else []
    with watching() as watcher, redirect_stdout(sys.stderr):
        found, report = calls.diagnose(data, declared, order, effects=effects, later=later, watcher=watcher)
    _report(found, report, json_out, html_out, doubts(data, declared))
    if report.interrupted:
        raise typer.Abort


def _declared(system: str | None, terms: str | None, order: int | None) -> tuple[System | None, Library, int]:
    """Return the equation that is declared: the system's own terms, or those given."""
    if system is not None and (terms is not None or order is not None):
        raise InputError(
            "--system declares an equation and its order: give it alone, or --terms and --order without it"
        )
    if system is None and terms is None:
        raise InputError(
            'give --system, or --terms and --order, such as --terms "u[n+1]+u[n-1]-2*u[n]; sin(u[n])" --order 2'
        )
    if system is not None:
        from latticebench import systems

        if EQUATION not in [one.name for one in systems.find(system).libraries]:
            raise InputError(
                f"--system {system}: it has no library {EQUATION!r} that says which coefficients are free; give it "
                "one, or give --terms"
            )
    return asked(system, EQUATION if terms is None else None, terms, order)


def _check_field(known: System | None, data: Sequence[Samples]) -> None:
    """Refuse recordings of a real field for an equation of a complex one, and the other way round."""
    if known is not None and known.is_complex != data[0].is_complex:
        kinds = ("real", "complex")
        raise InputError(
            f"{data[0].source}: the field is {kinds[data[0].is_complex]}, that of {known.name} is "
            f"{kinds[known.is_complex]}; choose another --system, or give --terms"
        )


def _report(
    found: Diagnosis, report: Report, json_out: str | None, html_out: Path | None, warnings: tuple[str, ...]
) -> None:
    """Show a diagnosis on the screen, and write it as JSON and as a page.

    Raises:
        InputError: a file cannot be written; the others are, and the screen has it all.
    """
    from latticebench.bench.overlay import of_diagnosis
    from latticebench.bench.report.content import diagnosis_document
    from latticebench.bench.report.document import provenance, to_json
    from latticebench.bench.report.screen import show_warnings
    from latticebench.bench.report.text import show
    from latticebench.systems.files import write_text

    about = provenance()
    overlay = None if json_out is None and html_out is None else of_diagnosis(found)
    text = "" if json_out is None else to_json(diagnosis_document(report, about, overlay))
    failures: list[str] = []
    # Files first: whoever reads the screen may stop reading.
    if json_out is not None and json_out != "-":
        with kept(failures):
            write_text(Path(json_out), text)
    if html_out is not None:
        from latticebench.bench.report.curves import curves
        from latticebench.bench.report.page import write_page

        with kept(failures):
            write_page(report, curves(found), about, html_out, overlay)
    if json_out == "-":
        print(text, end="")
    else:
        show_warnings(warnings)
        show(report)
    if failures:
        raise InputError("; ".join(failures))
