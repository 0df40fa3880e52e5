"""Sensors that look from the other side: the mirror image of an equation that says the same of the readings."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Set
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import Problem, turned
from latticebench.diagnosis.regression import regressed
from latticebench.diagnosis.worth import COUPLING, repelling
from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Single sensors are tried from the other side on chains of so many sites at most.
MOST_TURNED = 3
# Chains of so many sites that have an equation, at most, are asked for several.
LONGEST = 24
# Decimals by which the shares are told apart that equations leave: all but some sensors turned is the same as these.
ALIKE = 9


def mirrored(problem: Problem, start: Model) -> list[tuple[Model, Problem]]:
    """Return the declared equation with sensors that look from the other side, and the states it then has.

    On a short chain single ones do where neighbours would push each other away otherwise, or where the equation would
    leave more; on a longer one those that do so together, where with them the equation leaves much less.
    """
    if problem.chain.sites > MOST_TURNED:
        return _together(problem, start)
    found, left = [], regressed(problem)[1]
    for site, other in _sensors(problem):
        seen = turned(problem, site)
        coefficients, still_left = _carried(seen, start)
        model = replace(start, coefficients=coefficients)
        likelier = still_left < left or repelling(problem, start)
        if site != 0 and likelier and not repelling(problem, model):
            found.append((model.with_effect(other), seen))
    return found


def _together(problem: Problem, start: Model) -> list[tuple[Model, Problem]]:
    """Return the declared equation with the sensors that, turned step by step, make it leave least.

    A step turns one sensor, or all on one side of a bond. What they lead to is returned where it leaves much less
    (`rules.EXCHANGED`); of two sets that leave the same it has fewer sensors.
    """
    moving = frozenset(problem.chain.moving)
    if len(moving) > LONGEST:
        return []
    sensors = {site: one for site, one in _sensors(problem) if site in moving}
    sites = range(problem.chain.sites)
    beside = (part for k in sites[2:-1] for part in (sites[:k], sites[k:]))
    steps = [moving.intersection(part) for part in (*([site] for site in sites), *beside)]

    def seen(chosen: Set[int]) -> Problem:
        return functools.reduce(turned, chosen, problem)

    chosen: frozenset[int] = frozenset()
    first = least = regressed(problem)[1]
    while True:
        others = {chosen ^ step for step in steps if chosen ^ step <= sensors.keys()}
        left = {other: (round(_carried(seen(other), start)[1], ALIKE), len(other)) for other in others}
        best = min(others, key=lambda other: left[other], default=chosen)
        if best == chosen or not left[best][0] < rules.OTHERWISE * least:
            break
        chosen, least = best, left[best][0]
    if not least < rules.EXCHANGED * first:
        return []
    model = replace(start, coefficients=regressed(seen(chosen))[0])
    return [(functools.reduce(Model.with_effect, (sensors[site] for site in sorted(chosen)), model), seen(chosen))]


def images(problem: Problem, fitted: Fitted) -> Iterator[tuple[Model, list[Float[ndarray, "pieces m state"]]]]:
    """Yield the mirror images of a chain of two whose sites push each other away, with states to start from.

    The second sensor is turned. With w = -u of the second site, C (w - u) + k u is -C (u2 - u) + (k - 2 C) u of the
    first, and the like. Where k is an effect, the mirror image may do without it.
    """
    if problem.chain.sites != 2 or not repelling(problem, fitted.model):
        return
    sign = np.tile([1.0, -1.0], problem.chain.order)
    near = [nodes[..., : problem.plain.read] * sign for nodes in fitted.followed.nodes]
    for plain, (site, turned_over) in itertools.product(_attracting(problem, fitted.model), _sensors(problem)):
        if site == 0:
            continue
        there = [k for k, placed in enumerate(plain.effects) if placed.place == turned_over.place]
        rest = plain.without(there[0]) if there else plain
        other = plain.effects[there[0]].turned() if there else turned_over
        if other is not None:
            yield rest.with_effect(other), near


def _carried(problem: Problem, start: Model) -> tuple[tuple[float, ...], float]:
    """Return what `regressed` does; the start's coefficients, and infinity, where a declared term is not finite."""
    try:
        return regressed(problem)
    except InputError:
        return start.coefficients, np.inf


def _attracting(problem: Problem, model: Model) -> list[Model]:
    """Return the equations of the mirror image, all that sensors do left aside."""
    texts, coefficients = list(model.declared.texts), list(model.coefficients)
    pull = coefficients[texts.index(COUPLING)]
    more = -pull * (2 if problem.chain.ends == "free" else 4)
    coefficients[texts.index(COUPLING)] = -pull
    if "u[n]" in texts:
        coefficients[texts.index("u[n]")] += more
        return [replace(model, coefficients=tuple(coefficients))]
    for number, one in enumerate(model.effects):
        if not one.local and one.labels(problem.chain) == ("u[n]",):
            stiffer = one.moved([one.strength[0] + more])
            effects = (*model.effects[:number], stiffer, *model.effects[number + 1 :])
            found = replace(model, coefficients=tuple(coefficients), effects=effects)
            return [found, found.without(number)]
    return []


def _sensors(problem: Problem) -> list[tuple[int, Placed]]:
    """Return the sites, and what says of each that its sensor looks from the other side."""
    turned_over = ((one.site, one.turned()) for one in problem.candidates)
    return [(site, other) for site, other in turned_over if site is not None and other is not None]
