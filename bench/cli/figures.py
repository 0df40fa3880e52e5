"""`latticebench figures`: draw the results of a run."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from latticebench.bench.cli.options import Beside, check_places, place
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.files import check_outputs, shown, whole

if TYPE_CHECKING:
    from latticebench.bench.beside import Published
    from latticebench.bench.store import Store

EPILOG = "Example:  latticebench figures runs/default --out results/default"


def figures(
    folder: Annotated[Path, typer.Argument(parser=place, help="A store of results.", metavar="DIR")],
    out: Annotated[
        Path | None,
        typer.Option(
            parser=place,
            metavar="DIR",
            help="Where to write them; DIR/figures if not given. One figure: a .png, .svg or .pdf.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Draw this kind of figure alone; may be given several times.")
    ] = None,
    beside: Beside = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a program.")] = False,
) -> None:
    """Draw the results of a run: coefficients by iteration, errors by time and noise, effects by what was named."""
    from latticebench.bench import kinds
    from latticebench.bench.beside import read_published
    from latticebench.bench.store import open_store

    kinds.check_figures(only)
    store = open_store(folder)
    published = None if beside is None else read_published(beside)
    # With an ending of letters no folder is meant, unless there is one.
    if out is not None and out.suffix[1:].isalpha() and not out.is_dir():
        files = [_draw_one(store, out, only, published)]
    else:
        drawn = folder / "figures" if out is None else out
        check_places([], out=drawn / "figure.png")
        files = kinds.draw(store, drawn, only, published)
    if not files:
        print("no figure: these results have nothing that it could show", file=sys.stderr)
    if as_json:
        from latticebench.bench.report.document import provenance, to_json
        from latticebench.bench.report.outputs import FiguresDocument

        about = "" if published is None else published.about
        found = FiguresDocument(provenance=provenance(), published=about, files=list(map(str, files)))
        print(to_json(found), end="")
    else:
        for path in files:
            print(shown(path))


def _draw_one(store: Store, out: Path, only: list[str] | None, beside: Published | None) -> Path:
    """Draw a single figure into a file, and return that.

    Raises:
        InputError: its ending is that of no figure, or there are several figures, or none.
    """
    from latticebench.bench import kinds
    from latticebench.bench.figures import IMAGES, drawn_as

    if out.suffix.lower() not in IMAGES:
        raise unknown("ending", out.suffix, IMAGES, f"--out {shown(out)}")
    check_outputs({"--out": out})
    with tempfile.TemporaryDirectory() as drawn, drawn_as(out.suffix.lower()):
        found = kinds.draw(store, Path(drawn), only, beside)
        if len(found) != 1:
            raise InputError(
                f"--out {shown(out)}: there are {len(found)} figures; choose one with --only, or give a folder"
            )
        with whole(out) as temporary:
            temporary.write_bytes(found[0].read_bytes())
    return out
