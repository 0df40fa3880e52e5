"""`latticebench figures`: draw the results of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from latticebench.bench.cli.options import place

EPILOG = "Example:  latticebench figures runs/default --out results/default"


def figures(
    folder: Annotated[Path, typer.Argument(help="A store of results.", metavar="DIR")],
    out: Annotated[
        Path | None, typer.Option(parser=place, metavar="DIR", help="Where to write them; DIR/figures if not given.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Draw this kind of figure alone; may be given several times.")
    ] = None,
) -> None:
    """Draw the results of a run: coefficients by iteration, errors by time and noise, effects by what was named."""
    from latticebench.bench import kinds
    from latticebench.bench.store import open_store

    kinds.check_figures(only)
    for path in kinds.draw(open_store(folder), folder / "figures" if out is None else out, only):
        print(path)
