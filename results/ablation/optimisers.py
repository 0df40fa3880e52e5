"""Try optimisers and weights of the literature on the paper's network: optimisers.csv, optimisers.md, optimisers.png.

    python results/ablation/optimisers.py

Network, loss, units and first weights are those of `pinn`, which trains by Adam (1000 steps) and then L-BFGS. Beside
it:

- `soap`: SOAP for all steps, Adam in the slowly moving eigenbasis of Shampoo's preconditioner (Vyas et al.,
  arXiv:2409.11321; for physics-informed networks Wang et al., arXiv:2502.00604).
- `causal`: the equation's residual at a time counts by exp(-c * its loss at all times before), c = 10, the weights
  renewed every 300 evaluations (Wang, Sankaran & Perdikaris, arXiv:2203.07404).
- `broyden-20`: Adam, then the self-scaled Broyden method (Al-Baali, Comput. Optim. Appl. 9, 191 (1998); for
  physics-informed networks Kiyani et al., arXiv:2501.16371) with a whole matrix, which the 5906 weights of the paper's
  network are too many for: 20 units a layer.
- `pinn-20`: the training of `pinn` with 20 units a layer.

Every fit has BUDGET processor seconds. Lattices, libraries and samples are those of the suite `networks`, part `paper`.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.linalg.blas import dgemm
from scipy.optimize import line_search

from latticebench.bench.case import Folders
from latticebench.bench.colours import series
from latticebench.bench.figures import save
from latticebench.bench.fitting import FitCase, samples, seed_of
from latticebench.bench.provenance import origin
from latticebench.bench.publish import markdown_table, render
from latticebench.bench.published import read_head
from latticebench.methods.engine.networks.arrays import Arrays, one_thread
from latticebench.methods.engine.networks.descent import adam, lbfgs
from latticebench.methods.engine.networks.equation import multipliers
from latticebench.methods.engine.networks.loss import JointLoss, LossSettings, NetworkLoss
from latticebench.methods.engine.networks.members import member_draws
from latticebench.methods.engine.networks.network import backward, forward, split_layers
from latticebench.methods.engine.networks.sizes import estimate_sizes
from latticebench.methods.pinn import PINN
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
BUDGET = 8.0
CASES = (
    ("phi4", {"C": 2.0, "v": 0.5}, "lib2"),
    ("dnls", {"C": 0.5}, "four"),
    ("ginzburg-landau", {"C": 0.5}, "four"),
    ("sine-gordon", {"C": 0.5, "v": 0.5}, "lib2"),
)
SEEDS = {0.0: (1, 2, 3, 4, 5), 0.01: (1, 2, 3), 0.05: (1, 2, 3)}
SETTINGS = PINN()
Evaluate = Callable[[np.ndarray], tuple[Any, np.ndarray]]


class Over(Exception):
    """The processor time is spent."""


@dataclass
class Clock:
    """Counts processor time, and keeps the coefficients on the way.

    Attributes:
        loss: which knows the coefficients of a point.
        kept: seconds and coefficients.
    """

    loss: Any
    began: float = field(default_factory=time.process_time)
    kept: list[tuple[float, np.ndarray]] = field(default_factory=list)

    def note(self, _step: int, _loss: Any, point: np.ndarray) -> None:
        """Keep the coefficients twenty times a second; end the training when its time is spent."""
        seconds = time.process_time() - self.began
        if not self.kept or seconds > self.kept[-1][0] + 0.05:
            self.kept.append((seconds, np.array(self.loss.coefficients(point))))
        if seconds > BUDGET:
            raise Over


# The network and its loss -------------------------------------------------------------------------------------------


def built(case: FitCase, width: int, causal: float = 0.0) -> tuple[JointLoss, np.ndarray]:
    """Return the loss of `pinn` with so many units a layer, and its start."""
    system, library = case.resolve(Path())
    data = [one.observed() for one in samples(case, Path())]
    sizes = estimate_sizes(data, library, system.order)
    given = LossSettings(SETTINGS.layers, width, SETTINGS.collocation, SETTINGS.data_weight)
    arrays = Arrays("cpu")
    kind = CausalLoss if causal else NetworkLoss
    loss = kind(data, library, system.order, sizes, given, arrays)
    joint = JointLoss([loss], SETTINGS.coefficient_scale * sizes.coefficients())
    draws = member_draws(seed_of(case.seed, "method"), 1)
    return joint, joint.start(SETTINGS.frequency, draws, ())


class CausalLoss(NetworkLoss):
    """The loss with a weight for the residual at each time; for a single set of samples.

    Attributes:
        importance: of the collocation times (P, 1).
    """

    strictness = 10.0
    importance: np.ndarray | float = 1.0

    def renew(self) -> None:
        """Let a time count by what the equation leaves at all times before, in the point that was last evaluated."""
        before = np.cumsum(self.left) - self.left
        self.importance = np.exp(-self.strictness * before / self.points)[:, None]

    def loss(self, weights: np.ndarray, xi: np.ndarray, gradient: np.ndarray, coefficient_gradient: np.ndarray) -> Any:
        """Return the loss and compute its gradient; see `NetworkLoss.loss`."""
        points, rows, law = self.points, len(self.x), self.sets[0].equation
        out, pull = forward(split_layers(weights, self.shapes), self.x, self.work, np), self.work.pull
        miss = out[points:rows] - self.sets[0].data
        weighted = miss * self.sets[0].share
        pull[points:rows] = 2 * self.data_weight * weighted
        fields, rates = out[:points] * self.units, out[rows:] * (self.units / self.half)
        by_fields, by_rates = np.zeros_like(fields), np.zeros_like(rates)
        terms, slopes = law.evaluate(fields, xi)
        pulled, self.left = [], np.zeros(points)
        scale = self.residual_weight / (self.sizes.rate**2 * law.width)
        for part in range(law.parts):
            where = law.rate_columns(part)
            left = rates[:, where] - sum(x * term for x, term in zip(multipliers(xi), terms[part], strict=True))
            self.left += scale * np.sum(left**2, axis=1)
            left = left * self.importance * (2 * scale / points)
            by_rates[:, where] += left
            coefficient_gradient -= np.stack([np.sum(left * term) for term in terms[part]])
            pulled.append(-left)
        law.pull_back(slopes, pulled, by_fields)
        if self.order == 2:
            level = law.parts * law.sites
            scale = self.residual_weight / (self.sizes.velocity**2 * law.sites)
            gap = rates[:, :level] - fields[:, level:]
            self.left += scale * np.sum(gap**2, axis=1)
            gap = gap * self.importance * (2 * scale / points)
            by_rates[:, :level] += gap
            by_fields[:, level:] -= gap
        pull[:points], pull[rows:] = by_fields * self.units, by_rates * (self.units / self.half)
        backward(split_layers(weights, self.shapes), self.x, self.work, split_layers(gradient, self.shapes), np)
        return self.data_weight * np.sum(weighted * miss) + np.mean(self.left * np.ravel(self.importance))


# The optimisers -----------------------------------------------------------------------------------------------------


def paper(joint: JointLoss, start: np.ndarray, clock: Clock) -> None:
    """Train as `pinn` does."""
    point = adam(joint.value_and_gradient, start, SETTINGS.adam_steps, SETTINGS.learning_rate, clock.note)
    lbfgs(joint.value_and_gradient, point, 10**6, SETTINGS.memory, clock.note)


def causal(joint: JointLoss, start: np.ndarray, clock: Clock) -> None:
    """Train as `pinn` does, the causal weights renewed every 300 evaluations."""
    (loss,) = joint.losses
    assert isinstance(loss, CausalLoss)
    point = start
    for number in itertools.count():
        joint.value_and_gradient(point)
        loss.renew()
        if number < 4:
            point = adam(joint.value_and_gradient, point, 250, SETTINGS.learning_rate, clock.note)
        else:
            point = lbfgs(joint.value_and_gradient, point, 300, SETTINGS.memory, clock.note)
            clock.note(number, 0.0, point)


def soap(joint: JointLoss, start: np.ndarray, clock: Clock) -> None:
    """Train by SOAP, the step falling along half a cosine of the processor time."""
    shapes, count, point = joint.losses[0].shapes, joint.weights, start * 1.0
    state = [
        [np.zeros((size, size)) for size in shape] + [np.eye(size) for size in shape] + [np.zeros(shape)]
        for shape in shapes
    ]
    mean, square = np.zeros_like(point), np.zeros_like(point[count:])
    for step in itertools.count():
        value, gradient = joint.value_and_gradient(point)
        clock.note(step, value, point)
        mean += 0.05 * (gradient - mean)
        done = 1 - 0.95 ** (step + 1)
        rate = SETTINGS.learning_rate * 0.5 * (1 + math.cos(math.pi * min(1.0, clock.kept[-1][0] / BUDGET))) / done
        square += 0.05 * (gradient[count:] ** 2 - square)
        point[count:] -= rate * mean[count:] / (np.sqrt(square / done) + 1e-8)
        layers = (split_layers(vector[:count], shapes) for vector in (gradient, mean, point))
        for kept, g, m, weights in zip(state, *layers, strict=True):
            kept[0] += 0.05 * (g @ g.T - kept[0])
            kept[1] += 0.05 * (g.T @ g - kept[1])
            if step == 0:
                kept[2], kept[3] = np.linalg.eigh(kept[0])[1], np.linalg.eigh(kept[1])[1]
            elif step % 10 == 0:
                kept[2], kept[3] = np.linalg.qr(kept[0] @ kept[2])[0], np.linalg.qr(kept[1] @ kept[3])[0]
            left, right, second = kept[2], kept[3], kept[4]
            second += 0.05 * ((left.T @ g @ right) ** 2 - second)
            weights -= rate * left @ ((left.T @ m @ right) / (np.sqrt(second / done) + 1e-8)) @ right.T


def broyden(joint: JointLoss, start: np.ndarray, clock: Clock) -> None:
    """Train by Adam and then by the self-scaled Broyden method; the inverse Hessian is a whole matrix."""
    point = adam(joint.value_and_gradient, start, SETTINGS.adam_steps, SETTINGS.learning_rate, clock.note)
    seen: dict[bytes, tuple[float, np.ndarray]] = {}

    def at(x: np.ndarray) -> tuple[float, np.ndarray]:
        key = x.tobytes()
        if key not in seen:
            seen.clear()
            seen[key] = joint.value_and_gradient(x)
        return seen[key]

    value, gradient = at(point)
    inverse = np.asfortranarray(np.eye(len(point)) / np.linalg.norm(gradient))
    for step in itertools.count():
        clock.note(step, value, point)
        way = -inverse @ gradient
        length = line_search(
            lambda x: at(x)[0], lambda x: at(x)[1], point, way, gradient, value, c1=1e-4, c2=0.9, maxiter=20
        )[0]
        if length is None:
            # The search has failed: begin again downhill.
            inverse = np.asfortranarray(np.eye(len(point)) / np.linalg.norm(gradient))
            continue
        moved = length * way
        point = point + moved
        value, then = at(point)
        inverse = updated(inverse, moved, then - gradient, float(-length * moved @ gradient))
        gradient = then


def updated(inverse: np.ndarray, moved: np.ndarray, turned: np.ndarray, curved: float) -> np.ndarray:
    """Return the next inverse Hessian H by Al-Baali's choice of Broyden's theta and of the scale tau.

    Args:
        inverse: H (n, n), overwritten.
        moved: s, the step (n,).
        turned: y, the change of the gradient (n,).
        curved: s^T H^-1 s.
    """
    product, spread = float(turned @ moved), inverse @ turned
    if product <= 0:
        return inverse
    b, h = curved / product, float(turned @ spread) / product
    a = max(b * h - 1, 1e-16)
    upper, lower = min(1.0, 1 / b), min(1.0, h * (1 - math.sqrt(a / (1 + a))))
    theta = max((lower - 1) / a, min(1 / lower, (1 - b) / b))
    sigma = 1 + a * theta
    power = abs(sigma) ** (-1 / (len(moved) - 1))
    tau = upper * min(power, 1 / theta) if theta > 0 else min(upper * power, sigma)
    phi = (1 - theta) / (1 + a * theta)
    # H / tau + [s, Hy] M [s, Hy]^T
    size = float(turned @ spread)
    own = phi * size / (tau * product**2) + 1 / product
    cross, last = -phi / (tau * product), (phi - 1) / (tau * size)
    basis = np.asfortranarray(np.column_stack([moved, spread]))
    middle = basis @ np.array([[own, cross], [cross, last]])
    return np.asarray(dgemm(1.0, middle, basis, 1 / tau, inverse, trans_b=True, overwrite_c=True))


VARIANTS: dict[str, tuple[Callable[[JointLoss, np.ndarray, Clock], None], int, float]] = {
    "pinn": (paper, SETTINGS.width, 0.0),
    "soap": (soap, SETTINGS.width, 0.0),
    "causal": (causal, SETTINGS.width, 1.0),
    "pinn-20": (paper, 20, 0.0),
    "broyden-20": (broyden, 20, 0.0),
}

# Tables and figure --------------------------------------------------------------------------------------------------


def trained() -> Iterator[tuple[Any, ...]]:
    """Train every variant on every case; yield the error on the way, at even steps of a quarter of a second."""
    times = np.arange(1, 4 * BUDGET + 1) / 4
    for noise, (system, parameters, library) in itertools.product(SEEDS, CASES):
        for seed, (name, (train, width, weighted)) in itertools.product(SEEDS[noise], VARIANTS.items()):
            case = FitCase(
                system=system, parameters=parameters, library=library, noise=noise, seed=seed, known_ends=True,
                label=name, method="pinn",
            )  # fmt: skip
            place, candidates = case.resolve(Folders().suite)
            truth = place.truth(candidates, parameters)
            assert truth is not None
            joint, start = built(case, width, weighted)
            clock = Clock(joint)
            try:
                with one_thread(), np.errstate(all="ignore"):
                    train(joint, start, clock)
            except Over:
                pass
            seconds = np.array([one for one, _ in clock.kept])
            off = np.linalg.norm(np.array([found for _, found in clock.kept]) - truth, axis=1) / np.linalg.norm(truth)
            print(noise, system, seed, name, len(clock.kept), float(off[-1]), flush=True)
            for when in times:
                yield name, noise, system, seed, when, float(off[np.searchsorted(seconds, when, side="right") - 1])


def compared(table: pd.DataFrame) -> pd.DataFrame:
    """Return the errors at half and at all of the time: median [least, largest] over lattices and seeds."""
    rows = []
    for (noise, name), group in table.groupby(["noise", "variant"], sort=False):
        row: dict[str, Any] = {
            "noise": noise,
            "variant": name,
            "fits": group[["system", "seed"]].drop_duplicates().shape[0],
        }
        for when in (BUDGET / 2, BUDGET):
            last = group[group["seconds"] == when].set_index(["system", "seed"])["e2"]
            beside = table[
                (table["noise"] == noise) & (table["variant"] == "pinn") & (table["seconds"] == when)
            ].set_index(["system", "seed"])["e2"]
            row |= {f"e2 at {when:g} s": last.median(), f"largest at {when:g} s": last.max()}
            row[f"ratio at {when:g} s"] = (last / beside).median()
        rows.append(row)
    return pd.DataFrame(rows)


def figure(table: pd.DataFrame) -> Any:
    """Draw the median error against processor seconds, one line a variant, its band from the least to the largest."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    whole, grid = plt.subplots(1, len(SEEDS), figsize=(10, 4), sharey=True, layout="constrained")
    for axes, noise in zip(grid, SEEDS, strict=True):
        for place, name in enumerate(VARIANTS):
            chosen = table[(table["noise"] == noise) & (table["variant"] == name)].groupby("seconds")["e2"]
            colour = series(place)
            axes.plot(chosen.median(), color=colour, label=name)
            axes.fill_between(chosen.min().index, chosen.min(), chosen.max(), color=colour, alpha=0.12, linewidth=0)
        axes.set_yscale("log")
        axes.grid(alpha=0.25)
        axes.set_title(f"{100 * noise:g} % noise", fontsize=9)
        axes.set_xlabel("processor seconds", fontsize=9)
    grid[0].set_ylabel("relative error of the coefficients, E2", fontsize=9)
    grid[-1].legend(fontsize=8, frameon=False)
    return whole


def page() -> str:
    """Return the text of optimisers.md, made from optimisers.csv beside this file."""
    table = pd.read_csv(HERE / "optimisers.csv", comment="#")
    about = "".join(f"- {name}: {told}\n" for name, told in read_head(HERE / "optimisers.csv").items())
    return (
        "# Optimisers and weights of the literature on the paper's network\n\n"
        "Made by `python results/ablation/optimisers.py`, which says what the variants are. Each fit has "
        f"{BUDGET:g} processor seconds; medians and largest over four lattices and the seeds; ratio: the median over "
        "pairs (same lattice, samples and first weights) of the error over that of `pinn`. "
        "![Error and processor seconds](optimisers.png)\n\n"
        f"{markdown_table(compared(table))}\n\n{about}"
    )


def main() -> None:
    """Train, and write the three files."""
    about = {
        "command": "python results/ablation/optimisers.py", "budget": f"{BUDGET:g} processor seconds a fit", **origin(),
        "seeds": "; ".join(f"{', '.join(map(str, seeds))} at {100 * noise:g} %" for noise, seeds in SEEDS.items()),
    }  # fmt: skip
    table = pd.DataFrame(trained(), columns=["variant", "noise", "system", "seed", "seconds", "e2"])
    write_text(HERE / "optimisers.csv", render(table, about, "csv"))
    write_text(HERE / "optimisers.md", page())
    save(figure(table), HERE / "optimisers.png", about)


if __name__ == "__main__":
    main()
