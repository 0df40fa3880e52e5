"""What sensors have in common, as far as the likelihood of their residuals needs it: starts, and slopes."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.common import Unmixing, parts_of
from latticebench.diagnosis.rows import CLOSEST, Chained, Rows, gaps

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray

    Each = Float[ndarray, " readings"]

# The largest number a, at which a sensor's own noise is a thousandth of all of it.
MOST = 7.6
# How little and how much of the noise a search begins with, as a correlation c.
BEGIN_LEAST, BEGIN_MOST = 0.1, 0.95
# Where more than this share of the rows lack the reading of a sensor, own correlations in time are not used besides.
RAGGED = 0.02


@dataclass(frozen=True, eq=False)
class Beside:
    """Which readings are taken at one time.

    Attributes:
        chain: the readings in their order.
        seen: where there are any (rows, channels).
        sensor: of each channel (channels,).
        sensors: number of them.
        parts: channels of one part of the readings, and the time since the row before that has any, in units of the
            typical interval.
    """

    chain: Chained
    seen: Bool[ndarray, "rows channels"]
    sensor: Int[ndarray, " channels"]
    sensors: int
    parts: tuple[tuple[Int[ndarray, " some"], Float[ndarray, " rows"]], ...]

    @classmethod
    def of(cls, chain: Chained, rows: Rows, seen: Bool[ndarray, "rows channels"], interval: float) -> Beside:
        """Return this of readings whose typical interval is given."""
        part = parts_of(rows.sensor)
        every = [np.flatnonzero(part == k) for k in range(int(np.max(part, initial=0)) + 1)]
        parts = tuple((some, gaps(rows, np.any(seen[:, some], axis=1)) / interval) for some in every)
        return cls(chain, seen, rows.sensor, int(np.max(rows.sensor, initial=-1)) + 1, parts)

    @property
    def several(self) -> bool:
        """Whether some are: readings of several sensors."""
        return any(len(some) > 1 and np.any(np.sum(self.seen[:, some], axis=1) > 1) for some, _ in self.parts)

    @functools.cached_property
    def ragged(self) -> bool:
        """Whether many rows have readings of some sensors only, of those that are read at all."""
        counts = [np.sum(self.seen[:, some], axis=1) for some, _ in self.parts]
        some = [np.mean(one[one > 0] < np.max(one)) if np.any(one) else 0.0 for one in counts]
        return max(some, default=0.0) > RAGGED

    def promises(self, value: Each) -> float:
        """Return about how many nats one common part of white noise is worth, from the correlations of residuals.

        It is the likelihood ratio of a covariance of which one eigenvalue is larger than all others (Anderson, Ann.
        Math. Stat. 34, 122, 1963).
        """
        rows = sum(np.count_nonzero(np.sum(self.seen[:, some], axis=1) > 1) for some, _ in self.parts)
        count = len(np.unique(self.chain.sensor))
        most = float(np.clip(np.linalg.eigvalsh(self._correlations(value))[-1], 1.0, count - 1e-9))
        rest = (count - most) / (count - 1)
        return -rows / 2 * float(np.log(most) + (count - 1) * np.log(rest))

    def signed(self, number: float) -> Float[ndarray, " sensors"]:
        """Return the sign of each sensor's a where one number says them all: of two, the other one may be turned."""
        return np.array([-1.0 if number < 0 else 1.0, 1.0]) if self.sensors == 2 else np.ones(self.sensors)

    def begun(self, value: Each, shares: int) -> Float[ndarray, " shares"]:
        """Return so many numbers a that the correlations of residuals suggest."""
        values, vectors = np.linalg.eigh(self._correlations(value))
        # The first factor of sensors that all correlate alike.
        c = vectors[:, -1] * np.sqrt(max(values[-1] - 1, 0.0) * self.sensors / (self.sensors - 1))
        return self.reduced(c if np.sum(c) >= 0 else -c, shares, BEGIN_MOST)

    def reduced(self, c: Float[ndarray, " sensors"], shares: int, most: float) -> Float[ndarray, " shares"]:
        """Return so many numbers a for correlations c."""
        if shares == 1:
            c = np.array([np.mean(np.abs(c)) * (-1.0 if self.sensors == 2 and c[0] * c[1] < 0 else 1.0)])
        return np.asarray(np.where(c < 0, -1.0, 1.0) * np.arctanh(np.clip(np.abs(c), BEGIN_LEAST, most)))

    def unmixings(self, numbers: Float[ndarray, " sensors"], near: float, rho: Each) -> list[Unmixing]:
        """Return what makes the readings independent.

        Args:
            numbers: a.
            near: correlation of the common part over the typical interval.
            rho: correlation of each reading's own noise with that of the one before.
        """
        own, a = self.chain.grid(rho, self.seen), numbers[self.sensor]
        every = [np.where(np.isfinite(gap), np.minimum(near**gap, 1 - CLOSEST), 0.0) for _, gap in self.parts]
        return [
            Unmixing(some, self.seen[:, some], a[some], np.isfinite(gap), common, own[:, some])
            for (some, gap), common in zip(self.parts, every, strict=True)
        ]

    def apply(self, mixed: list[Unmixing], z: Each) -> Each:
        """Return independent innovations from those of each sensor by itself."""
        found = self.chain.grid(z, self.seen)
        for one in mixed:
            found[:, one.some] = one.apply(found[:, one.some])
        return self.chain.of(found)

    def slopes(
        self, mixed: list[Unmixing], z: Each, by_e: Each, near: float
    ) -> tuple[Each, Float[ndarray, " sensors"], float, Each]:
        """Return derivatives by z, a, and both correlations, from those by e; see `Unmixing.slopes`."""
        fresh, pulls = (self.chain.grid(one, self.seen) for one in (z, by_e))
        by_z, by_own = (np.zeros(self.seen.shape) for _ in range(2))
        by_number, by_near = np.zeros(self.sensors), 0.0
        for one, (some, gap) in zip(mixed, self.parts, strict=True):
            by_z[:, some], by_a, by_rho, by_own[:, some] = one.slopes(fresh[:, some], pulls[:, some])
            by_number += np.bincount(self.sensor[some], by_a, minlength=self.sensors)
            by_near += float(np.sum(by_rho * one.rho * np.where(np.isfinite(gap), gap, 0.0)) / near)
        return self.chain.of(by_z), by_number, by_near, self.chain.of(by_own)

    def _correlations(self, value: Each) -> Float[ndarray, "sensors sensors"]:
        """Return the correlations of the residuals of the sensors, 0 between those that are never read together."""
        total, count = np.zeros((2, self.sensors, self.sensors))
        grid = self.chain.grid(value, self.seen)
        for some, _ in self.parts:
            among = np.ix_(self.sensor[some], self.sensor[some])
            total[among] += grid[:, some].T @ grid[:, some]
            count[among] += self.seen[:, some].T.astype(float) @ self.seen[:, some]
        mean = total / np.maximum(count, 1.0)
        size = np.sqrt(np.maximum(np.diag(mean), np.finfo(float).tiny))
        found = mean / size / size[:, None]
        np.fill_diagonal(found, 1.0)
        return np.asarray(found)
