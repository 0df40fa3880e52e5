"""Fit panel (1b) of the paper with DeepXDE and with this project's PINNs, and compare errors and run times.

    python results/peers/deepxde_fit.py [--limit 900] [--out results/peers]

The lattice is phi^4 with C = 2, library lib2, 31 sites, 50 noise-free samples of u and v. DeepXDE is given what `pinn`
has: the 3 x 40 tanh network with time scaled to [-1, 1], 201 collocation times, the same loss with the same weights,
coefficients in the same units and started at 0, Adam and then L-BFGS with the same numbers of steps, double precision,
one thread. The differences are Glorot weights in the first layer, a constant learning rate, and torch's L-BFGS. The
observations are two point sets, u and v.

DeepXDE stops after its last step, or after `--limit` seconds. It may exceed the limit somewhat, since it hands 1000
iterations of L-BFGS to torch at once and counts them as one step. The script needs `deepxde>=1.15,<1.16` (the extra
`peers`) and writes fit.csv and fit.md.
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
from latticebench.bench.publish import render
from latticebench.methods.engine.networks.sizes import estimate_sizes
from latticebench.methods.method import make, solve
from latticebench.methods.pinn import PINN
from latticebench.systems.files import write_text
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import simulate

SEED = 1
# A fit is good as soon as its E2 stays at or below this.
GOOD = 0.01


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


def problem(samples: Samples, library: Library, settings: PINN) -> Problem:
    """Set up the network and the loss of `pinn` in DeepXDE, for the four terms of lib2."""
    import deepxde as dde

    sites, size = samples.sites, estimate_sizes([samples], library, 2)
    units = settings.coefficient_scale * size.coefficients()
    xi = [dde.Variable(0.0) for _ in units]
    start, half = float(samples.t[0]), float(samples.t[-1] - samples.t[0]) / 2
    assert samples.v is not None

    def residuals(t: Any, y: Any) -> list[Any]:
        u, v = y[:, :sites], y[:, sites:]
        found = [dde.grad.jacobian(y, t, i=n) - v[:, n : n + 1] for n in range(sites)]
        for n in range(1, sites - 1):
            here = u[:, n : n + 1]
            terms = (u[:, n + 1 : n + 2], u[:, n - 1 : n], here, here**3)
            law = sum(x * unit * term for x, unit, term in zip(xi, units, terms, strict=True))
            found.append(dde.grad.jacobian(y, t, i=sites + n) - law)
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
    weights = [1 / (sites * size.velocity**2)] * sites + [1 / ((sites - 2) * size.rate**2)] * (sites - 2)
    weights += [settings.data_weight / size.field**2, settings.data_weight / size.velocity**2]
    return Problem(dde.Model(data, network), xi, units, weights)


def train(samples: Samples, library: Library, settings: PINN, limit: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Train DeepXDE's network for at most `limit` seconds.

    Returns:
        Seconds (K,) and coefficients (K, terms) after each step, and the mean seconds per step of Adam.
    """
    import deepxde as dde
    import torch

    torch.set_num_threads(1)
    torch.manual_seed(SEED)
    dde.config.set_random_seed(SEED)
    dde.config.set_default_float("float64")
    given = problem(samples, library, settings)
    begin = time.perf_counter()
    seconds, found = [0.0], [np.zeros(len(given.units))]

    class Record(dde.callbacks.Callback):  # type: ignore[misc]
        """Record the coefficients after each step, and stop at the limit."""

        def on_batch_end(self) -> None:
            seconds.append(time.perf_counter() - begin)
            found.append(np.array([x.item() for x in given.xi]) * given.units)
            if seconds[-1] > limit:
                self.model.stop_training = True

    model = given.model
    common = {"external_trainable_variables": given.xi, "loss_weights": given.weights, "verbose": 0}
    model.compile("adam", lr=settings.learning_rate, **common)
    model.train(iterations=settings.adam_steps, display_every=10**9, verbose=0, callbacks=[Record()])
    step = seconds[-1] / max(1, len(seconds) - 1)
    if seconds[-1] < limit:
        steps = settings.lbfgs_steps
        dde.optimizers.set_LBFGS_options(maxcor=settings.memory, maxiter=steps, maxfun=steps, ftol=0.0, gtol=0.0)
        model.compile("L-BFGS", **common)
        model.train(display_every=10**9, verbose=0, callbacks=[Record()])
    return np.array(seconds), np.array(found), step


def first_good(seconds: np.ndarray, errors: np.ndarray) -> float:
    """Return the time from which on the error stays at or below GOOD; NaN if it never does."""
    bad = np.flatnonzero(errors > GOOD)
    last = bad[-1] + 1 if len(bad) else 0
    return float(seconds[last]) if last < len(errors) else float("nan")


def row(program: str, steps: int, seconds: float, error: float, good: float) -> dict[str, Any]:
    """Print and return one row of the table."""
    made = {"program": program, "steps": steps, "seconds": seconds, "E2": error, f"seconds to E2 <= {GOOD:g}": good}
    print(made, flush=True)
    return made


def main() -> None:
    """Run the three programs and write the two files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--limit", type=float, default=900.0, help="seconds after which DeepXDE is stopped")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent, help="folder for the two files")
    given = parser.parse_args()
    system = systems.find("phi4")
    samples, library = simulate(system).observed(), system.library("lib2")
    truth = system.truth(library, {})
    assert truth is not None

    def errors(found: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(found - truth, axis=-1) / np.linalg.norm(truth))

    made = origin()
    rows = []
    for name in ("pinn", "pielm"):
        fit = solve(make(methods.find(name), {}), [samples], library, 2, SEED)
        assert fit.history is not None
        good = min(first_good(fit.history.seconds, errors(fit.history.coefficients)), fit.seconds)
        steps, last = int(fit.history.step[-1]), float(errors(fit.coefficients))
        rows.append(row(f"latticebench {name}", steps, fit.seconds, last, good))
    seconds, found, step = train(samples, library, PINN(), given.limit)
    steps, last, good = len(seconds) - 1, float(errors(found[-1])), first_good(seconds, errors(found))
    rows.append(row("DeepXDE, the network and loss of pinn", steps, float(seconds[-1]), last, good))
    table = pd.DataFrame(rows)
    about = {
        "command": f"python results/peers/deepxde_fit.py --limit {given.limit:g}",
        "DeepXDE's time limit": f"{given.limit:g} s; a step of Adam took {1e3 * step:.1f} ms; "
        f"an empty entry: E2 never stayed below {GOOD:g}",
        "seed": SEED,
        **made,
        "deepxde": version("deepxde"),
    }
    for form in ("csv", "md"):
        write_text(given.out / f"fit.{form}", render(table, about, form))
    print(table.to_string())


if __name__ == "__main__":
    main()
