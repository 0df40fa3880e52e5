"""Maximum-likelihood fit of whole trajectories: multiple shooting with exact sensitivities.

The model is d^order u_n/dt^order = sum_j xi_j T_j without error; what is observed is u (and v) plus independent
Gaussian noise of unknown size. See `latticebench.methods.engine.shooting` for how the likelihood is maximised.

- Start: smoothed states with the coefficients of the weak form; where that leads nowhere, coefficients from fits to
  pieces of the trajectories (`latticebench.methods.engine.starts`).
- Unknown ends: the sites whose stencil is not whole have no equation. Their motion is a B-spline in time with unknown
  coefficients, fitted together with everything else; generalised cross-validation on their samples chooses the number
  of B-splines beforehand.
- Inputs: f between the samples is the cubic spline through them.
- Standard errors: from the inverse of the Gauss-Newton matrix with the estimated noise.
- Selection (off by default): the term of the smallest |xi|/stderr is dropped and the rest refitted, as long as the
  Bayesian information criterion (Schwarz, Ann. Statist. 6, 461 (1978)) falls.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.methods.engine.bounds import Count, Positive
from latticebench.methods.engine.record import Record, prepare, without_halves
from latticebench.methods.engine.shooting import Solution, State, maximise
from latticebench.methods.engine.starts import GRADUAL_PIECES, approach, following, from_weak_form, guess
from latticebench.methods.method import Abilities, Fit, History
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from numpy import ndarray


# What a fit imports; it is loaded before the clock of a fit starts.
LOADS = ("scipy.integrate", "scipy.interpolate", "scipy.linalg", "scipy.optimize", "scipy.sparse.linalg", "sympy")


@dataclass(frozen=True)
class Trajectory:
    """Maximum-likelihood fit of whole trajectories.

    Attributes:
        select: whether terms are dropped as long as the Bayesian information criterion falls.
        steps: largest number of Gauss-Newton steps per fit.
        tolerance: a fit has converged when no coefficient moves by more than this share of its standard error.
    """

    name: ClassVar[str] = "trajectory"
    select: bool = False
    steps: Count = 40
    tolerance: Positive = 1e-3

    @property
    def abilities(self) -> Abilities:
        """The method takes complex fields, inputs, uneven times and missing values, and returns a motion."""
        return Abilities(missing=True, motion=True, memory=200, loads=LOADS)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Fit by maximum likelihood, and select terms if `select` is set.

        Raises:
            InputError: the equation cannot be set up on the samples, or they are too few to start from.
        """
        data = [without_halves(samples) for samples in data]
        records = [prepare(samples, library.terms, order) for samples in data]
        first = solution = self._solution(data, records, library, seed)
        chosen = np.arange(len(library.terms))
        if self.select:
            chosen, records, solution = self._selected(library, records, solution)
        coefficients, stderr = np.zeros(len(library.terms)), np.zeros(len(library.terms))
        coefficients[chosen] = solution.state.coefficients
        stderr[chosen] = np.sqrt(np.diag(solution.covariance))
        found: dict[str, float | str] = {"noise_u": float(solution.sigma[0]), "steps": float(len(first.steps))}
        if len(solution.sigma) > 1:
            found["noise_v"] = float(solution.sigma[1])
        found["criterion"] = solution.criterion
        state = solution.state
        return Fit(
            self.name, library, order, coefficients, _left(records, solution), stderr=stderr,
            status="ok" if solution.converged else "the fit did not converge; its last step is given",
            history=_history(first), found=found, motion=tuple(map(_motion, data, records, state.nodes, state.splines)),
        )  # fmt: skip

    def _solution(self, data: Sequence[Samples], records: Sequence[Record], library: Library, seed: int) -> Solution:
        """Fit from one start after another until a fit converges; the best one where none does."""
        order = records[0].stretches.dynamics.order
        # Pieces may lead astray, above all where much is missing; the weak form does not, but needs many samples.
        starts: tuple[Callable[[], State | None], ...] = (
            lambda: from_weak_form(data, records, library, order, seed),
            lambda: approach(data, records, self.steps),
            lambda: approach(data, records, self.steps, GRADUAL_PIECES),
            lambda: guess(data, records),
        )
        solution = None
        for start in starts:
            state = start()
            if state is None:
                continue
            trial = self._maximise(records, following(records, state))
            if solution is None or trial.converged or not trial.criterion >= solution.criterion:
                solution = trial
            if solution.converged:
                break
        assert solution is not None
        return solution

    def _maximise(self, records: Sequence[Record], state: State) -> Solution:
        return maximise(records, state, steps=self.steps, tolerance=self.tolerance)

    def _selected(
        self, library: Library, records: list[Record], solution: Solution
    ) -> tuple[ndarray, list[Record], Solution]:
        """Drop terms one by one: the numbers of those that stay, with the records and the fit of their equation."""
        chosen = np.arange(len(library.terms))
        while len(chosen) > 1:
            error = np.sqrt(np.diag(solution.covariance))
            kept = np.delete(chosen, np.argmin(np.abs(solution.state.coefficients) / np.maximum(error, 1e-300)))
            fewer = [record.with_terms(tuple(library.terms[k] for k in kept)) for record in records]
            coefficients = solution.state.coefficients[np.isin(chosen, kept)]
            trial = self._maximise(fewer, replace(solution.state, coefficients=coefficients))
            if not trial.criterion < solution.criterion:
                break
            chosen, records, solution = kept, fewer, trial
        return chosen, records, solution


def _history(solution: Solution) -> History | None:
    """Return the steps of a fit; None where it took none."""
    if not solution.steps:
        return None
    seconds, loss, coefficients = map(np.array, zip(*solution.steps, strict=True))
    return History(np.arange(1, len(seconds) + 1), seconds, loss, coefficients)


def _motion(samples: Samples, record: Record, nodes: ndarray, splines: ndarray | None) -> Samples:
    """Return the states of a fit as samples: u and, for order 2, v at the sample times."""
    stretches = record.stretches
    whole = stretches.dynamics.whole(nodes, stretches.driven(record.times, splines))
    fields = [part[:, 0] + 1j * part[:, 1] if samples.is_complex else part[:, 0] for part in np.moveaxis(whole, 1, 0)]
    return replace(samples, u=fields[0], v=fields[1] if len(fields) > 1 else None)


def _left(records: Sequence[Record], solution: Solution) -> float:
    """Return the RMS of what the fitted trajectories leave of u, over the RMS of u."""
    total = sum(float(np.sum(record.value[:, 0] ** 2)) for record in records)
    return float(np.sqrt(solution.misfit[0] / max(total, 1e-300)))


METHODS = (Trajectory,)
