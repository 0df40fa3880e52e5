"""Sparse regression on the weak form of a lattice's equation, by generalised least squares with errors in the variables.

The equation d^order u_n / dt^order = sum_j xi_j T_j is multiplied by test functions phi_k of compact support and integrated,
the derivatives moved onto phi_k (Messenger & Bortz, Multiscale Model. Simul. 19, 1474 (2021); J. Comput. Phys. 443, 110525
(2021)):

    order 1:   - int phi_k' u_n dt = sum_j xi_j int phi_k T_j dt
    order 2:     int phi_k'' u_n dt = sum_j xi_j int phi_k T_j dt

The state. Each site's series is a least-squares spline of degree 9. Generalised cross-validation over all sites says how many
knots the data can bear: there their spectrum sinks into the noise. (A Fourier spectrum, from whose changepoint WSINDy
takes the support of phi, needs even times, no gaps and periodic data; a spline needs none of these.) Where the velocity was
observed, u = B c and v = B' c are fitted together, each weighted by its noise, so that one state carries both; as statistics that is the
first-order weak form - int phi' v together with the constraint v = u', at half its size. Where it was not, v = B' c, for
which int phi v = - int phi' u holds. The noise of u and of v is estimated from what the splines leave.

The integrals. The test functions (1 - s^2)^p are a few knot intervals wide; the trapezoidal rule on an even grid is
spectrally accurate for them (p derivatives vanish at the ends). The samples' own times may be uneven and have gaps.

The estimate. To first order in the noise of the state the residual of the weak equation is L(xi) (c_seen - c), with L from the
terms' derivatives; its covariance is L cov(c) L^T (WENDy: Bortz, Messenger & Dukic, Bull. Math. Biol. 85, 110 (2023)).
Generalised least squares gives xi, and the same algebra the nearest state that obeys the weak equation; there the terms are
evaluated again, until nothing changes. This is Gauss-Newton for maximum likelihood with errors in the variables (Britt & Luecke,
Technometrics 15, 233 (1973)); it takes away the bias that noise gives to plain least squares, such as 3 sigma^2 u in u^3.

The selection. On the whitened rows the least significant term is taken away, again and again, and the extended Bayesian
information criterion (Chen & Chen, Biometrika 95, 759 (2008)) says how many stay. Any of pysindy's optimisers can do it instead.
The coefficients are then estimated again on the terms that are left; their standard errors are those of that estimate,
infinite where the iteration did not settle.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from latticebench.methods.engine.regression import Regression
from latticebench.methods.method import Abilities, Fit
from latticebench.methods.sindy import sparse_fit
from latticebench.systems.compiler import partials
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import evaluate, ghosts, observed

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

LOADS = ("scipy.interpolate", "scipy.linalg", "sympy", "pysindy")

DEGREE = 9
MIN_SAMPLES = 6
MAX_INTERVALS = 400
# Twice the knots that cross-validation asks for: what the state cannot follow would count as noise, and errors would be too small.
FINENESS = 2
# Test functions a few knot intervals wide must fit into the record some times over.
FEWEST = 12
# A relative noise below this is no limit any more, round-off is; four times wider test functions do then as well.
EXACT = 1e-8
# Relative accuracy of quadrature and splines: the part of a weak equation's error that is not noise.
ACCURACY = 1e-10
# Trapezoidal points in half a support; with (1 - s^2)^12 what is left is below ACCURACY.
POINTS = 40
# So many channels decide on the number of knots where each has gaps of its own.
CHANNELS = 12
# Draws of the noise for total least squares, and the mean square residual from which it is tried.
DRAWS = 10
SUSPECT = 1.5
# Weights, relative to the data's, that make a spline smooth and small where a site was not seen.
BEND, SHRINK = 1e-7, 1e-10


def bumps(
    t: Float[ndarray, " grid"], centres: Float[ndarray, " tests"], half_width: float, power: int
) -> Float[ndarray, "derivatives tests grid"]:
    """Evaluate the test functions phi = (1 - s^2)^p, s = (t - centre) / half_width, and two derivatives in t.

    phi and its first p - 1 derivatives vanish at s = +-1, and phi is 0 beyond.

    Returns:
        phi (dimensionless), phi' (1 over time) and phi'' (1 over time squared), one above the other.
    """
    s = (t - centres[:, None]) / half_width
    inside = np.maximum(1 - s**2, 0.0)
    first = -2 * power * s * inside ** (power - 1) / half_width
    second = 2 * power * inside ** (power - 2) * ((2 * power - 1) * s**2 - 1) / half_width**2
    return np.stack([inside**power, first, second])


# The state ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class State:
    """What the samples say about a trajectory: a spline for each channel (a site's real or imaginary part), with its covariance.

    The spline's coefficients are c = factor @ w, where w has independent noise of variance 1.

    Attributes:
        seen: w as the samples give it (channels, coefficients).
        factors: one matrix a channel (coefficients, coefficients).
        knots: of the spline.
        degree: of the spline.
        intervals: how many knot intervals cross-validation asked for.
        noise: standard deviation of u (in each part of a complex field), and of v (NaN where it was not used).
        size: RMS of the seen values of u.
        whole: the sites that were seen often enough (N,).
    """

    seen: Float[ndarray, "channels coefficients"]
    factors: tuple[Float[ndarray, "coefficients coefficients"], ...]
    knots: Float[ndarray, " knots"]
    degree: int
    intervals: int
    noise: tuple[float, float]
    size: float
    whole: Bool[ndarray, " sites"]


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


def estimate_state(samples: Samples, order: int) -> State:
    """Fit splines to a trajectory's samples, with as many knots as the data can bear.

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
        _, alone = _bear(t, [field], [1.0], degree, tidy)
        noise.append(max(alone.noise, 1e-15 * _size(field), 1e-150))
    weights = [1 / sigma for sigma in noise]
    intervals, fitted = _bear(t, fields, weights, degree, tidy)
    for finer in (max(FINENESS * intervals + 3, FEWEST), intervals + 3):
        if finer <= _most_intervals(fields, degree):
            fitted = _spline_fit(t, fields, weights, finer, degree, tidy)
            break
    count = len(fitted.seen[0])
    inverse: dict[int, ndarray] = {}
    for triangle in fitted.triangles:
        if id(triangle) not in inverse:
            inverse[id(triangle)] = np.linalg.solve(triangle, np.eye(count))
    parts = 1 + samples.is_complex
    return State(
        fitted.seen,
        tuple(inverse[id(triangle)] for triangle in fitted.triangles),
        _knots(t, count - degree, degree),
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


def _knots(t: ndarray, intervals: int, degree: int) -> ndarray:
    inner = np.linspace(t[0], t[-1], intervals + 1)
    return np.concatenate([np.full(degree, t[0]), inner, np.full(degree, t[-1])])


def _basis(knots: ndarray, degree: int, t: ndarray, derivative: int) -> ndarray:
    """Evaluate all B-splines, or a derivative of them: (times, coefficients)."""
    from scipy.interpolate import BSpline

    return np.asarray(BSpline(knots, np.eye(len(knots) - degree - 1), degree)(t, derivative))


def _most_intervals(fields: Sequence[ndarray], degree: int) -> int:
    """Leave a tenth of the typical channel's values for the estimate of the noise."""
    values = float(np.median(sum(np.sum(~np.isnan(field), axis=0) for field in fields)))
    return int(min(0.9 * values - degree, len(fields[0]), MAX_INTERVALS))


def _bear(
    t: ndarray, fields: Sequence[ndarray], weights: Sequence[float], degree: int, tidy: bool
) -> tuple[int, _SplineFit]:
    """Find the number of knot intervals with the best cross-validation, in steps of an eighth."""
    # A few channels are enough to tell; each may have gaps, and so a factorisation, of its own.
    channels = np.unique(np.linspace(0, fields[0].shape[1] - 1, CHANNELS).round().astype(int))
    shown = fields if tidy else [field[:, channels] for field in fields]
    best: tuple[int, _SplineFit] | None = None
    intervals = 1
    while best is None or intervals <= min(_most_intervals(shown, degree), 4 * best[0] + 20):
        fitted = _spline_fit(t, shown, weights, intervals, degree, tidy)
        if best is None or fitted.score < best[1].score:
            best = intervals, fitted
        intervals = max(intervals + 1, round(1.125 * intervals))
    assert best is not None
    return best


def _spline_fit(
    t: ndarray, fields: Sequence[ndarray], weights: Sequence[float], intervals: int, degree: int, tidy: bool
) -> _SplineFit:
    """Fit u, and v as its derivative, by weighted least squares; channels with the same gaps share one factorisation."""
    knots = _knots(t, intervals, degree)
    design = np.concatenate([_basis(knots, degree, t, k) * weight for k, weight in enumerate(weights)])
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


# The weak equations -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Slope:
    """How the weak equations depend on one channel's w: `matrix` (equations * tests, coefficients), for some equations."""

    channel: int
    equations: ndarray
    matrix: ndarray


class WeakForm:
    """The weak equations of one trajectory: one for each test function, site and part, numbered by site, then part.

    Args:
        samples: the trajectory.
        library: the terms.
        order: of the equation.
        half_width: of the test functions, in knot intervals of the state.
        power: p of (1 - s^2)^p.

    Raises:
        InputError: too few samples or sites.
    """

    def __init__(self, samples: Samples, library: Library, order: int, half_width: float, power: int) -> None:
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
        self.value = _basis(state.knots, state.degree, self.grid, 0)
        self.rate = _basis(state.knots, state.degree, self.grid, 1)
        self.index, self.factor = ghosts(samples.sites, *library.reach, samples.ends)
        inner = np.arange(samples.sites)[observed(samples.sites, library.reach, samples.ends)]
        whole = state.whole if samples.f is None else state.whole & (np.sum(~np.isnan(samples.f), axis=0) > 1)
        width = 1 + sum(library.reach)
        stencils = [whole[self.index[k : k + width]] | (self.factor[k : k + width] == 0) for k in range(len(inner))]
        self.kept = np.flatnonzero([bool(np.all(stencil)) for stencil in stencils])
        self.sites = inner[self.kept]
        if len(self.sites) == 0:
            raise InputError(
                f"{samples.source}: no site has its whole stencil seen more than {state.degree} times; "
                "there are too many missing values or too few sites"
            )
        self.input = None if samples.f is None else _interpolate(t, samples.f, self.grid, whole)
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
        """Integrate both sides: (-1)^order int phi^(order) u, and int phi T_j for each term, in the term's units times time."""
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

    def slopes(
        self, w: Float[ndarray, "channels coefficients"], coefficients: Float[ndarray, " terms"]
    ) -> list[_Slope]:
        """Derive the residual of the weak equations by the state, one piece a channel."""
        profiles: defaultdict[int, dict[int, dict[str, ndarray]]] = defaultdict(dict)
        for (part, slot), slope in self._derivatives(w, coefficients).items():
            for k, place in enumerate(self.kept + self.library.reach[0] + slot.offset):
                if self.factor[place]:
                    channel = int(self.index[place]) * self.parts + (slot.part == "im")
                    one = profiles[channel].setdefault(k * self.parts + part, {})
                    one[slot.name] = one.get(slot.name, 0) + self.factor[place] * slope[:, k]
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
            result.append(_Slope(channel, equations, matrix @ self.state.factors[channel]))
        return result

    def _derivatives(self, w: ndarray, coefficients: ndarray) -> dict[tuple[int, Any], ndarray]:
        """Sum xi_j dT_j / d(slot) over the terms: for each part and slot (G, sites)."""
        bundle, places = self.partials
        u, v = self.fields(w)
        shape = (len(self.grid), len(self.sites))
        n = (np.arange(self.samples.sites) - (self.samples.sites - 1) / 2)[self.sites]
        arrays: list[ndarray] = []
        for slot in bundle.slots:
            if slot.name in ("t", "n"):
                arrays.append(np.broadcast_to(self.grid[:, None] if slot.name == "t" else n, shape))
                continue
            field = {"u": u, "v": v, "f": self.input}[slot.name]
            assert field is not None
            place = self.kept + self.library.reach[0] + slot.offset
            window = field[:, self.index[place]] * self.factor[place]
            arrays.append(window.imag if slot.part == "im" else window.real)
        found: dict[tuple[int, Any], ndarray] = {}
        if places and np.any(coefficients):
            # |u| has no derivative at 0; whatever is not finite there is left out.
            with np.errstate(all="ignore"):
                values = bundle.function(*arrays)
            for (term, part, slot), value in zip(places, values, strict=True):
                if coefficients[term]:
                    slope = np.broadcast_to(np.where(np.isfinite(value), value, 0.0), shape) * coefficients[term]
                    found[part, slot] = found.get((part, slot), 0.0) + slope
        return found

    def ranks(self) -> ndarray:
        """Order the equations so that those that share channels stand near each other; a ring is folded."""
        sites = len(self.sites)
        rank = np.arange(sites)
        if self.samples.ends in ("periodic", "antiperiodic"):
            rank = np.minimum(2 * rank, 2 * (sites - 1 - rank) + 1)
        return np.asarray((rank[:, None] * self.parts + np.arange(self.parts)).ravel())


def _interpolate(t: ndarray, f: ndarray, grid: ndarray, whole: ndarray) -> ndarray:
    """Put a measured input on the grid by cubic splines through what was seen of it; 0 at sites that are not used."""
    from scipy.interpolate import make_interp_spline

    result = np.zeros((len(grid), f.shape[1]))
    for site in np.flatnonzero(whole):
        seen = ~np.isnan(f[:, site])
        result[:, site] = make_interp_spline(t[seen], f[seen, site], k=min(3, int(np.sum(seen)) - 1))(grid)
    return result


class Covariance:
    """The Cholesky factor of the weak equations' covariance, a band matrix."""

    def __init__(self, form: WeakForm, slopes: Sequence[_Slope], accuracy: float) -> None:
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


# The estimate -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Estimate:
    """Coefficients by generalised least squares, the rows that they come from, and the states that go with them.

    Attributes:
        coefficients: (terms,); 0 outside the support.
        stderr: their standard errors, widened where the residual is larger than the noise explains.
        regression: the whitened rows of all terms.
        chi2: mean square of the whitened residual, about 1 when the equation holds and the noise is known.
        states: w of each trajectory.
        rounds: how often the terms were evaluated.
        settled: whether the coefficients stopped changing.
    """

    coefficients: Float[ndarray, " terms"]
    stderr: Float[ndarray, " terms"]
    regression: Regression
    chi2: float
    states: tuple[Float[ndarray, "channels coefficients"], ...]
    rounds: int
    settled: bool


def estimate(
    forms: Sequence[WeakForm],
    support: Bool[ndarray, " terms"],
    rounds: int,
    start: Estimate | None = None,
    seed: int = 0,
) -> Estimate:
    """Iterate generalised least squares and the state, on the terms in `support`.

    Without a start it begins with ordinary least squares and, where that leads nowhere because noise pulls it to zero, with
    total least squares; what settles is kept, and of two alike the one whose residual is what the noise explains.

    Args:
        forms: the weak equations of each trajectory.
        support: which terms are fitted.
        rounds: most times the terms are evaluated.
        start: where to begin.
        seed: of the draws that tell total least squares how the noise moves the rows.

    Raises:
        InputError: the covariance is not positive, or the terms overflow.
    """
    if start is not None:
        return _iterate(forms, support, rounds, np.where(support, start.coefficients, 0.0), start.states)
    seen = tuple(form.state.seen for form in forms)
    rows = np.concatenate([_joined(form, form.state.seen) for form in forms])
    found = _iterate(forms, support, rounds, Regression(rows[:, :-1], rows[:, -1]).least_squares(support), seen)
    if found.settled and found.chi2 < SUSPECT:
        return found
    first = _total(forms, support, seed)
    if first is None:
        return found
    other = _iterate(forms, support, rounds, first, seen)
    return max(found, other, key=lambda one: (one.settled, -abs(np.log(max(one.chi2, 1e-300)))))


def _iterate(
    forms: Sequence[WeakForm], support: ndarray, rounds: int, coefficients: ndarray, states: Sequence[ndarray]
) -> Estimate:
    target = np.concatenate([form.rows(form.state.seen)[0].ravel() for form in forms])
    accuracy = ACCURACY * (float(np.sqrt(np.mean(target**2))) or 1.0)
    best: Estimate | None = None
    for number in range(1, rounds + 1):
        try:
            now = _round(forms, support, coefficients, states, accuracy, number)
        except (np.linalg.LinAlgError, FloatingPointError) as error:
            if best is None:
                raise InputError(f"{forms[0].samples.source}: the weak form fails: {error}") from error
            return best
        step = np.abs(now.coefficients - coefficients)
        tolerance = np.maximum(0.01 * now.stderr, 1e-13 * np.max(np.abs(now.coefficients), initial=0.0))
        # The last estimate is the one to keep, unless the search ran away from a better one.
        if best is None or now.chi2 <= 1.2 * best.chi2:
            best = now
        if np.all(step <= tolerance):
            return replace(best, settled=True)
        coefficients, states = now.coefficients, now.states
    assert best is not None
    return best


def _total(forms: Sequence[WeakForm], support: ndarray, seed: int) -> ndarray | None:
    """Solve by total least squares, which noise in the terms does not pull towards zero as it does least squares.

    [A, y] (xi, -1) is made small against what the noise alone makes of it: the least generalised eigenvalue of the two
    matrices of sums of squares, that of the noise from a few draws (Van Huffel & Vandewalle, The Total Least Squares Problem,
    SIAM 1991, chapter 8). None where that has no finite solution.
    """
    import scipy.linalg

    draw = np.random.default_rng(seed)
    columns = np.append(np.flatnonzero(support), len(support))
    parts, changes = [], []
    for form in forms:
        seen = _joined(form, form.state.seen)[:, columns]
        parts.append(seen)
        for _ in range(DRAWS):
            noisy = form.state.seen + draw.normal(size=form.state.seen.shape)
            changes.append(_joined(form, noisy)[:, columns] - seen)
    rows, noise = np.concatenate(parts), np.concatenate(changes)
    scale = np.linalg.norm(rows, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    try:
        gram = (noise / scale).T @ (noise / scale) / DRAWS
        _, modes = scipy.linalg.eigh((rows / scale).T @ (rows / scale), gram, subset_by_index=[0, 0])
    except (np.linalg.LinAlgError, ValueError):
        return None
    least = modes[:, 0] / scale
    if abs(modes[-1, 0]) < 1e-6 * np.max(np.abs(modes)):
        return None
    full = np.zeros(len(support))
    full[columns[:-1]] = -least[:-1] / least[-1]
    return full


def _joined(form: WeakForm, w: ndarray) -> ndarray:
    """Put the terms' integrals and, in the last column, the derivative's into rows."""
    with np.errstate(all="ignore"):
        target, design = form.rows(w)
    return np.column_stack([design.reshape(target.size, -1), target.ravel()])


def _round(
    forms: Sequence[WeakForm],
    support: ndarray,
    coefficients: ndarray,
    states: Sequence[ndarray],
    accuracy: float,
    number: int,
) -> Estimate:
    """Linearise about the states and coefficients, solve for the coefficients, and move the states."""
    designs, targets, pieces = [], [], []
    for form, w in zip(forms, states, strict=True):
        target, design, slopes, covariance = linearised(form, w, coefficients, accuracy)
        designs.append(covariance.whiten(design))
        targets.append(covariance.whiten(target)[:, 0])
        pieces.append((form, slopes, covariance, target, design))
    regression = Regression(np.concatenate(designs), np.concatenate(targets))
    found = regression.least_squares(support)
    left = regression.target - regression.design @ found
    chi2 = float(np.sum(left**2) / max(len(left) - np.sum(support), 1))
    moved_states = []
    for form, slopes, covariance, target, design in pieces:
        pull = covariance.solve(target - design @ found)
        w = form.state.seen.copy()
        for slope in slopes:
            w[slope.channel] -= slope.matrix.T @ pull[slope.equations].ravel()
        moved_states.append(w)
    stderr = np.zeros(len(found))
    stderr[support] = _standard_errors(regression.design[:, support]) * np.sqrt(max(chi2, 1.0))
    return Estimate(found, stderr, regression, chi2, tuple(moved_states), number, settled=False)


def linearised(
    form: WeakForm, w: Float[ndarray, "channels coefficients"], coefficients: Float[ndarray, " terms"], accuracy: float
) -> tuple[Float[ndarray, "equations tests"], Float[ndarray, "equations tests terms"], list[_Slope], Covariance]:
    """Give both sides of the weak equations on the seen state, to first order about the state w, and their covariance.

    Args:
        form: the weak equations of a trajectory.
        w: the state that the terms are evaluated on.
        coefficients: xi.
        accuracy: standard deviation of what quadrature and splines miss.

    Raises:
        FloatingPointError: a term is not finite.
    """
    target, design = form.rows(w)
    slopes = form.slopes(w, coefficients)
    if not (np.all(np.isfinite(design)) and all(np.all(np.isfinite(slope.matrix)) for slope in slopes)):
        raise FloatingPointError("a term is not finite on the data")
    for slope in slopes:
        moved = slope.matrix @ (form.state.seen[slope.channel] - w[slope.channel])
        target[slope.equations] += moved.reshape(-1, form.count)
    return target, design, slopes, Covariance(form, slopes, accuracy)


def _standard_errors(design: ndarray) -> ndarray:
    """Root of the diagonal of (A^T A)^-1 for rows of unit variance; infinite where a column cannot be told from the others."""
    scale = np.linalg.norm(design, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, values, modes = np.linalg.svd(design / scale, full_matrices=False)
    if len(values) < design.shape[1] or len(values) == 0:
        return np.full(design.shape[1], np.inf)
    with np.errstate(divide="ignore"):
        spread = np.where(values > 1e-14 * values[0], 1 / values, np.inf)
    # A mode of infinite spread makes uncertain only the terms that are in it.
    parts = np.where(np.abs(modes) > 1e-12, np.abs(modes), 0.0)
    with np.errstate(invalid="ignore"):
        shares = np.where(parts > 0, parts * spread[:, None], 0.0)
    return np.asarray(np.sqrt(np.sum(shares**2, axis=0)) / scale)


def significant(
    regression: Regression, support: Bool[ndarray, " terms"], variance: float, gamma: float = 1.0
) -> Bool[ndarray, " terms"]:
    """Take away the least significant term, again and again, and keep the support with the best information criterion.

    The criterion is |y - A xi|^2 / variance + k (log n + 2 gamma log p), for k of p terms and n rows (Chen & Chen 2008).

    Args:
        regression: whitened rows.
        support: the terms to begin with.
        variance: of the rows.
        gamma: 0 for the Bayesian information criterion, 1 for its extension to large libraries.

    Returns:
        the terms that stay.
    """
    design, target = regression.design, regression.target
    rows, terms = design.shape
    price = np.log(rows) + 2 * gamma * np.log(terms)
    # The triangular factor has the same sums of squares in few rows.
    scale = np.linalg.norm(design, axis=0)
    scaled = np.column_stack([design / np.where(scale > 0, scale, 1.0), target])
    triangle = np.asarray(np.linalg.qr(scaled, mode="r"))
    columns, right = triangle[:, :-1], triangle[:, -1]
    left: ndarray = np.flatnonzero(support)
    best, best_score = np.zeros(terms, dtype=bool), float("inf")
    while True:
        solution = np.linalg.lstsq(columns[:, left], right, rcond=1e-14)[0] if len(left) else np.zeros(0)
        score = float(np.sum((right - columns[:, left] @ solution) ** 2)) / variance + price * len(left)
        if score < best_score:
            best = np.isin(np.arange(terms), left)
            best_score = score
        if len(left) == 0:
            return best
        z = np.abs(solution) / _standard_errors(columns[:, left])
        left = np.delete(left, int(np.argmin(z)))


@dataclass(frozen=True)
class Weak:
    """Weak form with generalised least squares and errors in the variables.

    Attributes:
        optimizer: how terms are selected: `bic` (extended Bayesian information criterion on the whitened rows), `none`
            (every term stays), or the class name of a pysindy optimiser, which gets the whitened rows.
        arguments: the pysindy optimiser's arguments, as a table.
        half_width: half the support of a test function, in knot intervals of the state (dimensionless).
        power: p of the test functions (1 - s^2)^p.
        rounds: most times the terms are evaluated anew.
    """

    name: ClassVar[str] = "weak"
    optimizer: str = "bic"
    arguments: dict[str, Any] | None = None
    half_width: float = 3.5
    power: int = 12
    rounds: int = 20

    @property
    def abilities(self) -> Abilities:
        """Everything: complex fields, inputs, uneven times, missing values."""
        return Abilities(missing=True, loads=LOADS)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Estimate all coefficients, select terms, estimate those again.

        Raises:
            InputError: a setting is out of range, there are too few samples, or the equations are not sound.
        """
        if not (self.half_width > 0 and self.power >= 4 and self.rounds >= 1):
            raise InputError("method 'weak': half_width must be above 0, power at least 4, rounds at least 1")
        forms = [WeakForm(samples, library, order, self.half_width, self.power) for samples in data]
        support = np.ones(len(library.terms), dtype=bool)
        found = estimate(forms, support, self.rounds, seed=seed)
        # The second pass judges with the covariance of the selected terms alone.
        for _ in range(2 if self.optimizer != "none" else 0):
            chosen = self._select(found, support, seed)
            if np.array_equal(chosen, support):
                break
            support = chosen
            found = estimate(forms, support, self.rounds, found)
        problems = []
        if not np.any(support):
            problems.append("every term was dropped")
        elif not found.settled:
            problems.append(f"not settled after {found.rounds} rounds")
        if found.chi2 > 2:
            problems.append(f"the residual is {np.sqrt(found.chi2):.2g} times what the noise explains")
        # Where the search did not settle, nobody knows how far off it is.
        stderr = np.where(support, found.stderr if found.settled else np.inf, 0.0)
        return Fit(
            self.name, library, order, found.coefficients, _residual(forms, found.coefficients), stderr,
            status="; ".join(problems) or "ok",
            found={
                "noise": forms[0].state.noise[0], "chi2": found.chi2, "rounds": float(found.rounds),
                "half_width": forms[0].support, "tests": float(forms[0].count),
                "intervals": float(forms[0].state.intervals),
            },
        )  # fmt: skip

    def _select(self, found: Estimate, support: ndarray, seed: int) -> ndarray:
        if self.optimizer == "bic":
            return significant(found.regression, support, max(found.chi2, 1.0))
        coefficients = sparse_fit(found.regression, self.optimizer, self.arguments or {}, seed)
        return np.asarray(support & (coefficients != 0))


def _residual(forms: Sequence[WeakForm], coefficients: ndarray) -> float:
    """Give what the equation leaves of the weak derivative on the seen states, relative to it."""
    rows = [form.rows(form.state.seen) for form in forms]
    target = np.concatenate([target.ravel() for target, _ in rows])
    left = target - np.concatenate([(design @ coefficients).ravel() for _, design in rows])
    height = float(np.sqrt(np.mean(target**2)))
    return float(np.sqrt(np.mean(left**2))) / (height or 1.0)


METHODS = (Weak,)
