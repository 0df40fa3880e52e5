"""What a Dask worker does for a run: it runs one case at a time, each in a process of the runner's under its limits.

The process lives on from batch to batch, and ends with the worker, or when there has been nothing to do for a while.
Dask finds the functions of this module by their names: a worker needs the same latticebench. What they take and return
is bytes and plain values, which a scheduler can pass on without it.
"""

from __future__ import annotations

import os
import pickle
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from latticebench.bench import source
from latticebench.bench.case import Case
from latticebench.bench.executors.parcel import Parcel, Shelf, moved, named_as_sent
from latticebench.bench.pool import Pool, Turn
from latticebench.bench.provenance import origin, processor

# Seconds after which a process that has nothing to do is ended.
REST = 60.0
# By which Dask has its workers give freed memory back at once. In the processes of cases the C library would then map
# each larger array anew: a fit by `trajectory` takes 1.6 times as long.
TRIM = "MALLOC_TRIM_THRESHOLD_"


class _UnwantedError(Exception):
    """Nobody waits for the batch any more."""


@dataclass
class _Station:
    """The one process of a worker, and the files that have been sent to it."""

    lock: threading.RLock = field(default_factory=threading.RLock)
    pool: Pool | None = None
    files: tempfile.TemporaryDirectory[str] | None = None
    timer: threading.Timer | None = None

    def shelf(self) -> Shelf:
        if self.files is None:
            self.files = tempfile.TemporaryDirectory(prefix="latticebench-", ignore_cleanup_errors=True)
        return Shelf(Path(self.files.name))

    def opened(self) -> Pool:
        if self.pool is None:
            os.environ.pop(TRIM, None)
            self.pool = Pool(1).__enter__()
        return self.pool

    def close(self) -> None:
        with self.lock:
            pool, self.pool = self.pool, None
            if self.timer is not None:
                self.timer.cancel()
            if pool is not None:
                pool.__exit__(None, None, None)

    def rest(self) -> None:
        """Close in a while, unless there is something to do before."""
        if self.timer is not None:
            self.timer.cancel()
        self.timer = threading.Timer(REST, self.close)
        self.timer.daemon = True
        self.timer.start()


_STATION = _Station()


def lacking(parcel: bytes) -> set[str]:
    """Return the hashes of those files of a parcel that are not here."""
    with _STATION.lock:
        return _STATION.shelf().lacking(pickle.loads(parcel))


def receive(given: Mapping[str, bytes]) -> None:
    """Keep contents of files by their hashes."""
    with _STATION.lock:
        _STATION.shelf().receive(given)


def introduce(parcel: bytes, samples: bytes, loads: Collection[str]) -> dict[str, Any]:
    """Return what computes cases here: `origin`, `processor`, and `prints`, the hashes of the code of sample cases.

    Args:
        parcel: the files of users.
        samples: cases, one of each code.
        loads: packages that methods load.
    """
    with _STATION.lock:
        place, folders = _STATION.shelf().lay_out(pickle.loads(parcel))
        cases: Sequence[Case] = pickle.loads(samples)
        prints = [source.fingerprint(moved(case, place).roots, folders) for case in cases]
        return {"origin": origin(loads), "processor": processor(), "prints": prints}


def work(parcel: bytes, batch: bytes, budget: float) -> dict[str, Any]:
    """Run a batch.

    Args:
        parcel: the files of users.
        batch: the cases.
        budget: seconds after which no further case begins.

    Returns:
        `done`: for each case that has been run, its place in the batch, the seconds it took, and its result.
        `seconds`: all of them, with the wait for a process that starts.
    """
    wanted = _asker()
    with _STATION.lock:
        given: Parcel = pickle.loads(parcel)
        place, folders = _STATION.shelf().lay_out(given)
        cases = [moved(case, place) for case in pickle.loads(batch)]
        order = {case.identity: number for number, case in enumerate(cases)}
        done: list[tuple[int, float, dict[str, Any]]] = []
        began = since = time.monotonic()

        def begin(_: Case) -> Turn:
            return "run" if not done or time.monotonic() - began < budget else "done"

        def keep(case: Case, result: dict[str, Any]) -> None:
            nonlocal since
            now = time.monotonic()
            sent = named_as_sent(result, place) if given.files else result
            done.append((order[case.identity], now - since, sent))
            since = now

        def pulse() -> None:
            if not wanted():
                raise _UnwantedError

        try:
            _STATION.opened().run(cases, folders, begin=begin, keep=keep, pulse=pulse)
        except _UnwantedError:
            # Whom this would be told to is gone.
            return {"done": done, "seconds": time.monotonic() - began}
        finally:
            _STATION.rest()
        return {"done": done, "seconds": time.monotonic() - began}


def close() -> None:
    """End the process; the next batch starts another."""
    _STATION.close()


def dask_setup(worker: object) -> None:  # noqa: ARG001
    """Leave Ctrl-C to the client that has started this worker; Dask calls this where the module is preloaded."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _asker() -> Callable[[], bool]:
    """Return what says whether the result of the task of this thread is still waited for.

    A task that is cancelled, also because its client is gone, runs on in Dask; so does one whose worker is closing.
    """
    from distributed import Status, get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def wanted() -> bool:
        task = worker.state.tasks.get(key)
        going_on = worker.status in (Status.running, Status.paused)
        return going_on and task is not None and task.state in ("executing", "long-running")

    return wanted
