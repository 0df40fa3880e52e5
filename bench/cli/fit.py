"""`latticebench fit`: fit a library to recorded samples."""

from __future__ import annotations

import json
import math
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from latticebench.bench.cli.arguments import asked, pairs, told
from latticebench.bench.cli.options import AnyEnds, Settings, complete_libraries, complete_methods, complete_systems

if TYPE_CHECKING:
    from latticebench.methods.method import Fit

EPILOG = (
    "Examples:  latticebench fit phi4.csv --system phi4 --library lib2 --method stlsq --set threshold=0.1\n\n"
    '           latticebench fit my.csv --terms "u\\[n+1]; u\\[n-1]; u\\[n]; u\\[n]**3" --order 2 --method least-squares'
)


def fit(
    files: Annotated[list[Path], typer.Argument(help="One or more .csv, .npz or .parquet files.")],
    system: Annotated[
        str | None, typer.Option(help="Take order and libraries from this system.", autocompletion=complete_systems)
    ] = None,
    library: Annotated[
        str | None, typer.Option(help="A library of the system.", autocompletion=complete_libraries)
    ] = None,
    terms: Annotated[str | None, typer.Option(help="Terms of your own, with ; between them.")] = None,
    order: Annotated[int | None, typer.Option(min=1, max=2, help="Order of the time derivative.")] = None,
    method: Annotated[
        str | None, typer.Option(help="A name from `list methods`, or a .py file.", autocompletion=complete_methods)
    ] = None,
    given: Settings = None,
    ends: Annotated[
        AnyEnds, typer.Option(help="How the chain ends; unknown uses only sites whose whole stencil was seen.")
    ] = "unknown",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the method's own draws.")] = 1,
    json_out: Annotated[
        str | None, typer.Option("--json", metavar="OUT", help="Write the fit as JSON to a file, or - for the screen.")
    ] = None,
) -> None:
    """Fit the coefficients of a library to recorded samples."""
    from latticebench import methods
    from latticebench.bench.screen import show_fit, waiting
    from latticebench.methods.method import make, solve
    from latticebench.systems.files import write_text
    from latticebench.systems.readers import read_all

    method = method or methods.DEFAULT
    chosen = make(methods.find(method), pairs(given))
    _, candidates, order = asked(system, library, terms, order)
    data = read_all(files, ends)
    with (
        told(data, method, f"method {method!r}"),
        waiting(f"{method}: fitting {len(candidates.terms)} terms"),
        redirect_stdout(sys.stderr),
    ):
        found = solve(chosen, data, candidates, order, seed)
    content = json.dumps(_fit_json(found), indent=2, allow_nan=False) + "\n"
    if json_out == "-":
        print(content, end="")
        return
    show_fit(found)
    if json_out is not None:
        write_text(Path(json_out), content)


def _fit_json(found: Fit) -> dict[str, Any]:
    texts = found.library.texts

    def number(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    return {
        "method": found.method, "order": found.order,
        "coefficients": {text: number(value) for text, value in zip(texts, found.coefficients, strict=True)},
        "stderr": None if found.stderr is None
        else {text: number(value) for text, value in zip(texts, found.stderr, strict=True)},
        "residual": number(found.residual), "seconds": number(found.seconds), "status": found.status,
    }  # fmt: skip
