"""What can be seen of an effect on readings beside all that is unknown in a declared equation.

The unknowns are the declared coefficients and the state at the first time; the size of the noise is known. Their
sensitivities are chained from one sample time to the next:

    Z_{k+1} = Z_k dy_{k+1}/dy_k + (what acts within the stretch),

where each row of Z_k is what one unknown does to the state at t_k. An effect that is not small is what the declared
equation leaves of clean readings when it is fitted to them, by Gauss and Newton's method with the state at every sample
time as a start of its own (lifted: Albersmeyer & Diehl, SIAM J. Optim. 20, 1655 (2010)).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.trials.faults.setting import Fields
from latticebench.bench.trials.information import beside, explained
from latticebench.diagnosis.acting import Chain, Force, Placed, Scene, way_of
from latticebench.diagnosis.acting.scene import Course
from latticebench.methods.engine.dynamics import Dynamics, split_parts
from latticebench.methods.engine.sensitivity import Stretches, Transition
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import System
from latticebench.systems.motion import Motion
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

# Of the integration, in units of the noise; of a fit, likewise, and the steps that it may take.
TOLERANCE, SETTLED, STEPS = 1e-5, 1e-2, 15
# Points of Gauss's rule within a stretch of motion.
POINTS = 3
# A motion that goes so far, in units of the noise, is unbounded.
UNBOUNDED = 1e50
# What is left of an effect is rounding where it is less than this share of the whole.
NOTHING = 1e-6


@dataclass(frozen=True, eq=False)
class Line:
    """The declared equation linearised about states at the sample times.

    Attributes:
        coefficients: declared ones.
        nodes: the states.
        transition: from each sample time to the next.
        known: what the unknowns do to the readings, in units of the noise (unknowns, rows); the state at the first time
            comes before the coefficients.
        left: what readings have beyond the states, likewise, and beyond what carries these to one motion (rows,).
        drift: the latter, as states (T, S).
        moves: what the unknowns do to the states (T, unknowns, S).
    """

    coefficients: Float[ndarray, " terms"]
    nodes: Float[ndarray, "time state"]
    transition: Transition
    known: Float[ndarray, "unknowns rows"]
    left: Float[ndarray, " rows"]
    drift: Float[ndarray, "time state"]
    moves: Float[ndarray, "time unknowns state"]

    @property
    def size(self) -> float:
        """The length of what the unknowns leave, in units of the noise."""
        return self.explained[0]

    @functools.cached_property
    def explained(self) -> tuple[float, ndarray]:
        """That length, and the amounts of the unknowns."""
        return _last_beside_others(np.concatenate([self.known, self.left[None]]))


@dataclass(frozen=True, eq=False)
class Sight:
    """What can be seen of effects on readings.

    Attributes:
        plain: the clean readings without an effect.
        dynamics: the declared equation.
        coefficients: its true ones.
        times: of the samples (T,).
        sizes: standard deviations of the noise on u and, where it is read, on v.
    """

    plain: Fields
    dynamics: Dynamics
    coefficients: Float[ndarray, " terms"]
    times: Float[ndarray, " time"]
    sizes: tuple[float, ...]

    @classmethod
    def of(cls, system: System, plain: Fields, times: ndarray, sizes: Sequence[float], chain: Motion) -> Sight:
        """Return the sight of a system's declared equation, at its true coefficients."""
        declared = system.library("equation")
        truth = system.truth(declared, {})
        assert truth is not None
        dynamics = Dynamics(declared.terms, chain.order, chain.is_complex, chain.sites, chain.ends)
        return cls(plain, dynamics, truth, times, tuple(sizes))

    def size(self, found: Fields) -> float:
        """Return the size of a small effect over the smallest standard error that it could be known with."""
        rows = np.concatenate([self._truth.known, self._rows(self._nodes(found) - self._nodes(self.plain))[None]])
        left = _last_beside_others(rows)[0]
        return left if left > NOTHING * float(np.linalg.norm(rows[-1])) else 0.0

    def fitted(self, found: Fields) -> Line:
        """Return the declared equation linearised about its fit to clean readings.

        Its size is that of an effect that need not be small.

        Raises:
            InputError: there is no such fit.
        """
        line = self._line(self.coefficients, self._nodes(found), found)
        for _ in range(STEPS):
            change = line.explained[1]
            count = self.dynamics.size
            nodes = line.nodes + line.drift + np.einsum("p,kps->ks", change, line.moves)
            line = self._line(line.coefficients + change[count:], nodes, found)
            if np.linalg.norm(self._rows(line.drift)) < SETTLED * max(line.size, 1.0):
                break
        return line

    def apart(self, line: Line) -> float:
        """Return what the nearest single effect of the catalogue, of any amount, leaves of what a fit leaves.

        Effects with a coefficient for every site come near anything and are not counted.
        """
        blocks = list(self._candidates(line))
        rows = np.concatenate([line.known, *blocks, line.left[None]])
        information = beside(rows @ rows.T, np.arange(len(line.known)))
        first, last = 0, np.eye(len(information))[-1]
        found_left = [line.size]
        for block in blocks:
            places = first + np.arange(len(block))
            found_left.append(explained(information, last, places)[0])
            first += len(block)
        return min(found_left)

    @functools.cached_property
    def _stretches(self) -> Stretches:
        return Stretches(self.dynamics, self.times[:-1], self.times[1:])

    @functools.cached_property
    def _substeps(self) -> Int[ndarray, " stretch"]:
        tolerance = TOLERANCE * min(self.sizes)
        return self._stretches.substeps(self.coefficients, self._nodes(self.plain)[:-1], tolerance)

    @functools.cached_property
    def _truth(self) -> Line:
        return self._line(self.coefficients, self._nodes(self.plain), self.plain)

    def _nodes(self, fields: Fields) -> Float[ndarray, "time state"]:
        return self.dynamics.pack(*fields)

    def _rows(self, states: Float[ndarray, "time *columns state"]) -> Float[ndarray, "*columns rows"]:
        """Return readings of states in units of the noise, those of one column in a row."""
        dynamics, levels = self.dynamics, len(self.sizes)
        fields = states.reshape(*states.shape[:-1], dynamics.order, dynamics.parts, dynamics.sites)
        fields = fields[..., :levels, :, :] / np.array(self.sizes)[:, None, None]
        return np.asarray(np.moveaxis(fields, 0, -4).reshape(*states.shape[1:-1], -1))

    def _line(self, coefficients: ndarray, nodes: ndarray, found: Fields) -> Line:
        """Return the equation linearised about states, beside clean readings.

        Raises:
            InputError: the motion is unbounded.
        """
        size = self.dynamics.size
        start = np.concatenate([np.eye(size), np.zeros((len(coefficients), size))])
        with np.errstate(all="ignore"):
            transition = self._stretches.vary(coefficients, nodes[:-1], self._substeps)
            terms = np.concatenate([np.zeros((len(nodes) - 1, size, size)), transition.by_coefficient], axis=1)
            moves = _chained(transition, start, terms)
            drift = _chained(transition, np.zeros((1, size)), (transition.end - nodes[1:])[:, None])[:, 0]
            known, left = self._rows(moves), self._rows(self._nodes(found) - nodes - drift)
        # Of NaN neither is true.
        if not (np.max(np.abs(known)) < UNBOUNDED and np.max(np.abs(left)) < UNBOUNDED):
            raise InputError("the declared equation cannot be fitted to the readings: the motion is unbounded")
        return Line(coefficients, nodes, transition, known, left, drift, moves)

    def _candidates(self, line: Line) -> Iterator[Float[ndarray, "strengths rows"]]:
        """Return what each effect of the catalogue in each place would do to the readings, to first order."""
        dynamics, levels = self.dynamics, len(self.sizes)
        every = tuple(range(dynamics.sites))
        chain = Chain(
            dynamics.sites, dynamics.order, dynamics.is_complex, levels, dynamics.ends, every, dynamics.sites - 1
        )
        scene = self._scene(chain, line)
        field = dynamics.whole(line.nodes, None)
        every_place = (one for effect in CATALOGUE for one in way_of(effect).places(effect, scene))
        # What a zero that wanders does cannot be foreseen.
        foreseen = (one for one in every_place if one.wandering() is None)
        placed = [one for one in foreseen if len(one.strength) < chain.sites - 1]
        pushing = []
        for one in placed:
            if one.instrument:
                by = one.misread(self.times, field).read(levels).by[: len(one.strength)]
                yield self._rows(np.moveaxis(self._full(by), 1, 0))
            elif (ends := one.other_ends()) is not None:
                other = replace(self._stretches, dynamics=replace(dynamics, ends=ends))
                moved = other.run(line.coefficients, line.nodes[:-1], self._substeps)
                yield self._pushed(line, (moved - line.transition.end)[:, None])
            else:
                pushing.append(one)
        yield from self._forced(line, pushing, chain)

    def _full(self, levels: Float[ndarray, "numbers time levels parts sites"]) -> ndarray:
        """Return readings as states, with zeros for a level that is not read."""
        missing = self.dynamics.order - levels.shape[2]
        return np.pad(levels, [(0, 0), (0, 0), (0, missing), (0, 0), (0, 0)]).reshape(*levels.shape[:2], -1)

    def _forced(self, line: Line, placed: Sequence[Placed], chain: Chain) -> Iterator[ndarray]:
        """Return what effects do that add terms to the right-hand side."""
        declared = self.dynamics.terms
        forces = [self._forces(one, line, chain) for one in placed]
        every = [force for some in forces for force in some]
        ones = np.ones(chain.sites)
        dynamics = replace(
            self.dynamics,
            terms=(*declared, *(Term(force.text) for force in every)),
            weights=np.stack([ones] * len(declared) + [ones if one.weights is None else one.weights for one in every]),
            factors=(*[None] * len(declared), *(force.factor_of(0) for force in every)),
        )
        moved = self._pushed(line, self._acting(line, dynamics)[:, len(declared) :])
        first = 0
        for one, some in zip(placed, forces, strict=True):
            by = np.array([[force.by.get(k, 0.0) for force in some] for k in range(len(one.strength))])
            yield by @ moved[first : first + len(some)]
            first += len(some)

    def _acting(self, line: Line, dynamics: Dynamics) -> Float[ndarray, "stretch terms state"]:
        """Return what each term of a right-hand side, acting within a stretch, does to the state at its end."""
        begin, step = self.times[:-1], np.diff(self.times)
        zero = np.zeros(len(dynamics.terms))
        total = np.zeros((len(begin), len(zero), dynamics.size))
        for x, weight in zip(*np.polynomial.legendre.leggauss(POINTS), strict=True):
            at = begin + (1 + x) / 2 * step
            nodes = replace(self._stretches, end=at).run(line.coefficients, line.nodes[:-1], self._substeps)
            rest = replace(self._stretches, begin=at).vary(line.coefficients, nodes, self._substeps)
            values = dynamics.linear(zero, at, nodes, derivatives=False)[1]
            pushes = np.zeros((len(begin), len(zero), dynamics.order, dynamics.parts, dynamics.count))
            pushes[:, :, -1] = np.transpose(values, (2, 1, 0, 3))
            for k, by_state in enumerate(rest.by_state):
                total[k] += weight / 2 * step[k] * (pushes[k].reshape(len(zero), -1) @ by_state)
        return total

    def _forces(self, placed: Placed, line: Line, chain: Chain) -> list[Force]:
        """Return the terms that an effect adds; a scaled site adds all declared ones there."""
        site = placed.scaled()
        if site is None:
            return placed.forces(chain)
        declared = zip(self.dynamics.terms, line.coefficients, strict=True)
        return [Force(term.text, 0.0, {0: float(value)}, np.eye(chain.sites)[site]) for term, value in declared]

    def _pushed(self, line: Line, acting: Float[ndarray, "stretch columns state"]) -> ndarray:
        """Return the readings of what acts within each stretch."""
        return self._rows(_chained(line.transition, np.zeros(acting.shape[1:]), acting))

    def _scene(self, chain: Chain, line: Line) -> Scene:
        """Return where and when effects may act, at frequencies half a resolution apart."""
        begin, span = float(self.times[0]), float(self.times[-1] - self.times[0])
        u = split_parts(self.plain[0], chain.is_complex)
        about = u - u.mean(axis=0)
        rate = np.gradient(u, self.times, axis=0)
        top = 2 * float(np.sqrt(np.sum(rate**2) / np.sum(about**2)))
        every = np.arange(1.0, 3 * top * span / np.pi) * np.pi / span
        texts = tuple(term.text for term in self.dynamics.terms)
        field = self.dynamics.whole(line.nodes, None)[:, 0]
        past = (Course.of(self.times, field),)
        return Scene(chain, begin, span, (begin, begin + span), top, every, np.empty(0), past, texts, False)


def _last_beside_others(rows: Float[ndarray, "parameters readings"]) -> tuple[float, ndarray]:
    """Return what of the last of some sensitivities the others leave, and their amounts."""
    last = len(rows) - 1
    return explained(rows @ rows.T, np.eye(len(rows))[last], np.arange(last))


def _chained(
    transition: Transition,
    start: Float[ndarray, "columns state"],
    acting: Float[ndarray, "stretch columns state"],
) -> Float[ndarray, "time columns state"]:
    """Return what starts and what acts within stretches does to the states at all sample times."""
    found = [start]
    for by_state, more in zip(transition.by_state, acting, strict=True):
        found.append(np.asarray(found[-1] @ by_state) + more)
    return np.stack(found)
