"""The motion of the sites at unknown ends, which have no equation.

Each site follows a B-spline in time that is fitted to its own samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.bsplines import BSplines
from latticebench.methods.engine.dynamics import Dynamics, split_parts
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

DEGREE = 7


def choose_basis(samples: Samples, dynamics: Dynamics) -> BSplines:
    """Return as many B-splines as generalised cross-validation on the samples of these sites asks for."""
    t = samples.t
    fields = _fields(samples, dynamics)
    most = len(t) * len(fields)
    degree = min(DEGREE, max(1, most // 2 - 1))
    sizes = sorted({min(degree + 1 + round(x), most) for x in np.geomspace(1, max(most - degree - 1, 1), 16)})
    best, chosen = np.inf, _basis(t, sizes[0], degree)
    for size in sizes:
        basis = _basis(t, size, degree)
        score = _cross_validation(basis, t, fields)
        if score < best:
            best, chosen = score, basis
    return chosen


def fit_border(basis: BSplines, samples: Samples, dynamics: Dynamics) -> Float[ndarray, "splines parts border"]:
    """Return the coefficients of the B-splines by least squares on the samples of these sites."""
    found = _least_squares(basis, samples.t, _fields(samples, dynamics))[0]
    return found.reshape(-1, dynamics.parts, len(dynamics.border))


def _fields(samples: Samples, dynamics: Dynamics) -> list[ndarray]:
    """Return the samples of u and v of the sites without an equation, each (T, parts * border)."""
    fields = [samples.u] if dynamics.order == 1 or samples.v is None else [samples.u, samples.v]
    return [split_parts(one[:, dynamics.border], samples.is_complex).reshape(len(samples.t), -1) for one in fields]


def _basis(t: ndarray, size: int, degree: int) -> BSplines:
    """Return `size` B-splines over the sample times, as dense as the samples are."""
    return BSplines.clamped(np.interp(np.linspace(0, 1, size - degree + 1), np.linspace(0, 1, len(t)), t), degree)


def _least_squares(basis: BSplines, t: ndarray, fields: Sequence[ndarray]) -> tuple[ndarray, ndarray, int]:
    """Fit u and v, each in units of its spread.

    Returns:
        the coefficients, the sums of squares that are left, and how many numbers were observed.
    """
    designs = [basis.design(t, level) for level in range(len(fields))]
    scales = [max(float(np.nanstd(one)), 1e-12) for one in fields]
    splines = np.zeros((basis.count, fields[0].shape[1]))
    left, seen = np.zeros(fields[0].shape[1]), 0
    for column in range(fields[0].shape[1]):
        known = [np.isfinite(one[:, column]) for one in fields]
        matrix = np.concatenate([d[k] / s for d, k, s in zip(designs, known, scales, strict=True)])
        target = np.concatenate([f[k, column] / s for f, k, s in zip(fields, known, scales, strict=True)])
        splines[:, column] = np.linalg.lstsq(matrix, target, rcond=1e-5)[0]
        left[column] = np.sum((target - matrix @ splines[:, column]) ** 2)
        seen += len(target)
    return splines, left, seen


def _cross_validation(basis: BSplines, t: ndarray, fields: Sequence[ndarray]) -> float:
    """Return the score of generalised cross-validation; infinite where the B-splines take all the samples."""
    splines, left, seen = _least_squares(basis, t, fields)
    free = 1 - splines.size / max(seen, 1)
    return float(np.log(np.sum(left) / max(seen, 1) + 1e-24) - 2 * np.log(free)) if free > 0.1 else np.inf
