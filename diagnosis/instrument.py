"""What readings say of the instrument that took them, before any equation: whether it works, its step, its noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.noise import Noise
from latticebench.methods.engine.record import without_halves

if TYPE_CHECKING:
    from jaxtyping import Float, Shaped
    from numpy import ndarray

    from latticebench.systems.samples import Samples

# A sensor that has read one number so many times, while another's readings change, does not work.
DEAD = 20
# Levels that a step is looked for in; fewer may lie at equal distances by chance.
FEWEST_LEVELS = 4
# A range of more steps than this is printed with six digits, which is not the grid of a converter, unless it is coarse.
PRINTED = 1e5
# Steps below this share of the noise add less than a thousandth to its variance: they are fine.
COARSE = 0.1
# Levels in the middle, where they lie close, that the step is first estimated from.
COMB = 200
# Steps between the first and the last of these; readings on no grid have more.
MOST_TEETH = 5000
# Gaps of so many steps are looked at first, where the step is known to this share.
SMALL_GAPS, SLACK = 6.0, 0.03
# Chance, in nats, of readings on no grid to lie as close to one as a step is allowed to be found at.
UNLIKELY = 12.0
# Orders of the differences that the noise is looked for in. At six readings a period each halves the signal.
MOST_ORDER = 16
# A smaller factor from one order to the next is a signal's; even strongly correlated noise falls more slowly.
FALLING = 0.85
# A line of the spectrum stands out from its surroundings by this factor; chance does once in 1e9.
LINE = 30.0
# Cycles per reading from which on differences take little from a signal.
FAST = 0.2
# Bands of the spectrum, of which one may hold nothing but noise, and the fewest frequencies in each.
BANDS, FEWEST_LINES = 16, 8
# A size within so many times the smallest that is looked for may be any smaller one.
AT_LEAST = 1.1
# A slow part is said to be all of the noise from this share of its variance on.
MOST_SLOW = 0.995
# Less than this share of the variance that is slow, or in common, is not said.
LEAST_COMMON = 0.01
WITH_OTHERS = "in common with the other sensors"
ROBUST = 1.4826  # standard deviation over median absolute value, of a Gaussian


# Sensors that do not work ---------------------------------------------------------------------------------------------


def dead_sensors(data: Sequence[Samples]) -> tuple[int, ...]:
    """Return the sites whose sensors read one number all the time, while others' readings change.

    Args:
        data: recordings of one chain; a sensor works where it does in any of them.
    """
    fields = [np.concatenate([one.u for one in data])]
    if all(one.v is not None for one in data):
        fields.append(np.concatenate([one.v for one in data if one.v is not None]))
    changes = np.any([np.any(field != _first(field), axis=0, where=np.isfinite(field)) for field in fields], axis=0)
    still = np.flatnonzero(~changes & (np.sum(np.isfinite(fields[0]), axis=0) >= DEAD))
    return tuple(still.tolist()) if np.any(changes) else ()


def without(samples: Samples, sites: Sequence[int]) -> Samples:
    """Return a recording without the readings of the sensors at some sites."""
    kept = ~np.isin(np.arange(samples.sites), sites)
    u, v = (None if field is None else np.where(kept, field, np.nan) for field in (samples.u, samples.v))
    return samples if np.all(kept) or u is None else without_halves(replace(samples, u=u, v=v))


def _first(field: Shaped[ndarray, "time sites"]) -> Shaped[ndarray, " sites"]:
    """Return the first reading of each sensor; NaN where there is none."""
    return np.asarray(field[np.argmax(np.isfinite(field), axis=0), np.arange(field.shape[1])])


# The step of a converter ----------------------------------------------------------------------------------------------


def step_of(values: Float[ndarray, " values"]) -> float:
    """Return the step of the converter that readings come from, in their units; 0 where none is seen.

    Readings are multiples of the step up to a common offset, and up to the last digit that they were printed with:
    steps of 0.068 printed with two decimals lie 0.06 or 0.07 apart. A grid of printing alone, with six digits or more,
    counts where it is coarse beside the scatter from one reading to the next.

    Args:
        values: readings of one sensor in the order of their times; NaN where nothing was read.
    """
    values = values[np.isfinite(values)]
    levels = np.unique(values)
    if len(levels) < FEWEST_LEVELS:
        return 0.0
    digit = _last_digit(levels)
    # Equal but for rounding of the arithmetic.
    levels = levels[np.concatenate([[True], np.diff(levels) > max(digit / 2, 1e-9 * float(np.max(abs(levels))))])]
    if len(levels) < FEWEST_LEVELS:
        return 0.0
    step = next((step for step in _steps(levels, digit) if step > 0), digit)
    if step <= 0:
        return 0.0
    if np.ptp(levels) > PRINTED * step and step < COARSE * min(_scales(np.arange(float(len(values))), values)):
        return 0.0
    return float(step)


def _last_digit(levels: Float[ndarray, " levels"]) -> float:
    """Return the power of ten that all levels are multiples of; 0 where it is lost in the arithmetic."""
    largest = float(np.max(np.abs(levels)))
    exponent = int(np.ceil(np.log10(largest)))
    for digits in range(12):
        unit = 10.0 ** (exponent - digits)
        # Doubles have 16 digits: twelve are read to within this.
        if np.max(np.abs(levels / unit - np.round(levels / unit))) < 1e-4:
            return unit
    return 0.0


def _steps(levels: Float[ndarray, " levels"], digit: float) -> Iterator[float]:
    """Yield the steps, or 0, that the least gaps suggest: they may be one, two or three steps."""
    gaps = np.diff(levels)
    least = float(np.min(gaps))
    if len(gaps) < FEWEST_LEVELS - 1 or least < 1.5 * digit:
        return
    for parts in (1, 2, 3):
        near = gaps[gaps < least + 1.01 * digit + 0.01 * least]
        yield _refined(levels, float(np.mean(near)) / parts, digit)


def _refined(levels: Float[ndarray, " levels"], step: float, digit: float) -> float:
    """Return the step that levels are multiples of within what printing rounds, from a first guess; 0 if none is."""
    allowed, kept = 0.8 * digit + 1e-3 * step, min(len(levels), COMB)
    some = _middle(levels, kept)
    teeth = float(np.ptp(some)) / step
    if step < 1.5 * digit or teeth > MOST_TEETH or not _even(np.diff(levels), step, allowed):
        return 0.0
    # Of combs of different rates the one that passes through most levels, so many that none is passed over.
    rates = np.linspace(0.85, 1.15, 3 * round(teeth) + 10) / step
    step = 1 / float(rates[np.argmax(np.abs(np.sum(np.exp(2j * np.pi * rates[:, None] * some), axis=1)))])
    while True:
        some = _middle(levels, kept)
        counts = np.round((some - some[0]) / step)
        if not counts[-1] > 0:
            return 0.0
        step, start = (float(number) for number in np.polyfit(counts, some, 1))
        if not step > 0 or np.max(np.abs(some - start - step * counts)) > allowed:
            return 0.0
        if kept == len(levels):
            break
        # By so little at a time that what the step is off by does not miscount the teeth.
        kept = min(kept + kept // 5, len(levels))
    unlikely = -len(levels) * np.log(min(2 * allowed / step, 1.0))
    return step if unlikely > UNLIKELY else 0.0


def _even(gaps: Float[ndarray, " gaps"], step: float, allowed: float) -> bool:
    """Return whether small gaps are multiples of about a step, as a converter's are: a first, quick look."""
    counts = gaps[gaps < SMALL_GAPS * step] / step
    return bool(np.all(np.abs(counts - np.round(counts)) < 2 * allowed / step + SLACK * counts))


def _middle(levels: Float[ndarray, " levels"], kept: int) -> Float[ndarray, " kept"]:
    """Return so many levels in the middle."""
    return levels[(len(levels) - kept) // 2 :][:kept]


# The size of the noise ------------------------------------------------------------------------------------------------


def of_readings(t: Float[ndarray, " time"], u: Shaped[ndarray, "time sites"]) -> Float[ndarray, " sites"]:
    """Return the size of each sensor's noise from its readings alone; NaN where it cannot be told from the signal.

    Divided differences of rising order, scaled such that white noise keeps its size, take a smooth signal away: at
    eight readings a period each order leaves four tenths of it. The size is that at the first order beyond which
    nothing more goes away, as a robust scale, which single outliers hardly change. Where readings are rounded and the
    rest is less, it is that of rounding, step / sqrt(12). With three readings a period, a signal looks like noise.

    Of noise that is correlated from one reading to the next it is a lower estimate: only the part is seen that changes
    from reading to reading. Of complex readings it is the size per part.

    Args:
        t: times, increasing; they need not be even.
        u: readings, NaN where nothing was read.
    """
    if np.iscomplexobj(u):
        return np.asarray(np.sqrt((of_readings(t, u.real) ** 2 + of_readings(t, u.imag) ** 2) / 2))
    found = np.full(u.shape[1], np.nan)
    for site in range(u.shape[1]):
        kept = np.isfinite(u[:, site])
        kept[1:] &= np.diff(t) > 0
        if np.count_nonzero(kept) > 4:
            found[site] = _size(t[kept], u[kept, site])
    return found


def quietest(t: Float[ndarray, " time"], u: Float[ndarray, "time parts sites"]) -> Float[ndarray, " sites"]:
    """Return the size of white noise whose spectrum is that of the readings where it is least; NaN where that is open.

    Of noise that has not all frequencies alike it is a lower estimate. Missing and uneven readings are interpolated.
    """
    step = float(np.median(np.diff(t)))
    grid = np.arange(t[0], t[-1] + step / 2, step)
    if len(grid) < 2 * BANDS * FEWEST_LINES:
        return np.full(u.shape[2], np.nan)
    window = np.hanning(len(grid))
    found = np.full(u.shape[1:], np.nan)
    for part, site in np.ndindex(*found.shape):
        seen = np.isfinite(u[:, part, site])
        if np.sum(seen) < len(grid) / 2:
            continue
        even = np.interp(grid, t[seen], u[seen, part, site])
        power = np.abs(np.fft.rfft((even - np.mean(even)) * window)[1:-1]) ** 2 / np.sum(window**2)
        found[part, site] = np.sqrt(min(np.median(band) for band in np.array_split(power, BANDS)) / np.log(2))
    return np.asarray(np.sqrt(np.mean(found**2, axis=0)))


def _size(t: Float[ndarray, " time"], values: Float[ndarray, " time"]) -> float:
    """Return the size of the noise of readings without gaps."""
    count = len(values)
    least = step_of(values) / np.sqrt(12)
    sizes = np.array(list(_scales(t, values)))
    # Neighbouring differences share readings: fewer of them count.
    spread = 1.2 * np.sqrt(np.sqrt(2.0 * np.arange(1, len(sizes) + 1)) / count)
    for order in range(len(sizes) - 1):
        later = sizes[order + 1 :]
        if sizes[order] <= least:
            return float(least)
        if sizes[order] <= np.min(later * (1 + 2 * spread[order + 1 :])):
            falls = later[0] < FALLING * sizes[order] * (1 - spread[order])
            return np.nan if falls or _has_fast_lines(values, order + 1) else float(max(sizes[order], least))
    return float("nan")


def _scales(t: Float[ndarray, " time"], values: Float[ndarray, " time"]) -> Iterator[float]:
    """Yield robust scales of divided differences of order 1, 2, ..., in units of what they make of white noise."""
    t = (t - t[0]) / float(np.median(np.diff(t)))
    differences, weights = values - np.median(values), np.ones((1, len(t)))
    for order in range(1, min(MOST_ORDER, len(t) // 3) + 1):
        # Times the factorial of the order the numbers stay moderate.
        width = (t[order:] - t[:-order]) / order
        differences = np.diff(differences) / width
        nothing = np.zeros((1, len(width)))
        weights = (np.vstack([nothing, weights[:, 1:]]) - np.vstack([weights[:, :-1], nothing])) / width
        yield ROBUST * float(np.median(np.abs(differences) / np.sqrt(np.einsum("kt,kt->t", weights, weights))))


def _has_fast_lines(values: Float[ndarray, " time"], order: int) -> bool:
    """Whether lines of the spectrum, faster than about five readings a period, make much of differences."""
    if len(values) < 64:
        return False
    centred = values - np.mean(values)
    cycles = np.fft.rfftfreq(len(values))
    fast = cycles > FAST
    power = np.abs(np.fft.rfft(centred * np.hanning(len(values)))[fast]) ** 2
    passed = power * (2 * np.sin(np.pi * cycles[fast])) ** (2 * order)
    lines = power > LINE * np.median(power)
    return bool(np.sum(passed[lines]) > np.sum(passed[~lines]))


# In words -------------------------------------------------------------------------------------------------------------


def describe(
    noise: Noise,
    steps: Sequence[float],
    unit: str = "",
    *,
    interval: float | None = None,
    least: float = 0.0,
    time: str = "",
    span: float | None = None,
) -> list[str]:
    """Return the noise in words, a line for each sensor, or one line for all if they are alike.

    Args:
        noise: to be described; sizes are said as standard deviations, and nothing of a sensor of which it is NaN.
        steps: step of each sensor's converter, 0 where there is none; what is fine beside the noise is not said.
        unit: of the readings.
        interval: time from one reading to the next; with it, the correlation over it is said.
        least: the smallest size that was looked for.
        time: unit of the times.
        span: length of the recording; with it, how far zeros wander is said.
    """
    lines: dict[int, str] = {}
    walks = noise.walk if len(noise.walk) else np.zeros(len(noise.size))
    every = zip(noise.deviation(), noise.memory, steps, walks, strict=True)
    for number, (size, memory, step, walk) in enumerate(every):
        if np.isnan(size):
            continue
        most = "at most " if size < AT_LEAST * least else ""
        parts = [f"{most}{two_digits(size)} {unit}".rstrip()]
        if step > COARSE * size:
            parts.append(f"steps of {two_digits(step)}")
        slow = 1 - noise.white[number] if len(noise.white) else 1.0
        if memory > 0 and slow > LEAST_COMMON:
            near = (
                f" ({two_digits(slow * np.exp(-interval / memory))} from one reading to the next)" if interval else ""
            )
            share = f"{two_digits(100 * slow)} % of its variance " if slow < MOST_SLOW else ""
            parts.append(f"{share}correlated over {two_digits(memory)} {time}".rstrip() + near)
        if span is not None and walk > 0:
            parts.append(f"a zero that wanders by {two_digits(walk * np.sqrt(span))} {unit}".rstrip())
        if noise.common is not None and noise.common.share[number] ** 2 > LEAST_COMMON:
            turned = noise.common.share[number] * np.sum(noise.common.share) < 0
            parts.append(_in_common(float(noise.common.share[number] ** 2), turned, noise.common.memory, time))
        if np.isfinite(noise.tail):
            parts.append(f"tails of Student's t with {two_digits(noise.tail)} degrees of freedom")
        if noise.growth > 0:
            parts.append(f"grows with the signal by {two_digits(100 * noise.growth * noise.tailed)} %")
        lines[number] = ", ".join(parts)
    if len(lines) > 1 and len(set(lines.values())) == 1:
        return [f"all sensors: {next(iter(lines.values()))}".replace(WITH_OTHERS, "in common")]
    return [f"sensor {number + 1}: {line}" for number, line in lines.items()]


def _in_common(share: float, turned: bool, memory: float, time: str) -> str:
    """Return what share of its variance a sensor has in common with the others in words."""
    round_ = ", turned round" if turned else ""
    slow = f", correlated over {two_digits(memory)} {time}".rstrip() if memory > 0 else ""
    return f"{two_digits(100 * share)} % of its variance {WITH_OTHERS}{round_}{slow}"


def two_digits(value: float) -> str:
    """Return a number with two digits that count."""
    return f"{float(f'{value:.2g}'):g}"
