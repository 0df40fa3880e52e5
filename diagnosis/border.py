"""The motion of the sites without an equation, piece by piece.

Where the ends of a chain are unknown, its outer sites are read but obey no equation that is known; they drive their
neighbours. Their readings hold noise as all others do: what these sites really did is a B-spline in time on each piece,
whose coefficients are fitted along with the piece's initial state.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_array

from latticebench.methods.engine.bsplines import BSplines
from latticebench.methods.engine.dynamics import Dynamics
from latticebench.methods.engine.record import Record
from latticebench.methods.engine.sensitivity import Transition

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray

# Degree of the curves where a piece has the rows for it.
DEGREE = 5
# B-splines of a piece, as a share of its rows: with as many as there are readings these would have no noise.
MOST = 0.6
# Numbers of B-splines that are compared first, and how often the way to the nearest ones is halved.
SIZES, HALVED = 8, 2
# So many times as many are taken as cross-validation asks for: there errors of the curve and of its numbers are of one
# size, but errors of the curve look like forces. They fall with the sixth power.
FINER = 1.25
# And how many times as many as that may be taken, where the neighbours' readings tell of a motion that hardly shows in
# those of the outer sites.
FINENESS = (1.0, 1.5, 2.25)
# Innovations of stronger correlations would say nothing of the slow part of a motion.
MOST_CORRELATED = 0.98
# Knots reach beyond the rows of a piece by this share of the time between rows.
BEYOND = 0.25


@dataclass(frozen=True, eq=False)
class Border:
    """The curves of one recording's outer sites.

    Attributes:
        basis: B-splines of all pieces, one piece after another; none is shared.
        first: the first B-spline of each piece.
        width: B-splines of a piece.
        start: coefficients of the curves through what was read (splines, parts, border).
    """

    basis: BSplines
    first: Int[ndarray, " pieces"]
    width: int
    start: Float[ndarray, "splines parts border"]

    @property
    def size(self) -> int:
        """How many numbers a piece has: spline, part, site."""
        return self.width * int(np.prod(self.start.shape[1:]))

    def moved(self, splines: Float[ndarray, "splines parts border"], by: Float[ndarray, "pieces numbers"]) -> ndarray:
        """Return coefficients that are changed by the numbers of each piece."""
        found = splines.copy()
        found[self._own] += by.reshape(len(by), self.width, *splines.shape[1:])
        return found

    @property
    def _own(self) -> Int[ndarray, "pieces width"]:
        return self.first[:, None] + np.arange(self.width)

    def add_readings(
        self,
        by: Float[ndarray, "rows level part site number"],
        t: Float[ndarray, "pieces m"],
        sites: Int[ndarray, " border"],
    ) -> None:
        """Add what the numbers of each piece do to the readings of its border.

        Args:
            by: derivatives of all readings by those numbers; changed.
            t: times of the rows.
            sites: of the border.
        """
        levels, parts = by.shape[1:3]
        curves = _designs(self.basis, self.first, self.width, t)[:levels].reshape(levels, t.size, self.width)
        for part in range(parts):
            for number, site in enumerate(sites):
                columns = (np.arange(self.width) * parts + part) * len(sites) + number
                by[:, :, part, site, columns] += np.moveaxis(curves, 0, 1)

    def driving(self, transition: Transition, intervals: int) -> Float[ndarray, "pieces intervals number state"]:
        """Return what the numbers of each piece do to the ends of its intervals.

        Args:
            transition: of all intervals, with the derivatives by the drive.
            intervals: of a piece.
        """
        by_drive, first = transition.by_drive, transition.first
        assert by_drive is not None
        assert first is not None
        each = int(np.prod(self.start.shape[1:]))
        state = by_drive.shape[-1]
        local = by_drive.reshape(len(by_drive), -1, each, state)
        found = np.zeros((len(by_drive), self.width, each, state))
        begin = first - np.repeat(self.first, intervals)
        rows = np.arange(len(by_drive))
        for k in range(local.shape[1]):
            inside = (begin + k >= 0) & (begin + k < self.width)
            found[rows[inside], (begin + k)[inside]] = local[inside, k]
        return found.reshape(len(self.first), intervals, -1, state)


def borders(
    records: Sequence[Record],
    plain: Dynamics,
    splines: Sequence[ndarray | None],
    rows: Sequence[Int[ndarray, "pieces m"]],
    valid: Sequence[Bool[ndarray, "pieces m"]],
    memory: float = 0.0,
    fineness: float = 1.0,
) -> tuple[Border | None, ...]:
    """Return the curves of each recording's outer sites, with as many B-splines as cross-validation asks for.

    Args:
        records: the recordings.
        plain: the equation, which says what sites have none.
        splines: of smoothed readings of those sites, of each recording.
        rows: of each piece.
        valid: whether a row is none of those repeated at the end of a shorter piece.
        memory: correlation time of the noise; 0 for white noise.
        fineness: so many times as many B-splines are taken; of `FINENESS`.
    """
    if not len(plain.border):
        return (None,) * len(records)
    shortest = min(int(np.min(np.sum(one, axis=1))) for one in valid)
    most = max(2, int(MOST * shortest))
    degree = min(DEGREE, most - 1)
    read = [_Read.of(*one, plain, memory) for one in zip(records, rows, valid, strict=True)]

    @functools.cache
    def score(intervals: int) -> float:
        left, free, count = np.sum([one.cross_validated(intervals, degree) for one in read], axis=0)
        return float(np.log(left / count + 1e-24) - 2 * np.log(1 - free / count)) if free < count else np.inf

    sizes = {round(one) for one in np.geomspace(1, most - degree, SIZES)}
    chosen = min(sorted(sizes), key=score)
    for _ in range(HALVED):
        # The geometric means with the nearest numbers on both sides that have been tried.
        beside = [max((one for one in sizes if one < chosen), default=chosen)]
        beside += [min((one for one in sizes if one > chosen), default=chosen)]
        sizes |= {round(float(np.sqrt(chosen * one))) for one in beside}
        chosen = min(sorted(sizes), key=score)
    chosen = min(math.ceil(FINER * fineness * chosen), most - degree)
    found = []
    for number, (record, row) in enumerate(zip(records, rows, strict=True)):
        t = record.times[row]
        basis, first, width = _basis(t, record.times, chosen, degree)
        curve = record.stretches.driven(t.ravel(), splines[number])
        assert curve is not None
        weight = valid[number].ravel()[:, None].astype(float)
        start = _least_squares(_design(basis, t), weight, curve[:, 0].reshape(t.size, -1))
        found.append(Border(basis, first, width, start.reshape(basis.count, *curve.shape[2:])))
    return tuple(found)


def _basis(
    t: Float[ndarray, "pieces m"], times: Float[ndarray, " time"], intervals: int, degree: int
) -> tuple[BSplines, Int[ndarray, " pieces"], int]:
    """Return B-splines with knots of their own for each piece, the first of each, and how many a piece has."""
    apart = np.concatenate([[np.median(np.diff(times))], t[1:, 0] - t[:-1, -1]])
    margin = BEYOND * float(np.min(apart))
    knots = []
    for begin, end in zip(t[:, 0] - margin, t[:, -1] + margin, strict=True):
        inner = np.linspace(begin, end, intervals + 1)
        knots.append(np.concatenate([np.full(degree, begin), inner, np.full(degree, end)]))
    return BSplines(np.concatenate(knots), degree), np.arange(len(t)) * len(knots[0]), intervals + degree


def _designs(
    basis: BSplines, first: Int[ndarray, " pieces"], width: int, t: Float[ndarray, "pieces m"]
) -> Float[ndarray, "two pieces m width"]:
    begin, *curves = basis.basis(t.ravel())
    found = np.zeros((2, t.size, width))
    columns = (begin - np.repeat(first, t.shape[1]))[:, None] + np.arange(basis.degree + 1)
    for level, curve in enumerate(curves):
        found[level][np.arange(t.size)[:, None], columns] = curve
    return found.reshape(2, *t.shape, width)


@dataclass(frozen=True, eq=False)
class _Read:
    """What was read of one recording's outer sites.

    Attributes:
        times: of the recording.
        t: of the rows (pieces, m).
        value: of each row (pieces * m, columns), 0 where nothing was read.
        seen: whether it was read, likewise.
        before: correlation of the noise with that of the row before, 0 at the first one of a piece (pieces * m,).
    """

    times: Float[ndarray, " time"]
    t: Float[ndarray, "pieces m"]
    value: Float[ndarray, "rows columns"]
    seen: Bool[ndarray, "rows columns"]
    before: Float[ndarray, " rows"]

    @classmethod
    def of(cls, record: Record, rows: ndarray, valid: ndarray, plain: Dynamics, memory: float) -> _Read:
        t = record.times[rows]
        value = record.value[rows][:, :, 0][..., plain.border].reshape(t.size, -1)
        seen = record.seen[rows][:, :, 0][..., plain.border] & valid[..., None, None]
        gap = np.diff(t, axis=1, prepend=-np.inf).ravel()
        before = np.minimum(np.exp(-gap / memory), MOST_CORRELATED) if memory else np.zeros(t.size)
        return cls(record.times, t, value, seen.reshape(t.size, -1), before)

    def cross_validated(self, intervals: int, degree: int) -> tuple[float, float, float]:
        """Return the sum of squares that B-splines leave of the readings, their number, and that of the readings.

        Both readings and B-splines are taken in innovations, which are independent where the noise has a memory.
        """
        basis, _, width = _basis(self.t, self.times, intervals, degree)
        design = _design(basis, self.t)
        left = free = count = 0.0
        masks, which = np.unique(self.seen, axis=1, return_inverse=True)
        for k, seen in enumerate(masks.T):
            if not np.any(seen):
                continue
            value = self.value[:, which == k]
            whiten = self._innovations(seen)
            target, own = whiten @ value, (whiten @ design).tocsr()
            rest = target - own @ _least_squares(own, seen[:, None].astype(float), target)
            size = np.maximum(np.std(value[seen], axis=0), 1e-12)
            left += float(np.sum((rest[seen] / size) ** 2))
            read, columns = float(np.sum(seen)), value.shape[1]
            free += columns * min(float(len(self.t) * width), read)
            count += columns * read
        return left, free, count

    def _innovations(self, seen: Bool[ndarray, " rows"]) -> csr_array:
        """Return the matrix from readings to innovations; rows after one that was not read begin anew."""
        from scipy.sparse import diags_array

        rho = np.where(np.concatenate([[False], seen[:-1]]), self.before, 0.0)
        unit = np.where(seen, 1 / np.sqrt(1 - rho**2), 0.0)
        return csr_array(diags_array([unit, -(rho * unit)[1:]], offsets=[0, -1]))


def _design(basis: BSplines, t: Float[ndarray, "pieces m"]) -> csr_array:
    """Return the values of all pieces' B-splines at their rows, as a matrix (rows, splines)."""
    from scipy.interpolate import BSpline

    return csr_array(BSpline.design_matrix(t.ravel(), basis.knots, basis.degree, extrapolate=True))


def _least_squares(design: csr_array, weight: ndarray, target: Float[ndarray, "rows columns"]) -> ndarray:
    """Return the coefficients that leave least of the targets; 0 for B-splines that no reading touches."""
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    gram = design.T @ (design * weight)
    unit = np.sqrt(np.maximum(gram.diagonal(), 1e-12 * np.max(gram.diagonal(), initial=1e-300)))
    scale = diags_array(1 / unit)
    # What no reading says is decided by a last digit.
    solved = splu((scale @ gram @ scale + 1e-11 * diags_array(np.ones(len(unit)))).tocsc())
    return np.asarray(solved.solve((design.T @ (weight * target)) / unit[:, None]) / unit[:, None])
