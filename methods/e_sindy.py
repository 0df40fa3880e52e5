"""Sparse regression by ensembles (E-SINDy), with pysindy's `EnsembleOptimizer`.

Fasel, Kutz, Brunton & Brunton, Proc. R. Soc. A 478, 20210904 (2022). For one threshold of STLSQ:

1. Library bagging: `models` models, from each of which `dropped` terms of the library and a bootstrap's share of the
   rows were left out at random. The inclusion probability of a term is the share of models that keep it, of those that
   were offered it; terms below `inclusion` leave the library.
2. Bagging: `models` models of rows drawn with replacement, on the terms that are left. Terms whose inclusion
   probability is below `inclusion` are dropped, the others have the median of their coefficients over the models.

The threshold is the one whose coefficients explain the samples best at their number of terms, by the criterion of
`methods.engine.integrated_equation`.

Standard errors are the spread over the models of step 2, as the ensemble's users take it. Rows are drawn one by one
although the errors of a differentiated series are correlated, and what noise does to the terms moves all models alike:
the spread is too small, by how much the coverage in a table of noisy samples shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from annotated_types import Le

from latticebench.methods.engine.bounds import SOME, CountOrNone, Positive, Several
from latticebench.methods.engine.derivatives import Differentiating
from latticebench.methods.engine.integrated_equation import integrate_equation
from latticebench.methods.engine.regression import Regression, rows
from latticebench.methods.engine.sparse import THRESHOLDS, fitted_optimizer, stlsq_path
from latticebench.methods.method import Fit
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray


@dataclass(frozen=True, eq=False)
class Ensemble:
    """The models of a library or row bagging.

    Attributes:
        coefficients: of each model, in the data's units; 0 where a term is not in it (model, terms).
        offered: which terms each model could choose from (model, terms).
    """

    coefficients: Float[ndarray, "model terms"]
    offered: Bool[ndarray, "model terms"]

    @property
    def inclusion(self) -> Float[ndarray, " terms"]:
        """The share of models that keep each term, of those that were offered it (terms,)."""
        return np.asarray(np.sum(self.coefficients != 0, axis=0) / np.maximum(np.sum(self.offered, axis=0), 1))


def bag(regression: Regression, threshold: float, models: int, dropped: int, seed: int) -> Ensemble:
    """Run STLSQ on bootstraps of the rows and, where `dropped` is not 0, on random parts of the library.

    Args:
        regression: the rows.
        threshold: share of the derivative's RMS below which a term is dropped (dimensionless).
        models: their number.
        dropped: number of terms that each model is not offered.
        seed: of the draws.
    """
    import pysindy

    class Telling(pysindy.STLSQ):  # type: ignore[misc]
        """STLSQ that marks what it drops by NaN: pysindy's ensemble has 0 for what was not offered."""

        def fit(self, x: Any, y: Any, **given: Any) -> Any:
            fitted = super().fit(x, y, **given)
            fitted.coef_ = np.where(fitted.coef_ == 0, np.nan, fitted.coef_)
            return fitted

    given = {"opt": Telling(threshold=threshold, alpha=0.0), "bagging": True, "n_models": models}
    if dropped:
        given |= {"library_ensemble": True, "n_candidates_to_drop": dropped}
    shares = np.array(fitted_optimizer(regression, "EnsembleOptimizer", given, seed).coef_list)[:, 0]
    return Ensemble(np.nan_to_num(shares) / regression.scales, shares != 0)


@dataclass(frozen=True)
class ESINDy(Differentiating):
    """pysindy's STLSQ on bags of rows and of terms, tuned on the samples; see the module.

    Attributes:
        thresholds: shares of the derivative's RMS (dimensionless) to choose from.
        models: number of models of each bagging.
        dropped: number of terms that a model of the library bagging is not offered; 0 leaves that step out.
        inclusion: probability below which a term is dropped (dimensionless).
    """

    name: ClassVar[str] = "e-sindy"
    thresholds: Annotated[tuple[Positive, ...], SOME] = THRESHOLDS
    models: Several = 20
    dropped: CountOrNone = 1
    inclusion: Annotated[Positive, Le(1)] = 0.6

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Bag at every threshold that changes what STLSQ finds, and take the one of the least criterion."""
        regression = rows(data, library, order, self.differentiation, self.options)
        judge = integrate_equation(data, library, order)
        tried = [threshold for threshold, _ in stlsq_path(regression, self.thresholds, seed)]
        bagged = [self.bagged(regression, threshold, seed) for threshold in tried]
        scores = judge.bic([coefficients for coefficients, _, _ in bagged])
        number = int(np.nanargmin(scores))
        coefficients, stderr, inclusion = bagged[number]
        found: dict[str, float | str] = {"threshold": tried[number], "criterion": float(scores[number])}
        found |= {f"inclusion of {text}": float(one) for text, one in zip(library.texts, inclusion, strict=True)}
        status = regression.status if np.any(coefficients) else "every term was dropped; lower the thresholds"
        residual = regression.residual(coefficients)
        return Fit(self.name, library, order, coefficients, residual, stderr, status=status, found=found)

    def bagged(
        self, regression: Regression, threshold: float, seed: int
    ) -> tuple[Float[ndarray, " terms"], Float[ndarray, " terms"], Float[ndarray, " terms"]]:
        """Bag the library, then the rows.

        Returns:
            coefficients, their spread over the models, and the inclusion probabilities: of step 1 for a term that left
            there, else of step 2; each (terms,).
        """
        terms = regression.design.shape[1]
        kept, inclusion = np.ones(terms, dtype=bool), np.zeros(terms)
        if 0 < self.dropped < terms:
            inclusion = bag(regression, threshold, self.models, self.dropped, seed).inclusion
            kept = inclusion >= self.inclusion
        coefficients, stderr = np.zeros(terms), np.zeros(terms)
        if np.any(kept):
            part = bag(Regression(regression.design[:, kept], regression.target), threshold, self.models, 0, seed + 1)
            inclusion[kept] = part.inclusion
            stays = part.inclusion >= self.inclusion
            coefficients[kept] = np.where(stays, np.median(part.coefficients, axis=0), 0.0)
            stderr[kept] = np.where(stays, np.std(part.coefficients, axis=0, ddof=1), 0.0)
        return coefficients, stderr, inclusion


METHODS = (ESINDy,)
