"""How far a zero wanders, and the noise besides, under which the residuals of a sensor are most likely."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.averages import Averages
from latticebench.diagnosis.noise import Noise, minus_log_density
from latticebench.diagnosis.rows import Rows, chained
from latticebench.diagnosis.walk import covariance

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

    from latticebench.diagnosis.noise import Readings

# Variance that a zero gains from one reading to the next over that of the noise: the least, which is none, and where
# the search for the likeliest begins.
LEAST, FIRST = 1e-10, 1e-3
# How far the size of the noise may be from that of the differences of readings, as a factor.
FAR = 100.0


def walked(noise: Noise, left: Readings, level: Readings, rows: Rows, start: Noise | None = None) -> Noise:
    """Return the noise with the sizes and the walks of the sensors whose zeros wander.

    Args:
        noise: of all other sensors, whose tails and growth the wandering ones share.
        left: residuals, NaN where nothing was read.
        level: what the model says.
        rows: times and sensors of both.
        start: where to start.
    """
    size, memory, walk = noise.size.copy(), noise.memory.copy(), np.zeros(len(noise.size))
    for sensor in sorted(rows.walking):
        task = _Task.of(noise, left, level, rows, sensor)
        if task is not None:
            known = start is not None and len(start.walk) and start.walk[sensor] > 0
            near = (start.size[sensor], start.walk[sensor]) if start is not None and known else None
            size[sensor], walk[sensor] = task.best(near)
            memory[sensor] = 0.0
    common = noise.common
    if common is not None:
        alone = np.isin(np.arange(len(size)), list(rows.walking))
        common = replace(common, share=np.where(alone, 0.0, common.share))
    white = np.where(memory > 0, noise.white, 0.0) if len(noise.white) else noise.white
    return replace(noise, size=size, memory=memory, white=white, walk=walk, common=common)


def won_by_walking(noise: Noise, left: Readings, level: Readings, rows: Rows, sensors: Collection[int]) -> ndarray:
    """Return the nats that each of some sensors would win if its zero wandered: (sensors,)."""
    found = []
    for sensor in sensors:
        here = np.where(rows.sensor == sensor, left, np.nan)
        before = noise.log_likelihood(here, level, rows)
        after = walked(noise, left, level, replace(rows, walking=frozenset([sensor])))
        found.append(after.log_likelihood(here, level, rows) - before)
    return np.array(found)


@dataclass(frozen=True, eq=False)
class _Task:
    """Readings of one sensor in their order.

    Attributes:
        differences: of residuals, from one reading to the next; at the first of a piece the residual.
        grown: how much the noise grows with the signal there, in units of the readings.
        time: since the reading before, or since the recordings began.
        linked: whether there is a reading before.
        unit: the size of noise with such differences.
        interval: the usual time between readings.
        most: the most that the variance may gain between two readings, over that of the noise.
        least: the least size of the noise.
        tail: of Student's t.
    """

    differences: Float[ndarray, " readings"]
    grown: Float[ndarray, " readings"]
    time: Float[ndarray, " readings"]
    linked: Bool[ndarray, " readings"]
    unit: float
    interval: float
    most: float
    least: float
    tail: float

    @classmethod
    def of(cls, noise: Noise, left: Readings, level: Readings, rows: Rows, sensor: int) -> _Task | None:
        """Return the task; None where the sensor has no two readings in a piece."""
        chain = chained(rows, np.isfinite(left) & (rows.sensor == sensor))
        linked = np.isfinite(chain.gap)
        if not np.any(linked):
            return None
        value = chain.of(left)
        differences = value - np.where(linked, np.concatenate([[0.0], value[:-1]]), 0.0)
        interval = float(np.median(chain.gap[linked]))
        unit = max(float(np.sqrt(np.mean(differences[linked] ** 2) / 2)), rows.least, np.finfo(float).tiny ** 0.5)
        return cls(
            differences, noise.growth * np.abs(chain.of(level)),
            np.where(linked, chain.gap, chain.time - np.min(rows.times)), linked, unit, interval,
            max(min(rows.fastest**2 * interval, 1.0), 10 * LEAST), rows.least, noise.tail,
        )  # fmt: skip

    def best(self, near: tuple[float, float] | None) -> tuple[float, float]:
        """Return the size of the noise and the walk after a unit of time that are likeliest."""
        from scipy.optimize import minimize

        size, walk = near or (self.unit, np.sqrt(FIRST / self.interval) * self.unit)
        start = np.log([size / self.unit, max((walk / size) ** 2 * self.interval, 2 * LEAST)])
        bounds = [
            (np.log(max(1 / FAR, self.least / self.unit)), np.log(FAR)), (np.log(LEAST), np.log(self.most))
        ]  # fmt: skip
        found = minimize(
            self.cost, np.clip(start, *np.transpose(bounds)), method="L-BFGS-B", bounds=bounds,
            options={"ftol": 1e-3 / len(self.differences), "eps": 1e-5},
        ).x  # fmt: skip
        size = float(np.exp(found[0])) * self.unit
        return size, float(np.exp(found[1] / 2) / np.sqrt(self.interval)) * size

    def cost(self, numbers: Float[ndarray, " two"]) -> float:
        """Return minus the mean log likelihood of a reading, with the logarithms of size and gain of variance."""
        plain = float(np.exp(numbers[0])) * self.unit
        walk = np.full(len(self.differences), np.exp(numbers[1] / 2) / np.sqrt(self.interval) * plain)
        size = np.hypot(plain, self.grown)
        averages = Averages.of(*covariance(size, walk, self.time, self.linked))
        z = averages.apply(self.differences)
        return (averages.log_scale + minus_log_density(z, self.tail)) / len(z)
