"""`latticebench data`: the measured recordings that are known, and a checked copy of one."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from latticebench.bench.cli.options import complete_recordings

app = typer.Typer(
    help="List measured recordings, and take a local copy of one.",
    epilog="Example:  latticebench data take gliders ~/Downloads/gliders.csv",
    invoke_without_command=True,
    rich_markup_mode="rich",
)


@app.callback()
def data(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a program.")] = False,
) -> None:
    """List measured recordings, and take a local copy of one."""
    if context.invoked_subcommand is not None:
        return
    from latticebench.bench.recordings import RECORDINGS

    if as_json:
        from latticebench.bench.report.document import provenance, to_json
        from latticebench.bench.report.outputs import ListDocument

        rows = [dataclasses.asdict(one) for one in RECORDINGS]
        print(to_json(ListDocument(provenance=provenance(), kind="recordings", rows=rows)), end="")
        return
    for one in RECORDINGS:
        print(f"{one.name}: {one.what}")
        print(f"    {one.rows} rows of {one.columns}, {one.sampling}\n    source:  {one.source}")
        print(f"    licence: {one.licence}\n    SHA-256: {one.sha256}\n")
    print("None of them comes with this program. Have one already?  latticebench data take NAME FILE")


@app.command(epilog="Example:  latticebench data take gliders ~/Downloads/gliders.csv data")
def take(
    name: Annotated[str, typer.Argument(help="A recording that `data` lists.", autocompletion=complete_recordings)],
    origin: Annotated[Path, typer.Argument(metavar="FILE", help="The file that you have of it.")],
    place: Annotated[
        Path | None, typer.Argument(metavar="[TO]", help="A folder or a .csv file for the copy; data/ if not given.")
    ] = None,
) -> None:
    """Check that a file is a recording, by its SHA-256, and copy it to where you want it. Nothing is downloaded."""
    from latticebench.bench.recordings import take as copy
    from latticebench.systems.files import shown

    made, new = copy(name, origin, place)
    print(f"{shown(made)}: {'copied' if new else 'was there already'}, SHA-256 as it should be")
