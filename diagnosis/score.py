"""Score tests: how much each candidate would win, to first order, with everything else in the model free to follow.

What a force would do to the readings follows from what unit forces do within each interval between samples, constant
ones and ones that grow in time, and from the transitions along the motion; so that hundreds of candidates cost one
integration (Rao's score test; nuisance parameters are projected out).
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acceleration import with_rates
from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.fitting import Fitted, gain, left_free, whitened
from latticebench.diagnosis.horizon import fields
from latticebench.diagnosis.model import Assembled, Model, read_term
from latticebench.diagnosis.normal import by_pieces, normal, scaled_inverse
from latticebench.diagnosis.propagation import propagate
from latticebench.diagnosis.reading import Sensitivity, seen_by

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.dynamics import Dynamics
    from latticebench.systems.terms import Term

# Numbers that are worked on at a time.
CHUNK = 2_000_000
# Directions that the model can do already, as a share of what a candidate does.
OLD = 1e-4


@dataclass(frozen=True, eq=False)
class Scored:
    """A candidate with what it would win.

    Attributes:
        placed: the effect, with the numbers that the linearised fit gives it.
        gain: nats, to first order.
        freedom: how many of its numbers do something new.
        won: by how much the sum of squares of what is left falls, in units of the noise.
    """

    placed: Placed
    gain: float
    freedom: int
    won: float


@dataclass(frozen=True, eq=False)
class _Along:
    """One recording along the fitted motion.

    Attributes:
        t: times (rows,).
        states: (rows, S).
        field: the motion as it was when it was read and, of order 2, the rate of v (rows, levels, parts, N).
        driven: the sites without an equation.
        assembled: the model.
        early, late: what a force does within an interval that falls from 1 to 0, or grows from 0 to 1 (pieces, m - 1,
            parts, M, S).
    """

    t: ndarray
    states: ndarray
    field: ndarray
    driven: ndarray | None
    assembled: Assembled
    early: ndarray
    late: ndarray


@dataclass(frozen=True, eq=False)
class _Responses:
    """What the numbers of candidates do to the readings, in units of their noise.

    Attributes:
        of: which candidates.
        whole: sizes of all they do.
        columns: of it, what initial states cannot do (readings, numbers).
    """

    of: tuple[Placed, ...]
    whole: ndarray
    columns: ndarray


class Tangent:
    """A fit with what unit forces at each site would do."""

    def __init__(self, fitted: Fitted) -> None:
        self.fitted = fitted
        layout, self.followed = fitted.layout, fitted.linearised()
        followed = self.followed
        self.whitener, self.error, slope, self.robust = whitened(followed, fitted.noise, fitted.rows)
        self.along = [self._along(number) for number in range(len(layout.records))]
        self.solved = normal(layout, self.error, slope, followed.local, 0.0)
        size, left, free, self.local, self.inverse = followed.local, [], [], [], []
        for by, error, inner in zip(self.solved.slope, self.solved.error, self.solved.inner, strict=True):
            local = by[:, :, :size]
            unit, divided = scaled_inverse(np.swapaxes(local, 1, 2) @ local, 0.0)
            self.local.append(local)
            self.inverse.append(divided / unit[:, :, None] / unit[:, None, :])
            free.append((by[:, :, size:] - local @ inner[:, :, :-1]).reshape(-1, inner.shape[2] - 1))
            left.append((error - (local @ inner[:, :, -1:])[..., 0]).ravel())
        self.left, self.free = np.concatenate(left), np.concatenate(free)
        self.basis = _orthonormal(self.free)
        whole = np.broadcast_to(fitted.rows.sensor, self.error.shape)
        self._sensor = np.concatenate([one.ravel() for one in by_pieces(layout, whole)])
        read = np.isfinite(followed.left)
        self._read = np.concatenate([one.ravel() for one in by_pieces(layout, read)])
        # Of the effects that it is in the place of: by how much the sum of squares grows without them.
        self.taken = 0.0
        self._kept: list[_Responses] = []
        self.terms: dict[tuple[int, str], ndarray] = {}
        self.evaluators: dict[tuple[int, tuple[int, int]], Callable[[Term], ndarray]] = {}

    def _along(self, number: int) -> _Along:
        layout, followed = self.fitted.layout, self.followed
        chain, rows = layout.chain, layout.rows[number]
        assembled = followed.model.assembled(layout.plain, chain, number)
        dynamics, record = assembled.dynamics, layout.records[number]
        pushed = [
            (f"{unit}{clock}", site)
            for unit in ("1", "i")[: chain.parts]
            for clock in ("", "*t")
            for site in chain.moving
        ]
        own = np.ones((len(dynamics.terms), chain.sites)) if dynamics.weights is None else dynamics.weights
        wide = replace(
            dynamics, terms=(*dynamics.terms, *(read_term(text) for text, _ in pushed)),
            weights=np.concatenate([own, np.eye(chain.sites)[[site for _, site in pushed]]]),
            factors=None if dynamics.factors is None else (*dynamics.factors, *(None,) * len(pushed)),
        )  # fmt: skip
        coefficients = np.concatenate([assembled.coefficients, np.zeros(len(pushed))])
        y = followed.nodes[number]
        pieces, m, size = y.shape
        stretches = replace(layout.stretches(number, assembled), dynamics=wide)
        flat = y[:, :-1].reshape(-1, size)
        found = stretches.vary(coefficients, flat, layout.rounds(number), followed.splines[number], dense=True)
        unit = found.by_coefficient[:, len(dynamics.terms) :][:, : len(pushed)]
        unit = unit.reshape(pieces, m - 1, chain.parts, 2, len(chain.moving), size)
        t = record.times[rows]
        h = np.diff(t, axis=1)[:, :, None, None, None]
        ramp = unit[:, :, :, 1] - t[:, :-1, None, None, None] * unit[:, :, :, 0]
        late = np.where(h > 0, ramp / np.where(h > 0, h, 1.0), 0.0)
        times, field = fields(layout, number, y, followed.splines[number])
        instruments = [one for one, _ in followed.model.instruments(number)]
        field = seen_by(instruments, times, with_rates(t, field))
        driven = layout.driven(number, followed.splines[number])
        return _Along(times, y.reshape(-1, size), field, driven, assembled, unit[:, :, :, 0] - late, late)

    def scored(self, candidates: Sequence[Placed]) -> list[Scored]:
        """Return all candidates with what they would win."""
        return [one for batch in self.batches(candidates) for one in self.scored_at_once(batch)]

    def batches(self, candidates: Sequence[Placed]) -> Iterator[list[Placed]]:
        """Yield as many candidates as are worked on at a time, those that act on the motion first."""
        batch: list[Placed] = []
        columns = 0
        for one in sorted(candidates, key=lambda one: one.instrument):
            batch.append(one)
            columns += columns_of(one)
            if columns * self.error.size > CHUNK:
                yield batch
                batch, columns = [], 0
        if batch:
            yield batch

    def in_place_of(self, numbers: Sequence[int]) -> Tangent:
        """Return the tangent of a model without some effects of this one, what they did being left of the readings."""
        model, kept = self.fitted.model, np.ones(self.free.shape[1], dtype=bool)
        done = np.zeros(len(self.free))
        for number in numbers:
            block, strength = model.blocks[number], np.array(model.effects[number].strength)
            kept[block] = False
            done += self.free[:, block.start : block.start + len(strength)] @ strength
        basis = _orthonormal(self.free[:, kept])
        own = done - basis @ (basis.T @ done)
        return self._other(self.left + own, basis, float(own @ own))

    def _other(self, left: ndarray, basis: ndarray, taken: float = 0.0) -> Tangent:
        other = copy.copy(self)
        other.left, other.basis, other.taken = left, basis, taken
        return other

    def without(self, placed: Placed) -> Tangent:
        """Return the tangent of what is left when an effect has done all that it can do."""
        # A line has wings.
        basis = _orthonormal(np.concatenate([self.free, self._responses([placed]).columns], axis=1))
        return self._other(self.left - basis @ (basis.T @ self.left), basis)

    def start(
        self, placed: Placed, dropped: Sequence[int] = ()
    ) -> tuple[Model, list[Float[ndarray, "pieces m state"]]]:
        """Return a model with one more effect and states near its motion, to first order in the effect's strengths.

        Args:
            placed: the effect with its numbers.
            dropped: the numbers of those effects of the model that it takes the place of.
        """
        model, layout = self.fitted.model, self.fitted.layout
        change, kept = np.zeros(self.free.shape[1]), np.ones(self.free.shape[1], dtype=bool)
        for number in dropped:
            block, gone = model.blocks[number], model.effects[number].strength
            kept[block] = False
            change[block.start : block.start + len(gone)] = -np.array(gone)
        own = np.concatenate([placed.strength, np.zeros(len(placed.shape))]) if placed.count else np.ones(1)
        pushed = [column @ own for column in by_pieces(layout, self._whitened([placed]))]
        target = self.left - self.free @ change - self._moving_on([one[..., None] for one in pushed])[:, 0]
        others = self.free[:, kept]
        size = np.linalg.norm(others, axis=0)
        size[size == 0] = 1.0
        change[kept] += np.linalg.lstsq(others / size, target, rcond=1e-5)[0] / size
        near = []
        for number, (local, inverse, push) in enumerate(zip(self.local, self.inverse, pushed, strict=True)):
            error = self.solved.error[number] - self.solved.slope[number][:, :, local.shape[2] :] @ change - push
            states = (inverse @ (np.swapaxes(local, 1, 2) @ error[..., None]))[..., 0]
            varied = np.concatenate([states, np.broadcast_to(change, (len(states), len(change)))], axis=1)
            nodes, moves = self.followed.nodes[number], self.followed.moves[number]
            near.append(nodes + (varied[:, None, None] @ moves)[:, :, 0])
            if not placed.instrument:
                near[-1] += (own @ self._moved(number, [placed])).reshape(nodes.shape)
            hanging = [one.resonator(layout.chain) for one in (placed, *(model.effects[k] for k in dropped))]
            if dropped and any(hanging):
                # What is not read is another one.
                near[-1] = near[-1][..., : layout.plain.read]
        moved = model.moved(model.numbers + change)
        for number in sorted(dropped, reverse=True):
            moved = moved.without(number)
        return moved.with_effect(placed), near

    def _whitened(self, batch: Sequence[Placed]) -> ndarray:
        flat = np.concatenate([self._columns(k, batch) for k in range(len(self.along))])
        return np.asarray(self.whitener.apply(flat) * self.robust[..., None])

    def _responses(self, batch: Sequence[Placed]) -> _Responses:
        """Return what numbers of effects do to the readings; those of the last candidates are kept."""
        known = tuple(batch)
        if not self._kept or self._kept[0].of != known:
            flat = self._whitened(batch)
            whole = np.linalg.norm(flat.reshape(-1, flat.shape[-1]), axis=0)
            columns = self._moving_on(by_pieces(self.fitted.layout, flat))
            # What overflows along the motion wins nothing.
            sound = np.isfinite(whole) & np.isfinite(columns).all(axis=0)
            # In the list that tangents in the place of effects share.
            self._kept[:] = [_Responses(known, np.where(sound, whole, 0.0), np.where(sound, columns, 0.0))]
        return self._kept[0]

    def _moving_on(self, pieces: Sequence[ndarray]) -> ndarray:
        """Return what columns do to the readings that initial states cannot do."""
        parts = zip(pieces, self.local, self.inverse, strict=True)
        found = [one - local @ (inverse @ (np.swapaxes(local, 1, 2) @ one)) for one, local, inverse in parts]
        return np.concatenate([one.reshape(-1, one.shape[-1]) for one in found])

    def new(self, pieces: Sequence[ndarray]) -> ndarray:
        """Return what columns do to the readings that nothing in the model can do."""
        new = self._moving_on(pieces)
        return np.asarray(new - self.basis @ (self.basis.T @ new))

    def scored_at_once(self, batch: Sequence[Placed]) -> list[Scored]:
        """Return a few candidates with what they would win."""
        seen = self._responses(batch)
        unit = np.where(seen.whole > 0, seen.whole, 1.0)
        shared = (self.basis.T @ seen.columns) / unit
        slopes = (seen.columns.T @ self.left) / unit - shared.T @ (self.basis.T @ self.left)
        found, begin = [], 0
        does = np.zeros((len(self.left), len(batch)))
        can = np.zeros((self.basis.shape[1], len(batch)))
        for k, one in enumerate(batch):
            block = slice(begin, begin + columns_of(one))
            begin = block.stop
            part = seen.columns[:, block] / unit[block]
            curved = part.T @ part - shared[:, block].T @ shared[:, block]
            if not one.count:
                numbers, freedom = unit[block], 1
                won = float((2 * slopes[block] * numbers - np.diag(curved) * numbers**2)[0])
            else:
                values, vectors = np.linalg.eigh(curved)
                held = values > OLD**2
                projected = vectors[:, held].T @ slopes[block]
                numbers, freedom = vectors[:, held] @ (projected / values[held]), int(np.sum(held))
                won = float(np.sum(projected**2 / values[held]))
                if (one.effect.takes and numbers[0] > 0) or (one.positive and numbers[0] < 0):
                    won, numbers = 0.0, 0 * numbers
                one = one.moved(one.numbers + numbers / unit[block])
            does[:, k], can[:, k] = part @ numbers, shared[:, block] @ numbers
            found.append(Scored(one, 0.0, freedom, won))
        gains = self._gains(does - self.basis @ can)
        return [replace(one, gain=value if one.won > 0 else 0.0) for one, value in zip(found, gains, strict=True)]

    def _gains(self, does: Float[ndarray, "readings candidates"]) -> list[float]:
        """Return the nats that candidates win which do so much to the readings, the size of the noise being free."""
        alike = not self.fitted.noise.structure.own_sizes
        sensor = np.zeros_like(self._sensor) if alike else self._sensor
        gains = np.zeros(does.shape[1])
        for number in range(int(np.max(sensor)) + 1):
            here = sensor == number
            total, taken = float(np.sum(self.left[here] ** 2)), self.fitted.curved
            count = left_free(float(np.sum(self._read[here])), taken if alike else taken[number])
            after = np.sum((self.left[here, None] - does[here]) ** 2, axis=0)
            gains += gain(total, after, count, self.fitted.least[number]) if count else 0.0
        return [float(one) for one in gains]

    def gain(self, won: Float[ndarray, " candidates"]) -> Float[ndarray, " candidates"]:
        """Return the nats that so much of the sum of squares is worth, the size of the noise being free."""
        total, count = float(np.sum(self.error**2)), left_free(float(np.sum(self._read)), self.fitted.curved)
        return gain(total, total - won, count, float(np.min(self.fitted.least)))

    def _columns(self, number: int, batch: Sequence[Placed]) -> ndarray:
        """Return what the numbers of effects do to the readings of one recording: (rows, channels, numbers)."""
        layout, along = self.fitted.layout, self.along[number]
        chain, rows = layout.chain, layout.rows[number]
        blocks = []
        forces = [one for one in batch if not one.instrument]
        if forces:
            z = self._moved(number, forces)
            field, sensitivity = layout.plain.whole(z, None), self.sensitivity(number)
            by = field[:, :, : chain.levels]
            if sensitivity.by_rates is not None:
                field = with_rates(layout.records[number].times[rows], field)
            blocks.append(sensitivity.forward(np.moveaxis(by, 1, -1), field))
        for one in batch:
            if one.instrument:
                by = one.misread(along.t, along.field).read(chain.levels).by
                by = by if one.acts_in(number) else np.zeros_like(by)
                blocks.append(np.moveaxis(by.reshape(len(by), rows.size, -1), 0, -1))
        return np.concatenate(blocks, axis=-1)

    def _moved(self, number: int, forces: Sequence[Placed]) -> ndarray:
        """Return what the numbers of forces do to the states of one recording: (rows, numbers, S)."""
        layout, along = self.fitted.layout, self.along[number]
        chain, rows = layout.chain, layout.rows[number]
        pushes = [self.push(number, one) for one in forces]
        push = np.concatenate(pushes).reshape(-1, *rows.shape, chain.parts, len(chain.moving))
        forced = np.einsum("cpjqn,pjqns->pjcs", push[:, :, :-1], along.early, optimize=True)
        forced += np.einsum("cpjqn,pjqns->pjcs", push[:, :, 1:], along.late, optimize=True)
        still = np.zeros((rows.shape[0], len(push), along.states.shape[1]))
        z = propagate(self.followed.transitions[number], forced, still)
        return z.reshape(rows.size, len(push), -1)

    def sensitivity(self, number: int) -> Sensitivity:
        """Return the derivatives of one recording's readings by the motion."""
        begin = sum(rows.size for rows in self.fitted.layout.rows[:number])
        return self.fitted.followed.sensitivity.at(slice(begin, begin + self.fitted.layout.rows[number].size))

    def push(self, number: int, one: Placed) -> ndarray:
        """Return the forces of an effect's numbers, or of one without any, along the motion: (., rows, parts, M)."""
        layout, along = self.fitted.layout, self.along[number]
        chain, dynamics = layout.chain, along.assembled.dynamics
        push = np.zeros((columns_of(one), len(along.t), chain.parts, len(chain.moving)))
        site, ends = one.scaled(), one.other_ends()
        if site is not None:
            index = chain.moving.index(site)
            push[0, :, :, index] = self._rate(number, replace(dynamics, resonators=()))[..., index]
        if ends is not None:
            push[0] = self._rate(number, replace(dynamics, ends=ends)) - self._rate(number, dynamics)
        for force in one.forces(chain):
            values = self.term(number, force.text)
            if force.weights is not None:
                values = values * force.weights[dynamics.moving]
            factor = force.factor_of(number)
            if factor is not None:
                whole = np.broadcast_to(factor(along.t), (chain.parts, len(along.t), chain.sites))
                values = values * np.moveaxis(whole[..., dynamics.moving], 0, 1)
            for k, value in force.by.items():
                push[k] += value * values
        return push

    def _rate(self, number: int, dynamics: Dynamics) -> ndarray:
        """Return the highest time derivative that an equation gives along the motion: (rows, parts, M)."""
        along, chain = self.along[number], self.fitted.chain
        rate = dynamics.linear(
            along.assembled.coefficients, along.t, along.states, self._input(number), along.driven, derivatives=False
        )[0]
        rate = rate[:, : dynamics.read].reshape(len(along.t), chain.order, chain.parts, -1)
        return np.asarray(rate[:, -1])

    def _input(self, number: int) -> ndarray | None:
        inputs = self.fitted.layout.records[number].stretches.inputs
        return None if inputs is None else inputs(self.along[number].t)

    def term(self, number: int, text: str) -> ndarray:
        """Return the values of a term along the motion: (rows, parts, M)."""
        if (number, text) not in self.terms:
            term = read_term(text)
            self.terms[number, text] = self._evaluator(number, term.reach)(term)
        return self.terms[number, text]

    def _evaluator(self, number: int, reach: tuple[int, int]) -> Callable[[Term], ndarray]:
        """Return what evaluates terms of a reach along the motion."""
        if (number, reach) not in self.evaluators:
            along = self.along[number]
            base = along.assembled.dynamics
            left, right = (max(pair) for pair in zip(base.reach, reach, strict=True))
            wide = replace(base, least_reach=(left, right))
            self.evaluators[number, reach] = wide.evaluator(along.t, along.states, self._input(number), along.driven)
        return self.evaluators[number, reach]


def columns_of(one: Placed) -> int:
    """Return how many columns an effect has: one per number, or one for what it does without any."""
    return max(one.count, 1)


def _orthonormal(columns: Float[ndarray, "readings numbers"]) -> Float[ndarray, "readings held"]:
    """Return an orthonormal basis of columns, but for those that overflow."""
    norm = np.linalg.norm(columns, axis=0)
    columns = np.where(np.isfinite(norm), columns, 0.0)
    left, values, _ = np.linalg.svd(columns / np.where((norm > 0) & np.isfinite(norm), norm, 1.0), full_matrices=False)
    return np.asarray(left[:, values > 1e-7 * max(float(np.max(values, initial=0.0)), 1e-300)])
