"""What a diagnosis names: an effect with its size and its evidence, and the effects that it cannot be told from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from latticebench.diagnosis import rules
from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.search import Search
from latticebench.diagnosis.worth import Worth, wald

# An alternative that comes to no less than so many nats behind the effect is given up.
HOPE = 30.0
# Alternatives of an effect that are fitted in full, each of another name, and the share of its evidence that their
# score must come to.
MOST_ALTERNATIVES, COMPARABLE = 3, 0.5
# Models of which one is better by less than so many nats are the same.
SAME = 0.02


@dataclass(frozen=True, eq=False)
class Finding:
    """An effect of the last model.

    Attributes:
        placed: the effect in its place.
        alternatives: effects that these readings cannot tell from it.
        evidence: nats that it brings.
        values: value and standard error, by label of a strength or name of a field in `shape`.
    """

    placed: Placed
    alternatives: tuple[str, ...]
    evidence: float
    values: Mapping[str, tuple[float, float]]

    @property
    def name(self) -> str:
        """The name of the effect."""
        return self.placed.effect.name

    @property
    def site(self) -> int | None:
        """The single site where it acts, from 0."""
        return self.placed.site


@dataclass(frozen=True, eq=False)
class Compared:
    """A model whose effects have been tried without and in exchange for others.

    Attributes:
        fitted: the model, the best that was met.
        evidence: of each effect.
        alternatives: of each effect.
    """

    fitted: Fitted
    evidence: tuple[float, ...]
    alternatives: tuple[tuple[str, ...], ...]


def compared(search: Search, fitted: Fitted) -> Compared:
    """Try a model without each of its effects, and with others in its place; a better model takes its place."""
    search.worth = Worth(search.problem, fitted)
    for _ in range(2 * rules.MOST_EFFECTS):
        better, evidence, alternatives = None, [], []
        for number in range(len(fitted.model.effects)):
            found = _exchanged(search, fitted, number)
            best = min(found.models, key=search.value, default=fitted)
            if search.value(best) < search.value(fitted) - search_margin(best, fitted):
                better = best
                break
            better = _said_first(search, fitted, number, found.models)
            if better is not None:
                break
            evidence.append(found.evidence)
            alternatives.append(found.equal)
        if better is None:
            return Compared(fitted, tuple(evidence), tuple(alternatives))
        fitted = better
    return Compared(fitted, tuple(evidence), tuple(alternatives))


def _said_first(search: Search, fitted: Fitted, number: int, models: Sequence[Fitted]) -> Fitted | None:
    """Return a model that is the same, but for an effect that the catalogue has before another; None for none.

    Of effects that do exactly the same here, rounding would choose.
    """
    order = {name: k for k, name in enumerate(dict.fromkeys(one.effect.name for one in search.problem.candidates))}
    own, count = fitted.model.effects[number], len(fitted.model.effects)
    for other in models:
        placed = other.model.effects[-1] if len(other.model.effects) == count else own
        alike = abs(search.value(other) - search.value(fitted)) < SAME
        if alike and order.get(placed.effect.name, count) < order.get(own.effect.name, -1):
            return other
    return None


def search_margin(one: Fitted, other: Fitted) -> float:
    """Return by how much one model must be better to replace another: less with fewer effects."""
    return 0.0 if len(one.model.effects) < len(other.model.effects) else 0.5


@dataclass(frozen=True, eq=False)
class _Exchange:
    """What an effect brings, models without it or with another in its place, and names of those that do as well."""

    evidence: float
    models: tuple[Fitted, ...]
    equal: tuple[str, ...]


def _exchanged(search: Search, fitted: Fitted, number: int) -> _Exchange:
    placed = fitted.model.effects[number]
    without = search.without(fitted, number)
    evidence = wald(fitted, number) if without is None else (without.cost - fitted.cost) / fitted.dispersion
    models, equal = [] if without is None else [without], []
    for found in _rivals(search, fitted, without, number, evidence):
        models.append(found)
        name = found.model.effects[-1].effect.name
        more = len(found.model.numbers) - len(fitted.model.numbers)
        if found.cost + more < fitted.cost + rules.EQUAL * fitted.dispersion and name != placed.effect.name:
            equal.append(name)
    return _Exchange(float(evidence), tuple(models), tuple(dict.fromkeys(equal)))


def _rivals(search: Search, fitted: Fitted, without: Fitted | None, number: int, evidence: float) -> Iterator[Fitted]:
    """Yield fits with the best candidates in the place of an effect, from the models with it and without it."""
    placed, names = fitted.model.effects[number], set()
    for one in search.standing_in(fitted, number)[:MOST_ALTERNATIVES]:
        names.add(one.placed.effect.name)
        hope = fitted.cost + HOPE * fitted.dispersion
        found = search.exchanged(fitted, [number], one.placed, hope)
        if found is None:
            found = search.climbed(fitted.model.without(number).with_effect(one.placed), fitted, hope)
        if found is not None:
            yield found
    if without is None:
        return
    scored = search.screened(without, timed=placed.timed)
    if placed.timed:
        # A score is linear, and far below what a strong effect brings: the effect's own score is its measure.
        own = [one.gain / fitted.dispersion for one in scored if one.placed.effect.name == placed.effect.name]
        evidence = min(evidence, max(own, default=evidence))
    for one in scored:
        name = one.placed.effect.name
        enough = one.gain / fitted.dispersion > COMPARABLE * evidence
        if name not in names and enough and len(names) < MOST_ALTERNATIVES and one.placed.place != placed.place:
            names.add(name)
            found = search.with_effect(without, one.placed)
            if found is not None:
                yield found


def findings(found: Compared) -> tuple[Finding, ...]:
    """Return what the model names."""
    model, errors = found.fitted.model, found.fitted.stderr
    every = []
    for k, (placed, block) in enumerate(zip(model.effects, model.blocks, strict=True)):
        names = (*placed.labels(found.fitted.chain), *placed.shape)
        numbers = zip(placed.numbers, errors[block], strict=True)
        known = ((name, pair) for name, pair in zip(names, numbers, strict=True) if name not in placed.moot)
        values = {name: (float(value), float(error)) for name, (value, error) in known}
        every.append(Finding(placed, found.alternatives[k], found.evidence[k], values))
    return tuple(every)
