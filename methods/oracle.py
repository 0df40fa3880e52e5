"""The ceiling: least squares on the true terms, with the exact derivative.

It is shown the truth, so it is no contestant. With the exact derivative it leaves round-off, whatever the noise, which
checks the samples and the derived truth. With the spline's it shows what the right support alone is worth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from latticebench.methods.engine.derivatives import LOADS
from latticebench.methods.engine.regression import Regression, assemble, rows
from latticebench.methods.method import Abilities, Fit, Skipped
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples, SimulatedSamples


@dataclass(frozen=True)
class Oracle:
    """Least squares on the true support.

    Attributes:
        derivative: `exact`, the noise-free derivative on the noise-free state; or `spline`, the smoothing spline's
            derivative of the samples, so that only the support is given away.
    """

    name: ClassVar[str] = "oracle"
    derivative: Literal["exact", "spline"] = "exact"

    @property
    def abilities(self) -> Abilities:
        """It needs the truth."""
        return Abilities(missing=True, truth=True, loads=LOADS)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:  # noqa: ARG002
        """Minimise |y - A xi|^2 over the terms of the equation.

        Raises:
            Skipped: the equation is outside the library, so that there is no true support.
        """
        known = [samples for samples in data if isinstance(samples, SimulatedSamples)]
        truth = known[0].truth(library)
        if truth is None:
            raise Skipped("the equation is outside the library, there is no true support")
        if self.derivative == "exact":
            parts = []
            for samples in known:
                assert samples.exact is not None
                assert samples.rate is not None
                parts.append(assemble(samples, library, samples.exact.u, samples.exact.v, samples.rate))
            regression = Regression(
                np.concatenate([part.design for part in parts]),
                np.concatenate([part.target for part in parts]),
            )
        else:
            regression = rows(data, library, order, "smoothing-spline")
        coefficients = regression.least_squares(truth != 0)
        return Fit(self.name, library, order, coefficients, regression.residual(coefficients))


METHODS = (Oracle,)
