"""Maximum-likelihood fit of whole trajectories: multiple shooting with exact sensitivities.

The model is d^order u_n/dt^order = sum_j xi_j T_j without error, what is observed is u (and v) plus independent Gaussian noise
of unknown size. All states at the sample times are variables, held together by the motion between them; Gauss-Newton steps on
the linearised problem, condensed to the start of each trajectory and the coefficients (Bock, Springer Ser. Chem. Phys. 18, 102
(1981); see `systems.sensitivity`). The states start from the smoothed samples, so that a poor first guess of the coefficients
does no harm: no trajectory is followed for longer than from one sample to the next.

- Start: a smoothing spline's values and slopes for the states, the weak form's coefficients (`methods.weak`), with which the states
  are fitted first; where that leads nowhere, least squares on the motion from sample to sample, led on by fits to short pieces.
- Noise: the standard deviations of u and v are estimated from what the fit leaves, and weigh the two in the next step.
- Unknown ends: the sites whose stencil is not whole have no equation. Their motion is a B-spline in time of unknown
  coefficients, fitted together with everything else to their own samples; how many B-splines is decided before the fit, by
  generalised cross-validation on those samples.
- Inputs: f between the samples is the cubic spline through them.
- Standard errors: inverse of the Gauss-Newton matrix with the estimated noise.
- Selection (off unless asked for): drop the term of the smallest |xi|/stderr, refit from the present states, as long as
  the Bayesian information criterion (Schwarz, Ann. Statist. 6, 461 (1978)) falls.
"""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from latticebench.methods.engine.derivatives import DEGREE, differentiate
from latticebench.methods.engine.sensitivity import (
    Condensed,
    Drive,
    Dynamics,
    Factor,
    Stretches,
    Transition,
    condense,
    split_parts,
)
from latticebench.methods.method import Abilities, Fit, History
from latticebench.methods.weak import LOADS, Weak
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Noise below this share of a field's RMS is round-off and integration error.
LEAST_NOISE = 1e-11
MAX_HALVINGS = 10
# Steps that states are given to follow a motion.
FOLLOW = 20
# Pieces of this share of a trajectory are fitted before the whole; of at least so many samples where u and v are seen.
PIECES = (0.1, 0.3)
GRADUAL_PIECES = (0.1, 0.2, 0.3, 0.5)
MIN_PIECE = 3


@dataclass(frozen=True, eq=False)
class Record:
    """One trajectory as the fit sees it: arrays of real numbers, with 0 where nothing was seen.

    Attributes:
        stretches: the motion between the sample times.
        value: u and, for order 2 where it was observed, v: (T, levels, parts, N).
        seen: whether a value was observed, likewise.
        times: T sample times.
    """

    stretches: Stretches
    value: Float[ndarray, "time levels parts sites"]
    seen: ndarray
    times: Float[ndarray, " time"]


@dataclass(frozen=True, eq=False)
class State:
    """Where the fit is: coefficients, and for each trajectory all states and the splines of sites without an equation.

    Attributes:
        coefficients: xi (terms,).
        nodes: states (T, S) of each trajectory.
        splines: coefficients (m, parts, border) of each trajectory, or None.
    """

    coefficients: Float[ndarray, " terms"]
    nodes: tuple[Float[ndarray, "time state"], ...]
    splines: tuple[ndarray | None, ...]


@dataclass(frozen=True, eq=False)
class Solution:
    """A fitted model.

    Attributes:
        state: where the fit ended.
        sigma: standard deviation of the noise on u and v, of each real part.
        covariance: of the coefficients.
        misfit: sum of squares of what is left, for u and v.
        counts: how many numbers of u and v were observed.
        parameters: how many numbers were fitted in all.
        converged: whether the steps ended.
        steps: of (misfit in units of the noise, coefficients), one a step.
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
        """The Bayesian information criterion up to a constant: n log(misfit / n) of u and v, plus log n a parameter."""
        parts = [n * np.log(max(m, 1e-300) / n) for n, m in zip(self.counts, self.misfit, strict=True) if n]
        return float(sum(parts) + self.parameters * np.log(np.sum(self.counts)))


def prepare(
    samples: Samples,
    terms: tuple[Term, ...],
    order: int,
    weights: ndarray | None = None,
    factors: tuple[Factor | None, ...] | None = None,
    least_reach: tuple[int, int] = (0, 0),
) -> Record:
    """Set the equation up on a trajectory's chain.

    Args:
        samples: what was observed.
        terms: of the equation.
        order: of the time derivative.
        weights: of each term at each site (terms, N), see `systems.sensitivity.Dynamics`.
        factors: of the terms in time, likewise.
        least_reach: sites that the stencil takes up to the left and to the right at least.
    """
    if order not in (1, 2):
        raise InputError(f"order is {order!r}; it must be 1 (du/dt) or 2 (d^2u/dt^2)")
    dynamics = Dynamics(terms, order, samples.is_complex, samples.sites, samples.ends, weights, factors, least_reach)
    fields = [samples.u] if order == 1 or samples.v is None else [samples.u, samples.v]
    value = np.stack([split_parts(one, samples.is_complex) for one in fields], axis=1)
    seen = np.isfinite(value)
    drive = _drive(samples, dynamics) if len(dynamics.border) else None
    inputs = None
    if samples.f is not None and any("f" in term.names for term in terms):
        inputs = samples.forcing()
    stretches = Stretches(dynamics, samples.t[:-1], samples.t[1:], inputs, drive)
    return Record(stretches, np.where(seen, value, 0.0), seen, samples.t)


def without_halves(samples: Samples) -> Samples:
    """Make both parts of a missing complex value NaN; as a number it may be nan + 0i."""

    def whole(field: ndarray | None) -> ndarray | None:
        if field is None or not np.iscomplexobj(field):
            return field
        return np.where(np.isnan(field), complex(np.nan, np.nan), field)

    u = whole(samples.u)
    assert u is not None
    return replace(samples, u=u, v=whole(samples.v))


def smooth(samples: Samples, order: int) -> tuple[ndarray, ndarray | None]:
    """Guess u and, for order 2, v at all sample times from the samples alone: smoothing splines, gaps bridged by cubics."""
    t = samples.t
    u, slope = _filled(t, samples.u)
    if order == 1:
        return u, None
    return u, (slope if samples.v is None else _filled(t, samples.v)[0])


def _filled(t: ndarray, field: ndarray) -> tuple[ndarray, ndarray]:
    from scipy.interpolate import CubicHermiteSpline

    if np.iscomplexobj(field):
        pairs = [_filled(t, part) for part in (field.real, field.imag)]
        return pairs[0][0] + 1j * pairs[1][0], pairs[0][1] + 1j * pairs[1][1]
    if len(t) > DEGREE:
        found = differentiate(t, field, "smoothing-spline")
        value, slope = found.value.copy(), found.first.copy()
    else:
        value, slope = field.copy(), np.full(field.shape, np.nan)
    for site in range(field.shape[1]):
        known = np.flatnonzero(np.isfinite(value[:, site]) & np.isfinite(slope[:, site]))
        if len(known) == len(t):
            continue
        if len(known) > 1:
            curve = CubicHermiteSpline(t[known], value[known, site], slope[known, site])
            value[:, site], slope[:, site] = curve(t), curve(t, 1)
            # A cubic runs away beyond its data.
            for outside, edge in ((t < t[known[0]], known[0]), (t > t[known[-1]], known[-1])):
                value[outside, site], slope[outside, site] = value[edge, site], 0.0
            continue
        known = np.flatnonzero(np.isfinite(field[:, site]))
        value[:, site] = np.interp(t, t[known], field[known, site]) if len(known) else np.nan
        slope[:, site] = np.gradient(value[:, site], t)
    unseen = np.all(np.isnan(value), axis=0)
    for lost in np.flatnonzero(unseen):
        others = np.flatnonzero(~unseen)
        nearest = others[np.argsort(np.abs(others - lost))[:2]]
        value[:, lost] = np.mean(value[:, nearest], axis=1)
        slope[:, lost] = np.mean(slope[:, nearest], axis=1)
    return value, slope


# The drive at unknown ends ---------------------------------------------------------------------------------------------------


def _drive(samples: Samples, dynamics: Dynamics) -> Drive:
    """Choose the splines for the sites without an equation: as many as generalised cross-validation on their samples wants."""
    t = samples.t
    fields = _edge_fields(samples, dynamics)
    most = len(t) * len(fields)
    degree = min(7, max(1, most // 2 - 1))
    sizes = sorted({min(degree + 1 + round(x), most) for x in np.geomspace(1, max(most - degree - 1, 1), 16)})
    best, chosen = np.inf, Drive(_knots(t, sizes[0], degree), degree)
    for size in sizes:
        drive = Drive(_knots(t, size, degree), degree)
        score = _cross_validation(drive, t, fields)
        if score < best:
            best, chosen = score, drive
    return chosen


def _edge_fields(samples: Samples, dynamics: Dynamics) -> list[ndarray]:
    """Give what was seen of u and v of the sites without an equation, each (T, parts * border)."""
    fields = [samples.u] if dynamics.order == 1 or samples.v is None else [samples.u, samples.v]
    return [split_parts(one[:, dynamics.border], samples.is_complex).reshape(len(samples.t), -1) for one in fields]


def _knots(t: ndarray, size: int, degree: int) -> ndarray:
    """Knots of `size` B-splines over the sample times, as dense as the samples are."""
    inner = np.interp(np.linspace(0, 1, size - degree + 1)[1:-1], np.linspace(0, 1, len(t)), t)
    return np.concatenate([np.full(degree + 1, t[0]), inner, np.full(degree + 1, t[-1])])


def _design(drive: Drive, t: ndarray, level: int) -> ndarray:
    first, *curves = drive.basis(t)
    design = np.zeros((len(t), drive.count))
    design[np.arange(len(t))[:, None], first[:, None] + np.arange(drive.degree + 1)] = curves[level]
    return design


def _spline_fit(drive: Drive, t: ndarray, fields: Sequence[ndarray]) -> tuple[ndarray, ndarray, int]:
    """Fit the border's samples; u and v count alike in units of their own spread. Gives splines, misfits and the numbers seen."""
    designs = [_design(drive, t, level) for level in range(len(fields))]
    scales = [max(float(np.nanstd(one)), 1e-12) for one in fields]
    splines = np.zeros((drive.count, fields[0].shape[1]))
    left, seen = np.zeros(fields[0].shape[1]), 0
    for column in range(fields[0].shape[1]):
        known = [np.isfinite(one[:, column]) for one in fields]
        matrix = np.concatenate([d[k] / s for d, k, s in zip(designs, known, scales, strict=True)])
        target = np.concatenate([f[k, column] / s for f, k, s in zip(fields, known, scales, strict=True)])
        splines[:, column] = np.linalg.lstsq(matrix, target, rcond=1e-5)[0]
        left[column] = np.sum((target - matrix @ splines[:, column]) ** 2)
        seen += len(target)
    return splines, left, seen


def _cross_validation(drive: Drive, t: ndarray, fields: Sequence[ndarray]) -> float:
    """Generalised cross-validation's score of a number of B-splines; infinite where they take all the samples."""
    splines, left, seen = _spline_fit(drive, t, fields)
    free = 1 - splines.size / max(seen, 1)
    return float(np.log(np.sum(left) / max(seen, 1) + 1e-24) - 2 * np.log(free)) if free > 0.1 else np.inf


# The fit ---------------------------------------------------------------------------------------------------------------------


def guess(data: Sequence[Samples], records: Sequence[Record]) -> State:
    """Start blind: smoothed states, and the coefficients that best carry each of them to the next."""
    nodes: list[ndarray] = []
    splines: list[ndarray | None] = []
    for samples, record in zip(data, records, strict=True):
        stretches = record.stretches
        dynamics = stretches.dynamics
        u, v = smooth(samples, dynamics.order)
        nodes.append(dynamics.pack(u, v))
        if stretches.drive is None:
            splines.append(None)
            continue
        found = _spline_fit(stretches.drive, samples.t, _edge_fields(samples, dynamics))[0]
        splines.append(found.reshape(-1, dynamics.parts, len(dynamics.border)))
    state = State(np.zeros(len(records[0].stretches.dynamics.terms)), tuple(nodes), tuple(splines))
    return replace(state, coefficients=_sweep(records, state))


def _sweep(records: Sequence[Record], state: State) -> ndarray:
    """Least squares for the coefficients with the states kept: the defects of all stretches, linear in the terms' integrals."""
    from scipy.interpolate import make_interp_spline

    designs, targets = [], []
    for record, nodes, splines in zip(records, state.nodes, state.splines, strict=True):
        stretches = record.stretches
        dynamics = stretches.dynamics
        f = None if stretches.inputs is None else stretches.inputs(record.times)
        driven = stretches.driven(record.times, splines)
        values = dynamics.linear(state.coefficients, record.times, nodes, f, driven, derivatives=False)[1]
        # v(t_k+1) - v(t_k) = sum_j xi_j * integral of T_j: integrals are kinder to noise than derivatives.
        curve = make_interp_spline(record.times, np.moveaxis(values, 2, 0), k=min(3, len(record.times) - 1))
        total = curve.antiderivative()(record.times)
        rate = nodes.reshape(len(nodes), dynamics.order, dynamics.parts, dynamics.count)[:, -1]
        window = max(1, len(record.times) // 10)
        designs.append(np.moveaxis(total[window:] - total[:-window], 2, -1).reshape(-1, values.shape[1]))
        targets.append((rate[window:] - rate[:-window]).ravel())
    design, target = np.concatenate(designs), np.concatenate(targets)
    scale = np.sqrt(np.mean(design**2, axis=0))
    scale[scale == 0] = 1.0
    # Directions that the smoothed states barely show start at 0; the fit finds them.
    return np.asarray(np.linalg.lstsq(design / scale, target, rcond=1e-4)[0] / scale)


@dataclass(frozen=True, eq=False)
class _Point:
    """A state with what it leaves: residuals of the samples and defects of the motion."""

    state: State
    residuals: tuple[ndarray, ...]
    defects: tuple[ndarray, ...]

    def misfit(self) -> Float[ndarray, " levels"]:
        return np.asarray(sum(np.sum(r**2, axis=(0, 2, 3)) for r in self.residuals))

    def chi2(self, sigma: ndarray) -> float:
        """Sum the squares of what the samples leave, in units of the noise."""
        return float(np.sum(self.misfit() / sigma**2))

    def gap(self, sizes: Sequence[ndarray]) -> float:
        """Say how far the states are from following the motion: the defects' sum of squares in units of the noise."""
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


class _Side:
    """Trajectories side by side: those of one equation with nothing acting from outside are integrated as one.

    A long record in many pieces then costs no more calls than a whole one.
    """

    def __init__(self, records: Sequence[Record]) -> None:
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
        """Do the work for each group, and give each trajectory its part of what comes out."""
        found: list[Any] = [None] * len(self.counts)
        for group, stretches in zip(self.groups, self.stretches, strict=True):
            whole, begin = work(stretches, group), 0
            for number in group:
                found[number] = cut(whole, slice(begin, begin + self.counts[number]))
                begin += self.counts[number]
        return found

    def run(self, state: State, substeps: Sequence[ndarray]) -> list[ndarray]:
        """Integrate all states; see `Stretches.run`."""
        return self._each(
            lambda stretches, group: stretches.run(state.coefficients, *_of_group(state, substeps, group)), _rows
        )

    def vary(self, state: State, substeps: Sequence[ndarray]) -> list[Transition]:
        """Integrate all states with their derivatives; see `Stretches.vary`."""
        return self._each(
            lambda stretches, group: stretches.vary(state.coefficients, *_of_group(state, substeps, group)),
            lambda whole, rows: Transition(
                whole.end[rows], whole.by_state[rows], whole.by_coefficient[rows],
                *(None if part is None else part[rows] for part in (whole.by_drive, whole.first)),
            ),
        )  # fmt: skip

    def substeps(self, state: State, tolerance: Sequence[ndarray]) -> list[ndarray]:
        """Find how many steps all stretches need; see `Stretches.substeps`."""
        wide = [np.broadcast_to(one, (count, len(one))) for one, count in zip(tolerance, self.counts, strict=True)]
        return self._each(
            lambda stretches, group: stretches.substeps(state.coefficients, *_of_group(state, wide, group)), _rows
        )


def _rows(whole: ndarray, rows: slice) -> ndarray:
    return whole[rows]


def _of_group(state: State, others: Sequence[ndarray], group: Sequence[int]) -> tuple[ndarray, ndarray, ndarray | None]:
    """Give the starts of all stretches of a group, something else of theirs, and the splines."""
    starts = np.concatenate([state.nodes[k][:-1] for k in group])
    return starts, np.concatenate([others[k] for k in group]), state.splines[group[0]]


def maximise(
    records: Sequence[Record],
    state: State,
    *,
    steps: int = 40,
    tolerance: float = 1e-4,
    noise: ndarray | None = None,
    held: bool = False,
    accuracy: float = 1e-2,
) -> Solution:
    """Climb to the largest likelihood by Gauss-Newton steps from `state`.

    Args:
        records: the trajectories.
        state: where to start; its states need not follow the motion.
        steps: at most so many.
        tolerance: it ends when no coefficient moves by more than this share of its standard error and the defects are as
            small beside the noise.
        noise: standard deviations of u and v, when they are known; estimated when None.
        held: the coefficients are known, and only the states are fitted.
        accuracy: of the integration from sample to sample, in units of the noise.
    """
    began = time.perf_counter()
    counts = np.asarray(sum(np.sum(record.seen, axis=(0, 2, 3)) for record in records), dtype=float)
    height = np.sqrt(sum(np.sum(r.value**2, axis=(0, 2, 3)) for r in records) / np.maximum(counts, 1))
    floor = LEAST_NOISE * np.maximum(height, 1e-300)
    free = len(state.coefficients) + sum(
        nodes.shape[1] + (0 if splines is None else splines.size)
        for nodes, splines in zip(state.nodes, state.splines, strict=True)
    )
    spare = max(1 - free / max(np.sum(counts), 1), 0.05)

    def estimate(misfit: ndarray) -> ndarray:
        if noise is not None:
            return np.asarray(np.maximum(noise, floor))
        return np.asarray(np.maximum(np.sqrt(misfit / np.maximum(counts, 1) / spare), floor))

    side = _Side(records)
    substeps = [np.ones(len(nodes) - 1, dtype=int) for nodes in state.nodes]
    point = _evaluate(records, state, side.run(state, substeps))
    sigma = np.maximum(estimate(point.misfit()), 1e-6 * height) if noise is None else estimate(point.misfit())
    reached = np.inf
    path = []
    converged = False
    covariance = np.full((len(state.coefficients),) * 2, np.nan)
    for _ in range(steps):
        # The integration need not be better than the noise asks for.
        wanted = accuracy * float(np.min(sigma))
        wanted = max(wanted, 1e-10 * float(np.max(height)))
        if wanted < 0.5 * reached:
            reached = wanted
            substeps = side.substeps(state, [tolerances(record, sigma, reached) for record in records])
        transitions = side.vary(state, substeps)
        if not all(np.all(np.isfinite(one.end)) for one in transitions):
            break
        point = _evaluate(records, state, [one.end for one in transitions])
        with np.errstate(over="ignore", invalid="ignore"):
            condensed = [
                _condense(record, one, record.seen / sigma[:, None, None], residual, defect)
                for record, one, residual, defect in zip(
                    records, transitions, point.residuals, point.defects, strict=True
                )
            ]
            rows = np.concatenate([one.rows for one in condensed])
            # The motion may be finite and yet so sensitive that nothing can be said of it.
            bounded = np.all(np.isfinite(np.sum(rows**2, axis=0)))
        if not bounded:
            break
        target = np.concatenate([one.target for one in condensed])
        change, covariance = _solve(rows, target)
        if held:
            change = np.zeros_like(change)
        error = np.sqrt(np.diag(covariance))
        moves = [one.moves(change) for one in condensed]
        sizes = [_sizes(record, sigma) for record in records]
        # First the states must come to follow the motion, which short enough steps always do; then the samples decide.
        gap, chi2 = point.gap(sizes), point.chi2(sigma)
        closed_gap = 1e-4 * float(np.sum(counts))
        # Closing a small gap may cost a little likelihood; the cost vanishes with the gap.
        slack = gap + 10 * np.sqrt(gap * np.sum(counts))
        length, found = 1.0, None
        for _halving in range(MAX_HALVINGS):
            trial = _moved(state, change, moves, length)
            candidate = _evaluate(records, trial, side.run(trial, substeps))
            near = candidate.gap(sizes)
            if gap > closed_gap:
                better = near <= max((1 - 0.1 * length) * gap, closed_gap)
            else:
                better = near <= closed_gap and candidate.chi2(sigma) <= chi2 + 1e-3 + slack
            if better:
                found = candidate
                break
            length /= 2
        if found is None:
            break
        state, point = found.state, found
        before, sigma = sigma, estimate(found.misfit())
        path.append((time.perf_counter() - began, float(np.sum(point.misfit() / sigma**2)), state.coefficients))
        still = np.max(np.abs(change) / np.maximum(error, 1e-300)) <= tolerance or np.max(
            np.abs(change)
        ) <= 1e-12 * np.max(np.abs(state.coefficients))
        closed = max(float(np.max(np.abs(d) / s, initial=0.0)) for d, s in zip(point.defects, sizes, strict=True))
        steady = np.all(np.abs(sigma / before - 1) < max(1e-3, 0.1 * tolerance))
        # Without noise the samples are fitted to the integrator's error, and nothing more is to be had.
        exact = np.all(sigma <= 10 * reached) and np.max(np.abs(change)) <= 1e-9 * np.max(np.abs(state.coefficients))
        if length == 1.0 and ((still and steady and closed < 0.1) or exact):
            converged = True
            break
    return Solution(state, sigma, covariance, point.misfit(), counts, free, converged, tuple(path))


def from_weak_form(
    data: Sequence[Samples], records: Sequence[Record], library: Library, order: int, seed: int
) -> State | None:
    """Start with the coefficients of the weak form and the smoothed states; None where it finds none."""
    try:
        coefficients = Weak().fit(data, library, order, seed).coefficients
    except (InputError, np.linalg.LinAlgError):
        return None
    return replace(guess(data, records), coefficients=coefficients) if np.any(coefficients) else None


def following(records: Sequence[Record], state: State) -> State:
    """Let the states follow the motion, the coefficients being held; the same state where no motion is found.

    The first step from noisy states would take their noise for motion, and draw the coefficients towards zero.
    """
    found = maximise(records, state, steps=FOLLOW, tolerance=0.1, held=True)
    return found.state if found.converged else state


def approach(
    data: Sequence[Samples], records: Sequence[Record], steps: int, lengths: Sequence[float] = PIECES
) -> State:
    """Lead the blind guess near the solution, by fits to pieces of the trajectories, from short to long ones.

    A short piece starts anew from states of its own, so that poor coefficients cannot lead its states far astray; longer pieces
    know the coefficients better. The last fit, to whole trajectories, is left to the caller. `lengths` are shares of a trajectory.
    """
    state = guess(data, records)
    for length in lengths:
        pieces, nodes, splines = [], [], []
        for record, along, drive in zip(records, state.nodes, state.splines, strict=True):
            count = len(record.times)
            least = MIN_PIECE if record.value.shape[1] == record.stretches.dynamics.order else 2 * MIN_PIECE
            cuts = np.linspace(0, count, max(1, count // max(least, round(count * length))) + 1).round().astype(int)
            for begin, end in itertools.pairwise(cuts):
                pieces.append(_piece(record, int(begin), int(end)))
                nodes.append(along[begin:end])
                splines.append(drive)
        if len(pieces) == len(records):
            break
        start = replace(state, nodes=tuple(nodes), splines=tuple(splines))
        found = maximise(pieces, start, steps=steps, tolerance=0.3).state
        if not np.all(np.isfinite(found.coefficients)):
            break
        joined = np.split(np.concatenate(found.nodes), np.cumsum([len(one) for one in state.nodes])[:-1])
        state = replace(state, coefficients=found.coefficients, nodes=tuple(joined))
    return state


def _piece(record: Record, begin: int, end: int) -> Record:
    """Cut the samples `begin` to `end` out of a record, as a record of its own."""
    whole = record.stretches
    # Its drive stays as it was guessed: what it lacks matters little over a short time.
    stretches = replace(whole, begin=whole.begin[begin : end - 1], end=whole.end[begin : end - 1], held=True)
    return Record(stretches, record.value[begin:end], record.seen[begin:end], record.times[begin:end])


def _condense(record: Record, transition: Any, weight: ndarray, residual: ndarray, defect: ndarray) -> Condensed:
    """Cut the samples into those of moving sites and those of the others, and condense."""
    dynamics = record.stretches.dynamics
    shape = (len(weight), dynamics.order, dynamics.parts, dynamics.sites)
    weights, residuals = np.zeros(shape), np.zeros(shape)
    weights[:, : weight.shape[1]], residuals[:, : weight.shape[1]] = weight, residual
    own, edge = dynamics.moving, dynamics.border
    return condense(
        record.stretches, transition,
        weights[..., own].reshape(len(weight), -1), residuals[..., own].reshape(len(weight), -1), defect,
        weights[..., edge] if len(edge) else None, residuals[..., edge] if len(edge) else None,
    )  # fmt: skip


def tolerances(record: Record, sigma: ndarray, least: float) -> Float[ndarray, " state"]:
    """Give the accuracy that each number of a state needs, when that of the best known level is `least`.

    A velocity that is not seen matters only by what it does to u until the next sample.
    """
    sizes = _sizes(record, sigma)
    return np.asarray(least * np.maximum(sizes / np.min(sigma), 1.0))


def _sizes(record: Record, sigma: ndarray) -> ndarray:
    """Give the scale of each number of a state: the noise of u, and of v or what stands for it."""
    dynamics = record.stretches.dynamics
    levels = [sigma[0]] + ([sigma[-1]] if dynamics.order == 2 else [])
    if dynamics.order == 2 and len(sigma) == 1:
        # A velocity that is not seen is known from u to about the noise over the time between samples.
        levels[1] = sigma[0] / float(np.mean(np.diff(record.times)))
    return np.repeat(levels, dynamics.parts * dynamics.count)


def _solve(rows: ndarray, target: ndarray) -> tuple[ndarray, ndarray]:
    """Least squares for the coefficients with their covariance; infinite where the samples say nothing."""
    scale = np.linalg.norm(rows, axis=0)
    scale[scale == 0] = 1.0
    left, values, right = np.linalg.svd(rows / scale, full_matrices=False)
    held = values > 1e-12 * values[0] if len(values) and values[0] > 0 else values > 0
    inverse = np.where(held, 1 / np.where(held, values, 1.0), 0.0)
    change = right.T @ (inverse * (left.T @ target)) / scale
    spread = np.where(held, inverse, 1e12 / max(values[0], 1e-300))
    covariance = (right.T * spread**2) @ right / scale / scale[:, None]
    return change, covariance


def _moved(state: State, change: ndarray, moves: Sequence[tuple[ndarray, ndarray]], length: float) -> State:
    return State(
        state.coefficients + length * change,
        tuple(nodes + length * move for nodes, (move, _) in zip(state.nodes, moves, strict=True)),
        tuple(
            splines if splines is None or not move.size else splines + length * move
            for splines, (_, move) in zip(state.splines, moves, strict=True)
        ),
    )


@dataclass(frozen=True)
class Trajectory:
    """Maximum-likelihood fit of whole trajectories.

    Attributes:
        select: drop terms as long as the Bayesian information criterion falls; otherwise every term stays.
        steps: at most so many Gauss-Newton steps a fit.
        tolerance: the fit ends when no coefficient moves by more than this share of its standard error.
    """

    name: ClassVar[str] = "trajectory"
    select: bool = False
    steps: int = 40
    tolerance: float = 1e-3

    @property
    def abilities(self) -> Abilities:
        """Anything goes."""
        return Abilities(missing=True, motion=True, loads=LOADS)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Fit by maximum likelihood, and select where asked to.

        Raises:
            InputError: the samples do not even give a start.
        """
        data = [without_halves(samples) for samples in data]
        chosen = np.arange(len(library.terms))
        records: Sequence[Record] = [prepare(samples, library.terms, order) for samples in data]
        # Pieces may lead astray, above all where much is missing; the weak form needs many samples, but knows no wrong turning.
        begins = (
            functools.partial(from_weak_form, data, records, library, order, seed),
            functools.partial(approach, data, records, self.steps),
            functools.partial(approach, data, records, self.steps, GRADUAL_PIECES),
            functools.partial(guess, data, records),
        )
        solution = None
        for begin in begins:
            state = begin()
            if state is None:
                continue
            trial = maximise(records, following(records, state), steps=self.steps, tolerance=self.tolerance)
            if solution is None or trial.converged or not trial.criterion >= solution.criterion:
                solution = trial
            if solution.converged:
                break
        assert solution is not None
        first = solution
        if self.select:
            chosen, records, solution = self._select(library, records, solution)
        coefficients, stderr = np.zeros(len(library.terms)), np.zeros(len(library.terms))
        coefficients[chosen] = solution.state.coefficients
        stderr[chosen] = np.sqrt(np.diag(solution.covariance))
        history = None
        if first.steps:
            history = History(
                np.arange(1, len(first.steps) + 1),
                np.array([seconds for seconds, _, _ in first.steps]),
                np.array([loss for _, loss, _ in first.steps]),
                np.array([found for _, _, found in first.steps]),
            )
        found: dict[str, float | str] = {"noise_u": float(solution.sigma[0]), "steps": float(len(first.steps))}
        if len(solution.sigma) > 1:
            found["noise_v"] = float(solution.sigma[1])
        found["criterion"] = solution.criterion
        return Fit(
            self.name, library, order, coefficients, _left(records, solution), stderr=stderr,
            status="ok" if solution.converged else "the fit did not converge; its last step is given",
            history=history, found=found, motion=tuple(map(_motion, data, records, solution.state.nodes, solution.state.splines)),
        )  # fmt: skip

    def _select(
        self, library: Library, records: Sequence[Record], solution: Solution
    ) -> tuple[ndarray, Sequence[Record], Solution]:
        chosen = np.arange(len(library.terms))
        while len(chosen) > 1:
            error = np.sqrt(np.diag(solution.covariance))
            kept = np.delete(chosen, np.argmin(np.abs(solution.state.coefficients) / np.maximum(error, 1e-300)))
            fewer = [
                replace(record, stretches=replace(record.stretches, dynamics=_of(record, library, kept)))
                for record in records
            ]
            start = replace(solution.state, coefficients=solution.state.coefficients[np.isin(chosen, kept)])
            trial = maximise(fewer, start, steps=self.steps, tolerance=self.tolerance)
            if not trial.criterion < solution.criterion:
                break
            chosen, records, solution = kept, fewer, trial
        return chosen, records, solution


def _of(record: Record, library: Library, kept: ndarray) -> Dynamics:
    """Make the equation of fewer terms on the same chain."""
    return replace(record.stretches.dynamics, terms=tuple(library.terms[k] for k in kept))


def _motion(samples: Samples, record: Record, nodes: ndarray, splines: ndarray | None) -> Samples:
    """Write the states of a fit as samples: u and, for order 2, v at the sample times."""
    stretches = record.stretches
    whole = stretches.dynamics.whole(nodes, stretches.driven(record.times, splines))
    fields = [part[:, 0] + 1j * part[:, 1] if samples.is_complex else part[:, 0] for part in np.moveaxis(whole, 1, 0)]
    return replace(samples, u=fields[0], v=fields[1] if len(fields) > 1 else None)


def _left(records: Sequence[Record], solution: Solution) -> float:
    """RMS of what the samples leave of the fitted trajectories, over that of the samples."""
    total = sum(float(np.sum(record.value[:, 0] ** 2)) for record in records)
    return float(np.sqrt(solution.misfit[0] / max(total, 1e-300)))


METHODS = (Trajectory,)
