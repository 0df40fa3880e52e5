"""The networks of several members on a device, and the Gauss-Newton equations of their weights, computed together.

The objective and its equations are those of `trained_curve` beside this file, which has them for one network on the
processor. Members have the same samples' times and the same sizes, and each its own samples and weights. Here, in place
of a singular value decomposition, which devices take one matrix at a time, the units are made orthonormal by a QR
decomposition with CUT times the identity below them: it holds combinations down that are round-off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from latticebench.methods.engine.networks.block_band import factor_band
from latticebench.methods.engine.networks.equation import CurveEquation, curve_equation
from latticebench.methods.engine.networks.hidden_layer import Layer, evaluate_layer
from latticebench.methods.engine.networks.trained_curve import CUT, RIDGE, TrainedCurve, Weights
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from numpy import ndarray

    from latticebench.methods.engine.networks.arrays import Array, Arrays


@dataclass(frozen=True, eq=False)
class CurveBatch:
    """The networks of one trajectory, one for each member, but for their weights.

    Attributes:
        curve: what they have in common.
        equation: of the library, on tensors.
        arrays: of the device.
        tau: collocation times, then sample times, scaled to [-1, 1] (P + T,).
        root: square roots of what each collocation time stands for (P, 1).
        value: the samples of u and v (members, levels, outputs, T), 0 where nothing was observed.
        seen: whether they were observed, as 1 and 0 (levels, outputs, T).
    """

    curve: TrainedCurve
    equation: CurveEquation
    arrays: Arrays
    tau: Array
    root: Array
    value: Array
    seen: Array

    @property
    def points(self) -> int:
        """The number P of collocation times."""
        return len(self.curve.points)

    def layer(self, theta: Array) -> Layer:
        """Evaluate the hidden layers (3, members, P + T, K)."""
        return evaluate_layer(self.curve.activation, theta, self.tau, self.curve.half, self.arrays.xp)

    def missed(self, layer: Layer, a: Array) -> Array:
        """Return the samples less the networks (members, levels, outputs, T), also where nothing was observed."""
        levels = self.value.shape[1]
        fitted = [(layer.levels[level][:, self.points :] @ a).mT for level in range(levels)]
        return self.value - self.arrays.xp.stack(fitted, 1)

    def law(self, layer: Layer, a: Array, xi: Array) -> tuple[list[Array], list[list[Array]], list[Any]]:
        """Return, by part, the residual (members, P, M) and the terms (J of them), and the slopes of their sum."""
        dynamics, equation = self.curve.record.stretches.dynamics, self.equation
        place = self.arrays.index(self.curve.place.T.ravel())
        fields = [(one[:, : self.points] @ a)[..., place] for one in layer.levels[: dynamics.order + 1]]
        terms, slopes = equation.evaluate(self.arrays.xp.concatenate(fields[:-1], axis=-1), xi)
        left, values = [], []
        for part in range(dynamics.parts):
            first = part * dynamics.sites + equation.inner.start
            rate = fields[-1][..., first : first + equation.width]
            # A term may be a plain number.
            values.append([rate * 0 + one for one in terms[part]])
            left.append(rate - sum(xi[:, k, None, None] * one for k, one in enumerate(values[-1])))
        return left, values, slopes

    def misfits(self, weights: Weights, xi: Array) -> tuple[Array, Array, Array]:
        """Return `trained_curve.Misfits` of each member: (members, levels), (members,) and (members,)."""
        layer = self.layer(weights.theta)
        samples = (self.seen * self.missed(layer, weights.a) ** 2).sum((-2, -1))
        left, _, _ = self.law(layer, weights.a, xi)
        law = sum(((one * self.root) ** 2).sum((-2, -1)) for one in left)
        return samples, law, ((weights.a / self.curve.decay) ** 2).sum((-2, -1))


def curve_batch(curve: TrainedCurve, samples: Samples, library: Library, value: ndarray, arrays: Arrays) -> CurveBatch:
    """Move the networks of one trajectory to a device.

    Args:
        curve: the network.
        samples: the trajectory that it follows.
        library: the terms.
        value: each member's samples, as `TrainedCurve.value` has them (members, levels, outputs, T).
        arrays: of the device.
    """
    order = curve.record.stretches.dynamics.order
    equation = curve_equation(samples, library, order, curve.points, arrays)
    move = arrays.move
    root = move(np.sqrt(curve.measure)[:, None])
    return CurveBatch(curve, equation, arrays, move(curve.tau), root, move(value), move(curve.seen))


@dataclass(eq=False)
class _Sums:
    """As `trained_curve` has them, with an axis of members in front."""

    band: Array
    border: Array
    corner: Array
    right: Array
    aim: Array
    numbers: int


class BatchEquations(NamedTuple):
    """The linear algebra of one Gauss-Newton step, as `trained_curve.StepEquations` has it, of each member.

    Attributes:
        sound: whether the matrix of the output weights is positive (members,).
    """

    divide: Callable[[Array], Array]
    own: Array
    across: Array
    schur: Array
    aim: Array
    damped: Array
    turn: Array
    rows: Array
    sound: Array

    def freedom(self, batch: CurveBatch, sigma: Array, signs: Array) -> Array:
        """Estimate the degrees of freedom that the networks take from u and v (members, levels).

        Args:
            batch: the networks.
            sigma: noise of u and v (levels,).
            signs: random signs (levels, outputs, T, probes).
        """
        traces = []
        for level, probe in enumerate(signs):
            # (members, 1, r, T) @ (outputs, T, probes)
            pulled = self.rows[level][:, None].mT @ (probe * batch.seen[level][..., None] / sigma[level])
            flat = pulled.reshape(len(pulled), -1, probe.shape[-1])
            traces.append((flat * self.divide(flat)).sum((-2, -1)) / probe.shape[-1])
        return batch.arrays.xp.stack(traces, -1)


def batch_equations(
    batch: CurveBatch, weights: Weights, xi: Array, sigma: Array, weight: float, *, train: bool
) -> BatchEquations:
    """Set up the Gauss-Newton step of each member; see `trained_curve.step_equations`."""
    arrays, xp, points = batch.arrays, batch.arrays.xp, batch.points
    layer = batch.layer(weights.theta)
    members, units, outputs = weights.a.shape
    shown = layer.levels[0, :, :points] * batch.root
    held = CUT * xp.sqrt((shown**2).sum((-2, -1)))[:, None, None] * arrays.move(np.eye(units))
    triangle = xp.linalg.qr(xp.concatenate([shown, held], axis=1), mode="r")[1]
    turn = xp.linalg.solve_triangular(triangle, arrays.move(np.eye(units)).expand_as(triangle), upper=True)
    numbers = weights.theta.shape[-1] if train else 0
    last = numbers + xi.shape[-1]
    sums = _Sums(
        arrays.zeros(members, outputs, batch.curve.blocks, units, units), arrays.zeros(members, outputs, units, last),
        arrays.zeros(members, last, last), arrays.zeros(members, outputs, units), arrays.zeros(members, last), numbers,
    )  # fmt: skip
    layer = layer if train else Layer(layer.levels, ())
    functions = layer.levels @ turn
    _add_samples(sums, batch, layer, functions, weights.a, sigma)
    _add_law(sums, batch, layer, functions, weights.a, xi, weight)
    sums.band[:, :, 0] += (turn.mT @ turn / batch.curve.decay**2)[:, None]
    sums.right -= (turn.mT @ weights.a).mT / batch.curve.decay**2
    border = sums.border.reshape(members, -1, last)
    divide, sound = factor_band(sums.band, arrays, RIDGE)
    solved = divide(xp.concatenate([border, sums.right.reshape(members, -1, 1)], axis=-1))
    across, own = solved[..., :-1], solved[..., -1]
    damped = xp.diagonal(sums.corner, 0, -2, -1)[:, :numbers]
    return BatchEquations(
        divide, own, across, sums.corner - border.mT @ across, sums.aim - (border.mT @ own[..., None])[..., 0], damped,
        turn, functions[: len(sigma), :, points:], sound,
    )  # fmt: skip


def _add_samples(sums: _Sums, batch: CurveBatch, layer: Layer, functions: Array, a: Array, sigma: Array) -> None:
    """Add the samples' rows."""
    points, numbers = batch.points, sums.numbers
    missed = batch.missed(layer, a)
    for level in range(len(sigma)):
        rows, share = functions[level, :, points:], batch.seen[level] / sigma[level] ** 2
        # (members, 1, r, T) scaled by (outputs, 1, T)
        sums.band[:, :, 0] += (rows[:, None].mT * share[:, None]) @ rows[:, None]
        scaled = share * missed[:, level]
        sums.right += scaled @ rows
        if not numbers:
            continue
        by_theta = batch.arrays.zeros(*missed[:, level].shape, numbers)
        for move in layer.moves:
            by_theta[..., move.numbers] += move.levels[level][:, None, points:] * a[:, move.units].mT[:, :, None]
        heavy = by_theta * share[..., None]
        sums.border[..., :numbers] += rows[:, None].mT @ heavy
        flat = heavy.flatten(1, 2)
        sums.corner[:, :numbers, :numbers] += by_theta.flatten(1, 2).mT @ flat
        sums.aim[:, :numbers] += (flat.mT @ missed[:, level].flatten(1)[..., None])[..., 0]


def _add_law(
    sums: _Sums, batch: CurveBatch, layer: Layer, functions: Array, a: Array, xi: Array, weight: float
) -> None:
    """Add the rows of the equation, of all sites at once."""
    curve, arrays, points = batch.curve, batch.arrays, batch.points
    dynamics = curve.record.stretches.dynamics
    left, values, slopes = batch.law(layer, a, xi)
    root = weight**0.5 * batch.root
    r = functions.shape[-1]
    for part in range(dynamics.parts):
        # What the residual reads: by offset and part of the field, the levels of its motion with their slopes.
        here = (0,) * len(dynamics.stencil.shape)
        read: dict[tuple[Any, int], list[tuple[int, Any]]] = {(here, part): [(dynamics.order, 1.0)]}
        for (own, slot), slope in zip(batch.equation.terms.slopes, slopes, strict=True):
            if own == part:
                level, source = slot.place
                factor = arrays.move(dynamics.stencil.neighbours(slot.vector)[1])
                read.setdefault((slot.vector, source), []).append((level, -slope * factor))
        first = len(read) * r
        rows = arrays.zeros(len(a), dynamics.count, points, first + sums.aim.shape[-1])
        outputs = []
        for block, ((offset, source), pieces) in enumerate(read.items()):
            outputs.append(curve.place[dynamics.stencil.neighbours(offset)[0], source])
            own_weights = a[:, :, arrays.index(outputs[-1])]
            for level, slope in pieces:
                share = ((left[part] * 0 + slope) * root).mT[..., None]
                rows[..., block * r : (block + 1) * r] += share * functions[level][:, None, :points]
                for move in layer.moves:
                    numbers = slice(first + move.numbers.start, first + move.numbers.stop)
                    moved = move.levels[level][:, None, :points] * own_weights[:, move.units].mT[:, :, None]
                    rows[..., numbers] += share * moved
        for term, value in enumerate(values[part]):
            rows[..., first + sums.numbers + term] -= (value * root).mT
        _add_rows(sums, rows, -(left[part] * root).mT, outputs, arrays)


def _add_rows(sums: _Sums, rows: Array, target: Array, outputs: Sequence[ndarray], arrays: Arrays) -> None:
    """Add the products of rows (members, M, P, blocks * r + numbers + J); their blocks belong to outputs (M,) each."""
    members, count, diagonals, r, _ = sums.band.shape
    first = len(outputs) * r
    product = rows.mT @ rows
    pulled = (rows.mT @ target[..., None])[..., 0]
    sums.corner += product[:, :, first:, first:].sum(1)
    sums.aim += pulled[..., first:].sum(1)
    band = sums.band.view(members, count * diagonals, r, r)
    for i, lower in enumerate(outputs):
        own, places = slice(i * r, (i + 1) * r), arrays.index(lower)
        # Several parts may have the same place, as at a free end, where a neighbour is the site itself.
        sums.right.index_add_(1, places, pulled[..., own])
        sums.border.index_add_(1, places, product[:, :, own, first:])
        for j, upper in enumerate(outputs):
            below = np.flatnonzero(lower >= upper)
            where = arrays.index(upper[below] * diagonals + (lower - upper)[below])
            band.index_add_(1, where, product[:, arrays.index(below), own, j * r : (j + 1) * r])
