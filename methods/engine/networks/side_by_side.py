"""Networks trained side by side on a device: the steps of `stiffening`, of all members at once.

One network is a batch of one. Each member has its own damping; one whose trial fails tries again while the others wait,
and one that has ended stays where it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from latticebench.methods.engine.networks.arrays import Arrays, host
from latticebench.methods.engine.networks.curve_batch import (
    BatchEquations,
    CurveBatch,
    batch_equations,
    curve_batch,
)
from latticebench.methods.engine.networks.stiffening import (
    DAMPING,
    GAIN,
    MAX_DAMPING,
    SOFTER,
    Reached,
    Stage,
    Training,
)
from latticebench.methods.engine.networks.trained_curve import TrainedCurve, Weights
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.networks.arrays import Array

# Bytes that the largest arrays of a batch may take; more members than that take their steps one batch after the other.
MEMORY = 8 * 2**30


class Point(NamedTuple):
    """Where the members are: the weights of each trajectory's networks, xi (members, J), and its covariance."""

    weights: tuple[Weights, ...]
    xi: Array
    covariance: Array


class Ended(NamedTuple):
    """Where the steps with one weight ended.

    Attributes:
        point: of the members.
        samples: sums of squares that are left of u and v (members, levels).
        law: that of the residual (members,).
        equations: the last step's, of each trajectory.
        steps: how many were taken (members,).
        sound: whether the linear algebra held (members,).
    """

    point: Point
    samples: Array
    law: Array
    equations: Sequence[BatchEquations]
    steps: Array
    sound: Array


@dataclass(frozen=True, eq=False)
class Device:
    """Where networks are trained, and what they are trained on.

    Attributes:
        arrays: of the device.
        data: the trajectories, one for each network of a member.
        library: the terms.
    """

    arrays: Arrays
    data: Sequence[Samples]
    library: Library

    def minimise(self, curves: Sequence[TrainedCurve], start: Stage, training: Training) -> Reached | None:
        """Take the steps of `stiffening.minimise` on the device."""
        batches = self._batches(curves, [curve.value[None] for curve in curves])
        sigma = self.arrays.move(start.sigma)
        ended = _minimise(batches, self._start(start, 1), sigma, start.weight, training)
        if not bool(ended.sound.all()):
            return None
        weights = tuple(Weights(host(one.theta)[0], host(one.a)[0]) for one in ended.point.weights)
        stage = replace(
            start, weights=weights, coefficients=host(ended.point.xi)[0], covariance=host(ended.point.covariance)[0],
            law=float(ended.law[0]),
        )  # fmt: skip

        def freedom(sigma: ndarray, signs: Sequence[ndarray]) -> ndarray:
            size, pairs = self.arrays.move(sigma), zip(batches, ended.equations, signs, strict=True)
            freed = [one.freedom(batch, size, self.arrays.move(probe)) for batch, one, probe in pairs]
            return np.asarray(np.sum([host(one)[0] for one in freed], axis=0))

        return Reached(stage, host(ended.samples)[0], freedom, int(ended.steps[0]))

    def retrain(
        self, curves: Sequence[TrainedCurve], stage: Stage, training: Training, values: Sequence[ndarray]
    ) -> Float[ndarray, "member terms"]:
        """Return the coefficients of members that are trained on other samples (`stiffening.retrain`).

        Args:
            curves: the networks.
            stage: where they start.
            training: how they are trained.
            values: the members' samples of each trajectory (members, levels, outputs, T).
        """
        members = len(values[0])
        at_once = max(1, min(members, int(MEMORY / max(_bytes(curve, len(stage.coefficients)) for curve in curves))))
        found = []
        for first in range(0, members, at_once):
            some = [value[first : first + at_once] for value in values]
            batches = self._batches(curves, some)
            point, weight = self._start(stage, len(some[0])), stage.weight / SOFTER
            going = point.xi[:, 0] == point.xi[:, 0]
            while weight <= 1.001 * stage.weight and bool(going.any()):
                ended = _minimise(batches, point, self.arrays.move(stage.sigma), weight, training)
                going = going & ended.sound
                point, weight = _chosen(self.arrays.xp, going, ended.point, point), weight * 10
            found.append(host(point.xi))
        return np.concatenate(found)

    def _batches(self, curves: Sequence[TrainedCurve], values: Sequence[ndarray]) -> list[CurveBatch]:
        return [
            curve_batch(curve, samples, self.library, value, self.arrays)
            for curve, samples, value in zip(curves, self.data, values, strict=True)
        ]

    def _start(self, stage: Stage, members: int) -> Point:
        """Put all members where a stage ended."""

        def copies(array: ndarray) -> Array:
            return self.arrays.move(np.repeat(array[None], members, axis=0))

        weights = tuple(Weights(copies(one.theta), copies(one.a)) for one in stage.weights)
        return Point(weights, copies(stage.coefficients), copies(stage.covariance))


def _bytes(curve: TrainedCurve, terms: int) -> float:
    """Return about how many bytes a member of a batch takes."""
    dynamics, units = curve.record.stretches.dynamics, 4 / 5 * len(curve.points)
    columns = (curve.blocks + 2) * units + units + terms
    rows = dynamics.count * columns * (len(curve.points) + columns)
    return 8 * (2 * rows + 3 * curve.place.size * curve.blocks * units**2)


def _minimise(batches: Sequence[CurveBatch], start: Point, sigma: Array, weight: float, training: Training) -> Ended:
    """Take Levenberg-Marquardt steps with one weight, as `stiffening.minimise` does."""
    arrays, xp = batches[0].arrays, batches[0].arrays.xp
    point = start
    now, samples, law = _objective(batches, point, sigma, weight)
    damping, steps = xp.zeros_like(now) + DAMPING, xp.zeros_like(now)
    active, sound = steps == 0, steps == 0
    equations: list[BatchEquations] = []
    while bool(active.any()):
        equations = [
            batch_equations(batch, one, point.xi, sigma, weight, train=training.train)
            for batch, one in zip(batches, point.weights, strict=True)
        ]
        for one in equations:
            sound = sound & (one.sound | ~active)
        trying = active = active & sound
        before, gained, found = point, now * 0, active & False
        while bool(trying.any()):
            trial = _stepped(arrays, before, equations, damping)
            then, further, left = _objective(batches, trial, sigma, weight)
            lower = trying & xp.isfinite(then) & (then <= now * (1 + 1e-9))
            damping = xp.where(lower, xp.clip(damping / 10, 1e-9, None), damping)
            damping = xp.where(trying & ~lower, xp.clip(damping * 10, 1e-6, None), damping)
            point, gained = _chosen(xp, lower, trial, point), xp.where(lower, now - then, gained)
            samples, law = xp.where(lower[:, None], further, samples), xp.where(lower, left, law)
            found = found | lower
            trying = trying & ~lower & (damping <= MAX_DAMPING)
        stuck = active & ~found
        if bool(stuck.any()):
            # The covariance is that of the point, not of the damped step.
            plain = _stepped(arrays, before, equations, damping * 0).covariance
            point = point._replace(covariance=xp.where(stuck[:, None, None], plain, point.covariance))
        now, steps = now - gained, steps + found
        error = xp.sqrt(xp.clip(xp.diagonal(point.covariance, 0, -2, -1), 1e-300, None))
        still = ((xp.abs(point.xi - before.xi) / error).amax(-1) < training.tolerance) & (gained < GAIN)
        active = found & ~still & (steps < training.steps)
    return Ended(point, samples, law, equations, steps, sound)


def _objective(batches: Sequence[CurveBatch], point: Point, sigma: Array, weight: float) -> tuple[Array, Array, Array]:
    """Return of each member what `stiffening` returns of one: objective, sums of squares of u and v, and residual."""
    parts = [batch.misfits(one, point.xi) for batch, one in zip(batches, point.weights, strict=True)]
    samples, law, decay = (sum(one) for one in zip(*parts, strict=True))
    return (samples / sigma**2).sum(-1) + weight * law + decay, samples, law


def _stepped(arrays: Arrays, point: Point, equations: Sequence[BatchEquations], damping: Array) -> Point:
    """Take a step of each member, with the movement of the hidden layers damped; coefficients are eliminated last."""
    xp = arrays.xp
    terms, inner = point.xi.shape[-1], []
    schur, aim = arrays.zeros(len(damping), terms, terms), arrays.zeros(len(damping), terms)
    for one in equations:
        n = one.damped.shape[-1]
        matrix = one.schur[:, :n, :n] + xp.diag_embed(damping[:, None] * one.damped)
        right = xp.concatenate([one.schur[:, :n, n:], one.aim[:, :n, None]], axis=-1)
        solved = _pseudo_inverse(arrays, matrix, 1e-15) @ right if n else right
        inner.append(solved)
        schur = schur + one.schur[:, n:, n:] - one.schur[:, n:, :n] @ solved[..., :-1]
        aim = aim + one.aim[:, n:] - (one.schur[:, n:, :n] @ solved[..., -1:])[..., 0]
    covariance = _pseudo_inverse(arrays, schur, 1e-13)
    change = (covariance @ aim[..., None])[..., 0]
    moved = []
    for weights, one, solved in zip(point.weights, equations, inner, strict=True):
        step = solved[..., -1] - (solved[..., :-1] @ change[..., None])[..., 0]
        b = one.own - (one.across @ xp.concatenate([step, change], axis=-1)[..., None])[..., 0]
        theta = weights.theta + step if step.shape[-1] else weights.theta
        moved.append(Weights(theta, weights.a + one.turn @ b.reshape(weights.a.mT.shape).mT))
    return Point(tuple(moved), point.xi + change, covariance)


def _pseudo_inverse(arrays: Arrays, matrix: Array, least: float) -> Array:
    """Invert symmetric matrices, scaled to a diagonal of 1, but for eigenvalues below `least` of the largest."""
    xp = arrays.xp
    scale = 1 / xp.sqrt(xp.clip(xp.diagonal(matrix, 0, -2, -1), 1e-300, None))
    scaled = xp.nan_to_num(matrix * scale[:, :, None] * scale[:, None, :])
    inverse = xp.linalg.pinv(scaled, rtol=least, hermitian=True)
    return inverse * scale[:, :, None] * scale[:, None, :]


def _chosen(xp: Any, which: Array, new: Point, old: Point) -> Point:
    """Return the new point of some members, and the old one of the others."""
    weights = tuple(
        Weights(xp.where(which[:, None], one.theta, other.theta), xp.where(which[:, None, None], one.a, other.a))
        for one, other in zip(new.weights, old.weights, strict=True)
    )
    covariance = xp.where(which[:, None, None], new.covariance, old.covariance)
    return Point(weights, xp.where(which[:, None], new.xi, old.xi), covariance)
