"""Compare the time of one training step of this project's PINN and of DeepXDE's, on the same network, points and terms.

    python results/peers/deepxde_step.py [--rounds 5] [--out results/peers]

The problem is phi^4 with C = 2 and the library lib2: 31 sites, u and v as outputs (62), 3 x 40 tanh, 201 collocation
times, 50 samples of u and v, double precision, one thread, Adam. DeepXDE is measured in three ways:

- as its own examples of inverse problems are written: `dde.grad.jacobian` for each output, with one backward pass per
  output, and one `PointSetBC` per output, each of which adds the sample times once more;
- the same with all outputs in one `PointSetBC`;
- with its forward mode, which needs one pass for all outputs.

The processor time per step is the difference between a long and a short training over the difference of their numbers
of steps, so that set-up and the evaluation at the end cancel. The four programs are measured in turn, `--rounds` times,
and their medians are compared. The script needs `deepxde>=1.15,<1.16` (the extra `peers`) and writes step_time.csv and
step_time.md.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

# Both are read when the packages are imported.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["DDE_BACKEND"] = "pytorch"

import numpy as np
import pandas as pd

from latticebench import systems
from latticebench.bench.provenance import origin
from latticebench.bench.publish import render
from latticebench.methods.pinn import PINN
from latticebench.systems.files import write_text
from latticebench.systems.simulate import simulate

SYSTEM, LIBRARY, COLLOCATION = "phi4", "lib2", 201


def ours() -> Callable[[int], float]:
    """Return the function that trains this project's PINN for a number of steps and returns the processor seconds."""
    system = systems.find(SYSTEM)
    samples, library = simulate(system).observed(), system.library(LIBRARY)

    def train(steps: int) -> float:
        start = time.process_time()
        PINN(collocation=COLLOCATION, adam_steps=steps, lbfgs_steps=0).fit([samples], library, system.order, 0)
        return time.process_time() - start

    return train


def deepxde(mode: str, *, each: bool = False) -> Callable[[int], float]:
    """Return the function that trains DeepXDE's PINN for a number of steps and returns the processor seconds.

    Args:
        mode: "reverse", DeepXDE's default, or "forward".
        each: whether each output has a `PointSetBC` of its own, as in DeepXDE's examples of inverse problems; the
            sample times are then evaluated once per output (62 x 50 points beside the 201).
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

    def residuals(t: Any, y: Any) -> list[Any]:
        # In forward mode outputs and derivatives are pairs: the values, and the function that makes them.
        outputs = y[0] if mode == "forward" else y

        def rate(column: int) -> Any:
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
        start = time.process_time()
        model.train(iterations=steps, display_every=10**9, verbose=0)
        return time.process_time() - start

    return train


class Training(NamedTuple):
    """One way to train: its name, how it differentiates, and the steps of a short and a long training."""

    name: str
    derivatives: str
    train: Callable[[int], float]
    short: int
    long: int

    def step_time(self) -> float:
        """Return the milliseconds per step, from a short and a long training."""
        before = self.train(self.short)
        return 1e3 * (self.train(self.long) - before) / (self.long - self.short)


def measured(rounds: int) -> pd.DataFrame:
    """Measure the contestants in turn, and return the median, smallest and largest milliseconds per step of each."""
    contestants = [
        Training("latticebench pinn", "one forward tangent, one backward pass", ours(), 200, 2200),
        Training(
            "DeepXDE as its examples", "as below, and one PointSetBC per output", deepxde("reverse", each=True), 2, 6
        ),
        Training("DeepXDE", "reverse mode, its default: one backward pass per output", deepxde("reverse"), 2, 12),
        Training(
            "DeepXDE, forward mode",
            "set_default_autodiff('forward'): one pass for all outputs",
            deepxde("forward"),
            20,
            120,
        ),
    ]
    for one in contestants:
        one.train(one.short)
    times = np.zeros((rounds, len(contestants)))
    for number in range(rounds):
        for column, one in enumerate(contestants):
            times[number, column] = one.step_time()
            print(f"round {number + 1} of {rounds}: {one.name}: {times[number, column]:.3f} ms per step", flush=True)
    medians = np.median(times, axis=0)
    return pd.DataFrame({
        "program": [one.name for one in contestants],
        "derivatives": [one.derivatives for one in contestants],
        "milliseconds per step": [f"{value:.3f}" for value in medians],
        "fastest": [f"{value:.3f}" for value in times.min(axis=0)],
        "slowest": [f"{value:.3f}" for value in times.max(axis=0)],
        "ratio": [f"{value:.1f}" for value in medians / medians[0]],
    })  # fmt: skip


def main() -> None:
    """Measure and write the two files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="how often each is measured")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder for the two files")
    given = parser.parse_args()
    about = {
        "command": f"python results/peers/deepxde_step.py --rounds {given.rounds}",
        **origin(),
        "deepxde": version("deepxde"),
    }
    table = measured(given.rounds)
    title = (
        "# Time of one training step: pinn and DeepXDE\n\n"
        f"phi^4, C = 2, library {LIBRARY}, 31 sites, 62 outputs, 3 x 40 tanh, {COLLOCATION} collocation times, "
        "50 samples of u and v, float64, one thread, Adam. Medians over the rounds; the ratio is to the first row.\n\n"
    )
    write_text(given.out / "step_time.csv", render(table, about, "csv"))
    write_text(given.out / "step_time.md", title + render(table, about, "md"))
    print(table.to_string())


if __name__ == "__main__":
    main()
