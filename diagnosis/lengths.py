"""How long the pieces are that models are followed over, in rows."""

from __future__ import annotations

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.border import MOST
from latticebench.diagnosis.problem import Problem

# On short horizons so many rows are looked at, or so many pieces' worth if that is more.
ROWS, PIECES = 1200, 4
# Derivatives of the states of one piece by the numbers of its border, at most: they grow as the square of its length.
MOST_MOVES = 5e6


def least(problem: Problem) -> int:
    """Return the fewest rows of a piece that say something."""
    return 2 * problem.chain.order // problem.chain.levels + 2


def looked_at(length: int) -> int:
    """Return the most rows that are looked at in pieces of so many."""
    return max(ROWS, PIECES * length)


def longest(problem: Problem) -> int:
    """Return the rows of the longest pieces: whole recordings, or some periods where the border has curves."""
    whole, plain = max(len(one.t) for one in problem.data), problem.plain
    if not len(plain.border):
        return whole
    period = 2 * np.pi / problem.main / problem.step
    room = int(np.sqrt(MOST_MOVES / (MOST * len(plain.border) * plain.parts * plain.size)))
    return min(whole, max(min(round(rules.BORDER * period), room), least(problem)))


def longer(problem: Problem, length: int, sure: bool) -> list[int]:
    """Return the rows of the pieces after those of `length`, and fewer in case these cannot be followed.

    Args:
        problem: the recordings.
        length: rows of the pieces now.
        sure: whether the last growth changed nothing and the model follows the readings: the next one is larger.
    """
    most = longest(problem)
    if length >= most:
        return []
    further = [length * many for many in ((rules.FASTER, rules.GROWTH) if sure else (rules.GROWTH,))]
    return list(dict.fromkeys(one if one < rules.ALMOST * most else most for one in further))
