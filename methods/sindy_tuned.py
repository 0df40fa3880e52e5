"""pysindy at its best: every optimiser on every differentiation, and the samples alone choose among what they find.

For each differentiation the design matrix is made once. STLSQ and SR3 run over a path of thresholds, SSR and FROLS give
their path of numbers of terms, all on columns normalised by their RMS and without ridge; each support found is refitted by least squares.
Bagged STLSQ (Fasel, Kutz, Brunton & Brunton, Proc. R. Soc. A 478, 20210904 (2022)) gives the median of its models.

The residuals of different derivative estimates are no common ground: the smoother one has the smaller residual, and SINDy's
own BIC picks it. All candidates are therefore judged on the same data, the samples themselves, by the equation integrated
over windows [a, b] of the record along one smoothing spline w of it,

    order 1:   u(b) - w(a)               = sum_j xi_j int_a^b T_j(w) dt
    order 2:   u(b) - w(a) - (b - a) z(a) = sum_j xi_j int_a^b (b - t) T_j(w, z) dt,     z = dw/dt, or a spline of v
               v(b) - z(a)               = sum_j xi_j int_a^b T_j(w, z) dt               where v was observed

which needs no derivative beyond the first and is linear in xi. The criteria: `bic`, n log(mean square) + 2 k log n for the k
terms of a candidate and n windows that do not overlap, twice its usual price, since one noise moves many windows; `cv`, the mean square in one part of the record with the support refitted on
the others; `residual`, the same BIC on each differentiation's own rows, kept for comparison.

What was measured: phi^4 (its own and a six-term library), DNLS (four and nine terms), Ginzburg-Landau (four) and sine-Gordon (the
sines) from 50 samples, the noise 0 / 0.1 / 1 / 5 %, one seed without noise and two with; geometric mean of E2 over that of the best candidate, and how
often the support was right:

    bic         1.04  1.12  1.06  1.01     6/6  12/12  12/12  6/12
    cv          1.04  1.14  1.12  1.10     6/6  11/12  11/12  9/12
    residual    1.06  1.34  1.13  1.08     5/6  12/12  12/12  9/12

From 401 samples: bic 1.4 / 1.1 / 1.1 / 1.1, cv 1.4 / 1.3 / 1.2 / 1.0, residual 1.6 / 1.7 / 1.2 / 1.1. With larger libraries on
all four systems (six seeds, three differentiations) the double price has the support right in 23 and 21 of 24 cases at 0.1 and
1 % noise, the usual one in 19 and 19. Windows of 0.2 to 1.4 radians choose alike; those of 8 or 15 of the 50 samples, three and
five times the default, err by a factor of 4 at 1 % noise. On phi^4 and DNLS alone, a forecast from each window's start chooses
as well (1.2 / 1.5 / 1.2 / 1.0, with `kernel` and bagging in the search) and takes seconds instead of milliseconds; the weak form of
`methods.weak` without the covariance of its rows is 8 / 9 / 2.4 / 1.0 off.

What is chosen is nearly always one of the two quintic splines, and STLSQ. `kernel` (4 s for 50 samples) lowers E2 by 1.6 without
noise and by 1.2 at 0.1 %; `savitzky_golay`, `kalman` and `trend_filtered` (0.6 to 1.5 s) bring nothing; bagging lowers it by
less than 1.1 from 50 samples and by 1.0 to 1.7 from 401, in five times the seconds. These are to be asked for.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from latticebench.methods.engine.derivatives import KINDS, LOADS, differentiate, takes
from latticebench.methods.engine.inputs import inputs
from latticebench.methods.engine.regression import Regression, rows
from latticebench.methods.engine.sparse import fitted_optimizer
from latticebench.methods.method import Abilities, Fit
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import evaluate, observed

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

OPTIMIZERS = ("STLSQ", "SR3", "SSR", "FROLS", "ensemble")
DIFFERENTIATIONS = ("smoothing-spline", "spline", "FiniteDifference", "SmoothedFiniteDifference", *KINDS)
# Gauss points in each interval between samples: exact for a cubic term of a cubic.
POINTS = 5
# So many rows a bagged model draws: more cost time and change nothing.
MOST_DRAWN = 1000


@dataclass(frozen=True, eq=False)
class Candidate:
    """One model of the search.

    Attributes:
        differentiation: the way, with its options.
        optimizer: who found it.
        knob: the threshold (dimensionless), or the number of terms for SSR and FROLS.
        coefficients: in the data's units (terms,).
        own: its differentiation's rows.
        fold: which part of the record each of them is in, from 0 to 1.
    """

    differentiation: str
    optimizer: str
    knob: float
    coefficients: Float[ndarray, " terms"]
    own: Regression
    fold: Float[ndarray, " rows"]

    @property
    def support(self) -> Bool[ndarray, " terms"]:
        """The terms that it has."""
        return np.asarray(self.coefficients != 0)


@dataclass(frozen=True, eq=False)
class Windows:
    """The integrated equation on all windows, in units of the field's and the velocity's size.

    Attributes:
        regression: one row a window, site, part and, for order 2 with observed velocities, level.
        fold: which part of the record each row is in, from 0 to 1.
        overlap: how many windows cover one instant.
    """

    regression: Regression
    fold: Float[ndarray, " rows"]
    overlap: int

    def lost(
        self, coefficients: Float[ndarray, "candidate terms"], where: Bool[ndarray, " rows"] | None = None
    ) -> Float[ndarray, " candidate"]:
        """Sum the squares of what each candidate leaves of the rows, or of those in `where`."""
        rows = self.regression
        some = rows if where is None else Regression(rows.design[where], rows.target[where])
        small = triangular(some)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(np.sum((small.target - coefficients @ small.design.T) ** 2, axis=1))


def options(kind: str, step: float) -> list[dict[str, Any]]:
    """List the options to try for a way of differentiating, its widths in multiples of the time step between samples."""
    if kind == "FiniteDifference":
        return [{"order": order} for order in (2, 4)]
    if kind == "SmoothedFiniteDifference":
        return [{"smoother_kws": {"window_length": width, "polyorder": 3}} for width in (5, 7, 11)]
    if kind == "finite_difference":
        return [{"k": 3}]
    if kind == "savitzky_golay":
        # A little more than a whole number of steps, so that round-off does not decide whether the last sample is in.
        return [{"order": 4, "left": width * step, "right": width * step} for width in (3.01, 5.01, 8.01)]
    if kind == "kalman":
        return [{"alpha": ratio * step**3} for ratio in (1e-2, 1.0)]
    if kind == "kernel":
        return [{"sigma": width * step, "lmbd": noise} for width in (3.0, 6.0) for noise in (1e-6, 1e-2)]
    if kind == "trend_filtered":
        return [{"order": 2, "alpha": 1e-4}]
    return [{}]


def own_rows(
    data: Sequence[Samples], library: Library, order: int, kind: str, given: Mapping[str, Any]
) -> tuple[Regression, Float[ndarray, " rows"]]:
    """Make the rows of one differentiation, and say which part of its record, from 0 to 1, each row is in.

    A trajectory that the differentiation cannot take, being too short or at rest, adds no rows.

    Raises:
        InputError: it can take none of them.
    """
    pieces, folds = [], []
    reason: InputError | None = None
    for samples in data:
        try:
            piece = rows([samples], library, order, kind, given)
        except InputError as error:
            reason = error
            continue
        # Rows are in the order of part, time, site.
        length = len(piece.target) // (1 + samples.is_complex)
        pieces.append(piece)
        folds.append(np.arange(len(piece.target)) % length / length)
    if not pieces:
        raise reason or InputError("there are no samples to fit")
    whole = Regression(
        np.concatenate([piece.design for piece in pieces]),
        np.concatenate([piece.target for piece in pieces]),
        sum(piece.left_out for piece in pieces),
    )
    return whole, np.concatenate(folds)


def path(
    regression: Regression, optimizer: str, thresholds: Sequence[float], models: int, seed: int
) -> list[tuple[float, Float[ndarray, " terms"]]]:
    """Run one optimiser over its path.

    Args:
        regression: the rows.
        optimizer: one of OPTIMIZERS.
        thresholds: shares of the derivative's RMS (dimensionless).
        models: how many models are bagged.
        seed: of the draws.

    Returns:
        pairs of a threshold, or a number of terms, and the coefficients found there.

    Raises:
        InputError: pysindy refuses the rows, such as FROLS those of dependent terms.
    """
    terms = regression.design.shape[1]
    small = triangular(regression)
    if optimizer in ("SSR", "FROLS"):
        history = fitted_optimizer(small, optimizer, {"alpha": 0.0, "max_iter": terms}, seed).history_
        # In pysindy 2.1 the model of all terms is overwritten in SSR's history and missing in that of FROLS.
        supports = [np.ones(terms, dtype=bool), *(np.ravel(shares) != 0 for shares in history[1:])]
        return [(float(np.sum(support)), small.least_squares(support)) for support in supports]
    found, listed = [], set()
    for threshold in thresholds:
        if optimizer == "SR3":
            # The relaxation that has with few rows the effect of 1 with all.
            nu = len(regression.target) / len(small.target)
            given = {"reg_weight_lam": threshold**2 / (2 * nu), "relax_coeff_nu": nu, "max_iter": 1000, "tol": 1e-8}
            shares = fitted_optimizer(small, "SR3", {"regularizer": "L0", **given}, seed).coef_
        else:
            shares = fitted_optimizer(small, "STLSQ", {"threshold": threshold, "alpha": 0.0}, seed).coef_
        support = np.ravel(shares) != 0
        # Bagging is dear: a threshold that changes nothing for STLSQ is not bagged again.
        if support.tobytes() in listed:
            continue
        listed.add(support.tobytes())
        coefficients = small.least_squares(support)
        if optimizer == "ensemble":
            import pysindy

            model = pysindy.STLSQ(threshold=threshold, alpha=0.0)
            drawn = min(len(regression.target), MOST_DRAWN)
            bags = {"opt": model, "bagging": True, "n_models": models, "n_subset": drawn}
            coefficients = (
                np.ravel(fitted_optimizer(regression, "EnsembleOptimizer", bags, seed).coef_) / regression.scales
            )
        found.append((threshold, coefficients))
    return found


def triangular(regression: Regression) -> Regression:
    """Give the same sums of squares in as many rows as columns: the triangle of the QR decomposition of [A y]."""
    if len(regression.target) <= regression.design.shape[1] + 1:
        return regression
    # On scaled columns, so that the units of a term do not matter.
    scale = np.append(regression.scales, 1.0)
    rows = np.column_stack([regression.design, regression.target]) / scale
    triangle = np.asarray(np.linalg.qr(rows, mode="r")) * scale
    return Regression(triangle[:, :-1], triangle[:, -1])


def windows(data: Sequence[Samples], library: Library, order: int, span: float) -> Windows:
    """Integrate the terms along a smoothing spline over windows that begin at each sample.

    Args:
        data: the trajectories.
        library: the terms.
        order: of the equation.
        span: length of a window in radians of the samples' root-mean-square angular frequency (of the velocity for order 2), in whole samples.

    Raises:
        InputError: there are too few samples.
    """
    pieces, folds = [], []
    overlap = 1
    for samples in data:
        piece, fold, steps = _integrate(samples, library, order, span)
        pieces.append(piece)
        folds.append(fold)
        overlap = max(overlap, steps)
    table, fold = np.concatenate(pieces), np.concatenate(folds)
    whole = np.all(np.isfinite(table), axis=1)
    if not np.any(whole):
        raise InputError(f"{data[0].source}: no site has its whole stencil; there are too many missing values")
    return Windows(Regression(table[whole, :-1], table[whole, -1]), fold[whole], overlap)


def _integrate(
    samples: Samples, library: Library, order: int, span: float
) -> tuple[Float[ndarray, "rows terms_and_target"], Float[ndarray, " rows"], int]:
    """Give one trajectory's rows with the target in the last column, each row's place from 0 to 1, and steps a window."""
    t, sites = samples.t, observed(samples.sites, library.reach, samples.ends)
    curves = _smooth(samples, samples.u)
    w, z = curves[:2]
    below, rate = curves[order - 1 : order + 1]
    if order == 2 and samples.v is not None:
        z = below = _smooth(samples, samples.v)[0]
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
    """RMS of what was seen; 1 where that is 0."""
    return float(np.sqrt(np.nanmean(np.abs(field) ** 2))) or 1.0


def _smooth(samples: Samples, field: ndarray) -> list[Any]:
    """Give the functions of time (times, sites) that a site-wise smoothing spline and its first two derivatives are."""
    from scipy.interpolate import make_interp_spline

    try:
        value = differentiate(samples.t, field, "smoothing-spline").value
    except InputError as error:
        raise InputError(f"{samples.source}: {error}") from None
    seen = np.isfinite(value)
    if np.all(seen):
        curve = make_interp_spline(samples.t, value, k=5)
        return [curve, curve.derivative(1), curve.derivative(2)]
    # With gaps every site has times of its own; a site that was never seen stays NaN.
    curves = [
        make_interp_spline(samples.t[one], value[one, site], k=5) if np.any(one) else None
        for site, one in enumerate(seen.T)
    ]

    def level(number: int) -> Any:
        return lambda at: np.stack([np.full(len(at), np.nan) if c is None else c(at, number) for c in curves], axis=1)

    return [level(number) for number in range(3)]


@dataclass(frozen=True)
class SINDyTuned:
    """pysindy's optimisers over all differentiations, tuned on the samples; see the module.

    Attributes:
        optimizers: which to run, of STLSQ, SR3, SSR, FROLS and ensemble (bagged STLSQ).
        differentiations: which to try, see `methods.derivatives`; those that cannot take the data are left out.
        criterion: bic, cv, or residual; see the module.
        thresholds: shares of the derivative's RMS (dimensionless) for STLSQ, SR3 and the ensemble.
        span: length of a window, in radians of the samples' root-mean-square angular frequency.
        price: of a term in bic and residual, in multiples of log n (dimensionless).
        models: bagged models.
        folds: parts of the record for cv.

    Raises:
        InputError: a name is unknown, or a number is out of range.
    """

    name: ClassVar[str] = "sindy-tuned"
    optimizers: tuple[str, ...] = ("STLSQ", "SR3", "SSR", "FROLS")
    differentiations: tuple[str, ...] = (
        "smoothing-spline", "spline", "FiniteDifference", "SmoothedFiniteDifference", "finite_difference", "spectral",
    )  # fmt: skip
    criterion: Literal["bic", "cv", "residual"] = "bic"
    thresholds: tuple[float, ...] = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
    span: float = 0.7
    price: float = 2.0
    models: int = 20
    folds: int = 5

    def __post_init__(self) -> None:
        """Check the settings."""
        for optimizer in self.optimizers:
            if optimizer not in OPTIMIZERS:
                raise unknown("optimizer", optimizer, OPTIMIZERS, f"method {self.name!r}")
        for kind in self.differentiations:
            if kind not in DIFFERENTIATIONS:
                raise unknown("differentiation", kind, DIFFERENTIATIONS, f"method {self.name!r}")
        numbers = (self.span, self.price, *self.thresholds)
        if not (self.optimizers and self.differentiations and self.thresholds and all(one > 0 for one in numbers)):
            raise InputError(
                f"method {self.name!r}: it takes at least one optimizer, differentiation and threshold; "
                "thresholds, span and price must be above 0"
            )
        if self.criterion not in ("bic", "cv", "residual"):
            raise unknown("criterion", self.criterion, ("bic", "cv", "residual"), f"method {self.name!r}")
        if self.models < 1 or self.folds < 2:
            raise InputError(f"method {self.name!r}: models must be at least 1, folds at least 2")

    @property
    def abilities(self) -> Abilities:
        """As far as any of the differentiations goes."""
        uneven, missing = np.any([takes(kind) for kind in self.differentiations], axis=0)
        return Abilities(uneven=bool(uneven), missing=bool(missing), loads=LOADS)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Search, judge, and give the candidate with the least criterion.

        Raises:
            InputError: no differentiation can take the data, or there are too few samples.
        """
        judge = windows(data, library, order, self.span)
        candidates = self.search(data, library, order, seed)
        scores = self._scores(candidates, judge)
        number = int(np.nanargmin(scores))
        best = candidates[number]
        status = best.own.status if np.any(best.support) else "every term was dropped; lower the thresholds"
        found: dict[str, float | str] = {
            "differentiation": best.differentiation, "optimizer": best.optimizer,
            "terms" if best.optimizer in ("SSR", "FROLS") else "threshold": best.knob,
            "criterion": float(scores[number]), "candidates": float(len(candidates)),
        }  # fmt: skip
        return Fit(
            self.name,
            library,
            order,
            best.coefficients,
            best.own.residual(best.coefficients),
            status=status,
            found=found,
        )

    def search(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> list[Candidate]:
        """Run the optimisers on each differentiation; a support that was found already is not listed again.

        Raises:
            InputError: no differentiation can take the data, or no optimiser their rows.
        """
        step = float(np.median(np.concatenate([np.diff(samples.t) for samples in data])))
        uneven, missing = any(not samples.is_even for samples in data), any(samples.has_missing for samples in data)
        candidates: list[Candidate] = []
        reason: InputError | None = None
        for kind in self.differentiations:
            copes = takes(kind)
            if (uneven and not copes[0]) or (missing and not copes[1]):
                continue
            for given in options(kind, step):
                name = f"{kind} {given}" if given else kind
                try:
                    own, fold = own_rows(data, library, order, kind, given)
                except InputError as error:
                    reason = error
                    continue
                listed: set[bytes] = set()
                for optimizer in self.optimizers:
                    found = []
                    # FROLS refuses dependent terms; the others go on.
                    with contextlib.suppress(InputError):
                        found = path(own, optimizer, self.thresholds, self.models, seed)
                    for knob, coefficients in found:
                        support = (coefficients != 0).tobytes()
                        if optimizer == "ensemble" or support not in listed:
                            listed.add(support)
                            candidates.append(Candidate(name, optimizer, knob, coefficients, own, fold))
        if not candidates:
            raise reason or InputError(f"{data[0].source}: no optimiser of method {self.name!r} can fit these rows")
        return candidates

    def _scores(self, candidates: Sequence[Candidate], judge: Windows) -> Float[ndarray, " candidate"]:
        """Compute the criterion of each candidate; less is better."""
        coefficients = np.array([one.coefficients for one in candidates])
        terms = np.count_nonzero(coefficients, axis=1)
        if self.criterion == "residual":
            lost = np.array([one.own.residual(one.coefficients) ** 2 for one in candidates])
            counts = np.array([len(one.own.target) for one in candidates])
        elif self.criterion == "bic":
            lost = judge.lost(coefficients) / len(judge.fold)
            counts = np.full(len(candidates), max(len(judge.fold) // judge.overlap, 2))
        else:
            return self._held_out(candidates, judge)
        return np.asarray(counts * np.log(np.maximum(lost, 1e-300)) + self.price * terms * np.log(counts))

    def _held_out(self, candidates: Sequence[Candidate], judge: Windows) -> Float[ndarray, " candidate"]:
        """Refit each candidate's support without one part of the record, and give the mean square in that part."""
        total = np.zeros(len(candidates))
        held = (judge.fold * self.folds).astype(int)
        for first in {id(one.own): one for one in candidates}.values():
            own, part = first.own, (first.fold * self.folds).astype(int)
            members = [number for number, one in enumerate(candidates) if one.own is own]
            for fold in range(self.folds):
                rest = part != fold
                if not np.any(rest):
                    continue
                kept = triangular(Regression(own.design[rest], own.target[rest]))
                refitted = np.array([kept.least_squares(candidates[number].support) for number in members])
                total[members] += judge.lost(refitted, held == fold)
        return total / len(held)


METHODS = (SINDyTuned,)
