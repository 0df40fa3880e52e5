"""About how many nats influences with a frequency or a time would win, thousands of them at once.

The slope of the likelihood by a force follows from its adjoint along the motion, that by what is added to readings from
the readings alone. Its curvature is a mean square over
random directions in the space of readings (Hutchinson, Commun. Stat. Simul. Comput. 18, 1059 (1989)).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import betaincinv, gammaincinv

from latticebench.diagnosis import rules
from latticebench.diagnosis.acceleration import Acceleration
from latticebench.diagnosis.acting import Force, InStep, Placed
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.normal import by_pieces
from latticebench.diagnosis.propagation import propagate
from latticebench.diagnosis.score import Scored, Tangent, columns_of
from latticebench.diagnosis.walk_estimate import won_by_walking

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Candidates of a kind whose score is computed in full.
PROMISING = 12
# Random directions of readings that a force's curvature is estimated from, and directions of its numbers that are one.
DIRECTIONS, ALIKE = 24, 1e-3
# Seed of the directions: the same each time, so that a diagnosis is.
SIGNS = 0


def glanced(tangent: Tangent, candidates: Sequence[Placed]) -> Float[ndarray, " candidates"]:
    """Return about how many nats candidates would win, without what each of them would do to the readings."""
    ends = np.cumsum([0, *map(columns_of, candidates)])
    by = np.zeros((ends[-1], 1 + DIRECTIONS))
    for number, readings in enumerate(_looked(tangent)):
        _Pull(tangent, number, readings).add(candidates, ends, by)
    # What overflows along the motion wins nothing.
    by = np.where(np.isfinite(by), by, 0.0)
    size = np.linalg.norm(by[:, 1:], axis=1, keepdims=True)
    by /= np.where(size > 0, size, 1.0)
    won, count = np.zeros(len(candidates)), np.diff(ends)
    for columns in np.unique(count):
        alike = np.flatnonzero(count == columns)
        block = by[ends[alike][:, None] + np.arange(columns)]
        u, values, _ = np.linalg.svd(block[:, :, 1:], full_matrices=False)
        slopes = np.einsum("cnk,cn->ck", u, block[:, :, 0])
        held = values > ALIKE
        won[alike] = DIRECTIONS * np.sum(np.where(held, slopes / np.where(held, values, 1.0), 0.0) ** 2, axis=1)
    return tangent.gain(won)


def most_promising(
    tangent: Tangent, candidates: Sequence[Placed], price: Callable[[Placed], float], kind: Callable[[Placed], object]
) -> list[Placed]:
    """Return the few candidates of each kind that are likely to win most beyond their price."""
    gains = glanced(tangent, candidates)
    ranked = sorted(zip(gains, candidates, strict=True), key=lambda pair: price(pair[1]) - pair[0])
    kept: dict[object, list[Placed]] = {}
    for _, one in ranked:
        kept.setdefault(kind(one), []).append(one)
    return [one for few in kept.values() for one in few[:PROMISING]]


def crowding(tangent: Tangent, placed: Placed, candidates: Sequence[Placed]) -> float:
    """Return how many times as many nats as noise lets them those beside a candidate win, at least 1."""
    others = placed.beside(candidates)
    if len(others) < rules.FEW_AROUND:
        return 1.0
    usual = float(np.median(glanced(tangent.without(placed), others)))
    # The quantile of a chance that the median of so many reaches in noise.
    half = (len(others) + 1) / 2
    chance = float(betaincinv(half, half, rules.CROWDED))
    return max(1.0, usual / float(gammaincinv(len(placed.strength) / 2, chance)))


class _Pull:
    """Derivatives of what one recording leaves, and of random directions, by the numbers of effects."""

    def __init__(self, tangent: Tangent, number: int, readings: ndarray) -> None:
        self.tangent, self.number = tangent, number
        self.t, self.chain = tangent.along[number].t, tangent.fitted.chain
        chain = self.chain
        self.dual = _dual(tangent, number, *tangent.sensitivity(number).back(readings))
        self.readings = readings.reshape(len(self.t), chain.levels, chain.parts, chain.sites, -1)[:, 0]
        self.courses: dict[InStep | None, ndarray] = {}

    def add(self, candidates: Sequence[Placed], ends: ndarray, by: ndarray) -> None:
        """Add those of all effects to their rows (numbers, 1 + D).

        What is one course in time at the same sites is taken together.
        """
        together: dict[tuple[bool, str, bytes], list[tuple[Force, InStep | None, int]]] = {}
        for one, begin, end in zip(candidates, ends, ends[1:], strict=False):
            if not one.acts_in(self.number):
                continue
            forces = [(force, force.factor) for force in (*one.forces(self.chain), *one.courses(self.chain))]
            in_step = [(force, factor, begin) for force, factor in forces if isinstance(factor, InStep | None)]
            if one.scaled() is not None or one.other_ends() is not None or len(in_step) < len(forces):
                by[begin:end] += self.tangent.push(self.number, one).reshape(end - begin, -1) @ self.dual
                continue
            for each in in_step:
                weights = b"" if each[0].weights is None else each[0].weights.tobytes()
                together.setdefault((one.instrument, each[0].text, weights), []).append(each)
        for (instrument, *_), same in together.items():
            courses = np.stack([self._course(factor) for _, factor, _ in same])
            pulled = courses @ (self._added_in_time if instrument else self._in_time)(same[0][0])
            for (force, _, begin), value in zip(same, pulled, strict=True):
                for k, share in force.by.items():
                    by[begin + k] += share * value

    def _course(self, factor: InStep | None) -> ndarray:
        """Return a factor that is the same at all sites, at each time: (rows,)."""
        if factor not in self.courses:
            self.courses[factor] = np.ones(len(self.t)) if factor is None else factor(self.t)[0, :, 0]
        return self.courses[factor]

    def _in_time(self, force: Force) -> ndarray:
        """Return derivatives by a force's factor at each time: (rows, 1 + D)."""
        values = self.tangent.term(self.number, force.text)
        if force.weights is not None:
            values = values * force.weights[list(self.chain.moving)]
        return np.asarray(np.einsum("rqn,rqnk->rk", values, self.dual.reshape(*values.shape, -1), optimize=True))

    def _added_in_time(self, force: Force) -> ndarray:
        """Return derivatives by the factor of what is added to readings of u at each time: (rows, 1 + D)."""
        weights = np.ones(self.chain.sites) if force.weights is None else force.weights
        if force.text in ("u[n]", "v[n]"):
            read = self.tangent.along[self.number].field[:, int(force.text == "v[n]")] * weights
            return np.asarray(np.einsum("rqn,rqnk->rk", read, self.readings))
        return np.asarray(np.einsum("n,rnk->rk", weights, self.readings[:, int(force.text.startswith("i*"))]))


def _looked(tangent: Tangent) -> list[ndarray]:
    """Return what is left, and random directions, by the readings of each recording: (rows, channels, 1 + D)."""
    layout, shape = tangent.fitted.layout, tangent.error.shape
    signs = np.random.default_rng(SIGNS).choice([-1.0, 1.0], (*shape, DIRECTIONS))
    looked = np.concatenate([tangent.left[:, None], tangent.new(by_pieces(layout, signs))], axis=1)
    readings = tangent.whitener.transposed(looked.reshape(*shape, -1) * tangent.robust[..., None])
    ends = np.cumsum([rows.size for rows in layout.rows])
    return np.split(readings, ends[:-1])


def _dual(tangent: Tangent, number: int, readings: ndarray, rates: ndarray | None) -> ndarray:
    """Return derivatives by forces from those by the readings' fields (rows, channels, 1 + D) and by rates."""
    layout, along, chain = tangent.fitted.layout, tangent.along[number], tangent.fitted.chain
    (pieces, m), count = layout.rows[number].shape, readings.shape[-1]
    fields = readings.reshape(pieces, m, chain.levels, chain.parts, chain.sites, count)[..., layout.plain.moving, :]
    by_state = np.zeros((pieces, m, count, chain.order, *fields.shape[3:5]))
    by_state[:, :, :, : chain.levels] = np.moveaxis(fields, -1, 2)
    if rates is not None:
        moving = rates.reshape(pieces, m, 2, chain.parts, chain.sites, count)[..., layout.plain.moving, :]
        by_v, by_a = np.moveaxis(moving, (2, -1), (0, 3))
        times = layout.records[number].times[layout.rows[number]]
        for level, one in enumerate(Acceleration.along(times).back(by_a)):
            by_state[:, :, :, level] += one
        by_state[:, :, :, 1] += by_v
    by_state = by_state.reshape(pieces, m, count, -1)
    unread = np.zeros((pieces, m, count, along.states.shape[1] - layout.plain.read))
    by_state = np.concatenate([by_state, unread], axis=-1)
    back = np.swapaxes(tangent.followed.transitions[number][:, ::-1], 2, 3)
    carried = propagate(back, by_state[:, -2::-1], by_state[:, -1])[:, ::-1]
    dual = np.zeros((pieces, m, chain.parts, len(chain.moving), count))
    dual[:, :-1] += np.einsum("pjqns,pjks->pjqnk", along.early, carried[:, 1:], optimize=True)
    dual[:, 1:] += np.einsum("pjqns,pjks->pjqnk", along.late, carried[:, 1:], optimize=True)
    return dual.reshape(-1, count)


def restless(fitted: Fitted, candidates: Sequence[Placed]) -> list[Scored]:
    """Return what zeros that wander would win, by what is left at their sensors."""
    every = {site: one for one in candidates if (site := one.wandering()) is not None}
    absent = {site: one for site, one in every.items() if site not in fitted.rows.walking}
    followed = fitted.followed
    gains = won_by_walking(fitted.noise, followed.left, followed.swing, fitted.rows, absent)
    return [Scored(one, float(gain), 1, 2 * float(gain)) for one, gain in zip(absent.values(), gains, strict=True)]
