"""The noise of a recording's sensors in words and in numbers, in the units of its readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.report.document import Content, Number
from latticebench.bench.report.units import Units, rate_of
from latticebench.diagnosis.instrument import describe

if TYPE_CHECKING:
    from latticebench.diagnosis.noise import Noise


class SensorNoise(Content):
    """The noise of one sensor; sizes in the units of its readings, of each part of a complex one.

    Attributes:
        deviation: standard deviation at zero signal in the last model; NaN where nothing was read.
        slow: share of the variance that is this sensor's own and correlated in time.
        slow_over: time over which it is correlated, which may be much less than that between readings; None where
            nothing is.
        next: correlation of the sensor's own noise from one reading to the next.
        common: share of the variance that is in common with the other sensors; negative where this one reads it turned
            round.
        common_over: time over which that part is correlated; None where there is none or it is white.
        wander: standard deviation of the walk of its zero over the recording; 0 where it does not wander.
        growth: share of the signal that adds to the deviation in quadrature, dimensionless.
        tail: degrees of freedom of Student's t; None for a Gaussian.
    """

    deviation: Number
    slow: Number
    slow_over: Number | None
    next: Number
    common: Number
    common_over: Number | None
    wander: Number
    growth: Number
    tail: Number | None


def noise_in_numbers(noise: Noise, units: Units, span: float, interval: float) -> tuple[SensorNoise, ...]:
    """Return the noise of each sensor, those of u before those of v.

    Args:
        noise: in units of the equation.
        units: of the recording.
        span: length of the recording, over which zeros wander.
        interval: usual time from one reading to the next.
    """
    nothing = np.zeros(len(noise.size))
    walk = noise.walk if len(noise.walk) else nothing
    white = noise.white if len(noise.white) else nothing
    share, common_over = nothing, 0.0
    if noise.common is not None:
        share, common_over = noise.common.share * np.where(np.sum(noise.common.share) < 0, -1, 1), noise.common.memory
    return tuple(
        SensorNoise(
            deviation=float(deviation) / abs(units.scale),
            slow=float((1 - one_white) * (1 - one_share**2)) if memory > 0 else 0.0,
            slow_over=float(memory) if memory > 0 else None,
            next=float((1 - one_white) * np.exp(-interval / memory)) if memory > 0 else 0.0,
            common=float(np.sign(one_share) * one_share**2),
            common_over=common_over if one_share and common_over > 0 else None,
            wander=float(one_walk * np.sqrt(span)) / abs(units.scale), growth=noise.growth * noise.tailed,
            tail=noise.tail if np.isfinite(noise.tail) else None,
        )
        for deviation, memory, one_white, one_share, one_walk in zip(
            noise.deviation(), noise.memory, white, share, walk, strict=True
        )
    )  # fmt: skip


def noise_in_words(
    noise: Noise, steps: Sequence[float], interval: float, sites: int, units: Units, span: float | None = None
) -> list[str]:
    """Return the noise of each sensor in words, in the unit of its readings; see `diagnosis.instrument.describe`.

    Args:
        noise: in units of the equation.
        steps: of the sensors' converters, in the same.
        interval: time from one reading to the next.
        sites: sensors of u, after which those of v come.
        units: of the recording.
        span: length of the recording, over which zeros wander.
    """
    lines: list[str] = []
    for begin in range(0, len(noise.size), sites):
        own = slice(begin, begin + sites)
        size, walk = noise.size[own] / abs(units.scale), noise.walk[own] / abs(units.scale)
        common = None if noise.common is None else replace(noise.common, share=noise.common.share[own])
        part = replace(noise, size=size, memory=noise.memory[own], white=noise.white[own], walk=walk, common=common)
        unit = units.reading if begin == 0 else rate_of(units.reading, units.time)
        grid = [step / abs(units.scale) for step in steps[own]]
        told = describe(part, grid, unit, interval=interval, time=units.time, span=span)
        lines += [("velocity, " if begin else "") + line for line in told]
    return lines
