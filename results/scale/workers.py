"""Measure what running cases costs beyond the cases themselves, by executor and number of workers.

    python results/scale/workers.py [SHARE]

runs a share of 20 000 quick fits (`stlsq`), 500 longer ones (`trajectory`) and 100 000 trivial cases (`zero`, which
fits nothing), and writes workers.csv and workers.md.

A case is phi^4 with 9 sites, lib2 and 1 % noise, each with a seed of its own. `alone` is one process that runs a tenth
of the cases, at least 50, one after another, keeps nothing and has no limits of time or memory. Seconds are of the
clock, start included. What a case costs besides is the time times the workers, for each case, less what it takes alone.
Efficiency is the time with one worker over twice that with two.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from latticebench.bench.executors.batches import LONGEST, SHARE
from latticebench.bench.provenance import lines, origin
from latticebench.bench.publish import markdown_list, markdown_table, render
from latticebench.bench.store import create
from latticebench.bench.suite import load
from latticebench.bench.worker import attempt
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
# Cases of a whole measurement.
COUNTS = {"stlsq": 20_000, "trajectory": 500, "zero": 100_000}
EXECUTORS = {
    "local, 1 worker": ["--jobs", "1"],
    "local, 2 workers": ["--jobs", "2"],
    "dask, 1 worker": ["--executor", "dask", "--cluster", "local:1"],
    "dask, 2 workers": ["--executor", "dask", "--cluster", "local:2"],
}
# Seeds that a grid may have.
MOST_SEEDS = 10_000
# How many empty tasks and results the rates are measured with.
MESSAGES = 2000


def suite(folder: Path, method: str, count: int) -> Path:
    """Write a suite of so many cases of a method on phi^4 with 9 sites, a seed each."""
    path = folder / f"{method}-{count}.toml"
    grids = (
        f'[[grid]]\nsystem = "phi4"\nlibraries = ["lib2"]\nsites = [9]\nnoise = [0.01]\n'
        f'seeds = "{first}-{min(first + MOST_SEEDS - 1, count)}"\n'
        for first in range(1, count + 1, MOST_SEEDS)
    )
    path.write_text("\n".join(['title = "many cases"\n', f'[methods.{method}]\nmethod = "{method}"\n', *grids]))
    return path


def alone(path: Path) -> float:
    """Return the seconds that each case takes in this process; the first, which loads what it needs, is not counted."""
    cases = load(str(path))
    first, *others = cases.by_identity.values()
    attempt(first, cases.folders)
    begin = time.perf_counter()
    for case in others:
        assert attempt(case, cases.folders)["status"] == "ok"
    return (time.perf_counter() - begin) / len(others)


def run(path: Path, results: Path, options: list[str]) -> float:
    """Return the seconds that `latticebench run` takes."""
    begin = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "latticebench", "run", str(path), "--results", str(results), "--yes", *options],
        check=True, capture_output=True,
    )  # fmt: skip
    return time.perf_counter() - begin


def tasks_a_second() -> float:
    """Return how many empty tasks a scheduler, its client and one worker on this machine get done."""
    from distributed import Client, LocalCluster

    async def measure() -> float:
        cluster = LocalCluster(n_workers=1, threads_per_worker=1, asynchronous=True, dashboard_address="")
        async with cluster, Client(cluster, asynchronous=True) as client:
            await client.submit(abs, -1)
            begin = time.perf_counter()
            await client.gather(client.map(abs, range(-MESSAGES, 0), pure=False))
            return MESSAGES / (time.perf_counter() - begin)

    return asyncio.run(measure())


def kept_a_second() -> float:
    """Return how many results a client keeps, a hundred at once."""
    with tempfile.TemporaryDirectory() as name:
        cases = load(str(suite(Path(name), "zero", MESSAGES)))
        store, about = create(Path(name) / "store"), origin()
        keys = {identity: f"{number:064x}" for number, identity in enumerate(cases.by_identity)}
        store.plan(keys, {})
        result = attempt(next(iter(cases.by_identity.values())), cases.folders)
        begin = time.perf_counter()
        for first in range(0, MESSAGES, 100):
            with store.writing():
                for identity, case in list(cases.by_identity.items())[first : first + 100]:
                    store.put(keys[identity], case, result, about)
        return MESSAGES / (time.perf_counter() - begin)


def measured(share: float) -> pd.DataFrame:
    """Return the table of all methods and executors."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for method, whole in COUNTS.items():
            count = max(1, round(share * whole))
            path = suite(folder, method, count)
            each = alone(suite(folder, method, max(50, count // 10)))
            for label, options in EXECUTORS.items():
                workers = int(label.split()[1])
                seconds = run(path, folder / f"{method} {label}", options)
                rows.append({
                    "method": method, "cases": count, "executor": label, "seconds": round(seconds, 2),
                    "alone_ms": round(1e3 * each, 3), "overhead_ms": round(1e3 * (seconds * workers / count - each), 3),
                })  # fmt: skip
                print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def page(table: pd.DataFrame, rates: Mapping[str, float]) -> str:
    """Return the text of workers.md, without its provenance."""
    kind = table["executor"].str.split(",").str[0]
    by_one = table.groupby(["method", kind], sort=False)["seconds"].transform("first")
    efficiency = (100 * by_one / (2 * table["seconds"])).where(table["executor"].str.endswith("2 workers"))
    shown = table.assign(efficiency=[f"{value:.0f} %" if value == value else "" for value in efficiency])
    shown = shown.rename(columns={"alone_ms": "ms a case alone", "overhead_ms": "ms a case besides"})
    tasks, kept = rates["tasks"], rates["results"]
    saturated = pd.DataFrame([
        {
            "a case takes": text, "the scheduler, one case a task": f"{tasks * seconds:,.0f}",
            f"the scheduler, tasks of {LONGEST:g} s": f"{tasks * max(LONGEST, seconds):,.0f}",
            "the client's store": f"{kept * seconds:,.0f}",
        }
        for text, seconds in (("1 ms", 1e-3), ("100 ms", 0.1), ("10 s", 10.0))
    ])  # fmt: skip
    return "\n\n".join([
        "# What running cases costs beyond the cases themselves", (__doc__ or "").split("workers.md.\n")[1].strip(),
        markdown_table(shown.astype(str)),
        "## How many workers a scheduler can keep busy, on paper",
        f"A scheduler, its client and one worker, all on this machine, got {tasks:.0f} empty tasks a second done. The "
        f"client's store kept {kept:.0f} results a second. A batch of cases is one task; it grows until messages take "
        f"{SHARE:.0%} of a worker's time, at most to {LONGEST:g} s. By these figures each keeps so many workers busy:",
        markdown_table(saturated),
    ])  # fmt: skip


def main() -> None:
    """Measure, and write the two files."""
    share = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    costs, rates = measured(share), {"tasks": tasks_a_second(), "results": kept_a_second()}
    command = " ".join(["python results/scale/workers.py", *sys.argv[1:]])
    counts = {f"{name} a second": f"{rate:.0f}" for name, rate in rates.items()}
    about = {"command": command, **origin(), **counts, "seeds": "from 1 on, one a case"}
    write_text(HERE / "workers.csv", render(costs, about, "csv"))
    provenance = "".join(f"{line}\n" for line in markdown_list(lines(about)))
    write_text(HERE / "workers.md", f"{page(costs, rates)}\n\n{provenance}")


if __name__ == "__main__":
    main()
