"""Sensors that look from the other side: the mirror image of an equation that says the same of the readings."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import Problem, turned
from latticebench.diagnosis.regression import regressed
from latticebench.diagnosis.worth import COUPLING, repelling

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Sensors are tried from the other side on chains of so many sites at most.
MOST_TURNED = 3


def mirrored(problem: Problem, start: Model) -> list[tuple[Model, Problem]]:
    """Return the declared equation with one sensor that looks from the other side, and the states it then has.

    It does where neighbours would push each other away otherwise, or where the equation would leave more.
    """
    found, left = [], regressed(problem)[1]
    for one in _sensors(problem):
        other = one.turned()
        if other is not None and one.site is not None:
            seen = turned(problem, one.site)
            coefficients, still_left = regressed(seen)
            model = replace(start, coefficients=coefficients)
            likelier = still_left < left or repelling(problem, start)
            if likelier and not repelling(problem, model):
                found.append((model.with_effect(other), seen))
    return found


def images(problem: Problem, fitted: Fitted) -> Iterator[tuple[Model, list[Float[ndarray, "pieces m state"]]]]:
    """Yield the mirror images of a chain of two whose sites push each other away, with states to start from.

    The second sensor is turned. With w = -u of the second site, C (w - u) + k u is -C (u2 - u) + (k - 2 C) u of the
    first, and the like. Where k is an effect, the mirror image may do without it.
    """
    if problem.chain.sites != 2 or not repelling(problem, fitted.model):
        return
    sign = np.tile([1.0, -1.0], problem.chain.order)
    near = [nodes * sign for nodes in fitted.followed.nodes]
    for plain, one in itertools.product(_attracting(problem, fitted.model), _sensors(problem)):
        there = [k for k, placed in enumerate(plain.effects) if placed.place == one.place]
        rest = plain.without(there[0]) if there else plain
        other = (plain.effects[there[0]] if there else one).turned()
        if other is not None:
            yield rest.with_effect(other), near


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


def _sensors(problem: Problem) -> list[Placed]:
    """Return what can be said of single sensors' sign, all but the first one's."""
    if problem.chain.sites > MOST_TURNED:
        return []
    return [one for one in problem.candidates if one.turned() is not None and one.site != 0]
