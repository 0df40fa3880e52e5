"""Fit panel (1b) of the paper with DeepXDE and with this project's PINNs, and compare errors and run times.

    python results/peers/deepxde_fit.py [--seeds 5] [--limit 900] [--out results/peers]

The lattice is phi^4 with C = 2, library lib2, 31 sites, 50 noise-free samples of u and v. DeepXDE is given what `pinn`
has: the 3 x 40 tanh network with time scaled to [-1, 1] and weights drawn alike (the first layer wide), 201 collocation
times, the same loss with the same weights, coefficients in the same units and started at 0, Adam with the same schedule
and then L-BFGS with the same numbers of steps, double precision, one thread. It differentiates in its forward mode,
which is four times as fast as its default (deepxde_step.py). The observations are two point sets, u and v. One
difference is left: its L-BFGS is torch's, that of `pinn` is SciPy's.

Seconds are processor seconds, so that other load does not count; the time at which an error is reached is its share of
the wall-clock time of the fit. DeepXDE stops after its last step, or after `--limit` seconds. It may exceed the limit
somewhat, since it hands 1000 iterations of L-BFGS to torch at once and counts them as one step. The script needs
`deepxde>=1.15,<1.16` (the extra `peers`) and writes fit.csv and fit.md.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

# Both are read when the packages are imported.
os.environ["OMP_NUM_THREADS"] = "1"
os.environ["DDE_BACKEND"] = "pytorch"

import numpy as np
import pandas as pd

from latticebench import methods, systems
from latticebench.bench.provenance import origin
from latticebench.bench.publish import format_number, render
from latticebench.methods.engine.networks.members import member_draws
from latticebench.methods.engine.networks.network import initial_weights, layer_shapes, split_layers
from latticebench.methods.engine.networks.sizes import estimate_sizes
from latticebench.methods.method import make, solve
from latticebench.methods.pinn import PINN
from latticebench.systems.files import write_text
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import simulate

# A fit is good as soon as its E2 stays at or below this.
GOOD = 0.01
OURS = ("pinn", "pinn-gn", "pielm")
DEEPXDE = "DeepXDE, the network and loss of pinn"


@dataclass(frozen=True, eq=False)
class Problem:
    """The training problem of DeepXDE: its model, not yet compiled, and what compiling needs.

    Attributes:
        model: data and network.
        xi: the coefficients to be trained, in units of `units`.
        units: units of the coefficients (terms,).
        weights: of the parts of the loss.
    """

    model: Any
    xi: list[Any]
    units: np.ndarray
    weights: list[float]


def problem(samples: Samples, library: Library, settings: PINN, seed: int) -> Problem:
    """Set up the network and the loss of `pinn` in DeepXDE's forward mode, for the four terms of lib2."""
    import deepxde as dde
    import torch

    sites, size = samples.sites, estimate_sizes([samples], library, 2)
    units = settings.coefficient_scale * size.coefficients()
    xi = [dde.Variable(0.0) for _ in units]
    start, half = float(samples.t[0]), float(samples.t[-1] - samples.t[0]) / 2
    assert samples.v is not None

    def residuals(t: Any, y: Any) -> list[Any]:
        # In forward mode outputs and derivatives are pairs: the values, and the function that makes them.
        u, v = y[0][:, :sites], y[0][:, sites:]
        found = [dde.grad.jacobian(y, t, i=n)[0] - v[:, n : n + 1] for n in range(sites)]
        for n in range(1, sites - 1):
            here = u[:, n : n + 1]
            terms = (u[:, n + 1 : n + 2], u[:, n - 1 : n], here, here**3)
            law = sum(x * unit * term for x, unit, term in zip(xi, units, terms, strict=True))
            found.append(dde.grad.jacobian(y, t, i=sites + n)[0] - law)
        return found

    times = samples.t[:, None]
    seen = [
        dde.icbc.PointSetBC(times, samples.u, component=list(range(sites))),
        dde.icbc.PointSetBC(times, samples.v, component=list(range(sites, 2 * sites))),
    ]
    domain = dde.geometry.TimeDomain(samples.t[0], samples.t[-1])
    data = dde.data.PDE(domain, residuals, seen, num_domain=settings.collocation, train_distribution="uniform")
    network = dde.nn.FNN([1, *[settings.width] * settings.layers, 2 * sites], "tanh", "Glorot uniform")
    network.apply_feature_transform(lambda t: (t - start) / half - 1)
    shapes = layer_shapes(settings.layers, settings.width, 2 * sites)
    (draw,) = member_draws(seed, 1)
    drawn = split_layers(initial_weights(shapes, settings.frequency, draw), shapes)
    with torch.no_grad():
        for linear, layer in zip(network.linears, drawn, strict=True):
            linear.weight.copy_(torch.from_numpy(layer[:-1].T.copy()))
            linear.bias.copy_(torch.from_numpy(layer[-1].copy()))
    weights = [1 / (sites * size.velocity**2)] * sites + [1 / ((sites - 2) * size.rate**2)] * (sites - 2)
    weights += [settings.data_weight / size.field**2, settings.data_weight / size.velocity**2]
    return Problem(dde.Model(data, network), xi, units, weights)


def train(samples: Samples, library: Library, settings: PINN, seed: int, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Train DeepXDE's network for at most `limit` seconds.

    Returns:
        Processor seconds (K,) and coefficients (K, terms) after each step.
    """
    import deepxde as dde
    import torch

    torch.set_num_threads(1)
    dde.config.set_random_seed(seed)
    dde.config.set_default_float("float64")
    dde.config.set_default_autodiff("forward")
    given = problem(samples, library, settings, seed)
    begin = time.process_time()
    seconds, found = [0.0], [np.zeros(len(given.units))]

    class Record(dde.callbacks.Callback):  # type: ignore[misc]
        """Record the coefficients after each step, and stop at the limit."""

        def on_batch_end(self) -> None:
            seconds.append(time.process_time() - begin)
            found.append(np.array([x.item() for x in given.xi]) * given.units)
            if seconds[-1] > limit:
                self.model.stop_training = True

    model = given.model
    common = {"external_trainable_variables": given.xi, "loss_weights": given.weights, "verbose": 0}
    model.compile("adam", lr=settings.learning_rate, decay=("cosine", settings.adam_steps, 0.0), **common)
    model.train(iterations=settings.adam_steps, display_every=10**9, verbose=0, callbacks=[Record()])
    if seconds[-1] < limit:
        steps = settings.lbfgs_steps
        dde.optimizers.set_LBFGS_options(maxcor=settings.memory, maxiter=steps, maxfun=steps, ftol=0.0, gtol=0.0)
        model.compile("L-BFGS", **common)
        model.train(display_every=10**9, verbose=0, callbacks=[Record()])
    return np.array(seconds), np.array(found)


def first_good(seconds: np.ndarray, errors: np.ndarray) -> float:
    """Return the time from which on the error stays at or below GOOD; infinite if it never does."""
    bad = np.flatnonzero(errors > GOOD)
    last = bad[-1] + 1 if len(bad) else 0
    return float(seconds[last]) if last < len(errors) else float("inf")


def spread(values: pd.Series) -> str:
    """Return the median with the least and the largest; `never` for what is infinite."""
    middle, low, high = (
        format_number(value) if np.isfinite(value) else "never"
        for value in (values.median(), values.min(), values.max())
    )
    return f"{middle} [{low}, {high}]"


def measured(seeds: int, limit: float) -> pd.DataFrame:
    """Fit with each program and seed: one row each."""
    system = systems.find("phi4")
    samples, library = simulate(system).observed(), system.library("lib2")
    truth = system.truth(library, {})
    assert truth is not None

    def errors(found: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(found - truth, axis=-1) / np.linalg.norm(truth))

    rows = []
    for seed in range(1, seeds + 1):
        for name in OURS:
            method, begin = make(methods.find(name), {}), time.process_time()
            fit = solve(method, [samples], library, 2, seed)
            seconds = time.process_time() - begin
            assert fit.history is not None
            good = min(first_good(fit.history.seconds, errors(fit.history.coefficients)), fit.seconds) / fit.seconds
            rows.append((f"latticebench {name}", seed, seconds, float(errors(fit.coefficients)), good * seconds))
            print(rows[-1], flush=True)
        times, found = train(samples, library, PINN(), seed, limit)
        off = errors(found)
        rows.append((DEEPXDE, seed, float(times[-1]), float(off[-1]), first_good(times, off)))
        print(rows[-1], flush=True)
    return pd.DataFrame(rows, columns=["program", "seed", "seconds", "E2", f"seconds to E2 <= {GOOD:g}"])


def main() -> None:
    """Run the programs and write the two files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5, help="fits per program")
    parser.add_argument("--limit", type=float, default=900.0, help="processor seconds after which DeepXDE is stopped")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder for the two files")
    given = parser.parse_args()
    made = origin()
    table = measured(given.seeds, given.limit)
    short = table.drop(columns="seed").groupby("program", sort=False).agg(spread)
    about = {
        "command": f"python results/peers/deepxde_fit.py --seeds {given.seeds} --limit {given.limit:g}",
        "seeds": ", ".join(str(seed) for seed in range(1, given.seeds + 1)),
        "entries": "median [least, largest] over the seeds, processor seconds; never: E2 does not stay below "
        f"{GOOD:g} within {given.limit:g} s",
        **made,
        "deepxde": version("deepxde"),
    }
    write_text(given.out / "fit.csv", render(table, about, "csv"))
    write_text(given.out / "fit.md", render(short.reset_index(), about, "md"))
    print(short.to_string())


if __name__ == "__main__":
    main()
