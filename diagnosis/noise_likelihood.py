"""The likelihood of residuals under noise of a given structure, its slopes, and where it is greatest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.averages import Averages
from latticebench.diagnosis.common import Common
from latticebench.diagnosis.common_estimate import MOST, Beside
from latticebench.diagnosis.noise import Noise, Structure, minus_log_density
from latticebench.diagnosis.rows import CLOSEST, Rows, chained

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray

    from latticebench.diagnosis.noise import Readings

    Each = Float[ndarray, " readings"]

# A size is at least this share of the level's root mean square: arithmetic with doubles is no more accurate.
FLOOR = 1e-12
# Where noise grows with the signal, at zero signal it is at least this share of its median; and the standard deviation
# of a Gaussian over its median absolute value.
AT_REST, ROBUST = 0.1, 1.4826
# Below 2 degrees of freedom there is no variance; closer to 2 it rests on a handful of outliers.
HEAVIEST = 2.5
# Beyond, Student's t is a Gaussian for any record.
LIGHTEST = 1000.0
# Correlations from one typical reading to the next. A stronger one than the largest may stand for any slow misfit of
# the equation, which the equation should have to answer for; below the least, the noise is white.
MOST_CORRELATED, LEAST_CORRELATED = 0.98, 1e-3
# Nats to which the greatest likelihood is found; of less than so many readings, which hardly know the parts of their
# noise, and look for it longest, those nats.
EXACT, FEW, ROUGH = 1e-4, 400, 1e-3
# The largest share that is white where the rest of the noise is slow: with all of it there would be no rest.
MOST_WHITE = 0.999


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals in their order and in units of their own: their largest scale and the typical interval are 1.

    Attributes:
        value, level, sensor: residual and absolute level, divided by `unit`, and sensor of each reading.
        beside: which readings are taken at one time.
        gap, linked: interval to the reading before, divided by `interval`, and whether there is one.
        even: whether all intervals are alike.
        unit, interval: root mean square of the residuals and median interval.
        floor: least size, divided by `unit`.
        possible: parts of a structure that can make a difference.
    """

    value: Each
    level: Each
    sensor: Int[ndarray, " readings"]
    beside: Beside
    gap: Each
    linked: Bool[ndarray, " readings"]
    even: bool
    unit: float
    interval: float
    floor: float
    sensors: int
    possible: tuple[str, ...]

    @classmethod
    def of(cls, left: Readings, level: Readings, rows: Rows) -> Residuals:
        chain = chained(rows, np.isfinite(left))
        value, heights = chain.of(left), np.abs(chain.of(level))
        height = float(np.sqrt(np.mean(heights**2))) if len(heights) else 0.0
        floor = max(FLOOR * height, rows.least, np.finfo(float).tiny ** 0.5)
        unit = max(float(np.sqrt(np.mean(value**2))) if len(value) else 0.0, floor)
        linked = np.isfinite(chain.gap)
        apart = linked & (chain.gap > 0)
        interval = float(np.median(chain.gap[apart])) if np.any(apart) else 1.0
        gap = np.where(linked, chain.gap, 0.0) / interval
        sensors = int(np.max(rows.sensor, initial=-1)) + 1
        beside = Beside.of(chain, rows, np.isfinite(left), interval)
        ways = {
            "own_sizes": sensors > 1, "growth": height > 0, "tails": True, "memory": bool(np.any(apart)),
            "white": bool(np.any(apart)), "common": beside.several,
        }  # fmt: skip
        even = bool(np.all(np.abs(gap[linked] - 1) < 1e-6))
        return cls(
            value / unit, heights / unit, chain.sensor, beside, gap, linked, even, unit, interval, floor / unit,
            sensors, tuple(part for part, there in ways.items() if there),
        )  # fmt: skip

    @property
    def each(self) -> float:
        """Schwarz' penalty for a number, in nats."""
        return float(np.log(max(len(self.value), 1))) / 2

    def is_exact(self) -> bool:
        """Whether the residuals are no more than what arithmetic leaves."""
        return self.floor >= 1 or not len(self.value)

    def groups(self, structure: Structure) -> tuple[Int[ndarray, " readings"], int]:
        """Return the group of each reading and the number of groups; sensors of a group share size and memory."""
        if structure.own_sizes:
            return self.sensor, self.sensors
        return np.zeros_like(self.sensor), 1

    def likeliest(self, structure: Structure, start: Noise | None) -> tuple[Noise, float]:
        """Return the noise of greatest likelihood with all parts of a structure, and its log likelihood."""
        from scipy.optimize import minimize

        structure = replace(structure, **{part: False for part in vars(structure) if part not in self.possible})
        if structure.common and self.beside.ragged:
            structure = replace(structure, memory=False)
        structure = replace(structure, white=structure.white and structure.memory and not structure.common)
        plain = self.plain(structure)
        if not len(self.value):
            return plain, 0.0
        numbers = self.packed(start or plain, structure)
        if self.is_exact() or structure in (Structure(), Structure(own_sizes=True)):
            numbers = self.packed(plain, structure)
            found, cost = plain, self.cost(numbers, structure)[0]
        else:
            groups = self.groups(structure)[1]
            bounds = [(np.log(least), np.log(1e3)) for least in self.least(structure)]
            bounds += [(np.log(1e-6), np.log(1e6))] * structure.growth
            bounds += [(1 / LIGHTEST, 1 / HEAVIEST)] * structure.tails
            bounds += [(LEAST_CORRELATED, MOST_CORRELATED)] * (groups * structure.memory)
            bounds += [(0.0, MOST_WHITE)] * (groups * structure.white)
            bounds += [(LEAST_CORRELATED, MOST_CORRELATED)] * structure.common
            bounds += [(-MOST, MOST)] * (structure.shares(self.sensors) * structure.common)
            nats = EXACT if len(self.value) >= FEW else ROUGH
            result = minimize(
                self.cost, numbers, args=(structure,), jac=True, method="L-BFGS-B", bounds=bounds,
                options={"ftol": nats / len(self.value), "gtol": 1e-5, "maxiter": 200},
            )  # fmt: skip
            found, cost = self.unpacked(np.asarray(result.x), structure), float(result.fun)
        return found, -len(self.value) * (cost + float(np.log(self.unit)))

    def least(self, structure: Structure) -> list[float]:
        """Return the least size of each group, divided by `unit`.

        Of noise that grows with the signal it is a share of the residuals' scale: with none at zero signal the
        likelihood has no bound, as readings near zero are then beyond all doubt.
        """
        group, groups = self.groups(structure)
        if not structure.growth:
            return [self.floor] * groups
        parts = [np.abs(self.value[group == k]) for k in range(groups)]
        scales = [ROBUST * float(np.median(one)) if len(one) else 0.0 for one in parts]
        return [max(self.floor, AT_REST * one) for one in scales]

    def plain(self, structure: Structure) -> Noise:
        """Return white Gaussian noise: root mean squares of the residuals, `unit` for a sensor without any."""
        group, groups = self.groups(structure)
        count = np.bincount(group, minlength=groups)
        mean = np.bincount(group, self.value**2, minlength=groups) / np.maximum(count, 1)
        size = np.maximum(np.sqrt(np.where(count > 0, mean, 1.0)), self.floor) * self.unit
        nothing = np.zeros(self.sensors)
        return Noise(np.broadcast_to(size, self.sensors).copy(), 0.0, np.inf, nothing, structure)

    def packed(self, noise: Noise, structure: Structure) -> Float[ndarray, " numbers"]:
        """Return noise as numbers to vary: log sizes, log growth, 1 / nu, correlations over the typical interval.

        Last come that of the common part, and how much of it the sensors have.
        Sizes are those of what is new in a reading, which has a floor: size * sqrt(1 - (1 - white) correlation^2).
        Parts of the structure that the noise does not have get a start of their own; with growth, half of the variance.
        """
        size = noise.size if noise.structure.own_sizes or not structure.own_sizes else self.plain(structure).size
        size = np.maximum(size / self.unit, self.floor)
        if not structure.own_sizes:
            size = np.exp(np.mean(np.log(size), keepdims=True))
        numbers: list[ndarray] = []
        if structure.growth:
            growth = noise.growth
            if not growth > 0:
                growth = float(np.sqrt(np.mean(size**2) / 2 / np.mean(self.level**2)))
                size = size / np.sqrt(2)
            numbers.append(np.log([growth]))
        if structure.tails:
            known = np.isfinite(noise.tail)
            size = size if known else size / np.sqrt(2)
            numbers.append(np.array([1 / noise.tail if known else 0.2]))
        if structure.memory:
            correlated = self.correlated(noise, structure)
            white = correlated[1] if structure.white else 0.0
            size = np.maximum(size * np.sqrt(1 - (1 - white) * correlated[0] ** 2), self.floor)
            numbers += correlated
        if structure.common:
            shares, known = structure.shares(self.sensors), noise.common
            near = np.exp(-self.interval / (known.memory or 1e-9 * self.interval)) if known else np.exp(-1)
            numbers.append(np.clip([near], LEAST_CORRELATED, MOST_CORRELATED))
            begun = self.beside.begun(self.value, shares)
            numbers.append(begun if known is None else self.beside.reduced(known.share, shares, np.tanh(MOST)))
        return np.concatenate([np.log(size), *numbers])

    def correlated(self, noise: Noise, structure: Structure) -> list[Float[ndarray, " groups"]]:
        """Return correlations over the typical interval, and where a part is white its share of the variance.

        Where it is not known yet, it is such that the noise correlates over one interval as it is known to.
        """
        known = len(noise.white) > 0
        every = (noise.memory, noise.white if known else np.zeros(self.sensors))
        time, white = (one if structure.own_sizes else np.mean(one, keepdims=True) for one in every)
        rho = np.exp(-self.interval / np.where(time > 0, time, self.interval))
        if structure.white and not known:
            rho = np.sqrt(rho)
            white = 1 - rho
        if known and not structure.white:
            rho = (1 - white) * rho
        rho = np.clip(rho, LEAST_CORRELATED, MOST_CORRELATED)
        return [rho, np.minimum(white, MOST_WHITE)] if structure.white else [rho]

    def unpacked(self, numbers: Float[ndarray, " numbers"], structure: Structure) -> Noise:
        """Return the noise that numbers of `packed` stand for."""
        size, growth, tail, rho, white, near, shares = self.parts(numbers, structure)
        everyone, time = np.ones(self.sensors), self.time(np.where((1 - white) * rho > LEAST_CORRELATED, rho, 0.0))
        found = Noise(size * self.unit * everyone, growth, tail, time * everyone, structure)
        if structure.white:
            found = replace(found, white=np.where(time > 0, white, 0.0) * everyone)
        if not structure.common:
            return found
        read = np.bincount(self.sensor, minlength=self.sensors) > 0
        return replace(found, common=Common(np.where(read, np.tanh(shares), 0.0), float(self.time(np.array(near)))))

    def time(self, rho: Float[ndarray, " *any"]) -> Float[ndarray, " *any"]:
        """Return the times over which noise of some correlations over the typical interval is correlated."""
        return np.where(rho > 1.01 * LEAST_CORRELATED, -self.interval / np.log(np.maximum(rho, LEAST_CORRELATED)), 0.0)

    def parts(
        self, numbers: Float[ndarray, " numbers"], structure: Structure
    ) -> tuple[ndarray, float, float, ndarray, ndarray, float, ndarray]:
        """Return sizes, growth, degrees of freedom, correlations over the typical interval, and white shares.

        Last come the correlation of the common part, and a of each sensor.
        """
        groups = self.groups(structure)[1]
        new, rest = np.exp(numbers[:groups]), list(numbers[groups:])
        growth = float(np.exp(rest.pop(0))) if structure.growth else 0.0
        tail = float(1 / rest.pop(0)) if structure.tails else np.inf
        rho, rest = (np.array(rest[:groups]), rest[groups:]) if structure.memory else (np.zeros(groups), rest)
        white, rest = (np.array(rest[:groups]), rest[groups:]) if structure.white else (np.zeros(groups), rest)
        near, shares = (rest[0], np.array(rest[1:])) if structure.common else (0.0, np.zeros(self.sensors))
        if structure.common and len(shares) == 1:
            shares = shares * self.beside.signed(shares[0])
        size = new / np.sqrt(1 - (1 - white) * rho**2)
        return size, growth, tail, rho, white, near, shares

    def innovations(
        self, size: Each, growth: float, near: Each, *, white: bool
    ) -> tuple[Each, Each, Each, Each, Each, Each]:
        """Return sizes, residuals over these, those before, correlations, factors, and innovations.

        Args:
            size: at zero signal, of each reading.
            growth: with the signal.
            near: correlation over the typical interval, of each reading.
            white: whether part of the noise is white; the innovations are then those of its moving averages.
        """
        s = np.sqrt(size**2 + (growth * self.level) ** 2) if growth else size
        y, rho = self.value / s, np.zeros_like(self.value)
        if np.any(near):
            rho = np.where(self.linked, near if self.even else near**self.gap, 0.0)
            rho = np.minimum(rho, 1 - CLOSEST)
        q = np.ones_like(y) if white else 1 / np.sqrt(1 - rho**2)
        before = np.concatenate([[0.0], y[:-1]])
        return s, y, before, rho, q, (y - rho * before) * q

    def cost(self, numbers: Float[ndarray, " count"], structure: Structure) -> tuple[float, Float[ndarray, " count"]]:
        """Return minus the mean log likelihood of a reading, and its gradient."""
        size, growth, tail, near, white, common, shares = self.parts(numbers, structure)
        group, groups = self.groups(structure)
        s, y, before, rho, q, z = self.innovations(size[group], growth, near[group], white=structure.white)
        e = z
        mixed = self.beside.unmixings(shares, common, rho) if structure.common else []
        averages = None
        if mixed:
            e = self.beside.apply(mixed, z)
        elif structure.white:
            v = white[group]
            averages = Averages.of(1 - rho**2 + 2 * v * rho**2, -v * rho)
            e = averages.apply(z)
        slope = e if not structure.tails else (tail + 1) * e / (tail + e**2)
        cost = np.sum(np.log(s)) - np.sum(np.log(q)) + minus_log_density(e, tail)
        cost += sum(one.log_scale for one in mixed) + (averages.log_scale if averages else 0.0)
        by_own = by_white = np.zeros_like(z)
        if mixed:
            slope, by_share, by_common, by_own = self.beside.slopes(mixed, z, slope, common)
        elif averages:
            slope = averages.transposed(slope)
            by_variance, by_beside = averages.slopes(e, slope)
            by_white = 2 * rho**2 * by_variance - rho * by_beside
            by_own = (4 * v - 2) * rho * by_variance - v * by_beside
        # By y of each reading, which its own innovation and the next one depend on.
        by_y = slope * q
        by_y[:-1] -= (slope * q * rho)[1:]
        by_size = 1 - by_y * y
        share = (size[group] / s) ** 2 if structure.growth else np.ones_like(s)
        gradient = [np.bincount(group, share * by_size, minlength=groups)]
        if structure.growth:
            gradient.append(np.array([np.sum((1 - share) * by_size)]))
        if structure.tails:
            gradient.append(np.array([-(tail**2) * _by_tail(e, tail)]))
        if structure.memory:
            narrow = 0.0 if structure.white else 1.0
            by_rho = by_own - slope * before * q + narrow * (slope * rho * q * z - rho * q) * q
            by_near = by_rho * rho * np.where(self.linked, self.gap, 0.0) / near[group]
            wider = gradient[0] / (1 - (1 - white) * near**2)
            gradient.append(np.bincount(group, by_near, minlength=groups) + wider * (1 - white) * near)
        if structure.white:
            gradient.append(np.bincount(group, by_white, minlength=groups) - wider * near**2 / 2)
        if mixed:
            one = structure.shares(self.sensors) == 1
            by_shares = np.array([self.beside.signed(numbers[-1]) @ by_share]) if one else by_share
            gradient += [np.array([by_common]), by_shares]
        return float(cost) / len(y), np.concatenate(gradient) / len(y)


def _by_tail(z: Each, tail: float) -> float:
    """Return the derivative of `minus_log_density` by the degrees of freedom."""
    from scipy.special import digamma

    share = z**2 / tail
    constant = (digamma(tail / 2) - digamma((tail + 1) / 2) + 1 / tail) / 2
    return float(np.sum(np.log1p(share) - (tail + 1) / tail * share / (1 + share)) / 2 + len(z) * constant)
