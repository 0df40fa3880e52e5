"""Effects that were added are tested again, now that the others are in the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from latticebench.diagnosis.contest import EQUAL, Means, contest
from latticebench.diagnosis.model import Fitted, without
from latticebench.diagnosis.placed import PlacedEffect
from latticebench.diagnosis.polish import polish
from latticebench.diagnosis.significance import beyond_chance
from latticebench.diagnosis.tangent import linearise
from latticebench.diagnosis.trace import Screened, variance_gain

# What cannot be told from an effect has at least this share of its evidence.
COMPARABLE = 0.5

Equal = tuple[tuple[str, ...], ...]


def pruned(fitted: Fitted, equal: Equal, *, all_of_them: bool = False) -> tuple[Fitted, Equal]:
    """Return a fit without the earlier effects that the later ones made superfluous, and what the rest are equal to.

    A random effect has one parameter, the variance of its coefficients, however many of these there are.

    Args:
        fitted: a model with effects.
        equal: for each of them, the names of those that cannot be told from it.
        all_of_them: test the last effect, too.
    """
    number = 0
    while len(fitted.model.effects) > 1 and number < len(fitted.model.effects) - (not all_of_them):
        placed = fitted.model.effects[number]
        smaller = _fitted_without(fitted, number)
        if smaller is not None and _gain_per_parameter(placed, fitted, smaller) < np.log(fitted.count):
            fitted = smaller
            equal = equal[:number] + equal[number + 1 :]
            continue
        number += 1
    return fitted, equal


def reconsidered(
    fitted: Fitted, equal: Equal, left: tuple[Screened, ...], means: Means
) -> tuple[Fitted, Equal, tuple[Screened, ...]]:
    """Try every effect in the place of each one that was added, now that the others are in the model.

    One that does better replaces it; those that do as well are equal to it. As long as something is left unexplained,
    it could tilt the balance by as much as its own evidence.

    Args:
        fitted: a model with effects.
        equal: for each of them, the names of those that cannot be told from it.
        left: what is significant in its residual, the best first.
        means: what the search works with.

    Returns:
        the three that were given, as they are afterwards.
    """
    margin = max(EQUAL, left[0].evidence) if left else EQUAL
    for number in range(len(fitted.model.effects)):
        own = fitted.model.effects[number]
        means.watcher(f"reconsidering {own.effect.name}")
        smaller = _fitted_without(fitted, number)
        if smaller is None or not means.horizon.follows(smaller):
            # Without it the readings are lost: its place is not in doubt.
            continue
        ranking = contest(smaller, means.screen(smaller), means.watcher, window=max(2 * EQUAL, margin))
        rivals = [one for one in ranking if one.screened.named and one.fitted is not None]
        if not rivals:
            continue
        best = rivals[0]
        present = next((one for one in ranking if one.name == own.effect.name), best).screened
        mine = present.evidence if own.spread is not None else replace(present, gain=fitted.gain(smaller)).evidence
        if best.name != own.effect.name and best.evidence > mine + margin and best.fitted is not None:
            # The better one goes to the end, where polish put it.
            fitted = best.fitted
            equal = (*equal[:number], *equal[number + 1 :], ())
            return fitted, equal, beyond_chance(means.screen(fitted))
        top = max(best.evidence, mine)
        least = max(top - margin, COMPARABLE * top)
        alike = tuple(one.name for one in rivals if one.name != own.effect.name and one.evidence > least)
        equal = (*equal[:number], alike, *equal[number + 1 :])
    return fitted, equal, left


def _fitted_without(fitted: Fitted, number: int) -> Fitted | None:
    """Return the fit of a model without one of its effects."""
    smaller = without(fitted, number)
    return polish(smaller.model, smaller)


def _gain_per_parameter(placed: PlacedEffect, fitted: Fitted, smaller: Fitted) -> float:
    """Return twice the log likelihood ratio to the model without an effect, per parameter of this effect."""
    if placed.spread is not None:
        return variance_gain(linearise(smaller), placed.effect)
    samples = fitted.data[0]
    columns = len(placed.forces(samples.sites, samples.is_complex)) + len(placed.free)
    return fitted.gain(smaller) / max(columns, 1)
