"""Zeros that wander: what a random walk adds to the noise of a sensor.

The noise of such a sensor is x_k = w_k + s_k z_k, where w is a Brownian motion that is 0 as the recordings begin, of
variance d^2 t, and z is white. The differences of readings from one to the next have a covariance with three
diagonals,

    var(x_k - x_(k-1)) = d^2 (t_k - t_(k-1)) + s_k^2 + s_(k-1)^2,    cov(x_k - x_(k-1), x_(k-1) - x_(k-2)) = -s_(k-1)^2,

whose Cholesky factor L has two: L^-1 applied to the differences makes them independent, in a time linear in their
number (Durbin & Koopman, Time Series Analysis by State Space Methods, 2012, section 2.2, has the same as a filter).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray


@dataclass(frozen=True, eq=False)
class Walk:
    """The map from differences of readings of sensors whose zeros wander to independent numbers of variance 1.

    Attributes:
        where: which readings of the chain these are.
        factor: the two diagonals of L (2, readings), as SciPy's banded matrices have them.
    """

    where: Int[ndarray, " walking"]
    factor: Float[ndarray, "two walking"]

    @classmethod
    def of(
        cls,
        where: Int[ndarray, " walking"],
        size: Float[ndarray, " walking"],
        walk: Float[ndarray, " walking"],
        time: Float[ndarray, " walking"],
        linked: Bool[ndarray, " walking"],
    ) -> Walk:
        """Return the map.

        Args:
            where: which readings of the chain.
            size: s_k.
            walk: d, per square root of time.
            time: since the reading before; of the first reading of a piece, since the recordings began.
            linked: whether there is a reading before in the same channel and piece.
        """
        from scipy.linalg import cholesky_banded

        before = np.where(linked, np.concatenate([[0.0], size[:-1]]), 0.0)
        covariance = np.zeros((2, len(where)))
        covariance[0] = walk**2 * time + size**2 + before**2
        covariance[1, :-1] = -(before[1:] ** 2)
        return cls(where, cholesky_banded(covariance, lower=True, check_finite=False))

    @property
    def log_scale(self) -> float:
        """The logarithm of the determinant of L."""
        return float(np.sum(np.log(self.factor[0])))

    def apply(self, differences: Float[ndarray, "walking *more"]) -> Float[ndarray, "walking *more"]:
        """Return L^-1 times differences."""
        from scipy.linalg import solve_banded

        return np.asarray(solve_banded((1, 0), self.factor, differences, check_finite=False))

    def transposed(self, z: Float[ndarray, "walking *more"]) -> Float[ndarray, "walking *more"]:
        """Return the transpose of L^-1 times z."""
        from scipy.linalg import solve_banded

        upper = np.zeros_like(self.factor)
        upper[0, 1:], upper[1] = self.factor[1, :-1], self.factor[0]
        return np.asarray(solve_banded((0, 1), upper, z, check_finite=False))
