"""The search: trace what is left to an effect, add that, and again, until nothing is left or nothing explains it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.contest import (
    BETTER,
    EQUAL,
    TIMED,
    Contender,
    Means,
    Watcher,
    chosen,
    contest,
    rival_of,
    trusted,
    unfitted,
)
from latticebench.diagnosis.horizon import Horizon, thinned
from latticebench.diagnosis.model import Fitted, Model
from latticebench.diagnosis.offsets import lead_of_forces, settled
from latticebench.diagnosis.reconsider import COMPARABLE, Equal, pruned, reconsidered
from latticebench.diagnosis.residual import alike, residual_rms
from latticebench.diagnosis.significance import FALSE_ALARM, anything_at_all, beyond_chance, is_exact
from latticebench.diagnosis.trace import Screened
from latticebench.systems.effects import Effect
from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

MOST_EFFECTS = 4
# Where the model with the added effects still loses the readings and leaves more than this share of what the declared
# equation left beyond the noise, nothing counts as found.
HARDLY = 0.5
# Readings beyond twice the number of unknowns that a test of what is left needs.
SPARE = 10


@dataclass(frozen=True, eq=False)
class Round:
    """One round of the search.

    Attributes:
        ranking: all effects and unnamed terms, the best first.
        added: the effect that was added, or None.
        equal: names of the effects that explain the residual as well.
    """

    ranking: tuple[Contender, ...]
    added: str | None = None
    equal: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Course:
    """How the search went.

    Attributes:
        before: the declared equation's fit.
        after: the fit with every effect that was added.
        equal: for each effect of the last model, the effects that cannot be told from it.
        rounds: of the search.
        left: what is significant in the last residual, the best first.
        verdict: "nothing missing", "explained", "partly explained" or "unexplained".
        rival: the unnamed term that does as well as the last effect in its place, or better, and its lead in natural
            logarithms of the likelihood ratio; or None.
    """

    before: Fitted
    after: Fitted
    equal: Equal
    rounds: tuple[Round, ...]
    left: tuple[Screened, ...]
    verdict: str
    rival: tuple[str, float] | None = None

    @property
    def repeated(self) -> tuple[str, ...]:
        """Effects with a frequency or time of their own that were added more than once.

        Together they can stand for any course in time.
        """
        return _repeated(self.after)


@dataclass(frozen=True, eq=False)
class _Progress:
    """Where the search is.

    Attributes:
        fitted: the model so far.
        equal, rounds, left, rival: as in `Course`.
        doubted: set while an unnamed term did better than the last effect that was added.
    """

    fitted: Fitted
    equal: Equal = ()
    rounds: tuple[Round, ...] = ()
    left: tuple[Screened, ...] = ()
    rival: tuple[str, float] | None = None
    doubted: _Doubted | None = None

    def with_round(self, ranking: Sequence[Contender]) -> _Progress:
        """Return the same after a round that added nothing."""
        return replace(self, rounds=(*self.rounds, Round(tuple(ranking))))

    def back_to(self, fitted: Fitted, equal: Equal, number: int) -> _Progress:
        """Return the same as if the round of this number had been the last one and had added nothing."""
        last = replace(self.rounds[number], added=None, equal=())
        left = beyond_chance([one.screened for one in last.ranking])
        return replace(self, fitted=fitted, equal=equal, rounds=(*self.rounds[:number], last), left=left)


@dataclass(frozen=True, eq=False)
class _Doubted:
    """Where the search was when an unnamed term did better than the best effect, and the evidence of both."""

    fitted: Fitted
    equal: Equal
    round: int
    named: float
    unnamed: float


def search(
    model: Model,
    data: Sequence[Samples],
    catalogue: Sequence[Effect],
    draw: np.random.Generator,
    *,
    watcher: Watcher = lambda _: None,
    most: int = MOST_EFFECTS,
    surrogates: int = 200,
    start: Float[ndarray, " terms"] | None = None,
) -> Course:
    """Search for the effects that an equation lacks.

    A long record that is sampled far more densely than it moves is thinned first, and of a very long one only parts are
    used.

    Args:
        model: the declared equation.
        data: recordings.
        catalogue: effects that may be missing.
        draw: for the surrogates.
        watcher: called with a text that says what is being done.
        most: effects that are added at most.
        surrogates: number of simulated recordings that the null distribution comes from.
        start: coefficients of the declared equation to start from, where another method has fitted them.

    Raises:
        InputError: the readings are too few for the unknowns.
    """
    watcher("fitting the declared equation")
    horizon = Horizon.of([thinned(samples, model.order) for samples in data], model)
    before = horizon.first(model, start)
    if before.count < 2 * before.parameters + SPARE:
        raise InputError(
            f"{data[0].source}: {before.count:.0f} readings are too few for {before.parameters:.0f} unknowns "
            "(the coefficients and each trajectory's start); give longer or more records"
        )
    means = Means(horizon, catalogue, draw, surrogates, watcher)
    now, ended, lost = _Progress(before), False, not horizon.follows(before)
    while not ended:
        now, ended = _next_round(now, means, lost=lost, most=most)
    if now.doubted is not None:
        # An unnamed term explains more than every effect, alone or with another: none of them is right.
        now = now.back_to(now.doubted.fitted, now.doubted.equal, now.doubted.round)
    return _concluded(before, _tested_again(before, now, means), horizon)


def _next_round(now: _Progress, means: Means, *, lost: bool, most: int) -> tuple[_Progress, bool]:
    """Return the search after one more round, and whether that was the last one.

    Args:
        now: where the search is.
        means: what it works with.
        lost: whether the declared equation loses the readings.
        most: effects that are added at most.
    """
    fitted, horizon = now.fitted, means.horizon
    means.watcher(f"tracing what is left, round {len(now.rounds) + 1}")
    screened = means.screen(fitted)
    now = replace(now, left=() if is_exact(fitted) else beyond_chance(screened))
    if not now.left or len(fitted.model.effects) >= most:
        left = now.left or anything_at_all(fitted, means.draw, means.surrogates)
        return replace(now.with_round(unfitted(screened)), left=left), True
    ranking = contest(fitted, screened, means.watcher, lost=not horizon.follows(fitted))
    best, margin = chosen(trusted(ranking, horizon) if lost else ranking)
    count = sum(one.named for one in screened)
    if best is None or best.fitted is None or best.p * count > FALSE_ALARM:
        return now.with_round(ranking), True
    # The second of two effects: together they must do clearly more than the unnamed term did alone.
    if now.doubted is not None and best.evidence + now.doubted.named < now.doubted.unnamed + EQUAL:
        return now.with_round(ranking), True
    return _with_best(now, ranking, best, margin, means), False


def _with_best(now: _Progress, ranking: Sequence[Contender], best: Contender, margin: float, means: Means) -> _Progress:
    """Return the search with the best effect of a ranking added."""
    assert best.fitted is not None
    horizon, fitted = means.horizon, now.fitted
    found = rival_of(ranking, best)
    doubted = None
    if now.doubted is None and found[1] > (BETTER if horizon.sees_all(fitted) else best.evidence):
        doubted = _Doubted(fitted, now.equal, len(now.rounds), best.evidence, best.evidence + found[1])
    least = max(best.evidence - margin, COMPARABLE * best.evidence)
    near = tuple(
        one.name
        for one in ranking
        if one is not best and one.screened.named and one.fitted is not None and one.evidence > least
    )
    # An effect that an unnamed term explains as well is no explanation yet.
    rival = found if found[1] > 0 and horizon.sees_all(fitted) else None
    larger, equal = pruned(best.fitted, (*now.equal, near))
    means.watcher("looking farther")
    larger = settled(horizon.lengthen(larger))
    return _Progress(larger, equal, (*now.rounds, Round(tuple(ranking), best.name, near)), now.left, rival, doubted)


def _tested_again(before: Fitted, now: _Progress, means: Means) -> _Progress:
    """Return the search with its effects tested again, now that all of them are in the model."""
    fitted, equal = pruned(now.fitted, now.equal, all_of_them=True)
    now = replace(now, fitted=fitted, equal=equal)
    if len(fitted.model.effects) > 1:
        fitted, equal, left = reconsidered(fitted, equal, now.left, means)
        now = replace(now, fitted=fitted, equal=equal, left=left)
    if fitted.model.effects and not means.horizon.follows(fitted) and _hardly(before, fitted, means.horizon):
        now = now.back_to(before, (), 0)
    return now


def _concluded(before: Fitted, now: _Progress, horizon: Horizon) -> Course:
    """Return the course with its verdict."""
    fitted, rival = now.fitted, now.rival
    if not fitted.model.effects:
        rival = None
    elif rival is None and horizon.follows(fitted):
        rival = lead_of_forces(fitted)
    if fitted.model.effects:
        verdict = "partly explained" if now.left or rival or _repeated(fitted) else "explained"
    else:
        verdict = "unexplained" if now.left else "nothing missing"
    return Course(before, fitted, now.equal, now.rounds, now.left, verdict, rival)


def _hardly(before: Fitted, after: Fitted, horizon: Horizon) -> bool:
    """Return whether the added effects take away only a small part of what is beyond the noise."""
    shares = [residual_rms(one, horizon.noise) ** 2 - 1 for one in (alike(before, after), after)]
    return shares[1] > HARDLY * shares[0]


def _repeated(fitted: Fitted) -> tuple[str, ...]:
    timed = Counter(placed.effect.name for placed in fitted.model.effects if placed.effect.acts in TIMED)
    return tuple(name for name, count in timed.items() if count > 1)
