"""How a model is followed: over pieces of recordings, side by side, each from an initial state of its own.

The motion between neighbouring samples is integrated for all samples at once, from states near it; Newton steps along
each piece then make every state the end of the motion from the one before (multiple shooting with its defects
closed; Bock, Springer Ser. Chem. Phys. 18, 102 (1981)).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.acceleration import with_rates
from latticebench.diagnosis.acting import Chain
from latticebench.diagnosis.border import Border, borders
from latticebench.diagnosis.model import Assembled, Model
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.propagation import propagate
from latticebench.diagnosis.reading import Sensitivity, is_late, read_by
from latticebench.diagnosis.rows import Rows
from latticebench.methods.engine.dynamics import Dynamics
from latticebench.methods.engine.record import Record
from latticebench.methods.engine.sensitivity import Stretches, Transition

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray

# Newton steps that may close the gaps of a motion, how small the last one must be in units of a small size, and how
# large one may be at most.
CLOSURES, CLOSED, LOST = 6, 1.0, 1e6
# Steps with derivatives from nearby must be so many times smaller: they do not square what is left.
CHORD = 0.1
# Steps of the integrator per typical interval, at most: a motion that runs away would have as many as it is given.
# In a gap, which lasts as long as several, it is at least so many for each of them.
MOST_SUBSTEPS, MOST_IN_GAPS = 8, 2
# Looking ahead over a step with dry friction takes about as long as so many stages.
AHEAD = 3
# Numbers of the states of all intervals below which the time goes into calls, not into numbers.
SMALL_BATCH = 5000
# A piece of fewer rows says nothing.
FEWEST_ROWS = 3
# What the errors of all intervals of a piece may come to together, in units of a small size.
TOGETHER = 3.0
# Noise is at least this share of a converter's step: where a motion stands still, readings repeat exactly.
ROUNDING = 0.2


@dataclass(frozen=True, eq=False)
class Layout:
    """How recordings are cut into pieces.

    Attributes:
        chain: the lattice.
        plain: the declared terms on it.
        records: the recordings.
        splines: of smoothed readings of the sites without an equation, of each recording.
        borders: the curves that these sites follow on the pieces, of each recording.
        rows: which rows of its recording each piece has (pieces, m); the last is repeated where a piece is shorter.
        valid: whether a row is none of those repeated.
        substeps: of the integrator, for each interval (pieces * (m - 1)).
        integrator: the one that needs the least work.
        least: the smallest size of the noise.
        small: a size of u that does not matter.
        memory: correlation time of the noise, by which the numbers of the curves were chosen.
        fastest: how far a zero that wanders goes at most, over the size of the noise, per square root of time.
    """

    chain: Chain
    plain: Dynamics
    records: tuple[Record, ...]
    splines: tuple[ndarray | None, ...]
    borders: tuple[Border | None, ...]
    rows: tuple[Int[ndarray, "pieces m"], ...]
    valid: tuple[Bool[ndarray, "pieces m"], ...]
    substeps: tuple[Int[ndarray, " intervals"], ...]
    small: float
    integrator: Literal["dop853", "rk45"] = "dop853"
    least: float = 0.0
    memory: float = 0.0
    fastest: float = np.inf

    @classmethod
    def of(cls, problem: Problem, length: int, most: int | None, small: float, memory: float = 0.0) -> Layout:
        """Cut recordings into pieces of about `length` rows; of `most` rows in all, evenly spaced, if that is given."""
        found_rows, found_valid = [], []
        total = sum(len(record.times) for record in problem.records)
        for record in problem.records:
            pieces = _pieces(record.times, length, length * problem.step)
            if most is not None and most < total:
                kept = max(1, round(len(pieces) * most / total))
                pieces = [pieces[k] for k in np.unique(np.linspace(0, len(pieces) - 1, kept).round().astype(int))]
            m = max(end - begin for begin, end in pieces)
            found_rows.append(np.stack([np.minimum(begin + np.arange(m), end - 1) for begin, end in pieces]))
            found_valid.append(np.stack([begin + np.arange(m) < end for begin, end in pieces]))
        substeps = tuple(np.ones(rows.shape[0] * (rows.shape[1] - 1), dtype=int) for rows in found_rows)
        curves = borders(
            problem.records, problem.plain, problem.splines, found_rows, found_valid, memory, problem.fineness
        )
        return cls(
            problem.chain, problem.plain, problem.records, problem.splines, curves, tuple(found_rows),
            tuple(found_valid), substeps, small,
            least=max(ROUNDING * min((one for one in problem.steps if one > 0), default=0.0), problem.finest,
                      problem.unrounded),
            memory=memory, fastest=float(np.sqrt(rules.SLOWER * problem.step)) * problem.main,
        )  # fmt: skip

    @property
    def pieces(self) -> int:
        """The number of pieces of all recordings."""
        return sum(len(rows) for rows in self.rows)

    @property
    def longest(self) -> int:
        """The samples of the longest piece."""
        return int(max(rows.shape[1] for rows in self.rows))

    def readings(self) -> int:
        """Return how many numbers were read."""
        pairs = zip(self.records, self.rows, self.valid, strict=True)
        return int(sum(np.sum(record.seen[rows][valid]) for record, rows, valid in pairs))

    def laid_out(self) -> Rows:
        """Return times and sensors of all rows, one after another."""
        times = np.concatenate([r.times[rows].ravel() for r, rows in zip(self.records, self.rows, strict=True)])
        first = np.concatenate([np.arange(rows.size) % rows.shape[1] == 0 for rows in self.rows])
        sensor = np.arange(self.chain.levels)[:, None, None] * self.chain.sites + np.arange(self.chain.sites)
        whole = np.broadcast_to(sensor, (self.chain.levels, self.chain.parts, self.chain.sites))
        outer = frozenset(sensor[:, :, self.plain.border].ravel().tolist())
        return Rows(times, first, whole.ravel(), self.least, outer, fastest=self.fastest)

    def resting(self, rest: float) -> Layout:
        """Return the same pieces, where dry friction is viscous below another speed."""
        return replace(self, plain=replace(self.plain, rest=rest))

    def stretches(self, number: int, assembled: Assembled) -> Stretches:
        """Return the intervals of all pieces of one recording."""
        record, border = self.records[number], self.borders[number]
        t = record.times[self.rows[number]]
        return replace(
            record.stretches,
            dynamics=assembled.dynamics,
            begin=t[:, :-1].ravel(),
            end=t[:, 1:].ravel(),
            drive=None if border is None else border.basis,
            held=True,
            integrator=self.integrator,
        )

    @property
    def curves(self) -> tuple[ndarray | None, ...]:
        """Coefficients of the curves through what was read of the sites without an equation."""
        return tuple(None if one is None else one.start for one in self.borders)

    def bordered(self, number: int, splines: ndarray | None, by: Float[ndarray, "pieces numbers"]) -> ndarray | None:
        """Return coefficients of the border's curves that are changed by the numbers of each piece."""
        border = self.borders[number]
        return None if border is None or splines is None else border.moved(splines, by)

    def driven(self, number: int, splines: ndarray | None) -> ndarray | None:
        """Return what the sites without an equation do at all rows: (rows, order, parts, border)."""
        border, record = self.borders[number], self.records[number]
        if border is None:
            return None
        t = record.times[self.rows[number]].ravel()
        return replace(record.stretches, drive=border.basis).driven(t, splines)

    def rounds(self, number: int) -> Int[ndarray, " intervals"]:
        """Return steps for each interval of a recording: as many for all as for one where that is quicker.

        A small batch takes as long as a smaller one, and each number of steps is a batch.
        """
        needed = self.substeps[number]
        return np.full_like(needed, np.max(needed)) if len(needed) * self.plain.size < SMALL_BATCH else needed

    def with_substeps(self, model: Model, nodes: Sequence[ndarray], top: float) -> Layout:
        """Return the same with the integrator that needs the least work near given states, and its steps."""
        ways = [replace(self, integrator=way) for way in ("rk45", "dop853")]
        (short, short_enough), (long, long_enough) = (way._steps(model, nodes, top) for way in ways)
        # Where the one of low order may take no more steps, it would need twice as many at least.
        counted = [steps * np.where(enough, 1, 2) for steps, enough in zip(short, short_enough, strict=True)]
        falls_short = any(np.any(one & ~other) for one, other in zip(long_enough, short_enough, strict=True))
        ahead = AHEAD if model.rubs else 0
        if (6 + ahead) * sum(map(np.sum, counted)) < (12 + ahead) * sum(map(np.sum, long)) and not falls_short:
            return replace(ways[0], substeps=short)
        return replace(ways[1], substeps=long)

    def _steps(
        self, model: Model, nodes: Sequence[ndarray], top: float
    ) -> tuple[tuple[Int[ndarray, " intervals"], ...], tuple[Bool[ndarray, " intervals"], ...]]:
        """Return the steps of each interval, and whether they were fewer than it may take."""
        found, enough = [], []
        for number in range(len(self.records)):
            assembled = model.assembled(self.plain, self.chain, number)
            y = nodes[number]
            # Errors add up along a piece; a slow loss of amplitude would be taken for a damping.
            least = self.small * min(0.3, TOGETHER / y.shape[1])
            levels = [least, least * top][: self.plain.order]
            tolerance = assembled.dynamics.sized(levels)
            flat = y[:, :-1].reshape(-1, y.shape[-1])
            stretches = self.stretches(number, assembled)
            # In a single step through a gap the motion would be lost.
            lasting = np.ceil((stretches.end - stretches.begin) / float(np.median(np.diff(self.records[number].times))))
            least = np.maximum(lasting, 1).astype(int)
            most = np.maximum(MOST_SUBSTEPS // least, MOST_IN_GAPS)
            needed = stretches.substeps(assembled.coefficients, flat, tolerance, self.curves[number], most, least)
            found.append(needed)
            enough.append(needed * 2 <= most * least)
        return tuple(found), tuple(enough)


def _pieces(times: Float[ndarray, " time"], length: int, longest: float) -> list[tuple[int, int]]:
    """Return the first row of each piece and the one after its last; of several, none holds a gap beyond `longest`."""
    count, found = len(times), []
    gaps = np.flatnonzero(np.diff(times) > longest) + 1 if length < count else np.array([], dtype=int)
    for begin, end in itertools.pairwise([0, *gaps.tolist(), count]):
        edges = np.linspace(begin, end, max(1, round((end - begin) / length)) + 1).round().astype(int).tolist()
        found += [piece for piece in itertools.pairwise(edges) if piece[1] - piece[0] > FEWEST_ROWS]
    return found or [(0, count)]


@dataclass(frozen=True, eq=False)
class Path:
    """A motion along all pieces, and what it leaves of the readings.

    Attributes:
        model: with its numbers.
        nodes: states at the rows of each recording's pieces (pieces, m, S).
        splines: coefficients of the curves of the sites without an equation.
        level: the model's readings, rows of all recordings one after another (rows, channels).
        left: readings less that, NaN where nothing was read.
        sensitivity: derivatives of the readings by the motion.
    """

    model: Model
    nodes: tuple[Float[ndarray, "pieces m state"], ...]
    splines: tuple[ndarray | None, ...]
    level: Float[ndarray, "rows channels"]
    left: Float[ndarray, "rows channels"]
    sensitivity: Sensitivity

    @property
    def size(self) -> int:
        """The length S of a state."""
        return int(self.nodes[0].shape[-1])

    @functools.cached_property
    def swing(self) -> Float[ndarray, "rows channels"]:
        """The model's readings about their mean: noise may grow with that, whatever a sensor's offset."""
        return np.asarray(self.level - np.mean(self.level, axis=0))


@dataclass(frozen=True, eq=False)
class Followed(Path):
    """A motion with its derivatives.

    Attributes:
        moves: of the nodes, by the piece's own numbers, which are its initial state and the curves of its border, and
            by the model's numbers (pieces, m, L + G, S).
        transitions: of each state by the one before (pieces, m - 1, S, S).
        slope: of the readings, by the piece's own numbers and the model's (rows, channels, L + G).
    """

    moves: tuple[Float[ndarray, "pieces m varied state"], ...]
    transitions: tuple[Float[ndarray, "pieces intervals state state"], ...]
    slope: Float[ndarray, "rows channels varied"]

    @property
    def path(self) -> Path:
        """The motion alone."""
        return Path(self.model, self.nodes, self.splines, self.level, self.left, self.sensitivity)

    @property
    def local(self) -> int:
        """The number L of a piece's own numbers."""
        return int(self.slope.shape[-1]) - len(self.model.numbers)


def follow(
    model: Model,
    layout: Layout,
    near: Sequence[Float[ndarray, "pieces m state"]],
    transitions: Sequence[Float[ndarray, "pieces intervals state state"]] | None = None,
    splines: Sequence[ndarray | None] | None = None,
) -> Path | None:
    """Follow a model from the first state of each piece; None where it cannot be followed.

    Args:
        model: with its numbers.
        layout: the pieces.
        near: states near the motion, of each recording.
        transitions: the derivatives of each state by the one before, of a motion nearby if there is one.
        splines: of the curves of the sites without an equation; those through what was read of them if None.
    """
    nodes: list[ndarray] = []
    splines = layout.curves if splines is None else tuple(splines)
    with np.errstate(all="ignore"):
        for number in range(len(layout.records)):
            assembled = model.assembled(layout.plain, layout.chain, number)
            gaps = _Gaps.of(layout, number, assembled, splines[number])
            closed = None if transitions is None else gaps.closed_along(near[number], transitions[number])
            closed = gaps.closed(near[number]) if closed is None else closed
            if closed is None:
                return None
            nodes.append(closed)
    return Path(model, tuple(nodes), splines, *_readings(model, layout, nodes, splines))


def linearised(path: Path, layout: Layout) -> Followed | None:
    """Return a motion with its derivatives; None where they are not finite."""
    moves, transitions = [], []
    with np.errstate(all="ignore"):
        for number, y in enumerate(path.nodes):
            assembled = path.model.assembled(layout.plain, layout.chain, number)
            flat = y[:, :-1].reshape(-1, y.shape[-1])
            stretches = replace(layout.stretches(number, assembled), held=False)
            found = stretches.vary(
                assembled.coefficients, flat, layout.rounds(number), path.splines[number], dense=True
            )
            by_state = np.asarray(found.by_state).reshape(*y[:, 1:].shape, y.shape[-1])
            moves.append(_moves(found, by_state, assembled, layout.borders[number]))
            transitions.append(by_state)
    if not all(np.all(np.isfinite(one)) for one in moves):
        return None
    slope = _slopes(path, layout, moves)
    return Followed(
        path.model, path.nodes, path.splines, path.level, path.left, path.sensitivity, tuple(moves), tuple(transitions),
        slope,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Gaps:
    """The gaps between the states of one recording's pieces and where the motion from the state before leads."""

    layout: Layout
    number: int
    assembled: Assembled
    stretches: Stretches
    units: Float[ndarray, " state"]
    splines: ndarray | None

    @classmethod
    def of(cls, layout: Layout, number: int, assembled: Assembled, splines: ndarray | None) -> _Gaps:
        dynamics, record = assembled.dynamics, layout.records[number]
        levels = [layout.small, layout.small / float(np.median(np.diff(record.times)))][: dynamics.order]
        units = dynamics.sized(levels)
        return cls(layout, number, assembled, layout.stretches(number, assembled), units, splines)

    def closed_along(self, near: ndarray, by_state: ndarray) -> ndarray | None:
        """Return states that follow one another, by steps with given derivatives; None where these are too far off."""
        y, last = np.array(near), np.inf
        for _ in range(CLOSURES):
            start = y[:, :-1].reshape(-1, y.shape[-1])
            ends = self.stretches.run(self.assembled.coefficients, start, self.layout.rounds(self.number), self.splines)
            y, worst = self._moved(y, ends, by_state)
            if worst < CLOSED * CHORD:
                return y
            if not worst < last / 2:
                return None
            last = worst
        return None

    def closed(self, near: ndarray) -> ndarray | None:
        """Return states that follow one another, by Newton steps; None where these do not lead there."""
        y = np.array(near)
        for _ in range(CLOSURES):
            start = y[:, :-1].reshape(-1, y.shape[-1])
            found = self.stretches.vary(
                self.assembled.coefficients, start, self.layout.rounds(self.number), self.splines,
                by_terms=False, dense=True,
            )  # fmt: skip
            y, worst = self._moved(y, found.end, np.asarray(found.by_state))
            # Newton steps square what is left.
            if worst < CLOSED:
                return y
            if not worst < LOST:
                break
        return None

    def _moved(self, y: ndarray, ends: ndarray, by_state: ndarray) -> tuple[ndarray, float]:
        """Return states after a step that closes the gaps as far as the motion is linear, and the largest change."""
        pieces, m, size = y.shape
        gaps = (ends.reshape(pieces, m - 1, size) - y[:, 1:])[:, :, None]
        by_state = by_state.reshape(pieces, m - 1, size, size)
        change = propagate(by_state, gaps, np.zeros((pieces, 1, size)))[:, :, 0]
        worst = float(np.max(np.abs(change) / self.units))
        return y + change, worst if np.isfinite(worst) else np.inf


def _moves(transition: Transition, by_state: ndarray, assembled: Assembled, border: Border | None) -> ndarray:
    """Return the derivatives of all states by the initial one, the border's curves and the model's numbers."""
    pieces, intervals, size, _ = by_state.shape
    forced = np.tensordot(transition.by_coefficient, assembled.slope, (1, 0))
    pushed = [np.moveaxis(forced, 1, 2).reshape(pieces, intervals, -1, size)]
    if border is not None:
        pushed.insert(0, border.driving(transition, intervals))
    pushed.insert(0, np.zeros((pieces, intervals, size, size)))
    wide = np.concatenate(pushed, axis=2)
    first = np.zeros((pieces, wide.shape[2], size))
    first[:, :size] = np.eye(size)
    return propagate(by_state, wide, first)


def fields(
    layout: Layout, number: int, nodes: Float[ndarray, "pieces m state"], splines: ndarray | None
) -> tuple[ndarray, ndarray]:
    """Return times (rows,) and the field (rows, order, parts, N)."""
    t = layout.records[number].times[layout.rows[number]].ravel()
    return t, layout.plain.whole(nodes.reshape(t.size, -1), layout.driven(number, splines))


def _readings(
    model: Model, layout: Layout, nodes: Sequence[ndarray], splines: Sequence[ndarray | None]
) -> tuple[ndarray, ndarray, Sensitivity]:
    """Return what instruments make of a motion, what that leaves of the readings, and its derivatives."""
    levels, lefts, sensitivities = [], [], []
    for number, record in enumerate(layout.records):
        rows = layout.rows[number]
        t, field = fields(layout, number, nodes[number], splines[number])
        level = field[:, : layout.chain.levels]
        sensitivity = Sensitivity(np.ones_like(level))
        if instruments := [placed for placed, _ in model.instruments(number)]:
            field = with_rates(layout.records[number].times[rows], field) if is_late(instruments) else field
            wrong = read_by(instruments, t, field).read(layout.chain.levels)
            level, sensitivity = level + wrong.added, Sensitivity.of(wrong)
        seen = record.seen[rows] & layout.valid[number][..., None, None, None]
        value = np.where(seen, record.value[rows], np.nan).reshape(level.shape)
        levels.append(level.reshape(rows.size, -1))
        lefts.append((value - level).reshape(rows.size, -1))
        sensitivities.append(sensitivity)
    return np.concatenate(levels), np.concatenate(lefts), Sensitivity.along(sensitivities)


def _slopes(path: Path, layout: Layout, moves: Sequence[ndarray]) -> ndarray:
    """Return the derivatives of the readings by the initial state and the model's numbers."""
    found, begin = [], 0
    for number, rows in enumerate(layout.rows):
        t, field = fields(layout, number, path.nodes[number], path.splines[number])
        count, size = moves[number].shape[2:]
        flat = moves[number].reshape(rows.size, count, size)
        by_field, sensitivity = layout.plain.whole(flat, None), path.sensitivity.at(slice(begin, begin + rows.size))
        begin += rows.size
        by = np.moveaxis(by_field[:, :, : layout.chain.levels], 1, -1)
        border = layout.borders[number]
        if border is not None:
            times = layout.records[number].times[rows]
            border.add_readings(by[..., size : size + border.size], times, layout.plain.border)
        if sensitivity.by_rates is not None:
            times = layout.records[number].times[rows]
            field, by_field = with_rates(times, field), with_rates(times, by_field)
        by = sensitivity.forward(by, by_field)
        if instruments := path.model.instruments(number):
            wrong = read_by([one for one, _ in instruments], t, field).read(layout.chain.levels)
            own = count - len(path.model.numbers)
            numbers = np.concatenate([np.arange(own + block.start, own + block.stop) for _, block in instruments])
            by[..., numbers] += np.moveaxis(wrong.by, 0, -1).reshape(rows.size, by.shape[1], -1)
        found.append(by)
    return np.concatenate(found)
