"""Whether what a model leaves is more than chance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.coherence import coherence, farthest
from latticebench.diagnosis.model import Fitted
from latticebench.diagnosis.tangent import linearise
from latticebench.diagnosis.trace import Screened

if TYPE_CHECKING:
    pass

# Chance of calling something missing where nothing is, over all candidates of a round.
FALSE_ALARM = 0.004
ARITHMETIC = 1e-6


def beyond_chance(screened: Sequence[Screened]) -> tuple[Screened, ...]:
    """Return what noise alone would hardly do, the least likely first.

    All that was screened is counted; half of the chance is for the catalogue's effects.
    """
    found = []
    for named in (True, False):
        group = [one for one in screened if one.named is named]
        found += [one for one in group if one.rarity > np.log(len(group)) - np.log(FALSE_ALARM / 2)]
    return tuple(sorted(found, key=lambda one: -one.rarity))


def anything_at_all(fitted: Fitted, draw: np.random.Generator, surrogates: int) -> tuple[Screened, ...]:
    """Return what is left in any form, where nothing of a known form is significant."""
    if is_exact(fitted):
        return ()
    tangent = linearise(fitted)
    found = (coherence(tangent, draw, surrogates), farthest(tangent))
    return tuple(one for one in found if one.p < FALSE_ALARM / 2)


def is_exact(fitted: Fitted) -> bool:
    """Return whether a model leaves less than any instrument could show: rounding of the arithmetic."""
    values = [record.value[record.seen] for record in fitted.records]
    return float(np.max(fitted.sigma)) < ARITHMETIC * float(np.sqrt(np.mean(np.concatenate(values) ** 2)))
