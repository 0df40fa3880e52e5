"""Batches: how many cases go to a worker at once.

A batch costs a message there and one back, whatever is in it. It is made as long as keeps that below SHARE of its time,
by what messages have cost so far and by how long such cases have taken. Towards the end batches shrink, so that no
worker is left with several cases while another has none. A worker gives back what it has not begun when its time is up,
so that a wrong guess costs nobody a long wait.
"""

from __future__ import annotations

import math
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from latticebench.bench.case import Case
from latticebench.bench.pool import AGAIN, Turn, foreign

# The part of a worker's time that messages may take.
SHARE = 0.02
# Seconds of a batch: of the first, before messages have been timed, and of the longest.
FIRST, LONGEST = 0.1, 5.0
# Weight of the newest measurement among all.
NEWEST = 0.3
# Workers that may be lost with a case before it is said to be the reason.
LOSSES = 3


@dataclass
class Batches:
    """Cases that wait for a worker.

    Attributes:
        open: cases without a result.
        overhead: seconds of a batch's turn that no case had.
    """

    open: int = 0
    overhead: float = FIRST * SHARE
    _queue: deque[Case] = field(default_factory=deque)
    _later: deque[tuple[float, Case]] = field(default_factory=deque)
    # By what `id` says of a case: what it took in an earlier run, and how many workers were lost with it.
    _known: dict[int, float] = field(default_factory=dict)
    _losses: Counter[int] = field(default_factory=Counter)
    _took: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, cases: Iterable[Case], seconds: Mapping[str, float]) -> Batches:
        """Return cases as they are to begin: the longest first, those of unknown length as one of the middle.

        Those with code of the user's come last, file by file: a process runs the code of one.

        Args:
            cases: in the order of their suite.
            seconds: what they took in earlier runs, by their identities.
        """
        waiting = list(cases)
        known = {id(one): seconds[one.identity] for one in waiting if one.identity in seconds} if seconds else {}
        middle = statistics.median(known.values()) if known else 0.0
        waiting.sort(key=lambda case: (foreign(case), -known.get(id(case), middle)))
        return cls(len(waiting), _queue=deque(waiting), _known=known)

    @property
    def waiting(self) -> bool:
        """Whether there are cases that no worker has."""
        return bool(self._queue or self._later)

    @property
    def budget(self) -> float:
        """Seconds that the next batch may take before what it has not begun is given back."""
        return min(self.overhead / SHARE, LONGEST)

    def take(self, workers: int, ask: Callable[[Case], Turn]) -> list[Case]:
        """Return the next batch; empty where nothing can begin now.

        Args:
            workers: how many share what is left.
            ask: says whether a case is to be run; one that is done already is none that is open.
        """
        while self._later and self._later[0][0] <= time.monotonic():
            self._queue.append(self._later.popleft()[1])
        most, left, batch = math.ceil(len(self._queue) / (2 * max(workers, 1))), self.budget, list[Case]()
        while self._queue and len(batch) < most and left > 0:
            case = self._queue[0]
            # One of which nothing is known goes alone, and so does one that has been lost with a worker.
            guess = math.inf if self._losses[id(case)] else self._guess(case)
            if batch and (math.isinf(guess) or foreign(case) != foreign(batch[0])):
                break
            self._queue.popleft()
            turn = ask(case)
            if turn == "later":
                self._later.append((time.monotonic() + AGAIN, case))
            elif turn == "done":
                self.open -= 1
            else:
                batch.append(case)
                left -= guess
        return batch

    def _guess(self, case: Case) -> float:
        """Return how long a case will take, by others of its kind in this run, or by what it took in an earlier one."""
        return self._took.get(_sort(case), self._known.get(id(case), math.inf))

    def back(self, cases: Iterable[Case]) -> None:
        """Take cases back that have not begun; they are the next."""
        self._queue.extendleft(reversed(list(cases)))

    def lost(self, cases: Iterable[Case]) -> list[Case]:
        """Take cases back whose worker is gone; return those that have gone with too many, which are given up."""
        given_up = []
        for case in cases:
            self._losses[id(case)] += 1
            if self._losses[id(case)] < LOSSES:
                self._queue.append(case)
            else:
                given_up.append(case)
        return given_up

    def done(self, case: Case, seconds: float) -> None:
        """Learn that a case has its result, and after how long."""
        self.open -= 1
        sort = _sort(case)
        self._took[sort] = _newer(self._took.get(sort, seconds), seconds)

    def turned(self, seconds: float) -> None:
        """Learn how much of a batch's turn no case had."""
        self.overhead = _newer(self.overhead, seconds)


def _sort(case: Case) -> str:
    """Return what cases that take about equally long have in common: who fits which system."""
    return f"{getattr(case, 'label', case.kind)}\n{case.roots}"


def _newer(known: float, measured: float) -> float:
    return known + NEWEST * (measured - known)
