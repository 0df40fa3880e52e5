"""Measure what limits, leases and the store cost a run: the same cases with them and without, side by side.

    python results/scale/walls.py [SUITE ...]

runs the suite `default` and 10 000 trivial cases (`zero`, which fits nothing), and writes walls.csv and walls.md.

`with` is `latticebench run SUITE --jobs 1`; `without` is one process that runs the cases one after another, keeps
nothing and has no limits of time or memory. Both begin at the same moment, each on a core of its own, so that what else
the machine does slows both. Seconds are of the clock, from the start of the process to its end.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pandas as pd

from latticebench.bench.provenance import lines, origin
from latticebench.bench.publish import markdown_list, markdown_table, render
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


def side_by_side(suite: str, results: Path) -> tuple[float, float]:
    """Return the seconds that the cases of a suite take with walls and without."""
    program = [sys.executable, "-m", "latticebench", "run", suite, "--jobs", "1", "--yes", "--results", str(results)]
    begin = time.perf_counter()
    waiting = {
        name: subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for name, command in (("with", program), ("without", [sys.executable, __file__, "--without", suite]))
    }
    took: dict[str, float] = {}
    while waiting:
        for name, process in list(waiting.items()):
            if process.poll() is not None:
                took[name] = time.perf_counter() - begin
                if waiting.pop(name).returncode:
                    raise SystemExit(f"{suite}, {name} walls: exit code {process.returncode}")
        time.sleep(0.05)
    return took["with"], took["without"]


def measured(suites: list[str]) -> pd.DataFrame:
    """Return the table of all pairs; the results of the runs are kept in runs/walls."""
    rows, kept = [], Path("runs") / "walls"
    if kept.exists():
        raise SystemExit(f"{kept} is there: a run would go on from its results; move it away")
    with tempfile.TemporaryDirectory() as name:
        trivial = Path(name) / "trivial.toml"
        trivial.write_text(SUITE)
        for number, suite in enumerate(suites or ["default", *[str(trivial)] * TIMES], 1):
            walled, bare = side_by_side(suite, kept / f"{Path(suite).stem}-{number}")
            rows.append({
                "suite": Path(suite).stem, "cases": len(load(suite).by_identity), "with": round(walled, 1),
                "without": round(bare, 1), "slower": f"{100 * (walled / bare - 1):.1f} %",
            })  # fmt: skip
            print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def main() -> None:
    """Measure, and write the two files."""
    if sys.argv[1:2] == ["--without"]:
        without(sys.argv[2])
        return
    table = measured(sys.argv[1:])
    about = {"command": " ".join(["python results/scale/walls.py", *sys.argv[1:]]), **origin()}
    write_text(HERE / "walls.csv", render(table, about, "csv"))
    text = (__doc__ or "").split("walls.md.\n")[1].strip()
    provenance = "".join(f"{line}\n" for line in markdown_list(lines(about)))
    shown = table.rename(columns={"with": "seconds with", "without": "seconds without"}).astype(str)
    page = "\n\n".join(["# What the walls around a case cost", text, markdown_table(shown), provenance])
    write_text(HERE / "walls.md", page)


if __name__ == "__main__":
    main()
