"""Measure what limits, leases, a process of their own and keeping each at once cost the cases of a run.

    python results/scale/walls.py [default] [trivial]

runs the suite `default` and 10 000 trivial cases (`zero`, which fits nothing), or one of both, and writes walls.csv and
walls.md; rows of the other are kept.

`with` is `latticebench run` with one worker. `without` does the same from its start to its end - it reads the suite,
runs the cases, keeps their results and prints their table - but in one process, without leases or limits of time or
memory, and keeps all results at once when the last case has ended. Seconds are those of the whole command. In the
suite `default` both begin at the same moment, each on a core of its own, so that what else the machine does slows both.
Of trivial cases the process that keeps their results needs a part of another core. There both are under way, but only
one of them runs at a time: they take turns of a second, in which all processes of the other are stopped, and the
seconds are those of its own turns. So what else the machine does slows both alike here, too.

In the row of commit 09a63745e6cd, the side without keeps no results and prints no table.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd
import psutil

from latticebench.bench.case import Case, Folders
from latticebench.bench.executors.executor import Ledger
from latticebench.bench.kinds import show
from latticebench.bench.provenance import commit, lines, origin
from latticebench.bench.publish import markdown_list, markdown_table, render
from latticebench.bench.published import read_table
from latticebench.bench.run import run
from latticebench.bench.store import create
from latticebench.bench.suite import load
from latticebench.bench.threads import ONE_THREAD
from latticebench.bench.worker import outcome
from latticebench.methods.method import Skipped
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
PARTS = ("default", "trivial")
# Trivial cases, how often they are run, and the seconds of a turn.
TRIVIAL, TIMES, TURN = 10_000, 5, 1.0
SUITE = f"""title = "trivial cases"
[methods.zero]
method = "zero"
[[grid]]
system = "phi4"
libraries = ["lib2"]
sites = [9]
noise = [0.01]
seeds = "1-{TRIVIAL}"
"""


def without(suite: str, results: str) -> None:
    """Run a suite as `latticebench run` does, without what protects cases from one another and from interruptions."""
    loaded, store = load(suite, large=True), create(Path(results))
    run(loaded, store, executor=Bare(), about={"command": "python " + " ".join(sys.argv)})
    show(store, loaded.title)


class Bare:
    """An executor that runs cases one after another in this process, and keeps their results when all have ended."""

    about: ClassVar[dict[str, Any]] = {"jobs": 0}

    def execute(self, cases: Sequence[Case], folders: Folders, loads: Collection[str], ledger: Ledger) -> None:
        """Run cases; see `Executor.execute`."""
        made = origin(loads)
        results = [self._attempt(case, folders) for case in cases]
        with ledger.together():
            for case, result in zip(cases, results, strict=True):
                ledger.keep(case, result, made)

    def _attempt(self, case: Case, folders: Folders) -> dict[str, Any]:
        found = case.blank()
        try:
            case.run(folders, found)
        except Skipped as skipped:
            return outcome(case, "skipped", str(skipped), found)
        return outcome(case, "ok", "", found)


def started(suite: str, results: Path, *, walls: bool) -> subprocess.Popen[bytes]:
    """Start a process that runs the cases of a suite, with walls or without."""
    program = [sys.executable, "-m", "latticebench", "run", suite, "--jobs", "1", "--yes", "--results", str(results)]
    # Workers of a run have one thread each.
    return subprocess.Popen(
        program if walls else [sys.executable, __file__, "--without", suite, f"{results} bare"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env={**os.environ, **ONE_THREAD},
    )  # fmt: skip


def together(suite: str, results: Path) -> dict[bool, float]:
    """Return the seconds of both, run at the same time, from their start to their end."""
    begin = time.perf_counter()
    processes = {walls: started(suite, results, walls=walls) for walls in (True, False)}
    took: dict[bool, float] = {}
    while len(took) < len(processes):
        for walls, process in processes.items():
            if walls not in took and process.poll() is not None:
                took[walls] = time.perf_counter() - begin
                check(process)
        time.sleep(0.02)
    return took


def in_turns(suite: str, results: Path, first: bool) -> dict[bool, float]:
    """Return the seconds of the turns of both, of which one runs while all processes of the other are stopped."""
    took = {first: 0.0, not first: 0.0}
    processes: dict[bool, subprocess.Popen[bytes]] = {}
    while running := [walls for walls in took if walls not in processes or processes[walls].poll() is None]:
        for walls in running:
            begin = time.perf_counter()
            if walls in processes:
                send(processes[walls], signal.SIGCONT)
            else:
                processes[walls] = started(suite, results, walls=walls)
            with contextlib.suppress(subprocess.TimeoutExpired):
                processes[walls].wait(TURN if len(running) > 1 else None)
            if processes[walls].poll() is None:
                send(processes[walls], signal.SIGSTOP)
            took[walls] += time.perf_counter() - begin
    for process in processes.values():
        check(process)
    return took


def send(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    """Send a signal to a process, and then to all that it has started."""
    with contextlib.suppress(psutil.NoSuchProcess):
        process.send_signal(number)
        for one in psutil.Process(process.pid).children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                one.send_signal(number)


def check(process: subprocess.Popen[bytes]) -> None:
    """Stop if a process has failed."""
    if process.returncode:
        raise SystemExit(f"{process.args!r}: exit code {process.returncode}")


def pairs(part: str, kept: Path, folder: Path) -> Iterator[tuple[str, int, dict[bool, float]]]:
    """Return what was run, of how many cases, and how long it took with walls and without."""
    if part == "default":
        yield part, len(load("default").by_identity), together("default", kept)
        return
    suite = folder / "trivial.toml"
    suite.write_text(SUITE)
    for number in range(TIMES):
        yield part, TRIVIAL, in_turns(str(suite), folder / str(number), first=bool(number % 2))


def measured(part: str, kept: Path) -> Iterator[dict[str, object]]:
    """Return the rows of a part; results of `default` are kept."""
    with tempfile.TemporaryDirectory() as folder:
        for name, cases, took in pairs(part, kept, Path(folder)):
            row: dict[str, object] = {
                "suite": name, "cases": cases, "with": round(took[True], 1), "without": round(took[False], 1),
                "slower": f"{100 * (took[True] / took[False] - 1):.1f} %", "commit": commit(),
            }  # fmt: skip
            print(row, flush=True)
            yield row


def told(rows: pd.DataFrame) -> str:
    """Say how much slower the pairs of a suite are on average, with the standard error where there are several."""
    slower = rows["slower"].str.removesuffix(" %").astype(float)
    error = f" +- {slower.std() / len(slower) ** 0.5:.1f}" if len(slower) > 1 else ""
    many = f"{len(slower)} pair{'s' * (len(slower) > 1)}"
    middle = f", median {slower.median():.1f} %" if len(slower) > 1 else ""
    return f"{rows['suite'].iloc[0]}: {slower.mean():.1f}{error} % slower (mean of {many}{middle})"


def main() -> None:
    """Measure, and write the two files."""
    if sys.argv[1:2] == ["--without"]:
        without(*sys.argv[2:4])
        return
    parts, kept = sys.argv[1:] or list(PARTS), Path("runs") / "walls"
    if "default" in parts and kept.exists():
        raise SystemExit(f"{kept} is there: a run would go on from its results; move it away")
    table = pd.DataFrame([row for part in parts for row in measured(part, kept)])
    if (HERE / "walls.csv").exists():
        before = read_table(HERE / "walls.csv")
        kept_rows = before["suite"].isin(set(PARTS) - set(table["suite"]))
        table = pd.concat([before[kept_rows], table], ignore_index=True)
        table = table.sort_values("suite", kind="stable")
    about = {"command": " ".join(["python results/scale/walls.py", *sys.argv[1:]]), **origin()}
    write_text(HERE / "walls.csv", render(table, about, "csv"))
    write_text(HERE / "walls.md", page(table, about))


def page(table: pd.DataFrame, about: Mapping[str, Any]) -> str:
    """Return the text of walls.md."""
    text = (__doc__ or "").split("are kept.\n")[1].strip()
    provenance = "".join(f"{line}\n" for line in markdown_list(lines(about)))
    shown = table.rename(columns={"with": "seconds with", "without": "seconds without"}).astype(str)
    means = "\n".join(f"- {told(rows)}" for _, rows in table.groupby("suite"))
    return "\n\n".join(["# What the walls around a case cost", text, means, markdown_table(shown), provenance])


if __name__ == "__main__":
    main()
