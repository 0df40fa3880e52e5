"""Maximum likelihood for whole trajectories: multiple shooting by Gauss-Newton steps with exact sensitivities.

The model is d^order u_n/dt^order = sum_j xi_j T_j without error; what is observed is u (and v) plus independent
Gaussian noise. The states at all sample times are variables, tied to each other by the motion between them. Each step
solves the linearised problem, reduced to the coefficients (Bock, Springer Ser. Chem. Phys. 18, 102 (1981); see
`latticebench.methods.engine.condensing`). No motion is followed for longer than from one sample to the next, so that
the states may start anywhere near the samples, and the coefficients almost anywhere.

The standard deviations of the noise on u and on v are estimated from what the fit leaves, and weight the two in the
next step. Standard errors follow from the inverse of the Gauss-Newton matrix.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.condensing import Condensed, condense
from latticebench.methods.engine.record import Record
from latticebench.methods.engine.scaled import Scaled
from latticebench.methods.engine.sensitivity import MAX_SUBSTEPS, Stretches, Transition

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

# Noise below this share of the RMS of a field is round-off and the error of the integrator.
LEAST_NOISE = 1e-11
MAX_HALVINGS = 10
# Where half of all stretches need more steps of the integrator than this, wrong coefficients make the motion far faster
# than the samples can show, and no fit leads on from there. Fits that end well need 8 at most.
FASTEST = 32


@dataclass(frozen=True, eq=False)
class State:
    """The variables of a fit.

    Attributes:
        coefficients: xi (terms,).
        nodes: the states at the sample times (T, S) of each trajectory.
        splines: coefficients of the B-splines at unknown ends (m, parts, border) of each trajectory, or None.
    """

    coefficients: Float[ndarray, " terms"]
    nodes: tuple[Float[ndarray, "time state"], ...]
    splines: tuple[ndarray | None, ...]

    def moved(self, change: ndarray, moves: Sequence[tuple[ndarray, ndarray]], length: float) -> State:
        """Add `length` times a change of the coefficients, and of the nodes and splines of each trajectory."""
        return State(
            self.coefficients + length * change,
            tuple(nodes + length * move for nodes, (move, _) in zip(self.nodes, moves, strict=True)),
            tuple(
                splines if splines is None or not move.size else splines + length * move
                for splines, (_, move) in zip(self.splines, moves, strict=True)
            ),
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """The end of a fit.

    Attributes:
        state: the variables.
        sigma: standard deviation of the noise on u and v, of each real part.
        covariance: of the coefficients.
        misfit: sum of squares of what is left of u and v.
        counts: how many numbers of u and v were observed.
        parameters: how many numbers were fitted.
        converged: whether the steps came to an end.
        steps: seconds since the start, misfit in units of the noise, and coefficients after each step.
    """

    state: State
    sigma: Float[ndarray, " levels"]
    covariance: Float[ndarray, "terms terms"]
    misfit: Float[ndarray, " levels"]
    counts: Float[ndarray, " levels"]
    parameters: int
    converged: bool
    steps: tuple[tuple[float, float, ndarray], ...]

    @property
    def criterion(self) -> float:
        """The Bayesian information criterion: sum over u and v of n log(misfit / n), plus log n per parameter."""
        parts = [n * np.log(max(m, 1e-300) / n) for n, m in zip(self.counts, self.misfit, strict=True) if n]
        return float(sum(parts) + self.parameters * np.log(np.sum(self.counts)))


def maximise(
    records: Sequence[Record],
    state: State,
    *,
    steps: int = 40,
    tolerance: float = 1e-4,
    noise: Float[ndarray, " levels"] | None = None,
    held: bool = False,
    accuracy: float = 1e-2,
) -> Solution:
    """Maximise the likelihood by Gauss-Newton steps.

    Args:
        records: the trajectories.
        state: where to start; its nodes need not follow the motion.
        steps: largest number of steps.
        tolerance: the fit has converged when no coefficient moves by more than this share of its standard error and the
            nodes follow the motion to a share of the noise.
        noise: standard deviations of u and v, if they are known; None to estimate them.
        held: whether the coefficients are known, so that only the states are fitted.
        accuracy: of the integration from sample to sample, in units of the noise.
    """
    began = time.perf_counter()
    scatter = _scatter(records, state, noise)
    side = _SideBySide(records)
    substeps = [np.ones(len(nodes) - 1, dtype=int) for nodes in state.nodes]
    point = side.evaluate(state, substeps=substeps)
    sigma = scatter.estimate(point.misfit())
    if noise is None:
        sigma = np.maximum(sigma, 1e-6 * scatter.height)
    reached, converged, path = np.inf, False, []
    covariance = np.full((len(state.coefficients),) * 2, np.nan)
    for _ in range(steps):
        # The integration need not be better than the noise asks for.
        wanted = max(accuracy * float(np.min(sigma)), 1e-10 * float(np.max(scatter.height)))
        if wanted < 0.5 * reached:
            reached = wanted
            resolved = side.substeps(point.state, [tolerances(record, sigma, reached) for record in records])
            if resolved is None:
                break
            substeps = resolved
        transitions = side.vary(point.state, substeps)
        point = _evaluate(records, point.state, [one.end for one in transitions])
        step = _gauss_newton(records, transitions, point, sigma, held)
        if step is None:
            break
        covariance = step.covariance
        found = _shortened(side, substeps, point, step, sigma, float(np.sum(scatter.counts)))
        if found is None:
            break
        length, point = found
        before, sigma = sigma, scatter.estimate(point.misfit())
        path.append((time.perf_counter() - began, point.chi2(sigma), point.state.coefficients))
        settled = step.small(point, tolerance) and np.all(np.abs(sigma / before - 1) < max(1e-3, 0.1 * tolerance))
        if length == 1.0 and (settled or (np.all(sigma <= 10 * reached) and step.negligible(point))):
            converged = True
            break
    return Solution(
        point.state, sigma, covariance, point.misfit(), scatter.counts, scatter.free, converged, tuple(path)
    )


def tolerances(record: Record, sigma: Float[ndarray, " levels"], least: float) -> Float[ndarray, " state"]:
    """Return the accuracy that each number of a state needs, where that of the best known level is `least`.

    A velocity that is not observed matters only by what it does to u until the next sample.
    """
    sizes = _sizes(record, sigma)
    return np.asarray(least * np.maximum(sizes / np.min(sigma), 1.0))


def _sizes(record: Record, sigma: ndarray) -> ndarray:
    """Return the scale of each number of a state: the noise of u, and of v or what stands for it."""
    dynamics = record.stretches.dynamics
    levels = [sigma[0]] + ([sigma[-1]] if dynamics.order == 2 else [])
    if dynamics.order == 2 and len(sigma) == 1:
        # A velocity that is not observed is known from u to about the noise over the time between samples.
        levels[1] = sigma[0] / float(np.mean(np.diff(record.times)))
    return np.repeat(levels, dynamics.parts * dynamics.count)


@dataclass(frozen=True, eq=False)
class _Scatter:
    """How the noise of u and v follows from what a fit leaves.

    Attributes:
        counts: how many numbers of u and v were observed.
        height: RMS of u and v.
        free: how many numbers are fitted.
        known: the noise, if it is known.
    """

    counts: Float[ndarray, " levels"]
    height: Float[ndarray, " levels"]
    free: int
    known: Float[ndarray, " levels"] | None

    def estimate(self, misfit: ndarray) -> Float[ndarray, " levels"]:
        """Return the standard deviations of u and v."""
        floor = LEAST_NOISE * np.maximum(self.height, 1e-300)
        if self.known is not None:
            return np.asarray(np.maximum(self.known, floor))
        spare = max(1 - self.free / max(np.sum(self.counts), 1), 0.05)
        return np.asarray(np.maximum(np.sqrt(misfit / np.maximum(self.counts, 1) / spare), floor))


def _scatter(records: Sequence[Record], state: State, known: ndarray | None) -> _Scatter:
    counts = np.asarray(sum(np.sum(record.seen, axis=(0, 2, 3)) for record in records), dtype=float)
    height = np.sqrt(sum(np.sum(r.value**2, axis=(0, 2, 3)) for r in records) / np.maximum(counts, 1))
    free = len(state.coefficients) + sum(
        nodes.shape[1] + (0 if splines is None else splines.size)
        for nodes, splines in zip(state.nodes, state.splines, strict=True)
    )
    return _Scatter(counts, height, free, known)


# One step ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Point:
    """A state with what it leaves: residuals of the samples and defects of the motion."""

    state: State
    residuals: tuple[ndarray, ...]
    defects: tuple[ndarray, ...]

    def misfit(self) -> Float[ndarray, " levels"]:
        """Return the sum of squares of what the samples leave, of u and v."""
        return np.asarray(sum(np.sum(r**2, axis=(0, 2, 3)) for r in self.residuals))

    def chi2(self, sigma: ndarray) -> float:
        """Return the sum of squares of what the samples leave, in units of the noise."""
        return float(np.sum(self.misfit() / sigma**2))

    def gap(self, sizes: Sequence[ndarray]) -> float:
        """Return how far the nodes are from following the motion: the defects' sum of squares in units of the noise."""
        with np.errstate(over="ignore", invalid="ignore"):
            return sum(float(np.sum((d / s) ** 2)) for d, s in zip(self.defects, sizes, strict=True))


def _evaluate(records: Sequence[Record], state: State, ends: Sequence[ndarray]) -> _Point:
    residuals, defects = [], []
    for record, nodes, splines, end in zip(records, state.nodes, state.splines, ends, strict=True):
        stretches = record.stretches
        whole = stretches.dynamics.whole(nodes, stretches.driven(record.times, splines))
        residuals.append(np.where(record.seen, record.value - whole[:, : record.value.shape[1]], 0.0))
        defects.append(end - nodes[1:])
    return _Point(state, tuple(residuals), tuple(defects))


@dataclass(frozen=True, eq=False)
class _Step:
    """A Gauss-Newton step.

    Attributes:
        change: of the coefficients.
        covariance: of the coefficients.
        moves: changes of the nodes and splines of each trajectory.
        sizes: scale of each number of a state, of each trajectory.
    """

    change: Float[ndarray, " terms"]
    covariance: Float[ndarray, "terms terms"]
    moves: tuple[tuple[ndarray, ndarray], ...]
    sizes: tuple[ndarray, ...]

    def small(self, point: _Point, tolerance: float) -> bool:
        """Whether the coefficients hardly moved and the nodes follow the motion."""
        most = np.max(np.abs(self.change))
        error = np.sqrt(np.diag(self.covariance))
        still = np.max(np.abs(self.change) / np.maximum(error, 1e-300)) <= tolerance
        still = still or most <= 1e-12 * np.max(np.abs(point.state.coefficients))
        left = zip(point.defects, self.sizes, strict=True)
        return bool(still and max(float(np.max(np.abs(d) / s, initial=0.0)) for d, s in left) < 0.1)

    def expected(self, records: Sequence[Record], point: _Point, sigma: ndarray) -> float:
        """Return the sum of squares in units of the noise after the whole step, by the linearised problem."""
        total = 0.0
        for record, residual, (nodes, splines) in zip(records, point.residuals, self.moves, strict=True):
            stretches = record.stretches
            driven = stretches.driven(record.times, splines) if splines.size else None
            whole = stretches.dynamics.whole(nodes, driven)
            left = residual - np.where(record.seen, whole[:, : residual.shape[1]], 0.0)
            total += float(np.sum(np.sum(left**2, axis=(0, 2, 3)) / sigma**2))
        return total

    def negligible(self, point: _Point) -> bool:
        """Whether the coefficients moved by round-off only: without noise, no step can gain more than that."""
        return bool(np.max(np.abs(self.change)) <= 1e-9 * np.max(np.abs(point.state.coefficients)))


def _gauss_newton(
    records: Sequence[Record], transitions: Sequence[Transition], point: _Point, sigma: ndarray, held: bool
) -> _Step | None:
    """Return the step of the linearised problem; None where the motion is so sensitive that the samples say nothing.

    A motion that is not finite is.
    """
    if not all(np.all(np.isfinite(one.end)) for one in transitions):
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        condensed = [
            _condense(record, one, record.seen / sigma[:, None, None], residual, defect)
            for record, one, residual, defect in zip(records, transitions, point.residuals, point.defects, strict=True)
        ]
        rows = np.concatenate([one.rows for one in condensed])
        if not np.all(np.isfinite(np.sum(rows**2, axis=0))):
            return None
    solved = Scaled.of(rows)
    change = solved.solution(np.concatenate([one.target for one in condensed]))
    if held:
        change = np.zeros_like(change)
    moves = tuple(one.moves(change) for one in condensed)
    return _Step(change, solved.covariance(), moves, tuple(_sizes(record, sigma) for record in records))


def _condense(record: Record, transition: Transition, weight: ndarray, residual: ndarray, defect: ndarray) -> Condensed:
    """Condense one trajectory; a level that was not observed weighs nothing."""
    dynamics = record.stretches.dynamics
    shape = (len(weight), dynamics.order, dynamics.parts, dynamics.sites)
    weights, residuals = np.zeros(shape), np.zeros(shape)
    weights[:, : weight.shape[1]], residuals[:, : weight.shape[1]] = weight, residual
    return condense(record.stretches, transition, weights, residuals, defect)


def _shortened(
    side: _SideBySide, substeps: Sequence[ndarray], point: _Point, step: _Step, sigma: ndarray, count: float
) -> tuple[float, _Point] | None:
    """Halve a step until it improves the fit: its length and where it leads, or None where no length does.

    The nodes must come to follow the motion first, which short enough steps always achieve; then the samples decide.
    What the linearised problem expects closing the gap to cost is no reason to go less far.
    """
    gap, chi2 = point.gap(step.sizes), point.chi2(sigma)
    expected = step.expected(side.records, point, sigma)
    closed_gap = 1e-4 * count
    # Closing a small gap may cost a little likelihood; the cost vanishes with the gap.
    slack = gap + 10 * np.sqrt(gap * count)
    length = 1.0
    for _ in range(MAX_HALVINGS):
        trial = side.evaluate(point.state.moved(step.change, step.moves, length), substeps=substeps)
        near = trial.gap(step.sizes)
        if gap > closed_gap:
            better = near <= max((1 - 0.1 * length) * gap, closed_gap)
        else:
            most = max(chi2, (1 - length) * chi2 + length * expected)
            better = near <= closed_gap and trial.chi2(sigma) <= most + 1e-3 + slack
        if better:
            return length, trial
        length /= 2
    return None


# Many trajectories -------------------------------------------------------------------------------------------


class _SideBySide:
    """Trajectories side by side; those that follow one equation without outside influence are integrated as one.

    A long record in many pieces then costs no more calls than a whole one.
    """

    def __init__(self, records: Sequence[Record]) -> None:
        self.records = records
        self.groups: list[list[int]] = []
        for number, record in enumerate(records):
            group = next((g for g in self.groups if record.stretches.joins(records[g[0]].stretches)), None)
            if group is None:
                self.groups.append([number])
            else:
                group.append(number)
        self.stretches = [self._joined([records[k].stretches for k in group]) for group in self.groups]
        self.counts = [len(record.times) - 1 for record in records]

    @staticmethod
    def _joined(parts: Sequence[Stretches]) -> Stretches:
        if len(parts) == 1:
            return parts[0]
        begin, end = (np.concatenate([getattr(part, name) for part in parts]) for name in ("begin", "end"))
        return replace(parts[0], begin=begin, end=end)

    def _each(self, work: Callable[[Stretches, list[int]], Any], cut: Callable[[Any, slice], Any]) -> list[Any]:
        """Do the work for each group, and return what belongs to each trajectory."""
        found: list[Any] = [None] * len(self.counts)
        for group, stretches in zip(self.groups, self.stretches, strict=True):
            whole, begin = work(stretches, group), 0
            for number in group:
                found[number] = cut(whole, slice(begin, begin + self.counts[number]))
                begin += self.counts[number]
        return found

    def evaluate(self, state: State, *, substeps: Sequence[Int[ndarray, " stretch"]]) -> _Point:
        """Integrate all states, and compare them with the samples; see `Stretches.run`."""
        ends = self._each(
            lambda stretches, group: stretches.run(state.coefficients, *_of_group(state, substeps, group)), _rows
        )
        return _evaluate(self.records, state, ends)

    def vary(self, state: State, substeps: Sequence[Int[ndarray, " stretch"]]) -> list[Transition]:
        """Integrate all states with their derivatives; see `Stretches.vary`."""
        return self._each(
            lambda stretches, group: stretches.vary(state.coefficients, *_of_group(state, substeps, group)),
            lambda whole, rows: Transition(
                whole.end[rows], whole.by_state[rows], whole.by_coefficient[rows],
                *(None if part is None else part[rows] for part in (whole.by_drive, whole.first)),
            ),
        )  # fmt: skip

    def substeps(
        self, state: State, tolerance: Sequence[Float[ndarray, " state"]]
    ) -> list[Int[ndarray, " stretch"]] | None:
        """Return how many steps all stretches need, or None where half of them need more than FASTEST."""
        wide = [np.broadcast_to(one, (count, len(one))) for one, count in zip(tolerance, self.counts, strict=True)]

        def needed(most: int) -> list[Int[ndarray, " stretch"]]:
            return self._each(
                lambda stretches, group: stretches.substeps(
                    state.coefficients, *_of_group(state, wide, group), most=most
                ),
                _rows,
            )

        found = needed(2 * FASTEST)
        together = np.concatenate(found)
        if np.median(together) > FASTEST:
            return None
        return needed(MAX_SUBSTEPS) if np.any(together > FASTEST) else found


def _rows(whole: ndarray, rows: slice) -> ndarray:
    return whole[rows]


def _of_group(state: State, others: Sequence[ndarray], group: Sequence[int]) -> tuple[ndarray, ndarray, ndarray | None]:
    """Return the starts of all stretches of a group, what `others` has for them, and the splines."""
    starts = np.concatenate([state.nodes[k][:-1] for k in group])
    return starts, np.concatenate([others[k] for k in group]), state.splines[group[0]]
