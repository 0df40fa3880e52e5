"""Times that were rounded in a file, put back on the even grid that they came from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Of fewer times a grid is not plain, and more decimals than this are none that a file has.
FEWEST, DECIMALS = 50, 9
# Steps are even that differ by less than this share of one; rounding is coarse up to this share of one.
EVEN, COARSEST = 1e-3, 0.5
# Longer steps than so many usual ones are gaps.
GAP = 1.5
# Of n times the fitted grid is off by up to this over sqrt(n) of what rounding is: its errors follow one another.
OFF = 4.0


def evened(t: Float[ndarray, " time"]) -> tuple[Float[ndarray, " time"], list[str]]:
    """Return times on an even grid, if rounding alone keeps them from it, and what to say of it.

    Clocks of cameras and converters are even, while a file may have few decimals. Times are put on the grid that fits
    them best if each is within half a unit of the last digit of it; rows may be missing. Others are returned as they
    are, and so are those that are even already.
    """
    steps = np.diff(t)
    if len(t) < FEWEST or not np.all(steps > 0) or not np.all(np.isfinite(t)):
        return t, []
    usual = float(np.median(steps))
    last = _last_digit(t)
    short = steps[steps < GAP * usual]
    if last is None or last > COARSEST * usual or np.ptp(short) <= EVEN * usual:
        return t, []
    number = np.concatenate([[0.0], np.cumsum(np.round(steps / np.mean(short)))])
    step, begin = np.polyfit(number, t, 1)
    off = np.max(np.abs(t - begin - step * number))
    if np.min(np.diff(number)) < 1 or off > last / 2 * (1 + OFF / np.sqrt(len(t))):
        return t, []
    # The zero of time does not matter; the first one stays as it is known.
    return t[0] + step * number, [f"times are rounded to {last:g}: they are taken from the even grid of {step:.7g}"]


def _last_digit(t: Float[ndarray, " time"]) -> float | None:
    """Return the unit of the last decimal that some of the times have; None where there are too many decimals.

    >>> _last_digit(np.array([0.03, 0.07, 0.1]))
    0.01
    """
    for decimals in range(DECIMALS + 1):
        scaled = t * 10.0**decimals
        if np.all(np.abs(scaled - np.round(scaled)) <= 1e-6 + 1e-12 * np.abs(scaled)):
            return float(10.0**-decimals)
    return None
