"""What a recording is like before any equation: sites, sampling, gaps, ranges, noise, frequencies, suspicious things.

Readings, noise and steps are in the units of the file, times and frequencies in that of its times.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.noise import centred
from latticebench.bench.report.notes import at_ends, degrees, resting, resting_at, strays, turns
from latticebench.diagnosis.held import freed
from latticebench.diagnosis.instrument import of_readings, step_of
from latticebench.diagnosis.spectrum import Spectrum
from latticebench.methods.engine.dynamics import split_parts
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from numpy import ndarray

# A step between readings this many times the usual one is a gap.
GAP = 2.5
# A share of the noise's variance that makes rounding worth a word.
ROUNDED = 0.5
# Readings in a period, and periods in a record, below which little can be told.
SPARSE, SHORT = 5.0, 3.0
PEAKS = 5
# A sensor was silent for long where it was for this share of the recording, in which others were read so many times.
HOLE, FEW = 0.05, 8


@dataclass(frozen=True)
class Sensor:
    """The readings of one sensor; of a complex field, of its real and imaginary part together.

    Attributes:
        name: the column in the file.
        readings, missing: how many there are, and how many are missing.
        least, most: the range.
        noise: standard deviation; NaN where neighbouring readings do not show it.
        step: of the converter; 0 where none is seen.
    """

    name: str
    readings: int
    missing: int
    least: float
    most: float
    noise: float
    step: float


@dataclass(frozen=True)
class Inspection:
    """What one trajectory is like.

    Attributes:
        source: where it comes from.
        sites, rows: how many there are.
        begin, end, interval: the first and the last time, and the usual step between times.
        uneven: whether steps differ from it by more than a thousandth.
        gaps: begin and end of the longest steps beyond `GAP` times the usual one, the longest first.
        seen: what was read beside u: "v", "f".
        sensors: of u.
        frequencies: of the strongest lines, in cycles per unit of time.
        suspicious: what deserves a look.
        notes: how the file was read.
    """

    source: str
    sites: int
    rows: int
    begin: float
    end: float
    interval: float
    uneven: bool
    gaps: tuple[tuple[float, float], ...]
    seen: tuple[str, ...]
    sensors: tuple[Sensor, ...]
    frequencies: tuple[float, ...]
    suspicious: tuple[str, ...]
    notes: tuple[str, ...]


def inspect(samples: Samples, terms: Library | None = None) -> Inspection:
    """Return what a recording is like; with terms, also whether it makes sense in them."""
    t = samples.t
    steps = np.diff(t)
    usual = float(np.median(steps))
    wide = np.argsort(-steps, kind="stable")
    gaps = tuple((float(t[k]), float(t[k + 1])) for k in wide[:PEAKS] if steps[k] > GAP * usual)
    peaks = Spectrum.of(samples).peaks[:PEAKS] / (2 * np.pi)
    sensors = tuple(_sensors(samples))
    return Inspection(
        samples.source, samples.sites, len(t), float(t[0]), float(t[-1]), usual, not samples.is_even, gaps,
        tuple(name for name in ("v", "f") if getattr(samples, name) is not None), sensors, tuple(map(float, peaks)),
        tuple(_suspicious(samples, sensors, list(map(float, peaks)), terms)), samples.origin.notes,
    )  # fmt: skip


def _sensors(samples: Samples) -> Iterator[Sensor]:
    """Yield what is known of each sensor."""
    origin, size = samples.origin, abs(samples.origin.scale)
    noise = of_readings(samples.t, centred(samples.u)) / size
    for site in range(samples.sites):
        field = samples.u[:, site]
        missing = int(np.sum(np.isnan(field)))
        values = _values(field) / origin.scale
        name = origin.columns[site] if origin.columns else f"{'re' if samples.is_complex else 'u'}{site + 1}"
        if not len(values):
            yield Sensor(name, 0, missing, np.nan, np.nan, np.nan, 0.0)
            continue
        step = step_of(values)
        yield Sensor(
            name, len(field) - missing, missing, float(values.min()), float(values.max()), float(noise[site]), step
        )


def _values(field: ndarray) -> ndarray:
    """Return the readings of a sensor that are there, as real numbers."""
    values = split_parts(field[:, None], np.iscomplexobj(field)).ravel()
    return np.asarray(values[np.isfinite(values)])


def _suspicious(
    samples: Samples, sensors: Sequence[Sensor], peaks: Sequence[float], terms: Library | None
) -> Iterator[str]:
    """Yield what deserves a look, one sentence each."""
    yield from () if terms is None else degrees(samples, terms)
    known: dict[bytes, str] = {}
    for site, one in enumerate(sensors):
        values = _values(samples.u[:, site])
        if one.readings == 0:
            yield f"{one.name}: nothing was read"
        elif np.ptp(values) > 0:
            for level, count, end in at_ends(values / samples.origin.scale):
                yield f"{one.name}: {count} readings of just {level:g} and none {end}; are they clipped?"
            if one.noise > 0 and one.step**2 / 12 > ROUNDED * one.noise**2:
                yield f"{one.name}: readings come in steps of {one.step:.3g}; rounding makes most of the noise"
        if (hole := _hole(samples, site)) is not None:
            yield f"{one.name}: nothing was read from t = {hole[0]:g} to {hole[1]:g}, while others were"
        first = known.setdefault(_key(samples.u[:, site]), one.name)
        if one.readings and first != one.name:
            yield f"{one.name}: the same readings as {first}; is one a copy of the other?"
    yield from resting(samples)
    yield from strays(samples)
    yield from turns(samples)
    yield from map(resting_at, freed(samples)[1])
    span, usual = float(np.ptp(samples.t)), float(np.median(np.diff(samples.t)))
    if len(peaks):
        if 1 / max(peaks) < SPARSE * usual:
            yield f"{1 / max(peaks) / usual:.2g} readings in a period of the fastest line; {SPARSE:g} are few"
        if span * min(peaks) < SHORT:
            yield f"{span * min(peaks):.2g} periods of the slowest line; {SHORT:g} or more tell damping from noise"


def _hole(samples: Samples, site: int) -> tuple[float, float] | None:
    """Return between which readings a sensor was silent longest while others were read, if that is long."""
    rows, others = np.flatnonzero(np.isfinite(samples.u[:, site])), np.any(np.isfinite(samples.u), axis=1)
    if len(rows) < 2:
        return None
    first, last = rows[np.argmax(np.diff(samples.t[rows])) :][:2]
    if samples.t[last] - samples.t[first] <= HOLE * np.ptp(samples.t) or np.sum(others[first + 1 : last]) < FEW:
        return None
    return float(samples.t[first]), float(samples.t[last])


def _key(field: ndarray) -> bytes:
    """Return the same for the same readings, where zero has no sign and missing ones are alike."""
    return np.where(np.isnan(field), np.nan, field + 0.0).tobytes()
