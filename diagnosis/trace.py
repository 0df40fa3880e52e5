"""Trace what a fitted model leaves to an effect that it lacks.

Every effect of the catalogue is put, to first order, beside the fitted model (`diagnosis.tangent`): at every site that
it might sit at, on a grid of frequencies, times and delays that it might have. With r the residual (in units of the
noise) and U an orthonormal basis of what the effect could add, s = |U^T r|^2 is what it would take off |r|^2: the score
test (Rao, Proc. Camb. Phil. Soc. 44, 50 (1948)). An effect with a coefficient for every site or time counts as a random
one, of unknown variance: the likelihood is then that of a Gaussian residual with a covariance.

The null distribution is simulated: noise of the estimated size is put on the fitted trajectories and the model is
fitted to it again, by the Gauss-Newton step that the tangent gives; the same search over sites and frequencies is then
done on what is left. The largest value of a search has an exponential tail; the surrogates say how many independent
candidates the search amounts to, so that p-values far below one over the number of surrogates make sense.

Terms without a name (`diagnosis.unnamed`, `diagnosis.misreadings`) are screened beside the catalogue. They are never
named; but where one of them does much better than every effect of the catalogue, none of these is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import special

from latticebench.diagnosis.candidate import Candidate
from latticebench.diagnosis.catalogued import ROUNDED, candidates_of
from latticebench.diagnosis.misreadings import misreadings
from latticebench.diagnosis.placed import PlacedEffect
from latticebench.diagnosis.tangent import Tangent
from latticebench.diagnosis.unnamed import unnamed
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

SEARCHED = ("omega", "at", "width", "delay", "s")
CERTAIN = 60.0
# Numbers drawn at a time for surrogates.
CHUNK = 4_000_000


@dataclass(frozen=True, eq=False)
class Screened:
    """What the screen says of one effect, or of an unnamed term.

    Attributes:
        name: of the effect, or the text of an unnamed term.
        placed: its best candidate.
        gain: twice the log likelihood ratio of that one.
        columns: how many coefficients it has.
        independent: how many independent candidates the search amounts to.
        cost: what the search costs the evidence: the log of that number, or half the log of the count of readings per
            parameter searched (as in the Bayesian information criterion) where that is more.
        named: whether it is of the catalogue.
        random: whether it is a random effect, of a coefficient for every site or time.
    """

    name: str
    placed: PlacedEffect
    gain: float
    columns: int
    independent: float
    cost: float
    named: bool = True
    random: bool = False

    @property
    def searched(self) -> int:
        """How many of its parameters were searched for: a frequency, a time, a delay."""
        return len(set(self.placed.psi) & set(SEARCHED))

    @property
    def rarity(self) -> float:
        """-ln of the chance p that noise alone does as well somewhere in the search."""
        return rarity(self._tail, self.independent)

    @property
    def p(self) -> float:
        """That chance."""
        return float(np.exp(-self.rarity))

    @property
    def evidence(self) -> float:
        """What the ranking goes by: -ln p of one candidate, less what the search costs."""
        return self._tail - self.cost

    @property
    def _tail(self) -> float:
        return float(tail(self.gain, self.columns)) + (np.log(2) if self.random and self.gain > 0 else 0.0)


def tail(gain: float | ndarray, columns: int) -> Any:
    """Return -ln of the chance that chi squared of this many degrees of freedom is larger.

    Far out it is that of an asymptotic series, where the chance itself would be 0.
    """
    half, x = columns / 2, np.maximum(np.asarray(gain, dtype=float), 0.0) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        near = -np.log(special.gammaincc(half, x))
        # The first terms of the asymptotic series of the incomplete gamma function.
        far = (
            x
            - (half - 1) * np.log(np.maximum(x, 1e-300))
            + special.gammaln(half)
            - np.log1p((half - 1) / np.maximum(x, 1.0))
        )
    return np.where(x > 300 + 4 * half, far, near)


def rarity(largest: float, count: float) -> float:
    """-ln of the chance that the largest of so many independent count is larger."""
    if largest > np.log(count) + 30:
        return float(largest - np.log(count))
    return float(-np.log(max(-np.expm1(count * np.log1p(-min(np.exp(-largest), 1 - 1e-15))), 1e-300)))


# The search -----------------------------------------------------------------------------------------------------------


def screen(
    tangent: Tangent, catalogue: Sequence[Effect], draw: np.random.Generator, surrogates: int = 200
) -> list[Screened]:
    """Return what the candidates of every effect and unnamed term explain, the best first."""
    model = tangent.fitted.model
    groups: list[tuple[str, bool, list[Candidate]]] = []
    for effect in catalogue:
        if not _addable(effect, model.effects):
            continue
        found = candidates_of(tangent, effect)
        if found:
            groups.append((effect.name, True, found))
    groups += [(name, False, candidates) for name, candidates in (*unnamed(tangent), *misreadings(tangent))]
    return rank(tangent, groups, draw, surrogates)


def variance_gain(tangent: Tangent, effect: Effect) -> float:
    """Return twice the log likelihood ratio of the best variance that a random effect's coefficients may have.

    0 where the effect has no random coefficients.
    """
    candidates = [one for one in candidates_of(tangent, effect) if one.spread is not None]
    scores = _scores(
        [(effect.name, True, candidates)], tangent.residual[:, None], float(np.sum(tangent.residual**2)), tangent.spare
    )
    return float(np.max(scores[0][0], initial=0.0)) if candidates else 0.0


def rank(
    tangent: Tangent, groups: Sequence[tuple[str, bool, list[Candidate]]], draw: np.random.Generator, surrogates: int
) -> list[Screened]:
    """Return what groups of candidates explain of the residual, compared with surrogates; the best group first."""
    spare = tangent.spare
    rows = len(tangent.residual)
    own = _scores(groups, tangent.residual[:, None], float(np.sum(tangent.residual**2)), spare)
    values = [[] for _ in groups]  # type: list[list[ndarray]]
    chunk = max(1, min(surrogates, CHUNK // max(rows, 1)))
    done = 0
    while done < surrogates:
        noise = surrogate_residuals(tangent, draw, min(chunk, surrogates - done))
        done += noise.shape[1]
        for kept, (_, best, _) in zip(values, _scores(groups, noise, np.sum(noise**2, axis=0), spare), strict=True):
            kept.append(np.max(best, axis=0))
    screened = []
    for (name, named, candidates), (gains, best, columns), null in zip(groups, own, values, strict=True):
        chosen = int(np.argmax(best[:, 0]))
        # The largest of m exponential variables has the mean ln m + 0.577 (Euler's constant) for large m.
        mean = float(np.mean(np.concatenate(null)))
        count = float(np.clip(np.exp(mean - 0.5772) if mean > 1.3 else mean, 1.0, 10.0 * len(candidates) + 1))
        placed = _with_spread(tangent, candidates[chosen])
        searched = len(set(placed.psi) & set(SEARCHED))
        cost = max(np.log(count), searched * np.log(tangent.fitted.count) / 2)
        gain = float(gains[chosen, 0])
        if "step" in placed.psi and placed.psi["step"] ** 2 / 12 > ROUNDED * float(tangent.fitted.sigma[0]) ** 2:
            gain = max(gain, CERTAIN)
        screened.append(
            Screened(
                name, placed, gain, columns[chosen], count, float(cost), named,
                candidates[chosen].spread is not None,
            )
        )  # fmt: skip
    return sorted(screened, key=lambda one: -one.evidence)


def surrogate_residuals(tangent: Tangent, draw: np.random.Generator, count: int) -> ndarray:
    """Return draws of what refits leave of pure noise (rows, count)."""
    noise = draw.normal(size=(len(tangent.residual), count))
    pieces, begin = [], 0
    for path in tangent.paths:
        end = begin + int(np.sum(path.weight > 0))
        pieces.append(path.free(noise[begin:end]))
        begin = end
    left = np.concatenate(pieces)
    return np.asarray(left - tangent.known @ (tangent.known.T @ left))


def _scores(
    groups: Sequence[tuple[str, bool, list[Candidate]]], residual: ndarray, total: Any, spare: float
) -> list[tuple[ndarray, ndarray, list[int]]]:
    """Return, per group, likelihood gains (candidates, draws), their tails, and numbers of coefficients."""
    if not groups:
        return []
    every = np.concatenate([one.basis for _, _, candidates in groups for one in candidates], axis=1)
    scores = every.T @ residual
    found, begin = [], 0
    for _, _, candidates in groups:
        gains, tails, columns = [], [], []
        for one in candidates:
            end = begin + one.basis.shape[1]
            gain = _gain(scores[begin:end], one.spread, total, spare)
            count = 1 if one.spread is not None else one.basis.shape[1]
            gains.append(gain)
            # A variance cannot be negative: half of the chance is at 0.
            tails.append(tail(gain, count) + (np.log(2) * (gain > 0) if one.spread is not None else 0.0))
            columns.append(count)
            begin = end
        found.append((np.stack(gains), np.stack(tails), columns))
    return found


def _gain(
    scores: Float[ndarray, "q draws"], spread: ndarray | None, total: Any, spare: float
) -> Float[ndarray, " draws"]:
    """Return twice the log likelihood ratio, the noise's size being fitted, too."""
    if spread is None:
        share = np.minimum(np.sum(scores**2, axis=0) / total, 1 - 1e-12)
        return np.asarray(-spare * np.log1p(-share))
    gains = [_random_gain(variance, scores, spread, total, spare) for variance in variances(spread)]
    return np.asarray(np.max(gains, axis=0, initial=0.0))


def variances(spread: Float[ndarray, " q"]) -> Float[ndarray, " variances"]:
    """Return the variances that a random effect is screened with."""
    return np.asarray(np.geomspace(0.03, 3e4, 25) / np.mean(spread))


def _random_gain(variance: float, scores: ndarray, spread: ndarray, total: Any, spare: float) -> ndarray:
    ratio = variance * spread
    share = np.minimum(np.sum(scores**2 * (ratio / (1 + ratio))[:, None], axis=0) / total, 1 - 1e-12)
    return np.asarray(-spare * np.log1p(-share) - np.sum(np.log1p(ratio)))


def _with_spread(tangent: Tangent, one: Candidate) -> PlacedEffect:
    """Return a candidate's effect, with the spread of its coefficients where they are random."""
    if one.spread is None:
        return one.placed
    scores, total = (one.basis.T @ tangent.residual)[:, None], float(np.sum(tangent.residual**2))
    sizes = variances(one.spread)
    best = sizes[int(np.argmax([_random_gain(v, scores, one.spread, total, tangent.spare)[0] for v in sizes]))]
    ratio = best * one.spread
    return replace(one.placed, spread=float(np.sqrt(best)), effective=float(np.sum(ratio / (1 + ratio))))


def _addable(effect: Effect, present: Sequence[PlacedEffect]) -> bool:
    """Return whether an effect may be added once more."""
    again = ("one site", "one equation", "harmonic", "pulse", "offset", "gain")
    return effect.acts in again or all(placed.effect.name != effect.name for placed in present)
