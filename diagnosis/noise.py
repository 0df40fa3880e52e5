"""The noise of the instruments that took the readings, as a model with a likelihood.

The noise x of a sensor at time t_k is s_k y_k. Its size is s = hypot(size, growth |level|), where `level` is what the
sensor would read without noise; y is a first-order autoregressive (Ornstein-Uhlenbeck) process of correlation time tau,
for times that need not be even:

    y_k = rho_k y_(k-1) + sqrt(1 - rho_k^2) z_k,    rho_k = exp(-(t_k - t_(k-1)) / tau),

and y = z at the first reading of a piece; an interval counts as at least `CLOSE` of the typical one. A share v of its
variance may be white besides, as where an amplifier hisses and its zero comes and goes: then y_k - rho_k y_(k-1) are
moving averages of two, of variance 1 - rho_k^2 + 2 v rho_k^2 and covariance -v rho_k with the one before (an ARMA(1, 1)
process: Granger & Morris, J. R. Stat. Soc. A 139, 246, 1976), and z is what `Averages` makes of these. The innovations
are independent and follow Student's t distribution with nu degrees of freedom (Lange, Little & Taylor, J. Am. Stat.
Assoc. 84, 881, 1989), or the normal distribution. Which of these parts are used is the `Structure`; Schwarz' criterion
(Ann. Stat. 6, 461, 1978) chooses it.

A part may be common to all sensors, see `common`. The zero of a sensor may wander besides, see `walk`; the rest of its
noise is then white, and its own.

All likelihoods are natural logarithms with their normalising constants, so that those of different structures compare.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.averages import Averages
from latticebench.diagnosis.common import Common, Unmixing
from latticebench.diagnosis.rows import CLOSEST, Chained, Rows, chained
from latticebench.diagnosis.walk import covariance

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

    from latticebench.diagnosis.rows import Seen

    Readings = Float[ndarray, "rows channels"]


@dataclass(frozen=True)
class Structure:
    """Which parts of the model of the noise are used.

    Attributes:
        own_sizes: each sensor has its own size (and its own correlation time); else all are alike.
        growth: the noise grows with the signal.
        tails: the innovations follow Student's t distribution, not the normal one.
        memory: the noise is correlated from one reading to the next.
        common: a part of it is common to all sensors; with sizes of their own, each has its share. Of two sensors their
            correlation is all that is seen, and the shares are alike.
        white: with a memory, a part of it is white besides; not where there is something in common. An estimate with
            this structure does without where it is not worth its numbers.
    """

    own_sizes: bool = False
    growth: bool = False
    tails: bool = False
    memory: bool = False
    common: bool = False
    white: bool = False

    def parameters(self, sensors: int) -> int:
        """Return how many numbers describe the noise of so many sensors, but for its white part, which has a price."""
        groups = sensors if self.own_sizes else 1
        return groups * (1 + self.memory) + self.growth + self.tails + self.common * (self.shares(sensors) + 1)

    def shares(self, sensors: int) -> int:
        """Return how many numbers say what so many sensors have in common."""
        return sensors if self.own_sizes and sensors > 2 else 1


@dataclass(frozen=True, eq=False)
class Noise:
    """The noise of every sensor.

    Attributes:
        size: standard deviation of Gaussian noise, or scale of Student's t, at zero signal (sensors,), in units of the
            readings.
        growth: share of the level that adds to the size in quadrature, dimensionless; of all sensors.
        tail: degrees of freedom of Student's t, more than 2; infinite for a Gaussian.
        memory: correlation time (sensors,), in units of time; 0 for white noise.
        structure: which of these were fitted.
        walk: standard deviation of the walk of each zero after a unit of time (sensors,), in units of the readings;
            empty where no zero wanders.
        common: what the sensors have in common; None for nothing.
        white: share v of the variance that is white where the rest has a memory (sensors,); empty for none.
        price: nats that this part has to win. Whether it is there is chosen for each fit, and not for all that compare.
    """

    size: Float[ndarray, " sensors"]
    growth: float
    tail: float
    memory: Float[ndarray, " sensors"]
    structure: Structure
    walk: Float[ndarray, " sensors"] = field(default_factory=lambda: np.zeros(0))
    common: Common | None = None
    white: Float[ndarray, " sensors"] = field(default_factory=lambda: np.zeros(0))
    price: float = 0.0

    @property
    def parameters(self) -> int:
        """How many numbers were fitted."""
        return self.structure.parameters(len(self.size))

    def deviation(self) -> Float[ndarray, " sensors"]:
        """Return the standard deviation at zero signal, in units of the readings."""
        return self.size * self.tailed

    @property
    def tailed(self) -> float:
        """The standard deviation of innovations over their scale: 1 of a Gaussian, more with heavy tails."""
        return float(np.sqrt(self.tail / (self.tail - 2))) if np.isfinite(self.tail) else 1.0

    def fresh(self, step: float) -> Float[ndarray, " sensors"]:
        """Return the size of what is new after a time, in units of the readings."""
        new = _fresh(self.memory, step)
        if len(self.white):
            new = new + self.white * (1 - new)
        if self.common is not None:
            new = new + self.common.share**2 * (_fresh(np.array(self.common.memory), step) - new)
        return np.asarray(self.size * np.sqrt(new))

    def log_likelihood(self, left: Readings, level: Readings, rows: Rows) -> float:
        """Return the logarithm of the probability density of residuals, NaN where nothing was read.

        Args:
            left: readings less what the model says.
            level: what the model says.
            rows: times and sensors of both.
        """
        whitener = self.whitener(level, rows, np.isfinite(left))
        z = whitener.apply(left)[whitener.seen]
        return -whitener.log_scale - minus_log_density(z, self.tail)

    def whitener(self, level: Readings, rows: Rows, seen: Seen) -> Whitener:
        """Return what turns residuals of the readings that were seen into independent ones of equal size."""
        chain = chained(rows, seen)
        size = np.hypot(self.size[chain.sensor], self.growth * np.abs(chain.of(level)))
        time = self.memory[chain.sensor]
        rho = np.where(time > 0, np.minimum(np.exp(-chain.gap / np.where(time > 0, time, 1.0)), 1 - CLOSEST), 0.0)
        white = self.white[chain.sensor] if len(self.white) else np.zeros_like(rho)
        spread = np.where(white > 0, 1.0, np.sqrt(1 - rho**2))
        before = np.zeros_like(rho)
        before[1:] = rho[1:] / (spread[1:] * size[:-1])
        own, log_size = 1 / (size * spread), np.log(size * spread)
        where, averages = np.flatnonzero(white > 0), None
        variance, beside = 1 - rho**2 + 2 * white * rho**2, -white * rho
        if np.any(self.walk):
            walking = np.flatnonzero(self.walk[chain.sensor] > 0)
            linked = np.isfinite(chain.gap[walking])
            gap = np.where(linked, chain.gap[walking], chain.time[walking] - np.min(rows.times))
            variance[walking], beside[walking] = covariance(
                size[walking], self.walk[chain.sensor[walking]], gap, linked
            )
            own[walking], before[walking], log_size[walking] = 1.0, linked, 0.0
            where = np.union1d(where, walking)
        log_scale = float(np.sum(log_size))
        if len(where):
            averages = Averages.of(variance[where], beside[where])
            log_scale += averages.log_scale
        mixed: tuple[Unmixing, ...] = ()
        if self.common is not None:
            mixed = tuple(self.common.unmixings(rows, seen, chain.grid(rho, seen)))
            log_scale += sum(one.log_scale for one in mixed)
        return Whitener(chain, seen, own, before, self.tail, log_scale, mixed, where, averages)

    def still(self, left: Readings, level: Readings, rows: Rows) -> Readings:
        """Return residuals without the walks of zeros, as far as these can be told from the rest of the noise.

        It is what is expected of the white part, s_k^2 times the inverse covariance of the noise times x.
        """
        if not np.any(self.walk):
            return left
        seen = np.isfinite(left)
        whitener = self.whitener(level, rows, seen)
        white = whitener.transposed(whitener.apply(np.where(seen, left, 0.0)))
        variance = self.size[rows.sensor] ** 2 + (self.growth * level) ** 2
        return np.where(self.walk[rows.sensor] > 0, np.where(seen, variance * white, np.nan), left)


@dataclass(frozen=True, eq=False)
class Whitener:
    """A linear map from residuals to innovations in units of their size.

    z_k = (x_k / s_k - rho_k x_p / s_p) / sqrt(1 - rho_k^2), where p is the last reading that was seen of the same
    channel in the same piece; x / s at the first of a piece. Where a part of the noise is white it is x_k / s_k - rho_k
    x_p / s_p, where a zero wanders x_k - x_p, and `averages` makes innovations of these.

    Attributes:
        seen: where there are readings (rows, channels).
        own, before: factors of each reading of the chain and of the one before it, 0 where there is none.
        tail: degrees of freedom of Student's t.
        log_scale: half the logarithm of the determinant of the residuals' covariance.
        mixed: what makes independent innovations where sensors have something in common.
        where, averages: which readings of the chain are moving averages, and what makes innovations of these.
    """

    chain: Chained
    seen: Seen
    own: Float[ndarray, " readings"]
    before: Float[ndarray, " readings"]
    tail: float
    log_scale: float
    mixed: tuple[Unmixing, ...]
    where: Int[ndarray, " averages"]
    averages: Averages | None

    def apply(self, x: Float[ndarray, "rows channels *more"]) -> Float[ndarray, "rows channels *more"]:
        """Return the innovations of residuals or of their derivatives (any further axes), 0 where nothing was seen."""
        along = x.shape[2:]
        values = self.chain.of(x.reshape(*self.seen.shape, -1))
        z = values * self.own[:, None]
        if np.any(self.before):
            z[1:] -= values[:-1] * self.before[1:, None]
        if self.averages is not None:
            z[self.where] = self.averages.apply(z[self.where])
        found = self.chain.grid(z, self.seen)
        for one in self.mixed:
            found[:, one.some] = one.apply(found[:, one.some])
        return found.reshape(*self.seen.shape, *along)

    def transposed(self, z: Float[ndarray, "rows channels *more"]) -> Float[ndarray, "rows channels *more"]:
        """Return the transposed map: the sum of z times `apply(x)` is that of `transposed(z)` times x."""
        along = z.shape[2:]
        whole = z.reshape(*self.seen.shape, -1)
        if self.mixed:
            whole = whole.copy()
        for one in self.mixed:
            whole[:, one.some] = one.transposed(whole[:, one.some])
        values = self.chain.of(whole)
        if self.averages is not None:
            values[self.where] = self.averages.transposed(values[self.where])
        x = values * self.own[:, None]
        if np.any(self.before):
            x[:-1] -= values[1:] * self.before[1:, None]
        return self.chain.grid(x, self.seen).reshape(*self.seen.shape, *along)

    def robust(self, z: Readings) -> Readings:
        """Return the square root of the weight of each innovation in a least-squares fit, 0 where nothing was seen.

        The weights (nu + 1) / (nu + z^2) make iterated least squares the fit of greatest likelihood; a Gaussian has 1.
        """
        heavy = np.isfinite(self.tail)
        weight = np.sqrt((self.tail + 1) / (self.tail + z**2)) if heavy else np.ones(z.shape)
        return np.where(self.seen, weight, 0.0)


def _fresh(memory: Float[ndarray, " *sensors"], step: float) -> Float[ndarray, " *sensors"]:
    """Return the share of the variance that is new after a time."""
    return np.asarray(np.where(memory > 0, -np.expm1(-2 * step / np.where(memory > 0, memory, 1.0)), 1.0))


def minus_log_density(z: Float[ndarray, " readings"], tail: float) -> float:
    """Return minus the sum of the logarithms of the densities of innovations in units of their size."""
    from scipy.special import betaln

    if not np.isfinite(tail):
        return float(np.sum(z**2) + len(z) * np.log(2 * np.pi)) / 2
    constant = betaln(tail / 2, 0.5) + np.log(tail) / 2
    return float((tail + 1) / 2 * np.sum(np.log1p(z**2 / tail)) + len(z) * constant)
