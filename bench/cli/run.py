"""`latticebench run`: run a suite."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from latticebench.bench.cli.options import complete_suites
from latticebench.bench.cli.table import cases_json, show_trials

if TYPE_CHECKING:
    from latticebench.bench.suite import Suite

EPILOG = "Example:  latticebench run default --jobs 2 --results runs/default"


def run(
    suite: Annotated[
        str, typer.Argument(help="A name from `list suites`, or a .toml file.", autocompletion=complete_suites)
    ],
    jobs: Annotated[int | None, typer.Option(min=1, help="Worker processes; one a core if not given.")] = None,
    results: Annotated[Path | None, typer.Option(help="Where results are kept; runs/SUITE if not given.")] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Run cases that failed again.")] = False,
    data: Annotated[Path, typer.Option(help="The folder of measured recordings, for a suite of them.")] = Path("data"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the table of cases as JSON.")] = False,
) -> None:
    """Run a suite, continuing where it was stopped, and show its table of errors."""
    from latticebench.bench.trials.trial import is_suite

    if is_suite(suite):
        _run_trials(suite, jobs or os.cpu_count() or 1, results, data, as_json)
        return
    from latticebench.bench.provenance import command_line, describe
    from latticebench.bench.run import run as run_suite
    from latticebench.bench.screen import progress_bar, show_results
    from latticebench.bench.store import create
    from latticebench.bench.suite import load

    loaded = load(suite)
    folder = results if results is not None else Path("runs") / loaded.name
    store = create(folder)
    jobs = jobs or os.cpu_count() or 1
    about = {
        "command": " ".join(["latticebench", *command_line()]), "suite": loaded.name, "jobs": jobs,
        "settings": _contestants(loaded),
    }  # fmt: skip
    # A cluster that ends a job says so first; that is the same as Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with progress_bar(len(loaded.cases)) as watcher:
            found, tally = run_suite(loaded, store, jobs=jobs, retry=retry, watcher=watcher, about=about)
    except KeyboardInterrupt:
        print(
            f"stopped; {len(store.all())} results are in {folder}; the same command continues from there",
            file=sys.stderr,
        )
        raise
    if as_json:
        print(cases_json(found))
        return
    show_results(found, describe(found, store.about()), loaded.title)
    statuses = ", ".join(f"{count} {status}" for status, count in sorted(tally.statuses.items()))
    print(f"{len(found)} cases ({statuses}); {tally.ran} run now, {tally.reused} were there; kept in {folder}")


def _run_trials(suite: str, jobs: int, results: Path | None, data: Path, as_json: bool) -> None:
    """Run a suite of diagnoses, and show how often they were right."""
    from latticebench.bench.provenance import command_line
    from latticebench.bench.screen import progress
    from latticebench.bench.trials.trial import load, run
    from latticebench.systems.files import write_text

    _, trials = load(suite)
    folder = results if results is not None else Path("runs") / Path(suite).stem
    about = {"command": " ".join(["latticebench", *command_line()]), "suite": Path(suite).stem, "jobs": jobs}
    # First, so that a run that is stopped says what it was.
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "about.txt", json.dumps(about) + "\n")
    with progress(len(trials)) as step:
        rows = run(trials, folder, jobs=jobs, data=data, watcher=step)
    show_trials(folder, None, as_json)
    print(f"{len(rows)} diagnoses, kept in {folder}", file=sys.stderr)


def _contestants(suite: Suite) -> dict[str, str]:
    """Say what each label of a suite stands for, with all its settings."""
    from latticebench import methods
    from latticebench.methods.method import make, settings

    written = {}
    for case in suite.cases:
        if case.label not in written:
            kind = methods.find(case.method, suite.base)
            chosen = make(kind, case.settings)
            values = {name: getattr(chosen, name) for name in settings(kind)}
            written[case.label] = ", ".join([case.method, *(f"{n}={v}" for n, v in values.items() if v is not None)])
    return written
