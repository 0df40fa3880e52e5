"""The noise under which residuals are most likely, and which of its parts they show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.averages import Averages
from latticebench.diagnosis.common import Common
from latticebench.diagnosis.common_estimate import MOST, Beside
from latticebench.diagnosis.noise import Noise, Structure, minus_log_density
from latticebench.diagnosis.rows import CLOSEST, Rows, chained
from latticebench.diagnosis.walk_estimate import walked

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
# The largest share that is white where the rest of the noise is slow: with all of it there would be no rest.
MOST_WHITE = 0.999
# Slow noise beside a white one is looked for in correlations over so many readings, of innovations up to so many sizes.
LAGS, OUTLYING = 16, 3.0
# Nats that each part of the structure but `white` and `common` must win beyond Schwarz' penalty. Five parts are tried,
# on records of less than a hundred readings as well, and equal white sensors are to keep the simplest form in 98 of 100
# records.
MARGIN = 2.0
# Readings that the structure is chosen from, in stretches all over a longer record: what so many do not show changes
# sizes by less than a per cent.
GLANCE, STRETCHES = 20_000, 10
# Of a sensor's readings a fit leaves at least this share free.
SPARE = 0.2
# Steps to the size of a sensor whose noise is otherwise known: each takes it most of the way.
LENT = 8


def estimate(
    left: Readings, level: Readings, rows: Rows, *, free: Float[ndarray, " sensors"] | float = 0.0,
    structure: Structure | None = None, start: Noise | None = None, mixed: bool = True,
) -> Noise:  # fmt: skip
    """Return the noise under which residuals are most likely.

    Args:
        left: readings less what a model says, NaN where nothing was read.
        level: what the model says, in the same units.
        rows: times and sensors of both.
        free: how many numbers the fit of the model took from the n readings, of each sensor or of all together. Such a
            fit leaves residuals that are too small: sizes are multiplied by sqrt(n / (n - free)).
        structure: which parts to use; chosen by Schwarz' criterion if left out.
        start: where to start, such as the noise at the last step of an iteration.
        mixed: whether noise may be of two kinds where the structure is chosen: in common and not, or white and slow.
    """
    task = _Task.of(left, level, rows)
    apart = np.isin(rows.sensor, list(rows.curved | rows.walking))
    others = bool(np.any(np.isfinite(left[:, ~apart])))
    plain = np.where(apart, np.nan, left) if np.any(apart) and others else left
    if structure is not None and rows.walking and not others:
        # Where all zeros wander, growth, tails and what is common are not told from the walks.
        structure = replace(structure, growth=False, tails=False, white=False, common=False)
    if structure is None:
        start = _chosen(_Task.of(*_glance(plain, level, rows)), mixed)
        structure = start.structure
    if plain is left:
        found = task.best(structure, start)[0]
    else:
        found = task.lent(_Task.of(plain, level, rows).best(structure, start)[0], left, level, rows)
    if rows.walking:
        found = walked(found, left, level, rows, start)
    if found.structure.white and not np.any(found.white):
        found = replace(found, structure=replace(found.structure, white=False), white=np.zeros(0), price=0.0)
    everything, taken = len(task.value), float(np.sum(free))
    scale = float(np.sqrt(everything / max(everything - taken, 1.0))) if everything else 1.0
    own = np.full(task.sensors, scale)
    if np.ndim(free) and found.structure.own_sizes:
        count = np.bincount(task.sensor, minlength=task.sensors)
        own = np.sqrt(np.maximum(count, 1) / np.maximum(count - free, SPARE * np.maximum(count, 1)))
    return replace(found, size=found.size * own, growth=found.growth * scale, walk=found.walk * own[: len(found.walk)])


def _glance(left: ndarray, level: ndarray, rows: Rows) -> tuple[ndarray, ndarray, Rows]:
    """Return stretches of a long record, each a piece of its own; of a short one all there is."""
    count, kept = len(rows.times), GLANCE // max(len(rows.sensor), 1)
    if count <= kept:
        return left, level, rows
    begin = np.linspace(0, count - kept // STRETCHES, STRETCHES).astype(int)
    few = (begin[:, None] + np.arange(kept // STRETCHES)).ravel()
    first = rows.first[few]
    first[:: kept // STRETCHES] = True
    return left[few], level[few], replace(rows, times=rows.times[few], first=first)


def _chosen(task: _Task, mixed: bool) -> Noise:
    """Return the noise of the structure that Schwarz' criterion prefers, found step by step.

    One part is added or taken away at a time, whichever helps most, until nothing helps: what one part did alone may
    later be done better by another.
    """
    tried: dict[Structure, tuple[float, Noise]] = {}
    each = task.each
    # The common part takes long to fit: it is left alone where it is far from worth its two numbers.
    possible = [part for part in task.possible if mixed or part not in ("common", "white")]
    alone = "common" in possible and task.beside.promises(task.value) < each + rules.IN_COMMON / 2
    parts = [part for part in possible if part != "common" or not alone]

    def price(structure: Structure, near: Noise | None) -> float:
        if structure not in tried:
            noise, likelihood = task.best(structure, near)
            margins = MARGIN * (sum(vars(structure).values()) - structure.white - structure.common)
            margins += noise.price + rules.IN_COMMON * structure.common
            tried[structure] = each * noise.parameters + margins - likelihood, noise
        return tried[structure][0]

    here = Structure()
    price(here, None)
    while not task.is_exact():
        found = tried[here][1]
        ways = [replace(here, **{part: not getattr(here, part)}) for part in parts]
        best = min(ways, key=lambda one: price(one, found))
        if tried[best][0] >= tried[here][0]:
            break
        here = best
    return tried[here][1]


@dataclass(frozen=True, eq=False)
class _Task:
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
    def of(cls, left: Readings, level: Readings, rows: Rows) -> _Task:
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

    def best(self, structure: Structure, start: Noise | None) -> tuple[Noise, float]:
        """Return the noise of greatest likelihood with a given structure, and its log likelihood.

        A part is white besides a slow one only where that is worth its price: both together do the work of weak forces.
        """
        plain, likelihood = self.likeliest(replace(structure, white=False), start)
        if not structure.white or not plain.structure.memory or plain.structure.common or self.is_exact():
            return plain, likelihood
        groups = len(np.unique(self.sensor)) if structure.own_sizes else 1
        price = self.each * groups + rules.BESIDE_WHITE
        known = start is not None and len(start.white) > 0
        if not known and self.unsettled(plain) < price / 2:
            return plain, likelihood
        both, higher = self.likeliest(structure, start if known else plain)
        return (replace(both, price=price), higher) if higher > likelihood + price else (plain, likelihood)

    def unsettled(self, noise: Noise) -> float:
        """Return about how many nats the correlations of innovations over some readings are worth.

        Of n pairs of independent numbers the squared correlation times n / 2 is 1/2 nat on the mean.
        """
        group, groups = self.groups(noise.structure)
        size = (noise.size if noise.structure.own_sizes else noise.size[:1]) / self.unit
        time = (noise.memory if noise.structure.own_sizes else noise.memory[:1]) / self.interval
        near = np.where(time > 0, np.exp(-1 / np.where(time > 0, time, 1.0)), 0.0)
        *_, z = self.innovations(size[group], noise.growth, near[group], white=False)
        z = np.clip(z, -OUTLYING, OUTLYING)
        begin = np.flatnonzero(~self.linked)
        place = np.arange(len(z)) - np.repeat(begin, np.diff(begin, append=len(z)))
        variance = np.bincount(group, z**2, minlength=groups) / np.maximum(np.bincount(group, minlength=groups), 1)
        nats = 0.0
        for lag in range(1, min(LAGS, int(np.max(place))) + 1):
            pairs = np.flatnonzero(place >= lag)
            count = np.bincount(group[pairs], minlength=groups)
            total = np.bincount(group[pairs], z[pairs] * z[pairs - lag], minlength=groups)
            there = (count > 0) & (variance > 0)
            nats += float(np.sum((total[there] / variance[there]) ** 2 / count[there] - 1)) / 2
        return nats

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
            result = minimize(
                self.cost, numbers, args=(structure,), jac=True, method="L-BFGS-B", bounds=bounds,
                options={"ftol": 1e-4 / len(self.value), "gtol": 1e-5, "maxiter": 200},
            )  # fmt: skip
            found, cost = self.unpacked(np.asarray(result.x), structure), float(result.fun)
        return found, -len(self.value) * (cost + float(np.log(self.unit)))

    def lent(self, noise: Noise, left: Readings, level: Readings, rows: Rows) -> Noise:
        """Return the noise of all sensors, of which some have a size of their own and all else from the others."""
        borrows = np.isin(np.arange(self.sensors), list(rows.curved))
        if noise.common is not None:
            known = ~borrows & (noise.common.share != 0)
            mean = np.mean(noise.common.share[known]) if np.any(known) else 0.0
            share = np.where(borrows, mean, noise.common.share)
            noise = replace(noise, common=replace(noise.common, share=share))
        if not noise.structure.own_sizes:
            return noise
        alike = np.isin(np.arange(self.sensors), self.sensor)
        alike[list(rows.curved | rows.walking)] = False
        memory = np.where(borrows, np.mean(noise.memory[alike]), noise.memory)
        white = np.where(borrows, np.mean(noise.white[alike]), noise.white) if len(noise.white) else noise.white
        first = self.plain(noise.structure).size / (np.sqrt(2) if np.isfinite(noise.tail) else 1.0)
        found = replace(noise, size=np.where(borrows, first, noise.size), memory=memory, white=white)
        for _ in range(LENT):
            size = np.maximum(found.size * np.sqrt(_excess(found, left, level, rows)), self.floor * self.unit)
            found = replace(found, size=np.where(borrows, size, noise.size))
        return found

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


def _excess(noise: Noise, left: Readings, level: Readings, rows: Rows) -> Float[ndarray, " sensors"]:
    """Return by how much the variance of each sensor's innovations is beyond that of the noise, weighed by it."""
    whitener, sensors = noise.whitener(level, rows, np.isfinite(left)), len(noise.size)
    z = whitener.apply(np.where(whitener.seen, left, 0.0))
    square = np.sum((whitener.robust(z) * z) ** 2, axis=0)
    count = np.bincount(rows.sensor, np.sum(whitener.seen, axis=0), minlength=sensors)
    mean = np.bincount(rows.sensor, square, minlength=sensors) / np.maximum(count, 1)
    return np.where(mean > 0, mean, 1.0)


def _by_tail(z: Each, tail: float) -> float:
    """Return the derivative of `minus_log_density` by the degrees of freedom."""
    from scipy.special import digamma

    share = z**2 / tail
    constant = (digamma(tail / 2) - digamma((tail + 1) / 2) + 1 / tail) / 2
    return float(np.sum(np.log1p(share) - (tail + 1) / tail * share / (1 + share)) / 2 + len(z) * constant)
