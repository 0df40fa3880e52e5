"""The pool of worker processes.

Each slot of the pool is a loky executor with one worker, so that a worker that hangs, eats memory or dies takes no
other case with it. A worker runs one thread, lives for many cases, and ends when the runner does, however that ends.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import Any

from latticebench.bench.case import Case, Folders
from latticebench.bench.threads import ONE_THREAD
from latticebench.bench.worker import attempt, follow_runner, outcome, ready, too_much

POLL = 0.1
START_LIMIT = 120.0
# A worker that died may have been the victim of something else; its case gets a second chance.
TRIES = 2


def execute(
    cases: Iterable[Case],
    folders: Folders,
    *,
    jobs: int,
    begin: Callable[[Case], bool],
    keep: Callable[[Case, dict[str, Any]], None],
) -> None:
    """Run cases on `jobs` workers.

    A case beyond its time or memory limit has its worker killed; its result says so. On any exception (Ctrl-C among
    them) all workers are killed before it is passed on.

    Args:
        cases: in the order in which they begin.
        folders: where relative paths start from.
        jobs: worker processes.
        begin: is asked as a case is about to begin; it is left out where the answer is False.
        keep: takes each result as soon as it is there.
    """
    queue = deque((case, 1) for case in cases)
    slots = [_Slot() for _ in range(max(1, min(jobs, len(queue))))]
    try:
        while queue or any(slot.busy for slot in slots):
            for slot in slots:
                while not slot.busy and queue:
                    case, number = queue.popleft()
                    if begin(case):
                        slot.start(case, folders, number)
            running = [slot.future for slot in slots if slot.future is not None]
            wait(running, timeout=POLL, return_when=FIRST_COMPLETED)
            for slot in slots:
                result = slot.result() if slot.busy else None
                if result is None or slot.case is None:
                    continue
                if result["status"] == "died" and slot.number < TRIES:
                    queue.appendleft((slot.case, slot.number + 1))
                else:
                    keep(slot.case, result)
    finally:
        for slot in slots:
            slot.close()


class _Slot:
    """One worker process, and the case it is on."""

    def __init__(self) -> None:
        self.executor: Any = None
        self.worker: int = 0
        self.future: Future[Any] | None = None
        self.case: Case | None = None
        self.number = 0
        self.since = 0.0

    @property
    def busy(self) -> bool:
        return self.future is not None

    def start(self, case: Case, folders: Folders, number: int) -> None:
        """Hand a case to the worker, with a new worker where there is none."""
        from joblib.externals.loky.process_executor import ProcessPoolExecutor

        if self.executor is None:
            self.executor = ProcessPoolExecutor(
                max_workers=1, env=ONE_THREAD, initializer=follow_runner, initargs=(os.getpid(),)
            )
        self.case, self.number, self.since = case, number, time.monotonic()
        try:
            if not self.worker:
                self.worker = self.executor.submit(ready, type(case)).result(timeout=START_LIMIT)
                self.since = time.monotonic()
            self.future = self.executor.submit(attempt, case, folders)
        except (RuntimeError, OSError, TimeoutError) as error:
            # A worker that cannot start is a worker that died.
            self.future = Future()
            self.future.set_exception(error)

    def result(self) -> dict[str, Any] | None:
        """Return the result when there is one, be it that a limit was passed; None while the case runs."""
        assert self.future is not None
        assert self.case is not None
        case = self.case
        if self.future.done():
            future, self.future = self.future, None
            error = future.exception()
            if error is None:
                return dict(future.result())
            self.close()
            return outcome(case, "died", f"the worker process ended by itself {TRIES} times ({type(error).__name__})")
        if time.monotonic() - self.since > case.time_limit:
            self.close()
            return outcome(case, "timeout", f"no result within the time limit of {case.time_limit:g} s")
        if self._resident_mib() > case.memory_limit:
            self.close()
            return outcome(case, "memory", too_much(case))
        return None

    def _resident_mib(self) -> float:
        import psutil

        try:
            return float(psutil.Process(self.worker).memory_info().rss) / 2**20
        except psutil.Error:
            return 0.0

    def close(self) -> None:
        """End the worker, whatever it is doing."""
        import psutil

        self.future = None
        if self.executor is not None:
            executor, self.executor = self.executor, None
            worker, self.worker = self.worker, 0
            # First the process itself: the executor's own way waits for a lock that a stuck worker may hold.
            if worker:
                with contextlib.suppress(psutil.Error):
                    psutil.Process(worker).kill()
            executor.shutdown(wait=True, kill_workers=True)
