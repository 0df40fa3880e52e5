"""Score tests: how much each candidate would win, to first order, with everything else in the model free to follow.

What a force would do to the readings follows from what unit forces do within each interval between samples, constant
ones and ones that grow in time, and from the transitions along the motion; so that hundreds of candidates cost one
integration (Rao's score test; nuisance parameters are projected out).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.fitting import Fitted, by_pieces, normal, scaled_inverse, whitened
from latticebench.diagnosis.horizon import fields, propagate
from latticebench.diagnosis.model import Assembled, read_term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Numbers that are worked on at a time.
CHUNK = 4_000_000
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
        field, rate: as readings see them (rows, levels, parts, N).
        driven: the sites without an equation.
        assembled: the model.
        early, late: what a force does within an interval that falls from 1 to 0, or grows from 0 to 1 (pieces, m - 1,
            parts, M, S).
    """

    t: ndarray
    states: ndarray
    field: ndarray
    rate: ndarray
    driven: ndarray | None
    assembled: Assembled
    early: ndarray
    late: ndarray


class Tangent:
    """A fit with what unit forces at each site would do."""

    def __init__(self, fitted: Fitted) -> None:
        self.fitted = fitted
        layout, followed = fitted.layout, fitted.followed
        self.whitener, self.error, slope, self.robust = whitened(followed, fitted.noise, fitted.rows)
        self.along = [self._along(number) for number in range(len(layout.records))]
        solved = normal(layout, self.error, slope, followed.size, 0.0)
        size, left, free = followed.size, [], []
        self.local, self.inverse = [], []
        for by, error, inner in zip(solved.slope, solved.error, solved.inner, strict=True):
            local = by[:, :, :size]
            unit, divided = scaled_inverse(np.swapaxes(local, 1, 2) @ local, 0.0)
            self.local.append(local)
            self.inverse.append(divided / unit[:, :, None] / unit[:, None, :])
            free.append((by[:, :, size:] - local @ inner[:, :, :-1]).reshape(-1, inner.shape[2] - 1))
            left.append((error - (local @ inner[:, :, -1:])[..., 0]).ravel())
        self.left, self.free = np.concatenate(left), np.concatenate(free)
        self.basis = _orthonormal(self.free)
        self.terms: dict[tuple[int, str], ndarray] = {}

    def _along(self, number: int) -> _Along:
        layout, followed = self.fitted.layout, self.fitted.followed
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
        found = stretches.vary(coefficients, flat, layout.substeps[number], layout.splines[number])
        unit = found.by_coefficient[:, len(dynamics.terms) :]
        unit = unit.reshape(pieces, m - 1, chain.parts, 2, len(chain.moving), size)
        t = record.times[rows]
        h = np.diff(t, axis=1)[:, :, None, None, None]
        ramp = unit[:, :, :, 1] - t[:, :-1, None, None, None] * unit[:, :, :, 0]
        late = np.where(h > 0, ramp / np.where(h > 0, h, 1.0), 0.0)
        times, field, rate = fields(layout, number, y)
        driven = record.stretches.driven(times, layout.splines[number])
        seen = field[:, : chain.levels], rate[:, : chain.levels]
        return _Along(times, y.reshape(-1, size), *seen, driven, assembled, unit[:, :, :, 0] - late, late)

    def scored(self, candidates: Sequence[Placed]) -> list[Scored]:
        """Return all candidates with what they would win."""
        found: list[Scored] = []
        batch: list[Placed] = []
        count = 0
        for instrument in (False, True):
            for one in candidates:
                if one.instrument is instrument and one.linear:
                    batch.append(one)
                    count += len(one.numbers)
                if count * self.error.size > CHUNK:
                    found, batch, count = found + self._scored(batch), [], 0
        return found + (self._scored(batch) if batch else [])

    def standing_in(self, number: int, candidates: Sequence[Placed]) -> list[Scored]:
        """Return candidates with the share of what one effect of the model does that they could do in its place.

        The share takes the place of the gain; their numbers are those with which they do it.
        """
        placed, block = self.fitted.model.effects[number], self.fitted.model.blocks[number]
        strength = slice(block.start, block.start + len(placed.strength))
        others = np.delete(self.free, np.arange(block.start, block.stop), axis=1)
        left, basis = self.left, self.basis
        self.basis = _orthonormal(others)
        done = self.free[:, strength] @ np.array(placed.strength)
        self.left = done - self.basis @ (self.basis.T @ done)
        found = self.scored(candidates)
        whole = float(self.left @ self.left)
        self.left, self.basis = left, basis
        return [replace(one, gain=one.won / whole if whole > 0 else 0.0) for one in found]

    def columns(self, batch: Sequence[Placed]) -> Float[ndarray, "readings numbers"]:
        """Return what the numbers of effects do to the readings that nothing in the model does; forces first."""
        pieces = by_pieces(self.fitted.layout, self._whitened(batch))
        return self._new(pieces)

    def _whitened(self, batch: Sequence[Placed]) -> ndarray:
        flat = np.concatenate([self._columns(k, batch) for k in range(len(self.along))])
        return np.asarray(self.whitener.apply(flat) * self.robust[..., None])

    def _new(self, pieces: Sequence[ndarray]) -> ndarray:
        found = []
        for column, local, inverse in zip(pieces, self.local, self.inverse, strict=True):
            found.append(
                (column - local @ (inverse @ (np.swapaxes(local, 1, 2) @ column))).reshape(-1, column.shape[-1])
            )
        new = np.concatenate(found)
        return np.asarray(new - self.basis @ (self.basis.T @ new))

    def _scored(self, batch: Sequence[Placed]) -> list[Scored]:
        flat = self._whitened(batch)
        whole = np.linalg.norm(flat.reshape(-1, flat.shape[-1]), axis=0)
        new = self._new(by_pieces(self.fitted.layout, flat))
        total, count = float(np.sum(self.error**2)), float(np.sum(np.isfinite(self.fitted.followed.left)))
        found, begin = [], 0
        for one in batch:
            block = slice(begin, begin + len(one.numbers))
            begin = block.stop
            unit = np.where(whole[block] > 0, whole[block], 1.0)
            u, values, vt = np.linalg.svd(new[:, block] / unit, full_matrices=False)
            held = values > OLD
            projected = u[:, held].T @ self.left
            numbers = (vt[held].T @ (projected / values[held])) / unit
            won = float(projected @ projected)
            if one.effect.takes and numbers[0] > 0:
                won = 0.0
            taken = min(won, 0.999999 * total)
            gain = -0.5 * count * np.log1p(-taken / max(total, 1e-12 * count)) if taken > 0 else 0.0
            found.append(Scored(one.moved(one.numbers + numbers), float(gain), int(np.sum(held)), won))
        return found

    def _columns(self, number: int, batch: Sequence[Placed]) -> ndarray:
        """Return what the numbers of effects do to the readings of one recording: (rows, channels, numbers)."""
        layout, along = self.fitted.layout, self.along[number]
        chain, rows = layout.chain, layout.rows[number]
        blocks = []
        pushes = [self._push(number, one) for one in batch if not one.instrument]
        if pushes:
            push = np.concatenate(pushes).reshape(-1, *rows.shape, chain.parts, len(chain.moving))
            forced = np.einsum("cpjqn,pjqns->pjcs", push[:, :, :-1], along.early, optimize=True)
            forced += np.einsum("cpjqn,pjqns->pjcs", push[:, :, 1:], along.late, optimize=True)
            still = np.zeros((rows.shape[0], len(push), along.states.shape[1]))
            z = propagate(self.fitted.followed.transitions[number], forced, still).reshape(rows.size, len(push), -1)
            field = np.moveaxis(layout.plain.whole(z, None)[:, :, : chain.levels], 1, -1)
            blocks.append(field.reshape(rows.size, -1, len(push)) * self._own(number)[..., None])
        for one in batch:
            if one.instrument:
                by = one.misread(along.t, along.field, along.rate).by
                blocks.append(np.moveaxis(by.reshape(len(by), rows.size, -1), 0, -1))
        return np.concatenate(blocks, axis=-1)

    def _own(self, number: int) -> ndarray:
        begin = sum(rows.size for rows in self.fitted.layout.rows[:number])
        return self.fitted.followed.own[begin : begin + self.fitted.layout.rows[number].size]

    def _push(self, number: int, one: Placed) -> ndarray:
        """Return the forces of an effect's numbers along the motion: (numbers, rows, parts, M)."""
        layout, along = self.fitted.layout, self.along[number]
        chain, dynamics = layout.chain, along.assembled.dynamics
        push = np.zeros((len(one.numbers), len(along.t), chain.parts, len(chain.moving)))
        site = one.scaled()
        if site is not None:
            f = self._input(number)
            rate = dynamics.linear(
                along.assembled.coefficients, along.t, along.states, f, along.driven, derivatives=False
            )[0]  # fmt: skip
            index = chain.moving.index(site)
            push[0, :, :, index] = rate.reshape(len(along.t), chain.order, chain.parts, -1)[:, -1, :, index]
        for force in one.forces(chain):
            values = self._term(number, force.text)
            if force.weights is not None:
                values = values * force.weights[dynamics.moving]
            factor = force.factor_of(number)
            if factor is not None:
                whole = np.broadcast_to(factor(along.t), (chain.parts, len(along.t), chain.sites))
                values = values * np.moveaxis(whole[..., dynamics.moving], 0, 1)
            for k, value in force.by.items():
                push[k] += value * values
        return push

    def _input(self, number: int) -> ndarray | None:
        inputs = self.fitted.layout.records[number].stretches.inputs
        return None if inputs is None else inputs(self.along[number].t)

    def _term(self, number: int, text: str) -> ndarray:
        """Return the values of a term along the motion: (rows, parts, M)."""
        if (number, text) not in self.terms:
            along = self.along[number]
            base = along.assembled.dynamics
            alone = replace(base, terms=(read_term(text),), weights=None, factors=None, least_reach=base.reach)
            values = alone.linear(
                np.zeros(1), along.t, along.states, self._input(number), along.driven, derivatives=False
            )[1]  # fmt: skip
            self.terms[number, text] = np.moveaxis(values[:, 0], 0, 1)
        return self.terms[number, text]


def _orthonormal(columns: Float[ndarray, "readings numbers"]) -> Float[ndarray, "readings held"]:
    """Return an orthonormal basis of columns."""
    norm = np.linalg.norm(columns, axis=0)
    left, values, _ = np.linalg.svd(columns / np.where(norm > 0, norm, 1.0), full_matrices=False)
    return np.asarray(left[:, values > 1e-7 * max(float(np.max(values, initial=0.0)), 1e-300)])
