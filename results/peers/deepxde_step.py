"""Measure one training step of this project's PINN and of DeepXDE's, on the same network, points and terms, in one run.

The problem is phi^4 with C = 2 and the library lib2: 31 sites, u and v out (62 outputs), 3 x 40 tanh, 201 collocation times,
50 samples of u and v, double precision, one thread, Adam. DeepXDE is measured in three ways: as its own examples of inverse
problems are written (`dde.grad.jacobian` for each output, which takes one backward pass each, and one `PointSetBC` for each
output, which takes the sample times in once each); with all outputs in one `PointSetBC`; and with its forward mode switched on,
which takes one pass for all.

A step's time is the difference between a long and a short training over the difference of their steps, so that set-up and
the evaluation at the end drop out. The four are measured in turn, `--rounds` times; the median counts.

    python results/peers/deepxde_step.py [--rounds 5] [--out results/peers]

It needs `deepxde>=1.15,<1.16` (the extra `peers`) and writes step_time.csv and step_time.md.
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Both are read when the packages are imported.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["DDE_BACKEND"] = "pytorch"

import numpy as np

from latticebench import systems
from latticebench.methods.pinn import PINN
from latticebench.systems.simulate import simulate

if TYPE_CHECKING:
    import torch

SYSTEM, LIBRARY, COLLOCATION = "phi4", "lib2", 201


def ours() -> Callable[[int], float]:
    """Make the function that trains this project's PINN for so many steps and gives the seconds."""
    system = systems.find(SYSTEM)
    samples, library = simulate(system).observed(), system.library(LIBRARY)

    def train(steps: int) -> float:
        start = time.perf_counter()
        PINN(collocation=COLLOCATION, adam_steps=steps, lbfgs_steps=0).fit([samples], library, system.order, 0)
        return time.perf_counter() - start

    return train


def deepxde(mode: str, *, each: bool = False) -> Callable[[int], float]:
    """Make the function that trains DeepXDE's PINN for so many steps and gives the seconds.

    Args:
        mode: "reverse", DeepXDE's default, or "forward".
        each: give each output its observations apart, as DeepXDE's own examples of inverse problems do; it then takes the
            sample times in once an output (62 x 50 points beside the 201).
    """
    import deepxde as dde
    import torch

    torch.set_num_threads(1)
    dde.config.set_default_float("float64")
    dde.config.set_default_autodiff(mode)
    samples = simulate(systems.find(SYSTEM)).observed()
    sites = samples.sites
    assert samples.v is not None
    xi = [dde.Variable(0.0) for _ in range(4)]

    def residuals(t: torch.Tensor, y: Any) -> list[torch.Tensor]:
        # In forward mode DeepXDE gives outputs and derivatives each together with the function that makes them.
        outputs = y[0] if mode == "forward" else y

        def rate(column: int) -> torch.Tensor:
            found = dde.grad.jacobian(y, t, i=column)
            return found[0] if mode == "forward" else found

        u, v = outputs[:, :sites], outputs[:, sites:]
        found = [rate(n) - v[:, n : n + 1] for n in range(sites)]
        for n in range(1, sites - 1):
            here = u[:, n : n + 1]
            law = xi[0] * u[:, n + 1 : n + 2] + xi[1] * u[:, n - 1 : n] + xi[2] * here + xi[3] * here**3
            found.append(rate(sites + n) - law)
        return found

    times, columns = samples.t[:, None], np.concatenate([samples.u, samples.v], axis=1)
    if each:
        data = [dde.icbc.PointSetBC(times, columns[:, k : k + 1], component=k) for k in range(2 * sites)]
    else:
        data = [dde.icbc.PointSetBC(times, columns, component=list(range(2 * sites)))]
    domain = dde.geometry.TimeDomain(samples.t[0], samples.t[-1])
    problem = dde.data.PDE(domain, residuals, data, num_domain=COLLOCATION, train_distribution="uniform")
    network = dde.nn.FNN([1, 40, 40, 40, 2 * sites], "tanh", "Glorot uniform")
    model = dde.Model(problem, network)
    model.compile("adam", lr=1e-3, external_trainable_variables=xi, verbose=0)

    def train(steps: int) -> float:
        dde.config.set_default_autodiff(mode)
        start = time.perf_counter()
        model.train(iterations=steps, display_every=10**9, verbose=0)
        return time.perf_counter() - start

    return train


def step_time(train: Callable[[int], float], short: int, long: int) -> float:
    """Seconds a step, from a short and a long training."""
    before = train(short)
    return (train(long) - before) / (long - short)


def machine() -> str:
    """Name the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"


def main() -> None:
    """Measure and write the two files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="how often each is measured")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder of the two files")
    given = parser.parse_args()
    contestants = [
        ("latticebench pinn", "one forward tangent, one backward pass", ours(), 200, 2200),
        ("DeepXDE as its examples", "as below, and one PointSetBC an output", deepxde("reverse", each=True), 2, 6),
        ("DeepXDE", "reverse mode, its default: one backward pass an output", deepxde("reverse"), 2, 12),
        ("DeepXDE, forward mode", "set_default_autodiff('forward'): one pass for all outputs", deepxde("forward"), 20, 120),
    ]  # fmt: skip
    times: dict[str, list[float]] = {name: [] for name, *_ in contestants}
    for _, _, train, short, _ in contestants:
        train(short)
    for number in range(given.rounds):
        for name, _, train, short, long in contestants:
            times[name].append(1e3 * step_time(train, short, long))
            print(f"round {number + 1} of {given.rounds}: {name}: {times[name][-1]:.3f} ms a step", flush=True)
    base = statistics.median(times["latticebench pinn"])
    rows = [
        {
            "program": name, "derivatives": how, "milliseconds_per_step": f"{statistics.median(times[name]):.3f}",
            "fastest": f"{min(times[name]):.3f}", "slowest": f"{max(times[name]):.3f}",
            "ratio": f"{statistics.median(times[name]) / base:.1f}",
        }
        for name, how, *_ in contestants
    ]  # fmt: skip
    given.out.mkdir(parents=True, exist_ok=True)
    with (given.out / "step_time.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    folder = Path(__file__).resolve().parent
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=folder, capture_output=True, text=True, check=False)
    versions = ", ".join(f"{name} {version(name)}" for name in ("deepxde", "torch", "numpy", "scipy", "sympy"))
    table = ["| " + " | ".join(rows[0]) + " |", "| " + " | ".join("---" for _ in rows[0]) + " |"]
    table += ["| " + " | ".join(row.values()) + " |" for row in rows]
    text = "\n".join([
        "# One training step: this PINN and DeepXDE's", "",
        f"phi^4, C = 2, library {LIBRARY}, 31 sites, 62 outputs, 3 x 40 tanh, {COLLOCATION} collocation times, 50 samples of u and v, "
        "float64, one thread, Adam. Median of the rounds; ratio to the first row.", "",
        *table, "",
        f"- command: `python results/peers/deepxde_step.py --rounds {given.rounds}`",
        f"- commit: {commit.stdout.strip() or 'unknown'}",
        f"- machine: {machine()}",
        f"- versions: {versions}",
        f"- date: {datetime.now(timezone.utc):%Y-%m-%d}",
        "",
    ])  # fmt: skip
    (given.out / "step_time.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    sys.exit(main())
