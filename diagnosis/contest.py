"""Ranking of a round's candidates by what they explain: the screen's best few are fitted in full."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from latticebench.diagnosis.horizon import Horizon
from latticebench.diagnosis.model import Fitted, strengths
from latticebench.diagnosis.placed import PlacedEffect
from latticebench.diagnosis.polish import polish
from latticebench.diagnosis.residual import correlation_time
from latticebench.diagnosis.tangent import linearise
from latticebench.diagnosis.trace import Screened, screen
from latticebench.systems.effects import Effect

# Effects whose evidence is this near the best one's cannot be told from it (natural logarithms).
EQUAL = 3.0
# By so much an unnamed term must be ahead before no effect is named (natural logarithms); by the effect's whole
# evidence where a model loses the readings.
BETTER = 5.0
# Unnamed terms that are fitted in full in a round, and the share of the best effect's evidence in the screen that they
# must have: where the declared equation is far off, the screen is rough.
OTHER_FITS, OTHER_SHARE = 4, 0.6
# Ways of acting with a frequency or a time of their own.
TIMED = ("harmonic", "pulse")
# A memory cannot be so many times as large as the largest declared force.
CANCELLED = 2.0
# How far behind the best an effect may be in the screen and still be fitted: where the readings are lost, and as a
# share of the evidence.
FAR, ROUGH = 20.0, 0.15
# Effects refitted in a round, at most.
FULL_FITS = 8

Watcher = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Means:
    """What a search works with.

    Attributes:
        horizon: how far models are followed.
        catalogue: effects that may be missing.
        draw: for the surrogates.
        surrogates: number of simulated recordings that the null distribution comes from.
        watcher: called with a text that says what is being done.
    """

    horizon: Horizon
    catalogue: Sequence[Effect]
    draw: np.random.Generator
    surrogates: int
    watcher: Watcher

    def screen(self, fitted: Fitted) -> list[Screened]:
        """Return what the screen says of every effect and unnamed term beside a fitted model, the best first."""
        return screen(linearise(fitted), self.catalogue, self.draw, self.surrogates)


@dataclass(frozen=True, eq=False)
class Contender:
    """An entry of a ranking: what the screen says, and a full fit where the screen put it near the best.

    Attributes:
        screened: what the screen says.
        gain: twice the log likelihood ratio, of the full fit where there is one.
        evidence: what the ranking goes by.
        p: chance that noise alone does as well, corrected for the search.
        fitted: the model with it, or None.
    """

    screened: Screened
    gain: float
    evidence: float
    p: float
    fitted: Fitted | None = None

    @property
    def name(self) -> str:
        """The effect, or the unnamed term."""
        return self.screened.name


def unfitted(screened: Sequence[Screened]) -> list[Contender]:
    """Return a ranking by the screen alone."""
    return [Contender(one, one.gain, one.evidence, one.p) for one in screened]


def contest(
    fitted: Fitted, screened: Sequence[Screened], watcher: Watcher, *, window: float = 2 * EQUAL, lost: bool = False
) -> list[Contender]:
    """Fit the best few in full, and return all of them ranked.

    Args:
        fitted: the model that they are added to, one at a time.
        screened: what the screen says of each, the best first.
        watcher: called with a text that says what is being done.
        window: how far behind the best an effect may be in the screen and still be fitted.
        lost: the model loses the readings; more are fitted then, since the screen is rough.
    """
    ranking: list[Contender] = []
    highest, fits, others = 0.0, 0, 0
    for one in screened:
        timed = one.placed.effect.acts in TIMED
        # Where the readings are lost, such an effect is fitted to see whether it finds them again; it is not what the
        # others are measured against.
        apart = timed and lost and one.named
        # The screen of what is plainly visible is rough; and other ends change the motion by more than to first order.
        # What has a frequency or a time of its own can stand for nearly anything, and is not given that much.
        behind = window if timed else max(FAR if lost else window, ROUGH * highest)
        near = one.evidence > highest - behind or (one.placed.ends is not None and one.evidence > EQUAL)
        if apart:
            near = one.evidence > EQUAL
        # An unnamed term is fitted, too, where the screen puts it beside the effects.
        if not one.named:
            near = bool(one.placed.texts) and one.evidence > OTHER_SHARE * highest and others < OTHER_FITS
        if not near or (fits >= FULL_FITS and not apart):
            ranking += unfitted([one])
            continue
        watcher(f"fitting {one.name}")
        ranking.append(_fitted(one, fitted))
        if ranking[-1].fitted is None:
            continue
        if not one.named:
            others += 1
        elif not apart:
            fits, highest = fits + 1, max(highest, one.evidence)
    return sorted(ranking, key=lambda one: -one.evidence)


def _fitted(one: Screened, fitted: Fitted) -> Contender:
    """Return the entry of a ranking for a full fit; without a fit and without evidence where it fails."""
    with_it = polish(fitted.model.with_effect(one.placed), fitted)
    if with_it is None or _impossible(one.placed, with_it, fitted):
        return Contender(one, 0.0, 0.0, 1.0)
    gain = with_it.gain(fitted)
    # Of a random effect the evidence is that of its variance: a fit has as many coefficients as there are sites.
    again = one if one.random or "step" in one.placed.psi else replace(one, gain=gain)
    return Contender(one, gain, again.evidence, again.p, with_it)


def _impossible(placed: PlacedEffect, with_it: Fitted, fitted: Fitted) -> bool:
    """Return whether a fit makes of an effect what it cannot be.

    A friction that drives is none. Nor is a memory so strong that the other terms must cancel it: together with the
    present field it makes a derivative.
    """
    own = slice(len(fitted.solution.state.coefficients), None)
    if placed.effect.takes:
        return bool(np.any(with_it.solution.state.coefficients[own] > 0))
    if placed.effect.acts == "delayed":
        return bool(np.max(strengths(with_it)[own]) > CANCELLED * np.max(strengths(fitted)))
    return False


def trusted(ranking: Sequence[Contender], horizon: Horizon) -> list[Contender]:
    """Return a ranking without what acts at its own frequency or time merely because that is in step with the motion.

    Where the declared equation loses the readings, such a force can stand for nearly anything. But then an unnamed term
    does clearly better, or the force does not find the readings again.
    """

    def timed(one: Contender) -> bool:
        return one.screened.placed.effect.acts in TIMED

    ahead = [one for one in ranking if not timed(one) or rival_of(ranking, one)[1] <= max(BETTER, ROUGH * one.evidence)]
    kept = [one for one in ahead if not timed(one) or (one.fitted is not None and horizon.follows(one.fitted))]
    return kept if any(one.screened.named and one.fitted is not None for one in kept) else ahead


def chosen(ranking: Sequence[Contender]) -> tuple[Contender | None, float]:
    """Return the effect to add (or None), and how near to its evidence others must come to be as good.

    Among those as good as the best, one without a searched parameter goes before one with. What is left of a model that
    is far off is correlated, and differences count for so much less.
    """
    fits = [one for one in ranking if one.screened.named and one.fitted is not None]
    if not fits or fits[0].fitted is None:
        return None, EQUAL
    margin = EQUAL * correlation_time(fits[0].fitted)
    plain = [one for one in fits if one.evidence > fits[0].evidence - margin and not one.screened.searched]
    return (plain or fits)[0], margin


def rival_of(ranking: Sequence[Contender], best: Contender) -> tuple[str, float]:
    """Return the best unnamed term of a ranking, and by how much it is ahead of the best effect.

    A full fit of the effect may find a better place or frequency for it than the screen's grid has; an unnamed term
    that is only screened must beat that, too.
    """
    found = ("", -np.inf)
    for one in ranking:
        if not one.screened.named:
            theirs = best.evidence if one.fitted is not None else max(best.evidence, best.screened.evidence)
            found = max(found, (one.name, float(one.evidence - theirs)), key=lambda pair: pair[1])
    return found
