"""The weak form of a lattice's equation: its integrals over test functions, and the covariance of their errors.

The equation d^order u_n / dt^order = sum_j xi_j T_j is multiplied by test functions phi_k of compact support and
integrated, with the derivatives moved onto phi_k (Messenger & Bortz, Multiscale Model. Simul. 19, 1474 (2021); J.
Comput. Phys. 443, 110525 (2021)):

    order 1:   - int phi_k' u_n dt = sum_j xi_j int phi_k T_j dt
    order 2:     int phi_k'' u_n dt = sum_j xi_j int phi_k T_j dt

The integrands are evaluated on a spline through the samples (`latticebench.methods.engine.spline_state`). The test
functions (1 - s^2)^p are a few knot intervals wide; the trapezoidal rule on an even grid is spectrally accurate for
them, because p derivatives vanish at the ends. (WSINDy takes the support of phi from the changepoint of a Fourier
spectrum, which needs even times, no gaps and periodic data; a spline needs none of these.) Where the velocity was
observed, u and v are one spline. In statistical terms this equals the first-order weak form - int phi' v together with
the constraint v = u', at half its size.

To first order in the noise of the state, the residual of the weak equations is L(xi) (c_seen - c), where c are the
coefficients of the spline and L follows from the derivatives of the terms; its covariance is L cov(c) L^T (WENDy:
Bortz, Messenger & Dukic, Bull. Math. Biol. 85, 110 (2023)).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.inputs import inputs
from latticebench.methods.engine.spline_state import estimate_state
from latticebench.systems.compiler import partials
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import Stencil, evaluate, numbers

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Half the support of a test function in knot intervals, and its power p.
HALF_WIDTH = 3.5
POWER = 12
# Below this relative noise, round-off limits the accuracy; test functions four times wider then serve as well.
EXACT = 1e-8
# Relative accuracy of quadrature and splines: the part of a weak equation's error that is not noise.
ACCURACY = 1e-10
# Points of the trapezoidal rule in half a support; with (1 - s^2)^12 its error is below ACCURACY.
POINTS = 40


def bumps(
    t: Float[ndarray, " grid"], centres: Float[ndarray, " tests"], half_width: float, power: int
) -> Float[ndarray, "derivatives tests grid"]:
    """Evaluate the test functions phi = (1 - s^2)^p, s = (t - centre) / half_width, and two derivatives in t.

    phi and its first p - 1 derivatives vanish at s = +-1, and phi is 0 beyond.

    Returns:
        phi (dimensionless), phi' (1 over time) and phi'' (1 over time squared).
    """
    s = (t - centres[:, None]) / half_width
    inside = np.maximum(1 - s**2, 0.0)
    first = -2 * power * s * inside ** (power - 1) / half_width
    second = 2 * power * inside ** (power - 2) * ((2 * power - 1) * s**2 - 1) / half_width**2
    return np.stack([inside**power, first, second])


@dataclass(frozen=True, eq=False)
class Slope:
    """The derivative of the residuals of some weak equations by the state of one channel.

    Attributes:
        channel: its number.
        equations: numbers of the equations that depend on it.
        matrix: the derivative by w (equations * tests, coefficients).
    """

    channel: int
    equations: ndarray
    matrix: ndarray


class WeakForm:
    """The weak equations of one trajectory: one per test function, site and part, ordered by site, then part.

    Args:
        samples: the trajectory.
        library: the terms.
        order: of the equation.
        half_width: half the support of the test functions, in knot intervals of the state.
        power: p of (1 - s^2)^p.

    Attributes:
        state: splines through the samples.
        grid: times at which the integrands are evaluated (G,).
        tests: the test functions and two derivatives, times the step of the grid (3, tests, G).
        support: half the support of a test function, in units of time.
        sites: the sites that have a weak equation.
        parts: 1 for a real field, 2 for a complex one.

    Raises:
        InputError: too few samples or sites.
    """

    def __init__(
        self, samples: Samples, library: Library, order: int, half_width: float = HALF_WIDTH, power: int = POWER
    ) -> None:
        """Estimate the state, then place the test functions."""
        self.samples, self.library, self.order = samples, library, order
        self.parts = 1 + samples.is_complex
        self.state = estimate_state(samples, order)
        state, t = self.state, samples.t
        span = t[-1] - t[0]
        intervals = len(state.knots) - 2 * state.degree - 1
        if state.noise[0] < EXACT * state.size:
            intervals = max(state.intervals // 4, min(intervals, 12))
        self.support = support = float(min(half_width * span / intervals, span / 3))
        count = max(int(np.ceil((span - 2 * support) / span * intervals)) + 1, 2)
        self.grid = np.linspace(t[0], t[-1], int(np.ceil(POINTS * span / support)) + 1)
        centres = np.linspace(t[0] + support, t[-1] - support, count)
        self.tests = bumps(self.grid, centres, support, power) * (self.grid[1] - self.grid[0])
        self.value = state.basis(self.grid, 0)
        self.rate = state.basis(self.grid, 1)
        self.stencil = Stencil.chain(samples.sites, library.reach, samples.ends)
        whole = state.whole if samples.f is None else state.whole & (np.sum(~np.isnan(samples.f), axis=0) > 1)
        read = [self.stencil.neighbours(offset) for offset in self.stencil.offsets]
        self.kept = np.flatnonzero(np.all([whole[place] | (factor == 0) for place, factor in read], axis=0))
        self.sites = self.stencil.own[self.kept]
        if len(self.sites) == 0:
            raise InputError(
                f"{samples.source}: no site has its whole stencil seen more than {state.degree} times; "
                "there are too many missing values or too few sites"
            )
        # At sites that are not used there may be no input at all.
        self.input = (
            None if samples.f is None else inputs(replace(samples, f=np.where(whole, samples.f, 0.0)), self.grid)
        )
        self.partials = partials(library.texts, samples.is_complex)

    @property
    def count(self) -> int:
        """The number of test functions."""
        return int(self.tests.shape[1])

    def fields(self, w: Float[ndarray, "channels coefficients"]) -> tuple[ndarray, ndarray]:
        """Evaluate the state on the grid: u and v, each (G, N)."""
        c = np.stack([factor @ one for factor, one in zip(self.state.factors, w, strict=True)], axis=1)
        u, v = self.value @ c, self.rate @ c
        if self.parts == 1:
            return u, v
        return u[:, ::2] + 1j * u[:, 1::2], v[:, ::2] + 1j * v[:, 1::2]

    def rows(
        self, w: Float[ndarray, "channels coefficients"]
    ) -> tuple[Float[ndarray, "equations tests"], Float[ndarray, "equations tests terms"]]:
        """Return both sides: (-1)^order int phi^(order) u, and int phi T_j in units of the term times time."""
        u, v = self.fields(w)
        values = evaluate(
            self.library.terms, u, v, self.input, self.grid, ends=self.samples.ends, reach=self.library.reach
        )
        design = np.einsum("kg,ptgs->spkt", self.tests[0], values[..., self.kept], optimize=True)
        field = np.stack([u.real, u.imag][: self.parts])[:, :, self.sites]
        target = np.einsum("kg,pgs->spk", self._main, field, optimize=True)
        equations = len(self.sites) * self.parts
        return target.reshape(equations, self.count), design.reshape(equations, self.count, -1)

    @property
    def _main(self) -> ndarray:
        return np.asarray(-self.tests[1] if self.order == 1 else self.tests[2])

    def slopes(self, w: Float[ndarray, "channels coefficients"], coefficients: Float[ndarray, " terms"]) -> list[Slope]:
        """Return the derivative of the residual of the weak equations by the state, one piece per channel."""
        profiles: defaultdict[int, dict[int, dict[str, ndarray]]] = defaultdict(dict)
        for (part, slot), slope in self._derivatives(w, coefficients).items():
            places, factors = self.stencil.neighbours(slot.vector)
            for k, (place, factor) in enumerate(zip(places[self.kept], factors[self.kept], strict=True)):
                if factor:
                    channel = int(place) * self.parts + (slot.part == "im")
                    one = profiles[channel].setdefault(k * self.parts + part, {})
                    one[slot.name] = one.get(slot.name, 0) + factor * slope[:, k]
        own = (self.sites[:, None] * self.parts + np.arange(self.parts)).ravel()
        for equation, channel in enumerate(own):
            profiles[int(channel)].setdefault(equation, {})
        result = []
        for channel, found in sorted(profiles.items()):
            equations = np.array(sorted(found))
            by_value = np.zeros((len(equations), *self._main.shape))
            by_rate = np.zeros_like(by_value)
            for k, equation in enumerate(equations):
                if own[equation] == channel:
                    by_value[k] += self._main
                by_value[k] -= self.tests[0] * found[equation].get("u", 0.0)
                by_rate[k] -= self.tests[0] * found[equation].get("v", 0.0)
            matrix = by_value.reshape(-1, len(self.grid)) @ self.value
            if any("v" in one for one in found.values()):
                matrix += by_rate.reshape(-1, len(self.grid)) @ self.rate
            result.append(Slope(channel, equations, matrix @ self.state.factors[channel]))
        return result

    def _derivatives(self, w: ndarray, coefficients: ndarray) -> dict[tuple[int, Any], ndarray]:
        """Return sum_j xi_j dT_j / d(slot) for each part and variable of the stencil, each (G, sites)."""
        bundle, places = self.partials
        u, v = self.fields(w)
        shape = (len(self.grid), len(self.sites))
        n = numbers(self.samples.sites)[self.sites]
        arrays: list[ndarray] = []
        for slot in bundle.slots:
            if slot.name in ("t", "n"):
                arrays.append(np.broadcast_to(self.grid[:, None] if slot.name == "t" else n, shape))
                continue
            field = {"u": u, "v": v, "f": self.input}[slot.name]
            assert field is not None
            place, factor = (one[self.kept] for one in self.stencil.neighbours(slot.vector))
            window = field[:, place] * factor
            arrays.append(window.imag if slot.part == "im" else window.real)
        found: dict[tuple[int, Any], ndarray] = {}
        if places and np.any(coefficients):
            # |u| has no derivative at 0; what is not finite there is left out.
            with np.errstate(all="ignore"):
                values = bundle.function(*arrays)
            for (term, part, slot), value in zip(places, values, strict=True):
                if coefficients[term]:
                    slope = np.broadcast_to(np.where(np.isfinite(value), value, 0.0), shape) * coefficients[term]
                    found[part, slot] = found.get((part, slot), 0.0) + slope
        return found

    def ranks(self) -> ndarray:
        """Return an order in which equations that share channels are near each other; a ring is folded."""
        sites = len(self.sites)
        rank = np.arange(sites)
        if self.stencil.is_ring:
            rank = np.minimum(2 * rank, 2 * (sites - 1 - rank) + 1)
        return np.asarray((rank[:, None] * self.parts + np.arange(self.parts)).ravel())


class Covariance:
    """The Cholesky factor of the weak equations' covariance, a band matrix."""

    def __init__(self, form: WeakForm, slopes: Sequence[Slope], accuracy: float) -> None:
        from scipy.linalg import cholesky_banded

        tests, equations = form.count, len(form.sites) * form.parts
        self.shape = (equations, tests)
        self.rank = form.ranks()
        self.order = np.argsort(self.rank)
        blocks: dict[tuple[int, int], ndarray] = {}
        for slope in slopes:
            gram = slope.matrix @ slope.matrix.T
            for i, one in enumerate(self.rank[slope.equations]):
                for j, other in enumerate(self.rank[slope.equations]):
                    if one >= other:
                        block = gram[i * tests : (i + 1) * tests, j * tests : (j + 1) * tests]
                        blocks[one, other] = blocks.get((one, other), 0.0) + block
        width = (1 + max(one - other for one, other in blocks)) * tests
        band = np.zeros((width, equations * tests))
        row, column = np.indices((tests, tests))
        for (one, other), block in blocks.items():
            below = (one - other) * tests + row - column
            lower = below >= 0
            band[below[lower], (other * tests + column)[lower]] = block[lower]
        band[0] += accuracy**2
        for jitter in (0.0, 1e-13, 1e-11, 1e-9, 1e-7):
            try:
                shifted = band.copy()
                shifted[0] *= 1 + jitter
                self.factor = cholesky_banded(shifted, lower=True, check_finite=False)
                return
            except np.linalg.LinAlgError:
                continue
        raise np.linalg.LinAlgError("the covariance of the weak equations is not positive")

    def whiten(self, rows: Float[ndarray, "equations tests *terms"]) -> ndarray:
        """Multiply by the inverse of the factor: rows with independent noise of variance 1."""
        from scipy.linalg.lapack import dtbtrs

        flat = rows[self.order].reshape(self.shape[0] * self.shape[1], -1)
        return np.asarray(dtbtrs(self.factor, flat, uplo="L")[0])

    def solve(self, rows: Float[ndarray, "equations tests"]) -> ndarray:
        """Multiply by the inverse of the covariance."""
        from scipy.linalg import cho_solve_banded

        solved = cho_solve_banded((self.factor, True), rows[self.order].ravel(), check_finite=False)
        return np.asarray(solved.reshape(self.shape)[self.rank])


def linearised(
    form: WeakForm, w: Float[ndarray, "channels coefficients"], coefficients: Float[ndarray, " terms"], accuracy: float
) -> tuple[Float[ndarray, "equations tests"], Float[ndarray, "equations tests terms"], list[Slope], Covariance]:
    """Linearise the weak equations on the observed state about the state w.

    Args:
        form: the weak equations of a trajectory.
        w: the state that the terms are evaluated on.
        coefficients: xi.
        accuracy: standard deviation of the errors of quadrature and splines.

    Returns:
        the left side (equations, tests), the terms on the right (equations, tests, terms), the derivatives by the
        state, and the covariance.

    Raises:
        FloatingPointError: a term is not finite.
        LinAlgError: the covariance is not positive.
    """
    target, design = form.rows(w)
    slopes = form.slopes(w, coefficients)
    if not (np.all(np.isfinite(design)) and all(np.all(np.isfinite(slope.matrix)) for slope in slopes)):
        raise FloatingPointError("a term is not finite on the data")
    for slope in slopes:
        moved = slope.matrix @ (form.state.seen[slope.channel] - w[slope.channel])
        target[slope.equations] += moved.reshape(-1, form.count)
    return target, design, slopes, Covariance(form, slopes, accuracy)
