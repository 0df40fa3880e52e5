"""Dense least squares on differentiated samples: the floor that every sparse method must beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from latticebench.methods.engine.derivatives import LOADS, takes
from latticebench.methods.engine.regression import rows
from latticebench.methods.method import Abilities, Fit
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples


@dataclass(frozen=True)
class LeastSquares:
    """Least squares on differentiated samples, no term dropped.

    Attributes:
        differentiation: see `methods.engine.derivatives`.
        options: further arguments of the differentiation.
    """

    name: ClassVar[str] = "least-squares"
    differentiation: str = "smoothing-spline"
    options: dict[str, Any] | None = None

    @property
    def abilities(self) -> Abilities:
        """Those of the differentiation."""
        uneven, missing = takes(self.differentiation)
        return Abilities(uneven=uneven, missing=missing, loads=LOADS)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:  # noqa: ARG002
        """Minimise |y - A xi|^2."""
        regression = rows(data, library, order, self.differentiation, self.options)
        coefficients = regression.least_squares()
        return Fit(self.name, library, order, coefficients, regression.residual(coefficients), status=regression.status)


METHODS = (LeastSquares,)
