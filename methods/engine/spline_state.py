"""The state of a trajectory as least-squares splines with a covariance, and the noise of its samples.

The series of each site is a spline of degree 9. Generalised cross-validation over all sites chooses the number of knots
that the data can bear: at their spacing the spectrum of the data sinks into the noise. Where the velocity was observed,
u = B c and v = B' c are fitted together, each weighted by its noise; otherwise v = B' c follows from u. The noise of u
and of v is estimated from what the splines leave. Times may be uneven and have gaps.

Sites are gone through some at a time. What cross-validation asks of many sites without gaps, sums of squares, is asked
of the triangular factor of all their series, which has the same.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.bsplines import BSplines
from latticebench.systems.arrays import empty, pieces
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
        factors: one matrix per channel, or one for all (channels or 1, coefficients, coefficients).
        knots: of the spline.
        degree: of the spline.
        intervals: how many knot intervals cross-validation asked for.
        noise: standard deviation of u (in each part of a complex field), and of v (NaN where it was not used).
        size: RMS of the observed values of u.
        whole: the sites that were observed often enough (N,).
    """

    seen: Float[ndarray, "channels coefficients"]
    factors: Float[ndarray, "matrices coefficients coefficients"]
    knots: Float[ndarray, " knots"]
    degree: int
    intervals: int
    noise: tuple[float, float]
    size: float
    whole: Bool[ndarray, " sites"]

    def factor(self, channels: ndarray) -> Float[ndarray, "*channels coefficients coefficients"]:
        """Return the factors of some channels, or the one of all as an array that stands for as many."""
        if len(self.factors) > 1:
            return np.asarray(self.factors[channels])
        return np.broadcast_to(self.factors[0], (*np.shape(channels), *self.factors.shape[1:]))

    def basis(self, t: Float[ndarray, " time"], derivative: int) -> Float[ndarray, "time coefficients"]:
        """Evaluate all B-splines, or a derivative of them."""
        return BSplines(self.knots, self.degree).design(t, derivative)


@dataclass(frozen=True, eq=False)
class _Series:
    """The real series of all channels: of u and, where it is used, of v.

    Attributes:
        fields: of each quantity, as observed (T, N).
        counts: how many values of each channel are known.
        tidy: whether none is missing.
    """

    fields: tuple[ndarray, ...]
    counts: ndarray
    tidy: bool

    @classmethod
    def of(cls, samples: Samples, order: int) -> _Series:
        fields = (samples.u,) if samples.v is None or order == 1 else (samples.u, samples.v)
        parts, whole = 1 + samples.is_complex, cls(fields, np.zeros(0), tidy=False)
        counts = np.empty((len(fields), samples.sites * parts), int)
        for some in whole.pieces():
            counts[:, some] = [np.sum(~np.isnan(one), axis=0) for one in whole.at(some)]
        return cls(fields, counts, samples.is_even and not samples.has_missing)

    @property
    def parts(self) -> int:
        return 1 + int(np.iscomplexobj(self.fields[0]))

    @property
    def channels(self) -> int:
        return int(self.fields[0].shape[1]) * self.parts

    def pieces(self) -> Iterator[slice]:
        """Go through the channels, whole sites at a time."""
        for some in pieces(self.fields[0].shape[1], len(self.fields[0]) * self.parts * len(self.fields)):
            yield slice(some.start * self.parts, some.stop * self.parts)

    def at(self, some: slice) -> list[ndarray]:
        """Return the series of some channels, site by site (T, channels)."""
        sites = slice(some.start // self.parts, some.stop // self.parts)
        found = []
        for field in self.fields:
            own = np.asarray(field[:, sites])
            found.append(own if self.parts == 1 else np.stack([own.real, own.imag], axis=-1).reshape(len(own), -1))
        return found

    def few(self) -> list[ndarray]:
        """Return series that choose the number of knots as all of them do."""
        if not self.tidy:
            # A few channels are enough; each may have gaps, and so a factorisation, of its own.
            channels = np.unique(np.linspace(0, self.channels - 1, CHANNELS).round().astype(int))
            both = [self.at(slice(one - one % self.parts, one - one % self.parts + self.parts)) for one in channels]
            kept = [one % self.parts for one in channels]
            return [
                np.stack([one[number][:, k] for one, k in zip(both, kept, strict=True)], axis=1)
                for number in range(len(self.fields))
            ]
        times = len(self.fields[0])
        triangle: ndarray | None = None
        for some in self.pieces():
            rows = np.concatenate(self.at(some)).T
            stacked = rows if triangle is None else np.concatenate([triangle, rows])
            triangle = stacked if len(stacked) <= stacked.shape[1] else np.asarray(np.linalg.qr(stacked, mode="r"))
        assert triangle is not None
        return [triangle[:, k * times : (k + 1) * times].T for k in range(len(self.fields))]

    def size(self, number: int) -> float:
        """Return the RMS of the known values of u or v."""
        total = sum(float(np.nansum(self.at(some)[number] ** 2)) for some in self.pieces())
        return float(np.sqrt(total / max(np.sum(self.counts[number]), 1)))


@dataclass(frozen=True, eq=False)
class _SplineFit:
    """Least squares of some channels on one spline basis: w, the triangles of each, and what is left of how many."""

    seen: ndarray
    triangles: tuple[ndarray, ...]
    squares: float
    left: int

    @property
    def score(self) -> float:
        """The logarithm of generalised cross-validation (Craven & Wahba 1979), up to a constant."""
        return float(np.log(max(self.squares, 1e-300)) - 2 * np.log(self.left))


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
    series = _Series.of(samples, order)
    few = series.few()
    # Where few stand for all, what is left of them is left of all.
    share = series.channels / few[0].shape[1] if series.tidy else 1.0
    most = int(np.median(np.sum(series.counts, axis=0)))
    noise = []
    for number, field in enumerate(few):
        values = int(np.median(series.counts[number]))
        _, alone = _cross_validated(t, [field], [1.0], degree, series.tidy, values)
        noise.append(max(np.sqrt(alone.squares / alone.left / share), 1e-15 * series.size(number), 1e-150))
    weights = [1 / sigma for sigma in noise]
    intervals, _ = _cross_validated(t, few, weights, degree, series.tidy, most)
    wanted = (max(FINENESS * intervals + 3, FEWEST), intervals + 3)
    bearable = _most_intervals(most, len(t), degree)
    finer = next((number for number in wanted if number <= bearable), intervals)
    seen, factors = _all_channels(t, series, weights, finer, degree)
    return SplineState(
        seen, factors, _basis(t, finer, degree).knots, degree, intervals,
        (float(noise[0]), float(noise[1]) if len(noise) > 1 else float("nan")),
        series.size(0), series.counts[0, :: series.parts] > degree,
    )  # fmt: skip


def _all_channels(
    t: ndarray, series: _Series, weights: Sequence[float], intervals: int, degree: int
) -> tuple[ndarray, ndarray]:
    """Return w and the factors of all channels."""
    count = intervals + degree
    seen = empty((series.channels, count))
    alike = bool(np.all(series.counts == len(t)))
    factors = empty((1 if alike else series.channels, count, count))
    for some in series.pieces():
        fitted = _spline_fit(t, series.at(some), weights, intervals, degree, series.tidy)
        seen[some] = fitted.seen
        inverse: dict[int, ndarray] = {}
        for channel, triangle in enumerate(fitted.triangles[: len(factors)], start=some.start):
            if id(triangle) not in inverse:
                inverse[id(triangle)] = np.linalg.solve(triangle, np.eye(count))
            factors[channel % len(factors)] = inverse[id(triangle)]
    return seen, factors


def _basis(t: ndarray, intervals: int, degree: int) -> BSplines:
    return BSplines.clamped(np.linspace(t[0], t[-1], intervals + 1), degree)


def _most_intervals(values: int, times: int, degree: int) -> int:
    """Return the most knot intervals that leave a tenth of a typical channel's values for the estimate of the noise."""
    return int(min(0.9 * values - degree, times, MAX_INTERVALS))


def _cross_validated(
    t: ndarray, fields: Sequence[ndarray], weights: Sequence[float], degree: int, tidy: bool, values: int
) -> tuple[int, _SplineFit]:
    """Find the number of knot intervals with the least cross-validation score, in steps of an eighth."""
    best: tuple[int, _SplineFit] | None = None
    intervals = 1
    while best is None or intervals <= min(_most_intervals(values, len(t), degree), 4 * best[0] + 20):
        fitted = _spline_fit(t, fields, weights, intervals, degree, tidy)
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
