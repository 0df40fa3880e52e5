"""The pool of worker processes: which case runs when, and where.

Each slot of the pool has one worker, so that a worker that hangs, eats memory or dies takes no other case with it. A
worker runs one thread, lives for many cases, and ends when the runner does, however that ends. One that has imported a
file of the user's is used for no other code.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Literal

from latticebench.bench.case import Case, Folders, code_file
from latticebench.bench.guardian import Guardian
from latticebench.bench.process import Events, Process

# Seconds between two looks at the limits of what is running.
POLL = 0.1
# Seconds until a case that another run is on is asked about again.
AGAIN = 0.5
# A worker that died may have been the victim of something else; its case gets a second chance.
TRIES = 2

# What a case that is about to begin is told: it may, it is done already, or it must wait for another run.
Turn = Literal["run", "done", "later"]


def foreign(case: Case) -> str:
    """Return which files of the user's with code a case runs; empty where all of its code is of this package."""
    roots = case.roots
    return "\n".join(path for name in (roots.method, roots.system) if (path := code_file(name)) is not None)


class Pool:
    """Workers that live on from one run of cases to the next; a context that ends them."""

    def __init__(self, size: int) -> None:
        self.events: Events = SimpleQueue()
        self.folders, self.guardian = Folders(), Guardian()
        self.workers: list[Process | None] = [None] * size
        self.later: deque[tuple[float, Case]] = deque()
        self.looked = 0.0

    def __enter__(self) -> Pool:
        """Start what ends the workers should this process be killed."""
        self.guardian.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        """End the workers."""
        try:
            self._close()
        finally:
            self.guardian.__exit__(kind, value, at)

    def start(self, cases: Iterable[Case]) -> None:
        """Start the workers for the first of these cases, before they are handed any: importing takes a while."""
        for place, code in zip(range(len(self.workers)), sorted(map(foreign, cases)), strict=False):
            self.workers[place] = Process(code, self.events, self.guardian)

    def run(
        self,
        cases: Iterable[Case],
        folders: Folders,
        *,
        begin: Callable[[Case], Turn],
        keep: Callable[[Case, dict[str, Any]], None],
        pulse: Callable[[], None] = lambda: None,
    ) -> None:
        """Run cases.

        A case beyond its time or memory limit has its worker ended; its result says so. On any exception (Ctrl-C among
        them) all workers are ended before it is passed on.

        Args:
            cases: in the order in which they begin, but for those with code of the user's, which come last.
            folders: where relative paths start from.
            begin: is asked as a case is about to begin.
            keep: takes each result as soon as it is there.
            pulse: is called about every POLL seconds.
        """
        # A worker is then started anew for each such code once, not at every second case.
        queue = deque(sorted(cases, key=foreign))
        self.folders = folders
        ended: list[tuple[Case, dict[str, Any]]] = []
        # How many workers died while they were on a case, by its identity.
        deaths: Counter[str] = Counter()
        try:
            while queue or self.later or self._busy() or ended:
                try:
                    self._begin(queue, begin)
                finally:
                    # Writing them to the disk takes a while, in which the workers are on their next cases.
                    while ended:
                        keep(*ended.pop())
                pulse()
                for case, result in self._results():
                    if result["status"] == "died" and deaths[case.identity] < TRIES - 1:
                        deaths[case.identity] += 1
                        queue.appendleft(case)
                    else:
                        ended.append((case, result))
                for worker in self.workers:
                    queue.extendleft(worker.lost() if worker is not None else ())
        except BaseException:
            self._close()
            raise

    def _busy(self) -> list[Process]:
        return [worker for worker in self.workers if worker is not None and worker.cases]

    def _begin(self, queue: deque[Case], ask: Callable[[Case], Turn]) -> None:
        """Give each worker that waits a case, and each on quick cases one beforehand."""
        while self.later and self.later[0][0] <= time.monotonic():
            queue.append(self.later.popleft()[1])
        busy = self._busy()
        if not queue and len(busy) < len(self.workers):
            # What waits behind a case that takes its time is for those that have none.
            queue.extend(case for worker in busy if (case := worker.give_back()) is not None)
        for place in sorted(range(len(self.workers)), key=lambda place: self.workers[place] in busy):
            while queue and self._room(place, queue[0]):
                case = queue.popleft()
                turn = ask(case)
                if turn == "later":
                    self.later.append((time.monotonic() + AGAIN, case))
                elif turn == "run":
                    self._start(place, case)

    def _room(self, place: int, case: Case) -> bool:
        """Return whether the worker of a place can be handed a case now."""
        worker = self.workers[place]
        return worker is None or not worker.cases or (worker.takes_another and worker.code == foreign(case))

    def _start(self, place: int, case: Case) -> None:
        code, worker = foreign(case), self.workers[place]
        if worker is not None and (worker.closed or worker.code != code):
            worker.close()
            worker = None
        if worker is None:
            worker = self.workers[place] = Process(code, self.events, self.guardian)
        worker.hand(case, self.folders)

    def _results(self) -> list[tuple[Case, dict[str, Any]]]:
        """Wait a moment, and return what has ended: the case, and the result."""
        found = []
        try:
            worker, line = self.events.get(timeout=POLL)
            found.append(worker.take(line))
        except Empty:
            pass
        if time.monotonic() - self.looked > POLL:
            self.looked = time.monotonic()
            found += [worker.overdue() for worker in self._busy()]
        return [one for one in found if one is not None]

    def _close(self) -> None:
        for worker in self.workers:
            if worker is not None:
                worker.close()
        self.workers = [None] * len(self.workers)
        self.later.clear()
