"""Ridge regression on differentiated samples: a method of a user's own, in one file."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from latticebench.methods.engine.derivatives import LOADS, takes
from latticebench.methods.engine.regression import rows
from latticebench.methods.method import Abilities, Fit
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples


@dataclass(frozen=True)
class Ridge:
    """Least squares with a penalty on large coefficients.

    Attributes:
        weight: of the penalty, in units of the mean square of the terms.
    """

    name: ClassVar[str] = "ridge"
    weight: float = 1e-6

    @property
    def abilities(self) -> Abilities:
        """Those of the differentiation."""
        uneven, missing = takes("smoothing-spline")
        return Abilities(uneven=uneven, missing=missing, loads=LOADS)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Minimise |y - A xi|^2 + weight |A|^2 |xi|^2 / terms."""
        regression = rows(data, library, order, "smoothing-spline", None)
        a, y = regression.design, regression.target
        penalty = self.weight * np.sum(a**2) / a.shape[1]
        found = np.linalg.solve(a.T @ a + penalty * np.eye(a.shape[1]), a.T @ y)
        return Fit(self.name, library, order, found, regression.residual(found))


METHODS = (Ridge,)
