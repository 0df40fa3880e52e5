"""The motion of the sites without an equation, piece by piece.

Where the ends of a chain are unknown, its outer sites are read but obey no equation that is known; they drive their
neighbours. Their readings hold noise as all others do: what these sites really did is a B-spline in time on each piece,
whose coefficients are fitted along with the piece's initial state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

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
# Numbers of B-splines that are compared.
SIZES = 8
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
) -> tuple[Border | None, ...]:
    """Return the curves of each recording's outer sites, with as many B-splines as cross-validation asks for.

    Args:
        records: the recordings.
        plain: the equation, which says what sites have none.
        splines: of smoothed readings of those sites, of each recording.
        rows: of each piece.
        valid: whether a row is none of those repeated at the end of a shorter piece.
    """
    if not len(plain.border):
        return (None,) * len(records)
    shortest = min(int(np.min(np.sum(one, axis=1))) for one in valid)
    most = max(2, int(MOST * shortest))
    degree = min(DEGREE, most - 1)
    best, chosen = np.inf, 1
    for intervals in sorted({round(one) for one in np.geomspace(1, most - degree, SIZES)}):
        parts = [_cross_validated(*one, plain, intervals, degree) for one in zip(records, rows, valid, strict=True)]
        left, free, count = np.sum(parts, axis=0)
        score = float(np.log(left / count + 1e-24) - 2 * np.log(1 - free / count)) if free < count else np.inf
        if score < best:
            best, chosen = score, intervals
    found = []
    for number, (record, row) in enumerate(zip(records, rows, strict=True)):
        t = record.times[row]
        basis, first, width = _basis(t, record.times, chosen, degree)
        curve = record.stretches.driven(t.ravel(), splines[number])
        assert curve is not None
        target = curve[:, 0].reshape(*row.shape, -1)
        design = _designs(basis, first, width, t)[0] * valid[number][..., None]
        local = np.linalg.pinv(design, rcond=1e-8) @ (target * valid[number][..., None])
        start = np.zeros((basis.count, *curve.shape[2:]))
        start[first[:, None] + np.arange(width)] = local.reshape(*local.shape[:2], *curve.shape[2:])
        found.append(Border(basis, first, width, start))
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


def _cross_validated(
    record: Record, rows: ndarray, valid: ndarray, plain: Dynamics, intervals: int, degree: int
) -> tuple[float, float, float]:
    """Return the sum of squares that B-splines leave of the readings, their number, and that of the readings."""
    t = record.times[rows]
    design = _designs(*_basis(t, record.times, intervals, degree), t)[0]
    value = record.value[rows][:, :, 0][..., plain.border]
    seen = record.seen[rows][:, :, 0][..., plain.border] & valid[..., None, None]
    left = free = count = 0.0
    for column in np.ndindex(value.shape[2:]):
        here = seen[(slice(None), slice(None), *column)]
        matrix = design * here[..., None]
        target = np.where(here, value[(slice(None), slice(None), *column)], 0.0)[..., None]
        size = max(float(np.std(target[here])), 1e-12) if np.any(here) else 1.0
        rest = target - matrix @ (np.linalg.pinv(matrix, rcond=1e-8) @ target)
        left += float(np.sum((rest / size) ** 2))
        free += min(float(design.shape[0] * design.shape[2]), float(np.sum(here)))
        count += float(np.sum(here))
    return left, free, count
