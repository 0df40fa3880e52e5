"""The state of a trajectory as least-squares splines with a covariance, and the noise of its samples.

The series of each site is a spline of degree 9. Generalised cross-validation over all sites chooses the number of knots
that the data can bear: at their spacing the spectrum of the data sinks into the noise. Where the velocity was observed,
u = B c and v = B' c are fitted together, each weighted by its noise; otherwise v = B' c follows from u. The noise of u
and of v is estimated from what the splines leave. Times may be uneven and have gaps.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.bsplines import BSplines
from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

DEGREE = 9
MIN_SAMPLES = 6
MAX_INTERVALS = 400
# Twice the knots that cross-validation asks for: what the state cannot follow would count as noise, and standard errors
# would be too small.
FINENESS = 2
# Test functions a few knot intervals wide must fit into the record several times.
FEWEST = 12
# The number of channels that choose the number of knots where each has gaps of its own.
CHANNELS = 12
# Weights, relative to those of the data, that make a spline smooth and small where a site was not observed.
BEND, SHRINK = 1e-7, 1e-10


@dataclass(frozen=True, eq=False)
class SplineState:
    """A spline with its covariance for each channel of a trajectory (the real or imaginary part of a site).

    The coefficients of a spline are c = factor @ w, where w has independent noise of variance 1.

    Attributes:
        seen: w as the samples give it (channels, coefficients).
        factors: one matrix per channel (coefficients, coefficients).
        knots: of the spline.
        degree: of the spline.
        intervals: how many knot intervals cross-validation asked for.
        noise: standard deviation of u (in each part of a complex field), and of v (NaN where it was not used).
        size: RMS of the observed values of u.
        whole: the sites that were observed often enough (N,).
    """

    seen: Float[ndarray, "channels coefficients"]
    factors: tuple[Float[ndarray, "coefficients coefficients"], ...]
    knots: Float[ndarray, " knots"]
    degree: int
    intervals: int
    noise: tuple[float, float]
    size: float
    whole: Bool[ndarray, " sites"]

    def basis(self, t: Float[ndarray, " time"], derivative: int) -> Float[ndarray, "time coefficients"]:
        """Evaluate all B-splines, or a derivative of them."""
        return BSplines(self.knots, self.degree).design(t, derivative)


@dataclass(frozen=True, eq=False)
class _SplineFit:
    """Least squares of all channels on one spline basis."""

    seen: ndarray
    triangles: tuple[ndarray, ...]
    squares: float
    left: int

    @property
    def score(self) -> float:
        """The logarithm of generalised cross-validation (Craven & Wahba 1979), up to a constant."""
        return float(np.log(max(self.squares, 1e-300)) - 2 * np.log(self.left))

    @property
    def noise(self) -> float:
        """Standard deviation of what is left."""
        return float(np.sqrt(self.squares / self.left))


def estimate_state(samples: Samples, order: int) -> SplineState:
    """Fit splines to the samples of a trajectory, with as many knots as the data can bear.

    Args:
        samples: u, and v where the order is 2 and it was observed.
        order: of the equation.

    Raises:
        InputError: too few samples for any spline.
    """
    t = samples.t
    if len(t) < MIN_SAMPLES:
        raise InputError(f"{samples.source}: the weak form needs at least {MIN_SAMPLES} samples, there are {len(t)}")
    degree = min(DEGREE, len(t) - 3)
    fields = [_channels(samples.u)]
    if samples.v is not None and order == 2:
        fields.append(_channels(samples.v))
    tidy = samples.is_even and not samples.has_missing
    noise = []
    for field in fields:
        _, alone = _cross_validated(t, [field], [1.0], degree, tidy)
        noise.append(max(alone.noise, 1e-15 * _size(field), 1e-150))
    weights = [1 / sigma for sigma in noise]
    intervals, _ = _cross_validated(t, fields, weights, degree, tidy)
    most = _most_intervals(fields, degree)
    wanted = (max(FINENESS * intervals + 3, FEWEST), intervals + 3)
    finer = next((number for number in wanted if number <= most), intervals)
    fitted = _spline_fit(t, fields, weights, finer, degree, tidy)
    count = len(fitted.seen[0])
    inverse: dict[int, ndarray] = {}
    for triangle in fitted.triangles:
        if id(triangle) not in inverse:
            inverse[id(triangle)] = np.linalg.solve(triangle, np.eye(count))
    parts = 1 + samples.is_complex
    return SplineState(
        fitted.seen,
        tuple(inverse[id(triangle)] for triangle in fitted.triangles),
        _basis(t, count - degree, degree).knots,
        degree,
        intervals,
        (noise[0], noise[1] if len(noise) > 1 else float("nan")),
        _size(fields[0]),
        np.sum(~np.isnan(fields[0][:, ::parts]), axis=0) > degree,
    )


def _channels(field: ndarray) -> ndarray:
    """Write a field (T, N) as real channels (T, N * parts), site by site."""
    if not np.iscomplexobj(field):
        return field
    return np.stack([field.real, field.imag], axis=-1).reshape(len(field), -1)


def _size(field: ndarray) -> float:
    return float(np.sqrt(np.nanmean(field**2))) if np.any(~np.isnan(field)) else 0.0


def _basis(t: ndarray, intervals: int, degree: int) -> BSplines:
    return BSplines.clamped(np.linspace(t[0], t[-1], intervals + 1), degree)


def _most_intervals(fields: Sequence[ndarray], degree: int) -> int:
    """Return the most knot intervals that leave a tenth of a typical channel's values for the estimate of the noise."""
    values = float(np.median(sum(np.sum(~np.isnan(field), axis=0) for field in fields)))
    return int(min(0.9 * values - degree, len(fields[0]), MAX_INTERVALS))


def _cross_validated(
    t: ndarray, fields: Sequence[ndarray], weights: Sequence[float], degree: int, tidy: bool
) -> tuple[int, _SplineFit]:
    """Find the number of knot intervals with the least cross-validation score, in steps of an eighth."""
    # A few channels are enough to choose; each may have gaps, and so a factorisation, of its own.
    channels = np.unique(np.linspace(0, fields[0].shape[1] - 1, CHANNELS).round().astype(int))
    shown = fields if tidy else [field[:, channels] for field in fields]
    best: tuple[int, _SplineFit] | None = None
    intervals = 1
    while best is None or intervals <= min(_most_intervals(shown, degree), 4 * best[0] + 20):
        fitted = _spline_fit(t, shown, weights, intervals, degree, tidy)
        if best is None or fitted.score < best[1].score:
            best = intervals, fitted
        intervals = max(intervals + 1, round(1.125 * intervals))
    return best


def _spline_fit(
    t: ndarray, fields: Sequence[ndarray], weights: Sequence[float], intervals: int, degree: int, tidy: bool
) -> _SplineFit:
    """Fit u, and v as its derivative; channels with the same gaps share one factorisation."""
    basis = _basis(t, intervals, degree)
    design = np.concatenate([basis.design(t, k) * weight for k, weight in enumerate(weights)])
    target = np.concatenate([field * weight for field, weight in zip(fields, weights, strict=True)])
    count = design.shape[1]
    height = np.sqrt(np.mean(np.sum(design**2, axis=0)))
    prior = np.zeros((0, count))
    if not tidy:
        bend = np.diff(np.eye(count), n=4, axis=0) if count > 4 else np.zeros((0, count))
        prior = height * np.concatenate([BEND * bend, SHRINK * np.eye(count)])
    groups: defaultdict[bytes, list[int]] = defaultdict(list)
    is_seen = ~np.isnan(target)
    for channel in range(target.shape[1]):
        groups[is_seen[:, channel].tobytes()].append(channel)
    seen = np.empty((target.shape[1], count))
    triangles: list[ndarray] = [prior] * target.shape[1]
    squares, left = 0.0, 0
    for members in groups.values():
        rows = is_seen[:, members[0]]
        q, r = np.linalg.qr(np.concatenate([design[rows], prior]))
        known = target[rows][:, members]
        w = q[: len(known)].T @ known
        squares += float(np.sum((known - q[: len(known)] @ w) ** 2))
        left += max(int(np.sum(rows)) - count, 0) * len(members)
        for k, channel in enumerate(members):
            seen[channel], triangles[channel] = w[:, k], r
    return _SplineFit(seen, tuple(triangles), squares, max(left, 1))
