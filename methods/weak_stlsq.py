"""STLSQ on pysindy's own weak form (`WeakPDELibrary`).

Reinbold, Gurevich & Grigoriev, Phys. Rev. E 101, 010203 (2020); Messenger & Bortz, J. Comput. Phys. 443, 110525
(2021). pysindy multiplies the equation by test functions (1 - s^2)^p on `domains` windows in time that are placed at
random, moves the derivatives onto them, and integrates what is linear between the grid's points exactly.

pysindy's library knows nothing of neighbours on a lattice. The terms are therefore evaluated here, and given to it as
the columns of its data, one for each term and site, beside the field itself: pysindy makes the integrals of all of
them, whose rows are then those of one regression. For order 2 with observed velocities the field is v and the
derivative the first, as pysindy's users write such an equation; else it is the second derivative of u, which pysindy
has through its implicit terms.

The grid is that of the samples, or `finer` times as fine on a smoothing spline; half-width of the windows, grid and
threshold are those whose coefficients explain the samples best, by the criterion of
`methods.engine.integrated_equation`.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Le, Lt

from latticebench.methods.engine.bounds import SOME, Count, Positive
from latticebench.methods.engine.inputs import inputs
from latticebench.methods.engine.integrated_equation import Curves, integrate_equation, smooth_curves
from latticebench.methods.engine.regression import Regression, folded
from latticebench.methods.engine.sparse import THRESHOLDS, seeded, stlsq_path
from latticebench.methods.method import Abilities, Fit
from latticebench.systems.arrays import PIECE
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import Stencil, Window, evaluate

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# A window must hold some points of the grid; in half a window there are at least so many steps.
FEWEST = 3.0


def integrals(
    t: Float[ndarray, " time"],
    columns: Float[ndarray, "time columns"],
    derivative: int,
    half_width: float,
    domains: int,
    power: int,
) -> tuple[Float[ndarray, "domains columns"], Float[ndarray, "domains columns"]]:
    """Return pysindy's weak form of series and of their time derivative: int phi x dt and (-1)^d int phi^(d) x dt.

    The domains are drawn from NumPy's global generator.

    Args:
        t: times.
        columns: the series x.
        derivative: d, 1 or 2.
        half_width: half the length of the windows, in units of time.
        domains: their number.
        power: p of the test functions.
    """
    import pysindy

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        library = pysindy.WeakPDELibrary(
            function_library=pysindy.IdentityLibrary(), spatiotemporal_grid=t, K=domains, H_xt=[half_width], p=power,
            derivative_order=derivative, implicit_terms=True, include_interaction=False,
        )  # fmt: skip
        values = np.asarray(library.fit(columns).transform(columns))
    count = columns.shape[1]
    return values[:, :count], values[:, derivative * count :]


@dataclass(frozen=True)
class WeakSTLSQ:
    """pysindy's weak form with its STLSQ, tuned on the samples; see the module.

    Attributes:
        thresholds: shares of the derivative's RMS (dimensionless) to choose from.
        widths: half the length of a window, as shares of the record, to choose from; pysindy's own is a twentieth.
        finer: points of the grid in each interval between samples, to choose from; 1 for the samples themselves.
        domains: number of windows.
        power: p of the test functions.
    """

    name: ClassVar[str] = "weak-stlsq"
    thresholds: Annotated[tuple[Positive, ...], SOME] = THRESHOLDS
    widths: Annotated[tuple[Annotated[Positive, Lt(0.5)], ...], SOME] = (0.05, 0.1, 0.2)
    finer: Annotated[tuple[Count, ...], SOME] = (1, 4)
    domains: Count = 100
    power: Annotated[int, Ge(2), Le(100)] = 4

    @property
    def abilities(self) -> Abilities:
        """The method takes complex fields, inputs and uneven times."""
        return Abilities(loads=("pysindy", "scipy.interpolate", "scipy.linalg", "scipy.optimize"))

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Run STLSQ on the rows of every grid and width, and take the model of the least criterion."""
        judge = integrate_equation(data, library, order)
        tried = []
        for finer, width in itertools.product(self.finer, self.widths):
            regression = self.weak_rows(data, library, order, finer, width, seed)
            path = stlsq_path(regression, self.thresholds, seed)
            tried += [(finer, width, threshold, coefficients, regression) for threshold, coefficients in path]
        scores = judge.bic([coefficients for *_, coefficients, _ in tried])
        number = int(np.nanargmin(scores))
        finer, width, threshold, coefficients, regression = tried[number]
        status = regression.status if np.any(coefficients) else "every term was dropped; lower the thresholds"
        found: dict[str, float | str] = {
            "threshold": threshold, "width": width, "finer": float(finer), "criterion": float(scores[number]),
            "candidates": float(len(tried)),
        }  # fmt: skip
        residual = regression.residual(coefficients)
        return Fit(self.name, library, order, coefficients, residual, status=status, found=found)

    def weak_rows(
        self, data: Sequence[Samples], library: Library, order: int, finer: int, width: float, seed: int
    ) -> Regression:
        """Return one row for each window, site and part of all trajectories.

        Args:
            data: the trajectories.
            library: the terms.
            order: of the time derivative.
            finer: points of the grid in each interval between samples.
            width: half the length of a window, as a share of the record.
            seed: of the places of the windows.

        Raises:
            InputError: there are too few samples, or a term is not finite.
        """
        return folded(piece for samples in data for piece in self._pieces(samples, library, order, finer, width, seed))

    def _pieces(
        self, samples: Samples, library: Library, order: int, finer: int, width: float, seed: int
    ) -> Iterator[Regression]:
        """Yield the rows of one trajectory, of some sites after others; the windows are the same at all sites."""
        course = _Course.of(samples, order, finer)
        t = course.t
        half = max(width * (t[-1] - t[0]), FEWEST * float(np.max(np.diff(t))))
        if half >= (t[-1] - t[0]) / 2:
            raise InputError(f"{samples.source}: too few samples for a window, there are {len(samples.t)}")
        most = max(1, PIECE // (len(t) * len(library.terms) * (1 + samples.is_complex)))
        for sites in Stencil.chain(samples.sites, library.reach, samples.ends).windows(most):
            values, field = course.series(library, sites)
            parts, terms, _, count = values.shape
            columns = np.concatenate([values.transpose(2, 0, 3, 1).reshape(len(t), -1), field], axis=1)
            if not np.all(np.isfinite(columns)):
                raise InputError(f"{samples.source}: a term of the library is not finite on the samples")
            with seeded(seed):
                integral, slope = integrals(t, columns, course.derivative, half, self.domains, self.power)
            own = parts * count
            yield Regression(integral[:, :-own].reshape(-1, terms), slope[:, -own:].ravel())


@dataclass(frozen=True, eq=False)
class _Course:
    """The field of one trajectory on the samples, or on a finer grid along a smoothing spline.

    Attributes:
        samples: the trajectory.
        order: of the time derivative.
        finer: points of the grid in each interval between samples.
        t: the grid.
        u, v: curves of some sites; v is None where the field is u.
    """

    samples: Samples
    order: int
    finer: int
    t: Float[ndarray, " grid"]
    u: Curves
    v: Curves | None

    @classmethod
    def of(cls, samples: Samples, order: int, finer: int) -> _Course:
        steps = np.linspace(0, len(samples.t) - 1, (len(samples.t) - 1) * finer + 1)
        t = np.interp(steps, np.arange(len(samples.t)), samples.t)
        velocity = smooth_curves(samples, samples.v) if order == 2 and samples.v is not None else None
        return cls(samples, order, finer, t, smooth_curves(samples, samples.u), velocity)

    @property
    def derivative(self) -> int:
        """The order of the field's derivative in the equation."""
        return self.order if self.v is None else 1

    def series(self, library: Library, sites: Window) -> tuple[ndarray, ndarray]:
        """Return the terms (parts, terms, grid, sites) and the field (grid, parts * sites) at some sites."""
        samples, t, some = self.samples, self.t, sites.columns
        curves = self.u(some)
        u = samples.u[:, some] if self.finer == 1 else curves[0](t)
        v = curves[1](t) if self.order == 2 else None
        field = u
        if self.v is not None and samples.v is not None:
            field = v = samples.v[:, some] if self.finer == 1 else self.v(some)[0](t)
        f = None if samples.f is None or not library.uses("f") else inputs(samples, t, some)
        values = evaluate(library.terms, u, v, f, t, ends=samples.ends, reach=library.reach, window=sites)
        inner = np.asarray(field)[:, sites.own]
        return values, np.concatenate([inner.real, inner.imag], axis=1) if samples.is_complex else inner


METHODS = (WeakSTLSQ,)
