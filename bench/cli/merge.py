"""`latticebench merge`: put shards together."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from latticebench.bench.cli.options import place
from latticebench.systems.files import shown

EPILOG = "Example:  latticebench merge runs/first runs/second --out runs/both"


def merge(
    folders: Annotated[
        list[Path], typer.Argument(parser=place, help="Stores of results of one suite.", metavar="DIR...")
    ],
    out: Annotated[Path, typer.Option(parser=place, metavar="DIR", help="The new store.")],
) -> None:
    """Put the results of several runs of one suite together, such as those of shards on several machines."""
    from latticebench.bench.merge import merge as merge_stores

    results, missing = merge_stores(folders, out)
    lacking = f"; {missing} cases of the suite have no result" if missing else ""
    print(f"{results} results in {shown(out)}{lacking}")
