"""`latticebench publish`: make a site of published results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from latticebench.bench.cli.options import place
from latticebench.systems.files import shown

EPILOG = "Example:  latticebench publish results/* --out site"


def publish(
    folders: Annotated[
        list[Path],
        typer.Argument(parser=place, help="Folders of published tables, texts and pictures.", metavar="DIR..."),
    ],
    out: Annotated[
        Path, typer.Option(parser=place, metavar="DIR", help="Where to write the site; one that is there is replaced.")
    ],
) -> None:
    """Make a static site of published results: tables to sort and filter, figures, texts, and what made them."""
    from latticebench.bench.provenance import command_line, origin
    from latticebench.bench.site.build import build

    files = build(folders, out, {"command": command_line(), **origin()})
    pages = sum(name.endswith(".html") and not name.startswith("files/") for name in files)
    print(f"{shown(out / 'index.html')}: {pages} pages, {len(files) - pages} files beside them")
