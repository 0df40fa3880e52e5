"""The equation integrated over windows of a record, on which models of different derivative estimates are compared.

The equation is integrated over windows [a, b] that begin at each sample, along one smoothing spline w of the samples,

    order 1:   u(b) - w(a)               = sum_j xi_j int_a^b T_j(w) dt
    order 2:   u(b) - w(a) - (b - a) z(a) = sum_j xi_j int_a^b (b - t) T_j(w, z) dt,     z = dw/dt, or a spline of v
               v(b) - z(a)               = sum_j xi_j int_a^b T_j(w, z) dt               where v was observed

which needs no derivative beyond the first and is linear in xi.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.derivatives import differentiate
from latticebench.methods.engine.inputs import inputs
from latticebench.methods.engine.regression import Regression, triangular
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import evaluate, observed

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
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
        regression: one row per window, site, part and, for order 2 with observed velocities, level (u or v), divided by
            the size of the field or the velocity.
        place: where in its trajectory each row's window begins, from 0 to 1.
        overlap: the largest number of windows that cover one instant.
    """

    regression: Regression
    place: Float[ndarray, " rows"]
    overlap: int

    def lost(
        self, coefficients: Float[ndarray, "model terms"], where: Bool[ndarray, " rows"] | None = None
    ) -> Float[ndarray, " model"]:
        """Return the sum of squares of what each model leaves of the rows, or of those in `where`."""
        rows = self.regression
        some = rows if where is None else Regression(rows.design[where], rows.target[where])
        small = triangular(some)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(np.sum((small.target - coefficients @ small.design.T) ** 2, axis=1))

    def bic(self, models: Sequence[Float[ndarray, " terms"]], price: float = PRICE) -> Float[ndarray, " model"]:
        """Return the Bayesian information criterion of models' coefficients on the samples; less is better.

        The rows that count are those of windows that do not overlap. What the integral leaves of a model that
        overflows is NaN.
        """
        coefficients = np.array(models)
        count = max(len(self.place) // self.overlap, 2)
        lost = self.lost(coefficients) / len(self.place)
        return information_criterion(lost, count, np.count_nonzero(coefficients, axis=1), price)


def information_criterion(
    lost: Float[ndarray, " model"], rows: int | ndarray, terms: ndarray, price: float
) -> Float[ndarray, " model"]:
    """Return n log(mean square) + price k log n for models of k terms that leave a mean square of n rows."""
    return np.asarray(rows * np.log(np.maximum(lost, 1e-300)) + price * terms * np.log(rows))


def integrate_equation(data: Sequence[Samples], library: Library, order: int, span: float = SPAN) -> IntegratedEquation:
    """Integrate the terms along a smoothing spline over windows that begin at each sample.

    Args:
        data: the trajectories.
        library: the terms.
        order: of the time derivative.
        span: length of a window, rounded to whole samples, in radians of the root-mean-square angular frequency of the
            samples (for order 2, of their velocity).

    Raises:
        InputError: there are too few samples.
    """
    tables, places = [], []
    overlap = 1
    for samples in data:
        table, place, steps = _integrate(samples, library, order, span)
        tables.append(table)
        places.append(place)
        overlap = max(overlap, steps)
    table, place = np.concatenate(tables), np.concatenate(places)
    whole = np.all(np.isfinite(table), axis=1)
    if not np.any(whole):
        raise InputError(f"{data[0].source}: no site has its whole stencil; there are too many missing values")
    return IntegratedEquation(Regression(table[whole, :-1], table[whole, -1]), place[whole], overlap)


def _integrate(
    samples: Samples, library: Library, order: int, span: float
) -> tuple[Float[ndarray, "rows terms_and_target"], Float[ndarray, " rows"], int]:
    """Return one trajectory's rows, the target in the last column, each row's place, and the steps per window."""
    t, sites = samples.t, observed(samples.sites, library.reach, samples.ends)
    curves = smooth_curves(samples, samples.u)
    w, z = curves[:2]
    below, rate = curves[order - 1 : order + 1]
    if order == 2 and samples.v is not None:
        z = below = smooth_curves(samples, samples.v)[0]
    frequency = _size(rate(t)) / _size(below(t) - np.nanmean(below(t), axis=0))
    steps = int(np.clip(round(span / (frequency * np.median(np.diff(t)))), 1, max(1, len(t) // 4)))
    points, weights = np.polynomial.legendre.leggauss(POINTS)
    half = np.diff(t)[:, None] / 2
    times = (t[:-1, None] + half * (points + 1)).ravel()
    f = None if samples.f is None or not library.uses("f") else inputs(samples, times)
    with np.errstate(all="ignore"):
        velocity = z(times) if order == 2 else None
        values: ndarray = evaluate(library.terms, w(times), velocity, f, times, ends=samples.ends)
    begin = np.arange(len(t) - steps)
    end = begin + steps

    def integral(weight: ndarray) -> ndarray:
        each = (values * weight.ravel()[:, None]).reshape(*values.shape[:2], len(t) - 1, POINTS, -1).sum(axis=3)
        upto = np.concatenate([np.zeros_like(each[:, :, :1]), np.cumsum(each, axis=2)], axis=2)
        return np.asarray(upto[:, :, end] - upto[:, :, begin])

    plain = integral(half * weights)
    # A complex value of which one part is missing is missing.
    u = np.where(np.isnan(samples.u), complex(np.nan, np.nan), samples.u) if samples.is_complex else samples.u
    gain, size = u[end] - w(t[begin]), _size(u - np.nanmean(u))
    if order == 1:
        levels = [(plain, gain, size)]
    else:
        late = t[end, None] * plain - integral(half * weights * times.reshape(-1, POINTS))
        levels = [(late, gain - (t[end] - t[begin])[:, None] * z(t[begin]), size)]
        if samples.v is not None:
            levels.append((plain, samples.v[end] - z(t[begin]), _size(samples.v)))
    tables = []
    for design, change, unit in levels:
        inner = change[:, sites]
        target = np.stack([inner.real, inner.imag] if samples.is_complex else [inner])
        table = np.concatenate([np.moveaxis(design, 1, -1), target[..., None]], axis=-1) / unit
        tables.append(table.reshape(-1, table.shape[-1]))
    place = np.broadcast_to((begin / len(begin))[:, None], target.shape).ravel()
    return np.concatenate(tables), np.tile(place, len(levels)), steps


def _size(field: ndarray) -> float:
    """Return the RMS of what was observed; 1 where that is 0."""
    return float(np.sqrt(np.nanmean(np.abs(field) ** 2))) or 1.0


def smooth_curves(samples: Samples, field: ndarray) -> list[Any]:
    """Return a site-wise smoothing spline and its first two derivatives, functions of time (P,) to (P, N)."""
    from scipy.interpolate import make_interp_spline

    try:
        value = differentiate(samples.t, field, "smoothing-spline").value
    except InputError as error:
        raise InputError(f"{samples.source}: {error}") from None
    seen = np.isfinite(value)
    if np.all(seen):
        curve = make_interp_spline(samples.t, value, k=5)
        return [curve, curve.derivative(1), curve.derivative(2)]
    # With gaps every site has times of its own; a site that was never observed stays NaN.
    curves = [
        make_interp_spline(samples.t[one], value[one, site], k=5) if np.any(one) else None
        for site, one in enumerate(seen.T)
    ]

    def level(number: int) -> Any:
        return lambda at: np.stack([np.full(len(at), np.nan) if c is None else c(at, number) for c in curves], axis=1)

    return [level(number) for number in range(3)]
