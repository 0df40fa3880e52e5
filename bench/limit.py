"""The statistical limit: how well any method could know the coefficients from given samples.

For samples y = u(t) + noise (independent, Gaussian, sigma known) of a motion with unknown start, no unbiased estimate has a
covariance below the inverse of the Fisher matrix sum (d y/d p)^T (d y/d p) / sigma^2, p being the coefficients, the whole
initial state and, at unknown ends, the splines that the sites without an equation follow (Cramer, Mathematical Methods of
Statistics (1946), section 32.3; Rao, Bull. Calcutta Math. Soc. 37, 81 (1945)). The derivatives come from the variational
equations (`systems.sensitivity`). The bound scales with the noise.

Unknown ends: the bound takes one B-spline coefficient a sample and site for the unknown motion there, as free as the samples
allow; the bound for known ends is lower.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from systems.errors import InputError
from systems.lattice import Ends, Library, System
from systems.samples import Samples, SimulatedSamples
from systems.sensitivity import Drive, Dynamics, Stretches, condense, split_parts
from systems.simulate import noise_size, sample_times, simulate

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# A coefficient or a sum counts as known below this relative error.
KNOWN = 0.1
# Estimates correlated more than this are told as a group.
TOGETHER = 0.9
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
        """Each standard error over its coefficient; for a coefficient of 0, over what would make it the whole derivative."""
        reference = np.where(self.coefficients != 0, np.abs(self.coefficients), 1 / self.scales)
        return self.stderr / reference

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """The terms that can only be told apart badly from each other: unknown ones whose estimates go together."""
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
        """Give the best known weighted sum of a group's coefficients: its weights (the largest is 1), value and standard error.

        It is the eigenvector of the smallest eigenvalue of the bound, each coefficient measured as its term's share.
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
        """One sentence a term."""
        texts = []
        member = {term: group for group in self.groups for term in group}
        for k, error in enumerate(self.errors):
            if error <= KNOWN:
                ending = "" if self.coefficients[k] != 0 else " of the derivative (its coefficient is 0)"
                texts.append(f"known to {100 * error:.2g} %{ending}")
            elif k in member:
                texts.append(self._sum(member[k]))
            else:
                texts.append("cannot be known from these samples")
        return tuple(texts)

    def _sum(self, group: Sequence[int]) -> str:
        weights, value, error = self.combination(group)
        reference = abs(value)
        largest = int(np.argmax(np.abs(weights)))
        least = 1 / self.scales[list(group)][largest]
        share = error / reference if reference > 1e-9 * least else error / least
        if share > KNOWN:
            return "cannot be known from these samples"
        if len(group) > 4:
            listed = ", ".join(self.library.texts[k] for k in group)
            return f"only weighted sums of the coefficients of {listed} are known, the best to {100 * share:.2g} %"
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
        """Give the bound for another noise level; standard errors are in proportion to it.

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
    """What a measurement would need for a wanted accuracy, each by itself, the rest as it is.

    Attributes:
        target: the wanted E2.
        relative: E2 at the bound as things are.
        noise: the largest noise level that allows it.
        samples: the fewest samples within the same time, or None where more than were tried are needed.
        span: the shortest record with the same time between samples, or None likewise.
    """

    target: float
    relative: float
    noise: float
    samples: int | None
    span: float | None


def bound(
    system: System,
    library: Library,
    *,
    parameters: Mapping[str, float] | None = None,
    sites: int | None = None,
    times: Float[ndarray, " time"] | None = None,
    ends: Ends | None = None,
    known_ends: bool = True,
    initial: str | None = None,
    variations: Sequence[np.random.Generator | None] = (None,),
    velocities: bool = True,
    noise: float = 0.01,
) -> Limit:
    """Give the bound for samples of a system.

    Args:
        system: what moves.
        library: whose coefficients are wanted; the equation must be in its span.
        parameters: values that differ from the system's defaults.
        sites: N, the system's own number when None.
        times: sample times, the paper's 50 when None.
        ends: the system's own when None.
        initial: which initial state, the first when None.
        known_ends: whether the method is told how the chain ends.
        variations: one trajectory each; a generator varies its initial state.
        velocities: whether v is seen too (order 2).
        noise: sigma over the RMS of the field about its mean, for u and v each.

    Raises:
        InputError: something is unsound, or the equation is outside the library.
    """
    data = [
        simulate(system, parameters=parameters, sites=sites, times=times, ends=ends, initial=initial, variation=draw)
        for draw in variations
    ]
    truth = system.truth(library, parameters or {})
    if truth is None:
        raise InputError(
            f"the equation of {system.name!r} is outside the library {library.name!r}: there are no coefficients to bound"
        )
    chain: Ends = (ends or system.ends) if known_ends else "unknown"
    return bound_along(data, library, system.order, truth, ends=chain, velocities=velocities, noise=noise)


def bound_along(
    data: Sequence[Samples],
    library: Library,
    order: int,
    coefficients: Float[ndarray, " terms"],
    *,
    ends: Ends | None = None,
    velocities: bool = True,
    noise: float = 0.01,
) -> Limit:
    """Give the bound along trajectories whose exact states are known (simulated or fitted).

    Args:
        data: states at the sample times; for simulated samples their `exact` ones are taken.
        library: the terms.
        order: of the time derivative.
        coefficients: of the equation that the data follow.
        ends: as the samples say when None.
        velocities: whether v is seen too.
        noise: sigma over the RMS of each field about its mean.

    Raises:
        InputError: the noise level is no positive number, or v is not known.
    """
    if not (np.isfinite(noise) and noise > 0):
        raise InputError(f"noise: {noise!r} must be a number above 0 (0.01 for one per cent)")
    rows, designs, rates = [], [], []
    for one in data:
        exact = one.exact if isinstance(one, SimulatedSamples) and one.exact is not None else one
        if order == 2 and exact.v is None:
            raise InputError(f"{one.source}: the bound needs the velocities of the exact motion")
        chain = ends or one.ends
        dynamics = Dynamics(library.terms, order, exact.is_complex, exact.sites, chain)
        drive, splines = _drive(exact, dynamics)
        stretches = Stretches(dynamics, exact.t[:-1], exact.t[1:], drive=drive)
        nodes = dynamics.pack(exact.u, exact.v)
        # Per real part; a complex field shares its noise between both.
        sizes = [noise_size(exact.u, noise) / np.sqrt(dynamics.parts)]
        if order == 2:
            assert exact.v is not None
            sizes.append(noise_size(exact.v, noise) if velocities else np.inf)
        if not all(size > 0 for size in sizes):
            raise InputError(f"{one.source}: nothing moves, so that a noise level has no meaning")
        weight = np.broadcast_to(
            (1 / np.asarray(sizes))[:, None, None], (len(exact.t), order, dynamics.parts, dynamics.sites)
        )
        accuracy = 1e-6 * float(np.max(np.abs(nodes)))
        steps = stretches.substeps(coefficients, nodes[:-1], accuracy, splines)
        found = condense(
            stretches, stretches.vary(coefficients, nodes[:-1], steps, splines),
            weight[..., dynamics.moving].reshape(len(weight), -1),
            edge_weights=weight[..., dynamics.border] if drive is not None else None,
        )  # fmt: skip
        rows.append(found.rows)
        driven = stretches.driven(exact.t, splines)
        rate, values, _ = dynamics.linear(coefficients, exact.t, nodes, None, driven, derivatives=False)
        designs.append(np.moveaxis(values, 1, -1).reshape(-1, len(library.terms)))
        rates.append(rate.reshape(len(rate), order, -1)[:, -1].ravel())
    design = np.concatenate(designs)
    columns = np.linalg.norm(design, axis=0)
    columns[columns == 0] = 1.0
    values = np.linalg.svd(design / columns, compute_uv=False)
    height = np.linalg.norm(np.concatenate(rates))
    return Limit(
        library, np.asarray(coefficients, dtype=float), _inverse(np.concatenate(rows)), columns / max(height, 1e-300),
        float(values[0] / max(values[-1], 1e-300)), noise, sum(len(one.t) for one in data),
        max(float(one.t[-1] - one.t[0]) for one in data),
    )  # fmt: skip


def _drive(exact: Samples, dynamics: Dynamics) -> tuple[Drive | None, ndarray | None]:
    """Put splines of one coefficient a sample through the exact motion of the sites without an equation."""
    from scipy.interpolate import make_interp_spline

    if len(dynamics.border) == 0:
        return None, None
    if len(exact.t) <= DEGREE:
        raise InputError(f"unknown ends need at least {DEGREE + 1} samples")
    curve = make_interp_spline(exact.t, split_parts(exact.u[:, dynamics.border], dynamics.is_complex), k=DEGREE)
    return Drive(curve.t, DEGREE), curve.c


def _inverse(rows: ndarray) -> ndarray:
    """(rows^T rows)^-1, very large in directions that the samples do not show at all."""
    scale = np.linalg.norm(rows, axis=0)
    scale[scale == 0] = 1.0
    _, values, right = np.linalg.svd(rows / scale, full_matrices=False)
    spread = 1 / np.maximum(values, 1e-13 * max(values[0], 1e-300))
    return np.asarray((right.T * spread**2) @ right / scale / scale[:, None])


def design(
    system: System,
    library: Library,
    *,
    target: float = 0.01,
    times: Float[ndarray, " time"] | None = None,
    velocities: bool = True,
    noise: float = 0.01,
    parameters: Mapping[str, float] | None = None,
    sites: int | None = None,
    doublings: int = 4,
) -> Design:
    """Say what would be needed to know the coefficients to `target`: less noise, more samples, or a longer record.

    Samples and record are doubled at most `doublings` times; between two doublings log E2 is taken as linear in their log.

    Raises:
        InputError: as for `bound`, or the target is not a positive number.
    """
    if not (np.isfinite(target) and target > 0):
        raise InputError(f"target: {target!r} must be a number above 0 (0.01 for one per cent)")
    times = sample_times() if times is None else times
    step = float(np.mean(np.diff(times)))
    count = len(times)

    def error(at: ndarray) -> float:
        return bound(
            system, library, parameters=parameters, sites=sites, times=at, velocities=velocities, noise=noise
        ).relative

    now = error(times)

    def needed(make: Sequence[ndarray]) -> float | None:
        before = now
        if before <= target:
            return 1.0
        for k, at in enumerate(make):
            try:
                after = error(at)
            except InputError:
                return None
            if after <= target:
                return float(2 ** (k + np.log(before / target) / np.log(before / after)))
            before = after
        return None

    begin, end = float(times[0]), float(times[-1])
    denser = [np.linspace(begin, end, (count - 1) * 2**k + 1) for k in range(1, doublings + 1)]
    longer = [begin + step * np.arange((count - 1) * 2**k + 1) for k in range(1, doublings + 1)]
    more, further = needed(denser), needed(longer)
    return Design(
        target, now, noise * target / now,
        None if more is None else int(np.ceil(1 + (count - 1) * more)),
        None if further is None else (end - begin) * further,
    )  # fmt: skip
