"""Curves through samples that are held to an equation at collocation points.

The motion of each site is a B-spline u_n(t) = sum_j c_nj B_j(t). The coefficients xi and the splines c minimise

    sum (u - data)^2 / sigma_u^2 + sum (du/dt - data)^2 / sigma_v^2 + W * mean over collocation points of |residual|^2,
    residual = d^order u_n/dt^order - sum_j xi_j T_j(u, du/dt)

The matrix of a Gauss-Newton step for the splines is banded in the order of time; the coefficients xi, few and dense,
are eliminated last. Sites without an equation, at unknown ends, are held by their samples and by a slight penalty on
roughness.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.bsplines import BSplines
from latticebench.methods.engine.record import Record

if TYPE_CHECKING:
    import scipy.sparse
    from jaxtyping import Float
    from numpy import ndarray

ROUGHNESS = 1e-6
RIDGE = 1e-13


@dataclass(frozen=True, eq=False)
class Curves:
    """The splines of one trajectory, and sparse maps from their coefficients to what is compared.

    The coefficients are ordered (j, part, site).

    Attributes:
        record: the data and the equation.
        basis: the B-splines, the same for all sites.
        points: collocation times (Q,).
        measure: the share of the whole time that each point stands for (Q,).
        levels: B_j and its first two derivatives at the points, each (Q, m).
        maps: from the coefficients to the observed numbers of u and of v.
        values: those numbers.
        rough: the penalty on sites without an equation, or None.
    """

    record: Record
    basis: BSplines
    points: Float[ndarray, " point"]
    measure: Float[ndarray, " point"]
    levels: tuple[Float[ndarray, "point splines"], ...]
    maps: tuple[scipy.sparse.csr_array, ...]
    values: tuple[ndarray, ...]
    rough: scipy.sparse.csr_array | None

    @functools.cached_property
    def grams(self) -> tuple[scipy.sparse.csr_array, ...]:
        """The maps' normal matrices, which no step changes."""
        return tuple(m.T @ m for m in self.maps)

    @property
    def each(self) -> int:
        """The number of coefficients per B-spline: parts * N."""
        return self.record.stretches.dynamics.parts * self.record.stretches.dynamics.sites

    def fields(self, splines: ndarray, highest: int) -> list[Float[ndarray, "point parts sites"]]:
        """Evaluate u and its derivatives up to the order `highest` at the collocation points."""
        dynamics = self.record.stretches.dynamics
        shape = (len(self.points), dynamics.parts, dynamics.sites)
        coefficients = splines.reshape(self.basis.count, -1)
        return [(level @ coefficients).reshape(shape) for level in self.levels[: highest + 1]]


def place_curves(record: Record, degree: int, density: float) -> Curves:
    """Choose knots and collocation points, two per knot interval, for one trajectory.

    Args:
        record: the trajectory.
        degree: of the B-splines.
        density: knot intervals per interval between samples.
    """
    import scipy.sparse

    dynamics = record.stretches.dynamics
    t = record.times
    intervals = max(2, round(density * (len(t) - 1)))
    edges = np.linspace(t[0], t[-1], intervals + 1)
    basis = BSplines.clamped(edges, degree)
    nodes, weights = np.polynomial.legendre.leggauss(2)
    half = (edges[1] - edges[0]) / 2
    points = ((edges[1:] + edges[:-1])[:, None] / 2 + half * nodes).ravel()
    measure = np.tile(weights * half, intervals) / (t[-1] - t[0])
    levels = tuple(basis.design(points, k) for k in range(3))
    identity = scipy.sparse.identity(dynamics.parts * dynamics.sites, format="csr")
    maps, values = [], []
    for level in range(record.value.shape[1]):
        seen = np.flatnonzero(record.seen[:, level].reshape(-1))
        at_samples = scipy.sparse.csr_array(basis.design(t, level))
        maps.append(scipy.sparse.csr_array(scipy.sparse.kron(at_samples, identity, format="csr")[seen]))
        values.append(record.value[:, level].reshape(-1)[seen])
    rough = None
    if len(dynamics.border):
        chosen = np.zeros((dynamics.parts, dynamics.sites))
        chosen[:, dynamics.border] = 1.0
        third = np.diff(np.eye(basis.count), 3, axis=0)
        rough = scipy.sparse.csr_array(
            scipy.sparse.kron(scipy.sparse.csr_array(third), scipy.sparse.diags_array(chosen.ravel()), format="csr")
        )
    return Curves(record, basis, points, measure, levels, tuple(maps), tuple(values), rough)


@dataclass(frozen=True, eq=False)
class Residuals:
    """The residuals of the equation along curves, and their derivatives.

    Attributes:
        value: (points * parts * moving sites,), each times the root of its share of time.
        by_spline: sparse (residuals, coefficients of the splines); None where it was not asked for.
        by_coefficient: (residuals, terms).
    """

    value: Float[ndarray, " residuals"]
    by_spline: Any
    by_coefficient: Float[ndarray, "residuals terms"]


def residuals(curves: Curves, splines: ndarray, coefficients: ndarray, *, derivatives: bool = True) -> Residuals:
    """Evaluate the residuals of the equation at the collocation points.

    Args:
        curves: of one trajectory.
        splines: their coefficients, ordered (j, part, site).
        coefficients: xi.
        derivatives: whether those by the splines are wanted.
    """
    stretches = curves.record.stretches
    dynamics = stretches.dynamics
    order, parts, count = dynamics.order, dynamics.parts, dynamics.count
    fields = curves.fields(splines, order)
    state = np.stack([one[..., dynamics.moving] for one in fields[:order]], axis=1).reshape(len(curves.points), -1)
    driven = np.stack([one[..., dynamics.border] for one in fields[:order]], axis=1) if len(dynamics.border) else None
    f = None if stretches.inputs is None else stretches.inputs(curves.points)
    rate, values, slopes = dynamics.linear(coefficients, curves.points, state, f, driven, derivatives=derivatives)
    root = np.sqrt(curves.measure)[:, None, None]
    wanted = rate.reshape(len(rate), order, parts, count)[:, -1]
    value = ((fields[order][..., dynamics.moving] - wanted) * root).ravel()
    by_coefficient = -(np.transpose(values, (2, 0, 3, 1)) * root[..., None]).reshape(-1, values.shape[1])
    by_spline = _by_spline(curves, slopes, splines.size) if derivatives else None
    return Residuals(value, by_spline, by_coefficient)


def _by_spline(curves: Curves, slopes: dict[Any, ndarray], size: int) -> Any:
    """Return the sparse derivative of the residuals by the splines, from that by each variable of the stencil."""
    import scipy.sparse

    dynamics = curves.record.stretches.dynamics
    parts, sites, count = dynamics.parts, dynamics.sites, dynamics.count
    # One block per variable: order of its time derivative, part of the equation, own part, sites, slope.
    blocks: list[tuple[int, int, int, ndarray, ndarray]] = [
        (dynamics.order, part, part, dynamics.stencil.own, np.ones((len(curves.points), count)))
        for part in range(parts)
    ]
    for (part, slot), slope in slopes.items():
        index, factor = dynamics.stencil.neighbours(slot.vector)
        weight = -np.broadcast_to(slope, (len(curves.points), count)) * factor
        blocks.append((int(slot.name == "v"), part, int(slot.part == "im"), index, weight))
    local = curves.basis.basis(curves.points)[0][:, None] + np.arange(curves.basis.degree + 1)
    at = np.arange(len(curves.points))
    rows, columns, data = [], [], []
    for level, part, source, site, weight in blocks:
        row = (at[:, None] * parts + part) * count + np.arange(count)
        column = (local[:, None, :] * parts + source) * sites + site[None, :, None]
        basis = curves.levels[level][at[:, None], local] * np.sqrt(curves.measure)[:, None]
        entry = weight[:, :, None] * basis[:, None, :]
        rows.append(np.broadcast_to(row[:, :, None], entry.shape).ravel())
        columns.append(np.broadcast_to(column, entry.shape).ravel())
        data.append(entry.ravel())
    return scipy.sparse.csr_array(
        (np.concatenate(data), (np.concatenate(rows), np.concatenate(columns))),
        shape=(len(curves.points) * parts * count, size),
    )


def objective(
    curves: Sequence[Curves], splines: Sequence[ndarray], coefficients: ndarray, sigma: ndarray, weight: float
) -> tuple[float, Float[ndarray, " levels"], float]:
    """Return the objective, the misfits of u and v, and the mean square of the residual."""
    misfit, left, rough = np.zeros(len(sigma)), 0.0, 0.0
    with np.errstate(all="ignore"):
        for one, c in zip(curves, splines, strict=True):
            misfit += [float(np.sum((y - m @ c) ** 2)) for m, y in zip(one.maps, one.values, strict=True)]
            left += float(np.sum(residuals(one, c, coefficients, derivatives=False).value ** 2))
            if one.rough is not None:
                rough += ROUGHNESS * float(np.sum((one.rough @ c) ** 2)) / sigma[0] ** 2
        return float(np.sum(misfit / sigma**2)) + weight * left + rough, misfit, left


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The linear algebra of one Gauss-Newton step for one trajectory.

    Attributes:
        divide: function that divides by the matrix of the splines.
        own, across: the splines move by own - across @ (change of xi).
        schur, aim: the normal equations of xi, schur @ (change of xi) = aim, with the splines eliminated.
    """

    divide: Callable[[ndarray], ndarray]
    own: ndarray
    across: ndarray
    schur: ndarray
    aim: ndarray

    def freedom(self, curves: Curves, sigma: ndarray, probe: ndarray) -> Float[ndarray, " levels"]:
        """Estimate the degrees of freedom that the splines take from u and v, by random signs (Hutchinson's trace).

        Args:
            curves: of the same trajectory.
            sigma: noise of u and v.
            probe: random signs (coefficients of the splines, probes).
        """
        traces = [
            float(np.sum(probe * self.divide(m.T @ (m @ probe) / size**2))) / probe.shape[1]
            for m, size in zip(curves.maps, sigma, strict=True)
        ]
        return np.array(traces)


def normal_equations(
    curves: Curves, splines: ndarray, coefficients: ndarray, sigma: ndarray, weight: float
) -> NormalEquations:
    """Set up the Gauss-Newton step of one trajectory.

    Raises:
        LinAlgError: the matrix of the splines is not positive.
    """
    one = residuals(curves, splines, coefficients)
    matrix = _data_matrix(curves, sigma) + weight * (one.by_spline.T @ one.by_spline)
    right = -weight * (one.by_spline.T @ one.value)
    for m, y, s in zip(curves.maps, curves.values, sigma, strict=True):
        right += m.T @ ((y - m @ splines) / s**2)
    if curves.rough is not None:
        right -= curves.rough.T @ (curves.rough @ splines) * (ROUGHNESS / sigma[0] ** 2)
    across = weight * (one.by_spline.T @ one.by_coefficient)
    divide = _band_factor(matrix)
    solved = divide(np.column_stack([across, right]))
    schur = weight * (one.by_coefficient.T @ one.by_coefficient) - across.T @ solved[:, :-1]
    aim = -weight * (one.by_coefficient.T @ one.value) - across.T @ solved[:, -1]
    return NormalEquations(divide, solved[:, -1], solved[:, :-1], schur, aim)


def _data_matrix(curves: Curves, sigma: ndarray) -> Any:
    """Return the part of the normal matrix that comes from the samples and the roughness."""
    total = sum(gram / s**2 for gram, s in zip(curves.grams, sigma, strict=True))
    if curves.rough is not None:
        total = total + (curves.rough.T @ curves.rough) * (ROUGHNESS / sigma[0] ** 2)
    return total


def _band_factor(matrix: Any) -> Callable[[ndarray], ndarray]:
    """Factor a symmetric positive sparse matrix as a band; return the function that divides by it."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    entries = matrix.tocoo()
    below = entries.row >= entries.col
    row, column, data = entries.row[below], entries.col[below], entries.data[below]
    width = int(np.max(row - column))
    band = np.zeros((width + 1, matrix.shape[0]))
    band[row - column, column] = data
    # The diagonal is scaled to 1 before the factor, so that the ridge is the same for all.
    scale = 1 / np.sqrt(np.maximum(band[0], 1e-300))
    band[row - column, column] *= scale[row] * scale[column]
    band[0] += RIDGE
    lower = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)

    def divide(right: ndarray) -> ndarray:
        scaled = right * (scale if right.ndim == 1 else scale[:, None])
        found = cho_solve_banded((lower, True), scaled, check_finite=False)
        return np.asarray(found * (scale if right.ndim == 1 else scale[:, None]))

    return divide
