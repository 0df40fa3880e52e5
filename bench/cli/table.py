"""`latticebench table`: show and publish the results of a run."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from latticebench.bench.cli.arguments import jsonable, selected
from latticebench.systems.errors import InputError, unknown

EPILOG = "Example:  latticebench table runs/default --out results/default"


def table(
    folder: Annotated[Path, typer.Argument(help="A store of results.", metavar="DIR")],
    out: Annotated[Path | None, typer.Option(help="Publish the tables here, as CSV, Markdown and LaTeX.")] = None,
    value: Annotated[str, typer.Option(help="Which score to show.")] = "e2",
    only: Annotated[
        list[str] | None, typer.Option(help="Publish this table alone; may be given several times.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the table of cases as JSON.")] = False,
) -> None:
    """Show the results of a run as a table, and publish them."""
    from latticebench.bench.provenance import describe
    from latticebench.bench.publish import TABLES, publish
    from latticebench.bench.screen import show_results
    from latticebench.bench.store import open_store
    from latticebench.bench.tables import SCORES
    from latticebench.bench.trials import scores

    if value not in SCORES:
        raise unknown("score", value, SCORES, "--value")
    chosen = selected(only, TABLES, "table")
    if scores.is_run(folder):
        show_trials(folder, out, as_json)
        return
    store = open_store(folder)
    found = store.all()
    if not found:
        raise InputError(f"{folder}: there are no results in it yet; run a suite with --results {folder}")
    if as_json:
        print(cases_json(found))
    else:
        show_results(found, describe(found, store.about()), "", value)
    if out is not None:
        for path in publish(found, describe(found, store.about()), out, chosen):
            print(path, file=sys.stderr if as_json else sys.stdout)


def show_trials(folder: Path, out: Path | None, as_json: bool) -> None:
    """Show the results of a suite of diagnoses, and publish them."""
    from latticebench.bench.screen import show_rows
    from latticebench.bench.trials import scores

    rows = scores.read(folder)
    if as_json:
        print(json.dumps(rows, indent=2))
    for path in scores.publish(rows, scores.about(rows, folder), out) if out is not None else ():
        print(path, file=sys.stderr if as_json else sys.stdout)
    if as_json or out is not None:
        return
    made = [row for row in rows if "effect" in row]
    if made:
        frame = scores.summary(scores.table(made))
        show_rows(list(frame.columns), frame.to_numpy().tolist())
    for row in rows:
        if "terms" in row:
            found = row["report"]["verdict"] if row["status"] == "ok" else row["message"]
            print(f"{row['name']}: {found}")


def cases_json(results: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of cases as JSON."""
    from latticebench.bench.tables import cases

    return json.dumps(jsonable(cases(results).to_dict("records")), indent=2)
