"""A network of time as the motion of a chain, and the Gauss-Newton equations of all its weights.

One hidden layer with the numbers theta (`hidden_layer` beside this file) is shared by all outputs,

    u_o(t) = sum_k a_ok phi_k(t; theta),   du_o/dt = sum_k a_ok dphi_k/dt,   and so on,

one output o per site and part. Output weights a, theta and the coefficients xi minimise together

    sum (u - data)^2 / sigma_u^2 + sum (du/dt - data)^2 / sigma_v^2 + W * mean over collocation points of |residual|^2
    + sum (a / decay)^2,      residual = d^order u_n/dt^order - sum_j xi_j T_j

All derivatives are exact. The units are combined by a singular value decomposition into functions that are orthonormal
on the collocation points, anew at each step, which keeps the equations well conditioned however redundant the units
are. Output weights of far sites meet in no residual, so that their matrix is a band; they are eliminated first, theta
and xi, few and dense, last (variable projection: Golub & Pereyra, SIAM J. Numer. Anal. 10, 413 (1973); for networks
with unknown coefficients Dong & Wang, arXiv 2210.04338).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from latticebench.methods.engine.networks.hidden_layer import Activation, Layer, evaluate_layer
from latticebench.methods.engine.record import Record
from latticebench.methods.method import Smooth

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray

# Combinations of units below this share of the largest are round-off.
CUT = 1e-10
# Added to the scaled diagonal of the band.
RIDGE = 1e-14


class Weights(NamedTuple):
    """The weights of one network, or on a device of several: with an axis of members in front.

    Attributes:
        theta: the hidden layer's numbers.
        a: the output layer's (K, outputs), in the order in which `TrainedCurve.place` has them.
    """

    theta: Float[ndarray, " number"]
    a: Float[ndarray, "unit output"]


class Misfits(NamedTuple):
    """The parts of the objective, without their weights.

    Attributes:
        samples: sums of squares of u and of v.
        law: mean over time of the squares of the residual, summed over sites and parts.
        decay: sum of (a / decay)^2.
    """

    samples: Float[ndarray, " levels"]
    law: float
    decay: float


@dataclass(frozen=True, eq=False)
class TrainedCurve:
    """The network of one trajectory, but for its weights.

    Attributes:
        record: the data and the equation.
        activation: of the hidden units.
        points: collocation times (P,).
        measure: the share of the whole time that each stands for (P,).
        tau: collocation times, then sample times, scaled to [-1, 1] (P + T,).
        half: half the span of time.
        value: the samples of u and v (levels, outputs, T), 0 where nothing was observed.
        seen: whether they were observed, likewise.
        decay: size above which output weights are held down.
        place: the output of each site and part (sites, parts); sites that meet in a residual are near each other.
        blocks: number of diagonals of the band, in blocks of one output.
    """

    record: Record
    activation: Activation
    points: Float[ndarray, " point"]
    measure: Float[ndarray, " point"]
    tau: Float[ndarray, " time"]
    half: float
    value: Float[ndarray, "levels output time"]
    seen: Bool[ndarray, "levels output time"]
    decay: float
    place: Int[ndarray, "sites parts"]
    blocks: int

    @property
    def states(self) -> int:
        """The number of initial values that a motion of the chain has."""
        return self.record.stretches.dynamics.size

    def layer(self, theta: ndarray) -> Layer:
        """Evaluate the hidden layer at the collocation times, then at the sample times."""
        return evaluate_layer(self.activation, theta, self.tau, self.half)

    def fitted(self, layer: Layer, a: ndarray) -> Float[ndarray, "levels output time"]:
        """Return u and v at the sample times."""
        at = layer.levels[: len(self.value), len(self.points) :]
        return np.swapaxes(at @ a, 1, 2)

    def fields(self, layer: Layer, a: ndarray) -> Float[ndarray, "levels point parts sites"]:
        """Return u and its derivatives up to the equation's order at the collocation times."""
        dynamics, count = self.record.stretches.dynamics, len(self.points)
        flat = layer.levels[: dynamics.order + 1, :count] @ a
        return np.swapaxes(flat[..., self.place], 2, 3)

    def law(self, layer: Layer, a: ndarray, xi: ndarray, *, derivatives: bool) -> tuple[ndarray, ndarray, Any]:
        """Return the residual (P, parts, M), the terms (parts, J, P, M), and the slopes of the right-hand side."""
        stretches, fields, count = self.record.stretches, self.fields(layer, a), len(self.points)
        dynamics = stretches.dynamics
        order, moving, border = dynamics.order, dynamics.moving, dynamics.border
        state = np.moveaxis(fields[:order][..., moving], 0, 1).reshape(count, -1)
        driven = np.moveaxis(fields[:order][..., border], 0, 1) if len(border) else None
        f = None if stretches.inputs is None else stretches.inputs(self.points)
        rate, values, slopes = dynamics.linear(xi, self.points, state, f, driven, derivatives=derivatives)
        wanted = rate.reshape(count, order, dynamics.parts, dynamics.count)[:, -1]
        return fields[order][..., moving] - wanted, values, slopes

    def misfits(self, weights: Weights, xi: ndarray) -> Misfits:
        """Evaluate the parts of the objective."""
        layer = self.layer(weights.theta)
        missed = np.sum(self.seen * (self.value - self.fitted(layer, weights.a)) ** 2, axis=(1, 2))
        left, _, _ = self.law(layer, weights.a, xi, derivatives=False)
        law = float(np.sum(left**2 * self.measure[:, None, None]))
        return Misfits(missed, law, float(np.sum((weights.a / self.decay) ** 2)))

    def smooth(self, weights: Weights) -> Smooth:
        """Return the motion and its derivatives at the collocation times."""
        return Smooth(self.points, self.measure, self.fields(self.layer(weights.theta), weights.a))


def place_curve(record: Record, activation: Activation, count: int, decay: float) -> TrainedCurve:
    """Choose collocation times, those of Gauss and Legendre, and the order of the outputs in the band.

    Args:
        record: the trajectory.
        activation: of the hidden units.
        count: number of collocation times.
        decay: size above which output weights are held down.
    """
    dynamics, t = record.stretches.dynamics, record.times
    nodes, shares = np.polynomial.legendre.leggauss(count)
    middle, half = (t[0] + t[-1]) / 2, (t[-1] - t[0]) / 2
    # On a ring the sites are folded: first, last, second, last but one, and so on.
    order = np.arange(dynamics.sites)
    if dynamics.stencil.is_ring:
        order = np.minimum(2 * order, 2 * (dynamics.sites - order) - 1)
    place = order[:, None] * dynamics.parts + np.arange(dynamics.parts)
    value, seen = (
        np.transpose(one, (1, 3, 2, 0)).reshape(one.shape[1], -1, len(t))[:, np.argsort(place.ravel())]
        for one in (record.value, record.seen)
    )
    read = order[[dynamics.stencil.neighbours(offset)[0] for offset in dynamics.stencil.offsets]]
    blocks = int(np.max(np.ptp(read, axis=0)) + 1) * dynamics.parts
    tau = np.concatenate([nodes, (t - middle) / half])
    return TrainedCurve(
        record, activation, middle + half * nodes, shares / 2, tau, float(half), value, seen, decay, place, blocks
    )


@dataclass(eq=False)
class _Sums:
    """Sums of products of the residuals' derivatives, as rows are added.

    Attributes:
        band: by two outputs' weights (outputs, blocks, r, r); band[o, d] is that of outputs o + d and o.
        border: by an output's weights and by theta and xi (outputs, r, numbers + J).
        corner: by theta and xi.
        right, aim: right-hand sides.
        numbers: how many of theta are among them.
    """

    band: ndarray
    border: ndarray
    corner: ndarray
    right: ndarray
    aim: ndarray
    numbers: int


@dataclass(frozen=True, eq=False)
class StepEquations:
    """The linear algebra of one Gauss-Newton step for one network.

    Attributes:
        divide: function that divides by the matrix of the output weights.
        own, across: the output weights b move by own - across @ (change of theta and xi).
        schur, aim: the equations of theta and xi, with the output weights eliminated.
        damped: the diagonal of the equations of theta before that, by which its damping is scaled.
        turn: from the orthonormal functions' weights to those of the units (K, r).
        rows: the orthonormal functions at the sample times (levels, T, r).
    """

    divide: Callable[[ndarray], ndarray]
    own: ndarray
    across: ndarray
    schur: ndarray
    aim: ndarray
    damped: ndarray
    turn: ndarray
    rows: ndarray

    def freedom(self, curve: TrainedCurve, sigma: ndarray, signs: ndarray) -> Float[ndarray, " levels"]:
        """Estimate the degrees of freedom that the network takes from u and v (Hutchinson's trace).

        Args:
            curve: the network.
            sigma: noise of u and v.
            signs: random signs (levels, outputs, T, probes).
        """
        traces = []
        for rows, seen, size, probe in zip(self.rows, curve.seen, sigma, signs, strict=True):
            pulled = np.einsum("ti,otk->oik", rows, probe * seen[..., None] / size)
            flat = pulled.reshape(-1, probe.shape[-1])
            traces.append(float(np.sum(flat * self.divide(flat))) / probe.shape[-1])
        return np.array(traces)


def step_equations(
    curve: TrainedCurve, weights: Weights, xi: ndarray, sigma: ndarray, weight: float, *, train: bool
) -> StepEquations:
    """Set up the Gauss-Newton step of one network.

    Args:
        curve: the network.
        weights: where it is.
        xi: coefficients (J,).
        sigma: noise of u and v.
        weight: W of the equation.
        train: whether theta moves.

    Raises:
        LinAlgError: the matrix of the output weights is not positive.
    """
    layer, points = curve.layer(weights.theta), len(curve.points)
    _, size, modes = np.linalg.svd(np.sqrt(curve.measure)[:, None] * layer.levels[0, :points], full_matrices=False)
    kept = size > CUT * size[0]
    turn = modes[kept].T / size[kept]
    outputs, r, numbers = curve.place.size, turn.shape[1], len(weights.theta) if train else 0
    last = numbers + len(xi)
    sums = _Sums(
        np.zeros((outputs, curve.blocks, r, r)), np.zeros((outputs, r, last)), np.zeros((last, last)),
        np.zeros((outputs, r)), np.zeros(last), numbers,
    )  # fmt: skip
    layer = layer if train else Layer(layer.levels, ())
    functions = layer.levels @ turn
    _add_samples(sums, curve, layer, functions, weights.a, sigma)
    _add_law(sums, curve, layer, functions, weights.a, xi, weight)
    sums.band[:, 0] += turn.T @ turn / curve.decay**2
    sums.right -= (turn.T @ weights.a).T / curve.decay**2
    return _eliminated(sums, turn, functions[: len(sigma), points:])


def _add_samples(
    sums: _Sums, curve: TrainedCurve, layer: Layer, functions: ndarray, a: ndarray, sigma: ndarray
) -> None:
    """Add the samples' rows."""
    points, numbers = len(curve.points), sums.numbers
    missed = curve.value - curve.fitted(layer, a)
    for level, size in enumerate(sigma):
        rows, share = functions[level, points:], curve.seen[level] / size**2
        if np.all(curve.seen[level]):
            sums.band[:, 0] += rows.T @ rows / size**2
        else:
            sums.band[:, 0] += np.matmul(rows.T * share[:, None], rows)
        sums.right += (share * missed[level]) @ rows
        if not numbers:
            continue
        by_theta = np.zeros((len(share), len(rows), numbers))
        for move in layer.moves:
            by_theta[..., move.numbers] += move.levels[level, points:] * a[move.units].T[:, None]
        scaled = by_theta * share[..., None]
        sums.border[..., :numbers] += np.matmul(rows.T, scaled)
        flat = scaled.reshape(-1, numbers)
        sums.corner[:numbers, :numbers] += by_theta.reshape(-1, numbers).T @ flat
        sums.aim[:numbers] += flat.T @ missed[level].ravel()


def _add_law(
    sums: _Sums, curve: TrainedCurve, layer: Layer, functions: ndarray, a: ndarray, xi: ndarray, weight: float
) -> None:
    """Add the rows of the equation, of all sites at once."""
    dynamics, points = curve.record.stretches.dynamics, len(curve.points)
    left, values, slopes = curve.law(layer, a, xi, derivatives=True)
    root = np.sqrt(weight * curve.measure)[:, None]
    r = functions.shape[-1]
    for part in range(dynamics.parts):
        # What the residual reads: by offset and part of the field, the levels of its motion with their slopes.
        here = (0,) * len(dynamics.stencil.shape)
        read: dict[tuple[Any, int], list[tuple[int, Any]]] = {(here, part): [(dynamics.order, 1.0)]}
        for (own, slot), slope in slopes.items():
            if own == part:
                level, source = slot.place
                factor = dynamics.stencil.neighbours(slot.vector)[1]
                read.setdefault((slot.vector, source), []).append((level, -slope * factor))
        first = len(read) * r
        rows = np.zeros((dynamics.count, points, first + len(sums.aim)))
        outputs = []
        for block, ((offset, source), pieces) in enumerate(read.items()):
            outputs.append(curve.place[dynamics.stencil.neighbours(offset)[0], source])
            own_weights = a[:, outputs[-1]]
            for level, slope in pieces:
                share = (np.broadcast_to(slope, left[:, part].shape) * root).T[..., None]
                rows[..., block * r : (block + 1) * r] += share * functions[level, :points]
                for move in layer.moves:
                    numbers = slice(first + move.numbers.start, first + move.numbers.stop)
                    rows[..., numbers] += share * (move.levels[level, :points] * own_weights[move.units].T[:, None])
        rows[..., first + sums.numbers :] -= np.transpose(values[part] * root, (2, 1, 0))
        _add_rows(sums, rows, -(left[:, part] * root).T, outputs)


def _add_rows(sums: _Sums, rows: ndarray, target: ndarray, outputs: Sequence[ndarray]) -> None:
    """Add the products of rows (M, P, blocks * r + numbers + J), whose blocks belong to given outputs (M,) each."""
    r = sums.right.shape[1]
    first = len(outputs) * r
    transposed = np.swapaxes(rows, 1, 2)
    product = np.matmul(transposed, rows)
    pulled = np.matmul(transposed, target[..., None])[..., 0]
    sums.corner += np.sum(product[:, first:, first:], axis=0)
    sums.aim += np.sum(pulled[:, first:], axis=0)
    for i, lower in enumerate(outputs):
        own = slice(i * r, (i + 1) * r)
        _add_at(sums.right, (lower,), pulled[:, own])
        _add_at(sums.border, (lower,), product[:, own, first:])
        for j, upper in enumerate(outputs):
            below = lower >= upper
            place = upper[below], (lower - upper)[below]
            _add_at(sums.band, place, product[below, own, j * r : (j + 1) * r])


def _add_at(total: ndarray, place: tuple[ndarray, ...], parts: ndarray) -> None:
    """Add each part at its place; several may have the same, as at a free end, where a neighbour is the site itself."""
    if len(np.unique(np.column_stack(place), axis=0)) == len(parts):
        # Some ten times as fast.
        total[place] += parts
    else:
        np.add.at(total, place, parts)


def _eliminated(sums: _Sums, turn: ndarray, rows: ndarray) -> StepEquations:
    """Eliminate the output weights."""
    last = len(sums.aim)
    divide = _band_factor(sums.band)
    border = sums.border.reshape(-1, last)
    solved = divide(np.column_stack([border, sums.right.ravel()]))
    across, own = solved[:, :-1], solved[:, -1]
    return StepEquations(
        divide, own, across, sums.corner - border.T @ across, sums.aim - border.T @ own,
        np.diag(sums.corner)[: sums.numbers].copy(), turn, rows,
    )  # fmt: skip


def _band_factor(blocks: ndarray) -> Callable[[ndarray], ndarray]:
    """Factor a positive matrix given by blocks (outputs, diagonals, r, r); return the function that divides by it."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    outputs, diagonals, r, _ = blocks.shape
    band = np.zeros((diagonals * r, outputs * r))
    row, column = np.indices((r, r))
    first = np.arange(outputs)[:, None] * r
    for diagonal in range(diagonals):
        inside = row + diagonal * r >= column
        i, j = row[inside], column[inside]
        band[diagonal * r + i - j, first + j] = blocks[:, diagonal, i, j]

    # The diagonal is scaled to 1 before the factor, so that the ridge is the same for all.
    scale = 1 / np.sqrt(np.maximum(band[0], 1e-300))
    padded = np.concatenate([scale, np.zeros(len(band))])
    band *= scale * np.lib.stride_tricks.sliding_window_view(padded, len(scale))[: len(band)]
    band[0] += RIDGE
    lower = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)

    def divide(right: ndarray) -> ndarray:
        scaled = (right.T * scale).T
        return np.asarray((cho_solve_banded((lower, True), scaled, check_finite=False).T * scale).T)

    return divide
