"""What all instruments of a model together make of a motion, and how that changes with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting import Misreading, Placed
from latticebench.diagnosis.acting.late import Late, misread_late

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# The least slope of a reading that can be undone, and numbers that are worked on at a time.
LEAST_SLOPE, CHUNK = 0.05, 2_000_000


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Derivatives of readings by the motion that they are of.

    Attributes:
        own: by their own field (rows, levels, parts, N), rows of all recordings one after another.
        by_rates: by v and its rate (rows, levels, 2, parts, N), but for their own field; None for 0.
        by_others: by the same field at other sites, or of the other part, a row for each reading (levels, parts * N,
            parts * N); None for 0.
    """

    own: Float[ndarray, "rows levels parts sites"]
    by_rates: Float[ndarray, "rows levels 2 parts sites"] | None = None
    by_others: Float[ndarray, "levels channels channels"] | None = None

    @classmethod
    def of(cls, wrong: Misreading) -> Sensitivity:
        """Return that of readings to which instruments add something."""
        return cls(1 + wrong.slope, wrong.by_rates, wrong.by_others)

    @classmethod
    def along(cls, every: Sequence[Sensitivity]) -> Sensitivity:
        """Return that of several recordings one after another, in which sensors mix alike."""
        rates = [
            np.zeros((*one.own.shape[:2], 2, *one.own.shape[2:])) if one.by_rates is None else one.by_rates
            for one in every
        ]
        by_rates = np.concatenate(rates)
        own = np.concatenate([one.own for one in every])
        return cls(own, by_rates if np.any(by_rates) else None, every[0].by_others)

    def at(self, rows: slice) -> Sensitivity:
        """Return that of some rows."""
        return Sensitivity(self.own[rows], None if self.by_rates is None else self.by_rates[rows], self.by_others)

    def undone(self, difference: Float[ndarray, "rows levels parts sites"]) -> ndarray:
        """Return by how much the fields differ where the readings do so, to first order, whatever v and its rate do."""
        own = np.where(np.abs(self.own) > LEAST_SLOPE, self.own, 1.0)
        if self.by_others is None:
            return difference / own
        rows, levels = own.shape[:2]
        flat, found = own.reshape(rows, levels, -1), np.zeros((rows, levels, own[0, 0].size))
        for some in np.array_split(np.arange(rows), rows * self.by_others.size // CHUNK + 1):
            matrix = self.by_others + flat[some][..., None] * np.eye(flat.shape[2])
            found[some] = np.linalg.solve(matrix, difference[some].reshape(len(some), levels, -1, 1))[..., 0]
        return found.reshape(difference.shape)

    def forward(
        self, by: Float[ndarray, "rows levels parts sites count"], by_field: ndarray
    ) -> Float[ndarray, "rows channels count"]:
        """Return derivatives of the readings from those of the motion.

        Args:
            by: of the levels that are read.
            by_field: of the whole motion (rows, count, levels, parts, N), with the rate of v where that counts.
        """
        found: ndarray = by.reshape(*self.own.shape, -1) * self.own[..., None]
        if self.by_others is not None:
            found += _mixed(self.by_others, by)
        if self.by_rates is not None:
            found += np.sum(self.by_rates[..., None] * np.moveaxis(by_field[:, :, 1:], 1, -1)[:, None], axis=2)
        return found.reshape(len(found), -1, found.shape[-1])

    def back(
        self, readings: Float[ndarray, "rows channels count"]
    ) -> tuple[Float[ndarray, "rows channels count"], Float[ndarray, "rows 2 parts sites count"] | None]:
        """Return derivatives by the fields that are read, and by v and its rate, from those by the readings."""
        of_sites = readings.reshape(*self.own.shape, -1)
        by = of_sites * self.own[..., None]
        if self.by_others is not None:
            by += _mixed(np.swapaxes(self.by_others, 1, 2), of_sites)
        rates = None if self.by_rates is None else np.sum(of_sites[:, :, None] * self.by_rates[..., None], axis=1)
        return by.reshape(readings.shape), rates


def read_by(instruments: Sequence[Placed], t: ndarray, field: Float[ndarray, "rows levels parts sites"]) -> Misreading:
    """Return what instruments make of a motion; numbers are those of the instruments one after another.

    First readings are late by all that makes them so; all the rest is done to what is read then, and adds up.
    Derivatives by the motion of other sites are those of readings that are on time.

    Args:
        instruments: in the order of their numbers.
        t: times of the rows.
        field: u and, where the motion has them, v and its rate.
    """
    late = [one for one in instruments if isinstance(one, Late)]
    first = misread_late(late, t, field) if late else None
    seen = field if first is None else field + first.added
    rest = [one.misread(t, seen) for one in instruments if not isinstance(one, Late)]
    added, slope = np.zeros_like(field), np.zeros_like(field)
    for wrong in rest:
        added, slope = added + wrong.added, slope + wrong.slope
    mixing = [wrong.by_others for wrong in rest if wrong.by_others is not None]
    by_others = np.sum(mixing, axis=0) if mixing else None
    by, others, begin = [], iter(rest), 0
    for one in instruments:
        if isinstance(one, Late) and first is not None:
            own = first.by[begin : begin + one.count]
            by.append((1 + slope) * own)
            if by_others is not None:
                by[-1] += np.moveaxis(_mixed(by_others, np.moveaxis(own, 0, -1)), -1, 0)
            begin += one.count
        else:
            by.append(next(others).by)
    numbers = np.concatenate(by) if by else np.zeros((0, *field.shape))
    if first is None:
        return Misreading(added, slope, numbers, None, by_others)
    by_rates = (1 + slope)[:, :, None] * (0.0 if first.by_rates is None else first.by_rates)
    return Misreading(first.added + added, (1 + slope) * (1 + first.slope) - 1, numbers, by_rates, by_others)


def _mixed(
    by_others: Float[ndarray, "levels channels channels"], values: Float[ndarray, "rows levels parts sites count"]
) -> Float[ndarray, "rows levels parts sites count"]:
    rows, levels, *_, count = values.shape
    return np.asarray((by_others @ values.reshape(rows, levels, -1, count)).reshape(values.shape))


def is_late(instruments: Sequence[Placed]) -> bool:
    """Return whether any of them makes readings late: it needs the rate of v, too."""
    return any(isinstance(one, Late) for one in instruments)


def seen_by(instruments: Sequence[Placed], t: ndarray, field: ndarray) -> ndarray:
    """Return the motion as it was when it was read: what else a sensor might do, it would do to that."""
    late = [one for one in instruments if isinstance(one, Late)]
    return field + misread_late(late, t, field).added if late else field
