"""The part of the noise that all sensors have in common, as where a camera shakes or a reference is shared.

The noise x_i of a sensor, in units of its size, has a part of its own and one that all have in common:

    x_i = sqrt(1 - c_i^2) y_i + c_i y_0,

so that the correlation of two sensors is c_i c_j (one factor: Spearman, Am. J. Psychol. 15, 201, 1904). y_0 is a
first-order autoregressive process with a correlation time of its own.

Let z be the innovations of the sensors as if each were by itself, d_i = sqrt(1 - c_i^2), w_i = c_i / d_i, K the sum of
w_i^2 over the sensors that are read at one time, and h = w / sqrt(K). Across the unit vector h, the numbers z / d are
independent and of size 1. Along it, p = h^T z / d is white noise of size 1 and sqrt(K) times the innovations that y_0
has if it is taken to be correlated as the sensors' own noise is, by rho_1. In

    p_k - r_k p_(k-1),    r_k = rho_0 sqrt(K_k / K_(k-1)),

where rho_0 is the correlation of y_0 over the interval, both are moving averages of two numbers, of which `Averages`
makes independent numbers f. Then

    e = (I - h h^T) z / d + h f

are independent and of size 1. It is exact where the sensors' own parts are white, at any times, and where nothing is
missing, the times are even and the own parts have one correlation time. Where readings are missing here and there, own
parts that are correlated are far from it: the estimate does not use both, see `Beside.ragged`.

Numbers that may have any value are a_i = artanh c_i: d = 1 / cosh a, w = sinh a. Imaginary parts of complex readings
have a common part of their own.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.averages import Averages
from latticebench.diagnosis.rows import CLOSEST, Rows, gaps

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray

    from latticebench.diagnosis.rows import Seen

    Grid = Float[ndarray, "rows channels *more"]


@dataclass(frozen=True, eq=False)
class Common:
    """What the sensors have in common.

    Attributes:
        share: c of each sensor (sensors,), between -1 and 1.
        memory: correlation time, in units of time; 0 for white noise.
    """

    share: Float[ndarray, " sensors"]
    memory: float = 0.0

    def unmixings(self, rows: Rows, seen: Seen, own: Float[ndarray, "rows channels"]) -> Iterator[Unmixing]:
        """Yield what makes the readings independent, for each part of theirs.

        Args:
            rows: their times and sensors.
            seen: where there are any.
            own: correlation of each reading's own noise with that of the one before.
        """
        numbers, part = np.arctanh(self.share)[rows.sensor], parts_of(rows.sensor)
        for k in range(int(np.max(part)) + 1):
            some = np.flatnonzero((part == k) & (numbers != 0))
            gap = gaps(rows, np.any(seen[:, some], axis=1))
            rho = np.exp(-gap / self.memory) if self.memory > 0 else np.zeros(len(gap))
            rho = np.minimum(rho, 1 - CLOSEST)
            yield Unmixing(some, seen[:, some], numbers[some], np.isfinite(gap), rho, own[:, some])


def parts_of(sensor: Int[ndarray, " channels"]) -> Int[ndarray, " channels"]:
    """Return which part of its sensor's readings each channel is: 0, or 1 for an imaginary one."""
    return np.array([np.count_nonzero(sensor[:k] == one) for k, one in enumerate(sensor)], dtype=int)


@dataclass(frozen=True, eq=False)
class Unmixing:
    """The linear map to independent innovations, for channels that have a part in common.

    Attributes:
        some: the channels (some,).
        seen: where there are readings (rows, some).
        numbers: a of each channel (some,).
        linked: whether there is a row before with readings, in the same piece (rows,).
        rho: correlation of the common part with that at the row before (rows,), 0 where there is none.
        own: correlation of each reading's own noise with that of the one before (rows, some).
    """

    some: Int[ndarray, " some"]
    seen: Bool[ndarray, "rows some"]
    numbers: Float[ndarray, " some"]
    linked: Bool[ndarray, " rows"]
    rho: Float[ndarray, " rows"]
    own: Float[ndarray, "rows some"]

    @functools.cached_property
    def _there(self) -> Int[ndarray, " read"]:
        """The rows that have readings."""
        return np.flatnonzero(self.seen @ np.abs(self.numbers) > 0)

    @functools.cached_property
    def _total(self) -> Float[ndarray, " read"]:
        """K."""
        return np.asarray(self.seen[self._there] @ np.sinh(self.numbers) ** 2)

    @functools.cached_property
    def _along(self) -> Float[ndarray, "read some"]:
        """The unit vector h."""
        return np.asarray(self.seen[self._there] * np.sinh(self.numbers) / np.sqrt(self._total)[:, None])

    @functools.cached_property
    def _second(self) -> Bool[ndarray, " read"]:
        """Whether the row before is the first of its piece, where y_0 and the sensors' noise begin."""
        linked = self.linked[self._there]
        return np.asarray(linked & np.concatenate([[False], ~linked[:-1]]))

    @functools.cached_property
    def _shares(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """r, the shares that the new and the last innovation of y_0 have in p_k - r_k p_(k-1), and rho_1."""
        rho, total = self.rho[self._there], self._total
        last = np.concatenate([total[:1], total[:-1]])
        own = np.where(self.linked[self._there], np.sum(self._along**2 * self.own[self._there], axis=1), 0.0)
        new = np.sqrt(total * (1 - rho**2) / (1 - own**2))
        begun = np.sqrt(total) * (rho - (rho - own) / np.sqrt(1 - own**2))
        return rho * np.sqrt(total / last), new, np.where(self._second, begun, own * new), own

    @functools.cached_property
    def _averages(self) -> Averages:
        """What makes p_k - r_k p_(k-1) independent."""
        r, new, old, _ = self._shares
        before = np.concatenate([[0.0], new[:-1]])
        return Averages.of(1 + r**2 + new**2 + old**2, -(r + old * before))

    @property
    def log_scale(self) -> float:
        """Half the logarithm of the determinant of the covariance of z."""
        return self._averages.log_scale - float(np.sum(self.seen @ np.log(np.cosh(self.numbers))))

    def apply(self, z: Grid) -> Grid:
        """Return independent innovations, or their derivatives (any further axes); z is 0 where nothing was read."""
        found = z * _shaped(np.cosh(self.numbers), z, 1)
        along = self._inner(found[self._there])
        found[self._there] += self._outer(self._fresh(along) - along)
        return np.asarray(found)

    def transposed(self, e: Grid) -> Grid:
        """Return the transposed map: the sum of e times `apply(z)` is that of `transposed(e)` times z."""
        found, along = e.copy(), self._inner(e[self._there])
        found[self._there] += self._outer(self._fresh_transposed(along)[0] - along)
        return np.asarray(found * _shaped(np.cosh(self.numbers), e, 1))

    def slopes(self, z: Grid, by_e: Grid) -> tuple[Grid, Float[ndarray, " some"], Float[ndarray, " rows"], Grid]:
        """Return derivatives by z, by a, by rho and by the sensors' own correlations, from those by e = apply(z).

        Those of `log_scale` are among the last three.
        """
        there, h, total, (r, new, old, own) = self._there, self._along, self._total, self._shares
        across, by_here = (z * np.cosh(self.numbers))[there], by_e[there]
        along, pull = np.sum(h * across, axis=1), np.sum(h * by_here, axis=1)
        fresh = self._fresh(along)
        by_p, by_difference = self._fresh_transposed(pull)
        on, beside = self._averages.slopes(fresh, by_difference)
        last, before = np.concatenate([total[:1], total[:-1]]), np.concatenate([[0.0], along[:-1]])
        by_r = 2 * r * on - beside - by_difference * before
        by_old = 2 * old * on - beside * np.concatenate([[0.0], new[:-1]])
        by_begun = np.where(self._second, by_old, 0.0)
        by_new = 2 * new * on + own * (by_old - by_begun)
        by_new[:-1] -= (beside * old)[1:]
        by_own = new * (by_old - by_begun) + by_new * new * own / (1 - own**2)
        narrow, rho = np.sqrt(1 - own**2), self.rho[there]
        by_own += by_begun * np.sqrt(total) * (1 / narrow - (rho - own) * own / narrow**3)
        by_own = np.where(self.linked[there], by_own, 0.0)
        by_rho = by_r * np.sqrt(total / last) - by_new * new * rho / (1 - rho**2)
        by_rho += by_begun * np.sqrt(total) * (1 - 1 / narrow)
        by_total = (by_new * new + by_r * r + by_begun * old) / (2 * total)
        by_total[:-1] -= (by_r * r / last)[1:] / 2
        by_h = by_here * (fresh - along)[:, None] + (by_p - pull)[:, None] * across
        by_h += 2 * h * by_own[:, None] * self.own[there]
        by_w = (by_h - h * np.sum(h * by_h, axis=1, keepdims=True)) / np.sqrt(total)[:, None]
        by_w = self.seen[there] * (by_w + 2 * np.sinh(self.numbers) * by_total[:, None])
        by_across = by_e.copy()
        by_across[there] += h * (by_p - pull)[:, None]
        tilt = np.tanh(self.numbers) * np.sum(by_across * z * np.cosh(self.numbers) - self.seen, axis=0)
        by_rows, by_owns = np.zeros(len(z)), np.zeros(z.shape)
        by_rows[there], by_owns[there] = by_rho, h**2 * by_own[:, None]
        by_a = np.sum(by_w, axis=0) * np.cosh(self.numbers) + tilt
        return by_across * np.cosh(self.numbers), by_a, by_rows, by_owns

    def _inner(self, x: Float[ndarray, "read some *more"]) -> Float[ndarray, "read *more"]:
        return np.asarray(np.einsum("rc,rc...->r...", self._along, x))

    def _outer(self, values: Float[ndarray, "read *more"]) -> Float[ndarray, "read some *more"]:
        return np.asarray(np.einsum("rc,r...->rc...", self._along, values))

    def _fresh(self, along: Float[ndarray, "read *more"]) -> Float[ndarray, "read *more"]:
        """Return f from p."""
        difference = along.copy()
        difference[1:] -= _shaped(self._shares[0][1:], along, 0) * along[:-1]
        return self._averages.apply(difference)

    def _fresh_transposed(self, f: Float[ndarray, "read *more"]) -> tuple[ndarray, ndarray]:
        """Return the transpose of that map applied to numbers, and of its last step alone."""
        difference = self._averages.transposed(f)
        found = difference.copy()
        found[:-1] -= _shaped(self._shares[0][1:], f, 0) * difference[1:]
        return found, difference


def _shaped(values: ndarray, x: ndarray, axis: int) -> ndarray:
    """Return values in a shape that multiplies x along an axis."""
    return values.reshape(-1, *(1,) * (x.ndim - 1 - axis))
