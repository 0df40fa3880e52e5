"""Sparse regression with pysindy's optimisers on differentiated samples.

`stlsq`: sequentially thresholded least squares (Brunton, Proctor & Kutz, PNAS 113, 3932 (2016)); `sr3`: sparse relaxed
regularised regression (Zheng et al., IEEE Access 7, 1404 (2019)), debiased on its support as STLSQ is; `pysindy`: any
other of pysindy's optimisers by its name.

All have the settings and abilities of `methods.engine.derivatives.Differentiating`, too.

Rows are scaled by the RMS of the derivative and columns by the RMS of their term, so that a threshold is a share: a
term below `threshold` times the derivative's RMS is dropped, whatever the units and the number of samples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from latticebench.methods.engine.bounds import Count, NotNegative, Positive
from latticebench.methods.engine.derivatives import Differentiating
from latticebench.methods.engine.regression import Regression, rows, sums
from latticebench.methods.engine.sparse import make_optimizer, sparse_fit
from latticebench.methods.method import Fit
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples


@dataclass(frozen=True)
class STLSQ(Differentiating):
    """pysindy's STLSQ.

    Attributes:
        threshold: share of the derivative's RMS below which a term is dropped (dimensionless).
        alpha: ridge penalty; 0, because pysindy's default of 0.05 biases the selection.
        max_iter: maximum number of rounds of thresholding.
    """

    name: ClassVar[str] = "stlsq"
    threshold: NotNegative = 0.05
    alpha: NotNegative = 0.0
    max_iter: Count = 20

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Threshold and refit until the support stays the same."""
        regression = sums(data, library, order, self.differentiation, self.options)
        arguments = {"threshold": self.threshold, "alpha": self.alpha, "max_iter": self.max_iter}
        return _fit(self.name, "STLSQ", arguments, regression, library, order, seed)


@dataclass(frozen=True)
class SR3(Differentiating):
    """pysindy's SR3, with the coefficients refitted on the support it finds.

    Attributes:
        regularizer: the penalty: L0, L1 or L2.
        reg_weight_lam: its weight (dimensionless); with L0 and a relaxation of 1 a term below sqrt(2 reg_weight_lam)
            times the derivative's RMS is dropped.
        relax_coeff_nu: the relaxation.
        max_iter: maximum number of iterations.
        tol: change of the coefficients at which to stop, see pysindy.
    """

    name: ClassVar[str] = "sr3"
    regularizer: Literal["L0", "L1", "L2"] = "L0"
    reg_weight_lam: NotNegative = 0.00125
    relax_coeff_nu: Positive = 1.0
    max_iter: Count = 1000
    tol: Positive = 1e-8

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Minimise the relaxed objective, then refit on the support."""
        regression = sums(data, library, order, self.differentiation, self.options)
        arguments = {
            "regularizer": self.regularizer, "reg_weight_lam": self.reg_weight_lam,
            "relax_coeff_nu": self.relax_coeff_nu, "max_iter": self.max_iter, "tol": self.tol, "unbias": True,
        }  # fmt: skip
        return _fit(self.name, "SR3", arguments, regression, library, order, seed)


@dataclass(frozen=True)
class PySINDy(Differentiating):
    """Any of pysindy's optimisers.

    Attributes:
        optimizer: class name of the optimiser, such as SSR, FROLS or MIOSR.
        arguments: its arguments.
    """

    name: ClassVar[str] = "pysindy"
    optimizer: str = "FROLS"
    arguments: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        """Check the optimiser where it is not the usual one."""
        super().__post_init__()
        if (self.optimizer, self.arguments) != ("FROLS", None):
            make_optimizer(self.optimizer, self.arguments or {})

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Fit the scaled rows with the optimiser."""
        regression = rows(data, library, order, self.differentiation, self.options)
        return _fit(self.name, self.optimizer, self.arguments or {}, regression, library, order, seed)


def _fit(
    name: str,
    optimizer: str,
    arguments: Mapping[str, Any],
    regression: Regression,
    library: Library,
    order: int,
    seed: int,
) -> Fit:
    coefficients = sparse_fit(regression, optimizer, arguments, seed)
    status = regression.status if np.any(coefficients) else "every term was dropped; lower the threshold"
    return Fit(name, library, order, coefficients, regression.residual(coefficients), status=status)


METHODS = (STLSQ, SR3, PySINDy)
