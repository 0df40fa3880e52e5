"""Measure what limits, leases and the store cost a run: the same cases with them and without.

    python results/scale/walls.py [default] [trivial]

runs the suite `default` and 10 000 trivial cases (`zero`, which fits nothing), or one of both, and writes walls.csv and
walls.md; rows of the other are kept.

`with` is a run with one worker; `without` is one process that runs the cases one after another, keeps nothing and has
no limits of time or memory. In the suite `default` both begin at the same moment, each on a core of its own, so that
what else the machine does slows both, and seconds are those of `latticebench run` from its start to its end. Trivial
cases are run with and without in turns, either one first every second time, since the process that keeps their results
needs a part of another core; there seconds are those from the end of the hundredth case to that of the last. `trivial,
whole` is how much longer `latticebench run` takes from its start to its end: it starts two processes, reads the suite,
and prints a table of all cases.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from latticebench.bench.case import Case
from latticebench.bench.provenance import commit, lines, origin
from latticebench.bench.publish import markdown_list, markdown_table, render
from latticebench.bench.published import read_table
from latticebench.bench.run import run
from latticebench.bench.store import create
from latticebench.bench.suite import load
from latticebench.bench.threads import ONE_THREAD
from latticebench.bench.worker import attempt
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
# Trivial cases, and how often they are run: for the seconds of the cases, and of the whole. Before so many, processes
# still import what they need.
TRIVIAL, TIMES, FEW = 10_000, 8, 1
SETTLED = 100
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


def without(suite: str) -> None:
    """Run all cases of a suite in this process; print the seconds from the hundredth to the last."""
    cases, ends = load(suite), Ends()
    for case in cases.by_identity.values():
        ends.finished(case, attempt(case, cases.folders))
    print(ends.seconds())


def within(suite: str, results: str) -> None:
    """Run the same by a worker, keeping each result; print the same."""
    ends = Ends()
    run(load(suite, large=True), create(Path(results)), jobs=1, watcher=ends)
    print(ends.seconds())


class Ends:
    """A watcher that remembers when cases ended."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def count(self, left: int) -> None:
        """Ignore how many there are."""

    def started(self, case: Case) -> None:
        """Ignore the start of a case."""

    def found(self) -> None:
        """Ignore what another run has done: there is none."""

    def finished(self, case: Case, result: dict[str, Any]) -> None:  # noqa: ARG002
        """Remember the time."""
        self.times.append(time.perf_counter())

    def seconds(self) -> float:
        """Return the seconds from the hundredth case, or the first of fewer, to the last."""
        return self.times[-1] - self.times[min(len(self.times), SETTLED) - 1]


def started(suite: str, results: Path, *, walls: bool, whole: bool = True) -> subprocess.Popen[str]:
    """Start a process that runs the cases of a suite, with walls or without; as `latticebench run` if whole."""
    program = [sys.executable, "-m", "latticebench", "run", suite, "--jobs", "1", "--yes", "--results", str(results)]
    own = [sys.executable, __file__, *(["--with", suite, str(results)] if walls else ["--without", suite])]
    # Workers of a run have one thread each.
    alike = {**os.environ, **ONE_THREAD}
    return subprocess.Popen(
        program if walls and whole else own, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=alike, text=True
    )


def together(suite: str, results: Path) -> dict[bool, float]:
    """Return the seconds of both, run at the same time, from their start to their end."""
    begin = time.perf_counter()
    processes = {walls: started(suite, results, walls=walls) for walls in (True, False)}
    took: dict[bool, float] = {}
    # A process must not wait for what it prints to be read.
    readers = {walls: threading.Thread(target=process.communicate) for walls, process in processes.items()}
    for reader in readers.values():
        reader.start()
    while len(took) < len(processes):
        for walls, reader in readers.items():
            if walls not in took and not reader.is_alive():
                took[walls] = time.perf_counter() - begin
                check(processes[walls])
        time.sleep(0.02)
    return took


def alone(suite: str, results: Path, *, walls: bool, whole: bool = False) -> float:
    """Return the seconds of one: from the hundredth case to the last, or from its start to its end."""
    begin = time.perf_counter()
    process = started(suite, results, walls=walls, whole=whole)
    printed = process.communicate()[0]
    check(process)
    return time.perf_counter() - begin if whole else float(printed)


def check(process: subprocess.Popen[str]) -> None:
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
    for name, times in ((part, TIMES), ("trivial, whole", FEW)):
        for number in range(times):
            order = (True, False) if number % 2 else (False, True)
            results = folder / f"{name} {number}"
            yield name, TRIVIAL, {
                walls: alone(str(suite), results, walls=walls, whole=name != part) for walls in order
            }  # fmt: skip


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
    return f"{rows['suite'].iloc[0]}: {slower.mean():.1f}{error} % slower (mean of {many})"


def main() -> None:
    """Measure, and write the two files."""
    if sys.argv[1:2] == ["--without"]:
        without(sys.argv[2])
        return
    if sys.argv[1:2] == ["--with"]:
        within(*sys.argv[2:4])
        return
    parts, kept = sys.argv[1:] or ["default", "trivial"], Path("runs") / "walls"
    if "default" in parts and kept.exists():
        raise SystemExit(f"{kept} is there: a run would go on from its results; move it away")
    table = pd.DataFrame([row for part in parts for row in measured(part, kept)])
    if (HERE / "walls.csv").exists():
        before = read_table(HERE / "walls.csv")
        table = pd.concat([before[~before["suite"].isin(table["suite"])], table], ignore_index=True)
        table = table.sort_values("suite", kind="stable")
    about = {"command": " ".join(["python results/scale/walls.py", *sys.argv[1:]]), **origin()}
    write_text(HERE / "walls.csv", render(table, about, "csv"))
    text = (__doc__ or "").split("are kept.\n")[1].strip()
    provenance = "".join(f"{line}\n" for line in markdown_list(lines(about)))
    shown = table.rename(columns={"with": "seconds with", "without": "seconds without"}).astype(str)
    means = "\n".join(f"- {told(rows)}" for _, rows in table.groupby("suite"))
    page = "\n\n".join(["# What the walls around a case cost", text, means, markdown_table(shown), provenance])
    write_text(HERE / "walls.md", page)


if __name__ == "__main__":
    main()
