"""Sparse regression on the weak form of the equation, by generalised least squares with errors in the variables.

The equation is multiplied by test functions of compact support and integrated by parts, so that no noisy series is
differentiated (`latticebench.methods.engine.weak_form`). The integrands are evaluated on a spline through the samples,
with as many knots as the data can bear (`latticebench.methods.engine.spline_state`). The coefficients follow from
generalised least squares that takes the noise in the terms into account; terms are selected by the extended Bayesian
information criterion, or by any of pysindy's optimisers, on the whitened rows
(`latticebench.methods.engine.errors_in_variables`).

The coefficients of the selected terms are then estimated again. Their standard errors are those of that estimate; they
are infinite where the iteration did not settle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from annotated_types import Ge, Le

from latticebench.methods.engine.bounds import Count, Positive
from latticebench.methods.engine.errors_in_variables import ROUNDS, Estimate, Selection, by_criterion, sparse_estimate
from latticebench.methods.engine.sparse import make_optimizer, sparse_fit
from latticebench.methods.engine.weak_form import HALF_WIDTH, POWER, WeakForm
from latticebench.methods.method import Abilities, Fit
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from numpy import ndarray

# Ways of selecting terms that are not pysindy's.
OWN = ("bic", "none")


@dataclass(frozen=True)
class Weak:
    """Weak form with generalised least squares and errors in the variables.

    Attributes:
        optimizer: how terms are selected: `bic` (extended Bayesian information criterion on the whitened rows), `none`
            (every term stays), or the class name of a pysindy optimiser, which gets the whitened rows.
        arguments: arguments of the pysindy optimiser, as a table.
        half_width: half the support of a test function, in knot intervals of the state (dimensionless).
        power: p of the test functions (1 - s^2)^p.
        rounds: largest number of times that the terms are evaluated anew.
    """

    name: ClassVar[str] = "weak"
    optimizer: str = "bic"
    arguments: dict[str, Any] | None = None
    half_width: Positive = HALF_WIDTH
    power: Annotated[int, Ge(4), Le(100)] = POWER
    rounds: Count = ROUNDS

    def __post_init__(self) -> None:
        """Check the optimiser."""
        if self.optimizer not in OWN:
            make_optimizer(self.optimizer, self.arguments or {})
        elif self.arguments:
            raise InputError(f"optimizer {self.optimizer!r} takes no arguments; leave them out")

    @property
    def abilities(self) -> Abilities:
        """The method takes complex fields, inputs, uneven times and missing values."""
        return Abilities(missing=True, loads=("scipy.interpolate", "scipy.linalg", "sympy", "pysindy"))

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Estimate all coefficients, select terms, and estimate the coefficients of those again.

        Raises:
            InputError: there are too few samples, or the covariance is not positive.
        """
        forms = [WeakForm(samples, library, order, self.half_width, self.power) for samples in data]
        found, support = sparse_estimate(forms, self.rounds, seed, self._selection(seed))
        problems = []
        if not np.any(support):
            problems.append("every term was dropped")
        elif not found.settled:
            problems.append(f"not settled after {found.rounds} rounds")
        if found.chi2 > 2:
            problems.append(f"the residual is {np.sqrt(found.chi2):.2g} times what the noise explains")
        # The errors of an iteration that did not settle are not known.
        stderr = np.where(support, found.stderr if found.settled else np.inf, 0.0)
        return Fit(
            self.name, library, order, found.coefficients, _residual(forms, found.coefficients), stderr,
            status="; ".join(problems) or "ok",
            found={
                "noise": forms[0].state.noise[0], "chi2": found.chi2, "rounds": float(found.rounds),
                "half_width": forms[0].support, "tests": float(forms[0].count),
                "intervals": float(forms[0].state.intervals),
            },
        )  # fmt: skip

    def _selection(self, seed: int) -> Selection | None:
        """Return the selection of terms that the settings ask for; None to keep every term."""
        if self.optimizer == "none":
            return None
        if self.optimizer == "bic":
            return by_criterion

        def by_optimizer(found: Estimate, support: ndarray) -> ndarray:
            coefficients = sparse_fit(found.regression, self.optimizer, self.arguments or {}, seed)
            return np.asarray(support & (coefficients != 0))

        return by_optimizer


def _residual(forms: Sequence[WeakForm], coefficients: ndarray) -> float:
    """Return the RMS of what the equation leaves of the weak derivative on the observed states, relative to its RMS."""
    left, whole = 0.0, 0.0
    for form in forms:
        for rows in form.pieces(form.state.seen):
            left += float(np.sum((rows[:, -1] - rows[:, :-1] @ coefficients) ** 2))
            whole += float(np.sum(rows[:, -1] ** 2))
    return float(np.sqrt(left / (whole or 1.0)))


METHODS = (Weak,)
