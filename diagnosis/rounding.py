"""What rounding adds to readings, on average, where the motion is nearly known.

A converter reads the multiple of its step S that lies nearest to x + s z, with z normal. Its error e(x) = <reading> - x
is a function of the motion, no noise: of a regular motion it has lines at many multiples of its frequency, and it is
like a small force that depends on u. It is (Widrow & Kollar, Quantization Noise, 2008, for the series)

    e(x) = S sum_k (-1)^k / (pi k) exp(-2 (pi k s / S)^2) sin(2 pi k x / S).

Once a model follows the readings to a fraction of a step, e is known and can be taken away. That makes forces and lines
of it go, and tells nothing new: between two steps, a reading less e is what the model said before. So the noise that is
reckoned with stays as large as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.problem import Problem

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Sizes of the noise before the rounding that are tried, over the step; of larger ones rounding is noise.
SPREADS = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3)
# Terms of the series.
TERMS = 12
# Nats that it must win, besides Schwarz' price for the noise's size.
MARGIN = 3.0


def expected(x: Float[ndarray, " *any"], step: float, spread: float) -> Float[ndarray, " *any"]:
    """Return the mean error e(x) of readings of x on the grid of multiples of `step`.

    Args:
        x: what is read, in any units.
        step: of the grid, in the same units.
        spread: standard deviation of the noise before the rounding, over the step.
    """
    k = np.arange(1, TERMS + 1)
    size = np.where(k % 2, -1.0, 1.0) / (np.pi * k) * np.exp(-2 * (np.pi * k * spread) ** 2)
    return np.asarray(step * np.sin(2 * np.pi * np.multiply.outer(x / step, k)) @ size)


def without_rounding(problem: Problem, fits: Sequence[Fitted], value: Callable[[Fitted], float]) -> Problem | None:
    """Return the problem whose readings are free of what rounding adds; None where the readings do not show that.

    Args:
        problem: the recordings.
        fits: rival models that follow whole recordings. One with too many effects may do what rounding does: the one
            counts that is worth most beside rounding.
        value: what a fit costs with the price of its effects, in nats.
    """
    if problem.unrounded or not any(problem.steps):
        return None
    found = min((_free(problem, one, value(one)) for one in fits), key=lambda pair: pair[0])
    return found[1]


def _free(problem: Problem, fitted: Fitted, value: float) -> tuple[float, Problem | None]:
    """Return what a fit costs beside rounding, and the problem without that."""
    better, records = 0.0, []
    for record, curve in zip(problem.records, fitted.curves(), strict=True):
        read = record.value.copy()
        for level, part, site in np.ndindex(read.shape[1:]):
            step = problem.steps[level * problem.chain.sites + site]
            here = np.index_exp[:, level, part, site]
            seen = record.seen[here] & np.isfinite(curve.level[here])
            if step > 0 and np.any(seen):
                won, error = _likeliest(read[here][seen], curve.level[here][seen], step)
                read[here][seen] -= error
                better += won
        records.append(replace(record, value=read))
    if better < MARGIN:
        return value, None
    noise = float(np.nanmin(fitted.noise.deviation()))
    return value - better / fitted.dispersion, replace(problem, records=tuple(records), unrounded=noise)


def _likeliest(read: ndarray, wanted: ndarray, step: float) -> tuple[float, ndarray]:
    """Return the nats that the likeliest error by rounding wins, less its price, and the error; 0 where none wins."""
    # The grid need not hold 0.
    origin = np.angle(np.mean(np.exp(2j * np.pi * read / step))) * step / (2 * np.pi)
    plain = np.sum((read - wanted) ** 2)
    found, best = np.zeros_like(read), np.log(len(read)) / 2
    least = 0.0
    for spread in SPREADS:
        error = expected(wanted - origin, step, spread)
        won = len(read) / 2 * float(np.log(plain / np.sum((read - wanted - error) ** 2)))
        if won - best > least:
            least, found = won - best, error
    return least, found
