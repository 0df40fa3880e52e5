"""The runner: cases on a pool of worker processes, each result kept at once.

Each slot of the pool is a loky executor with one worker, so that a worker that hangs, eats memory or dies takes no other case
with it. A worker runs one thread, lives for many cases, and ends when the runner does, however that ends.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from latticebench.bench.case import blank, run_case
from latticebench.bench.provenance import origin
from latticebench.bench.store import Store
from latticebench.bench.suite import Case, Suite

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)
POLL = 0.1
START_LIMIT = 120.0
# A worker that died may have been the victim of something else; its case gets a second chance.
TRIES = 2


class Watcher(Protocol):
    """What a progress display is told."""

    def count(self, left: int) -> None:
        """Say how many cases are to be run."""

    def started(self, case: Case) -> None:
        """Say that a case has been handed to a worker."""

    def finished(self, case: Case, result: dict[str, Any]) -> None:
        """Say that a case has its result."""


@dataclass
class Tally:
    """What a run did: how many cases were there before, were run, and ended with which status."""

    reused: int = 0
    ran: int = 0
    statuses: dict[str, int] = field(default_factory=dict)


def run(
    suite: Suite,
    store: Store,
    *,
    jobs: int,
    retry: bool = False,
    watcher: Watcher | None = None,
    about: Mapping[str, Any] | None = None,
) -> tuple[list[dict[str, Any]], Tally]:
    """Run the cases of a suite that have no result yet, and give all results in the suite's order.

    Args:
        suite: what to run.
        store: where results are kept; one that is there is used again.
        jobs: worker processes.
        retry: run failed cases again.
        watcher: is told of every case.
        about: the command and what else to write down of the run.

    Raises:
        InputError: a result cannot be written.
        KeyboardInterrupt: the user stopped the run; finished cases are in the store.
    """
    keys = {case.identity: case.key(suite.base) for case in suite.cases}
    tally = Tally()
    store.put_about({**(about or {}), "keys": list(keys.values())})
    made = origin()
    _forget_superseded(store, suite, set(keys.values()))

    def done(case: Case) -> bool:
        key = keys[case.identity]
        return store.has(key) and not _again(case, store.get(key), retry)

    waiting = [case for case in suite.cases if not done(case)]
    tally.reused = len(suite.cases) - len(waiting)
    if watcher is not None:
        watcher.count(len(waiting))

    def keep(case: Case, result: dict[str, Any]) -> None:
        store.put(keys[case.identity], {**result, "made": made})
        tally.ran += 1
        if watcher is not None:
            watcher.finished(case, result)

    if waiting:
        # Another run on the same store may finish a case in the meantime, unless failures are to be run again.
        execute(waiting, suite.base, jobs=jobs, keep=keep, superfluous=None if retry else done, watcher=watcher)
    results = []
    for case in suite.cases:
        key = keys[case.identity]
        result = store.get(key)
        current = case.model_dump(mode="json")
        if result["case"] != current:
            # The same case under another label or limit.
            result = {**result, "case": current}
            store.put(key, result)
        results.append(result)
        tally.statuses[result["status"]] = tally.statuses.get(result["status"], 0) + 1
    return results, tally


def _again(case: Case, result: dict[str, Any], retry: bool) -> bool:
    """Say whether a result does not count: a failure to retry, or a limit that has been raised since."""
    status, before = result["status"], result["case"]
    if status == "timeout":
        return retry or bool(case.time_limit > before["time_limit"])
    if status == "memory":
        return retry or bool(case.memory_limit > before["memory_limit"])
    return retry and status in ("failed", "died")


def _forget_superseded(store: Store, suite: Suite, keys: set[str]) -> None:
    """Remove results of this suite's cases that an older source computed."""
    identities = {case.identity for case in suite.cases}
    stale = [
        path for path in store.paths() if path.stem not in keys
        and Case.model_validate(store.get(path.stem)["case"]).identity in identities
    ]  # fmt: skip
    for path in stale:
        path.unlink(missing_ok=True)


def execute(
    cases: Iterable[Case],
    base: Path,
    *,
    jobs: int,
    keep: Callable[[Case, dict[str, Any]], None],
    superfluous: Callable[[Case], bool] | None = None,
    watcher: Watcher | None = None,
) -> None:
    """Run cases on `jobs` workers and hand each result to `keep` as soon as it is there.

    A case beyond its time or memory limit has its worker killed; its result says so. On any exception (Ctrl-C among them) all
    workers are killed before it is passed on.
    """
    queue = deque((case, 1) for case in cases)
    slots = [_Slot() for _ in range(max(1, min(jobs, len(queue))))]
    try:
        while queue or any(slot.busy for slot in slots):
            for slot in slots:
                while not slot.busy and queue:
                    case, attempt = queue.popleft()
                    if superfluous is None or not superfluous(case):
                        slot.start(case, base, attempt)
                        if watcher is not None:
                            watcher.started(case)
            running = [slot.future for slot in slots if slot.future is not None]
            wait(running, timeout=POLL, return_when=FIRST_COMPLETED)
            for slot in slots:
                if not slot.busy:
                    continue
                result = slot.result()
                if result is None:
                    continue
                assert slot.case is not None
                if result["status"] == "died" and slot.attempt < TRIES:
                    queue.appendleft((slot.case, slot.attempt + 1))
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
        self.attempt = 0
        self.since = 0.0

    @property
    def busy(self) -> bool:
        return self.future is not None

    def start(self, case: Case, base: Path, attempt: int) -> None:
        """Hand a case to the worker, with a new worker where there is none."""
        from joblib.externals.loky.process_executor import ProcessPoolExecutor

        if self.executor is None:
            self.executor = ProcessPoolExecutor(
                max_workers=1, env=ONE_THREAD, initializer=_follow_runner, initargs=(os.getpid(),)
            )
        self.case, self.attempt, self.since = case, attempt, time.monotonic()
        try:
            if not self.worker:
                self.worker = self.executor.submit(os.getpid).result(timeout=START_LIMIT)
                self.since = time.monotonic()
            self.future = self.executor.submit(run_case, case, base)
        except (RuntimeError, OSError, TimeoutError) as error:
            # A worker that cannot start is a worker that died.
            self.future = Future()
            self.future.set_exception(error)

    def result(self) -> dict[str, Any] | None:
        """Give the case's result when there is one, be it that a limit was passed; None while it runs."""
        assert self.future is not None
        assert self.case is not None
        case = self.case
        if self.future.done():
            future, self.future = self.future, None
            error = future.exception()
            if error is None:
                return dict(future.result())
            self.close()
            return blank(case, "died", f"the worker process ended by itself {TRIES} times ({type(error).__name__})")
        if time.monotonic() - self.since > case.time_limit:
            self.close()
            return blank(case, "timeout", f"no result within the time limit of {case.time_limit:g} s")
        if self._resident_mib() > case.memory_limit:
            self.close()
            return blank(case, "memory", f"more than {case.memory_limit} MiB of memory were needed")
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


def _follow_runner(runner: int) -> None:
    """In a worker: leave Ctrl-C to the runner, and end when the runner is gone."""
    import signal

    import psutil

    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        try:
            parent = psutil.Process(runner)
            while parent.is_running() and parent.status() != psutil.STATUS_ZOMBIE:
                time.sleep(0.5)
        except psutil.Error:
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
