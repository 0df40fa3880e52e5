"""`latticebench plot`: draw a recording, a fit or a diagnosis."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from latticebench.bench.cli.arguments import kept
from latticebench.bench.cli.options import check_places, place
from latticebench.bench.cli.reading import (
    Between,
    Columns,
    Scale,
    Sort,
    Time,
    TimeScale,
    Turn,
    layout_of,
    read_told,
)
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.files import shown

if TYPE_CHECKING:
    from latticebench.bench.overlay import Overlay
    from latticebench.systems.layout import Layout

EPILOG = (
    "Examples:  latticebench plot phi4.csv --out phi4.png --animate phi4.gif\n\n"
    "           latticebench plot fit.json --only sites --out fit.pdf"
)


def plot(
    file: Annotated[
        Path, typer.Argument(parser=place, help="A recording, or what `fit --json` or `diagnose --json` wrote.")
    ],
    out: Annotated[
        Path | None, typer.Option(parser=place, metavar="FILE", help="The picture to write: .png, .svg or .pdf.")
    ] = None,
    animate: Annotated[
        Path | None, typer.Option(parser=place, metavar="FILE", help="A film of the chain to write: .gif or .mp4.")
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(help="Draw this panel alone: map, sites, residual, learning, spectrum, phase; may be repeated."),
    ] = None,
    trajectory: Annotated[int, typer.Option(min=1, help="Which trajectory of a recording is drawn.")] = 1,
    time: Time = None,
    columns: Columns = None,
    scale: Scale = "1",
    time_scale: TimeScale = "1",
    sort: Sort = False,
    turn: Turn = 0.0,
    between: Between = None,
) -> None:
    """Draw a recording, or a fit or a diagnosis on top of its readings: maps, lines, residual, spectra, portraits."""
    from latticebench.bench.animation import FILMS, check_film
    from latticebench.bench.animation import animate as write_film
    from latticebench.bench.figures import save
    from latticebench.bench.plots import panels
    from latticebench.bench.plots import plot as draw
    from latticebench.bench.provenance import command_line, origin

    if out is None and animate is None:
        raise InputError("give --out FILE for a picture, --animate FILE for a film, or both")
    from latticebench.bench.figures import IMAGES

    for option, path, known in (("--out", out, IMAGES), ("--animate", animate, FILMS)):
        if path is not None and path.suffix.lower() not in known:
            raise unknown("ending", path.suffix, known, f"{option} {shown(path)}")
    if animate is not None:
        check_film(animate)
    check_places([file], out=out, animate=animate)
    overlay = _overlay(file, trajectory, layout_of(time, columns, scale, sort, turn, time_scale, between))
    for name in only or ():
        if name not in panels(overlay):
            raise unknown("panel", name, panels(overlay), "--only")
    about: dict[str, Any] = {"command": command_line(), **origin()}
    failures: list[str] = []
    if out is not None:
        with kept(failures):
            print(shown(save(draw(overlay, only or ()), out, about)))
    if animate is not None:
        with kept(failures):
            write_film(overlay, animate, about)
            print(shown(animate))
    if failures:
        raise InputError("; ".join(failures))


def _overlay(file: Path, trajectory: int, layout: Layout) -> Overlay:
    """Read what is drawn.

    Raises:
        InputError: the file cannot be read, or there is nothing in it that can be drawn.
    """
    from latticebench.bench.overlay import of_recording

    if file.suffix.lower() == ".json":
        return _written(file)
    data = read_told([file], "unknown", layout)
    if trajectory > len(data):
        raise InputError(f"--trajectory {trajectory}: {shown(file)} has {len(data)}")
    return of_recording(data[trajectory - 1])


def _written(file: Path) -> Overlay:
    """Read what the JSON document of a fit or a diagnosis shows.

    Raises:
        InputError: it is another document, or of a version that did not draw.
    """
    from latticebench.bench.report.shown import Shown
    from latticebench.systems.files import read_json

    found = read_json(file)
    kind = str(found.get("schema", "")).split("/") if isinstance(found, dict) else []
    if kind[:1] != ["latticebench"] or kind[1:2] not in (["fit"], ["diagnosis"]):
        raise InputError(f"{shown(file)}: this is no document of `latticebench fit --json` or `diagnose --json`")
    if found.get("shown") is None:
        raise InputError(f"{shown(file)}: a version that did not draw has written it; write it again")
    try:
        return Shown.model_validate(found["shown"]).overlay()
    except ValueError as error:
        reason = str(error).splitlines()[-1].strip()
        raise InputError(f"{shown(file)}: key shown: it cannot be drawn ({reason}); write it again") from None
