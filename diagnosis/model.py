"""A declared equation with effects added to it, as numbers and as terms."""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting import Chain, Placed
from latticebench.methods.engine.dynamics import Dynamics, Factor
from latticebench.methods.engine.resonator import Resonator
from latticebench.systems.lattice import Library
from latticebench.systems.stencil import Ends
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@functools.lru_cache(maxsize=1024)
def read_term(text: str) -> Term:
    """Return the term of a text; each text is parsed once."""
    return Term(text)


@dataclass(frozen=True, eq=False)
class Assembled:
    """The right-hand side of a model on the chain of one recording.

    Attributes:
        dynamics: the terms with weights and factors.
        coefficients: of the terms.
        slope: derivatives of the coefficients and, after these, of the numbers of resonators by the model's numbers.
    """

    dynamics: Dynamics
    coefficients: Float[ndarray, " terms"]
    slope: Float[ndarray, "varied numbers"]


@dataclass(frozen=True, eq=False)
class Model:
    """A declared equation and what was added to it.

    Attributes:
        declared: its terms.
        order: of the time derivative.
        coefficients: of the declared terms.
        effects: those added so far.
    """

    declared: Library
    order: int
    coefficients: tuple[float, ...]
    effects: tuple[Placed, ...] = ()

    @property
    def numbers(self) -> Float[ndarray, " numbers"]:
        """All numbers that a fit changes: the declared coefficients, then those of each effect."""
        return np.concatenate([self.coefficients, *(one.numbers for one in self.effects)])

    @property
    def blocks(self) -> list[slice]:
        """The numbers of each effect."""
        ends = np.cumsum([len(self.coefficients), *(one.count for one in self.effects)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    @property
    def key(self) -> tuple[str, ...]:
        """What distinguishes models, their numbers apart."""
        return tuple(sorted(repr((one.near, one.turns)) for one in self.effects))

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its effects."""
        return tuple(one.effect.name for one in self.effects)

    @property
    def possible(self) -> bool:
        """Whether all effects have numbers such as they may have."""
        return all(one.possible for one in self.effects)

    @property
    def rubs(self) -> bool:
        """Whether there is dry friction in it."""
        texts = [text for one in self.effects for text in one.effect.texts(self.order, is_complex=False)]
        return any(read_term(text).jumps for text in (*self.declared.texts, *texts))

    @property
    def may_stand_in(self) -> bool:
        """Whether there is something with a frequency, a time or a delay of its own in it, wandering zeros apart."""
        return any(one.timed and one.wandering() is None for one in self.effects)

    def hanging(self, chain: Chain) -> list[Placed]:
        """Return the effects of which a part is not read, but has a state of its own."""
        return [one for one in self.effects if one.resonator(chain) is not None]

    def with_past(self, past: tuple[Factor, ...]) -> Model:
        """Return the same model, fed with another field at earlier times of each recording."""
        return replace(self, effects=tuple(one.with_past(past) for one in self.effects))

    @property
    def walking(self) -> frozenset[int]:
        """The sites whose sensors have zeros that wander."""
        return frozenset(site for one in self.effects if (site := one.wandering()) is not None)

    def with_walks(self, walk: Float[ndarray, " sensors"]) -> Model:
        """Return the same model, which says how far zeros wander."""
        return replace(self, effects=tuple(one.with_walks(walk) for one in self.effects)) if len(walk) else self

    def moved(self, numbers: Float[ndarray, " numbers"]) -> Model:
        """Return the same model with other numbers."""
        count = len(self.coefficients)
        effects = tuple(one.moved(numbers[block]) for one, block in zip(self.effects, self.blocks, strict=True))
        return replace(self, coefficients=tuple(map(float, numbers[:count])), effects=effects)

    def with_effect(self, placed: Placed) -> Model:
        """Return the model with one effect more."""
        return replace(self, effects=(*self.effects, placed))

    def without(self, number: int) -> Model:
        """Return the model without the effect of this number."""
        return replace(self, effects=self.effects[:number] + self.effects[number + 1 :])

    def instruments(self, recording: int) -> list[tuple[Placed, slice]]:
        """Return the effects that act on the readings of a recording, with their numbers."""
        pairs = zip(self.effects, self.blocks, strict=True)
        return [(one, block) for one, block in pairs if one.instrument and one.acts_in(recording)]

    def of_others(self, recordings: int) -> Model:
        """Return the model without what acts in some of so many recordings alone: what may be said of others."""
        every = range(recordings)
        return replace(self, effects=tuple(one for one in self.effects if all(one.acts_in(k) for k in every)))

    def assembled(self, plain: Dynamics, chain: Chain, recording: int = 0) -> Assembled:
        """Return the right-hand side.

        Args:
            plain: the declared terms on the chain.
            chain: the same lattice, as effects know it.
            recording: its number, for factors that differ between recordings.
        """
        size = len(self.numbers)
        found = _Sum(chain.sites, size)
        for k, (text, value) in enumerate(zip(self.declared.texts, self.coefficients, strict=True)):
            found.add(text, value, {k: 1.0})
        for placed, block in zip(self.effects, self.blocks, strict=True):
            if (one := placed.resonator(chain)) is not None:
                found.hang(one, block)
                continue
            for force in placed.forces(chain):
                by = {block.start + k: value for k, value in force.by.items()}
                found.add(force.text, force.coefficient, by, force.weights, force.factor_of(recording))
        for placed, block in zip(self.effects, self.blocks, strict=True):
            site = placed.scaled()
            if site is not None:
                found.scale(site, placed.strength[0], block.start)
        for placed, block in zip(self.effects, self.blocks, strict=True):
            excess = placed.quickened()
            if excess is not None:
                found.quicken(excess, plain.order, block.start)
        ends = next((way for one in self.effects if (way := one.other_ends()) is not None), plain.ends)
        return found.assembled(plain, ends)


class _Sum:
    """Terms of a right-hand side while it is put together."""

    def __init__(self, sites: int, numbers: int) -> None:
        self.sites, self.numbers = sites, numbers
        self.texts: list[str] = []
        self.coefficients: list[float] = []
        self.slopes: list[ndarray] = []
        self.weights: list[ndarray] = []
        self.factors: list[Factor | None] = []
        self.resonators: list[tuple[Resonator, slice]] = []

    def add(
        self,
        text: str,
        coefficient: float,
        by: dict[int, float],
        weights: ndarray | None = None,
        factor: Factor | None = None,
    ) -> None:
        slope = np.zeros(self.numbers)
        slope[list(by)] = list(by.values())
        self.texts.append(text)
        self.coefficients.append(coefficient)
        self.slopes.append(slope)
        self.weights.append(np.ones(self.sites) if weights is None else weights)
        self.factors.append(factor)

    def hang(self, resonator: Resonator, block: slice) -> None:
        """Add what is not read, whose numbers are those of a block."""
        self.resonators.append((resonator, block))

    def scale(self, site: int, strength: float, number: int) -> None:
        """Multiply all that acts at a site by 1 + strength; the derivative by it is what acts there."""
        here = np.eye(self.sites)[site]
        acting = [k for k in range(len(self.texts)) if self.coefficients[k] != 0 and self.weights[k][site] != 0]
        before = [(self.texts[k], self.coefficients[k], self.weights[k] * here, self.factors[k]) for k in acting]
        self.weights = [one * (1 + strength * here) for one in self.weights]
        for text, value, weights, factor in before:
            self.add(text, 0.0, {number: value}, weights, factor)

    def quicken(self, strength: float, order: int, number: int) -> None:
        """Multiply all forces by (1 + strength)^order, as what goes so much quicker; what is not read does not."""
        factor = 1 + strength
        for k, value in enumerate(self.coefficients):
            self.slopes[k] = self.slopes[k] * factor**order
            self.slopes[k][number] += order * factor ** (order - 1) * value
        self.coefficients = [one * factor**order for one in self.coefficients]

    def assembled(self, plain: Dynamics, ends: Ends) -> Assembled:
        weights = np.stack(self.weights)
        dynamics = replace(
            plain,
            terms=tuple(read_term(text) for text in self.texts),
            weights=None if np.all(weights == 1) else weights,
            factors=tuple(self.factors) if any(self.factors) else None,
            ends=ends,
            resonators=tuple(one for one, _ in self.resonators),
        )
        unread = [np.eye(self.numbers)[block] for _, block in self.resonators]
        return Assembled(dynamics, np.array(self.coefficients), np.concatenate([np.stack(self.slopes), *unread]))
