"""`latticebench schema`: the JSON Schemas of what `--json` writes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from latticebench.bench.cli.options import place
from latticebench.systems.errors import unknown

EPILOG = "Example:  latticebench schema diagnosis"
PUBLISHED = Path(__file__).parents[1] / "report" / "schemas"


def schema(
    name: Annotated[str | None, typer.Argument(help="A kind of document; without it all are listed.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(parser=place, metavar="DIR", help="Write it, or without a name all of them, into this folder."),
    ] = None,
) -> None:
    """Print the JSON Schema of a document that a command writes with --json."""
    published = {path.stem: path for path in sorted(PUBLISHED.glob("*.json"))}
    if name is not None and name not in published:
        raise unknown("document", name, list(published))
    if out is not None:
        _write(out, name)
    elif name is not None:
        print(published[name].read_text(encoding="utf-8"), end="")
    else:
        print("\n".join(published))


def _write(folder: Path, name: str | None) -> None:
    """Write the schemas that documents have in this version, or one of them."""
    from latticebench.bench.report.schema import DOCUMENTS, json_schema
    from latticebench.systems.files import shown, write_text

    for kind in DOCUMENTS if name is None else [name]:
        path = folder / f"{kind}.json"
        write_text(path, json_schema(kind))
        print(shown(path))
