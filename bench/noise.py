"""The noise of recordings as a fit of their motion leaves it, sensor by sensor, and whether the equation misfits.

The noise is estimated with the model of `latticebench.diagnosis.noise`. An equation that lacks something leaves more,
and that counts as noise, too; noise of two kinds is left out, for it could do the work of nearly any force. Differences
of neighbouring readings show the noise without any equation (`latticebench.diagnosis.instrument`): where a fit leaves
much more, the equation misfits, unless the rest is noise that is correlated from one reading to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.report.noise import noise_in_words
from latticebench.bench.report.units import units_of
from latticebench.diagnosis.instrument import ROBUST, of_readings, step_of, two_digits
from latticebench.diagnosis.noise import Noise
from latticebench.diagnosis.noise_estimate import estimate
from latticebench.diagnosis.rows import Rows
from latticebench.methods.engine.dynamics import split_parts
from latticebench.methods.engine.record import prepare
from latticebench.systems.samples import Samples, check_alike

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.record import Record
    from latticebench.methods.method import Fit

    Channels = Float[ndarray, "rows channels"]

# A fit that leaves more than so many times the noise that the readings show misfits. Of sixty records of 2 x 60
# readings, the right equation leaves at most 1.4 times the noise if it is white, and 1.6 times if its tails are heavy.
FAR = 1.75
# Innovations of noise as it was estimated are not correlated; more than this, over one to so many readings, shows that
# what is left is not such noise.
CORRELATED, LAGS = 0.15, 8
# The same in standard errors.
SURE = 4.0


# Readings without noise show what integrators and rounding leave; this share of their size is more than that.
SILENT = 1e-6


# A share of its readings that is left to a site without an equation, at least, however many splines it follows.
LEAST_SPARE = 0.05
TINY = np.finfo(float).tiny


@dataclass(frozen=True, eq=False)
class Left:
    """What a fit leaves of recordings.

    Attributes:
        noise: of each sensor: u of each site, then, for order 2 if it was observed, v.
        lines: the noise in words and in the units of the readings.
        times: how many times the noise that the readings show the fit leaves; NaN where they do not show it or have
            none.
        misfit: whether that is more than noise.
        silent: whether the readings have no noise.
    """

    noise: Noise
    lines: tuple[str, ...]
    times: float
    misfit: bool
    silent: bool = False

    @property
    def warning(self) -> tuple[str, ...]:
        """What is to be said where the equation misfits, or where that cannot be told."""
        if self.misfit:
            much = "a part of readings without noise" if self.silent else f"{two_digits(self.times)} times the noise"
            return (f"the equation leaves {much}: these bounds do not hold; see `latticebench diagnose`",)
        if self.silent:
            return ()
        if self.times > FAR:
            return (
                f"neighbouring readings differ by {two_digits(self.times)} times less than such noise without "
                "correlation: these bounds hold if it is the instrument's; see `latticebench diagnose`",
            )
        if np.isnan(self.times):
            return ("neighbouring readings do not show their noise, so that whether the equation fits is not known",)
        return ()


def fields_of(samples: Samples, order: int) -> list[ndarray]:
    """Return u and, for order 2 if it was observed, v."""
    return [samples.u] if order == 1 or samples.v is None else [samples.u, samples.v]


def centred(field: ndarray) -> ndarray:
    """Return readings about the middle of each sensor's: digits of a large constant would hide those of the motion."""
    with np.errstate(invalid="ignore"):
        middle = np.array([np.mean(one[np.isfinite(one)]) if np.any(np.isfinite(one)) else 0.0 for one in field.T])
    return np.asarray(field - middle)


def of_sensors(t: Float[ndarray, " time"], field: ndarray) -> tuple[Float[ndarray, " sites"], bool]:
    """Return the noise that each sensor shows by itself, at least SILENT of their size, and whether all is that.

    See `latticebench.diagnosis.instrument.of_readings`; of complex readings it is the size per part. A sensor that
    always reads the same, while others do not, shows none.
    """
    about = centred(field)
    shown = of_readings(t, about)
    same = np.array([len(np.unique(one[np.isfinite(one)])) < 2 for one in field.T])
    shown = np.where(same & ~np.all(same), np.nan, shown)
    square = np.nanmean(np.abs(about[:, np.any(np.isfinite(about), axis=0)]) ** 2, axis=0)
    least = SILENT * float(np.sqrt(np.max(square, initial=0.0)))
    told = np.isfinite(shown)
    return np.maximum(shown, least), bool(np.any(told) and np.all(shown[told] <= least))


def readings(samples: Samples, order: int) -> Channels:
    """Return the numbers of u and, for order 2 if it was observed, v as rows; NaN where nothing was read."""
    fields = fields_of(samples, order)
    return np.concatenate([split_parts(one, samples.is_complex).reshape(len(one), -1) for one in fields], axis=1)


def rows_of(data: Sequence[Samples], order: int) -> Rows:
    """Return times and sensors of the rows of `readings`, one recording after another."""
    first = data[0]
    levels = 1 if order == 1 or first.v is None else 2
    sensor = np.arange(levels * first.sites).reshape(levels, 1, first.sites)
    whole = np.broadcast_to(sensor, (levels, 1 + first.is_complex, first.sites))
    begins = np.concatenate([np.arange(len(one.t)) == 0 for one in data])
    return Rows(np.concatenate([one.t for one in data]), begins, whole.ravel())


def left_by(data: Sequence[Samples], fit: Fit) -> Left:
    """Return what a fit with a motion leaves of recordings, as noise of each sensor's own.

    Raises:
        InputError: the recordings differ in their sites, or in what was observed.
    """
    assert fit.motion is not None
    check_alike(data)
    order = fit.order
    rows = rows_of(data, order)
    # A motion has velocities even where none were observed.
    motion = [replace(exact, v=None if one.v is None else exact.v) for one, exact in zip(data, fit.motion, strict=True)]
    level = np.concatenate([readings(one, order) for one in motion])
    seen = np.concatenate([readings(one, order) for one in data])
    left = seen - level
    records = [prepare(one, fit.library.terms, order) for one in data]
    free = len(fit.library.terms) + sum(one.stretches.dynamics.size for one in records)
    own = _unspent(left, records, rows)
    # In units of what is left of each, the sensors of positions and of velocities may be alike.
    units = np.ones(rows.sensor[-1] + 1)
    if len(units) > data[0].sites:
        halves = np.split(own, 2, axis=1)
        units[data[0].sites :] = np.sqrt(np.nanmean(halves[1] ** 2) / max(np.nanmean(halves[0] ** 2), TINY)) or 1.0
    scale = units[rows.sensor]
    noise = estimate(own / scale, level / scale, rows, free=free, mixed=False)
    noise = replace(noise, size=noise.size * units)
    ratios, silent = _ratios(data, left, noise, rows, order)
    times = float(np.sqrt(np.mean(ratios**2))) if len(ratios) else np.nan
    misfit = bool(times > FAR) and not _is_memory(noise, left, level, rows)
    return Left(noise, tuple(_lines(data, noise, order)), np.nan if silent else times, misfit, silent)


def _unspent(left: Channels, records: Sequence[Record], rows: Rows) -> Channels:
    """Return residuals of the size of the noise at the sites without an equation, whose splines took a part of it."""
    drives = [one.stretches.drive for one in records]
    splines = sum(one.count for one in drives if one is not None)
    dynamics = records[0].stretches.dynamics
    border = np.isin(rows.sensor % dynamics.sites, dynamics.border)
    levels = records[0].value.shape[1]
    seen = levels * np.sum(np.isfinite(left[:, border]), axis=0)
    found = left.copy()
    found[:, border] /= np.sqrt(np.maximum(1 - splines / np.maximum(seen, 1), LEAST_SPARE))
    return found


def _ratios(
    data: Sequence[Samples], left: Channels, noise: Noise, rows: Rows, order: int
) -> tuple[Float[ndarray, " sensors"], bool]:
    """Return what is left at each sensor that shows its noise by itself, in units of that, and whether none has any."""
    longest = max(data, key=lambda one: len(one.t))
    each = [of_sensors(longest.t, one) for one in fields_of(longest, order)]
    shown = np.concatenate([one for one, _ in each])
    # Single outliers are no misfit.
    heavy = np.isfinite(noise.tail)
    own = np.full(len(shown), np.nan)
    for sensor in range(len(shown)):
        values = left[:, rows.sensor == sensor]
        values = values[np.isfinite(values)]
        if len(values):
            own[sensor] = ROBUST * np.median(np.abs(values)) if heavy else np.sqrt(np.mean(values**2))
    told = np.isfinite(shown) & (shown > 0) & np.isfinite(own)
    return np.asarray(own[told] / shown[told]), all(silent for _, silent in each)


def _is_memory(noise: Noise, left: Channels, level: Channels, rows: Rows) -> bool:
    """Whether correlated noise as it was estimated explains what is left: its innovations are not correlated."""
    if not noise.structure.memory:
        return False
    whitener = noise.whitener(level, rows, np.isfinite(left))
    z = np.where(whitener.seen, whitener.apply(left), np.nan)
    z = z * whitener.robust(z)
    power = float(np.nanmean(z**2))
    for lag in range(1, min(LAGS, len(z) - 1) + 1):
        # No pair reaches from one recording into the next.
        alike = np.cumsum(rows.first)[lag:] == np.cumsum(rows.first)[:-lag]
        pairs = (z[lag:] * z[:-lag])[alike]
        count = np.count_nonzero(np.isfinite(pairs))
        if count and abs(np.nanmean(pairs)) > power * max(CORRELATED, SURE / np.sqrt(count)):
            return False
    return True


def _lines(data: Sequence[Samples], noise: Noise, order: int) -> list[str]:
    """Return the noise in words, of u and of v if it was observed."""
    first = data[0]
    fields = [centred(one) for one in fields_of(first, order)]
    steps = [step_of(split_parts(one[:, k], first.is_complex).ravel()) for one in fields for k in range(first.sites)]
    return noise_in_words(noise, steps, float(np.median(np.diff(first.t))), first.sites, units_of(first.origin))
