"""What has no name in the catalogue but may be seen in a residual, or does better than what was named."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from latticebench.diagnosis import rules
from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.glance import most_promising
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.score import Scored, Tangent
from latticebench.diagnosis.search import Search
from latticebench.diagnosis.unnamed import forces, readings
from latticebench.diagnosis.unnamed.nameless import Nameless

# What could do better than named effects is fitted in full: the likeliest ones, so many of each set of effects. Sets of
# so many are looked at, and all together.
TRIED, OF_EACH, MOST = 5, 2, 2
# Scores are linear: what they say is worse by no more than so many nats, and this share of what the effects bring, may
# be better.
SLACK, INEXACT = 10.0, 0.3


@dataclass(frozen=True)
class Left:
    """Something without a name that is significant in a residual, or does better than effects that have one.

    Attributes:
        name: in words, or a term.
        gain: nats that it would win, or by which it is better.
        price: nats that noise alone reaches in its share of `rules.FALSE_DOUBT`, or by which it must be better.
        site: where it acts, from 0; None for everywhere.
        instead: the named effects in whose place it does better; none for what is in the residual.
    """

    name: str
    gain: float
    price: float
    site: int | None
    instead: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Unnamed:
    """What may be there without a name.

    Attributes:
        problem: the recordings.
        few: what is scored one by one.
        many: families of what is alike elsewhere, at another time or frequency: the likeliest ones are scored.
    """

    problem: Problem
    few: tuple[Placed, ...]
    many: tuple[tuple[Placed, ...], ...]

    @classmethod
    def of(cls, problem: Problem) -> Unnamed:
        """Return all of it for some recordings."""
        few = (
            *forces.terms(problem), *forces.changing(problem), *forces.placed(problem), *readings.readings(problem)
        )  # fmt: skip
        many = forces.beginning(problem), forces.at_sites(problem), forces.swinging(problem)
        return cls(problem, few, tuple(found for one in many if (found := tuple(one))))

    def scored(self, tangents: Sequence[Tangent]) -> Iterator[tuple[int, Scored, float]]:
        """Yield what acts along a fitted motion, with its score and its price, and the number of the tangent."""
        kinds = {id(one): len(family) for family in (self.few, *self.many) for one in family}
        likely: dict[int, Placed] = {}
        for tangent in tangents:
            for family in self.many:
                likely |= {id(one): one for one in most_promising(tangent, family, lambda _: 0.0, lambda _: 0)}
        for batch in tangents[0].batches([*self.few, *likely.values()]):
            for number, tangent in enumerate(tangents):
                for before, one in zip(batch, tangent.scored_at_once(batch), strict=True):
                    if one.freedom:
                        share = rules.FALSE_DOUBT / (1 + len(self.many)) / kinds[id(before)]
                        yield number, one, self.problem.chance(share, one.freedom)


def without_name(search: Search, fitted: Fitted) -> tuple[Left, ...]:
    """Return what is significant in a residual, then what does better than named effects, the best of each first."""
    unnamed, tangent = Unnamed.of(search.problem), search.tangent(fitted)
    known = [k for k, one in enumerate(fitted.model.effects) if one.strength]
    sets = [one for size in range(1, len(known) + 1) for one in itertools.combinations(known, size)]
    sets = [one for one in sets if len(one) <= MOST or len(one) == len(known)]
    left: list[Left] = []
    instead: dict[tuple[int, ...], list[_Instead]] = {}
    tangents = [tangent, *(tangent.in_place_of(one) for one in sets)]
    for number, one, price in unnamed.scored(tangents):
        if number:
            found = _Instead.of(search, fitted, sets[number - 1], tangents[number].taken, one, price)
            if found.worse < SLACK + INEXACT * tangents[number].taken / 2:
                instead.setdefault(found.numbers, []).append(found)
        elif one.gain > price:
            left.append(Left(_nameless(one.placed).said, one.gain, price, one.placed.site))
    likely = [one for found in instead.values() for one in sorted(found, key=lambda one: one.worse)[:OF_EACH]]
    best: dict[tuple[str, int | None], Left] = {}
    for thing in sorted(left, key=lambda left: left.price - left.gain):
        best.setdefault((thing.name, thing.site), thing)
    return (*best.values(), *_better(search, fitted, likely))


@dataclass(frozen=True, eq=False)
class _Instead:
    """Something without a name in the place of some effects.

    Attributes:
        numbers: those of the effects in the model.
        placed: what takes their place.
        worse: by how many nats the model would be worse, to first order.
        saved: the nats that it costs less than the effects.
    """

    numbers: tuple[int, ...]
    placed: Placed
    worse: float
    saved: float

    @classmethod
    def of(
        cls, search: Search, fitted: Fitted, numbers: tuple[int, ...], taken: float, one: Scored, price: float
    ) -> _Instead:
        """Return what a score in the place of effects says, which together take so much off the sum of squares."""
        effects = [fitted.model.effects[k] for k in numbers]
        named = sum(search.worth.price_of(effect) for effect in effects)
        # A name is no disadvantage.
        alike = one.freedom >= sum(effect.count for effect in effects)
        saved = named - (max(price, named) if alike else price)
        return cls(numbers, one.placed, (taken - one.won) / 2 / fitted.dispersion - saved, saved)


def _better(search: Search, fitted: Fitted, likely: list[_Instead]) -> list[Left]:
    """Return what does better than the effects in whose place it is fitted."""
    found: dict[tuple[int, ...], Left] = {}
    for one in sorted(likely, key=lambda one: one.worse)[:TRIED]:
        hope = fitted.cost + fitted.dispersion * one.saved
        other = search.exchanged(fitted, one.numbers, one.placed, hope)
        if other is None:
            continue
        better = (hope - other.cost) / fitted.dispersion
        names = tuple(fitted.model.effects[k].effect.name for k in one.numbers)
        if better > max(rules.NAMED, found[one.numbers].gain if one.numbers in found else 0.0):
            found[one.numbers] = Left(_nameless(one.placed).said, better, rules.NAMED, one.placed.site, names)
    return sorted(found.values(), key=lambda left: -left.gain)


def _nameless(placed: Placed) -> Nameless:
    assert isinstance(placed, Nameless)
    return placed
