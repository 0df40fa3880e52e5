"""`latticebench figures`: draw the results of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from latticebench.bench.cli.arguments import selected
from latticebench.systems.errors import InputError

EPILOG = "Example:  latticebench figures runs/default --out results/default"


def figures(
    folder: Annotated[Path, typer.Argument(help="A store of results.", metavar="DIR")],
    out: Annotated[Path | None, typer.Option(help="Where to write them; DIR/figures if not given.")] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Draw this kind of figure alone; may be given several times.")
    ] = None,
) -> None:
    """Draw the results of a run: coefficients against iteration, errors, error against time and noise."""
    from latticebench.bench.figures import FIGURES, draw_all
    from latticebench.bench.provenance import describe
    from latticebench.bench.store import open_store

    chosen = selected(only, FIGURES, "figure")
    store = open_store(folder)
    found = store.all()
    if not found:
        raise InputError(f"{folder}: there are no results in it yet; run a suite with --results {folder}")
    for path in draw_all(found, describe(found, store.about()), out if out is not None else folder / "figures", chosen):
        print(path)
