"""Networks that are trained while the equation stiffens: Gauss-Newton steps in all weights, weight by weight.

The weight W of the equation grows tenfold from stage to stage, each of which starts where the last ended. The noise of
u and v is estimated after each stage from what the networks leave of the samples and from the degrees of freedom that
they take. A stage is admitted whose robust cross-validation score (Lukas, Inverse Problems 22, 1883 (2006)) exceeds the
least by little, and whose networks are not stiffer than a motion, which is as free as its initial state. Of those the
first is taken in which the coefficients stand still, in units of their standard errors, or else the one in which they
moved least (quasi-optimality: Tikhonov & Glasko, USSR Comput. Math. Math. Phys. 5(3), 93 (1965)): with a smaller weight
the samples' noise would move them, with a larger one what the network cannot follow.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.networks.trained_curve import (
    StepEquations,
    TrainedCurve,
    Weights,
    step_equations,
)
from latticebench.methods.engine.shooting import LEAST_NOISE

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

PROBES = 16
# Robust cross-validation counts freedom more than plain one, which sometimes lets a network follow the noise.
ROBUST = 0.3
# A stage is admitted with a score up to this above the least; the last stage has one this far above it.
RISE = 0.01
LAST = 0.3
# Share of the freedom of an initial state below which networks are too stiff to follow a motion.
STIFF = 0.9
# A stage has not ended while a step lowers the objective, twice a likelihood, by more than this.
GAIN = 0.1
# What the weight is divided by before networks follow other samples.
SOFTER = 1e4
# Damping of the hidden layer at the start, and as far as it is raised.
DAMPING = 1e-4
MAX_DAMPING = 1e4


@dataclass(frozen=True)
class Training:
    """How networks are trained.

    Attributes:
        stages: largest number of weights W.
        steps: largest number of Gauss-Newton steps per weight.
        tolerance: a stage ends when no coefficient moves by more than this share of its standard error.
        train: whether the hidden layer is trained.
    """

    stages: int
    steps: int
    tolerance: float
    train: bool


@dataclass(frozen=True, eq=False)
class Stage:
    """The minimum for one weight.

    Attributes:
        weight: W of the equation.
        weights: of each network.
        coefficients: xi.
        sigma: noise of u and v.
        covariance: of xi.
        law: mean over time of the squares of the residual, summed over sites and parts.
        score: of cross-validation.
        moved: largest change of a coefficient since the last weight, in standard errors; infinite where nothing tells.
    """

    weight: float
    weights: tuple[Weights, ...]
    coefficients: Float[ndarray, " terms"]
    sigma: Float[ndarray, " levels"]
    covariance: Float[ndarray, "terms terms"]
    law: float = math.inf
    score: float = math.inf
    moved: float = math.inf


@dataclass(frozen=True, eq=False)
class Reached:
    """Where the steps with one weight ended.

    Attributes:
        stage: the minimum, without score.
        samples: sums of squares that are left of u and v.
        freedom: function that estimates the degrees of freedom that the networks take from u and v, from the noise of
            both and random signs (levels, outputs, T, probes) for each network.
        steps: how many were taken.
    """

    stage: Stage
    samples: Float[ndarray, " levels"]
    freedom: Callable[[ndarray, Sequence[ndarray]], Float[ndarray, " levels"]]
    steps: int


Minimise = Callable[[Sequence[TrainedCurve], Stage, Training], "Reached | None"]


def first_stage(curves: Sequence[TrainedCurve], weights: Sequence[Weights], coefficients: ndarray) -> Stage:
    """Return the start with its noise, and with a weight that trusts the equation as little as the start deserves."""
    counts, height = _counts(curves), _height(curves)
    misfits = [curve.misfits(one, coefficients) for curve, one in zip(curves, weights, strict=True)]
    sigma = np.sqrt(sum((one.samples for one in misfits), np.zeros(len(counts))) / counts)
    left = sum(one.law for one in misfits)
    weight = float(np.sum(counts)) / left if left > 0 and np.isfinite(left) else 1.0
    unknown = np.full((len(coefficients),) * 2, np.nan)
    return Stage(weight, tuple(weights), coefficients, np.maximum(sigma, 1e-6 * height), unknown, left)


def stiffen(
    curves: Sequence[TrainedCurve], start: Stage, training: Training, draw: np.random.Generator, minimise: Minimise
) -> tuple[Stage | None, list[tuple[float, float, ndarray]]]:
    """Raise the weight from stage to stage.

    Args:
        curves: the networks.
        start: where they are.
        training: how they are trained.
        draw: of the random signs.
        minimise: takes the steps with one weight: `minimise` below, or that of a device.

    Returns:
        the stage that is taken, None where not even the first can be solved; and time (of `time.perf_counter`), score
        and coefficients after each stage.
    """
    counts, height = _counts(curves), _height(curves)
    signs = [draw.choice([-1.0, 1.0], size=(*curve.value.shape, PROBES)) for curve in curves]
    admitted: list[Stage] = []
    path = []
    now = start
    for _ in range(training.stages):
        reached = minimise(curves, now, training)
        if reached is None or (admitted and not reached.steps):
            break
        used = reached.freedom(now.sigma, signs)
        if admitted and np.sum(used) < STIFF * sum(curve.states for curve in curves):
            break
        used = np.clip(used, 0.0, 0.99 * counts)
        stage = _judged(reached, now, used, counts, height)
        path.append((time.perf_counter(), stage.score, stage.coefficients))
        if math.isfinite(stage.moved) or not admitted:
            admitted.append(stage)
        if math.isfinite(stage.moved) and stage.score > min(one.score for one in admitted) + LAST:
            break
        # Without noise the coefficients may stand still while the score still falls.
        if stage.moved < training.tolerance and stage.score > now.score - RISE:
            break
        now = replace(stage, weight=stage.weight * 10)
    if not admitted:
        return None, path
    least = min(one.score for one in admitted)
    near = [one for one in admitted if one.score <= least + RISE]
    still = [one for one in near if one.moved < training.tolerance]
    return still[0] if still else min(near, key=lambda one: one.moved), path


def retrain(curves: Sequence[TrainedCurve], stage: Stage, training: Training) -> ndarray:
    """Return the coefficients of networks that are trained on other samples, with the noise and weight of a stage.

    Args:
        curves: the networks, with the other samples.
        stage: where they start.
        training: how they are trained.
    """
    # A network that follows the equation closely cannot leave its motion; it is made softer first.
    now = replace(stage, weight=stage.weight / SOFTER)
    while now.weight <= 1.001 * stage.weight:
        reached = minimise(curves, now, training)
        if reached is None:
            break
        now = replace(reached.stage, weight=now.weight * 10)
    return now.coefficients


def _judged(reached: Reached, before: Stage, used: ndarray, counts: ndarray, height: ndarray) -> Stage:
    """Give a stage its noise, score and movement, from the degrees of freedom of u and v that the networks take."""
    floor, share, stage = LEAST_NOISE * height, used / counts, reached.stage
    parts = np.log(np.maximum(reached.samples, floor**2) / (1 - share) ** 2) + np.log(ROBUST + (1 - ROBUST) * share)
    # While the networks have many degrees of freedom, what they leave says little about the noise.
    spread = np.maximum(np.sqrt(reached.samples / (counts - used)), floor)
    error = np.sqrt(np.maximum(np.diag(stage.covariance), 1e-300))
    moved = float(np.max(np.abs(stage.coefficients - before.coefficients) / error))
    return replace(
        stage,
        sigma=np.where(used < 0.5 * counts, spread, before.sigma),
        score=float(np.sum(counts * parts) / np.sum(counts)),
        moved=moved if np.sum(used) < 0.5 * np.sum(counts) else math.inf,
    )


def minimise(curves: Sequence[TrainedCurve], start: Stage, training: Training) -> Reached | None:
    """Take Levenberg-Marquardt steps with one weight; None where the linear algebra breaks down."""
    stage, damping, count = start, DAMPING, 0
    now, samples, law = _objective(curves, stage.weights, stage)
    equations: list[StepEquations] = []
    while count < training.steps:
        try:
            equations = [
                step_equations(curve, one, stage.coefficients, stage.sigma, stage.weight, train=training.train)
                for curve, one in zip(curves, stage.weights, strict=True)
            ]
        except np.linalg.LinAlgError:
            return None
        while True:
            trial = _stepped(stage, equations, damping)
            then, further, left = _objective(curves, trial.weights, trial)
            lower = bool(np.isfinite(then)) and then <= now * (1 + 1e-9)
            damping = max(damping / 10, 1e-9) if lower else max(damping * 10, 1e-6)
            if lower or damping > MAX_DAMPING:
                break
        if not lower:
            # The covariance is that of the point, not of the damped step.
            stage = replace(stage, covariance=_stepped(stage, equations, 0.0).covariance, law=law)
            break
        change, gained = np.abs(trial.coefficients - stage.coefficients), now - then
        stage, samples, now, law, count = replace(trial, law=left), further, then, left, count + 1
        error = np.sqrt(np.maximum(np.diag(stage.covariance), 1e-300))
        if np.max(change / error) < training.tolerance and gained < GAIN:
            break

    def freedom(sigma: ndarray, signs: Sequence[ndarray]) -> ndarray:
        trio = zip(curves, equations, signs, strict=True)
        return np.asarray(np.sum([step.freedom(curve, sigma, probe) for curve, step, probe in trio], axis=0))

    return Reached(stage, samples, freedom, count)


def _objective(
    curves: Sequence[TrainedCurve], weights: Sequence[Weights], stage: Stage
) -> tuple[float, Float[ndarray, " levels"], float]:
    """Return the objective, the sums of squares that are left of u and v, and that of the residual."""
    with np.errstate(all="ignore"):
        misfits = [curve.misfits(one, stage.coefficients) for curve, one in zip(curves, weights, strict=True)]
        samples = sum((one.samples for one in misfits), np.zeros(len(stage.sigma)))
        law = sum(one.law for one in misfits)
        total = float(np.sum(samples / stage.sigma**2)) + stage.weight * law + sum(one.decay for one in misfits)
    return total, samples, law


def _stepped(stage: Stage, equations: Sequence[StepEquations], damping: float) -> Stage:
    """Take a step, with the movement of the hidden layers damped; coefficients are eliminated last."""
    terms = len(stage.coefficients)
    schur, aim = np.zeros((terms, terms)), np.zeros(terms)
    inner = []
    for one in equations:
        numbers = len(one.damped)
        matrix = one.schur[:numbers, :numbers] + np.diag(damping * one.damped + 1e-300)
        right = np.column_stack([one.schur[:numbers, numbers:], one.aim[:numbers]])
        solved = np.linalg.lstsq(matrix, right, rcond=1e-15)[0] if numbers else right
        inner.append(solved)
        schur += one.schur[numbers:, numbers:] - one.schur[numbers:, :numbers] @ solved[:, :-1]
        aim += one.aim[numbers:] - one.schur[numbers:, :numbers] @ solved[:, -1]
    scale = 1 / np.sqrt(np.maximum(np.diag(schur), 1e-300))
    covariance = np.linalg.pinv(schur * scale * scale[:, None], rcond=1e-13, hermitian=True) * scale * scale[:, None]
    change = covariance @ aim
    moved = []
    for weights, one, solved in zip(stage.weights, equations, inner, strict=True):
        step = solved[:, -1] - solved[:, :-1] @ change
        b = one.own - one.across @ np.concatenate([step, change])
        theta = weights.theta + step if len(step) else weights.theta
        moved.append(Weights(theta, weights.a + one.turn @ b.reshape(weights.a.shape[1], -1).T))
    return replace(
        stage, weights=tuple(moved), coefficients=stage.coefficients + change, covariance=np.asarray(covariance)
    )


def _counts(curves: Sequence[TrainedCurve]) -> Float[ndarray, " levels"]:
    """Return how many numbers of u and of v were observed."""
    counts = np.sum([np.sum(curve.seen, axis=(1, 2)) for curve in curves], axis=0)
    return np.asarray(np.maximum(counts, 1), dtype=float)


def _height(curves: Sequence[TrainedCurve]) -> Float[ndarray, " levels"]:
    """Return the root mean squares of u and v, none of which counts as 0."""
    squares = np.sum([np.sum(curve.value**2, axis=(1, 2)) for curve in curves], axis=0)
    height = np.sqrt(squares / _counts(curves))
    return np.asarray(np.maximum(height, max(1e-6 * float(np.max(height)), 1e-30)))
