"""Moving averages of two: numbers each of which has something in common with the one before it and the one after.

Their covariance has three diagonals, and its Cholesky factor L has two: L_kk^2 = C_kk - L_k,k-1^2 and
L_k,k-1 = C_k,k-1 / L_k-1,k-1. L^-1 makes the numbers independent and of size 1, in a time linear in their number
(Durbin & Koopman, Time Series Analysis by State Space Methods, 2012, section 2.2, has the same as a filter).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    Each = Float[ndarray, " numbers"]


@dataclass(frozen=True, eq=False)
class Averages:
    """The map to independent numbers.

    Attributes:
        factor: the two diagonals of L (2, numbers), as SciPy's banded matrices have them.
    """

    factor: Float[ndarray, "two numbers"]

    @classmethod
    def of(cls, variance: Each, beside: Each) -> Averages:
        """Return the map for numbers of some variances, and covariances of each with the one before it (0 at first)."""
        from scipy.linalg import cholesky_banded

        covariance = np.zeros((2, len(variance)))
        covariance[0] = variance
        covariance[1, :-1] = beside[1:]
        return cls(
            np.asarray(cholesky_banded(covariance, lower=True, check_finite=False)) if len(variance) else covariance
        )

    @property
    def log_scale(self) -> float:
        """The logarithm of the determinant of L."""
        return float(np.sum(np.log(self.factor[0])))

    def apply(self, numbers: Float[ndarray, "numbers *more"]) -> Float[ndarray, "numbers *more"]:
        """Return L^-1 times the numbers, or times their derivatives (any further axes)."""
        from scipy.linalg import solve_banded

        return np.asarray(solve_banded((1, 0), self.factor, numbers, check_finite=False)) if len(numbers) else numbers

    def transposed(self, fresh: Float[ndarray, "numbers *more"]) -> Float[ndarray, "numbers *more"]:
        """Return the transpose of L^-1 times independent numbers."""
        from scipy.linalg import solve_banded

        if not len(fresh):
            return fresh
        upper = np.zeros_like(self.factor)
        upper[0, 1:], upper[1] = self.factor[1, :-1], self.factor[0]
        return np.asarray(solve_banded((0, 1), upper, fresh, check_finite=False))

    def slopes(self, fresh: Each, by_numbers: Each) -> tuple[Each, Each]:
        """Return derivatives by the variances and by the covariances, those of `log_scale` among them.

        Args:
            fresh: L^-1 times the numbers.
            by_numbers: derivatives by the numbers.
        """
        from scipy.linalg import solve_banded

        size, beside = self.factor[0], np.concatenate([[0.0], self.factor[1, :-1]])
        by_size = 1 / size - by_numbers * fresh
        by_beside = -by_numbers * np.concatenate([[0.0], fresh[:-1]])
        earlier = np.concatenate([size[:1], size[:-1]])
        # The recursion of L, followed backwards.
        upper = np.ones((2, len(size)))
        upper[0, 1:] = -(beside**2 / (size * earlier))[1:]
        right = by_size.copy()
        right[:-1] -= (by_beside * beside / earlier)[1:]
        total = solve_banded((0, 1), upper, right, check_finite=False)
        return total / (2 * size), (by_beside - total * beside / size) / earlier
