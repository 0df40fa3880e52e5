"""Linearised least squares along a trajectory, with all states but the coefficients eliminated.

The states at the sample times are unknowns of a least-squares problem, tied to each other by the motion between them.
About given states the problem is linear: all states but the first are eliminated along the motion, then the first state
and the motion at unknown ends. What remains is least squares for the coefficients alone (Bock, Springer Ser. Chem.
Phys. 18, 102 (1981)). Fits of whole trajectories and the statistical limit both use it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.colouring import TAIL
from latticebench.methods.engine.sensitivity import CHUNK, Stretches, Transition

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

# Up to this many operations the problem is solved by orthogonal factors, beyond by normal equations.
MAX_QR_WORK = 6e9
# Columns that are eliminated at a time.
PANEL = 32


@dataclass(frozen=True, eq=False)
class Condensed:
    """What the samples of one trajectory say about the coefficients, with its start and drive unknown.

    Attributes:
        rows, target: least squares for a change of the coefficients, rows @ change = target, in units of the noise.
        own: function that maps a change of the coefficients to the change of the start (S,) and of the splines of the
            drive (m * parts * border,) that goes with it.
        transition, defects, stretches: see `condense`.
    """

    rows: Float[ndarray, "rows terms"]
    target: Float[ndarray, " rows"]
    own: Callable[[ndarray], tuple[ndarray, ndarray]]
    transition: Transition
    defects: Float[ndarray, "stretch state"]
    stretches: Stretches

    def moves(self, change: Float[ndarray, " terms"]) -> tuple[Float[ndarray, "time state"], ndarray]:
        """Return the changes of all states (K + 1, S) and of the splines (m, parts, border) that go with `change`."""
        start, splines = self.own(change)
        moved = np.empty((len(self.defects) + 1, len(start)))
        moved[0] = start
        shared = np.tensordot(self.transition.by_coefficient, change, (1, 0)) + self.defects
        if len(splines):
            assert self.transition.by_drive is not None
            local = _local_columns(self.stretches, self.transition)
            shared = shared + np.einsum("kq,kqs->ks", splines[local], self.transition.by_drive)
        for k, forced in enumerate(shared):
            moved[k + 1] = moved[k] @ self.transition.by_state[k] + forced
        dynamics = self.stretches.dynamics
        each = max(dynamics.parts * len(dynamics.border), 1)
        return moved, splines.reshape(len(splines) // each, dynamics.parts, len(dynamics.border))


def _local_columns(stretches: Stretches, transition: Transition) -> Int[ndarray, "stretch local"]:
    """Return which of all spline coefficients act in each stretch (K, Q)."""
    assert transition.by_drive is not None
    assert transition.first is not None
    width = transition.by_drive.shape[1]
    each = stretches.dynamics.parts * len(stretches.dynamics.border)
    return np.asarray(transition.first[:, None] * each + np.arange(width))


def condense(
    stretches: Stretches,
    transition: Transition,
    weights: Float[ndarray, "time order parts sites"],
    residuals: Float[ndarray, "time order parts sites"] | None = None,
    defects: Float[ndarray, "stretch state"] | None = None,
    before: Float[ndarray, "time order parts sites"] | None = None,
) -> Condensed:
    """Eliminate all states but the first, and then the start and the drive, from the linearised least squares.

    Minimises sum (weights * (residuals - change of state))^2 over the changes that follow
    change_{k+1} = (d end / d start) change_k + (d end / d xi) change of xi + defects_k.

    Noise that is correlated from one reading to the next is whitened: `before` times the residual of the last value
    that was seen of the same number is subtracted from each residual in the sum.

    Args:
        stretches: between K + 1 sample times.
        transition: their ends with derivatives.
        weights: one over the noise of each observed number, 0 where nothing was seen (K + 1, order, parts, N).
        residuals: observed minus present values, likewise; None for 0.
        defects: end of each stretch minus the next state; None for 0.
        before: factors as `weights`; None where the noise is white.
    """
    dynamics = stretches.dynamics
    size, terms = dynamics.size, transition.by_coefficient.shape[1]
    count = len(transition.end)
    residuals = np.zeros_like(weights) if residuals is None else residuals
    defects = np.zeros((count, size)) if defects is None else defects
    readings = _Readings(weights, residuals, before)
    edge = _edge_rows(stretches, readings.at(dynamics.border))
    readings = readings.at(dynamics.moving).flat(size)
    splines = edge.shape[1] - 1 if edge is not None else 0
    columns = size + splines + terms
    sparse = isinstance(transition.by_state, Sequence) and size > 300
    if not sparse and (count + 1) * size * columns**2 < MAX_QR_WORK:
        sums: Any = _Triangle(columns)
    else:
        sums = _Squares(size, columns, sparse)
    if edge is not None:
        wide = np.zeros((len(edge), columns + 1))
        wide[:, size : size + splines] = edge[:, :-1]
        wide[:, -1] = edge[:, -1]
        sums.add_rows(wide)
    local = _local_columns(stretches, transition) if splines else None
    if isinstance(sums, _Triangle):
        _gather(sums, transition, readings, defects, splines, local)
    else:
        _square(sums, transition, readings, defects, splines, local)
    rows, target, solve = sums.reduce(terms)

    def start_and_drive(change: ndarray) -> tuple[ndarray, ndarray]:
        found = solve(change)
        return found[:size], found[size:]

    return Condensed(rows, target, start_and_drive, transition, defects, stretches)


def _gather(
    sums: _Triangle,
    transition: Transition,
    readings: _Readings,
    defects: ndarray,
    splines: int,
    local: ndarray | None,
) -> None:
    """Follow the effects of the start, the drive, the coefficients and (last row) the defects.

    The rows of many sample times are collected at once.
    """
    count, size = defects.shape
    z = np.zeros((sums.columns + 1, size))
    z[:size] = np.eye(size)
    block = max(1, CHUNK // z.size)
    kept = np.empty((min(block, count + 1), *z.shape))
    for k in range(count + 1):
        number = k % block
        kept[number] = z
        if number == block - 1 or k == count:
            now = slice(k - number, k + 1)
            sums.add(kept[: number + 1], readings.during(now))
        if k == count:
            break
        z = z @ transition.by_state[k]
        z[size + splines : -1] += transition.by_coefficient[k]
        z[-1] += defects[k]
        if local is not None:
            assert transition.by_drive is not None
            z[size + local[k]] += transition.by_drive[k]


def _square(
    sums: _Squares,
    transition: Transition,
    readings: _Readings,
    defects: ndarray,
    splines: int,
    local: ndarray | None,
) -> None:
    """Follow the same effects for normal equations, one time after another."""
    count, size = defects.shape
    state: Any = np.eye(size)
    if sums.sparse:
        import scipy.sparse

        state = scipy.sparse.csr_array(scipy.sparse.identity(size, format="csr"))
    other = np.zeros((sums.columns + 1 - size, size))
    for k in range(count + 1):
        # The last row of `other` is the effect of the defects.
        sums.add(state, other, readings.during(slice(k, k + 1)))
        if k == count:
            break
        through = transition.by_state[k]
        state = state @ through
        other = other @ through
        other[splines:-1] += transition.by_coefficient[k]
        other[-1] += defects[k]
        if local is not None:
            assert transition.by_drive is not None
            other[local[k]] += transition.by_drive[k]
        if sums.sparse:
            state.data[np.abs(state.data) < TAIL * 1e-3 * np.max(np.abs(state.data))] = 0.0
            state.eliminate_zeros()


def _edge_rows(stretches: Stretches, readings: _Readings) -> ndarray | None:
    """Return rows that hold the drive to the samples of its sites; the last column is the target."""
    if stretches.drive is None or stretches.held:
        return None
    dynamics, drive = stretches.dynamics, stretches.drive
    times = np.append(stretches.begin, stretches.end[-1])
    first, *curves = drive.basis(times)
    each = dynamics.parts * len(dynamics.border)
    place = first[:, None] + np.arange(drive.degree + 1)
    blocks = []
    for level in range(dynamics.order):
        for number in range(each):
            one = readings.at((level, *divmod(number, len(dynamics.border))))
            seen = np.flatnonzero(one.weights > 0)
            block = np.zeros((len(seen), drive.count * each + 1))
            block[np.arange(len(seen))[:, None], place[seen] * each + number] = curves[level][seen]
            block[:, -1] = one.residuals[seen]
            whitened = block * one.weights[seen, None]
            if one.before is not None:
                whitened[1:] -= block[:-1] * one.before[seen[1:], None]
            blocks.append(whitened)
    return np.concatenate(blocks)


def _triangular(upper: ndarray, rows: ndarray) -> ndarray:
    """Return the factor R of Q R = rows below those of `upper`, which is triangular: LAPACK leaves out its zeros."""
    from scipy.linalg.lapack import dtpqrt

    if len(rows) == 0:
        return upper
    factor: Any = dtpqrt(0, min(PANEL, len(upper)), upper, rows)[0]
    return np.asarray(factor)


@dataclass(frozen=True, eq=False)
class _Readings:
    """What is known of the numbers that were read, the times first: `weights`, `residuals`, `before` of `condense`."""

    weights: ndarray
    residuals: ndarray
    before: ndarray | None

    def _each(self, change: Callable[[ndarray], ndarray]) -> _Readings:
        before = None if self.before is None else change(self.before)
        return _Readings(change(self.weights), change(self.residuals), before)

    def at(self, place: Any) -> _Readings:
        """Return those of some sites, or of one (level, part, site)."""
        whole = (slice(None), *place) if isinstance(place, tuple) else (..., place)
        return self._each(lambda one: one[whole])

    def flat(self, size: int) -> _Readings:
        """Return each time's in a row."""
        return self._each(lambda one: one.reshape(len(one), size))

    def during(self, times: slice) -> _Readings:
        """Return those of some times."""
        return self._each(lambda one: one[times])


class _Triangle:
    """Rows of a least-squares problem, kept as their triangular factor R."""

    def __init__(self, columns: int) -> None:
        self.columns = columns
        self.upper = np.zeros((columns + 1, columns + 1))
        self.waiting: list[ndarray] = []
        # The rows of each number when it was last seen.
        self.last: Any = 0.0

    def add_rows(self, rows: ndarray) -> None:
        self.waiting.append(rows)
        if sum(map(len, self.waiting)) > 6 * self.columns:
            self.upper = _triangular(self.upper, np.concatenate(self.waiting))
            self.waiting = []

    def add(self, z: ndarray, readings: _Readings) -> None:
        """Add the samples at B times: z (B, columns + 1, S), readings (B, S)."""
        rows = np.moveaxis(z, 1, 2).copy()
        rows[..., -1] = readings.residuals - rows[..., -1]
        seen = readings.weights > 0
        earlier = (
            [] if readings.before is None else [self._passed(one, there) for one, there in zip(rows, seen, strict=True)]
        )
        rows *= readings.weights[..., None]
        if readings.before is not None:
            rows -= np.stack(earlier) * readings.before[..., None]
        if np.any(seen):
            self.add_rows(rows[seen])

    def _passed(self, rows: ndarray, seen: ndarray) -> Any:
        """Return the rows when each number was last seen, and keep those that are seen now."""
        before = self.last
        self.last = np.where(seen[:, None], rows, before)
        return np.broadcast_to(before, rows.shape)

    def reduce(self, terms: int) -> tuple[ndarray, ndarray, Callable[[ndarray], ndarray]]:
        from scipy.linalg import solve_triangular

        own = self.columns - terms
        rows = np.concatenate([np.zeros((0, self.columns + 1)), *self.waiting])
        scale = np.linalg.norm(np.concatenate([self.upper, rows])[:, :-1], axis=0)
        scale[scale == 0] = 1.0
        # What the samples do not determine at all stays where it is.
        ridge = np.zeros((own, self.columns + 1))
        ridge[np.arange(own), np.arange(own)] = 1e-9 * scale[:own]
        factor = _triangular(self.upper, np.concatenate([rows, ridge]))
        upper, coupled, aim = factor[:own, :own], factor[:own, own:-1], factor[:own, -1]

        def solve(change: ndarray) -> ndarray:
            return np.asarray(solve_triangular(upper, aim - coupled @ change))

        return factor[own:, own:-1], factor[own:, -1], solve


class _Squares:
    """The same problem as normal equations; the block of the states is sparse for long chains."""

    def __init__(self, size: int, columns: int, sparse: bool) -> None:
        self.size, self.columns, self.sparse = size, columns, sparse
        self.block: Any = np.zeros((size, size))
        if sparse:
            import scipy.sparse

            self.block = scipy.sparse.csr_array((size, size))
        self.last: tuple[Any, ndarray] | None = None
        self.across = np.zeros((size, columns - size + 1))
        self.rest = np.zeros((columns - size + 1, columns - size + 1))

    def add_rows(self, rows: ndarray) -> None:
        tail = rows[:, self.size :]
        self.rest += tail.T @ tail

    def add(self, state: Any, other: ndarray, readings: _Readings) -> None:
        tail = other.copy()
        tail[-1] = readings.residuals[0] - tail[-1]
        weighted, target = self._times(state, readings.weights[0]), tail * readings.weights[0]
        if readings.before is not None:
            if self.last is not None:
                weighted = weighted - self._times(self.last[0], readings.before[0])
                target -= self.last[1] * readings.before[0]
            self._pass(state, tail, readings.weights[0] > 0)
        self.block = self.block + weighted @ weighted.T
        self.across += weighted @ target.T
        self.rest += target @ target.T

    def _times(self, state: Any, factors: ndarray) -> Any:
        """Return the columns of a matrix times factors."""
        if not self.sparse:
            return state * factors
        import scipy.sparse

        return state @ scipy.sparse.diags_array(factors, format="csr")

    def _pass(self, state: Any, tail: ndarray, seen: ndarray) -> None:
        """Keep the columns of each number when it was last seen."""
        if self.last is not None and not np.all(seen):
            state = self._times(state, seen.astype(float)) + self._times(self.last[0], (~seen).astype(float))
            tail = np.where(seen, tail, self.last[1])
        self.last = state, tail

    def reduce(self, terms: int) -> tuple[ndarray, ndarray, Callable[[ndarray], ndarray]]:
        import scipy.linalg
        import scipy.sparse.linalg

        diagonal = self.block.diagonal()
        ridge = 1e-14 * np.where(diagonal > 0, diagonal, 1.0)
        if self.sparse:
            import scipy.sparse

            matrix = scipy.sparse.csc_array(self.block + scipy.sparse.diags_array(ridge))
            divide = scipy.sparse.linalg.splu(
                matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            ).solve
        else:
            factor = scipy.linalg.cho_factor(self.block + np.diag(ridge))

            def divide(right: ndarray) -> ndarray:
                return np.asarray(scipy.linalg.cho_solve(factor, right))

        solved = divide(self.across)
        left = self.rest - self.across.T @ solved
        left = (left + left.T) / 2
        # Then the drive is eliminated; what remains concerns the coefficients.
        drive = len(left) - 1 - terms
        inner = np.zeros((drive, terms + 1))
        if drive:
            held = np.diag(left)[:drive]
            near = left[:drive, :drive] + np.diag(1e-14 * np.where(held > 0, held, 1.0))
            inner = scipy.linalg.solve(near, left[:drive, drive:], assume_a="pos")
            left = left[drive:, drive:] - left[drive:, :drive] @ inner
        scale = np.sqrt(np.maximum(np.diag(left)[:-1], 1e-300))
        values, vectors = np.linalg.eigh(left[:-1, :-1] / scale / scale[:, None])
        root = np.sqrt(np.maximum(values, 0.0))
        rows = root[:, None] * vectors.T * scale
        target = np.where(root > 1e-8, vectors.T @ (left[:-1, -1] / scale) / np.maximum(root, 1e-8), 0.0)

        def solve(change: ndarray) -> ndarray:
            splines = inner[:, -1] - inner[:, :-1] @ change
            start = solved[:, -1] - solved[:, :-1] @ np.concatenate([splines, change])
            return np.concatenate([start, splines])

        return rows, target, solve
