"""`latticebench run`: run a suite."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from latticebench.bench.cli.options import Yes, complete_suites, place
from latticebench.bench.cli.table import document
from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from latticebench.bench.case import Case
    from latticebench.bench.store import Shard
    from latticebench.bench.suite import Suite

EPILOG = "Example:  latticebench run default --jobs 2 --results runs/default"


def run(
    suite: Annotated[
        str, typer.Argument(help="A name from `list suites`, or a .toml file.", autocompletion=complete_suites)
    ],
    jobs: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Worker processes; one per core if not given.")
    ] = None,
    results: Annotated[
        Path | None, typer.Option(parser=place, metavar="DIR", help="Where results are kept; runs/SUITE if not given.")
    ] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Run cases that failed again.")] = False,
    shard: Annotated[
        str | None, typer.Option(metavar="K/N", help="Run every N-th case alone, beginning with the K-th.")
    ] = None,
    data: Annotated[Path, typer.Option(parser=place, metavar="DIR", help="The folder of measured recordings.")] = Path(
        "data"
    ),
    as_json: Annotated[bool, typer.Option("--json", help="Print the tables of cases as JSON.")] = False,
    yes: Yes = False,
) -> None:
    """Run a suite, continuing where it was stopped, and show its results."""
    from latticebench.bench import kinds
    from latticebench.bench.provenance import command_line
    from latticebench.bench.report.screen import progress_bar
    from latticebench.bench.run import run as run_suite
    from latticebench.bench.store import create
    from latticebench.bench.suite import load

    loaded = load(suite, data, large=yes)
    part = shard_of(shard, len(loaded.cases))
    jobs = jobs or os.cpu_count() or 1
    _tell_hours(suite, loaded.cases[part.first - 1 :: part.step], jobs, yes)
    folder = results if results is not None else Path("runs") / loaded.name
    store = create(folder)
    about = {"command": command_line(), "suite": loaded.name, "jobs": jobs}
    if loaded.contestants:
        about["settings"] = _contestants(loaded)
    # A cluster that ends a job says so first; that is the same as Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with progress_bar(len(loaded.cases[part.first - 1 :: part.step])) as watcher:
            found, tally = run_suite(loaded, store, jobs=jobs, retry=retry, shard=part, watcher=watcher, about=about)
    except KeyboardInterrupt:
        print(
            f"stopped; {len(store.results())} results are in {folder}; the same command continues from there",
            file=sys.stderr,
        )
        raise
    title = loaded.title
    # What is shown is read from the store; a hundred thousand cases need not be held beside it.
    del loaded, watcher
    if as_json:
        print(document(store, part), end="")
        return
    kinds.show(store, title, shard=part)
    statuses = ", ".join(f"{count} {status}" for status, count in tally.statuses.items())
    print(f"{len(found)} cases ({statuses}); {tally.ran} run now, {tally.reused} were there; kept in {folder}")


def _tell_hours(suite: str, cases: Sequence[Case], jobs: int, yes: bool) -> None:
    """Say how long cases may take, and ask for a confirmation where that is absurd.

    Raises:
        InputError: it is, and there is none.
    """
    from latticebench.bench.effort import TOLD_HOURS, check_hours, hours

    most = hours(cases, jobs)
    if not yes:
        check_hours(most, suite)
    if most > TOLD_HOURS:
        print(f"{suite}: at most {most:.0f} hours, if every case needs all of its time limit", file=sys.stderr)


def shard_of(text: str | None, cases: int) -> Shard:
    """Read K/N as a part of a suite of so many cases; all of it for None.

    Raises:
        InputError: there is no such part.
    """
    from latticebench.bench.store import WHOLE, Shard

    if text is None:
        return WHOLE
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip())
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise InputError(f"--shard {text}: write K/N with K from 1 to N, such as 1/10 for every tenth case")
    if int(found[1]) > cases:
        raise InputError(f"--shard {text}: there is no case {found[1]}, the suite has {cases}")
    return Shard(int(found[1]), int(found[2]))


def _contestants(suite: Suite) -> dict[str, str]:
    """Return what each label of a suite stands for, with all its settings; of a user's file, with those given."""
    from latticebench import methods
    from latticebench.bench.case import code_file
    from latticebench.methods.method import make, settings

    written = {}
    for label, one in suite.contestants.items():
        values: dict[str, Any] = dict(one.settings)
        if code_file(one.method) is None:
            kind = methods.find(one.method)
            chosen = make(kind, one.settings)
            values = {name: getattr(chosen, name) for name in settings(kind)}
        written[label] = ", ".join([one.method, *(f"{n}={v}" for n, v in values.items() if v is not None)])
    return written
