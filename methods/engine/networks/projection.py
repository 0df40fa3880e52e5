"""A network's output weights and an equation's coefficients solved for together by least squares.

The hidden units are fixed (`hidden_units` beside this file), so that the fields are linear in the output weights a,

    u_n(t) = sum_k a_kn phi_k(t),   du_n/dt = sum_k a_kn dphi_k/dt,   and so on.

With given w, the output weights of every trajectory and the shared coefficients xi minimise

    |u - samples|^2 / s_u^2 + |du/dt - samples of v|^2 / s_v^2 + w^2 |rate - sum_j xi_j T_j(u)|^2 / s_r^2

summed over the samples and over the collocation times, which is least squares but for the nonlinearity of the library.
A damped Gauss-Newton step eliminates each trajectory's weights by a Schur complement (variable projection: Golub &
Pereyra, SIAM J. Numer. Anal. 10, 413 (1973); Kaufman's simplification, BIT 15, 49 (1975)).

Outputs are the sites' real parts, then for a complex field their imaginary parts. `...` in a shape is nothing for one
network, or on torch one axis of members.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from latticebench.methods.engine.derivatives import DEGREE, differentiate
from latticebench.methods.engine.networks.arrays import host
from latticebench.methods.engine.networks.equation import columns, curve_equation
from latticebench.methods.engine.networks.hidden_units import Basis, draw_basis, stack_bases
from latticebench.methods.method import Skipped, Smooth
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import ghosts

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.networks.arrays import Array, Arrays
    from latticebench.methods.engine.networks.sizes import Sizes

# Dense normal equations of this size take 800 MB with their inverse.
MAX_UNKNOWNS = 7000


@dataclass(frozen=True)
class CurveSettings:
    """How a curve is drawn and where the equation is asked for.

    Attributes:
        width: number of tanh units.
        bandwidth: steepest unit, in multiples of the samples' root-mean-square angular frequency.
        collocation: number of evenly spaced times, ends included, at which the equation is asked for.
    """

    width: int
    bandwidth: float
    collocation: int


class Neighbour(NamedTuple):
    """An output that the right-hand side at a site reads.

    Attributes:
        slope: number of the derivative by it, among those that `CurveEquation.evaluate` returns.
        output: its number.
        factor: that of the ghost that it is, 1 for a site within the chain.
        velocity: whether its time derivative is read.
    """

    slope: int
    output: int
    factor: float
    velocity: bool


class SiteEquation(NamedTuple):
    """The equation of one part at one inner site.

    Attributes:
        own: the output whose rate it describes.
        neighbours: what its right-hand side reads.
        columns: the unknowns that it has, as columns of the normal equations, those of the coefficients at the end.
    """

    own: int
    neighbours: list[Neighbour]
    columns: Array


class Curve:
    """One trajectory: its basis, its samples, and the normal equations of its output weights a (..., units, outputs).

    Attributes:
        times: collocation times (P,).
        law: the library on them.
        weights: the a to start with: the smoothing spline through the samples.
        outputs: number of outputs.
        units: number of functions in the basis.
        unknowns: outputs * units.
        observed: number of observed values.
    """

    def __init__(
        self,
        samples: Samples,
        library: Library,
        order: int,
        sizes: Sizes,
        settings: CurveSettings,
        draws: Sequence[np.random.Generator],
        arrays: Arrays,
    ) -> None:
        """Draw the hidden units and start at the smoothing spline.

        Args:
            samples: the trajectory.
            library: the terms.
            order: of the time derivative.
            sizes: by which residuals are scaled.
            settings: of the basis and the collocation.
            draws: one generator per network or member.
            arrays: of the device.

        Raises:
            Skipped: there are too many unknowns.
        """
        self.order, self.sizes, self.arrays = order, sizes, arrays
        lead = (len(draws),) if arrays.batches else ()
        self.times = times = np.linspace(samples.t[0], samples.t[-1], settings.collocation)
        steepness = settings.bandwidth * (sizes.rate / (sizes.velocity if order == 2 else sizes.field))
        drawn = [draw_basis(times, samples.t, settings.width, steepness, draw) for draw in draws]
        self.grid, self.at = (stack_bases(bases, arrays, lead) for bases in zip(*drawn, strict=True))
        self.law = curve_equation(samples, library, order, times, arrays)
        self.outputs = self.law.parts * samples.sites
        self.units = self.grid.value.shape[-1]
        self.unknowns = self.outputs * self.units
        if self.unknowns > MAX_UNKNOWNS:
            raise Skipped(f"it has {self.unknowns} unknown output weights, more than {MAX_UNKNOWNS}; lower width")
        self.blank = arrays.zeros(*lead, len(times), self.law.width)
        targets = columns(samples, order)
        levels = [(self.at.value, targets[:, : self.outputs] / sizes.field, sizes.field)]
        if order == 2:
            levels.append((self.at.first, targets[:, self.outputs :] / sizes.velocity, sizes.velocity))
        # Per observed level: the basis at the sample times, the samples in units of their size, and that size.
        self.targets = [(basis, arrays.move(target), unit) for basis, target, unit in levels]
        seen = [np.isfinite(target) for _, target, _ in levels]
        # The samples that an output has, None where it has them all.
        self.seen = [[None if np.all(one) else arrays.index(np.flatnonzero(one)) for one in whole.T] for whole in seen]
        self.observed = sum(int(np.sum(whole)) for whole in seen)
        self.site_equations = self._site_equations(samples, library)
        spline = np.stack([_smoothing_spline(samples.t, u, times) for u in targets[:, : self.outputs].T], axis=1)

        def fitted(grid: Basis) -> ndarray:
            # A little of the second derivative keeps weights small that the spline does not determine.
            bend = 1e-3 * grid.second / steepness**2
            right = np.vstack([spline, np.zeros_like(spline)])
            found = np.linalg.lstsq(np.vstack([grid.value, bend]), right, rcond=None)[0]
            return np.pad(found, ((0, self.units - len(found)), (0, 0)))

        weights = np.stack([fitted(grid) for grid, _ in drawn])
        self.weights: Array = arrays.move(weights.reshape(*lead, self.units, self.outputs))

    def _site_equations(self, samples: Samples, library: Library) -> list[list[SiteEquation]]:
        """Return the equations of each part, one per inner site."""
        index, factor = ghosts(samples.sites, *library.reach, samples.ends)
        read: list[list[list[Neighbour]]] = [[[] for _ in range(self.law.width)] for _ in range(self.law.parts)]
        for number, (part, slot) in enumerate(self.law.terms.slopes):
            for site in range(self.law.width):
                padded = self.law.reach[0] + slot.offset + site
                output = (samples.sites if slot.part == "im" else 0) + int(index[padded])
                if factor[padded]:
                    read[part][site].append(Neighbour(number, output, float(factor[padded]), slot.name == "v"))
        last = np.arange(self.unknowns, self.unknowns + len(library.terms))

        def site_equation(own: int, neighbours: list[Neighbour]) -> SiteEquation:
            outputs = dict.fromkeys([own, *(one.output for one in neighbours)])
            unknowns = [np.arange(output * self.units, (output + 1) * self.units) for output in outputs]
            return SiteEquation(own, neighbours, self.arrays.index(np.concatenate([*unknowns, last])))

        return [
            [
                site_equation(part * self.law.sites + self.law.inner.start + site, neighbours)
                for site, neighbours in enumerate(sites)
            ]
            for part, sites in enumerate(read)
        ]

    def state(self, a: Array, xi: Array) -> tuple[Array, Array, list[Array]]:
        """Evaluate both sides of the equation at the collocation times and the inner sites.

        Args:
            a: output weights (..., units, outputs).
            xi: coefficients (..., J).

        Returns:
            the terms (parts, J, ..., P, inner), the rate (parts, ..., P, inner), and the derivatives of sum_j xi_j T_j
            that `law.terms.slopes` names, each (..., P, inner).
        """
        law, xp = self.law, self.arrays.xp
        fields = self.grid.value @ a
        if self.order == 2:
            fields = xp.concatenate([fields, self.grid.first @ a], -1)
        rate = self.grid.level(self.order) @ a
        terms, slopes = law.evaluate(fields, xi)
        # A term, or a slope, may be a number.
        full = xp.stack([self.blank + term for part in terms for term in part])
        inner = [rate[..., p * law.sites + law.inner.start : p * law.sites + law.inner.stop] for p in range(law.parts)]
        return (
            full.reshape(law.parts, law.count, *self.blank.shape),
            xp.stack(inner),
            [self.blank + slope for slope in slopes],
        )

    def smooth(self, a: Array) -> list[Smooth]:
        """Return the field and its derivatives at the collocation times, one `Smooth` per network or member."""
        count = self.order + 1
        levels = np.stack([host(self.grid.level(number) @ a) for number in range(count)], axis=-3)
        share = np.full(len(self.times), 1 / len(self.times))
        each = levels.reshape(-1, count, len(self.times), self.law.parts, self.law.sites)
        return [Smooth(self.times, share, one) for one in each]

    def misfits(self, a: Array, xi: Array) -> tuple[Array, Array]:
        """Return the sums of squares (...) of the samples' and of the equation's scaled residuals, without w."""
        xp = self.arrays.xp
        data = sum(xp.nansum((basis @ a / unit - target) ** 2, (-2, -1)) for basis, target, unit in self.targets)
        terms, rate, _ = self.state(a, xi)
        left = rate - xp.einsum("...j,pj...ts->p...ts", xi, terms)
        return data, (left**2).sum((0, -2, -1)) / self.sizes.rate**2

    def normal(self, a: Array, xi: Array, weight: float) -> tuple[Array, Array]:
        """Return the Gauss-Newton equations for a change of output weights and coefficients.

        Args:
            a: output weights (..., units, outputs).
            xi: coefficients (..., J).
            weight: w.

        Returns:
            matrix (..., unknowns + J, unknowns + J) and right-hand side (..., unknowns + J): the weights output by
            output, then the coefficients.
        """
        total = self.unknowns + xi.shape[-1]
        lead = xi.shape[:-1]
        matrix, right = self.arrays.zeros(*lead, total, total), self.arrays.zeros(*lead, total)
        self._add_samples(matrix, right, a)
        self._add_equation(matrix, right, a, xi, weight)
        return matrix, right

    def _add_samples(self, matrix: Array, right: Array, a: Array) -> None:
        """Add the samples' rows to the normal equations."""
        units = self.units
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

    def _add_equation(self, matrix: Array, right: Array, a: Array, xi: Array, weight: float) -> None:
        """Add the equation's rows to the normal equations."""
        xp = self.arrays.xp
        terms, rate, slopes = self.state(a, xi)
        left = rate - xp.einsum("...j,pj...ts->p...ts", xi, terms)
        top = self.grid.level(self.order)
        scale = weight / self.sizes.rate
        for part, site_equations in enumerate(self.site_equations):
            for site, one in enumerate(site_equations):
                blocks = {one.own: top}
                for neighbour in one.neighbours:
                    basis = self.grid.first if neighbour.velocity else self.grid.value
                    piece = basis * (-neighbour.factor * slopes[neighbour.slope][..., site : site + 1])
                    output = neighbour.output
                    blocks[output] = blocks[output] + piece if output in blocks else piece
                rows = xp.concatenate([*blocks.values(), -xp.moveaxis(terms[part, ..., site], 0, -1)], -1) * scale
                matrix[..., one.columns[:, None], one.columns] += rows.mT @ rows
                right[..., one.columns] -= (rows.mT @ (left[part, ..., site] * scale)[..., None])[..., 0]


def _smoothing_spline(t: ndarray, values: ndarray, times: ndarray) -> ndarray:
    """Return the smoothing spline of one output (T,) at other times (P,); lines where too few values were seen."""
    from scipy.interpolate import make_interp_spline

    seen = np.isfinite(values)
    if np.sum(seen) > DEGREE:
        smooth = differentiate(t[seen], values[seen, None], "smoothing-spline").value[:, 0]
        # Beyond the values that were seen the curve goes on level: a quintic would run away.
        inside = np.clip(times, t[seen][0], t[seen][-1])
        return np.asarray(make_interp_spline(t[seen], smooth, k=DEGREE)(inside))
    return np.interp(times, t[seen], values[seen]) if np.any(seen) else np.zeros_like(times)


@dataclass(frozen=True, eq=False)
class ProjectedStep:
    """Where a step leads, and the factorised equations that it came from.

    Attributes:
        weights: output weights after it (..., units, outputs), one array per trajectory.
        coefficients: after it (..., J).
        freedom: trace of the samples' hat matrix (...), the coefficients counted as J; 0 where it was not asked for.
        covariance: inverse of the coefficients' block (..., J, J), in units of the variance of a scaled residual.
        sound: which members' damping was not too small for the round-off (...); the others' numbers mean nothing.
    """

    weights: list[Array]
    coefficients: Array
    freedom: Array
    covariance: Array
    sound: Array


def projected_step(
    curves: Sequence[Curve], at: Sequence[Array], xi: Array, weight: float, damping: Array, *, hat: bool
) -> ProjectedStep:
    """Solve the damped normal equations, trajectory by trajectory, with xi eliminated by its Schur complement.

    Args:
        curves: the trajectories.
        at: their output weights (..., units, outputs).
        xi: the coefficients (..., J).
        weight: w.
        damping: added to the diagonal, as a share of it (...).
        hat: compute the trace of the samples' hat matrix, too.
    """
    arrays, count = curves[0].arrays, xi.shape[-1]
    xp = arrays.xp
    schur, right = arrays.zeros(*xi.shape, count), arrays.zeros(*xi.shape)
    solved = []
    freedom, sound = damping * 0, damping == damping
    for curve, a in zip(curves, at, strict=True):
        matrix, vector = curve.normal(a, xi, weight)
        n = curve.unknowns
        diagonal = arrays.index(np.arange(n))
        size = xp.sqrt(matrix[..., diagonal, diagonal])
        # A unit that only fills a member up is held at zero by the damping.
        scale = xp.where(size > 0, 1 / size, 1.0)
        inner = matrix[..., :n, :n] * scale[..., None, :] * scale[..., None]
        inner[..., diagonal, diagonal] += damping[..., None]
        border = matrix[..., :n, n:] * scale[..., None]
        factor, positive = arrays.cholesky(inner)
        sound = sound & positive
        both = arrays.solve(factor, xp.concatenate([border, (vector[..., :n] * scale)[..., None]], -1))
        schur += matrix[..., n:, n:] - border.mT @ both[..., :-1]
        right += vector[..., n:] - (border.mT @ both[..., -1:])[..., 0]
        if hat:
            inverse = arrays.inverse(factor)
            for output in range(curve.outputs):
                place = slice(output * curve.units, (output + 1) * curve.units)
                for (basis, _, unit), seen in zip(curve.targets, curve.seen, strict=True):
                    some = seen[output]
                    rows = (basis if some is None else basis[..., some, :]) / unit * scale[..., None, place]
                    freedom = freedom + ((inverse[..., place.start :, place] @ rows.mT) ** 2).sum((-2, -1))
        solved.append((both, scale))
    covariance, finite = _pseudoinverse(host(schur))
    sound = sound & arrays.index(finite)
    inverse = arrays.move(covariance)
    change = (inverse @ right[..., None])[..., 0]
    moved = []
    for curve, a, (both, scale) in zip(curves, at, solved, strict=True):
        shift = (both[..., -1] - (both[..., :-1] @ change[..., None])[..., 0]) * scale
        moved.append(a + shift.reshape(*xi.shape[:-1], curve.outputs, curve.units).mT)
    return ProjectedStep(moved, xi + change, freedom + (count if hat else 0), inverse, sound)


def _pseudoinverse(schur: Float[ndarray, "*member terms terms"]) -> tuple[ndarray, ndarray]:
    """Invert the coefficients' block in units in which its diagonal is 1; return the inverse and where it is finite."""
    finite = np.all(np.isfinite(schur), axis=(-2, -1))
    schur = np.where(finite[..., None, None], schur, np.eye(schur.shape[-1]))
    size = np.sqrt(np.diagonal(schur, 0, -2, -1))
    size = np.where(size > 0, size, 1.0)
    scaled = schur / size[..., None, :] / size[..., None]
    return np.linalg.pinv(scaled, rcond=1e-15, hermitian=True) / size[..., None, :] / size[..., None], finite


def project(curves: Sequence[Curve], at: Sequence[Array], count: int) -> Float[ndarray, "*member terms"]:
    """Solve for the coefficients alone, by least squares with the curves as they are.

    Args:
        curves: the trajectories.
        at: their output weights (..., units, outputs).
        count: the number of terms J.

    Returns:
        the coefficients (..., J).
    """
    lead = at[0].shape[:-2]
    none = curves[0].arrays.zeros(*lead, count)
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
