"""Zeros that wander: what a random walk adds to the noise of a sensor.

The noise of such a sensor is x_k = w_k + s_k z_k, where w is a Brownian motion that is 0 as the recordings begin, of
variance d^2 t, and z is white. The differences of readings from one to the next are moving averages of two:

    var(x_k - x_(k-1)) = d^2 (t_k - t_(k-1)) + s_k^2 + s_(k-1)^2,    cov(x_k - x_(k-1), x_(k-1) - x_(k-2)) = -s_(k-1)^2.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

    Each = Float[ndarray, " walking"]


def covariance(size: Each, walk: Each, time: Each, linked: Bool[ndarray, " walking"]) -> tuple[Each, Each]:
    """Return the variances of the differences, and their covariances each with the one before.

    Args:
        size: s_k.
        walk: d, per square root of time.
        time: since the reading before; of the first reading of a piece, since the recordings began.
        linked: whether there is a reading before in the same channel and piece.
    """
    before = np.where(linked, np.concatenate([[0.0], size[:-1]]), 0.0)
    return walk**2 * time + size**2 + before**2, -(before**2)
