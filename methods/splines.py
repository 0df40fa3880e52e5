"""Splines with the equation as a penalty: the objective of a physics-informed network without the network.

The motion of each site is a B-spline. Coefficients and splines minimise together the misfit of the samples plus W times
the mean square of the residual of the equation, by Gauss-Newton steps with exact derivatives of the terms
(`latticebench.methods.engine.collocation`; Ramsay, Hooker, Campbell & Cao, J. R. Stat. Soc. B 69, 741 (2007)). The
coefficients start from fits to short pieces of the trajectories (`latticebench.methods.engine.starts`).

W grows from stage to stage, each of which starts where the last ended. The largest W is taken that robust generalised
cross-validation allows (Lukas, Inverse Problems 22, 1883 (2006), with the trace of the hat matrix in place of that of
its square): the data themselves decide how far the splines can follow the equation. That trace, the degrees of freedom
of the splines, is estimated with random signs (Hutchinson, Commun. Stat. 18, 1059 (1989)); the noise of u and v is
estimated with it, too. Standard errors follow from the Gauss-Newton matrix with the estimated noise.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Le

from latticebench.methods.engine.bounds import Count, NotNegative, Positive
from latticebench.methods.engine.collocation import Curves, NormalEquations, normal_equations, objective, place_curves
from latticebench.methods.engine.dynamics import split_parts
from latticebench.methods.engine.record import prepare, without_halves
from latticebench.methods.engine.scaled import inverse_of_squares
from latticebench.methods.engine.shooting import LEAST_NOISE
from latticebench.methods.engine.starts import approach, smooth
from latticebench.methods.method import Abilities, Fit, History, Smooth
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Largest number of Gauss-Newton steps to the first coefficients.
START_STEPS = 40
PROBES = 4
# Plain cross-validation sometimes lets the splines follow the noise; robust cross-validation counts freedom more.
ROBUST = 0.3


@dataclass(frozen=True, eq=False)
class _Stage:
    """The minimum for one weight.

    Attributes:
        weight: W of the equation.
        splines: coefficients of the splines of each trajectory.
        coefficients: xi.
        misfit: sums of squares of what is left of u and v.
        sigma: estimated noise of u and v.
        covariance: of xi.
    """

    weight: float
    splines: list[ndarray]
    coefficients: Float[ndarray, " terms"]
    misfit: Float[ndarray, " levels"]
    sigma: Float[ndarray, " levels"]
    covariance: Float[ndarray, "terms terms"]


@dataclass(frozen=True, eq=False)
class _Scale:
    """How many numbers of u and v were observed, and their RMS."""

    counts: Float[ndarray, " levels"]
    height: Float[ndarray, " levels"]

    @property
    def floor(self) -> Float[ndarray, " levels"]:
        """The least noise of u and v that counts."""
        return np.asarray(LEAST_NOISE * np.maximum(self.height, 1e-300))


@dataclass(frozen=True)
class Splines:
    """B-splines with the equation as a penalty.

    Attributes:
        degree: of the B-splines.
        density: knot intervals per interval between samples.
        stages: largest number of weights of the equation, each ten times the last.
        steps: largest number of Gauss-Newton steps per weight.
        tolerance: a stage ends when no coefficient moves by more than this share of its standard error.
        rise: the largest weight is taken whose cross-validation score exceeds the least by no more than this.
    """

    name: ClassVar[str] = "splines"
    degree: Annotated[int, Ge(3), Le(20)] = 7
    density: Positive = 1.5
    stages: Count = 16
    steps: Count = 4
    tolerance: Positive = 0.05
    rise: NotNegative = 0.003

    @property
    def abilities(self) -> Abilities:
        """The method takes complex fields, inputs, uneven times and missing values."""
        return Abilities(missing=True)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Minimise the penalised misfit, with growing weight of the equation.

        Raises:
            InputError: the equation cannot be set up on the samples, or they are too few to start from.
        """
        began = time.perf_counter()
        data = [without_halves(samples) for samples in data]
        records = [prepare(samples, library.terms, order) for samples in data]
        coefficients = approach(data, records, START_STEPS).coefficients
        curves = [place_curves(record, self.degree, self.density) for record in records]
        scale = _scale(curves)
        draw = np.random.default_rng(seed)
        splines = [_start(one, samples, order) for one, samples in zip(curves, data, strict=True)]
        probes = [draw.choice([-1.0, 1.0], size=(c.size, PROBES)) for c in splines]
        start = _first_stage(curves, splines, coefficients, scale)
        best, path = self._stages(curves, start, scale, probes, began)
        found: dict[str, float | str] = {"weight": best.weight, "noise_u": float(best.sigma[0])}
        if len(best.sigma) > 1:
            found["noise_v"] = float(best.sigma[1])
        history = None
        if path:
            seconds, score, followed = map(np.array, zip(*path, strict=True))
            history = History(np.arange(1, len(path) + 1), seconds, score, followed)
        return Fit(
            self.name, library, order, best.coefficients, _left(curves, best, order),
            stderr=np.sqrt(np.diag(best.covariance)),
            status="ok" if best is not start else "the fit did not converge; its start is given",
            history=history, found=found, smooth=tuple(map(_smooth, curves, best.splines)),
        )  # fmt: skip

    def _stages(
        self, curves: Sequence[Curves], start: _Stage, scale: _Scale, probes: Sequence[ndarray], began: float
    ) -> tuple[_Stage, list[tuple[float, float, ndarray]]]:
        """Raise the weight from stage to stage.

        Returns:
            the stage of the largest weight that cross-validation allows (`start` where the first one fails); and
            seconds, score and coefficients after each stage.
        """
        counts, path = scale.counts, []
        now, best, least, before = start, start, np.inf, np.inf
        for _ in range(self.stages):
            reached = self._minimised(curves, now)
            if reached is None:
                break
            stage, steps = reached
            # An estimate from few probes may leave the range of the trace.
            parts = zip(curves, steps, probes, strict=True)
            used = sum(step.freedom(one, now.sigma, probe) for one, step, probe in parts)
            used = np.clip(used, 0.0, 0.99 * counts)
            score = _score(stage.misfit, used, scale)
            path.append((time.perf_counter() - began, score, stage.coefficients))
            # While the splines have many degrees of freedom, what they leave says little about the noise.
            spread = np.maximum(np.sqrt(stage.misfit / (counts - used)), scale.floor)
            stage = replace(stage, sigma=np.where(used < 0.5 * counts, spread, now.sigma))
            least = min(least, score)
            if score <= least + self.rise:
                best = stage
            free = float(np.sum(used))
            error = np.sqrt(np.maximum(np.diag(stage.covariance), 1e-300))
            moved = np.max(np.abs(stage.coefficients - now.coefficients) / error)
            # Heavier weights change nothing more, or the splines cannot follow the equation any closer.
            settled = moved < self.tolerance and abs(free / before - 1) < 0.02
            if free < 0.5 * np.sum(counts) and (settled or score > least + 0.3):
                break
            before = free
            now = replace(stage, weight=stage.weight * 10)
        return best, path

    def _minimised(self, curves: Sequence[Curves], start: _Stage) -> tuple[_Stage, list[NormalEquations]] | None:
        """Minimise for one weight; None where the linear algebra breaks down."""
        splines, coefficients, sigma, weight = list(start.splines), start.coefficients, start.sigma, start.weight
        now, misfit, _ = objective(curves, splines, coefficients, sigma, weight)
        steps: list[NormalEquations] = []
        covariance = np.zeros((len(coefficients),) * 2)
        for _ in range(self.steps):
            try:
                steps = [
                    normal_equations(one, c, coefficients, sigma, weight)
                    for one, c in zip(curves, splines, strict=True)
                ]
                covariance = inverse_of_squares(np.sum([step.schur for step in steps], axis=0))
            except np.linalg.LinAlgError:
                return None
            change = covariance @ np.sum([step.aim for step in steps], axis=0)
            moves = [step.own - step.across @ change for step in steps]
            length = 1.0
            while length > 1e-3:
                trial = [c + length * move for c, move in zip(splines, moves, strict=True)]
                then, further, _ = objective(curves, trial, coefficients + length * change, sigma, weight)
                if np.isfinite(then) and then <= now * (1 + 1e-9):
                    break
                length /= 2
            else:
                break
            splines, coefficients, misfit = trial, coefficients + length * change, further
            gained, now = now - then, then
            error = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
            if length == 1.0 and (np.max(np.abs(change) / error) <= self.tolerance or gained < 1e-3):
                break
        return _Stage(weight, splines, coefficients, misfit, sigma, covariance), steps


def _scale(curves: Sequence[Curves]) -> _Scale:
    counts = np.asarray(sum(np.array([len(y) for y in one.values]) for one in curves), dtype=float)
    squares = sum(np.array([np.sum(y**2) for y in one.values]) for one in curves)
    return _Scale(counts, np.sqrt(squares / np.maximum(counts, 1)))


def _start(curves: Curves, samples: Samples, order: int) -> ndarray:
    """Return splines through the smoothed samples, as smooth as the smoothing left them."""
    dynamics = curves.record.stretches.dynamics
    u, v = smooth(samples, order)
    rows = [curves.basis.design(samples.t, 0)]
    fields = [split_parts(u, samples.is_complex).reshape(len(u), -1)]
    if v is not None:
        step = float(np.mean(np.diff(samples.t)))
        rows.append(curves.basis.design(samples.t, 1) * step)
        fields.append(split_parts(v, samples.is_complex).reshape(len(u), -1) * step)
    bend = np.diff(np.eye(curves.basis.count), min(4, curves.basis.count - 1), axis=0)
    matrix = np.concatenate([*rows, 1e-3 * bend])
    target = np.concatenate([*fields, np.zeros((len(bend), dynamics.parts * dynamics.sites))])
    return np.asarray(np.linalg.lstsq(matrix, target, rcond=None)[0]).ravel()


def _first_stage(curves: Sequence[Curves], splines: list[ndarray], coefficients: ndarray, scale: _Scale) -> _Stage:
    """Return the start with its noise, and with a weight that trusts the equation as little as the start deserves."""
    _, misfit, left = objective(curves, splines, coefficients, np.ones(len(scale.counts)), 1.0)
    sigma = np.sqrt(misfit / np.maximum(scale.counts, 1))
    sigma = np.maximum(sigma, np.maximum(1e-6 * scale.height, scale.floor))
    weight = float(np.sum(scale.counts)) / max(left, 1e-300)
    return _Stage(weight, splines, coefficients, misfit, sigma, np.full((len(coefficients),) * 2, np.nan))


def _score(misfit: ndarray, used: ndarray, scale: _Scale) -> float:
    """Return the score of robust generalised cross-validation for `used` degrees of freedom of u and v."""
    share = used / scale.counts
    parts = np.log(np.maximum(misfit, scale.floor**2) / (1 - share) ** 2) + np.log(ROBUST + (1 - ROBUST) * share)
    return float(np.sum(scale.counts * parts) / np.sum(scale.counts))


def _left(curves: Sequence[Curves], stage: _Stage, order: int) -> float:
    """Return the RMS of what the equation leaves of the highest derivative of the splines, over that of this."""
    missed = objective(curves, stage.splines, stage.coefficients, stage.sigma, stage.weight)[2]
    whole = 0.0
    for one, splines in zip(curves, stage.splines, strict=True):
        rate = one.fields(splines, order)[order][..., one.record.stretches.dynamics.moving]
        whole += float(np.sum(one.measure[:, None, None] * rate**2))
    return float(np.sqrt(missed / whole if whole > 0 else missed))


def _smooth(curves: Curves, splines: ndarray) -> Smooth:
    """Evaluate the splines and their derivatives at the collocation points."""
    order = curves.record.stretches.dynamics.order
    return Smooth(curves.points, curves.measure, np.stack(curves.fields(splines, order)))


METHODS = (Splines,)
