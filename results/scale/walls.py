"""Measure what limits, leases and the store cost a run: the same cases with them and without.

    python results/scale/walls.py [default] [trivial]

runs the suite `default` and 10 000 trivial cases (`zero`, which fits nothing), or one of both, and writes walls.csv and
walls.md; rows of the other are kept.

`with` is `latticebench run SUITE --jobs 1`; `without` is one process that runs the cases one after another, keeps
nothing and has no limits of time or memory. In the suite `default` both begin at the same moment, each on a core of its
own, so that what else the machine does slows both. Trivial cases are run with and without in turns, since the process
that keeps their results needs a part of another core. Seconds are of the clock, from the start of the process to its
end.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from latticebench.bench.provenance import commit, lines, origin
from latticebench.bench.publish import markdown_list, markdown_table, render
from latticebench.bench.published import read_table
from latticebench.bench.suite import load
from latticebench.bench.worker import attempt
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
# Trivial cases, and how often they are run.
TRIVIAL, TIMES = 10_000, 3
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
    """Run all cases of a suite in this process."""
    cases = load(suite)
    for case in cases.by_identity.values():
        attempt(case, cases.folders)


def started(suite: str, results: Path, *, walls: bool) -> subprocess.Popen[bytes]:
    """Start a process that runs the cases of a suite, with walls or without."""
    program = [sys.executable, "-m", "latticebench", "run", suite, "--jobs", "1", "--yes", "--results", str(results)]
    command = program if walls else [sys.executable, __file__, "--without", suite]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


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


def measured(part: str, kept: Path) -> list[dict[str, object]]:
    """Return the rows of a part; results of `default` are kept."""
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as name:
        suite = "default" if part == "default" else str(Path(name) / "trivial.toml")
        if part == "trivial":
            Path(suite).write_text(SUITE)
        cases = len(load(suite).by_identity)
        for number in range(1 if part == "default" else TIMES):
            begin = time.perf_counter()
            if part == "default":
                took = finished({walls: started(suite, kept, walls=walls) for walls in (True, False)}, begin)
            else:
                took = finished({False: started(suite, kept, walls=False)}, begin)
                begin = time.perf_counter()
                took |= finished({True: started(suite, Path(name) / str(number), walls=True)}, begin)
            rows.append({
                "suite": part, "cases": cases, "with": round(took[True], 1), "without": round(took[False], 1),
                "slower": f"{100 * (took[True] / took[False] - 1):.1f} %", "commit": commit(),
            })  # fmt: skip
            print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Measure, and write the two files."""
    if sys.argv[1:2] == ["--without"]:
        without(sys.argv[2])
        return
    parts, kept = sys.argv[1:] or ["default", "trivial"], Path("runs") / "walls"
    if "default" in parts and kept.exists():
        raise SystemExit(f"{kept} is there: a run would go on from its results; move it away")
    rows = [row for part in parts for row in measured(part, kept)]
    table = pd.DataFrame(rows)
    if (HERE / "walls.csv").exists():
        before = read_table(HERE / "walls.csv")
        table = pd.concat([before[~before["suite"].isin(parts)], table], ignore_index=True).sort_values("suite")
    about = {"command": " ".join(["python results/scale/walls.py", *sys.argv[1:]]), **origin()}
    write_text(HERE / "walls.csv", render(table, about, "csv"))
    text = (__doc__ or "").split("are kept.\n")[1].strip()
    provenance = "".join(f"{line}\n" for line in markdown_list(lines(about)))
    shown = table.rename(columns={"with": "seconds with", "without": "seconds without"}).astype(str)
    page = "\n\n".join(["# What the walls around a case cost", text, markdown_table(shown), provenance])
    write_text(HERE / "walls.md", page)


if __name__ == "__main__":
    main()
