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
- Long chains: more than WIDE sites are fitted by windows (`latticebench.methods.engine.windows`) whose outer sites move
  as they were read, some windows at a time, so that memory does not grow with the chain. Coefficients are the means of
  the windows' by the inverse of their covariances. The sites next to the ends of the chain have no equation; `windows`
  in `Fit.found` says how many there were. Terms with n are fitted to the whole chain.
- Selection (off by default): the term of the smallest |xi|/stderr is dropped and the rest refitted, as long as the
  Bayesian information criterion (Schwarz, Ann. Statist. 6, 461 (1978)) falls.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from latticebench.methods.engine.bounds import Count, Positive
from latticebench.methods.engine.record import Record, prepare, without_halves
from latticebench.methods.engine.scaled import inverse_of_squares
from latticebench.methods.engine.shooting import Solution, State, maximise
from latticebench.methods.engine.starts import GRADUAL_PIECES, approach, following, from_weak_form, guess
from latticebench.methods.engine.windows import WINDOW, Part, cut, is_wide
from latticebench.methods.method import Abilities, Fit, History
from latticebench.systems.arrays import empty
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


# Chains of more sites are fitted by windows, of which so many sites are fitted at once.
WIDE = 256
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
        return Abilities(missing=True, motion=True, memory=2500, window=WIDE, loads=LOADS)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Fit by maximum likelihood, and select terms if `select` is set.

        Raises:
            InputError: the equation cannot be set up on the samples, or they are too few to start from.
        """
        if is_wide(data, library, WIDE):
            return self._by_windows(data, library, order, seed)
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
        return Fit(
            self.name, library, order, coefficients, _left(records, solution), stderr=stderr,
            status="ok" if solution.converged else "the fit did not converge; its last step is given",
            history=_history(first), found=found, motion=_motions(data, records, solution),
        )  # fmt: skip

    def _by_windows(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Fit windows of long chains, some at a time, and put together what they say."""
        sums = _Sums.of(len(library.terms))
        motions = []
        for samples in data:
            motion = [empty(samples.u.shape, samples.u.dtype) for _ in range(order)]
            for group in _groups(samples, library):
                parts = [replace(part, samples=without_halves(part.samples)) for part in group]
                shown = [part.samples for part in parts]
                records = [prepare(one, library.terms, order) for one in shown]
                solution = self._solution(shown, records, library, seed, sums.coefficients)
                for part, fitted in zip(parts, _motions(shown, records, solution), strict=True):
                    for field, one in zip(motion, (fitted.u, fitted.v), strict=False):
                        assert one is not None
                        field[:, part.sites] = one[:, part.own]
                sums.add(records, solution)
            motions.append(replace(samples, u=motion[0], v=motion[1] if order == 2 else None))
        coefficients, stderr = sums.coefficients, sums.stderr
        if self.select and coefficients is not None:
            coefficients, stderr = sums.selected()
        if coefficients is None:
            raise InputError(f"{data[0].source}: no window of the chain could be fitted; fit some of its sites alone")
        status = f"{sums.lost} of {sums.windows} windows did not converge and were left out" if sums.lost else "ok"
        return Fit(
            self.name, library, order, coefficients, sums.residual, stderr=stderr, status=status,
            history=sums.history, found=sums.found, motion=tuple(motions),
        )  # fmt: skip

    def _solution(
        self,
        data: Sequence[Samples],
        records: Sequence[Record],
        library: Library,
        seed: int,
        near: Float[ndarray, " terms"] | None = None,
    ) -> Solution:
        """Fit from one start after another until a fit converges; the best one where none does.

        Coefficients of other windows of the same chain are `near`.
        """
        order = records[0].stretches.dynamics.order
        # Pieces may lead astray, above all where much is missing; the weak form does not, but needs many samples.
        starts: tuple[Callable[[], State | None], ...] = (
            lambda: None if near is None else replace(guess(data, records), coefficients=near),
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


def _motions(data: Sequence[Samples], records: Sequence[Record], solution: Solution) -> tuple[Samples, ...]:
    state = solution.state
    return tuple(map(_motion, data, records, state.nodes, state.splines))


def _groups(samples: Samples, library: Library) -> Iterator[list[Part]]:
    """Yield windows of a chain that are fitted together: about WIDE sites."""
    yield from (list(some) for some in _batched(cut(samples, library.reach), max(1, WIDE // WINDOW)))


def _batched(parts: Iterable[Part], size: int) -> Iterator[tuple[Part, ...]]:
    """Yield tuples of `size` parts, the last of fewer."""
    left = iter(parts)
    while some := tuple(itertools.islice(left, size)):
        yield some


@dataclass
class _Sums:
    """What the windows of a chain say together.

    Attributes:
        information: the sum of the inverse covariances of the windows' coefficients.
        aim: the same times the coefficients.
        misfit, counts: sums of squares of what is left of u and v, and how many numbers they are of.
        height: sum of squares of u.
        windows, lost: how many there were, and how many of them did not converge.
        steps: Gauss-Newton steps.
        history: of the first fit.
    """

    information: Float[ndarray, "terms terms"]
    aim: Float[ndarray, " terms"]
    misfit: Any = 0.0
    counts: Any = 0.0
    height: float = 0.0
    windows: int = 0
    lost: int = 0
    steps: int = 0
    history: History | None = None

    @classmethod
    def of(cls, terms: int) -> _Sums:
        return cls(np.zeros((terms, terms)), np.zeros(terms))

    def add(self, records: Sequence[Record], solution: Solution) -> None:
        """Add a fit of some windows."""
        self.windows += len(records)
        self.steps += len(solution.steps)
        if self.history is None:
            self.history = _history(solution)
        if not solution.converged:
            self.lost += len(records)
            return
        information = inverse_of_squares(solution.covariance)
        self.information += information
        self.aim += information @ solution.state.coefficients
        # The noise is what is left for each number that was not fitted.
        self.misfit = self.misfit + solution.misfit
        self.counts = self.counts + solution.misfit / solution.sigma**2
        self.height += sum(float(np.sum(record.value[:, 0] ** 2)) for record in records)

    @property
    def covariance(self) -> Float[ndarray, "terms terms"]:
        return inverse_of_squares(self.information)

    @property
    def coefficients(self) -> Float[ndarray, " terms"] | None:
        """None where no window has said anything yet."""
        return np.asarray(self.covariance @ self.aim) if np.any(self.information) else None

    @property
    def stderr(self) -> Float[ndarray, " terms"]:
        return np.sqrt(np.diag(self.covariance))

    def selected(self) -> tuple[Float[ndarray, " terms"], Float[ndarray, " terms"]]:
        """Drop the least significant term, again and again, as long as the Bayesian information criterion falls."""
        kept = np.arange(len(self.aim))
        while True:
            covariance = inverse_of_squares(self.information[np.ix_(kept, kept)])
            values, errors = covariance @ self.aim[kept], np.sqrt(np.diag(covariance))
            least = int(np.argmin(np.abs(values) / errors))
            if len(kept) == 1 or (values[least] / errors[least]) ** 2 > np.log(np.sum(self.counts)):
                break
            kept = np.delete(kept, least)
        coefficients, stderr = np.zeros(len(self.aim)), np.zeros(len(self.aim))
        coefficients[kept], stderr[kept] = values, errors
        return coefficients, stderr

    @property
    def residual(self) -> float:
        return float(np.sqrt(np.atleast_1d(self.misfit)[0] / max(self.height, 1e-300)))

    @property
    def found(self) -> dict[str, float | str]:
        sigma = np.sqrt(self.misfit / np.maximum(self.counts, 1e-300))
        named = zip(("noise_u", "noise_v"), np.atleast_1d(sigma).tolist(), strict=False)
        return {**dict(named), "steps": float(self.steps), "windows": float(self.windows)}


def _left(records: Sequence[Record], solution: Solution) -> float:
    """Return the RMS of what the fitted trajectories leave of u, over the RMS of u."""
    total = sum(float(np.sum(record.value[:, 0] ** 2)) for record in records)
    return float(np.sqrt(solution.misfit[0] / max(total, 1e-300)))


METHODS = (Trajectory,)
