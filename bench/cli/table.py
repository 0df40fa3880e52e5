"""`latticebench table`: show and publish the results of a run."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from latticebench.bench.cli.arguments import kept
from latticebench.bench.cli.options import OTHERS, Beside, check_places, place
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.files import shown

if TYPE_CHECKING:
    from latticebench.bench.beside import Published
    from latticebench.bench.store import Shard, Store

EPILOG = (
    "Example:  latticebench table runs/default --out results/default\n\n"
    "Beside what was published:  latticebench table runs/mine --with results/paper --out published"
)


def table(
    folder: Annotated[Path, typer.Argument(parser=place, help="A store of results.", metavar="DIR")],
    out: Annotated[
        Path | None,
        typer.Option(parser=place, metavar="DIR", help="Publish the tables here, as CSV, Markdown and LaTeX."),
    ] = None,
    value: Annotated[str, typer.Option(help="Which score of fits to show.")] = "e2",
    only: Annotated[
        list[str] | None, typer.Option(help="Publish this table alone; may be given several times.")
    ] = None,
    beside: Beside = None,
    spread: Annotated[
        bool,
        typer.Option("--spread/--no-spread", help="Show 10 % and 90 % quantiles and the number of seeds, too."),
    ] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print the tables of cases as JSON.")] = False,
) -> None:
    """Show the results of a run as a table, and publish them."""
    from latticebench.bench import kinds
    from latticebench.bench.beside import read_published
    from latticebench.bench.store import open_store
    from latticebench.bench.tables import SCORES

    if value not in SCORES:
        raise unknown("score", value, SCORES, "--value")
    kinds.check_tables(only)
    if out is not None and out.suffix.lower() in OTHERS and not out.is_dir():
        raise InputError(f"--out {shown(out)}: tables go into a folder; give its name, such as {shown(out.stem)}")
    store = open_store(folder)
    published = None if beside is None else read_published(beside)
    # Results of several kinds have folders of their own.
    for place_of_kind in () if out is None else (out, out / "fit"):
        check_places([None if published is None else published.file], out=place_of_kind / "cases.csv")
    written: Sequence[Path] = ()
    failures: list[str] = []
    # Files first: the screen may be full, or its reader stop reading.
    if out is not None:
        with kept(failures):
            written = kinds.publish(store, out, only, published)
    if as_json:
        print(document(store, beside=published), end="")
    else:
        kinds.show(store, value=value, beside=published, spread=spread)
    for path in written:
        print(shown(path), file=sys.stderr if as_json else sys.stdout)
    if failures:
        raise InputError("; ".join(failures))


def document(store: Store, shard: Shard | None = None, beside: Published | None = None) -> str:
    """Return one row per case, and published rows beside them, as JSON; see `bench.report.outputs.RunDocument`."""
    from latticebench.bench import kinds
    from latticebench.bench.provenance import describe
    from latticebench.bench.report.document import to_json
    from latticebench.bench.report.outputs import run_document
    from latticebench.bench.store import WHOLE

    rows = kinds.rows(store, shard or WHOLE, beside)
    with store.sound():
        return to_json(run_document(rows, describe(store.origins(), store.about(), store.seeds())))
