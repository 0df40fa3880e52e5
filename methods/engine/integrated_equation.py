"""The equation integrated over windows of a record, on which models of different derivative estimates are compared.

The equation is integrated over windows [a, b] that begin at each sample, along one smoothing spline w of the samples,

    order 1:   u(b) - w(a)               = sum_j xi_j int_a^b T_j(w) dt
    order 2:   u(b) - w(a) - (b - a) z(a) = sum_j xi_j int_a^b (b - t) T_j(w, z) dt,     z = dw/dt, or a spline of v
               v(b) - z(a)               = sum_j xi_j int_a^b T_j(w, z) dt               where v was observed

which needs no derivative beyond the first and is linear in xi.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.derivatives import differentiator
from latticebench.methods.engine.inputs import inputs
from latticebench.methods.engine.regression import Regression, folded, joined, triangular
from latticebench.systems.arrays import PIECE, pieces
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import Stencil, Window, evaluate

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Length of a window in radians of the root-mean-square angular frequency, and the price of a term in multiples of the
# usual one: chosen by results/tuned/constants.py, on lattices outside the benchmark.
SPAN = 1.0
PRICE = 4.0
# Gauss points in each interval between samples: exact for a cubic term of a cubic.
POINTS = 5


@dataclass(frozen=True, eq=False)
class IntegratedEquation:
    """The equation's integrals over all windows of all trajectories.

    Attributes:
        parts: one row per window, site, real or imaginary part and, for order 2 with observed velocities, level (u or
            v), divided by the size of the field or the velocity: those of the windows that begin in each part of a
            trajectory, or as few that have the same sums of squares.
        overlap: the largest number of windows that cover one instant.
    """

    parts: tuple[Regression, ...]
    overlap: int

    @functools.cached_property
    def regression(self) -> Regression:
        """The rows of all windows, or as few that have the same sums of squares."""
        return folded(self.parts)

    def lost(self, coefficients: Float[ndarray, "model terms"], part: int | None = None) -> Float[ndarray, " model"]:
        """Return the sum of squares of what each model leaves of the rows, or of those in one part."""
        small = triangular(self.regression if part is None else self.parts[part])
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(np.sum((small.target - coefficients @ small.design.T) ** 2, axis=1))

    def bic(self, models: Sequence[Float[ndarray, " terms"]], price: float = PRICE) -> Float[ndarray, " model"]:
        """Return the Bayesian information criterion of models' coefficients on the samples; less is better.

        The rows that count are those of windows that do not overlap. What the integral leaves of a model that
        overflows is NaN.
        """
        coefficients, size = np.array(models), self.regression.size
        count = max(size // self.overlap, 2)
        return information_criterion(
            self.lost(coefficients) / size, count, np.count_nonzero(coefficients, axis=1), price
        )


def information_criterion(
    lost: Float[ndarray, " model"], rows: int | ndarray, terms: ndarray, price: float
) -> Float[ndarray, " model"]:
    """Return n log(mean square) + price k log n for models of k terms that leave a mean square of n rows."""
    return np.asarray(rows * np.log(np.maximum(lost, 1e-300)) + price * terms * np.log(rows))


def integrate_equation(
    data: Sequence[Samples], library: Library, order: int, span: float = SPAN, parts: int = 1
) -> IntegratedEquation:
    """Integrate the terms along a smoothing spline over windows that begin at each sample.

    Args:
        data: the trajectories.
        library: the terms.
        order: of the time derivative.
        span: length of a window, rounded to whole samples, in radians of the root-mean-square angular frequency of the
            samples (for order 2, of their velocity).
        parts: of a trajectory, whose windows are kept apart.

    Raises:
        InputError: there are too few samples.
    """
    sums: list[Regression | None] = [None] * parts
    overlap = 1
    for samples in data:
        course = _Course.of(samples, order, span)
        overlap = max(overlap, course.steps)
        stencil = Stencil.chain(samples.sites, library.reach, samples.ends)
        most = max(1, PIECE // (len(samples.t) * POINTS * len(library.terms) * (1 + samples.is_complex)))
        for sites in stencil.windows(most):
            table, place = course.rows(library, sites)
            whole = np.all(np.isfinite(table), axis=1)
            for part in range(parts):
                some = whole & ((place * parts).astype(int) == part)
                if np.any(some):
                    sums[part] = joined(sums[part], Regression(table[some, :-1], table[some, -1]))
    if not any(sums):
        raise InputError(f"{data[0].source}: no site has its whole stencil; there are too many missing values")
    nothing = Regression(np.zeros((0, len(library.terms))), np.zeros(0))
    return IntegratedEquation(tuple(one or nothing for one in sums), overlap)


@dataclass(frozen=True, eq=False)
class _Course:
    """The smoothed motion of one trajectory, and the windows over which its equation is integrated.

    Attributes:
        samples: the trajectory.
        order: of the time derivative.
        u, v: curves of some sites, see `smooth_curves`; v is None where it was not observed or is not used.
        steps: samples in a window.
        sizes: RMS of u about its mean and of v.
    """

    samples: Samples
    order: int
    u: Curves
    v: Curves | None
    steps: int
    sizes: tuple[float, float]

    @classmethod
    def of(cls, samples: Samples, order: int, span: float) -> _Course:
        t, u = samples.t, samples.u
        curves = smooth_curves(samples, u)
        velocity = smooth_curves(samples, samples.v) if order == 2 and samples.v is not None else None
        rates, levels = _Square(), _Square()
        columns = [*pieces(samples.sites, len(t))]
        for some in columns:
            below, rate = curves(some)[order - 1 : order + 1]
            if velocity is not None:
                below = velocity(some)[0]
            value = below(t)
            rates.add(rate(t))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                levels.add(value - np.nanmean(value, axis=0))
        steps = int(np.clip(round(span / (rates.size / levels.size * np.median(np.diff(t)))), 1, max(1, len(t) // 4)))
        middle = sum(np.nansum(u[:, some]) for some in columns) / sum(
            int(np.sum(~np.isnan(u[:, some]))) for some in columns
        )
        fields, speeds = _Square(), _Square()
        for some in columns:
            fields.add(u[:, some] - middle)
            if velocity is not None and samples.v is not None:
                speeds.add(samples.v[:, some])
        return cls(samples, order, curves, velocity, steps, (fields.size, speeds.size))

    def rows(
        self, library: Library, sites: Window
    ) -> tuple[Float[ndarray, "rows terms_and_target"], Float[ndarray, " rows"]]:
        """Return the rows of some sites, the target in the last column, and each row's place."""
        samples, t, steps = self.samples, self.samples.t, self.steps
        points, weights = np.polynomial.legendre.leggauss(POINTS)
        half = np.diff(t)[:, None] / 2
        times = (t[:-1, None] + half * (points + 1)).ravel()
        w, z, _ = self.u(sites.columns)
        if self.v is not None:
            z = self.v(sites.columns)[0]
        f = None if samples.f is None or not library.uses("f") else inputs(samples, times, sites.columns)
        with np.errstate(all="ignore"):
            velocity = z(times) if self.order == 2 else None
            values: ndarray = evaluate(
                library.terms, w(times), velocity, f, times, ends=samples.ends, reach=library.reach, window=sites
            )
        begin = np.arange(len(t) - steps)
        end = begin + steps

        def integral(weight: ndarray) -> ndarray:
            each = (values * weight.ravel()[:, None]).reshape(*values.shape[:2], len(t) - 1, POINTS, -1).sum(axis=3)
            upto = np.concatenate([np.zeros_like(each[:, :, :1]), np.cumsum(each, axis=2)], axis=2)
            return np.asarray(upto[:, :, end] - upto[:, :, begin])

        plain = integral(half * weights)
        # A complex value of which one part is missing is missing.
        u = np.asarray(samples.u[:, sites.sites])
        u = np.where(np.isnan(u), complex(np.nan, np.nan), u) if samples.is_complex else u
        gain = u[end] - w(t[begin])[:, sites.own]
        if self.order == 1:
            levels = [(plain, gain, self.sizes[0])]
        else:
            late = t[end, None] * plain - integral(half * weights * times.reshape(-1, POINTS))
            rate = z(t[begin])[:, sites.own]
            levels = [(late, gain - (t[end] - t[begin])[:, None] * rate, self.sizes[0])]
            if self.v is not None and samples.v is not None:
                levels.append((plain, samples.v[end, sites.sites] - rate, self.sizes[1]))
        tables = []
        for design, change, unit in levels:
            target = np.stack([change.real, change.imag] if samples.is_complex else [change])
            table = np.concatenate([np.moveaxis(design, 1, -1), target[..., None]], axis=-1) / unit
            tables.append(table.reshape(-1, table.shape[-1]))
        place = np.broadcast_to((begin / len(begin))[:, None], target.shape).ravel()
        return np.concatenate(tables), np.tile(place, len(levels))


class _Square:
    """The RMS of what was observed, gathered piece by piece."""

    def __init__(self) -> None:
        self._squares, self._count = 0.0, 0

    def add(self, field: ndarray) -> None:
        seen = ~np.isnan(field)
        self._squares += float(np.sum(np.abs(field[seen]) ** 2))
        self._count += int(np.sum(seen))

    @property
    def size(self) -> float:
        """The RMS; 1 where that is 0."""
        return float(np.sqrt(self._squares / max(self._count, 1))) or 1.0


Curves = Callable[["slice | ndarray"], list[Any]]


def smooth_curves(samples: Samples, field: ndarray) -> Curves:
    """Return a function of some sites that gives their smoothing splines and two derivatives.

    Each of these is a function of times (P,) with values (P, sites).
    """
    from scipy.interpolate import make_interp_spline

    t = samples.t
    try:
        smooth = differentiator(t, field, "smoothing-spline")
    except InputError as error:
        raise InputError(f"{samples.source}: {error}") from None

    def curves(some: slice | ndarray) -> list[Any]:
        value = smooth(np.asarray(field[:, some])).value
        seen = np.isfinite(value)
        if np.all(seen):
            curve = make_interp_spline(t, value, k=5)
            return [curve, curve.derivative(1), curve.derivative(2)]
        # With gaps every site has times of its own; a site that was never observed stays NaN.
        each = [
            make_interp_spline(t[one], value[one, site], k=5) if np.any(one) else None
            for site, one in enumerate(seen.T)
        ]

        def level(number: int) -> Any:
            return lambda at: np.stack([np.full(len(at), np.nan) if c is None else c(at, number) for c in each], axis=1)

        return [level(number) for number in range(3)]

    return curves
