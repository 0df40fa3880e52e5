"""`latticebench run`: run a suite."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from latticebench.bench.cli.options import Jobs, Methods, Only, Recordings, Seeds, Yes, complete_suites, place
from latticebench.bench.cli.table import document
from latticebench.systems.errors import InputError, printable
from latticebench.systems.files import shown

if TYPE_CHECKING:
    from latticebench.bench.executors.cluster import Place
    from latticebench.bench.executors.executor import Executor
    from latticebench.bench.run import Tally
    from latticebench.bench.store import Shard, Store
    from latticebench.bench.suite import Suite

EPILOG = (
    "Example:  latticebench run default --jobs 2 --results runs/default\n\n"
    "A part of it, with a method of your own:  latticebench run paper --only 'phi4*' --methods stlsq,mine.py --dry-run"
)

ExecutorName = Annotated[
    Literal["local", "dask"], typer.Option(help="Run cases in processes of this machine, or on workers of Dask's.")
]
Scheduler = Annotated[
    str | None, typer.Option(metavar="tcp://HOST:PORT", help="With dask: a scheduler that runs; tls://, too.")
]
Cluster = Annotated[
    str | None, typer.Option(metavar="local:N|FILE.toml", help="With dask: N workers here, or jobs of a batch system.")
]
AnyProcessor = Annotated[
    bool, typer.Option("--any-processor", help="With dask: take unlike processors even for a suite that is timed.")
]

ResultsDir = Annotated[
    Path | None, typer.Option(parser=place, metavar="DIR", help="Where results are kept; runs/SUITE if not given.")
]

DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Say how many cases it is and how long they took before; run nothing.")
]

ShardText = Annotated[
    str | None, typer.Option(metavar="K/N", help="Run every N-th case alone, beginning with the K-th.")
]


def run(
    suite: Annotated[
        str, typer.Argument(help="A name from `list suites`, or a .toml file.", autocompletion=complete_suites)
    ],
    jobs: Jobs = None,
    executor: ExecutorName = "local",
    scheduler: Scheduler = None,
    cluster: Cluster = None,
    any_processor: AnyProcessor = False,
    results: ResultsDir = None,
    retry: Annotated[bool, typer.Option("--retry", help="Run cases that failed again.")] = False,
    only: Only = None,
    methods: Methods = None,
    seeds: Seeds = None,
    dry_run: DryRun = False,
    shard: ShardText = None,
    data: Recordings = Path("data"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the tables of cases as JSON.")] = False,
    yes: Yes = False,
) -> None:
    """Run a suite, continuing where it was stopped, and show its results."""
    from latticebench.bench.choice import chosen
    from latticebench.bench.provenance import command_line
    from latticebench.bench.store import create
    from latticebench.bench.suite import load

    choice = chosen(only, methods, seeds)
    loaded = load(suite, data, large=yes, choice=choice)
    part = shard_of(shard, len(loaded.cases))
    where = _place(executor, scheduler, cluster, any_processor, jobs)
    jobs = (jobs or os.cpu_count() or 1) if where is None else where.workers
    folder = results if results is not None else Path("runs") / loaded.name
    if dry_run:
        _tell_estimate(loaded, part, jobs, folder, retry, as_json)
        return
    _tell_hours(suite, loaded, part, jobs, folder, retry, yes)
    store = create(folder)
    about = {"command": command_line(), **loaded.about, "chosen": str(choice)}
    with _executor(where, loaded, folder, jobs, any_processor) as one:
        tally = _run(loaded, store, one, part, retry, {**about, **one.about})
    title = loaded.title
    # What is shown is read from the store; a hundred thousand cases need not be held beside it.
    del loaded, one
    if as_json:
        print(document(store, part), end="")
    else:
        _show(store, title, part, f"{tally.ran} run now, {tally.reused} were there; kept in {shown(folder)}")


def _run(suite: Suite, store: Store, executor: Executor, part: Shard, retry: bool, about: dict[str, Any]) -> Tally:
    """Run a suite with a display of its progress; return what was done.

    Raises:
        KeyboardInterrupt: the user stopped it, and has been told how it goes on.
    """
    from latticebench.bench.progress import progress_of
    from latticebench.bench.run import run as run_suite

    # A cluster that ends a job says so first; that is the same as Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with progress_of(len(suite.cases[part.first - 1 :: part.step])) as watcher:
            return run_suite(suite, store, executor=executor, retry=retry, shard=part, watcher=watcher, about=about)[1]
    except KeyboardInterrupt:
        print(
            f"stopped; {len(store.results())} results are in {shown(store.path.parent)}, which `latticebench table` "
            "shows; the same command continues from there",
            file=sys.stderr,
        )
        raise


def _place(
    executor: str, scheduler: str | None, cluster: str | None, any_processor: bool, jobs: int | None
) -> Place | None:
    """Return where the workers of Dask's are; None for processes of this machine.

    Raises:
        InputError: the options do not go together, or Dask is not installed.
    """
    if executor == "local":
        for name, given in (("scheduler", scheduler), ("cluster", cluster), ("any-processor", any_processor)):
            if given:
                raise InputError(f"--{name}: goes with --executor dask")
        return None
    from latticebench.bench.executors.cluster import check_installed, place_of

    if jobs is not None:
        raise InputError("--jobs: the workers of --executor dask are those of --scheduler or --cluster")
    check_installed()
    return place_of(scheduler, cluster)


@contextmanager
def _executor(where: Place | None, suite: Suite, folder: Path, jobs: int, any_processor: bool) -> Iterator[Executor]:
    """Return what runs the cases; what it has started ends after the block."""
    if where is None:
        from latticebench.bench.executors.local import Local

        yield Local(jobs)
        return
    from latticebench.bench.estimate import seconds_of
    from latticebench.bench.executors.cluster import is_open
    from latticebench.bench.executors.dask import Dask

    with where.connected() as connection:
        if is_open(connection.address):
            print(
                f"warning: the scheduler at {connection.address} takes code from all who reach it; use tls:// "
                "(see docs/cluster.md)",
                file=sys.stderr,
            )
        if connection.dashboard:
            print(f"dashboard: {connection.dashboard}", file=sys.stderr)
        yield Dask(connection, suite.timing and not any_processor, seconds_of(suite, folder))


def _show(store: Store, title: str, part: Shard, told: str) -> None:
    """Print the results, and what was done."""
    from latticebench.bench import kinds

    kinds.show(store, title, shard=part)
    statuses = store.statuses(part)
    counts = printable(", ".join(f"{n} {status}" for status, n in statuses.items()))
    print(f"{sum(statuses.values())} cases ({counts}); {told}")


def _tell_estimate(suite: Suite, part: Shard, jobs: int, folder: Path, retry: bool, as_json: bool) -> None:
    """Print what would be run, and how long it took before.

    Raises:
        InputError: JSON is asked for.
    """
    from latticebench.bench.effort import hours
    from latticebench.bench.estimate import estimate
    from latticebench.bench.progress import clock
    from latticebench.bench.report.screen import show_rows

    if as_json:
        raise InputError("--json: a dry run has no results to print; leave one of the two out")
    cases = suite.cases[part.first - 1 :: part.step]
    found = estimate(suite, cases, folder, retry=retry)
    rows = [
        (row["method"], row["cases"], row["there"], row["known"], clock(row["seconds"]) if row["known"] else "?")
        for row in found.methods.to_dict("records")
    ]
    show_rows(("method", "cases", "finished", "with a recorded time", "which is"), rows)
    to_run = found.cases - found.there
    print(f"{found.cases} cases, {found.there} of them finished in {shown(folder)}; {to_run} to run")
    if found.known:
        most = "about" if found.known == to_run else "at least"
        print(
            f"{most} {clock(found.seconds(jobs))} on {jobs} worker{'s' if jobs > 1 else ''}, {found.core_hours:.2g} "
            f"core-hours, by what {found.known} of the {to_run} took in {' and '.join(map(shown, found.sources))}"
        )
    if found.known < to_run:
        print(
            f"{to_run - found.known} have not been run before: there is nothing to estimate from; by their time "
            f"limits all {to_run} take at most {hours(cases, jobs) * to_run / found.cases:.2g} hours"
        )
    print("nothing was run or written")


def _tell_hours(where: str, suite: Suite, part: Shard, jobs: int, folder: Path, retry: bool, yes: bool) -> None:
    """Say how long cases may take, and ask for a confirmation where that is much.

    Raises:
        InputError: it is, and there is none.
    """
    from latticebench.bench.effort import TOLD_HOURS, check_hours, check_known_hours, hours
    from latticebench.bench.estimate import estimate, seconds_of

    cases = suite.cases[part.first - 1 :: part.step]
    most, known = hours(cases, jobs), sum(seconds_of(suite, folder).values()) / jobs / 3600
    if known > TOLD_HOURS:
        # Some of them may be finished, which takes longer to find out.
        known = estimate(suite, cases, folder, retry=retry).seconds(jobs) / 3600
    if not yes:
        check_hours(most, where)
        check_known_hours(known, where)
    if known > TOLD_HOURS:
        print(f"{shown(where)}: about {known:.1f} hours, by what its cases took before", file=sys.stderr)
    elif most > TOLD_HOURS:
        told = f"{most:.0f} hour{'s' * (round(most) != 1)}"
        print(f"{shown(where)}: at most {told}, if every case needs all of its time limit", file=sys.stderr)


def shard_of(text: str | None, cases: int) -> Shard:
    """Read K/N as a part of a suite of so many cases; all of it for None.

    Raises:
        InputError: there is no such part.
    """
    from latticebench.bench.store import WHOLE, Shard

    if text is None:
        return WHOLE
    found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text.strip())
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise InputError(f"--shard {text}: write K/N with K from 1 to N, such as 1/10 for every tenth case")
    if int(found[1]) > cases:
        raise InputError(f"--shard {text}: there is no case {found[1]}, the suite has {cases}")
    return Shard(int(found[1]), int(found[2]))
