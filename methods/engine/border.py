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


def _least_squares(basis: BSplines, t: ndarray, fields: Sequence[ndarray]) -> tuple[ndarray, float]:
    """Fit u and v, each in units of its spread; return the coefficients and the sum of squares that is left."""
    scales = [max(float(np.nanstd(one)), 1e-12) for one in fields]
    matrix = np.concatenate([basis.design(t, level) / scale for level, scale in enumerate(scales)])
    target = np.concatenate([one / scale for one, scale in zip(fields, scales, strict=True)])
    splines, left = np.zeros((basis.count, target.shape[1])), 0.0
    known = np.isfinite(target)
    for one in np.unique(known, axis=1).T:
        alike = np.flatnonzero(np.all(known == one[:, None], axis=0))
        wanted = target[np.ix_(one, alike)]
        splines[:, alike] = np.linalg.lstsq(matrix[one], wanted, rcond=1e-5)[0]
        left += float(np.sum((wanted - matrix[one] @ splines[:, alike]) ** 2))
    return splines, left


def _cross_validation(basis: BSplines, t: ndarray, fields: Sequence[ndarray]) -> float:
    """Return the score of generalised cross-validation; infinite where the B-splines take all the samples."""
    seen = max(sum(np.count_nonzero(np.isfinite(one)) for one in fields), 1)
    free = 1 - basis.count * fields[0].shape[1] / seen
    if free <= 0.1:
        return np.inf
    left = _least_squares(basis, t, fields)[1]
    return float(np.log(left / seen + 1e-24) - 2 * np.log(free))
