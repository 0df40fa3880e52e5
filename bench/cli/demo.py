"""`latticebench demo`: a recording is made, diagnosed, and its page written, to see what comes of it."""

from __future__ import annotations

import sys
import time
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated

import typer

from latticebench.bench.cli.options import check_places, place
from latticebench.bench.cli.reading import say_notes

EPILOG = "Example:  latticebench demo --out demo"


def demo(
    out: Annotated[
        Path, typer.Option(parser=place, metavar="DIR", help="The folder that recording and page are written to.")
    ] = Path("demo"),
) -> None:
    """Simulate seven pendula with a defect and a sensor that is off, and find both; takes about half a minute."""
    from latticebench.bench import calls
    from latticebench.bench import demo as made
    from latticebench.bench.overlay import of_diagnosis
    from latticebench.bench.report.curves import curves
    from latticebench.bench.report.document import provenance
    from latticebench.bench.report.page import write_page
    from latticebench.bench.report.screen import console, watching
    from latticebench.systems.files import shown
    from latticebench.systems.lattice import library
    from latticebench.systems.layout import Layout
    from latticebench.systems.readers import read

    recording, page = out / "pendula.csv", out / "diagnosis.html"
    check_places([], out=recording)
    check_places([], out=page)
    began = time.perf_counter()
    made.write_recording(recording)
    print(
        f"{shown(recording)}: {made.SITES} pendula, simulated; pendulum {made.DEFECT} hangs on an extra spring, air "
        f"brakes all, sensor {made.OFF} reads {made.OFFSET:g} degrees too much"
    )
    data = read(recording, "free", Layout(made.TIME, (made.COLUMNS,), made.SCALE))
    say_notes(data)
    with watching() as watcher, redirect_stdout(sys.stderr):
        found, report = calls.diagnose(data, library("declared", made.TERMS), 2, watcher=watcher)
    write_page(report, curves(found), provenance(), page, of_diagnosis(found))
    screen = console()
    screen.print(report.sentence, style="bold", highlight=False, markup=False, soft_wrap=True)
    for line in (report.equation.after.text, *(f"    {line}" for line in report.equation.after.elsewhere)):
        screen.print(line, highlight=False, markup=False, soft_wrap=True)
    command = (
        f'latticebench diagnose {shown(recording)} --time {made.TIME} --columns "{made.COLUMNS}" --scale {made.SCALE} '
        f'--terms "{made.TERMS}" --order 2 --ends free'
    )
    print(f"The whole story with pictures: {shown(page.resolve())} ({time.perf_counter() - began:.0f} s)")
    print(f"The same by hand: {command}")
    if report.interrupted:
        raise typer.Abort
