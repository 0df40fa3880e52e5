"""Spectra of recordings: the peaks that are motion, and lines that are too fast for it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis import rules
from latticebench.methods.engine.dynamics import split_parts
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# A peak of the spectrum is motion where it stands so many times above the noise, and has this share of the largest.
ABOVE, SHARE = 30.0, 3e-3
# A gap of a sensor is interpolated where it has at most so many usual steps, or lasts half a period at most.
HOLE = 8.0
# The spectrum's grid has at most so many times, or four for each reading if that is more; it is so many times finer
# than the resolution.
MOST_GRID, FINER = 2**20, 4
# A fast line stands above the median of so many resolutions about it; so many of the strongest are kept, up to this
# share of half the rate of reading.
ABOUT, MOST_LINES, HIGHEST = 32, 8, 0.95
# Steps are equal where no time is farther from equal steps than this share of one; a step as long as so many usual ones
# is a gap. Rounded times are at most so many units of the rounding from equal steps: the first time is rounded, too.
EVEN, GAP, ROUNDED = 1e-3, 2.5, 1.5


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The mean power spectrum of all sensors.

    Attributes:
        omega: angular frequencies.
        power: relative.
        peaks: frequencies of the peaks that are motion, the strongest first.
    """

    omega: Float[ndarray, " frequencies"]
    power: Float[ndarray, " frequencies"]
    peaks: Float[ndarray, " peaks"]

    @classmethod
    def of(cls, samples: Samples) -> Spectrum:
        """Return the spectrum of a recording; missing and uneven readings are interpolated.

        A sensor's gap in which it swings is not: a line through it is a slow motion that nobody has seen. The spectrum
        is the sum of those of the longest stretches between such gaps.
        """
        few = HOLE * float(np.median(np.diff(samples.t)))
        omega, total = _mean(samples, few)
        half = np.pi / float(omega[1 + np.argmax(total[1:])])
        if half > few:
            omega, total = _mean(samples, half)
        floor = float(np.median(total[len(total) // 2 :]))
        inner = (total[1:-1] >= total[:-2]) & (total[1:-1] > total[2:])
        peaks = np.flatnonzero(inner) + 1
        tall = peaks[total[peaks] > max(ABOVE * floor, SHARE * float(np.max(total)))]
        return cls(omega, total, omega[tall[np.argsort(-total[tall])]])

    def between(self, peak: float) -> float:
        """Return the frequency of a peak by the parabola through the logarithms of the power beside it."""
        k = int(np.searchsorted(self.omega, peak))
        low, high, beyond = np.log(self.power[k - 1 : k + 2])
        return float(peak + (self.omega[1] - self.omega[0]) * (low - beyond) / (2 * (low - 2 * high + beyond)))


def lines(samples: Samples, above: float) -> Float[ndarray, " lines"]:
    """Return angular frequencies of the strongest lines that any one sensor shows beyond a frequency, in order.

    A line stands out from the frequencies about it, as mains do in a cable. Rounded times make lines, too: those that
    are gone where the readings are taken to be evenly spaced do not count.
    """
    omega, highest = _standing_out(samples, above)
    inner = np.flatnonzero((highest[1:-1] >= highest[:-2]) & (highest[1:-1] > highest[2:])) + 1
    tall = inner[highest[inner] > ABOVE]
    if not len(tall):
        return np.empty(0)
    even, other, there = _even(samples.t), omega, highest
    if even is not samples.t:
        other, there = _standing_out(replace(samples, t=even), above)
    near, found = FINER * rules.AROUND // 2, np.empty(0, dtype=int)
    for one in tall[np.argsort(-highest[tall])]:
        k = int(np.searchsorted(other, omega[one]))
        stays = np.max(there[max(k - FINER, 0) : k + FINER], initial=0.0) > ABOVE
        # The wings of a strong line are no lines of their own.
        if stays and not np.any(np.abs(found - one) < near) and len(found) < MOST_LINES:
            found = np.append(found, one)
    return np.sort(omega[found])


def _even(t: Float[ndarray, " time"]) -> Float[ndarray, " time"]:
    """Return rounded times with equal steps, but for gaps; others as they are.

    Times are rounded where all are multiples of one power of ten, and equal steps are no farther from them than that.
    """
    steps = np.diff(t)
    even = t[0] + np.cumsum([0.0, *np.where(steps < GAP * np.median(steps), mean_step(t), steps)])
    apart = float(np.max(np.abs(even - t)))
    if apart < EVEN * mean_step(t):
        return t
    unit = 10.0 ** np.ceil(np.log10(apart / ROUNDED))
    return np.asarray(even) if np.max(np.abs(t / unit - np.round(t / unit))) < EVEN else t


def _standing_out(samples: Samples, above: float) -> tuple[ndarray, Float[ndarray, " frequencies"]]:
    """Return angular frequencies beyond one, and by how many times a sensor stands above what is about it, at most."""
    omega, sensors = _powers(samples, HOLE * float(np.median(np.diff(samples.t))))
    size = FINER * ABOUT
    begin, end = np.searchsorted(omega, [above, HIGHEST * np.pi / mean_step(samples.t)])
    blocks = max(end - begin, 0) // size
    if blocks < 1:
        return np.empty(0), np.zeros(0)
    highest, middles = np.zeros(end - begin), (np.arange(blocks) + 0.5) * size
    for power in sensors:
        part = power[begin:end]
        floor = np.median(part[: blocks * size].reshape(blocks, size), axis=1)
        highest = np.maximum(highest, part / np.maximum(np.interp(np.arange(len(part)), middles, floor), 1e-300))
    return omega[begin:end], highest


def mean_step(t: Float[ndarray, " time"]) -> float:
    """Return the mean time between readings but for gaps; where times are rounded, the usual one is another."""
    steps = np.diff(t)
    return float(np.mean(steps[steps < GAP * np.median(steps)]))


def alias(omega: Float[ndarray, " lines"], step: float) -> Float[ndarray, " lines"]:
    """Return the angular frequencies from 0 to pi/step at which waves appear that are read so far apart."""
    rate = 2 * np.pi / step
    return np.abs((omega + rate / 2) % rate - rate / 2)


def hidden(omega: Float[ndarray, " lines"], step: float, above: float, near: float) -> int:
    """Return how many lines would look like slow ones, like one another or like noise, being read so far apart.

    Args:
        omega: their angular frequencies.
        step: between readings.
        above: what is not beyond this frequency is slow.
        near: what is no farther apart than this looks alike.
    """
    seen = np.sort(alias(omega, step))
    alike = int(np.sum(np.diff(seen) < near)) if len(seen) > 1 else 0
    return alike + int(np.sum((seen <= above) | (seen >= HIGHEST * np.pi / step)))


def _mean(samples: Samples, gap: float) -> tuple[Float[ndarray, " frequencies"], Float[ndarray, " frequencies"]]:
    """Return angular frequencies, and the mean power of all sensors at them."""
    omega, sensors = _powers(samples, gap)
    return omega, sum(sensors, np.zeros(len(omega)))


def _powers(samples: Samples, gap: float) -> tuple[Float[ndarray, " frequencies"], Iterator[ndarray]]:
    """Return angular frequencies, and the power at them of each sensor's stretches without a longer gap."""
    sensors = []
    for column in split_parts(samples.u, samples.is_complex).reshape(len(samples.t), -1).T:
        rows = np.flatnonzero(np.isfinite(column))
        parts = np.split(rows, np.flatnonzero(np.diff(samples.t[rows]) > gap) + 1)
        longest = max(map(len, parts))
        # The lines of much shorter ones are too broad beside those of the longest.
        sensors.append([(samples.t[part], column[part]) for part in parts if len(part) >= max(4, longest / 2)])
    step = float(np.median(np.diff(samples.t)))
    lasting = float(max((t[-1] - t[0] for one in sensors for t, _ in one), default=samples.t[-1] - samples.t[0]))
    # Many shorter gaps, too, must not make a grid that no memory holds.
    step = max(step, lasting / max(MOST_GRID, 4 * len(samples.t)))
    size = FINER * len(np.arange(0, lasting + step / 2, step))
    omega = 2 * np.pi * np.fft.rfftfreq(size, step)
    return omega, (_power(one, step, size) for one in sensors if one)


def _power(stretches: list[tuple[ndarray, ndarray]], step: float, size: int) -> Float[ndarray, " frequencies"]:
    """Return the power of a sensor's stretches on an even grid, as shares of their sum."""
    mean = np.mean(np.concatenate([values for _, values in stretches]))
    power = np.zeros(size // 2 + 1)
    for t, values in stretches:
        even = np.interp(np.arange(t[0], t[-1] + step / 2, step), t, values) - mean
        power += np.abs(np.fft.rfft(even * np.hanning(len(even)), size)) ** 2
    return np.asarray(power / max(float(np.sum(power)), 1e-300))
