"""`latticebench inspect`: what a recording is like, before any equation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from latticebench.bench.cli.options import JsonOut, Order, SystemOption, Terms, check_places, place
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
)

if TYPE_CHECKING:
    from latticebench.bench.inspection import Inspection
    from latticebench.systems.lattice import Library
    from latticebench.systems.samples import Samples

EPILOG = (
    'Example:  latticebench inspect pendula.csv --time time_s --columns "theta_*_deg" --scale deg '
    '--terms "sin(u\\[n])" --out pendula.png'
)
PICTURES = (".png", ".svg", ".pdf")


def inspect(
    files: Files,
    system: SystemOption = None,
    terms: Terms = None,
    order: Order = None,
    time: Time = None,
    columns: Columns = None,
    scale: Scale = "1",
    time_scale: TimeScale = "1",
    sort: Sort = False,
    turn: Turn = 0.0,
    between: Between = None,
    json_out: JsonOut = None,
    out: Annotated[
        Path | None,
        typer.Option(parser=place, metavar="FILE", help="Draw readings and spectrum: a .png, .svg or .pdf file."),
    ] = None,
) -> None:
    """Show what was read of a recording: sites, sampling, gaps, ranges, noise, frequencies, and what is suspicious.

    With --terms or --system it is also told whether the readings make sense in an equation with them.
    """
    from latticebench.bench.cli.arguments import kept
    from latticebench.bench.figures import save
    from latticebench.bench.inspection import inspect as look
    from latticebench.bench.provenance import command_line
    from latticebench.bench.report.inspected import picture
    from latticebench.systems.errors import InputError, unknown
    from latticebench.systems.files import write_text
    from latticebench.systems.readers import read_all

    check_places([*files, system], json=json_out, out=out)
    if out is not None and out.suffix.lower() not in PICTURES:
        raise unknown("ending", out.suffix, PICTURES, f"--out {out}")
    declared = _terms(system, terms, order)
    data = read_all(files, "unknown", layout_of(time, columns, scale, sort, turn, time_scale, between))
    found = [look(one, declared) for one in data]
    failures: list[str] = []
    if json_out is not None:
        from latticebench.bench.report.document import provenance, to_json
        from latticebench.bench.report.outputs import inspection_document
        from latticebench.bench.report.units import units_of

        text = to_json(inspection_document(found, units_of(data[0].origin), provenance()))
        if json_out != "-":
            with kept(failures):
                write_text(Path(json_out), text)
    if out is not None:
        with kept(failures):
            save(picture(data[0]), out, {"command": command_line()})
    if json_out == "-":
        print(text, end="")
    else:
        for one, samples in zip(found, data, strict=True):
            _show(one, samples)
    if failures:
        raise InputError("; ".join(failures))


def _terms(system: str | None, terms: str | None, order: int | None) -> Library | None:
    """Return the terms that the readings are for, of which the order says nothing; None where none are given."""
    from latticebench.bench.cli.arguments import asked

    if terms is None and system is None:
        return None
    return asked(system, "equation" if terms is None else None, terms, order or (None if system else 2))[1]


def _show(found: Inspection, samples: Samples) -> None:
    """Print what a recording is like, the suspicious first."""
    from latticebench.bench.report.inspected import SHOWN, lines, more, sensors
    from latticebench.bench.report.screen import console, show_rows
    from latticebench.systems.errors import printable

    screen = console()

    def say(text: str, style: str = "") -> None:
        screen.print(printable(text), style=style, highlight=False, markup=False, soft_wrap=True)

    say(found.source, "bold")
    for line in found.notes:
        say(f"  {line}", "dim")
    if not found.suspicious:
        say("Nothing suspicious.")
    for line in found.suspicious[:SHOWN]:
        say(f"Suspicious: {line}", "bold red")
    for line in more(found.suspicious, "are suspicious; --json has all"):
        say(line)
    for line in lines(found, samples.origin.time):
        say(line)
    heads, rows = sensors(found, samples.origin.unit)
    show_rows(heads, rows[:SHOWN])
    for line in more(rows, "sensors; --json has all"):
        say(line)
