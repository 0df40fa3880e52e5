"""Recordings that begin before the lattice is let go, or go on when it is caught or stuck, away from where it rests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.spectrum import Spectrum
from latticebench.methods.engine.dynamics import split_parts
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# A sensor is at rest where it scatters by at most this share of what it does in the whole recording. One that does
# hardly more than this share of what the liveliest does tells nothing.
STILL = 0.1
# It moves where two readings in a row are so many standard deviations of that scatter away.
MOVES = 5.0
# Fewer readings than this are too few for a scatter.
FEWEST = 8
# Per cent of a Gaussian below its mean less and plus a standard deviation.
QUANTILES = (15.87, 84.13)
# What comes to rest away from its middle has swung through there so many times before: else it may be on its way still.
PASSES = 4
# Periods of motion that have to be left, and that a mean is taken of.
NEAR = 2.0


@dataclass(frozen=True)
class Held:
    """How long nothing moves as a recording begins or ends.

    Attributes:
        source: of the recording.
        begin, end: the times between which nothing moves; one is the recording's first or last, the other that of the
            first or last reading in which something plainly moves.
        rows: how many were left out.
        early: whether this is as it begins.
    """

    source: str
    begin: float
    end: float
    rows: int
    early: bool


def freed(samples: Samples) -> tuple[Samples, tuple[Held, ...]]:
    """Return a recording from where it is let go to where it is caught or stuck, and what was left out.

    It is held where no sensor moves for `rules.HELD` periods of the main frequency at least, and one of them reads
    something else then than in the mean of the nearest motion: what rests where it belongs may be pushed later.
    """
    t, count = samples.t, len(samples.t)
    if count < 2 * FEWEST:
        return samples, ()
    values, period = split_parts(samples.u, samples.is_complex).reshape(count, -1), _period(samples)
    early = _resting(values, int(np.searchsorted(t, t[0] + rules.HELD * period)))
    late = _resting(values[::-1], count - int(np.searchsorted(t, t[-1] - rules.HELD * period)))
    if count - early - late < 2 * FEWEST:
        return samples, ()
    if early:
        period = _period(samples.of_rows(slice(early, count - late)))
        early = early if _away(values[:early], values[early : np.searchsorted(t, t[early] + NEAR * period)]) else 0
    if late:
        end = count - late
        period = _period(samples.of_rows(slice(early, end)))
        near = values[np.searchsorted(t, t[end - 1] - NEAR * period) : end]
        late = late if _away(values[end:], near) and _swings(values[early:end], values[end:]) else 0
    moving = samples.of_rows(slice(early, count - late))
    if not (early or late) or np.ptp(moving.t) < NEAR * _period(moving):
        return samples, ()
    found = []
    if early:
        found.append(Held(samples.source, float(t[0]), float(t[early]), early, early=True))
    if late:
        found.append(Held(samples.source, float(t[count - late - 1]), float(t[-1]), late, early=False))
    return moving, tuple(found)


def _period(samples: Samples) -> float:
    """Return the period of the strongest peak of the spectrum, or how long the recording is if that is less."""
    peaks, span = Spectrum.of(samples).peaks, float(np.ptp(samples.t))
    return min(2 * np.pi / float(peaks[0]), span) if len(peaks) else span


def _resting(values: Float[ndarray, "time sensors"], shortest: int) -> int:
    """Return in how many rows nothing moves at first; 0 where something does.

    Args:
        values: readings; NaN for none.
        shortest: fewer rows than this do not count.
    """
    shortest = max(shortest, FEWEST)
    values = values[:, np.all(_read(values[:shortest], values[shortest:]), axis=0)]
    if not values.size or not _still(values, shortest):
        return 0
    row = 0
    # What so few readings scatter is known the better the more there are.
    while row < shortest < len(values):
        row, shortest = shortest, _moved(values, shortest)
    return shortest if len(values) - shortest >= FEWEST else 0


def _moved(values: Float[ndarray, "time sensors"], rows: int) -> int:
    """Return after how many rows, `rows` or more, something moves away from where it is in these."""
    middle, scatter = np.nanmedian(values[:rows], axis=0), np.maximum(_scatter(values[:rows]), _finest(values))
    away = np.any(np.abs(values - middle) > MOVES * scatter, axis=1)
    twice = np.flatnonzero(away[rows:-1] & away[rows + 1 :])
    return rows + int(twice[0]) if len(twice) else len(values)


def _away(rest: Float[ndarray, "time sensors"], motion: Float[ndarray, "time sensors"]) -> bool:
    """Return whether a sensor reads something else at rest than in the mean of the motion."""
    rest, motion = (part[:, np.all(_read(rest, motion), axis=0)] for part in (rest, motion))
    if not rest.size:
        return False
    apart = np.abs(np.nanmean(motion, axis=0) - np.nanmedian(rest, axis=0))
    return bool(np.any(apart > np.maximum(rules.AWAY * np.nanstd(motion, axis=0), MOVES * _scatter(rest))))


def _read(*parts: Float[ndarray, "time sensors"]) -> list[ndarray]:
    """Return which sensors each part of a recording has enough readings of."""
    return [np.sum(np.isfinite(part), axis=0) >= FEWEST for part in parts]


def _still(values: Float[ndarray, "time sensors"], rows: int) -> bool:
    """Return whether no sensor moves in the first rows."""
    swing = np.nanstd(values, axis=0)
    lively = swing > STILL * np.max(swing)
    return bool(np.any(lively) and np.all(_scatter(values[:rows])[lively] <= STILL * swing[lively]))


def _scatter(values: Float[ndarray, "time sensors"]) -> Float[ndarray, " sensors"]:
    """Return half of what lies between two quantiles: a standard deviation, whatever single outliers do."""
    low, high = np.nanpercentile(values, QUANTILES, axis=0)
    return np.asarray((high - low) / 2)


def _swings(values: Float[ndarray, "time sensors"], later: Float[ndarray, "time sensors"]) -> bool:
    """Return whether the liveliest sensor passed the place where it rests later again and again."""
    values, later = (part[:, np.all(_read(values, later), axis=0)] for part in (values, later))
    site = int(np.argmax(np.nanvar(values, axis=0)))
    column = values[:, site][np.isfinite(values[:, site])]
    return int(np.sum(np.diff(np.sign(column - np.nanmedian(later[:, site]))) != 0)) >= PASSES


def _finest(values: Float[ndarray, "time sensors"]) -> Float[ndarray, " sensors"]:
    """Return the least change of each sensor from one reading to the next, which steps of a converter hide."""
    changes = np.abs(np.diff(values, axis=0))
    return np.asarray(np.min(np.where(changes > 0, changes, np.inf), axis=0, initial=np.inf))
