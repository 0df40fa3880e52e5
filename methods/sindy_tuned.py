"""pysindy at its best: every optimiser on every differentiation, and the samples alone choose among what they find.

For each differentiation the design matrix is made once. STLSQ and SR3 run over a path of thresholds, SSR and FROLS have
a path of numbers of terms, all on columns normalised by their RMS and without ridge; each support found is refitted by
least squares. Bagged STLSQ (Fasel, Kutz, Brunton & Brunton, Proc. R. Soc. A 478, 20210904 (2022)) has the median of its
models.

The residuals of different derivative estimates cannot be compared: the smoother estimate has the smaller residual. All
models are therefore judged on the same data, the samples themselves, by the equation integrated over windows of the
record (`methods.engine.integrated_equation`). The criteria:

- `bic`: n log(mean square) + price k log n for a model of k terms and n windows that do not overlap. A price of 1 is
  the usual one; a term costs more here, since one value's noise moves many windows.
- `cv`: the mean square in one part of the record with the support refitted on the others.
- `residual`: the same BIC on each differentiation's own rows, for comparison.

The length of a window and the price of a term were chosen on six lattices outside the benchmark (Fermi-Pasta-Ulam-
Tsingou, Toda, Morse, van der Pol, Nagumo, Ablowitz-Ladik), sampled densely and sparsely with noise of 0 / 0.1 / 1 /
5 %, by `results/tuned/constants.py`: with both, the geometric mean of E2 over that of the best model searched is 1.45
and the support right in 96 % of 48 recordings; with the usual price 1.51 and 85 %, with windows of 0.35 or 4 radians
1.6 and 83 to 92 %. The optimum is flat in the price.

`kernel`, `savitzky_golay`, `kalman`, `trend_filtered` and bagging take seconds; a user has to name these.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np

from latticebench.methods.engine.bounds import SOME, Count, Positive, Several
from latticebench.methods.engine.derivatives import LOADS, Differentiation, takes
from latticebench.methods.engine.integrated_equation import (
    PRICE,
    SPAN,
    IntegratedEquation,
    information_criterion,
    integrate_equation,
)  # fmt: skip
from latticebench.methods.engine.regression import Regression, folded, joined, row_pieces, triangular
from latticebench.methods.engine.sparse import THRESHOLDS, fitted_optimizer, sparse_fit, stlsq_path
from latticebench.methods.method import Abilities, Fit
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

Optimizer = Literal["STLSQ", "SR3", "SSR", "FROLS", "ensemble"]
# The rows that a bagged model draws: more cost time and change nothing.
MOST_DRAWN = 1000
# Rows that are kept to draw from.
MOST_KEPT = 200_000


@dataclass(frozen=True, eq=False)
class DerivativeRows:
    """The rows that one differentiation makes of the samples.

    Attributes:
        differentiation: its kind, with its options.
        parts: the rows of each part of the trajectories, or as few that have the same sums of squares.
        drawn: rows from which bags are drawn: all, or some where there are many.
    """

    differentiation: str
    parts: tuple[Regression, ...]
    drawn: Regression

    @functools.cached_property
    def regression(self) -> Regression:
        """All rows, or as few that have the same sums of squares."""
        return folded(self.parts)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Some of many rows, each as likely as any other: those with the least of random numbers."""

    rows: tuple[Regression, ...] = ()
    luck: ndarray = field(default_factory=lambda: np.zeros(0))
    seen: int = 0

    def and_some_of(self, piece: Regression) -> _Drawn:
        """Return some of these rows and those of a piece."""
        luck = np.append(self.luck, np.random.default_rng(self.seen).uniform(size=len(piece.target)))
        rows, seen = (*self.rows, piece), self.seen + len(piece.target)
        if len(luck) <= MOST_KEPT:
            return _Drawn(rows, luck, seen)
        both = _joined(rows)
        kept = np.sort(np.argpartition(luck, MOST_KEPT)[:MOST_KEPT])
        return _Drawn((Regression(both.design[kept], both.target[kept]),), luck[kept], seen)

    @property
    def regression(self) -> Regression:
        return _joined(self.rows)


def _joined(rows: Sequence[Regression]) -> Regression:
    """Return the rows of several regressions as one."""
    return Regression(np.concatenate([one.design for one in rows]), np.concatenate([one.target for one in rows]))


@dataclass(frozen=True, eq=False)
class SparseModel:
    """One model of the search.

    Attributes:
        rows: on which it was found.
        optimizer: that found it, an `Optimizer`.
        knob: the threshold (dimensionless), or the number of terms for SSR and FROLS.
        coefficients: in the data's units (terms,).
    """

    rows: DerivativeRows
    optimizer: str
    knob: float
    coefficients: Float[ndarray, " terms"]

    @property
    def support(self) -> Bool[ndarray, " terms"]:
        """Which terms it has (terms,)."""
        return np.asarray(self.coefficients != 0)


def options(kind: str, step: float) -> list[dict[str, Any]]:
    """Return the options to try for a kind of differentiation; `step` is the time between samples."""
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


def derivative_rows(
    data: Sequence[Samples], library: Library, order: int, kind: str, given: Mapping[str, Any], parts: int = 1
) -> DerivativeRows:
    """Make the rows of one differentiation.

    A trajectory that the differentiation cannot take, being too short or at rest, adds no rows.

    Args:
        data: the trajectories.
        library: the terms.
        order: of the time derivative.
        kind: of differentiation.
        given: its options.
        parts: of a trajectory, whose rows are kept apart.

    Raises:
        InputError: it can take no trajectory.
    """
    sums: list[Regression | None] = [None] * parts
    drawn = _Drawn()
    reason: InputError | None = None
    for samples in data:
        own, some = list(sums), drawn
        try:
            for piece in row_pieces([samples], library, order, kind, given):
                # Rows are in the order of part, time, site.
                length = max(len(piece.target) // (1 + samples.is_complex), 1)
                place = np.arange(len(piece.target)) % length / length
                for part in range(parts):
                    there = (place * parts).astype(int) == part
                    rows = Regression(piece.design[there], piece.target[there], piece.left_out * (part == 0))
                    own[part] = joined(own[part], rows)
                some = some.and_some_of(piece)
        except InputError as error:
            reason = error
            continue
        sums, drawn = own, some
    if not any(sums):
        raise reason or InputError("there are no samples to fit")
    kept = tuple(one for one in sums if one is not None)
    return DerivativeRows(f"{kind} {given}" if given else kind, kept, drawn.regression)


def path(
    regression: Regression, optimizer: str, thresholds: Sequence[float], models: int, seed: int
) -> list[tuple[float, Float[ndarray, " terms"]]]:
    """Run one optimiser over its path.

    Args:
        regression: the rows.
        optimizer: an `Optimizer`.
        thresholds: shares of the derivative's RMS (dimensionless), of all but SSR and FROLS.
        models: number of models that are bagged.
        seed: of the draws.

    Returns:
        pairs of a threshold, or for SSR and FROLS a number of terms, and the coefficients found there (terms,).

    Raises:
        InputError: pysindy refuses the rows, such as FROLS those of dependent terms.
    """
    small = triangular(regression)
    if optimizer in ("SSR", "FROLS"):
        return [(float(np.sum(support)), small.least_squares(support)) for support in _greedy(small, optimizer, seed)]
    if optimizer == "STLSQ":
        return stlsq_path(regression, thresholds, seed)
    if optimizer == "ensemble":
        # Bagging is dear: a threshold that changes nothing for STLSQ is not bagged again.
        tried = [threshold for threshold, _ in stlsq_path(regression, thresholds, seed)]
        return [(threshold, _bagged(regression, threshold, models, seed)) for threshold in tried]
    found = []
    for threshold in thresholds:
        # The relaxation that has with few rows the effect of 1 with all.
        nu = regression.size / small.size
        given = {"reg_weight_lam": threshold**2 / (2 * nu), "relax_coeff_nu": nu, "max_iter": 1000, "tol": 1e-8}
        shares = fitted_optimizer(small, "SR3", {"regularizer": "L0", **given}, seed).coef_
        found.append((threshold, small.least_squares(np.ravel(shares) != 0)))
    return found


def _greedy(regression: Regression, optimizer: str, seed: int) -> list[Bool[ndarray, " terms"]]:
    """Return the supports that SSR or FROLS go through, with one term less or more each."""
    terms = regression.design.shape[1]
    history = fitted_optimizer(regression, optimizer, {"alpha": 0.0, "max_iter": terms}, seed).history_
    # In pysindy 2.1 the model of all terms is overwritten in SSR's history and missing in that of FROLS.
    return [np.ones(terms, dtype=bool), *(np.ravel(shares) != 0 for shares in history[1:])]


def _bagged(regression: Regression, threshold: float, models: int, seed: int) -> Float[ndarray, " terms"]:
    """Return the median coefficients of STLSQ's models of rows drawn with replacement."""
    import pysindy

    model = pysindy.STLSQ(threshold=threshold, alpha=0.0)
    drawn = min(len(regression.target), MOST_DRAWN)
    bags = {"opt": model, "bagging": True, "n_models": models, "n_subset": drawn}
    return sparse_fit(regression, "EnsembleOptimizer", bags, seed)


@dataclass(frozen=True)
class SINDyTuned:
    """pysindy's optimisers over all differentiations, tuned on the samples; see the module.

    Attributes:
        optimizers: which to run, of STLSQ, SR3, SSR, FROLS and ensemble (bagged STLSQ).
        differentiations: which to try, see `methods.engine.derivatives`; those that cannot take the data are left out.
        criterion: bic, cv, or residual; see the module.
        thresholds: shares of the derivative's RMS (dimensionless) for STLSQ, SR3 and the ensemble.
        span: length of a window, in radians of the samples' root-mean-square angular frequency.
        price: of a term in bic and residual, in multiples of log n (dimensionless).
        models: number of bagged models.
        folds: number of parts of the record for cv.
    """

    name: ClassVar[str] = "sindy-tuned"
    optimizers: Annotated[tuple[Optimizer, ...], SOME] = ("STLSQ", "SR3", "SSR", "FROLS")
    differentiations: Annotated[tuple[Differentiation, ...], SOME] = (
        "smoothing-spline", "spline", "FiniteDifference", "SmoothedFiniteDifference", "finite_difference", "spectral",
    )  # fmt: skip
    criterion: Literal["bic", "cv", "residual"] = "bic"
    thresholds: Annotated[tuple[Positive, ...], SOME] = THRESHOLDS
    span: Positive = SPAN
    price: Positive = PRICE
    models: Count = 20
    folds: Several = 5

    @property
    def abilities(self) -> Abilities:
        """Those of any of the differentiations."""
        uneven, missing = np.any([takes(kind) for kind in self.differentiations], axis=0)
        return Abilities(uneven=bool(uneven), missing=bool(missing), loads=LOADS)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Search for models and return the one with the least criterion.

        Raises:
            InputError: no differentiation can take the data, or there are too few samples.
        """
        judge = integrate_equation(data, library, order, self.span, self._parts)
        models = self.search(data, library, order, seed)
        scores = self._scores(models, judge)
        number = int(np.nanargmin(scores))
        best = models[number]
        own = best.rows.regression
        found: dict[str, float | str] = {
            "differentiation": best.rows.differentiation, "optimizer": best.optimizer,
            "terms" if best.optimizer in ("SSR", "FROLS") else "threshold": best.knob,
            "criterion": float(scores[number]), "candidates": float(len(models)),
        }  # fmt: skip
        status = own.status if np.any(best.support) else "every term was dropped; lower the thresholds"
        residual = own.residual(best.coefficients)
        return Fit(self.name, library, order, best.coefficients, residual, status=status, found=found)

    @property
    def _parts(self) -> int:
        return self.folds if self.criterion == "cv" else 1

    def search(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> list[SparseModel]:
        """Run the optimisers on each differentiation; a support is listed once for each, but for bagged models.

        Raises:
            InputError: no differentiation can take the data, or no optimiser their rows.
        """
        step = float(np.median(np.concatenate([np.diff(samples.t) for samples in data])))
        uneven, missing = any(not samples.is_even for samples in data), any(samples.has_missing for samples in data)
        models: list[SparseModel] = []
        reason: InputError | None = None
        for kind in self.differentiations:
            takes_uneven, takes_missing = takes(kind)
            if (uneven and not takes_uneven) or (missing and not takes_missing):
                continue
            for given in options(kind, step):
                try:
                    models += self._models(derivative_rows(data, library, order, kind, given, self._parts), seed)
                except InputError as error:
                    reason = error
        if not models:
            raise reason or InputError(f"{data[0].source}: no optimiser of method {self.name!r} can fit these rows")
        return models

    def _models(self, own: DerivativeRows, seed: int) -> list[SparseModel]:
        """Run the optimisers on the rows of one differentiation."""
        models: list[SparseModel] = []
        listed: set[bytes] = set()
        for optimizer in self.optimizers:
            found = []
            # FROLS refuses dependent terms; the others go on.
            with contextlib.suppress(InputError):
                rows = own.drawn if optimizer == "ensemble" else own.regression
                found = path(rows, optimizer, self.thresholds, self.models, seed)
            for knob, coefficients in found:
                support = (coefficients != 0).tobytes()
                if optimizer == "ensemble" or support not in listed:
                    listed.add(support)
                    models.append(SparseModel(own, optimizer, knob, coefficients))
        return models

    def _scores(self, models: Sequence[SparseModel], judge: IntegratedEquation) -> Float[ndarray, " model"]:
        """Return the criterion of each model; less is better."""
        if self.criterion == "cv":
            return self._held_out(models, judge)
        if self.criterion == "bic":
            return judge.bic([one.coefficients for one in models], self.price)
        terms = np.array([np.sum(one.support) for one in models])
        lost = np.array([one.rows.regression.residual(one.coefficients) ** 2 for one in models])
        return information_criterion(lost, np.array([one.rows.regression.size for one in models]), terms, self.price)

    def _held_out(self, models: Sequence[SparseModel], judge: IntegratedEquation) -> Float[ndarray, " model"]:
        """Return the mean square of each model in each part of the record, its support refitted on the other parts."""
        total = np.zeros(len(models))
        for own in {id(one.rows): one.rows for one in models}.values():
            members = [number for number, one in enumerate(models) if one.rows is own]
            for fold in range(len(own.parts) if len(own.parts) > 1 else 0):
                kept = triangular(folded(part for number, part in enumerate(own.parts) if number != fold))
                refitted = np.array([kept.least_squares(models[number].support) for number in members])
                total[members] += judge.lost(refitted, fold)
        return total / judge.regression.size


METHODS = (SINDyTuned,)
