"""Least squares with all columns scaled to length 1, so that the units of the unknowns do not matter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# A direction whose singular value is below this share of the largest is not determined.
UNDETERMINED = 1e-12


@dataclass(frozen=True, eq=False)
class Scaled:
    """The singular values of the rows of a least-squares problem, columns scaled to length 1.

    Attributes:
        scale: length of each column (columns,); 1 where it is 0.
        left, values, right: rows / scale = left @ diag(values) @ right.
    """

    scale: Float[ndarray, " columns"]
    left: Float[ndarray, "rows values"]
    values: Float[ndarray, " values"]
    right: Float[ndarray, "values columns"]

    @classmethod
    def of(cls, rows: Float[ndarray, "rows columns"]) -> Scaled:
        """Decompose rows that are in units of their noise."""
        scale = np.linalg.norm(rows, axis=0)
        scale[scale == 0] = 1.0
        return cls(scale, *np.linalg.svd(rows / scale, full_matrices=False))

    def solution(self, target: Float[ndarray, " rows"]) -> Float[ndarray, " columns"]:
        """Return the solution; nothing moves in directions that are not determined."""
        held = self.values > UNDETERMINED * np.max(self.values, initial=0.0)
        inverse = np.where(held, 1 / np.where(held, self.values, 1.0), 0.0)
        return np.asarray(self.right.T @ (inverse * (self.left.T @ target)) / self.scale)

    def covariance(self, least: float = UNDETERMINED) -> Float[ndarray, "columns columns"]:
        """Return (rows^T rows)^-1, with singular values of at least the share `least` of the largest.

        It is vast in directions that are not determined.
        """
        spread = 1 / np.maximum(self.values, least * max(float(np.max(self.values, initial=0.0)), 1e-100))
        return np.asarray((self.right.T * spread**2) @ self.right / self.scale / self.scale[:, None])

    def stderr(self) -> Float[ndarray, " columns"]:
        """Return the root of the diagonal of (rows^T rows)^-1; infinite where a column depends on the others."""
        if len(self.values) < len(self.scale) or len(self.values) == 0:
            return np.full(len(self.scale), np.inf)
        with np.errstate(divide="ignore"):
            spread = np.where(self.values > 1e-14 * self.values[0], 1 / self.values, np.inf)
        # A direction of infinite spread makes uncertain only the unknowns that are in it.
        parts = np.where(np.abs(self.right) > 1e-12, np.abs(self.right), 0.0)
        with np.errstate(invalid="ignore"):
            shares = np.where(parts > 0, parts * spread[:, None], 0.0)
        return np.asarray(np.sqrt(np.sum(shares**2, axis=0)) / self.scale)


def inverse_of_squares(matrix: Float[ndarray, "columns columns"]) -> Float[ndarray, "columns columns"]:
    """Return the pseudo-inverse of a matrix of normal equations, with its diagonal scaled to 1."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / scale / scale[:, None]
    return np.asarray(np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) / scale / scale[:, None])


def lstsq(
    design: Float[ndarray, "rows columns"],
    target: Float[ndarray, " rows"],
    rcond: float,
    scale: Float[ndarray, " columns"] | None = None,
) -> Float[ndarray, " columns"]:
    """Return the solution of smallest norm in units of `scale`; of each column's root mean square if that is None.

    Directions whose singular value is below `rcond` of the largest stay at 0.

    Raises:
        numpy.linalg.LinAlgError: a number is not finite.
    """
    # LAPACK would say so itself, on the screen.
    if not (np.all(np.isfinite(design)) and np.all(np.isfinite(target))):
        raise np.linalg.LinAlgError("the least squares are of numbers that are not finite")
    if scale is None:
        scale = np.sqrt(np.mean(design**2, axis=0))
        scale[scale == 0] = 1.0
    return np.asarray(np.linalg.lstsq(design / scale, target, rcond=rcond)[0] / scale)
