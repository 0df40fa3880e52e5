"""Readings in the order in which their noise is correlated: rows of times, and channels of each sensor one by one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, Shaped
    from numpy import ndarray

    Seen = Bool[ndarray, "rows channels"]

# Readings closer than this share of the typical interval correlate as over that: part of any noise is white, and of
# white noise two readings at nearly the same time differ as any others.
CLOSE = 0.2
# What is left between strongly correlated readings must not be divided by zero.
CLOSEST = 1e-4


@dataclass(frozen=True, eq=False)
class Rows:
    """Times and channels of readings laid out as rows: pieces of one or several recordings, one after another.

    Attributes:
        times: (rows,), increasing within a piece.
        first: whether a piece begins (rows,); nothing correlates with the row before.
        sensor: the sensor of each channel (channels,), from 0; the channels of one sensor, such as the real and the
            imaginary part of a field, share its noise.
        least: the smallest size of the noise.
        curved: sensors of which a free curve takes the slow part of the noise: their own memory, tails and growth
            cannot be seen, and are taken to be those of the others.
        walking: sensors whose zeros wander.
        fastest: how far such a zero goes at most, over the size of its noise, per square root of time.
    """

    times: Float[ndarray, " rows"]
    first: Bool[ndarray, " rows"]
    sensor: Int[ndarray, " channels"]
    least: float = 0.0
    curved: frozenset[int] = frozenset()
    walking: frozenset[int] = frozenset()
    fastest: float = np.inf


@dataclass(frozen=True, eq=False)
class Chained:
    """The readings that were seen, channel after channel: places in a flat array (channels, rows), sensors and times.

    `gap` is the time since the reading before, at least `CLOSE` of the typical one; infinite where there is none in the
    same channel and piece.
    """

    where: Int[ndarray, " readings"]
    sensor: Int[ndarray, " readings"]
    gap: Float[ndarray, " readings"]
    time: Float[ndarray, " readings"]

    def of(self, values: Shaped[ndarray, "rows channels *more"]) -> Shaped[ndarray, "readings *more"]:
        """Return the values of the readings in this order."""
        return np.asarray(np.swapaxes(values, 0, 1).reshape(-1, *values.shape[2:])[self.where])

    def grid(self, values: Float[ndarray, "readings *more"], seen: Seen) -> Float[ndarray, "rows channels *more"]:
        """Return values in this order by row and channel; 0 where nothing was seen."""
        flat = np.zeros((seen.size, *values.shape[1:]))
        flat[self.where] = values
        return np.swapaxes(flat.reshape(*seen.T.shape, *values.shape[1:]), 0, 1)


def chained(rows: Rows, seen: Seen) -> Chained:
    """Return the readings that were seen in their order."""
    where = np.flatnonzero(seen.T)
    channel, row = np.divmod(where, max(len(rows.times), 1))
    piece = np.cumsum(rows.first)[row]
    linked = (np.diff(channel) == 0) & (np.diff(piece) == 0)
    gap = np.full(len(where), np.inf)
    gap[1:] = np.where(linked, np.diff(rows.times[row]), np.inf)
    apart = gap[np.isfinite(gap) & (gap > 0)]
    apart_enough = np.maximum(gap, CLOSE * np.median(apart)) if len(apart) else gap
    return Chained(where, rows.sensor[channel], apart_enough, rows.times[row])


def gaps(rows: Rows, there: Bool[ndarray, " rows"]) -> Float[ndarray, " rows"]:
    """Return the time since the row before that has readings, infinite where there is none; see `Chained`."""
    chain = chained(replace(rows, sensor=np.zeros(1, dtype=int)), there[:, None])
    found = np.full(len(there), np.inf)
    found[chain.where] = chain.gap
    return found
