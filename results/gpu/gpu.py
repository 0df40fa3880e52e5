"""Train the networks on a GPU and on the processor of the same machine: gpu.csv, gpu.md.

    python results/gpu/gpu.py [cuda]

`pinn-gn`, `pielm` and `pinn` with one network, with 8 and with 64 members, on the four lattices of the paper with 1 %
noise. The argument is the name of the device in torch. The fits of the processor are made one thread each and at the
same time as those of the device, which has a thread of its own; a machine of 14 cores or more has one for each.

A processor takes its members one after the other, so that a fit is left out that would end more than LATEST seconds
after the start by the time that fewer members took. The device begins none after that.
"""

from __future__ import annotations

import itertools
import multiprocessing
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from latticebench import methods
from latticebench.bench.case import Folders
from latticebench.bench.fitting import FitCase, samples
from latticebench.bench.provenance import origin
from latticebench.bench.publish import markdown_table, render
from latticebench.bench.published import read_head
from latticebench.methods.engine.networks.arrays import one_thread
from latticebench.methods.method import make, solve
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
CASES = (
    ("phi4", {"C": 2.0, "v": 0.5}, "lib2"),
    ("sine-gordon", {"C": 0.5, "v": 0.5}, "lib2"),
    ("dnls", {"C": 0.5}, "four"),
    ("ginzburg-landau", {"C": 0.5}, "four"),
)
METHODS = ("pinn-gn", "pielm", "pinn")
MEMBERS = (1, 8, 64)
NOISE, SEED = 0.01, 1
LATEST = 420.0
COLUMNS = ["system", "method", "members", "device", "seconds", "e2", "spread", "status"]


def fitted(number: int, method: str, members: int, device: str) -> list[Any]:
    """Fit one case; return its row.

    `spread` is the median over the terms of the standard deviation of the members' coefficients, over the norm of the
    true ones.
    """
    system, parameters, library = CASES[number]
    case = FitCase(
        system=system, parameters=parameters, library=library, noise=NOISE, seed=SEED, known_ends=True, label=method,
        method=method,
    )  # fmt: skip
    place, candidates = case.resolve(Folders().suite)
    truth = place.truth(candidates, parameters)
    assert truth is not None
    # A single network of `pinn-gn` has no members beside it.
    settings = {"device": device, "members": 0 if (method, members) == ("pinn-gn", 1) else members}
    data = [one.observed() for one in samples(case, Path())]
    began = time.perf_counter()
    with one_thread():
        fit = solve(make(methods.find(method), settings), data, candidates, place.order, SEED)
    seconds, size = time.perf_counter() - began, np.linalg.norm(truth)
    spreads = [float(value) for name, value in fit.found.items() if name.startswith("spread of ")]
    off = float(np.linalg.norm(fit.coefficients - truth) / size)
    spread = float(np.median(spreads) / size) if spreads else np.nan
    return [system, method, members, device, seconds, off, spread, fit.status]


def on_processor(number: int, method: str, began: float) -> list[list[Any]]:
    """Fit one lattice with one method on the processor."""
    rows: list[list[Any]] = []
    for members in MEMBERS:
        expected = rows[-1][4] * members / rows[-1][2] if rows else 0.0
        if time.time() - began + expected > LATEST:
            told = f"left out, about {expected:.0f} s"
            rows.append([CASES[number][0], method, members, "cpu", np.nan, np.nan, np.nan, told])
            break
        rows.append(fitted(number, method, members, "cpu"))
    return rows


def on_device(device: str, began: float) -> Iterator[list[Any]]:
    """Fit everything on the device until LATEST; what it does at its first use is not counted."""
    fitted(1, "pinn-gn", 8, device)
    for method, members, number in itertools.product(METHODS, MEMBERS, range(len(CASES))):
        if time.time() - began > LATEST:
            row = [CASES[number][0], method, members, device, np.nan, np.nan, np.nan, "left out"]
        else:
            row = fitted(number, method, members, device)
        print(f"{time.strftime('%H:%M:%S')} {row}", flush=True)
        yield row


def main() -> None:
    """Fit, and write the two files."""
    device = sys.argv[1] if len(sys.argv) > 1 else "cuda"
    began = time.time()
    places = list(itertools.product(range(len(CASES)), METHODS))
    with ProcessPoolExecutor(len(places), multiprocessing.get_context("spawn")) as pool:
        beside = [pool.submit(on_processor, number, method, began) for number, method in places]
        rows = list(on_device(device, began))
        rows += [row for some in beside for row in some.result()]
    about = {"command": f"python results/gpu/gpu.py {device}", "device": name(device), **origin(["torch"])}
    write_text(HERE / "gpu.csv", render(pd.DataFrame(rows, columns=COLUMNS), about, "csv"))
    write_text(HERE / "gpu.md", page())


def name(device: str) -> str:
    """Return what torch calls the device."""
    import torch

    return torch.cuda.get_device_name(device) if device.startswith("cuda") else device


def beside(table: pd.DataFrame) -> pd.DataFrame:
    """Put the processor's seconds and errors beside the device's, a row for each kind of fit."""
    rows = []
    device = next(one for one in table["device"] if one != "cpu")
    for (system, method, members), group in table.groupby(["system", "method", "members"], sort=False):
        row: dict[str, Any] = {"lattice": system, "method": method, "members": members}
        for where in ("cpu", device):
            found = group[group["device"] == where]
            known = len(found) > 0 and np.isfinite(found["seconds"].iloc[0])
            row[f"{where} s"] = found["seconds"].iloc[0] if known else "left out"
            row[f"{where} e2"] = found["e2"].iloc[0] if known else ""
        both = group.set_index("device")["seconds"]
        row["times as fast"] = both.get("cpu", np.nan) / both.get(device, np.nan)
        rows.append(row)
    return pd.DataFrame(rows)


def page() -> str:
    """Return the text of gpu.md, made from gpu.csv beside this file."""
    table = pd.read_csv(HERE / "gpu.csv", comment="#")
    about = "".join(f"- {key}: {told}\n" for key, told in read_head(HERE / "gpu.csv").items())
    return (
        "# The networks on a GPU\n\n"
        "Made by `python results/gpu/gpu.py`, which says what is fitted. Seconds of a whole fit, and the relative "
        "error E2 of its coefficients: on the processor, one thread, members one after the other, and on the device, "
        f"members together. 1 % noise, seed {SEED}.\n\n"
        f"{markdown_table(beside(table))}\n\n{about}"
    )


if __name__ == "__main__":
    main()
