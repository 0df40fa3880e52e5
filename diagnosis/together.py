"""Two effects that swing at one frequency, and one that does what they do together.

A force at one site and one at all of the same frequency, opposite to each other, move one site alone: so does the hum
of its sensor. No exchange of one effect leads from these two to that one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np

from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.score import Tangent

# A candidate may take the place of effects if it can do this share of what they do.
MOST_OF_IT = 0.9


def for_two(problem: Problem, tangent: Tangent) -> Iterator[tuple[tuple[int, int], Placed]]:
    """Yield the numbers of two effects of a model that swing together, with the candidate that does most of both.

    Frequencies are one where they differ by less than half of what the longest recording resolves.
    """
    swinging = [(k, one.frequency) for k, one in enumerate(tangent.fitted.model.effects) if one.frequency is not None]
    for (i, first), (j, second) in itertools.combinations(swinging, 2):
        if abs(first - second) > np.pi / problem.scene.span:
            continue
        # One of each kind and place; all are tuned to the same frequency.
        places = {one.place: one for one in problem.candidates if one.frequency is not None}
        without = tangent.in_place_of([i, j])
        scored = without.scored([one.tuned((first + second) / 2) for one in places.values()])
        best = max(scored, key=lambda one: one.won)
        if best.won > MOST_OF_IT * without.taken > 0:
            yield (i, j), best.placed
