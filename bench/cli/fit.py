"""`latticebench fit`: fit a library to recorded samples."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from latticebench.bench.cli.arguments import asked, kept, pairs
from latticebench.bench.cli.options import (
    AnyEnds,
    HtmlOut,
    JsonOut,
    Library,
    MemoryLimit,
    MethodOption,
    Order,
    Settings,
    SystemOption,
    Terms,
    TimeLimit,
    check_places,
)
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
    from latticebench.bench.adequacy import Adequacy
    from latticebench.methods.method import Fit
    from latticebench.systems.samples import Samples

EPILOG = (
    "Examples:  latticebench fit phi4.csv --system phi4 --library lib2 --method stlsq --set threshold=0.1\n\n"
    '           latticebench fit my.csv --terms "u\\[n+1]; u\\[n-1]; u\\[n]; u\\[n]**3" --order 2 '
    "--method least-squares"
)

TIME_LIMIT, MEMORY_LIMIT = 3600.0, 4096


def fit(
    files: Files,
    system: SystemOption = None,
    library: Library = None,
    terms: Terms = None,
    order: Order = None,
    method: MethodOption = None,
    given: Settings = None,
    ends: Annotated[
        AnyEnds, typer.Option(help="How the chain ends; unknown uses only sites whose whole stencil was seen.")
    ] = "unknown",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the method's own draws.")] = 1,
    time_limit: TimeLimit = None,
    memory_limit: MemoryLimit = None,
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
    """Fit the coefficients of a library to recorded samples.

    A method of your own (.py) runs in a process of its own, within the limits; so does any method where one is given.
    """
    from latticebench import methods
    from latticebench.bench import calls
    from latticebench.bench.apart import Apart, fit_apart
    from latticebench.bench.case import code_file
    from latticebench.bench.report.screen import waiting
    from latticebench.methods.method import make
    from latticebench.systems.files import check_regular

    method = methods.DEFAULT if method is None else method
    check_places([*files, system, method], json=json_out, html=html_out)
    layout = layout_of(time, columns, scale, sort, turn, time_scale, between)
    own = code_file(method)
    chosen = None if own is not None else make(methods.find(method), pairs(given), texts=True)
    if own is not None:
        check_regular(Path(own))
    # What a file of the user's prints is for people, not for a program that reads the result.
    with redirect_stdout(sys.stderr):
        _, candidates, order = asked(system, library, terms, order)
    data = read_told(files, ends, layout)
    with waiting(f"{method}: fitting {len(candidates.terms)} terms"), redirect_stdout(sys.stderr):
        if chosen is not None and time_limit is None and memory_limit is None:
            found = calls.fit(data, candidates, order, chosen, seed)
        else:
            apart = Apart(
                files=tuple(files), ends=ends, terms=candidates.texts, order=order, method=method,
                settings=pairs(given), seed=seed, time_limit=time_limit or TIME_LIMIT,
                memory_limit=memory_limit or MEMORY_LIMIT, layout=layout,
            )  # fmt: skip
            with calls.told(data, method):
                found = fit_apart(apart, candidates)
        quality = calls.judged(data, found)
    _report(found, data, quality, seed, json_out, html_out)


def _report(
    found: Fit, data: list[Samples], quality: Adequacy, seed: int, json_out: str | None, html_out: Path | None
) -> None:
    """Show a fit and how well its equation fits, and write it as JSON and as a page, each where it is asked for.

    Raises:
        InputError: a file cannot be written; the other is, and the screen has it.
    """
    from latticebench.bench.overlay import of_fit
    from latticebench.bench.report.document import provenance, to_json
    from latticebench.bench.report.fit_page import write_fit_page
    from latticebench.bench.report.outputs import fit_document
    from latticebench.bench.report.screen import show_fit
    from latticebench.bench.report.units import units_of
    from latticebench.systems.files import write_text

    units = units_of(data[0].origin)
    text = ""
    failures: list[str] = []
    # Files first: the screen may be full, or its reader stop reading.
    if json_out is not None or html_out is not None:
        overlay, about = of_fit(data, found), provenance([seed])
        text = to_json(fit_document(found, quality, units, about, overlay))
        if json_out is not None and json_out != "-":
            with kept(failures):
                write_text(Path(json_out), text)
        if html_out is not None:
            with kept(failures):
                write_fit_page(found, overlay, quality, units, about, html_out)
    if json_out == "-":
        print(text, end="")
    else:
        show_fit(found, quality, units)
    if failures:
        raise InputError("; ".join(failures))
