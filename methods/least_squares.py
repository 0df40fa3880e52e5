"""Dense least squares on differentiated samples: the floor that every sparse method must beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from latticebench.methods.engine.derivatives import Differentiating
from latticebench.methods.engine.regression import sums
from latticebench.methods.method import Fit
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples


@dataclass(frozen=True)
class LeastSquares(Differentiating):
    """Least squares on differentiated samples, no term dropped; settings and abilities are `Differentiating`'s."""

    name: ClassVar[str] = "least-squares"

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:  # noqa: ARG002
        """Minimise |y - A xi|^2."""
        regression = sums(data, library, order, self.differentiation, self.options)
        coefficients = regression.least_squares()
        return Fit(self.name, library, order, coefficients, regression.residual(coefficients), status=regression.status)


METHODS = (LeastSquares,)
