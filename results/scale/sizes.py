"""Measure what a lattice's size costs: processor time, memory and error of simulation and fits, one process each.

    python results/scale/sizes.py [MOST [TASK ...]]

measures what sizes.csv lacks, up to MOST sites and of the tasks that are named, and writes sizes.csv, sizes.md and
sizes.png.

Samples are made once for each size: phi^4 (C = 2) in motion everywhere, 101 times in a span of 10, 1 % noise. Methods
fit the terms of lib2; the diagnosis begins with those of the equation. Time is the processor's, without the start of
Python. Memory is the peak of what the process itself allocates (RssAnon, read every 10 ms); files that are mapped,
which the system can drop, are not in it. It needs Linux. What is empty was not measured.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Collection
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd

from latticebench import methods, systems
from latticebench.bench.provenance import commit, machine
from latticebench.diagnosis.repair import diagnose
from latticebench.methods.method import make, solve
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.files import whole, write_text
from latticebench.systems.lattice import Initial
from latticebench.systems.readers import read
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import drift, observe, sample_times, simulate
from latticebench.systems.writers import write

HERE = Path(__file__).parent
SIZES = (100, 1000, 10_000, 100_000, 1_000_000)
# The largest of these sizes that each is asked for; what is refused or too long beyond is said in the page.
TASKS = {
    "simulate": 10**6, "least-squares": 10**6, "stlsq": 10**6, "sr3": 10**6, "weak": 10**5, "trajectory": 10**4,
    "diagnose": 100,
}  # fmt: skip
SYSTEM = replace(
    systems.find("phi4"),
    initials={"waves": Initial("cos(x)/2 + sin(sqrt(2)*x)/3", "cos(sqrt(3)*x)/2")},
)
# From here on sizes are large enough for the slope of time against size.
LARGE = 10_000


class Peak:
    """The largest memory that this process allocates in a block, in MiB."""

    def __enter__(self) -> Peak:
        self.mib, self._done = 0.0, threading.Event()
        self._watch = threading.Thread(target=self._look)
        self._watch.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._watch.join()

    def _look(self) -> None:
        while not self._done.wait(0.01):
            for line in Path("/proc/self/status").read_text().splitlines():
                if line.startswith("RssAnon"):
                    self.mib = max(self.mib, int(line.split()[1]) / 1024)


def error_of(task: str, samples: Samples) -> float:
    """Fit or diagnose the samples, and return the relative error of the coefficients."""
    library = SYSTEM.library("equation" if task == "diagnose" else "lib2")
    truth = SYSTEM.truth(library, {})
    assert truth is not None
    if task == "diagnose":
        coefficients = diagnose(library, SYSTEM.order, [samples], CATALOGUE).declared[1]
    else:
        coefficients = solve(make(methods.find(task), {}), [samples], library, SYSTEM.order, 1).coefficients
    return float(np.linalg.norm(coefficients - truth) / np.linalg.norm(truth))


def measure(task: str, sites: int, path: Path) -> dict[str, float | str]:
    """Do one task in this process and return what it took."""
    found: dict[str, float | str] = {}
    # What is loaded and compiled at the first call is no matter of size.
    small = observe(simulate(SYSTEM, sites=20, times=sample_times(20, 2.0)), np.random.default_rng(1), noise=0.01)
    if task != "simulate":
        data = replace(read(path)[0], ends=SYSTEM.ends)
        error_of(task, replace(small, ends=SYSTEM.ends))
    with Peak() as peak:
        begin = time.process_time()
        if task == "simulate":
            clean = simulate(SYSTEM, sites=sites, times=sample_times(101, 10.0), integrator="dop853")
            write([observe(clean, np.random.default_rng(1), noise=0.01).observed()], path)
        else:
            found["e2"] = error_of(task, data)
        seconds = time.process_time() - begin
    if task == "simulate":
        found["drift"] = drift(SYSTEM, {}, clean) or 0.0
    return {"task": task, "sites": sites, "cpu_seconds": round(seconds, 3), "mib": round(peak.mib, 1), **found}


def measured(most: int, tasks: Collection[str]) -> pd.DataFrame:
    """Return the table of all tasks, of which those that sizes.csv lacks are done now."""
    place = HERE / "sizes.csv"
    rows = pd.read_csv(place, comment="#").to_dict("records") if place.exists() else []
    with tempfile.TemporaryDirectory() as folder:
        for sites in (one for one in SIZES if one <= most):
            path = Path(folder) / "samples.npz"
            there = {row["task"] for row in rows if row["sites"] == sites}
            wanted = [task for task in TASKS if task in tasks and sites <= TASKS[task] and task not in there]
            if wanted and wanted[0] != "simulate":
                wanted = ["simulate", *wanted]
            for task in wanted:
                done = subprocess.run(
                    [sys.executable, __file__, "one", task, str(sites), str(path)],
                    capture_output=True, text=True, check=True,
                    env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
                         "LATTICEBENCH_LARGEST_FILE": "4096"},
                )  # fmt: skip
                row = json.loads(done.stdout)
                print(row, flush=True)
                rows = [one for one in rows if (one["task"], one["sites"]) != (task, sites)] + [row]
                table = pd.DataFrame(rows)
                table["task"] = pd.Categorical(table["task"], list(TASKS), ordered=True)
                table = table.sort_values(["task", "sites"])
                write_text(place, "".join(f"# {line}\n" for line in made()) + table.to_csv(index=False))
    return pd.read_csv(place, comment="#")


def made() -> list[str]:
    """Return the lines that say what made the table."""
    return [
        "command: python results/scale/sizes.py", f"commit: {commit()}", f"date: {date.today()}",
        f"machine: {machine()}",
    ]  # fmt: skip


def slope(table: pd.DataFrame, column: str) -> float:
    """Return the exponent of a column's growth with the sites, from LARGE on."""
    large = table[table["sites"] >= LARGE]
    return float(np.polyfit(np.log(large["sites"]), np.log(large[column]), 1)[0]) if len(large) > 1 else np.nan


def page(table: pd.DataFrame) -> str:
    """Return the text of sizes.md."""
    parts = ["# What a lattice's size costs\n", "Made by `python results/scale/sizes.py`.\n"]
    parts.append((__doc__ or "").split("\nsizes.png.\n")[1].strip() + "\n")
    parts.append("![Time and memory against size](sizes.png)\n")
    for column, title in (("cpu_seconds", "Processor seconds"), ("mib", "Memory (MiB)"), ("e2", "E2")):
        some = table.dropna(subset=[column])
        wide = some.pivot_table(index="sites", columns="task", values=column)
        wide = wide[[task for task in TASKS if task in wide]]
        wide.columns.name = None
        parts.append(f"## {title}\n\n{wide.to_markdown(floatfmt='.3g').replace('nan', '   ')}\n")
        if column != "e2":
            grows = {task: slope(some[some["task"] == task], column) for task in TASKS}
            listed = ", ".join(f"`{task}` {value:.2f}" for task, value in grows.items() if np.isfinite(value))
            parts.append(f"Exponent of the growth with the sites, from {LARGE} on: {listed}.\n")
    simulated = table[table["task"] == "simulate"]
    parts.append(f"What the lattice conserves, its energy, drifts by at most {simulated['drift'].max():.1e}.\n")
    return "\n".join(parts)


def figure(table: pd.DataFrame, path: Path) -> None:
    """Draw time and memory against size."""
    import matplotlib.pyplot as plt

    drawn, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for panel, column, label in zip(axes, ("cpu_seconds", "mib"), ("processor seconds", "memory (MiB)"), strict=True):
        for task, some in table.groupby("task", sort=False):
            panel.loglog(some["sites"], some[column], "o-", label=str(task))
        panel.set(xlabel="sites", ylabel=label)
    axes[0].legend(frameon=False, fontsize="small")
    with whole(path) as temporary:
        drawn.savefig(temporary, dpi=150)


if __name__ == "__main__":
    if sys.argv[1:2] == ["one"]:
        print(json.dumps(measure(sys.argv[2], int(sys.argv[3]), Path(sys.argv[4]))))
    else:
        sizes = measured(int(sys.argv[1]) if len(sys.argv) > 1 else max(SIZES), sys.argv[2:] or TASKS)
        write_text(HERE / "sizes.md", page(sizes) + "\n" + "".join(f"- {line}\n" for line in made()))
        figure(sizes, HERE / "sizes.png")
