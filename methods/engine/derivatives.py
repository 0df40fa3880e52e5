"""Time derivatives of sampled fields, for the methods that regress on them.

`smoothing-spline`: a quintic spline with a penalty on its fourth derivative, the weight chosen by generalised
cross-validation over all sites together (Craven & Wahba, Numer. Math. 31, 377 (1979)); it interpolates where the data
have no noise. `spline`: the interpolating quintic spline. Any other name is one of pysindy's: `FiniteDifference`,
`SmoothedFiniteDifference`, or a kind of its `SINDyDerivative` (the package `derivative`).
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from latticebench.methods.engine.bsplines import BSplines
from latticebench.methods.method import Abilities
from latticebench.systems.arrays import pieces, rows_of
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.options import beside, option, setting

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Of the splines.
DEGREE = 5
# A dense eigenvalue problem of this size takes about a second.
MAX_COEFFICIENTS = 1000
Ours = Literal["smoothing-spline", "spline"]
PySINDys = Literal["FiniteDifference", "SmoothedFiniteDifference"]
# Of the derivative package; most need their options.
Kind = Literal["finite_difference", "kalman", "kernel", "savitzky_golay", "spectral", "trend_filtered"]
Differentiation = Literal[Ours, PySINDys, Kind]
KINDS: tuple[str, ...] = get_args(Kind)
# What a differentiation imports; a method that differentiates names it in its abilities.
LOADS = ("pysindy", "scipy.interpolate", "scipy.linalg", "scipy.optimize")


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A field and its first two time derivatives at the sample times, each (T, N)."""

    value: Float[ndarray, "time sites"]
    first: Float[ndarray, "time sites"]
    second: Float[ndarray, "time sites"]


def takes(kind: str) -> tuple[bool, bool]:
    """Return whether a kind of differentiation takes uneven times, and whether it takes missing values."""
    return kind in (*get_args(Ours), "FiniteDifference"), kind in get_args(Ours)


@dataclass(frozen=True)
class Differentiating:
    """The settings of a method that differentiates the samples.

    Attributes:
        differentiation: the kind, see the module.
        options: further arguments of pysindy's kinds.

    Raises:
        InputError: there are options that the kind does not take, or it lacks some.
    """

    differentiation: Differentiation = "smoothing-spline"
    options: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        """Check the options."""
        check_options(self.differentiation, self.options)

    @property
    def abilities(self) -> Abilities:
        """Those of the differentiation."""
        uneven, missing = takes(self.differentiation)
        return Abilities(uneven=uneven, missing=missing, loads=LOADS)


def check_options(kind: str, options: Mapping[str, Any] | None) -> None:
    """Refuse options that a kind of differentiation does not take, as far as it says so without samples.

    Raises:
        InputError: there is no such kind, or its options are wrong.
    """
    if kind not in get_args(Differentiation):
        raise unknown("differentiation", kind, get_args(Differentiation))
    if kind in get_args(Ours):
        if options:
            raise InputError(f"differentiation {kind!r} takes no options")
    elif options or kind in KINDS:
        from derivative.differentiation import methods

        try:
            (methods[kind] if kind in KINDS else _pysindys(kind))(**copy.deepcopy(dict(options or {})))
        except Exception as error:
            raise _refused(kind, options or {}, error) from error


def differentiate(
    t: Float[ndarray, " time"],
    field: Float[ndarray, "time sites"],
    kind: str,
    options: Mapping[str, Any] | None = None,
) -> Smoothed:
    """Differentiate each site's series twice; see `differentiator`."""
    return differentiator(t, field, kind, options)(field)


def differentiator(
    t: Float[ndarray, " time"],
    field: Float[ndarray, "time sites"],
    kind: str,
    options: Mapping[str, Any] | None = None,
) -> Callable[[Float[ndarray, "time some"]], Smoothed]:
    """Return a function that differentiates the series of some of the sites twice.

    What all sites decide together, the weight of a smoothing spline, is found beforehand.

    Args:
        t: times (T,).
        field: (T, N), real or complex, of all sites.
        kind: of differentiation, see the module.
        options: further arguments for pysindy's kinds.

    Raises:
        InputError: there is no such kind, its options are wrong, or there are too few samples.
    """
    check_options(kind, options)
    parts: list[Callable[[ndarray], ndarray]] = [np.real, np.imag] if np.iscomplexobj(field) else [np.asarray]
    each: list[Callable[[ndarray], Smoothed]]
    if kind not in get_args(Ours):
        each = [functools.partial(_pysindy, t, kind=kind, options=options or {}) for _ in parts]
    elif any(np.any(np.isnan(field[some])) for some in rows_of(field)):
        each = [functools.partial(_with_gaps, t, smooth=kind == "smoothing-spline") for _ in parts]
    else:
        columns = list(pieces(field.shape[1], len(t)))
        each = [
            _spline(t, (part(field[:, some]) for some in columns), smooth=kind == "smoothing-spline") for part in parts
        ]
    if len(parts) == 1:
        return each[0]

    def by_parts(some: ndarray) -> Smoothed:
        # A value of which one part is missing is missing.
        whole = np.where(np.isnan(some), complex(np.nan, np.nan), some)
        real, imaginary = each[0](whole.real), each[1](whole.imag)
        return Smoothed(
            real.value + 1j * imaginary.value,
            real.first + 1j * imaginary.first,
            real.second + 1j * imaginary.second,
        )

    return by_parts


def _with_gaps(t: ndarray, field: ndarray, *, smooth: bool) -> Smoothed:
    """Differentiate series with gaps: every site has times of its own; a value that was not seen stays NaN."""
    result = Smoothed(*(np.full(field.shape, np.nan) for _ in range(3)))
    for site in range(field.shape[1]):
        seen = ~np.isnan(field[:, site])
        if np.sum(seen) <= DEGREE:
            continue
        series = field[seen, site : site + 1]
        one = _spline(t[seen], [series], smooth=smooth)(series)
        for target, source in (
            (result.value, one.value),
            (result.first, one.first),
            (result.second, one.second),
        ):
            target[seen, site] = source[:, 0]
    return result


def _spline(t: ndarray, fields: Iterable[ndarray], *, smooth: bool) -> Callable[[ndarray], Smoothed]:
    """Return a function that lays splines through series, of a smoothness that the `fields` choose together."""
    from scipy.interpolate import BSpline, make_interp_spline

    if len(t) <= DEGREE:
        raise InputError(
            f"a quintic spline needs at least {DEGREE + 1} samples, there are {len(t)}; "
            f"give more, or use {setting('differentiation', 'FiniteDifference')}"
        )
    # The fit lives on [0, 1], so that the penalty's size does not depend on the unit of time.
    span = t[-1] - t[0]
    x = (t - t[0]) / span
    basis = _basis(x)
    smoothing = _smoothing(x, basis, fields) if smooth else None

    def differentiated(field: ndarray) -> Smoothed:
        if smoothing is not None:
            curve = BSpline(basis.knots, smoothing(field), DEGREE)
        else:
            curve = make_interp_spline(x, field, k=DEGREE)
        return Smoothed(curve(x), curve(x, 1) / span, curve(x, 2) / span**2)

    return differentiated


def _basis(x: ndarray) -> BSplines:
    """Return the basis of quintic splines that interpolate at (at most MAX_COEFFICIENTS of) the sample times."""
    if len(x) > MAX_COEFFICIENTS:
        x = x[np.linspace(0, len(x) - 1, MAX_COEFFICIENTS).round().astype(int)]
    inner = x[DEGREE // 2 + 1 : -(DEGREE // 2 + 1)]
    return BSplines.clamped(np.concatenate([x[:1], inner, x[-1:]]), DEGREE)


def _smoothing(x: ndarray, splines: BSplines, fields: Iterable[ndarray]) -> Callable[[ndarray], ndarray]:
    """Return the function from a field to the smoothest coefficients that follow it.

    They are the c that minimise |field - B c|^2 + weight * integral of (fourth derivative)^2. The weight is that of
    least generalised cross-validation for all `fields` together. In the basis in which both parts are diagonal the
    hat matrix has the eigenvalues 1/(1 + weight d_k), so that one eigenvalue problem serves all weights, and the
    mean square of each amplitude all fields.
    """
    import scipy.linalg
    from scipy.interpolate import BSpline
    from scipy.optimize import minimize_scalar

    basis, count = BSpline.design_matrix(x, splines.knots, DEGREE), splines.count
    gram = np.asarray((basis.T @ basis).todense())
    # Two Gauss points per knot interval integrate the square of the fourth derivative, of degree 2, exactly.
    points, weights = np.polynomial.legendre.leggauss(2)
    edges = np.unique(splines.knots)
    middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    places = (middle[:, None] + half[:, None] * points).ravel()
    bend = splines.design(places, 4)
    penalty = bend.T @ (bend * (half[:, None] * weights).ravel()[:, None])
    try:
        d, modes = scipy.linalg.eigh(penalty, gram)
    # What NumPy and SciPy raise, the former where a number is not finite.
    except ValueError:
        steps = np.diff(x)
        raise InputError(
            f"the longest of its steps in time is {np.max(steps) / np.min(steps):.0e} times the shortest, too much for "
            f"a spline; cut the recording into trajectories, or fit it by "
            f"{beside(option('method', 'stlsq'), setting('differentiation', 'FiniteDifference'))}"
        ) from None
    d = np.maximum(d, 0.0)
    power, outside = np.zeros(count), 0.0
    for field in fields:
        amplitude = modes.T @ np.asarray(basis.T @ field)
        power += np.sum(amplitude**2, axis=1)
        if count < len(x):
            outside += float(np.sum((field - basis @ (modes @ amplitude)) ** 2))

    def score(log_weight: float) -> float:
        lost = 1 - 1 / (1 + np.exp(log_weight) * d)
        return float(
            np.log(np.sum(lost**2 * power) + outside + 1e-300) - 2 * np.log((np.sum(lost) + len(x) - count) / len(x))
        )

    positive = d[d > 1e-12 * d[-1]]
    grid = np.linspace(-np.log(positive[-1]) - 10, -np.log(positive[0]) + 10, 80)
    best = int(np.argmin([score(value) for value in grid]))
    bounds = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    share = 1 / (1 + np.exp(minimize_scalar(score, bounds=bounds, method="bounded").x) * d)
    return lambda field: np.asarray(modes @ (share[:, None] * (modes.T @ np.asarray(basis.T @ field))))


def _pysindy(t: ndarray, field: ndarray, kind: str, options: Mapping[str, Any]) -> Smoothed:
    import warnings

    if len(t) < 3:
        raise InputError(f"differentiation {kind!r} needs at least 3 samples, there are {len(t)}; give more")
    make, given = _pysindys(kind), {"kind": kind, **options} if kind in KINDS else options
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # Copies, because pysindy writes into tables among its options.
            first = np.asarray(make(**copy.deepcopy(given))(field, t))
            second = np.asarray(make(**copy.deepcopy(given))(first, t))
    except Exception as error:
        raise _refused(kind, options, error) from error
    return Smoothed(field, first, second)


def _pysindys(kind: str) -> Any:
    """Return pysindy's class of a kind of differentiation."""
    import pysindy

    return getattr(pysindy, "SINDyDerivative" if kind in KINDS else kind)


def _refused(kind: str, options: Mapping[str, Any], error: Exception) -> InputError:
    return InputError(f"differentiation {kind!r} with {dict(options)}: {error}")
