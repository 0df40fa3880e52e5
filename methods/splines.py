"""Splines with the equation as a penalty: the objective of a physics-informed network without the network.

Each site's motion is a B-spline u_n(t) = sum_j c_nj B_j(t). Coefficients xi and splines c minimise together

    sum (u - data)^2 / sigma_u^2 + sum (du/dt - data)^2 / sigma_v^2 + W * mean over collocation points of |residual|^2,
    residual = d^order u_n/dt^order - sum_j xi_j T_j(u, du/dt)

by Gauss-Newton steps with the exact derivatives of the terms and a banded Cholesky factor; the coefficients, few and dense, are
eliminated last (Ramsay, Hooker, Campbell & Cao, J. R. Stat. Soc. B 69, 741 (2007)). The coefficients start from the fits to
short pieces that start the trajectory fit (`methods.trajectory`). W grows from stage to stage, each starting where the last
ended, and the largest is taken that robust generalised cross-validation allows (Lukas, Inverse Problems 22, 1883 (2006), with
the trace of the hat matrix in the place of that of its square): the data themselves say how far the splines can follow the
equation. That trace, the splines' degrees of freedom, is estimated with random signs (Hutchinson, Commun. Stat. 18, 1059
(1989)), and serves to estimate the noise of u and v too.

Sites without an equation, at unknown ends, are held by their data alone and by a slight penalty on roughness.
Standard errors follow from the same matrix with the estimated noise.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from latticebench.methods.engine.sensitivity import Drive, split_parts
from latticebench.methods.method import Abilities, Fit, History, Smooth
from latticebench.methods.trajectory import LEAST_NOISE, Record, approach, prepare, smooth, without_halves
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    import scipy.sparse
    from jaxtyping import Float
    from numpy import ndarray

# At most so many Gauss-Newton steps to the first coefficients.
START_STEPS = 40
PROBES = 4
# Plain cross-validation now and then lets the splines follow the noise; robust cross-validation counts freedom more.
ROBUST = 0.3
ROUGHNESS = 1e-6
RIDGE = 1e-13


@dataclass(frozen=True, eq=False)
class _Curves:
    """One trajectory's splines and the sparse maps from their coefficients, ordered (j, part, site), to what is compared.

    Attributes:
        record: the data and the equation.
        drive: the B-splines, the same for all sites.
        points: collocation times (Q,).
        measure: length of time that each point stands for, over the whole (Q,).
        levels: B_j and its first two derivatives at the points.
        maps: from coefficients to the observed numbers of u and of v.
        values: those numbers.
        rough: the penalty on sites without an equation, or None.
    """

    record: Record
    drive: Drive
    points: Float[ndarray, " point"]
    measure: Float[ndarray, " point"]
    levels: tuple[ndarray, ...]
    maps: tuple[scipy.sparse.csr_array, ...]
    values: tuple[ndarray, ...]
    rough: scipy.sparse.csr_array | None

    @property
    def each(self) -> int:
        """Numbers of one B-spline: parts * N."""
        return self.record.stretches.dynamics.parts * self.record.stretches.dynamics.sites


def _curves(record: Record, degree: int, density: float) -> _Curves:
    import scipy.sparse
    from scipy.interpolate import BSpline

    dynamics = record.stretches.dynamics
    t = record.times
    intervals = max(2, round(density * (len(t) - 1)))
    edges = np.linspace(t[0], t[-1], intervals + 1)
    knots = np.concatenate([np.full(degree, t[0]), edges, np.full(degree, t[-1])])
    drive = Drive(knots, degree)
    nodes, weights = np.polynomial.legendre.leggauss(2)
    half = (edges[1] - edges[0]) / 2
    points = ((edges[1:] + edges[:-1])[:, None] / 2 + half * nodes).ravel()
    measure = np.tile(weights * half, intervals) / (t[-1] - t[0])
    every = BSpline(knots, np.eye(drive.count), degree)
    levels = tuple(np.asarray(every(points, k)) for k in range(3))
    each = dynamics.parts * dynamics.sites
    identity = scipy.sparse.identity(each, format="csr")
    maps, values = [], []
    for level in range(record.value.shape[1]):
        seen = np.flatnonzero(record.seen[:, level].reshape(-1))
        basis = scipy.sparse.csr_array(np.asarray(every(t, level)))
        maps.append(scipy.sparse.csr_array(scipy.sparse.kron(basis, identity, format="csr")[seen]))
        values.append(record.value[:, level].reshape(-1)[seen])
    rough = None
    if len(dynamics.border):
        chosen = np.zeros((dynamics.parts, dynamics.sites))
        chosen[:, dynamics.border] = 1.0
        third = np.diff(np.eye(drive.count), 3, axis=0)
        rough = scipy.sparse.csr_array(
            scipy.sparse.kron(scipy.sparse.csr_array(third), scipy.sparse.diags_array(chosen.ravel()), format="csr")
        )
    return _Curves(record, drive, points, measure, levels, tuple(maps), tuple(values), rough)


@dataclass(frozen=True, eq=False)
class _Equation:
    """The equation's residuals along the splines, and their derivatives.

    Attributes:
        residual: (points * parts * moving sites,), each times the root of its share of time.
        by_spline: sparse (residuals, coefficients of the splines).
        by_coefficient: (residuals, terms).
    """

    residual: ndarray
    by_spline: Any
    by_coefficient: ndarray


def _equation(curves: _Curves, splines: ndarray, coefficients: ndarray, *, derivatives: bool = True) -> _Equation:
    import scipy.sparse

    stretches = curves.record.stretches
    dynamics = stretches.dynamics
    order, parts, sites, count = dynamics.order, dynamics.parts, dynamics.sites, dynamics.count
    shape = (len(curves.points), parts, sites)
    fields = [(level @ splines.reshape(curves.drive.count, -1)).reshape(shape) for level in curves.levels]
    state = np.stack([one[..., dynamics.moving] for one in fields[:order]], axis=1).reshape(len(curves.points), -1)
    driven = np.stack([one[..., dynamics.border] for one in fields[:order]], axis=1) if len(dynamics.border) else None
    f = None if stretches.inputs is None else stretches.inputs(curves.points)
    rate, values, slopes = dynamics.linear(coefficients, curves.points, state, f, driven, derivatives=derivatives)
    root = np.sqrt(curves.measure)[:, None, None]
    wanted = rate.reshape(len(rate), order, parts, count)[:, -1]
    residual = ((fields[order][..., dynamics.moving] - wanted) * root).ravel()
    by_coefficient = -(np.transpose(values, (2, 0, 3, 1)) * root[..., None]).reshape(-1, values.shape[1])
    if not derivatives:
        return _Equation(residual, None, by_coefficient)
    index, factor = dynamics._pad
    factor = np.ones(len(index)) if factor is None else factor
    moving = np.arange(sites)[dynamics.moving]
    # Each variable of the stencil is one block: which coefficients it comes from, and the derivative by it.
    pieces: list[tuple[int, int, int, ndarray, ndarray]] = [
        (order, part, part, moving, np.ones((len(curves.points), count))) for part in range(parts)
    ]
    for (part, slot), slope in slopes.items():
        window = slice(dynamics.reach[0] + slot.offset, dynamics.reach[0] + slot.offset + count)
        weight = -np.broadcast_to(slope, (len(curves.points), count)) * factor[window]
        pieces.append((int(slot.name == "v"), part, int(slot.part == "im"), index[window], weight))
    degree = curves.drive.degree
    first = curves.drive.basis(curves.points)[0]
    local = first[:, None] + np.arange(degree + 1)
    at = np.arange(len(curves.points))
    rows, columns, data = [], [], []
    for level, part, source, site, weight in pieces:
        row = (at[:, None] * parts + part) * count + np.arange(count)
        column = (local[:, None, :] * parts + source) * sites + site[None, :, None]
        basis = curves.levels[level][at[:, None], local] * np.sqrt(curves.measure)[:, None]
        entry = weight[:, :, None] * basis[:, None, :]
        rows.append(np.broadcast_to(row[:, :, None], entry.shape).ravel())
        columns.append(np.broadcast_to(column, entry.shape).ravel())
        data.append(entry.ravel())
    by_spline = scipy.sparse.csr_array(
        (np.concatenate(data), (np.concatenate(rows), np.concatenate(columns))), shape=(residual.size, splines.size)
    )
    return _Equation(residual, by_spline, by_coefficient)


@dataclass(frozen=True, eq=False)
class _Step:
    """One Gauss-Newton step's linear algebra for one trajectory."""

    divide: Callable[[ndarray], ndarray]
    right: ndarray
    across: ndarray
    schur: ndarray
    aim: ndarray


def _factor(matrix: Any) -> Callable[[ndarray], ndarray]:
    """Factor a symmetric positive sparse matrix as a band, in the order of time."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    entries = matrix.tocoo()
    below = entries.row >= entries.col
    row, column, data = entries.row[below], entries.col[below], entries.data[below]
    width = int(np.max(row - column))
    band = np.zeros((width + 1, matrix.shape[0]))
    band[row - column, column] = data
    # Unit diagonal before the factor, so that the ridge is the same for all.
    scale = 1 / np.sqrt(np.maximum(band[0], 1e-300))
    band[row - column, column] *= scale[row] * scale[column]
    band[0] += RIDGE
    lower = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)

    def divide(right: ndarray) -> ndarray:
        scaled = right * (scale if right.ndim == 1 else scale[:, None])
        found = cho_solve_banded((lower, True), scaled, check_finite=False)
        return np.asarray(found * (scale if right.ndim == 1 else scale[:, None]))

    return divide


def _held(curves: _Curves, sigma: ndarray) -> Any:
    """Give the data's part of the normal matrix."""
    total = sum((m.T @ m) / s**2 for m, s in zip(curves.maps, sigma, strict=True))
    if curves.rough is not None:
        total = total + (curves.rough.T @ curves.rough) * (ROUGHNESS / sigma[0] ** 2)
    return total


def _step(curves: _Curves, splines: ndarray, coefficients: ndarray, sigma: ndarray, weight: float) -> _Step:
    one = _equation(curves, splines, coefficients)
    matrix = _held(curves, sigma) + weight * (one.by_spline.T @ one.by_spline)
    right = -weight * (one.by_spline.T @ one.residual)
    for m, y, s in zip(curves.maps, curves.values, sigma, strict=True):
        right += m.T @ ((y - m @ splines) / s**2)
    if curves.rough is not None:
        right -= curves.rough.T @ (curves.rough @ splines) * (ROUGHNESS / sigma[0] ** 2)
    across = weight * (one.by_spline.T @ one.by_coefficient)
    divide = _factor(matrix)
    solved = divide(np.column_stack([across, right]))
    schur = weight * (one.by_coefficient.T @ one.by_coefficient) - across.T @ solved[:, :-1]
    aim = -weight * (one.by_coefficient.T @ one.residual) - across.T @ solved[:, -1]
    return _Step(divide, solved[:, -1], solved[:, :-1], schur, aim)


def _objective(
    curves: Sequence[_Curves], splines: Sequence[ndarray], coefficients: ndarray, sigma: ndarray, weight: float
) -> tuple[float, ndarray, float]:
    """Give the objective, the misfits of u and v, and the mean square of the equation's residual."""
    misfit, left = np.zeros(len(sigma)), 0.0
    smooth_ = 0.0
    with np.errstate(all="ignore"):
        for one, c in zip(curves, splines, strict=True):
            misfit += [float(np.sum((y - m @ c) ** 2)) for m, y in zip(one.maps, one.values, strict=True)]
            left += float(np.sum(_equation(one, c, coefficients, derivatives=False).residual ** 2))
            if one.rough is not None:
                smooth_ += ROUGHNESS * float(np.sum((one.rough @ c) ** 2)) / sigma[0] ** 2
        return float(np.sum(misfit / sigma**2)) + weight * left + smooth_, misfit, left


def _scaled(schur: ndarray) -> tuple[ndarray, ndarray]:
    scale = np.sqrt(np.maximum(np.diag(schur), 1e-300))
    return schur / scale / scale[:, None], scale


@dataclass(frozen=True)
class Splines:
    """B-splines with the equation as a penalty.

    Attributes:
        degree: of the B-splines.
        density: knot intervals to each interval between samples.
        stages: at most so many weights of the equation, each ten times the last.
        steps: at most so many Gauss-Newton steps a weight.
        tolerance: a stage ends when no coefficient moves by more than this share of its standard error.
        rise: the largest weight is taken whose score of generalised cross-validation exceeds the least by no more than this.
    """

    name: ClassVar[str] = "splines"
    degree: int = 7
    density: float = 1.5
    stages: int = 16
    steps: int = 4
    tolerance: float = 0.05
    rise: float = 0.003

    @property
    def abilities(self) -> Abilities:
        """Anything goes."""
        return Abilities(missing=True)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Minimise the penalised misfit, with growing weight of the equation.

        Raises:
            InputError: the samples do not even give a start.
        """
        began = time.perf_counter()
        data = [without_halves(samples) for samples in data]
        records = [prepare(samples, library.terms, order) for samples in data]
        coefficients = approach(data, records, START_STEPS).coefficients
        curves = [_curves(record, self.degree, self.density) for record in records]
        splines = [_start(one, samples, order) for one, samples in zip(curves, data, strict=True)]
        counts = np.asarray(sum(np.array([len(y) for y in one.values]) for one in curves), dtype=float)
        height = np.sqrt(sum(np.array([np.sum(y**2) for y in one.values]) for one in curves) / np.maximum(counts, 1))
        floor = LEAST_NOISE * np.maximum(height, 1e-300)
        draw = np.random.default_rng(seed)
        probes = [draw.choice([-1.0, 1.0], size=(c.size, PROBES)) for c in splines]
        _, misfit, left = _objective(curves, splines, coefficients, np.ones(len(counts)), 1.0)
        sigma = np.maximum(np.sqrt(misfit / np.maximum(counts, 1)), np.maximum(1e-6 * height, floor))
        # The first weight believes the equation as little as the guess deserves.
        weight = float(np.sum(counts)) / max(left, 1e-300)
        best: Any = None
        least = np.inf
        before = (coefficients, np.inf)
        path = []
        for _ in range(self.stages):
            reached = self._stage(curves, splines, coefficients, sigma, weight)
            if reached is None:
                break
            splines, coefficients, misfit, steps, covariance = reached
            # An estimate from few probes may leave the range that the trace has.
            used = np.clip(_freedom(curves, steps, sigma, probes), 0.0, 0.99 * counts)
            share = used / counts
            terms = np.log(np.maximum(misfit, floor**2) / (1 - share) ** 2) + np.log(ROBUST + (1 - ROBUST) * share)
            score = float(np.sum(counts * terms) / np.sum(counts))
            path.append((time.perf_counter() - began, score, coefficients))
            # While the splines are freer than the data are many, what is left says little about the noise.
            sigma = np.where(used < 0.5 * counts, np.maximum(np.sqrt(misfit / (counts - used)), floor), sigma)
            least = min(least, score)
            if score <= least + self.rise:
                best = (weight, coefficients, covariance, sigma, misfit, splines)
            free = float(np.sum(used))
            moved = np.max(np.abs(coefficients - before[0]) / np.sqrt(np.maximum(np.diag(covariance), 1e-300)))
            # Heavier weights change nothing more, or the splines cannot follow the equation any closer.
            settled = moved < self.tolerance and abs(free / before[1] - 1) < 0.02
            if free < 0.5 * np.sum(counts) and (settled or score > least + 0.3):
                break
            before = (coefficients, free)
            weight *= 10
        status = "ok"
        if best is None:
            best = (weight, coefficients, np.full((len(coefficients),) * 2, np.nan), sigma, misfit, splines)
            status = "the fit did not converge; its start is given"
        weight, coefficients, covariance, noise, misfit, splines = best
        found: dict[str, float | str] = {"weight": weight, "noise_u": float(noise[0])}
        if len(noise) > 1:
            found["noise_v"] = float(noise[1])
        history = None
        if path:
            history = History(
                np.arange(1, len(path) + 1), np.array([p[0] for p in path]), np.array([p[1] for p in path]),
                np.array([p[2] for p in path]),
            )  # fmt: skip
        residual = float(np.sqrt(misfit[0] / max(counts[0], 1)) / max(height[0], 1e-300))
        return Fit(
            self.name, library, order, coefficients, residual, stderr=np.sqrt(np.diag(covariance)), status=status,
            history=history, found=found, smooth=tuple(map(_smooth, curves, splines)),
        )  # fmt: skip

    def _stage(
        self,
        curves: Sequence[_Curves],
        splines: Sequence[ndarray],
        coefficients: ndarray,
        sigma: ndarray,
        weight: float,
    ) -> tuple[list[ndarray], ndarray, ndarray, list[_Step], ndarray] | None:
        """Minimise for one weight; None where the linear algebra breaks down."""
        splines = list(splines)
        now, misfit, _ = _objective(curves, splines, coefficients, sigma, weight)
        steps: list[_Step] = []
        covariance = np.zeros((len(coefficients),) * 2)
        for _ in range(self.steps):
            try:
                steps = [_step(one, c, coefficients, sigma, weight) for one, c in zip(curves, splines, strict=True)]
                schur, scale = _scaled(np.sum([step.schur for step in steps], axis=0))
                inverse = np.linalg.pinv(schur, rcond=1e-13, hermitian=True) / scale / scale[:, None]
            except np.linalg.LinAlgError:
                return None
            covariance = inverse
            change = inverse @ np.sum([step.aim for step in steps], axis=0)
            moves = [step.right - step.across @ change for step in steps]
            length = 1.0
            while length > 1e-3:
                trial = [c + length * move for c, move in zip(splines, moves, strict=True)]
                then, further, _ = _objective(curves, trial, coefficients + length * change, sigma, weight)
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
        return splines, coefficients, misfit, steps, covariance


def _start(curves: _Curves, samples: Samples, order: int) -> ndarray:
    """Splines through the smoothed samples, as smooth as the smoothing left them."""
    dynamics = curves.record.stretches.dynamics
    u, v = smooth(samples, order)
    rows = [_levels(curves, samples.t, 0)]
    fields = [split_parts(u, samples.is_complex).reshape(len(u), -1)]
    if v is not None:
        step = float(np.mean(np.diff(samples.t)))
        rows.append(_levels(curves, samples.t, 1) * step)
        fields.append(split_parts(v, samples.is_complex).reshape(len(u), -1) * step)
    bend = np.diff(np.eye(curves.drive.count), min(4, curves.drive.count - 1), axis=0)
    matrix = np.concatenate([*rows, 1e-3 * bend])
    target = np.concatenate([*fields, np.zeros((len(bend), dynamics.parts * dynamics.sites))])
    return np.asarray(np.linalg.lstsq(matrix, target, rcond=None)[0]).ravel()


def _smooth(curves: _Curves, splines: ndarray) -> Smooth:
    """Evaluate the splines and their derivatives at the collocation points."""
    dynamics = curves.record.stretches.dynamics
    shape = (len(curves.points), dynamics.parts, dynamics.sites)
    each = splines.reshape(curves.drive.count, -1)
    levels = [(level @ each).reshape(shape) for level in curves.levels[: dynamics.order + 1]]
    return Smooth(curves.points, curves.measure, np.stack(levels))


def _levels(curves: _Curves, t: ndarray, level: int) -> ndarray:
    first, *values = curves.drive.basis(t)
    dense = np.zeros((len(t), curves.drive.count))
    dense[np.arange(len(t))[:, None], first[:, None] + np.arange(curves.drive.degree + 1)] = values[level]
    return dense


def _freedom(
    curves: Sequence[_Curves], steps: Sequence[_Step], sigma: ndarray, probes: Sequence[ndarray]
) -> Float[ndarray, " levels"]:
    """How many degrees of freedom the splines take from u and v: traces of the normal matrix's inverse times their parts of it."""
    total = np.zeros(len(sigma))
    for one, step, probe in zip(curves, steps, probes, strict=True):
        for level, (m, size) in enumerate(zip(one.maps, sigma, strict=True)):
            total[level] += float(np.sum(probe * step.divide(m.T @ (m @ probe) / size**2))) / probe.shape[1]
    return total


METHODS = (Splines,)
