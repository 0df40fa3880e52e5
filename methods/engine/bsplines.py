"""B-splines in time, and the values and slopes of those that are not zero at a given time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray
    from scipy.interpolate import BSpline


@dataclass(frozen=True, eq=False)
class BSplines:
    """A basis of B-splines of one degree.

    Attributes:
        knots: those at both ends repeated degree + 1 times.
        degree: of the polynomials.
    """

    knots: Float[ndarray, " knots"]
    degree: int

    @classmethod
    def clamped(cls, edges: Float[ndarray, " edges"], degree: int) -> BSplines:
        """Return the basis with knots at increasing times, the first and the last of them repeated."""
        ends = np.full(degree, edges[0]), np.full(degree, edges[-1])
        return cls(np.concatenate([ends[0], edges, ends[1]]), degree)

    @property
    def count(self) -> int:
        """The number m of B-splines."""
        return len(self.knots) - self.degree - 1

    def basis(
        self, t: Float[ndarray, " time"]
    ) -> tuple[Int[ndarray, " time"], Float[ndarray, "time local"], Float[ndarray, "time local"]]:
        """Evaluate the degree + 1 consecutive B-splines that are not zero at each time.

        Returns:
            the index of the first of them, their values, and their slopes (1 over time).
        """
        degree = self.degree
        span = np.clip(np.searchsorted(self.knots, t, side="right") - 1, degree, self.count - 1)
        # Cox and de Boor's recursion, one degree at a time; `lower` keeps the last but one for the slopes.
        value = np.ones((len(t), 1))
        lower = value
        for d in range(1, degree + 1):
            lower = value
            value = np.zeros((len(t), d + 1))
            for j in range(d):
                left = self.knots[span + j + 1 - d]
                right = self.knots[span + j + 1]
                share = lower[:, j] / (right - left)
                value[:, j] += share * (right - t)
                value[:, j + 1] += share * (t - left)
        slope = np.zeros((len(t), degree + 1))
        for j in range(degree):
            share = degree * lower[:, j] / (self.knots[span + j + 1] - self.knots[span + j + 1 - degree])
            slope[:, j] -= share
            slope[:, j + 1] += share
        return span - degree, value, slope

    def curve(self, coefficients: Float[ndarray, "splines *each"]) -> BSpline:
        """Return the curve of given coefficients: a function of times and of the derivative's order."""
        from scipy.interpolate import BSpline

        return BSpline.construct_fast(self.knots, coefficients, self.degree)

    def design(self, t: Float[ndarray, " time"], derivative: int) -> Float[ndarray, "time splines"]:
        """Return the values of all B-splines, or of their derivatives, as a matrix."""
        return np.asarray(self.curve(np.eye(self.count))(t, derivative))


def through(
    t: Float[ndarray, " time"], values: Float[ndarray, "time *each"], degree: int
) -> tuple[BSplines, Float[ndarray, "splines *each"]]:
    """Return the B-splines and coefficients, one per time, of the curve through values at all times."""
    from scipy.interpolate import make_interp_spline

    curve = make_interp_spline(t, values, k=degree)
    return BSplines(curve.t, degree), np.asarray(curve.c)
