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
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from methods.derivatives import DEGREE, differentiate
from methods.method import Abilities, Fit, Skipped
from methods.pinn import Diary, Equation, Scales, columns, equation, one_thread, scales
from systems.errors import InputError
from systems.lattice import Library, ghosts
from systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

# Dense normal equations of this size take 800 MB with their inverse.
MAX_UNKNOWNS = 7000
# Singular values below this share of the largest are round-off of nearly equal hidden units.
CUT = 1e-10


@dataclass(frozen=True, eq=False)
class Basis:
    """Orthonormal combinations of the hidden units, with their first and second derivative by t: each (rows, K)."""

    value: Float[ndarray, "rows units"]
    first: Float[ndarray, "rows units"]
    second: Float[ndarray, "rows units"]

    def part(self, rows: slice | ndarray) -> Basis:
        """Take some of the rows."""
        return Basis(self.value[rows], self.first[rows], self.second[rows])


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


class Curve:
    """One trajectory: its basis, its samples, and the normal equations of its output weights a (K, outputs).

    Outputs are the sites' real parts, then for a complex field their imaginary parts.

    Attributes:
        law: the library on the collocation times.
        weights: a, the start.
        observed: how many values were observed.
    """

    def __init__(
        self, samples: Samples, library: Library, order: int, size: Scales, settings: PINNVP, draw: np.random.Generator
    ) -> None:
        """Draw the hidden layer and start at the smoothing spline.

        Raises:
            Skipped: there are too many unknowns.
        """
        self.order, self.size = order, size
        times = np.linspace(samples.t[0], samples.t[-1], settings.collocation)
        frequency = size.rate / (size.velocity if order == 2 else size.field)
        self.grid, self.at = hidden(times, samples.t, settings.width, settings.bandwidth * frequency, draw)
        self.law: Equation = equation(
            samples, library, order, times, np, lambda a: np.ascontiguousarray(a, dtype=float)
        )
        targets = columns(samples, order)
        self.outputs = self.law.parts * samples.sites
        self.units = self.grid.value.shape[1]
        self.unknowns = self.outputs * self.units
        if self.unknowns > MAX_UNKNOWNS:
            raise Skipped(f"it has {self.unknowns} unknown output weights, more than {MAX_UNKNOWNS}; lower width")
        self.targets = [(self.at.value, targets[:, : self.outputs] / size.field, size.field)]
        if order == 2:
            self.targets.append((self.at.first, targets[:, self.outputs :] / size.velocity, size.velocity))
        self.observed = sum(int(np.sum(np.isfinite(target))) for _, target, _ in self.targets)
        self.places = self._places(samples, library)
        start = np.stack([_smooth(samples.t, u, times) for u in targets[:, : self.outputs].T], axis=1)
        # A little of the second derivative keeps weights small that the spline does not determine.
        bend = 1e-3 * self.grid.second / (settings.bandwidth * frequency) ** 2
        self.weights: Float[ndarray, "units outputs"] = np.linalg.lstsq(
            np.vstack([self.grid.value, bend]), np.vstack([start, np.zeros_like(start)]), rcond=None
        )[0]

    def _places(self, samples: Samples, library: Library) -> list[list[list[tuple[int, int, float, bool]]]]:
        """Say for each part and inner site which outputs the right-hand side sees.

        Each is (number of the slope, output, factor, whether it is the output's velocity).
        """
        index, factor = ghosts(samples.sites, *library.reach, samples.ends)
        width = self.law.inner.stop - self.law.inner.start
        found: list[list[list[tuple[int, int, float, bool]]]] = [
            [[] for _ in range(width)] for _ in range(self.law.parts)
        ]
        for number, (part, slot) in enumerate(self.law.terms.places):
            for site in range(width):
                padded = self.law.reach[0] + slot.offset + site
                output = (samples.sites if slot.part == "im" else 0) + int(index[padded])
                if factor[padded]:
                    found[part][site].append((number, output, float(factor[padded]), slot.name == "v"))
        return found

    def state(
        self, a: Float[ndarray, "units outputs"], xi: Float[ndarray, " terms"]
    ) -> tuple[Float[ndarray, "parts terms time sites"], Float[ndarray, "parts time sites"], list[ndarray]]:
        """Give the terms, the rate at the inner sites, and the slopes of sum_j xi_j T_j."""
        law = self.law
        fields = self.grid.value @ a
        if self.order == 2:
            fields = np.hstack([fields, self.grid.first @ a])
        rate = (self.grid.second if self.order == 2 else self.grid.first) @ a
        values = law.terms.function(*law.windows(fields), *xi.tolist())
        shape = (len(rate), law.inner.stop - law.inner.start)
        terms = np.stack([np.broadcast_to(value, shape) for value in values[: law.count * law.parts]])
        inner = [rate[:, p * law.sites + law.inner.start : p * law.sites + law.inner.stop] for p in range(law.parts)]
        slopes = [np.broadcast_to(value, shape) for value in values[law.count * law.parts :]]
        return terms.reshape(law.parts, law.count, *shape), np.stack(inner), slopes

    def misfits(self, a: ndarray, xi: ndarray) -> tuple[float, float]:
        """Give the sums of squares of the samples' and of the equation's residuals, both scaled by sizes, without w."""
        data = sum(float(np.nansum((basis @ a / unit - target) ** 2)) for basis, target, unit in self.targets)
        terms, rate, _ = self.state(a, xi)
        left = rate - np.einsum("j,pjts->pts", xi, terms)
        return data, float(np.sum(left**2)) / self.size.rate**2

    def normal(self, a: ndarray, xi: ndarray, weight: float) -> tuple[ndarray, ndarray]:
        """Give the Gauss-Newton matrix (unknowns + J, unknowns + J) and right-hand side, output by output, then xi."""
        units, count = self.units, len(xi)
        total = self.unknowns + count
        matrix, right = np.zeros((total, total)), np.zeros(total)
        for basis, target, unit in self.targets:
            scaled = basis / unit
            whole = scaled.T @ scaled
            for output in range(self.outputs):
                seen = np.isfinite(target[:, output])
                rows = scaled[seen]
                block = slice(output * units, (output + 1) * units)
                matrix[block, block] += whole if np.all(seen) else rows.T @ rows
                right[block] += rows.T @ (target[seen, output] - rows @ a[:, output])
        terms, rate, slopes = self.state(a, xi)
        left = rate - np.einsum("j,pjts->pts", xi, terms)
        top = self.grid.second if self.order == 2 else self.grid.first
        scale = weight / self.size.rate
        last = np.arange(self.unknowns, total)
        for part, sites in enumerate(self.places):
            for site, seen_outputs in enumerate(sites):
                blocks = {part * self.law.sites + self.law.inner.start + site: top}
                for number, output, factor, velocity in seen_outputs:
                    basis = self.grid.first if velocity else self.grid.value
                    piece = basis * (-factor * slopes[number][:, site : site + 1])
                    blocks[output] = blocks[output] + piece if output in blocks else piece
                rows = np.hstack([*blocks.values(), -terms[part, :, :, site].T]) * scale
                place: Int[ndarray, " columns"] = np.concatenate(
                    [*(np.arange(output * units, (output + 1) * units) for output in blocks), last]
                )
                matrix[np.ix_(place, place)] += rows.T @ rows
                right[place] -= rows.T @ (left[part, :, site] * scale)
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
    """A factorised step: output weights and coefficients, the trace of the hat matrix and the inverse of xi's block."""

    weights: list[ndarray]
    coefficients: ndarray
    freedom: float
    covariance: ndarray


def step(
    curves: Sequence[Curve], at: Sequence[ndarray], xi: ndarray, weight: float, damping: float, *, hat: bool
) -> Step:
    """Solve the damped normal equations, trajectory by trajectory, with xi eliminated by its Schur complement.

    Args:
        curves: the trajectories.
        at: their output weights.
        xi: the coefficients.
        weight: w.
        damping: added to the diagonal, as a share of it.
        hat: compute the trace of the hat matrix of the samples, too.

    Raises:
        numpy.linalg.LinAlgError: the damping is too small for the round-off.
    """
    from scipy.linalg import cho_factor, cho_solve, solve_triangular

    count = len(xi)
    schur, right = np.zeros((count, count)), np.zeros(count)
    solved = []
    freedom = 0.0
    for curve, a in zip(curves, at, strict=True):
        matrix, vector = curve.normal(a, xi, weight)
        n = curve.unknowns
        scale = 1 / np.sqrt(np.diag(matrix)[:n])
        inner = matrix[:n, :n] * scale * scale[:, None]
        inner[np.diag_indices(n)] += damping
        border = matrix[:n, n:] * scale[:, None]
        factor = cho_factor(inner, lower=True, overwrite_a=True, check_finite=False)
        both = cho_solve(factor, np.hstack([border, (vector[:n] * scale)[:, None]]), check_finite=False)
        schur += matrix[n:, n:] - border.T @ both[:, :-1]
        right += vector[n:] - border.T @ both[:, -1]
        rows: ndarray | None = None
        if hat:
            inverse = solve_triangular(factor[0], np.eye(n), lower=True, overwrite_b=True, check_finite=False)
            for output in range(curve.outputs):
                place = slice(output * curve.units, (output + 1) * curve.units)
                for basis, target, unit in curve.targets:
                    seen = np.isfinite(target[:, output])
                    rows = (basis[seen] / unit) * scale[place]
                    freedom += float(np.sum((inverse[place.start :, place] @ rows.T) ** 2))
        solved.append((both, scale))
    size = np.sqrt(np.diag(schur))
    size[~(size > 0)] = 1.0
    covariance = np.linalg.pinv(schur / size / size[:, None], rcond=1e-15, hermitian=True) / size / size[:, None]
    change = covariance @ right
    moved = []
    for curve, a, (both, scale) in zip(curves, at, solved, strict=True):
        shift = (both[:, -1] - both[:, :-1] @ change) * scale
        moved.append(a + shift.reshape(curve.outputs, curve.units).T)
    return Step(moved, xi + change, freedom + (count if hat else 0), covariance)


def project(curves: Sequence[Curve], at: Sequence[ndarray], count: int) -> Float[ndarray, " terms"]:
    """Solve for the coefficients alone, by least squares with the curves as they are."""
    design, target = [], []
    for curve, a in zip(curves, at, strict=True):
        terms, rate, _ = curve.state(a, np.zeros(count))
        design.append(np.moveaxis(terms, 1, -1).reshape(-1, count))
        target.append(rate.ravel())
    matrix = np.concatenate(design)
    size = np.sqrt(np.mean(matrix**2, axis=0))
    size[~(size > 0)] = 1.0
    return np.asarray(np.linalg.lstsq(matrix / size, np.concatenate(target), rcond=1e-14)[0] / size)


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

    def __post_init__(self) -> None:
        """Check the settings."""
        for name, least in (("width", 1), ("collocation", 2), ("iterations", 1)):
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
        return Abilities(missing=True)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Solve for output weights and coefficients with one weight w after the other, and keep the best by cross-validation.

        Raises:
            Skipped: a trajectory has too many unknowns for dense normal equations.
        """
        draw = np.random.default_rng(seed)
        with one_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            size = scales(data, library, order)
            curves = [Curve(samples, library, order, size, self, draw) for samples in data]
            observed = sum(curve.observed for curve in curves)
            at = [curve.weights for curve in curves]
            xi = project(curves, at, len(library.terms))
            diary = Diary(1)
            taken = 0
            best: tuple[float, float, list[ndarray], ndarray, ndarray] | None = None
            for weight in sorted(self.weights):
                at, xi, taken, last = self._descend(curves, at, xi, weight, taken, diary)
                if last is None:
                    continue
                missed = sum(curve.misfits(a, xi)[0] for curve, a in zip(curves, at, strict=True))
                # With as many degrees of freedom as values the samples say nothing about their noise.
                variance = missed / max(observed - last.freedom, 1e-6 * observed)
                score = variance * observed / max(observed - last.freedom, 1e-6 * observed)
                if best is None or score < best[0]:
                    best = (score, weight, at, xi, np.sqrt(np.maximum(np.diag(last.covariance), 0) * variance))
                elif score > 3 * best[0]:
                    break
            if best is None:
                return Fit(self.name, library, order, xi, float("nan"), status="no weight could be solved for")
            score, weight, at, xi, stderr = best
            diary.note(taken + 1, diary.loss[-1] if diary.loss else 0.0, xi, always=True)
            missed, whole = 0.0, 0.0
            for curve, a in zip(curves, at, strict=True):
                missed += curve.misfits(a, xi)[1]
                whole += float(np.sum(curve.state(a, xi)[1] ** 2)) / size.rate**2
        residual = math.sqrt(missed / whole) if whole > 0 else math.sqrt(missed)
        found = {"weight": weight, "noise": math.sqrt(score) * size.field}
        return Fit(self.name, library, order, xi, residual, stderr, history=diary.history(), found=found)

    def _descend(
        self, curves: list[Curve], at: list[ndarray], xi: ndarray, weight: float, taken: int, diary: Diary
    ) -> tuple[list[ndarray], ndarray, int, Step | None]:
        """Take Levenberg-Marquardt steps with one weight; give the point and the factorised last step."""

        def objective(point: Sequence[ndarray], coefficients: ndarray) -> float:
            pairs = [curve.misfits(a, coefficients) for curve, a in zip(curves, point, strict=True)]
            value = sum(data + weight**2 * law for data, law in pairs)
            return value if math.isfinite(value) else math.inf

        value, damping = objective(at, xi), 1e-12
        for _ in range(self.iterations):
            lower = None
            while damping < 1e3:
                try:
                    trial = step(curves, at, xi, weight, damping, hat=False)
                    lower = objective(trial.weights, trial.coefficients)
                except np.linalg.LinAlgError:
                    lower = None
                if lower is not None and lower < value:
                    break
                lower, damping = None, damping * 30
            if lower is None:
                break
            taken += 1
            at, xi, gain, value = trial.weights, trial.coefficients, value - lower, lower
            diary.note(taken, value, xi)
            damping = max(damping / 30, 1e-12)
            if gain < self.tolerance * (value + gain):
                break
        for damping in (1e-12, 1e-10, 1e-8):
            try:
                return at, xi, taken, step(curves, at, xi, weight, damping, hat=True)
            except np.linalg.LinAlgError:
                continue
        return at, xi, taken, None


METHODS = (PINNVP,)
