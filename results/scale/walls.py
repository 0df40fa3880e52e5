"""Measure what limits, leases and the store cost a run: the same cases with them and without.

    python results/scale/walls.py [default] [trivial]

runs the suite `default` and 10 000 trivial cases (`zero`, which fits nothing), or one of both, and writes walls.csv and
walls.md; rows of the other are kept.

`with` is `latticebench run SUITE --jobs 1`; `without` is one process that runs the cases one after another, keeps
nothing and has no limits of time or memory. In the suite `default` both begin at the same moment, each on a core of its
own, so that what else the machine does slows both. Trivial cases are run with and without in turns, either one first
every second time, since the process that keeps their results needs a part of another core. Seconds are of the clock,
from the start of the process to its end; `one case` is how much longer a run of a single trivial case takes: the start
of the runner and of its worker, and the table that it prints.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import pandas as pd

from latticebench.bench.provenance import commit, lines, origin
from latticebench.bench.publish import markdown_list, markdown_table, render
from latticebench.bench.published import read_table
from latticebench.bench.suite import load
from latticebench.bench.threads import ONE_THREAD
from latticebench.bench.worker import attempt
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
# Trivial cases, and how often they are run.
TRIVIAL, TIMES = 10_000, 10
SUITE = """title = "trivial cases"
[methods.zero]
method = "zero"
[[grid]]
system = "phi4"
libraries = ["lib2"]
sites = [9]
noise = [0.01]
seeds = "1-{}"
"""


def without(suite: str) -> None:
    """Run all cases of a suite in this process."""
    cases = load(suite)
    for case in cases.by_identity.values():
        attempt(case, cases.folders)


def started(suite: str, results: Path, *, walls: bool) -> subprocess.Popen[bytes]:
    """Start a process that runs the cases of a suite, with walls or without."""
    program = [sys.executable, "-m", "latticebench", "run", suite, "--jobs", "1", "--yes", "--results", str(results)]
    command = program if walls else [sys.executable, __file__, "--without", suite]
    # Workers of a run have one thread each.
    alike = {**os.environ, **ONE_THREAD}
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=alike)


def finished(processes: Mapping[bool, subprocess.Popen[bytes]], begin: float) -> dict[bool, float]:
    """Return the seconds from a moment to the end of each process."""
    took: dict[bool, float] = {}
    while len(took) < len(processes):
        for walls, process in processes.items():
            if walls not in took and process.poll() is not None:
                took[walls] = time.perf_counter() - begin
                if process.returncode:
                    raise SystemExit(f"{'with' if walls else 'without'} walls: exit code {process.returncode}")
        time.sleep(0.02)
    return took


def in_turns(suite: str, results: Path, *, walls_first: bool) -> dict[bool, float]:
    """Return the seconds that the cases of a suite take with walls and without, one after the other."""
    took: dict[bool, float] = {}
    for walls in (walls_first, not walls_first):
        begin = time.perf_counter()
        took |= finished({walls: started(suite, results, walls=walls)}, begin)
    return took


def pairs(part: str, kept: Path, folder: Path) -> Iterator[tuple[str, int, dict[bool, float]]]:
    """Return what was run, of how many cases, and how long it took with walls and without."""
    if part == "default":
        begin = time.perf_counter()
        took = finished({walls: started("default", kept, walls=walls) for walls in (True, False)}, begin)
        yield part, len(load("default").by_identity), took
        return
    for name, cases in (("one case", 1), (part, TRIVIAL)):
        suite = folder / f"{cases}.toml"
        suite.write_text(SUITE.format(cases))
        for number in range(TIMES):
            results = folder / f"{cases}-{number}"
            yield name, cases, in_turns(str(suite), results, walls_first=number % 2 == 1)


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
    means = "\n".join(f"- {told(rows)}" for name, rows in table.groupby("suite") if name != "one case")
    page = "\n\n".join(["# What the walls around a case cost", text, means, markdown_table(shown), provenance])
    write_text(HERE / "walls.md", page)


if __name__ == "__main__":
    main()
