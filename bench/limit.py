"""The statistical limit: how accurately any method could know the coefficients from given samples.

For samples y = u(t) + noise of a motion with unknown start, no unbiased estimate has a covariance below the inverse of
the Fisher matrix (d y/d p)^T C^-1 (d y/d p), where C is the covariance of the noise. The parameters p are the
coefficients, the whole initial state and, at unknown ends, the splines that the sites without an equation follow
(Cramer, Mathematical Methods of Statistics (1946), section 32.3; Rao, Bull. Calcutta Math. Soc. 37, 81 (1945)). The
derivatives come from the variational equations (`latticebench.methods.engine.sensitivity`). The bound is proportional
to the noise.

Noise has the model of `latticebench.diagnosis.noise`, whose innovations make C diagonal. Where they follow Student's t
with nu degrees of freedom and scale s, each has (nu + 1) / (nu + 3) / s^2 in place of 1 / s^2 (Lange, Little & Taylor,
J. Am. Stat. Assoc. 84, 881, 1989). That noise which grows with the signal tells something about it is left out.

Values that were not observed (NaN in the data) carry no weight. A measured input counts as known; between its samples
it is their cubic spline.

At unknown ends the bound takes one B-spline coefficient per sample and site for the unknown motion there, which is as
free as the samples allow; the bound for known ends is lower.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.noise import fields_of, left_by, readings, rows_of
from latticebench.diagnosis.noise import Noise, Structure
from latticebench.methods.engine.bsplines import BSplines, through
from latticebench.methods.engine.condensing import condense
from latticebench.methods.engine.dynamics import Dynamics, split_parts
from latticebench.methods.engine.scaled import Scaled
from latticebench.methods.engine.sensitivity import Stretches
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples, SimulatedSamples
from latticebench.systems.simulate import noise_size

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.method import Fit

# A coefficient or a sum counts as known below the first relative error, and as roughly known below the second.
KNOWN = 0.1
ROUGH = 0.5
# Terms whose estimates are correlated more than this form a group.
TOGETHER = 0.9
# Larger groups are counted instead of listed in a verdict.
LISTED = 4
# Directions that the samples do not show count as known to this share of the best known one.
LEAST = 1e-13
DEGREE = 5


@dataclass(frozen=True, eq=False)
class Limit:
    """The Cramer-Rao bound of a library's coefficients.

    Attributes:
        library: the terms.
        coefficients: where the bound was taken (the truth, or a fit).
        covariance: the smallest covariance that unbiased estimates can have.
        scales: RMS of each term over that of the derivative, so that coefficient * scale is the term's share.
        conditioning: ratio of the largest to the smallest singular value of the terms' values, columns scaled to 1.
        noise: the noise level that the bound is for, sigma over RMS of the field about its mean.
        samples, span: how many samples in all trajectories, and how long the longest lasts.
    """

    library: Library
    coefficients: Float[ndarray, " terms"]
    covariance: Float[ndarray, "terms terms"]
    scales: Float[ndarray, " terms"]
    conditioning: float
    noise: float
    samples: int
    span: float

    @property
    def stderr(self) -> Float[ndarray, " terms"]:
        """The smallest standard error of each coefficient, in its units."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def relative(self) -> float:
        """The smallest root-mean-square of E2 = |xi - xi*| / |xi*|."""
        size = np.linalg.norm(self.coefficients)
        return float(np.sqrt(np.trace(self.covariance)) / size) if size > 0 else float("inf")

    @property
    def errors(self) -> Float[ndarray, " terms"]:
        """Relative standard errors of the coefficients.

        A coefficient that cannot be distinguished from 0 is compared with the value at which its term would be the
        whole derivative.
        """
        with np.errstate(divide="ignore"):
            relative = self.stderr / np.abs(self.coefficients)
        return np.asarray(np.where(relative <= ROUGH, relative, self.stderr * self.scales))

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Groups of terms that these samples hardly distinguish: unknown coefficients with correlated estimates."""
        unknown = np.flatnonzero(self.errors > KNOWN)
        error = self.stderr
        linked = np.abs(self.covariance) > TOGETHER * error * error[:, None]
        groups: list[tuple[int, ...]] = []
        left = set(unknown.tolist())
        while left:
            group, fresh = set[int](), {left.pop()}
            while fresh:
                one = fresh.pop()
                group.add(one)
                near = {other for other in left if linked[one, other]}
                left -= near
                fresh |= near
            if len(group) > 1:
                groups.append(tuple(sorted(group)))
        return tuple(sorted(groups))

    def combination(self, group: Sequence[int]) -> tuple[Float[ndarray, " group"], float, float]:
        """Return the best known weighted sum of the coefficients of a group.

        The weights are the eigenvector of the smallest eigenvalue of the bound, with each coefficient in units of its
        scale.

        Returns:
            the weights (the largest is 1), the value of the sum, and its standard error.
        """
        index = np.asarray(group)
        scale = self.scales[index]
        inner = self.covariance[np.ix_(index, index)] * scale * scale[:, None]
        weights = np.linalg.eigh(inner)[1][:, 0] * scale
        weights = weights / weights[np.argmax(np.abs(weights))]
        value = float(weights @ self.coefficients[index])
        error = float(np.sqrt(max(weights @ self.covariance[np.ix_(index, index)] @ weights, 0.0)))
        return weights, value, error

    @property
    def verdicts(self) -> tuple[str, ...]:
        """One sentence per term."""
        member = {term: group for group in self.groups for term in group}
        return tuple(
            (self._sum(member[k]) if error > KNOWN and k in member else "") or self._alone(k, float(error))
            for k, error in enumerate(self.errors)
        )

    def _alone(self, k: int, error: float) -> str:
        """Judge a coefficient by itself."""
        if error > ROUGH:
            return "cannot be known from these samples"
        value = abs(float(self.coefficients[k]))
        what = "" if self.stderr[k] <= ROUGH * value else " of the derivative, and cannot be told from 0"
        what = what if value else " of the derivative (its coefficient is 0)"
        return f"known {'only ' if error > KNOWN else ''}to {100 * error:.2g} %{what}"

    def _sum(self, group: Sequence[int]) -> str:
        """Describe the sum of the coefficients of a group that is known; empty where none is."""
        weights, value, error = self.combination(group)
        reference = abs(value)
        largest = int(np.argmax(np.abs(weights)))
        least = 1 / self.scales[list(group)][largest]
        share = error / reference if reference > 1e-9 * least else error / least
        if share > KNOWN:
            return ""
        if len(group) > LISTED:
            return f"only weighted sums with {len(group) - 1} other terms are known, the best to {100 * share:.2g} %"
        parts = []
        for weight, k in zip(weights, group, strict=True):
            if abs(weight) < 0.01:
                continue
            number = "" if abs(abs(weight) - 1) < 0.005 else f"{abs(weight):.3g} "
            sign = "-" if weight < 0 else "+"
            parts.append(f"{sign} {number}[{self.library.texts[k]}]")
        text = " ".join(parts).removeprefix("+ ")
        return f"only the sum of coefficients {text} is known, to {100 * share:.2g} %"

    def at(self, noise: float) -> Limit:
        """Return the bound for another noise level; standard errors are proportional to it.

        Raises:
            InputError: the level is not a positive number.
        """
        if not (np.isfinite(noise) and noise > 0):
            raise InputError(f"noise: {noise!r} must be a number above 0 (0.01 for one per cent)")
        covariance = self.covariance * (noise / self.noise) ** 2
        return Limit(
            self.library, self.coefficients, covariance, self.scales, self.conditioning, noise, self.samples, self.span
        )


@dataclass(frozen=True)
class Design:
    """What a measurement would need for a wanted accuracy; each number holds with everything else as it is.

    Attributes:
        target: the wanted E2.
        relative: E2 at the bound of the measurement as it is.
        noise: the largest noise level that allows it.
        samples: the fewest samples within the same time, or None if more are needed than `design` looks at.
        span: the duration of the shortest record with the same time between samples, or None likewise.
        records: the fewest records like this one, each with noise of its own.
    """

    target: float
    relative: float
    noise: float
    samples: int | None
    span: float | None
    records: int


def bound_of(data: Sequence[SimulatedSamples], library: Library, order: int, *, noise: float) -> Limit:
    """Return the bound for simulated samples, at their truth.

    Args:
        data: the samples of each trajectory; v counts if it is there, values that are NaN do not count.
        library: the terms whose coefficients are wanted.
        order: of the time derivative.
        noise: sigma over the RMS of each field about its mean, whatever noise the samples have.

    Raises:
        InputError: the equation is outside the library, or the noise level is not a positive number.
    """
    truth = data[0].truth(library)
    if truth is None:
        raise InputError(
            f"the equation of {data[0].source} is outside the library {library.name!r}: "
            "there are no coefficients to bound"
        )
    motion = [one.exact for one in data if one.exact is not None]
    return bound_along(data, motion, library, order, truth, noise=noise)


def bound_of_fit(data: Sequence[Samples], fit: Fit, noise: Noise | None = None) -> Limit:
    """Return the bound for measured samples, along the motion of a fit, with its coefficients.

    Args:
        data: the samples.
        fit: whose motion is followed.
        noise: of each sensor; None for what the fit leaves (`bench.noise.left_by`), including errors of the model.

    Raises:
        InputError: the fit has no motion.
    """
    if fit.motion is None:
        raise InputError(
            f"{data[0].source}: method {fit.method!r} follows no motion, along which a bound could be taken"
        )
    noise = left_by(data, fit).noise if noise is None else noise
    return bound_along(data, fit.motion, fit.library, fit.order, fit.coefficients, noise=noise)


def bound_along(
    data: Sequence[Samples],
    motion: Sequence[Samples],
    library: Library,
    order: int,
    coefficients: Float[ndarray, " terms"],
    *,
    noise: float | Noise = 0.01,
) -> Limit:
    """Return the bound along trajectories whose exact states are known (simulated or fitted).

    Args:
        data: the samples of each trajectory: v counts if it is there, values that are NaN do not count; their `ends` is
            used.
        motion: the states at the same times; v is needed for order 2.
        library: the terms.
        order: of the time derivative.
        coefficients: of the equation that the motion follows.
        noise: of each sensor, u before v; or a number, sigma over the RMS of each field about its mean.

    Raises:
        InputError: the noise is not a positive number, v is not known, or an input is missing.
    """
    if not isinstance(noise, Noise) and not (np.isfinite(noise) and noise > 0):
        raise InputError(f"noise: {noise!r} must be a number above 0 (0.01 for one per cent)")
    pieces = [_along(one, exact, library, order, coefficients, noise) for one, exact in zip(data, motion, strict=True)]
    design = np.concatenate([one.values for one in pieces])
    columns = np.linalg.norm(design, axis=0)
    columns[columns == 0] = 1.0
    values = np.linalg.svd(design / columns, compute_uv=False)
    height = np.linalg.norm(np.concatenate([one.rate for one in pieces]))
    covariance = Scaled.of(np.concatenate([one.rows for one in pieces])).covariance(LEAST)
    return Limit(
        library, np.asarray(coefficients, dtype=float), covariance,
        columns / max(height, 1e-300), float(values[0] / max(values[-1], 1e-300)),
        float(np.mean([one.level for one in pieces])), sum(len(one.t) for one in data),
        max(float(one.t[-1] - one.t[0]) for one in data),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Along:
    """What one trajectory contributes to the bound.

    Attributes:
        rows: derivatives of the samples by the coefficients, in units of the noise, with the start and the drive
            eliminated.
        values: of the terms (numbers of the derivative, terms).
        rate: the derivative of the equation.
        level: of the noise on u, relative to the RMS of u about its mean.
    """

    rows: Float[ndarray, "rows terms"]
    values: Float[ndarray, "numbers terms"]
    rate: Float[ndarray, " numbers"]
    level: float


def _along(
    one: Samples, exact: Samples, library: Library, order: int, coefficients: ndarray, noise: float | Noise
) -> _Along:
    if order == 2 and exact.v is None:
        raise InputError(f"{one.source}: the bound needs the velocities of the exact motion")
    dynamics = Dynamics(library.terms, order, exact.is_complex, exact.sites, one.ends)
    drive, splines = _drive(exact, dynamics)
    force = one.forcing() if library.uses("f") else None
    stretches = Stretches(dynamics, exact.t[:-1], exact.t[1:], force, drive)
    nodes = dynamics.pack(exact.u, exact.v)
    noise = noise if isinstance(noise, Noise) else _white(one, exact, noise, dynamics)
    weights, before, level = _whitening(one, exact, dynamics, noise)
    steps = stretches.substeps(coefficients, nodes[:-1], 1e-6 * float(np.max(np.abs(nodes))), splines)
    found = condense(stretches, stretches.vary(coefficients, nodes[:-1], steps, splines), weights, before=before)
    f = None if force is None else force(exact.t)
    driven = stretches.driven(exact.t, splines)
    rate, values, _ = dynamics.linear(coefficients, exact.t, nodes, f, driven, derivatives=False)
    return _Along(
        found.rows,
        np.moveaxis(values, 1, -1).reshape(-1, len(library.terms)),
        rate.reshape(len(rate), order, -1)[:, -1].ravel(),
        level,
    )


def _white(one: Samples, exact: Samples, level: float, dynamics: Dynamics) -> Noise:
    """Return white noise of one level; a complex field shares it between both parts."""
    sizes = [
        noise_size(field, level) / np.sqrt(dynamics.parts) for field in fields_of(_like(one, exact), dynamics.order)
    ]
    size = np.repeat(sizes, dynamics.sites)
    return Noise(size, 0.0, np.inf, np.zeros(len(size)), Structure())


def _whitening(
    one: Samples, exact: Samples, dynamics: Dynamics, noise: Noise
) -> tuple[Float[ndarray, "time order parts sites"], Float[ndarray, "time order parts sites"] | None, float]:
    """Return `weights` and `before` of `condense` for each observed number, and the noise level of u.

    Args:
        one: the samples; what is NaN in them weighs nothing.
        exact: their motion.
        dynamics: the equation.
        noise: of each sensor.
    """
    seen = np.isfinite(readings(one, dynamics.order))
    level, rows = readings(_like(one, exact), dynamics.order), rows_of([one], dynamics.order)
    height = noise_size(exact.u, 1.0)
    if not (np.all(np.isfinite(noise.size)) and np.all(noise.size > 0) and height > 0):
        raise InputError(f"{one.source}: nothing moves, or nothing is left to noise: there is no bound")
    whitener = noise.whitener(level, rows, seen)
    told = np.sqrt((noise.tail + 1) / (noise.tail + 3)) if np.isfinite(noise.tail) else 1.0

    def arranged(factors: ndarray) -> ndarray:
        flat = np.zeros(seen.size)
        flat[whitener.chain.where] = told * factors
        found = np.zeros((len(seen), dynamics.order, dynamics.parts * dynamics.sites))
        own = flat.reshape(seen.T.shape).T.reshape(len(seen), -1, found.shape[2])
        found[:, : own.shape[1]] = own
        return found.reshape(len(seen), dynamics.order, dynamics.parts, dynamics.sites)

    # Of Student's t the standard deviation is larger than the scale.
    heavier = (noise.deviation() / noise.size)[rows.sensor]
    spread = (heavier * np.hypot(noise.size[rows.sensor], noise.growth * level))[:, rows.sensor < dynamics.sites]
    noisy = float(np.sqrt(np.mean(spread**2) * dynamics.parts) / height)
    return arranged(whitener.own), arranged(whitener.before) if np.any(whitener.before) else None, noisy


def _like(one: Samples, exact: Samples) -> Samples:
    """Return a motion without velocities where none were observed."""
    return replace(exact, v=None) if one.v is None else exact


def _drive(exact: Samples, dynamics: Dynamics) -> tuple[BSplines | None, ndarray | None]:
    """Return splines with one coefficient per sample through the exact motion of the sites without an equation."""
    if len(dynamics.border) == 0:
        return None, None
    if len(exact.t) <= DEGREE:
        raise InputError(f"unknown ends need at least {DEGREE + 1} samples")
    return through(exact.t, split_parts(exact.u[:, dynamics.border], dynamics.is_complex), DEGREE)


def design(bound_at: Callable[[int, int], Limit], *, target: float = 0.01, doublings: int = 4) -> Design:
    """Return what would be needed to know the coefficients to `target`: less noise, more samples, or a longer record.

    Samples and record are doubled at most `doublings` times; between two doublings log E2 is taken as linear in their
    logarithm.

    Args:
        bound_at: function of two factors that returns the bound for as many times more samples in the same time, and
            for a record as many times longer. It raises InputError where the bound is not known.
        target: the wanted E2.
        doublings: largest number of doublings.

    Raises:
        InputError: the bound of the data as they are is not known, or the target is not a positive number.
    """
    if not (np.isfinite(target) and target > 0):
        raise InputError(f"target: {target!r} must be a number above 0 (0.01 for one per cent)")
    limit = bound_at(1, 1)
    now = limit.relative

    def needed(at: Callable[[int], Limit]) -> float | None:
        before = now
        if before <= target:
            return 1.0
        for k in range(doublings):
            try:
                after = at(2 ** (k + 1)).relative
            except InputError:
                return None
            if after <= target:
                return float(2 ** (k + np.log(before / target) / np.log(before / after)))
            before = after
        return None

    denser, longer = needed(lambda times: bound_at(times, 1)), needed(lambda times: bound_at(1, times))
    return Design(
        target, now, limit.noise * target / now,
        None if denser is None else int(np.ceil(limit.samples * denser)),
        None if longer is None else limit.span * longer,
        int(np.ceil((now / target) ** 2)),
    )  # fmt: skip


def denser(data: Sequence[Samples], fit: Fit, times: int, noise: Noise | None = None) -> Limit:
    """Return the bound of `bound_of_fit` for `times` as many samples of the same motion in the same time.

    Between the sample times the fitted motion is its spline of degree 5; no value is missing there.

    Raises:
        InputError: as for `bound_of_fit`, or there are too few samples for a spline.
    """
    if times == 1 or fit.motion is None:
        return bound_of_fit(data, fit, noise)
    noise = left_by(data, fit).noise if noise is None else noise
    seen, motion = [], []
    for one, exact in zip(data, fit.motion, strict=True):
        t = np.interp(np.arange((len(one.t) - 1) * times + 1) / times, np.arange(len(one.t)), one.t)
        u, v = _between(exact.t, exact.u, t), None if exact.v is None else _between(exact.t, exact.v, t)
        f = None if one.f is None else one.forcing()(t)
        motion.append(replace(exact, t=t, u=u, v=v, f=f))
        seen.append(replace(motion[-1], v=None if one.v is None else v))
    return bound_of_fit(seen, replace(fit, motion=tuple(motion)), noise)


def _between(t: ndarray, field: ndarray, at: ndarray) -> ndarray:
    """Interpolate a motion in time."""
    if len(t) <= DEGREE:
        raise InputError(f"a motion of {len(t)} samples cannot be interpolated; at least {DEGREE + 1} are needed")
    basis, coefficients = through(t, field, DEGREE)
    return np.asarray(basis.design(at, 0) @ coefficients)
