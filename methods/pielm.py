"""A physics-informed extreme learning machine: a hidden layer that is drawn, and a least-squares problem for the rest.

The literature's name for a network whose hidden units stay as they were drawn and which is held to an equation
(Dwivedi & Srinivasan, Neurocomputing 391, 96 (2020); Dong & Li, Comput. Methods Appl. Mech. Eng. 387, 114129 (2021));
here the coefficients of the equation are unknown, too.

One hidden layer of tanh units takes the time t and gives phi_k(t); the field is u_n(t) = sum_k a_kn phi_k(t). The
velocity and the rate are its exact time derivatives, so that no residual of du/dt - v is needed. Output weights a and
coefficients xi minimise the squares of the samples' residuals plus w^2 times those of the equation's residuals, each
scaled by a size (`methods.engine.networks.projection` has the formula). Differences from `pinn`:

- Variable projection: the problem is least squares in a and xi but for the library's nonlinearity, so
  Levenberg-Marquardt steps in both together end within a few iterations.
- The hidden units are drawn and not trained (`methods.engine.networks.hidden_units`). Their steepness follows from the
  frequencies in the samples, they bend evenly over the span, and they are orthonormal, which keeps the least squares
  well conditioned.
- The weight w follows from the samples: from weak to strong, the one with the least generalised cross-validation score
  (Golub, Heath & Wahba, Technometrics 21, 215 (1979)) of the predicted samples. Samples without noise ask for a weak w,
  noisy ones of an equation that the library holds for a strong one, and an equation outside the library for a weak one.
- Training starts at the smoothing spline through the samples.

Standard errors are those of the linearised least squares at the end, with the variance that cross-validation finds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, NamedTuple

import numpy as np

from latticebench.methods.engine.bounds import SOME, Count, Positive, Several
from latticebench.methods.engine.networks.arrays import Arrays, check_device, host, one_thread
from latticebench.methods.engine.networks.history import HistoryLog
from latticebench.methods.engine.networks.members import best_member, member_draws, spread
from latticebench.methods.engine.networks.projection import Curve, CurveSettings, ProjectedStep, project, projected_step
from latticebench.methods.engine.networks.sizes import estimate_sizes
from latticebench.methods.method import Abilities, Fit, History, Smooth
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.networks.arrays import Array


@dataclass(frozen=True)
class PIELM:
    """A network whose hidden units are drawn, solved by least squares; see the module.

    Attributes:
        width: number of tanh units.
        bandwidth: steepest unit, in multiples of the samples' root-mean-square angular frequency.
        collocation: number of evenly spaced times, ends included, at which the equation is asked for.
        weights: the weights w of the equation against the samples to choose from.
        iterations: maximum number of Levenberg-Marquardt steps per weight.
        tolerance: a step that lowers the objective by less than this share of it is the last one.
        device: cpu, or a device of torch's such as cuda; cpu:0 is torch on the processor.
        members: number of networks whose hidden units are drawn differently; the one with the least cross-validation
            score is the fit, and `found` has the standard deviation of each coefficient over them. On a device they
            take their steps together, in `members` times the memory; on NumPy arrays one is solved after the other,
            since a processor gains nothing (on torch with one thread of it, eight together cost 1.7 of eight single
            ones: the matrices outgrow its cache).

    Raises:
        InputError: there is no such device.
    """

    name: ClassVar[str] = "pielm"
    width: Count = 80
    bandwidth: Positive = 3.0
    collocation: Several = 201
    weights: Annotated[tuple[Positive, ...], SOME] = (1e-4, 1e-3, 0.01, 0.1, 1.0, 10.0, 100.0)
    iterations: Count = 8
    tolerance: Positive = 1e-6
    device: str = "cpu"
    members: Count = 1

    def __post_init__(self) -> None:
        """Check the device."""
        check_device(self.device)

    @property
    def abilities(self) -> Abilities:
        """Everything but the truth."""
        return Abilities(missing=True, loads=() if self.device == "cpu" else ("torch",))

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Solve for output weights and coefficients with one weight w after the other, and keep the best.

        Raises:
            InputError: torch does not have the device.
            Skipped: a trajectory has too many unknowns for dense normal equations.
        """
        arrays = Arrays(self.device)
        draws = member_draws(seed, self.members)
        settings = CurveSettings(self.width, self.bandwidth, self.collocation)
        since = time.perf_counter()
        with one_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            sizes = estimate_sizes(data, library, order)
            solved = [
                one
                for group in ([draws] if arrays.batches else [[draw] for draw in draws])
                for one in self._solve(
                    [Curve(samples, library, order, sizes, settings, group, arrays) for samples in data],
                    len(library.terms),
                    since,
                )
            ]
        best = solved[best_member(np.array([one.score for one in solved]))]
        if not math.isfinite(best.score):
            status = "no weight could be solved for"
            return Fit(self.name, library, order, best.coefficients, float("nan"), status=status)
        found = {"weight": best.weight, "noise": math.sqrt(best.score) * sizes.field}
        found |= spread(np.array([one.coefficients for one in solved]), library)
        return Fit(
            self.name, library, order, best.coefficients, best.residual, best.stderr, history=best.history, found=found,
            smooth=best.smooth,
        )  # fmt: skip

    def _solve(self, curves: list[Curve], count: int, since: float) -> list[SolvedNetwork]:
        """Go through the weights with one network, or with the members of a batch, each as far as its score says."""
        arrays = curves[0].arrays
        xp = arrays.xp
        observed = sum(curve.observed for curve in curves)
        at = [curve.weights for curve in curves]
        xi = arrays.move(project(curves, at, count))
        log = HistoryLog(1, since)
        least = arrays.zeros(*xi.shape[:-1]) + math.inf
        going = least > 0
        # The best so far: w, the output weights, the coefficients, their standard errors.
        chosen, kept, found, errors = least * 1, at, xi, xi * math.nan
        for weight in sorted(self.weights):
            at, xi, last = self._descend(curves, at, xi, weight, going, log)
            missed = sum(curve.misfits(a, xi)[0] for curve, a in zip(curves, at, strict=True))
            # With as many degrees of freedom as values the samples say nothing about their noise.
            free = xp.clip(observed - last.freedom, 1e-6 * observed, None)
            variance = missed / free
            score = variance * observed / free
            sound = going & last.sound
            better = sound & (score < least)
            spreads = xp.clip(xp.diagonal(last.covariance, 0, -2, -1), 0, None)
            errors = xp.where(better[..., None], xp.sqrt(spreads * variance[..., None]), errors)
            kept = [xp.where(better[..., None, None], a, old) for a, old in zip(at, kept, strict=True)]
            found = xp.where(better[..., None], xi, found)
            chosen = xp.where(better, weight, chosen)
            least = xp.where(better, score, least)
            going = going & ~(sound & ~better & (score > 3 * least))
            if not bool(going.any()):
                break
        found = xp.where(xp.isfinite(least)[..., None], found, xi)
        ending = log.loss[-1] if log.loss else host(arrays.zeros(*least.shape))
        log.note(len(log.step) + 1, ending, host(found), always=True)
        numbers = [host(one) for one in (least, chosen, found, errors, _residual(curves, kept, found))]
        smooth = list(zip(*(curve.smooth(a) for curve, a in zip(curves, kept, strict=True)), strict=True))
        return [
            SolvedNetwork(
                float(numbers[0][of]), float(numbers[1][of]), numbers[2][of], numbers[3][of], float(numbers[4][of]),
                log.history(of[0] if of else None), smooth[of[0] if of else 0],
            )
            for of in np.ndindex(*least.shape)
        ]  # fmt: skip

    def _descend(
        self, curves: list[Curve], at: list[Array], xi: Array, weight: float, going: Array, log: HistoryLog
    ) -> tuple[list[Array], Array, ProjectedStep]:
        """Take Levenberg-Marquardt steps with one weight.

        Each member has its own damping: one whose trial fails tries again while the others move on.

        Args:
            curves: the trajectories.
            at: their output weights (..., units, outputs).
            xi: the coefficients (..., J).
            weight: w.
            going: which members are to move (...).
            log: gets a record per step.

        Returns:
            the output weights and coefficients at the end, and an undamped step from there.
        """
        arrays = curves[0].arrays
        xp = arrays.xp

        def objective(point: Sequence[Array], coefficients: Array) -> Array:
            pairs = [curve.misfits(a, coefficients) for curve, a in zip(curves, point, strict=True)]
            value = sum(data + weight**2 * law for data, law in pairs)
            return xp.where(xp.isfinite(value), value, math.inf)

        value = objective(at, xi)
        least = arrays.zeros(*xi.shape[:-1]) + 1e-12
        damping, steps, active = least, arrays.zeros(*xi.shape[:-1]), going
        while bool(active.any()):
            trial = projected_step(curves, at, xi, weight, damping, hat=False)
            lower = objective(trial.weights, trial.coefficients)
            found = active & trial.sound & (lower < value)
            at = [xp.where(found[..., None, None], new, old) for new, old in zip(trial.weights, at, strict=True)]
            xi = xp.where(found[..., None], trial.coefficients, xi)
            gain = value - lower
            enough = gain < self.tolerance * (lower + gain)
            value, steps = xp.where(found, lower, value), steps + found
            damping = xp.where(found, xp.clip(damping / 30, 1e-12, None), damping * 30)
            active = active & xp.where(found, (steps < self.iterations) & ~enough, damping < 1e3)
            if bool(found.any()):
                log.note(len(log.step) + 1, host(value), host(xi))
        last = projected_step(curves, at, xi, weight, least, hat=True)
        for _ in range(2):
            if bool((last.sound | ~going).all()):
                break
            least = xp.where(last.sound, least, least * 100)
            last = projected_step(curves, at, xi, weight, least, hat=True)
        return at, xi, last


def _residual(curves: Sequence[Curve], at: Sequence[Array], xi: Array) -> Array:
    """Return the RMS of rate - sum_j xi_j T_j over that of the rate (...), over all collocation points."""
    xp = curves[0].arrays.xp
    missed = sum(curve.misfits(a, xi)[1] for curve, a in zip(curves, at, strict=True))
    whole = sum(
        (curve.state(a, xi)[1] ** 2).sum((0, -2, -1)) / curve.sizes.rate**2 for curve, a in zip(curves, at, strict=True)
    )
    return xp.sqrt(xp.where(whole > 0, missed / whole, missed))


class SolvedNetwork(NamedTuple):
    """What one network, or one member, ended with; `score` is that of cross-validation, `weight` the w chosen by it."""

    score: float
    weight: float
    coefficients: Float[ndarray, " terms"]
    stderr: Float[ndarray, " terms"]
    residual: float
    history: History
    smooth: tuple[Smooth, ...]


METHODS = (PIELM,)
