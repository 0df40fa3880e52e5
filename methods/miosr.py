"""Sparse regression to proven optimality, by mixed-integer programming: pysindy's MIOSR.

Bertsimas & Gurnee, Nonlinear Dyn. 111, 6585 (2023): for each number of terms k the support of k terms that leaves the
least sum of squares of the derivative's rows, found by branch and bound. The number of terms is the one whose
coefficients explain the samples best, by the criterion of `methods.engine.integrated_equation`.

The solver is Gurobi. Without it the method is skipped; `pip install gurobipy` installs it with a licence for problems
of at most 2000 variables, that is libraries of 1000 terms. It runs on one thread, as all methods do.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.methods.engine.bounds import Positive
from latticebench.methods.engine.derivatives import Differentiating
from latticebench.methods.engine.integrated_equation import integrate_equation
from latticebench.methods.engine.regression import Regression, sums, triangular
from latticebench.methods.engine.sparse import fitted_optimizer
from latticebench.methods.method import Abilities, Fit
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


def best_subsets(regression: Regression, patience: float, seed: int) -> list[Float[ndarray, " terms"]]:
    """Return least squares on the best support of 1, 2, ... and all terms, each (terms,).

    Args:
        regression: the rows.
        patience: seconds after which the best support so far is taken.
        seed: of the draws.
    """
    import gurobipy

    # The solver prints its licence when it is first used, which is no part of the output.
    with contextlib.redirect_stdout(io.StringIO()):
        gurobipy.setParam("OutputFlag", 0)
        gurobipy.setParam("Threads", 1)
        gurobipy.setParam("MIPGap", 1e-9)
    small, found = triangular(regression), []
    for terms in range(1, regression.design.shape[1] + 1):
        given = {"target_sparsity": terms, "alpha": 0.0, "regression_timeout": patience}
        shares = np.ravel(fitted_optimizer(small, "MIOSR", given, seed).coef_)
        found.append(small.least_squares(shares != 0))
    return found


@dataclass(frozen=True)
class MIOSR(Differentiating):
    """pysindy's mixed-integer regression (MIOSR), tuned on the samples; see the module.

    Attributes:
        patience: seconds after which the solver's best support of one number of terms is taken, proven or not.
    """

    name: ClassVar[str] = "miosr"
    patience: Positive = 10.0

    @property
    def abilities(self) -> Abilities:
        """Those of the differentiation; a solver must be installed."""
        return replace(super().abilities, needs=("gurobipy",))

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Find the best support of every number of terms, and take the one of the least criterion."""
        regression = sums(data, library, order, self.differentiation, self.options)
        models = best_subsets(regression, self.patience, seed)
        scores = integrate_equation(data, library, order).bic(models)
        number = int(np.nanargmin(scores))
        found: dict[str, float | str] = {
            "terms": float(np.count_nonzero(models[number])), "criterion": float(scores[number]),
        }  # fmt: skip
        residual = regression.residual(models[number])
        return Fit(self.name, library, order, models[number], residual, status=regression.status, found=found)


METHODS = (MIOSR,)
