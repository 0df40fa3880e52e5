"""Times that were rounded in a file, put back on the even grid that they came from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Of fewer times a grid is not plain, and more decimals than this are none that a file has.
FEWEST, DECIMALS = 50, 9
# Steps are even that differ by less than this share of one. Rounding may be half of one, but for its own digits; finer
# than a tenth it moves readings by less than a thirtieth of what they differ by from one to the next, and stays.
EVEN, FINEST, COARSEST = 1e-3, 0.1, 0.505
# Longer steps than so many usual ones, and half a unit of the last digit, are gaps.
GAP = 1.5
# Of n times the fitted grid is off by up to this over sqrt(n) of what rounding is: its errors follow one another.
OFF = 4.0
# A number that was read or computed is off by so many units of its last binary digit; decimals are told apart where
# this is less than such a share of one.
ULPS, TOLD = 8.0, 0.05


def evened(t: Float[ndarray, " time"]) -> tuple[Float[ndarray, " time"], list[str]]:
    """Return times on an even grid, if rounding alone keeps them from it, and what to say of it.

    Clocks of cameras and converters are even, while a file may have few decimals. Times are put on the grid that fits
    them best if each is within half a unit of the last digit of it; rows may be missing. Others are returned as they
    are, and so are those that are even already, or hardly rounded.
    """
    steps = np.diff(t)
    if len(t) < FEWEST or not np.all(steps > 0) or not np.all(np.isfinite(t)):
        return t, []
    usual = float(np.median(steps))
    last = _last_digit(t)
    if last is None or not FINEST * usual <= last <= COARSEST * usual:
        return t, []
    short = steps[steps < GAP * usual + last / 2]
    if np.ptp(short) <= EVEN * usual:
        return t, []
    number = np.concatenate([[0.0], np.cumsum(np.round(steps / np.mean(short)))])
    step, begin = np.polyfit(number, t, 1)
    off = np.max(np.abs(t - begin - step * number))
    if np.min(np.diff(number)) < 1 or off > last / 2 * (1 + OFF / np.sqrt(len(t))):
        return t, []
    # The zero of time does not matter; the first one stays as it is known.
    return t[0] + step * number, [f"times are rounded to {last:g}: they are taken from the even grid of {step:.7g}"]


def _last_digit(t: Float[ndarray, " time"]) -> float | None:
    """Return the unit of the last decimal that some of the times have; None where there are too many, or none is told.

    >>> _last_digit(np.array([0.03, 0.07, 0.1]))
    0.01
    """
    for decimals in range(DECIMALS + 1):
        scaled, off = t * 10.0**decimals, ULPS * np.spacing(np.max(np.abs(t))) * 10.0**decimals
        if off > TOLD:
            return None
        if np.all(np.abs(scaled - np.round(scaled)) <= off):
            return float(10.0**-decimals)
    return None
