"""A physics-informed network whose output layer and coefficients are solved for, not descended to.

One hidden layer of tanh units takes the time t and gives phi_k(t); the field is u_n(t) = sum_k a_nk phi_k(t). The velocity and
the rate are its exact time derivatives, so that no residual on du/dt - v is needed. Output weights a and coefficients xi
minimise

    |u - samples|^2 / s_u^2 + |du/dt - samples|^2 / s_v^2 + w^2 |rate - sum_j xi_j T_j(u)|^2 / s_r^2

summed over the samples and over evenly spaced collocation times; s_u, s_v and s_r are the sizes of the field, velocity and
rate in the samples, as in `methods.pinn`. What is new against that method:

- Variable projection (Golub & Pereyra, SIAM J. Numer. Anal. 10, 413 (1973); Kaufman's simplification, BIT 15, 49 (1975)):
  the problem is least squares in a and xi but for the library's nonlinearity, so Levenberg-Marquardt steps in both together
  end within a few iterations. The coefficients are eliminated from each step by their Schur complement.
- The hidden units are drawn and not trained. Their steepness follows from the frequencies in the samples, they bend evenly
  over the span, and a singular value decomposition makes them orthonormal, which keeps the least squares well conditioned.
- The weight w follows from the samples: from weak to strong, that with the least generalised cross-validation score
  (Golub, Heath & Wahba, Technometrics 21, 215 (1979)) of the predicted samples. Samples without noise ask for a weak w, noisy
  ones of an equation that the library holds for a strong one, and an equation outside the library for a weak one again.
- Training starts at the smoothing spline through the samples.

Standard errors are those of the linearised least squares at the end, with the variance that cross-validation finds.

The same formulas run on NumPy arrays and, on another device, on torch tensors, there for several members at once: networks whose
hidden units were drawn differently, which have one more axis in front. Each takes its own steps.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from latticebench.methods.engine.derivatives import DEGREE, differentiate
from latticebench.methods.method import Abilities, Fit, History, Skipped, Smooth
from latticebench.methods.pinn import (
    Diary,
    Equation,
    Scales,
    arrays,
    best_member,
    columns,
    equation,
    host,
    member_draws,
    multipliers,
    one_thread,
    scales,
    spread,
)
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import ghosts

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    # A NumPy array on the processor, a torch tensor elsewhere.
    Array = Any

# Dense normal equations of this size take 800 MB with their inverse.
MAX_UNKNOWNS = 7000
# Singular values below this share of the largest are round-off of nearly equal hidden units.
CUT = 1e-10


class Algebra:
    """What NumPy and torch do not have under one name.

    Attributes:
        xp: numpy or torch.
        move: what turns a NumPy array of numbers into one of `xp`.
    """

    def __init__(self, device: str) -> None:
        """Find the device.

        Raises:
            InputError: there is no such device.
        """
        self.xp, self.move = arrays(device)
        self.device = device

    def index(self, numbers: ndarray) -> Array:
        """Move whole numbers or truth values."""
        return numbers if self.xp is np else self.xp.tensor(numbers, device=self.device)

    def zeros(self, *shape: int) -> Array:
        """Make an array of zeros."""
        return np.zeros(shape) if self.xp is np else self.xp.zeros(shape, dtype=self.xp.float64, device=self.device)

    def cholesky(self, matrix: Array) -> tuple[Array, Array]:
        """Factorise matrices (..., n, n), which may be overwritten; say which (...) could be, the others give the identity.

        Only the lower triangle of a factor means anything.
        """
        if self.xp is np:
            from scipy.linalg import cho_factor

            try:
                return cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)[0], np.True_
            except np.linalg.LinAlgError:
                return np.eye(len(matrix)), np.False_
        factor, failed = self.xp.linalg.cholesky_ex(matrix)
        factor[failed > 0] = self.xp.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        return factor, failed == 0

    def solve(self, factor: Array, right: Array) -> Array:
        """Solve for right-hand sides (..., n, m)."""
        if self.xp is np:
            from scipy.linalg import cho_solve

            return cho_solve((factor, True), right, check_finite=False)
        return self.xp.cholesky_solve(right, factor)

    def inverse(self, factor: Array) -> Array:
        """Invert the factors themselves."""
        if self.xp is np:
            from scipy.linalg import solve_triangular

            return solve_triangular(factor, np.eye(len(factor)), lower=True, overwrite_b=True, check_finite=False)
        one = self.xp.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
        return self.xp.linalg.solve_triangular(factor, one.expand_as(factor), upper=False)


@dataclass(frozen=True, eq=False)
class Basis:
    """Orthonormal combinations of the hidden units, with their first and second derivative by t: each (..., rows, units)."""

    value: Array
    first: Array
    second: Array

    def part(self, rows: slice | ndarray) -> Basis:
        """Take some of the rows."""
        return Basis(self.value[rows], self.first[rows], self.second[rows])


def together(bases: Sequence[Basis], algebra: Algebra, lead: tuple[int, ...]) -> Basis:
    """Put the members' bases into one; a basis with fewer units than another is filled up with zeros."""
    units = max(basis.value.shape[-1] for basis in bases)

    def filled(arrays: Sequence[ndarray]) -> Array:
        whole = np.stack([np.pad(one, ((0, 0), (0, units - one.shape[-1]))) for one in arrays])
        return algebra.move(whole.reshape(*lead, -1, units))

    return Basis(*(filled(arrays) for arrays in zip(*((b.value, b.first, b.second) for b in bases), strict=True)))


def hidden(
    times: Float[ndarray, " collocation"],
    more: Float[ndarray, " time"],
    width: int,
    steepness: float,
    draw: np.random.Generator,
) -> tuple[Basis, Basis]:
    """Draw a hidden layer and make it orthonormal on the collocation times.

    Args:
        times: collocation times; their first and last are the span.
        more: further times, the samples'.
        width: how many tanh units.
        steepness: largest slope of a unit's argument, in 1/time.
        draw: the generator.

    Returns:
        the basis on the collocation times and on the further times; the constant is in it.
    """
    slopes = draw.uniform(-steepness, steepness, width)
    middle, half = (times[0] + times[-1]) / 2, (times[-1] - times[0]) / 2
    # Units that bend a little beyond the span serve its ends.
    centres = middle + half * draw.uniform(-1.1, 1.1, width)
    t = np.concatenate([times, more])[:, None]
    h = np.tanh(slopes * (t - centres))
    first = (1 - h * h) * slopes
    second = -2 * h * first * slopes
    constant = np.ones_like(t)
    layers = [np.hstack([h, constant]), np.hstack([first, 0 * constant]), np.hstack([second, 0 * constant])]
    count = len(times)
    _, size, modes = np.linalg.svd(layers[0][:count], full_matrices=False)
    kept = size > CUT * size[0]
    turn = modes[kept].T / size[kept] * math.sqrt(count)
    whole = Basis(*(layer @ turn for layer in layers))
    return whole.part(slice(None, count)), whole.part(slice(count, None))


class Source(NamedTuple):
    """An output that the right-hand side sees: the slope's number, the output, a ghost's factor, whether it is its velocity."""

    number: int
    output: int
    factor: float
    velocity: bool


class Place(NamedTuple):
    """An equation of one part and inner site: its own output, what it sees, and its columns of the normal equations."""

    own: int
    sources: list[Source]
    columns: Array


class Curve:
    """One trajectory: its basis, its samples, and the normal equations of its output weights a (..., units, outputs).

    Outputs are the sites' real parts, then for a complex field their imaginary parts. `...` is one axis of members, or nothing.

    Attributes:
        times: collocation times.
        law: the library on them.
        weights: a, the start.
        observed: how many values were observed.
    """

    def __init__(
        self,
        samples: Samples,
        library: Library,
        order: int,
        size: Scales,
        settings: PINNVP,
        draws: Sequence[np.random.Generator],
        algebra: Algebra,
    ) -> None:
        """Draw the hidden layers and start at the smoothing spline.

        Raises:
            Skipped: there are too many unknowns.
        """
        self.order, self.size, self.algebra = order, size, algebra
        lead = () if algebra.xp is np else (len(draws),)
        self.times = times = np.linspace(samples.t[0], samples.t[-1], settings.collocation)
        frequency = size.rate / (size.velocity if order == 2 else size.field)
        drawn = [hidden(times, samples.t, settings.width, settings.bandwidth * frequency, draw) for draw in draws]
        self.grid, self.at = (together(bases, algebra, lead) for bases in zip(*drawn, strict=True))
        self.law: Equation = equation(samples, library, order, times, algebra.xp, algebra.move)
        targets = columns(samples, order)
        self.outputs = self.law.parts * samples.sites
        self.units = self.grid.value.shape[-1]
        self.unknowns = self.outputs * self.units
        if self.unknowns > MAX_UNKNOWNS:
            raise Skipped(f"it has {self.unknowns} unknown output weights, more than {MAX_UNKNOWNS}; lower width")
        shape = (*lead, len(times), self.law.inner.stop - self.law.inner.start)
        self.blank = algebra.zeros(*shape)
        halves = [(self.at.value, targets[:, : self.outputs] / size.field, size.field)]
        if order == 2:
            halves.append((self.at.first, targets[:, self.outputs :] / size.velocity, size.velocity))
        self.targets = [(basis, algebra.move(target), unit) for basis, target, unit in halves]
        seen = [np.isfinite(target) for _, target, _ in halves]
        # The samples that an output has, None where it has them all.
        self.seen = [[None if np.all(one) else algebra.index(np.flatnonzero(one)) for one in whole.T] for whole in seen]
        self.observed = sum(int(np.sum(whole)) for whole in seen)
        self.places = self._places(samples, library)
        start = np.stack([_smooth(samples.t, u, times) for u in targets[:, : self.outputs].T], axis=1)

        def fitted(grid: Basis) -> ndarray:
            # A little of the second derivative keeps weights small that the spline does not determine.
            bend = 1e-3 * grid.second / (settings.bandwidth * frequency) ** 2
            ends = np.vstack([start, np.zeros_like(start)])
            found = np.linalg.lstsq(np.vstack([grid.value, bend]), ends, rcond=None)[0]
            return np.pad(found, ((0, self.units - len(found)), (0, 0)))

        weights = np.stack([fitted(grid) for grid, _ in drawn])
        self.weights: Array = algebra.move(weights.reshape(*lead, self.units, self.outputs))

    def _places(self, samples: Samples, library: Library) -> list[list[Place]]:
        """Say for each part and inner site what its equation sees."""
        index, factor = ghosts(samples.sites, *library.reach, samples.ends)
        width = self.law.inner.stop - self.law.inner.start
        sources: list[list[list[Source]]] = [[[] for _ in range(width)] for _ in range(self.law.parts)]
        for number, (part, slot) in enumerate(self.law.terms.places):
            for site in range(width):
                padded = self.law.reach[0] + slot.offset + site
                output = (samples.sites if slot.part == "im" else 0) + int(index[padded])
                if factor[padded]:
                    source = Source(number, output, float(factor[padded]), velocity=slot.name == "v")
                    sources[part][site].append(source)
        last = np.arange(self.unknowns, self.unknowns + len(library.terms))

        def place(own: int, seen: list[Source]) -> Place:
            outputs = dict.fromkeys([own, *(source.output for source in seen)])
            columns = [np.arange(output * self.units, (output + 1) * self.units) for output in outputs]
            return Place(own, seen, self.algebra.index(np.concatenate([*columns, last])))

        return [
            [place(part * self.law.sites + self.law.inner.start + site, seen) for site, seen in enumerate(sites)]
            for part, sites in enumerate(sources)
        ]

    def state(self, a: Array, xi: Array) -> tuple[Array, Array, list[Array]]:
        """Give the terms (parts, terms, ..., time, sites), the rate (parts, ..., time, sites) and the slopes.

        Args:
            a: output weights (..., units, outputs).
            xi: coefficients (..., terms).

        Returns:
            terms and rate at the inner sites, and the slopes of sum_j xi_j T_j, each (..., time, sites).
        """
        law, xp = self.law, self.algebra.xp
        fields = self.grid.value @ a
        if self.order == 2:
            fields = xp.concatenate([fields, self.grid.first @ a], -1)
        rate = (self.grid.second if self.order == 2 else self.grid.first) @ a
        values = law.terms.function(*law.windows(fields), *multipliers(xi))
        # A term, or a slope, may be a number.
        full = [self.blank + value for value in values]
        terms = xp.stack(full[: law.count * law.parts]).reshape(law.parts, law.count, *self.blank.shape)
        inner = [rate[..., p * law.sites + law.inner.start : p * law.sites + law.inner.stop] for p in range(law.parts)]
        return terms, xp.stack(inner), full[law.count * law.parts :]

    def smooth(self, a: Array) -> list[Smooth]:
        """Give the field and its derivatives at the collocation times, one for each member."""
        bases = (self.grid.value, self.grid.first, self.grid.second)[: self.order + 1]
        levels = np.stack([host(basis @ a) for basis in bases], axis=-3)
        share = np.full(len(self.times), 1 / len(self.times))
        each = levels.reshape(-1, len(bases), len(self.times), self.law.parts, self.law.sites)
        return [Smooth(self.times, share, one) for one in each]

    def misfits(self, a: Array, xi: Array) -> tuple[Array, Array]:
        """Give the sums of squares (...) of the samples' and of the equation's residuals, both scaled by sizes, without w."""
        xp = self.algebra.xp
        data = sum(xp.nansum((basis @ a / unit - target) ** 2, (-2, -1)) for basis, target, unit in self.targets)
        terms, rate, _ = self.state(a, xi)
        left = rate - xp.einsum("...j,pj...ts->p...ts", xi, terms)
        return data, (left**2).sum((0, -2, -1)) / self.size.rate**2

    def normal(self, a: Array, xi: Array, weight: float) -> tuple[Array, Array]:
        """Give the Gauss-Newton matrix (..., unknowns + J, unknowns + J) and right-hand side, output by output, then xi."""
        xp, units, count = self.algebra.xp, self.units, xi.shape[-1]
        total = self.unknowns + count
        matrix, right = self.algebra.zeros(*xi.shape[:-1], total, total), self.algebra.zeros(*xi.shape[:-1], total)
        for (basis, target, unit), seen in zip(self.targets, self.seen, strict=True):
            scaled = basis / unit
            whole = scaled.mT @ scaled
            for output, some in enumerate(seen):
                rows = scaled if some is None else scaled[..., some, :]
                values = target[:, output] if some is None else target[some, output]
                block = slice(output * units, (output + 1) * units)
                matrix[..., block, block] += whole if some is None else rows.mT @ rows
                missed = values - (rows @ a[..., output, None])[..., 0]
                right[..., block] += (rows.mT @ missed[..., None])[..., 0]
        terms, rate, slopes = self.state(a, xi)
        left = rate - xp.einsum("...j,pj...ts->p...ts", xi, terms)
        top = self.grid.second if self.order == 2 else self.grid.first
        scale = weight / self.size.rate
        for part, places in enumerate(self.places):
            for site, place in enumerate(places):
                blocks = {place.own: top}
                for source in place.sources:
                    basis = self.grid.first if source.velocity else self.grid.value
                    piece = basis * (-source.factor * slopes[source.number][..., site : site + 1])
                    output = source.output
                    blocks[output] = blocks[output] + piece if output in blocks else piece
                rows = xp.concatenate([*blocks.values(), -xp.moveaxis(terms[part, ..., site], 0, -1)], -1) * scale
                matrix[..., place.columns[:, None], place.columns] += rows.mT @ rows
                right[..., place.columns] -= (rows.mT @ (left[part, ..., site] * scale)[..., None])[..., 0]
        return matrix, right


def _smooth(t: ndarray, values: ndarray, times: ndarray) -> ndarray:
    """Interpolate the smoothing spline of one output at other times; lines where too few values were seen."""
    from scipy.interpolate import make_interp_spline

    seen = np.isfinite(values)
    if np.sum(seen) > DEGREE:
        smooth = differentiate(t[seen], values[seen, None], "smoothing-spline").value[:, 0]
        # Beyond the values that were seen the curve goes on level: a quintic would run away.
        inside = np.clip(times, t[seen][0], t[seen][-1])
        return np.asarray(make_interp_spline(t[seen], smooth, k=DEGREE)(inside))
    return np.interp(times, t[seen], values[seen]) if np.any(seen) else np.zeros_like(times)


@dataclass(frozen=True, eq=False)
class Step:
    """A factorised step: output weights and coefficients, the trace of the hat matrix and the inverse of xi's block.

    `sound` says which members' damping was not too small for the round-off; the others' numbers mean nothing.
    """

    weights: list[Array]
    coefficients: Array
    freedom: Array
    covariance: Array
    sound: Array


def step(curves: Sequence[Curve], at: Sequence[Array], xi: Array, weight: float, damping: Array, *, hat: bool) -> Step:
    """Solve the damped normal equations, trajectory by trajectory, with xi eliminated by its Schur complement.

    Args:
        curves: the trajectories.
        at: their output weights (..., units, outputs).
        xi: the coefficients (..., J).
        weight: w.
        damping: added to the diagonal, as a share of it (...).
        hat: compute the trace of the hat matrix of the samples, too.
    """
    algebra, count = curves[0].algebra, xi.shape[-1]
    xp = algebra.xp
    schur, right = algebra.zeros(*xi.shape, count), algebra.zeros(*xi.shape)
    solved = []
    freedom, sound = damping * 0, damping == damping
    for curve, a in zip(curves, at, strict=True):
        matrix, vector = curve.normal(a, xi, weight)
        n = curve.unknowns
        diagonal = algebra.index(np.arange(n))
        size = xp.sqrt(matrix[..., diagonal, diagonal])
        # A unit that only fills a member up is held at zero by the damping.
        scale = xp.where(size > 0, 1 / size, 1.0)
        inner = matrix[..., :n, :n] * scale[..., None, :] * scale[..., None]
        inner[..., diagonal, diagonal] += damping[..., None]
        border = matrix[..., :n, n:] * scale[..., None]
        factor, positive = algebra.cholesky(inner)
        sound = sound & positive
        both = algebra.solve(factor, xp.concatenate([border, (vector[..., :n] * scale)[..., None]], -1))
        schur += matrix[..., n:, n:] - border.mT @ both[..., :-1]
        right += vector[..., n:] - (border.mT @ both[..., -1:])[..., 0]
        if hat:
            inverse = algebra.inverse(factor)
            for output in range(curve.outputs):
                place = slice(output * curve.units, (output + 1) * curve.units)
                for (basis, _, unit), seen in zip(curve.targets, curve.seen, strict=True):
                    some = seen[output]
                    rows = (basis if some is None else basis[..., some, :]) / unit * scale[..., None, place]
                    freedom = freedom + ((inverse[..., place.start :, place] @ rows.mT) ** 2).sum((-2, -1))
        solved.append((both, scale))
    covariance, finite = _pseudoinverse(host(schur))
    sound = sound & algebra.index(finite)
    inverse = algebra.move(covariance)
    change = (inverse @ right[..., None])[..., 0]
    moved = []
    for curve, a, (both, scale) in zip(curves, at, solved, strict=True):
        shift = (both[..., -1] - (both[..., :-1] @ change[..., None])[..., 0]) * scale
        moved.append(a + shift.reshape(*xi.shape[:-1], curve.outputs, curve.units).mT)
    return Step(moved, xi + change, freedom + (count if hat else 0), inverse, sound)


def _pseudoinverse(schur: Float[ndarray, "*member terms terms"]) -> tuple[ndarray, ndarray]:
    """Invert the coefficients' block in units in which its diagonal is 1, and say where it is finite."""
    finite = np.all(np.isfinite(schur), axis=(-2, -1))
    schur = np.where(finite[..., None, None], schur, np.eye(schur.shape[-1]))
    size = np.sqrt(np.diagonal(schur, 0, -2, -1))
    size = np.where(size > 0, size, 1.0)
    scaled = schur / size[..., None, :] / size[..., None]
    return np.linalg.pinv(scaled, rcond=1e-15, hermitian=True) / size[..., None, :] / size[..., None], finite


def project(curves: Sequence[Curve], at: Sequence[Array], count: int) -> Float[ndarray, "*member terms"]:
    """Solve for the coefficients alone, by least squares with the curves as they are."""
    lead = at[0].shape[:-2]
    none = curves[0].algebra.zeros(*lead, count)
    states = [[host(part) for part in curve.state(a, none)[:2]] for curve, a in zip(curves, at, strict=True)]
    found = np.zeros((*lead, count))
    for member in np.ndindex(*lead):
        of = (slice(None), slice(None), *member)
        design = [np.moveaxis(terms[of], 1, -1).reshape(-1, count) for terms, _ in states]
        target = [rate[of[1:]].ravel() for _, rate in states]
        matrix = np.concatenate(design)
        size = np.sqrt(np.mean(matrix**2, axis=0))
        size[~(size > 0)] = 1.0
        found[member] = np.linalg.lstsq(matrix / size, np.concatenate(target), rcond=1e-14)[0] / size
    return found


@dataclass(frozen=True)
class PINNVP:
    """A network with its output layer and coefficients solved by least squares; see the module.

    Attributes:
        width: tanh units.
        bandwidth: steepest unit, in multiples of the samples' root-mean-square angular frequency.
        collocation: evenly spaced times, ends included, at which the equation is asked for.
        weights: weights w of the equation against the samples, to choose from, weak to strong.
        iterations: most Levenberg-Marquardt steps a weight.
        tolerance: a step that lowers the objective by less than this share of it is the last one.
        device: cpu, or a device of torch's such as cuda; cpu:0 is torch on the processor.
        members: networks whose hidden units are drawn differently; the one with the least cross-validation score is the fit,
            and `found` has the standard deviation of each coefficient over them. On a device they take their steps together,
            in `members` times the memory; on NumPy arrays one is solved after the other, since a processor gains nothing
            (on torch with one thread of it, eight together cost 1.7 of eight single ones: the matrices outgrow its cache).

    Raises:
        InputError: a number is unsound.
    """

    name: ClassVar[str] = "pinn-vp"
    width: int = 80
    bandwidth: float = 3.0
    collocation: int = 201
    weights: tuple[float, ...] = (1e-4, 1e-3, 0.01, 0.1, 1.0, 10.0, 100.0)
    iterations: int = 8
    tolerance: float = 1e-6
    device: str = "cpu"
    members: int = 1

    def __post_init__(self) -> None:
        """Check the settings."""
        for name, least in (("width", 1), ("collocation", 2), ("iterations", 1), ("members", 1)):
            if getattr(self, name) < least:
                raise InputError(
                    f"method {self.name!r}: setting {name} = {getattr(self, name)!r}; it must be at least {least}"
                )
        for name, values in (
            ("bandwidth", (self.bandwidth,)),
            ("tolerance", (self.tolerance,)),
            ("weights", self.weights),
        ):
            if not values or not all(math.isfinite(value) and value > 0 for value in values):
                raise InputError(
                    f"method {self.name!r}: setting {name} = {getattr(self, name)!r}; it takes numbers above 0"
                )

    @property
    def abilities(self) -> Abilities:
        """Everything but the truth."""
        return Abilities(missing=True, loads=() if self.device == "cpu" else ("torch",))

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Solve for output weights and coefficients with one weight w after the other, and keep the best by cross-validation.

        Raises:
            InputError: torch does not have the device.
            Skipped: a trajectory has too many unknowns for dense normal equations.
        """
        algebra = Algebra(self.device)
        draws = member_draws(seed, self.members)
        since = time.perf_counter()
        with one_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            size = scales(data, library, order)
            ends = [
                end
                for group in ([[draw] for draw in draws] if algebra.xp is np else [draws])
                for end in self._solve(
                    [Curve(samples, library, order, size, self, group, algebra) for samples in data],
                    len(library.terms),
                    since,
                )
            ]
        best = ends[best_member(np.array([end.score for end in ends]))]
        if not math.isfinite(best.score):
            status = "no weight could be solved for"
            return Fit(self.name, library, order, best.coefficients, float("nan"), status=status)
        found = {"weight": best.weight, "noise": math.sqrt(best.score) * size.field}
        found |= spread(np.array([end.coefficients for end in ends]), library)
        return Fit(
            self.name, library, order, best.coefficients, best.residual, best.stderr, history=best.history, found=found,
            smooth=best.smooth,
        )  # fmt: skip

    def _solve(self, curves: list[Curve], count: int, since: float) -> list[End]:
        """Go through the weights with one network or the members of a batch; each leaves off where its own score says so."""
        algebra = curves[0].algebra
        xp = algebra.xp
        observed = sum(curve.observed for curve in curves)
        at = [curve.weights for curve in curves]
        xi = algebra.move(project(curves, at, count))
        diary = Diary(1, since)
        taken = 0
        least = algebra.zeros(*xi.shape[:-1]) + math.inf
        going = least > 0
        # The best so far: w, the output weights, the coefficients, their standard errors.
        chosen, kept, found, errors = least * 1, at, xi, xi * math.nan
        for weight in sorted(self.weights):
            at, xi, taken, last = self._descend(curves, at, xi, weight, going, taken, diary)
            missed = sum(curve.misfits(a, xi)[0] for curve, a in zip(curves, at, strict=True))
            # With as many degrees of freedom as values the samples say nothing about their noise.
            free = xp.clip(observed - last.freedom, 1e-6 * observed, None)
            variance = missed / free
            score = variance * observed / free
            sound = going & last.sound
            better = sound & (score < least)
            spreads = xp.clip(xp.diagonal(last.covariance, 0, -2, -1), 0, None)
            errors = xp.where(better[..., None], xp.sqrt(spreads * variance[..., None]), errors)
            kept = [xp.where(better[..., None, None], a, old) for a, old in zip(at, kept, strict=True)]
            found = xp.where(better[..., None], xi, found)
            chosen = xp.where(better, weight, chosen)
            least = xp.where(better, score, least)
            going = going & ~(sound & ~better & (score > 3 * least))
            if not bool(going.any()):
                break
        found = xp.where(xp.isfinite(least)[..., None], found, xi)
        ending = diary.loss[-1] if diary.loss else host(algebra.zeros(*least.shape))
        diary.note(taken + 1, ending, host(found), always=True)
        law = sum(curve.misfits(a, found)[1] for curve, a in zip(curves, kept, strict=True))
        whole = sum(
            (curve.state(a, found)[1] ** 2).sum((0, -2, -1)) / curve.size.rate**2
            for curve, a in zip(curves, kept, strict=True)
        )
        residual = xp.sqrt(xp.where(whole > 0, law / whole, law))
        numbers = [host(one) for one in (least, chosen, found, errors, residual)]
        smooth = list(zip(*(curve.smooth(a) for curve, a in zip(curves, kept, strict=True)), strict=True))
        return [
            End(
                float(numbers[0][of]), float(numbers[1][of]), numbers[2][of], numbers[3][of], float(numbers[4][of]),
                diary.history(of[0] if of else None), smooth[of[0] if of else 0],
            )
            for of in np.ndindex(*least.shape)
        ]  # fmt: skip

    def _descend(
        self,
        curves: list[Curve],
        at: list[Array],
        xi: Array,
        weight: float,
        going: Array,
        taken: int,
        diary: Diary,
    ) -> tuple[list[Array], Array, int, Step]:
        """Take Levenberg-Marquardt steps with one weight; give the point and the factorised last step.

        Each member that is still `going` has its own damping: one whose trial fails tries again while the others move on.
        """
        algebra = curves[0].algebra
        xp = algebra.xp

        def objective(point: Sequence[Array], coefficients: Array) -> Array:
            pairs = [curve.misfits(a, coefficients) for curve, a in zip(curves, point, strict=True)]
            value = sum(data + weight**2 * law for data, law in pairs)
            return xp.where(xp.isfinite(value), value, math.inf)

        value = objective(at, xi)
        least = algebra.zeros(*xi.shape[:-1]) + 1e-12
        damping, steps, active = least, algebra.zeros(*xi.shape[:-1]), going
        while bool(active.any()):
            trial = step(curves, at, xi, weight, damping, hat=False)
            lower = objective(trial.weights, trial.coefficients)
            found = active & trial.sound & (lower < value)
            at = [xp.where(found[..., None, None], new, old) for new, old in zip(trial.weights, at, strict=True)]
            xi = xp.where(found[..., None], trial.coefficients, xi)
            gain = value - lower
            enough = gain < self.tolerance * (lower + gain)
            value, steps = xp.where(found, lower, value), steps + found
            damping = xp.where(found, xp.clip(damping / 30, 1e-12, None), damping * 30)
            active = active & xp.where(found, (steps < self.iterations) & ~enough, damping < 1e3)
            if bool(found.any()):
                taken += 1
                diary.note(taken, host(value), host(xi))
        last = step(curves, at, xi, weight, least, hat=True)
        for _ in range(2):
            if bool((last.sound | ~going).all()):
                break
            least = xp.where(last.sound, least, least * 100)
            last = step(curves, at, xi, weight, least, hat=True)
        return at, xi, taken, last


class End(NamedTuple):
    """Where a member ended: its cross-validation score, weight w, coefficients, standard errors, residual, way there and curves."""

    score: float
    weight: float
    coefficients: ndarray
    stderr: ndarray
    residual: float
    history: History
    smooth: tuple[Smooth, ...]


METHODS = (PINNVP,)
