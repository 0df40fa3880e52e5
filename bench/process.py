"""A worker process as the runner sees it: started, handed cases, watched, and ended."""

from __future__ import annotations

import contextlib
import io
import json
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections import deque
from dataclasses import replace
from queue import SimpleQueue
from typing import Any

from latticebench.bench import cgroup
from latticebench.bench.case import STATUSES, Case, Folders
from latticebench.bench.guardian import Guardian, search_path
from latticebench.bench.threads import ONE_THREAD
from latticebench.bench.tree import MARK, Tree, end, resident_mib, started
from latticebench.bench.worker import LENGTH, MOST_BYTES, one_line, outcome, too_much

# Nothing is imported from the working folder.
START = "import sys; sys.path[:] = sys.argv[1].split('\\n'); from latticebench.bench.shield import serve; serve()"
# Seconds until a new worker has imported what it needs.
START_LIMIT = 120.0
# Seconds within which a case is so quick that another one may wait behind it.
QUICK = 0.1
# Lines of a worker that may wait to be taken: that it has begun, and two results. One that writes more waits itself.
WAITING = 3
# Characters of what a case has printed that are shown in its row; bytes that are kept of it while it runs.
MOST_SHOWN = 200
MOST_PRINTED = 2**20

Events = SimpleQueue["tuple[Process, bytes]"]


class Process:
    """One worker.

    Attributes:
        code: what code of a user's it runs (see `bench.pool.foreign`); a worker is kept for cases of the same.
        cases: what it is on, and behind that what it has been handed beforehand; empty while it waits.
    """

    def __init__(self, code: str, events: Events, guardian: Guardian) -> None:
        """Start it; what it answers, line by line and at its end nothing, is put into `events`."""
        self.code = code
        self.cases: deque[Case] = deque()
        self.number, self.since, self.begun = 1, 0.0, False
        self.quick = self.last = self.silent = False
        self.room = threading.Semaphore(WAITING)
        # Where in the file what the present case prints begins, and what of it is in the file no more.
        self.place, self.kept = 0, ""
        mark = uuid.uuid4().hex
        self.printed, written = _nameless_file()
        self.process = subprocess.Popen(
            [sys.executable, "-c", START, search_path()],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=written,
            env={**os.environ, **ONE_THREAD, MARK: mark}, start_new_session=True,
        )  # fmt: skip
        written.close()
        cgroup.enter(self.process.pid, mark)
        self.guardian = guardian
        self._is(Tree(mark, shield=self.process.pid, worker=self.process.pid))
        self._send(b"\n")
        self.listener = threading.Thread(target=self._listen, args=(events,), daemon=True)
        self.listener.start()

    def _is(self, tree: Tree) -> None:
        self.tree = tree
        self.guardian.watch_over(tree)

    def _send(self, request: bytes) -> None:
        assert self.process.stdin is not None
        # A worker that has ended is found out by `overdue`.
        with contextlib.suppress(OSError):
            self.process.stdin.write(request)
            self.process.stdin.flush()

    def _listen(self, events: Events) -> None:
        assert self.process.stdout is not None
        # A line that is longer than a result can be is cut, and then none.
        with self.process.stdout as answers, contextlib.suppress(OSError):
            while not self.closed and (line := answers.readline(2 * MOST_BYTES)):
                self.room.acquire()
                events.put((self, line))
        events.put((self, b""))

    def hand(self, case: Case, folders: Folders) -> None:
        """Hand a case to the worker, which begins with it when it has done those before."""
        if not self.cases:
            self.since = time.monotonic()
        self.cases.append(case)
        request = pickle.dumps((case, folders))
        self._send(len(request).to_bytes(LENGTH, "big") + request)

    @property
    def takes_another(self) -> bool:
        """Whether a case can wait behind the one that it is on, which saves waking it for each of many quick ones."""
        # What a case of a user's leaves running must have ended before the next begins.
        return self.quick and len(self.cases) == 1 and not (self.code or self.last or self.closed)

    def give_back(self) -> Case | None:
        """Take back the case behind the one that it is on, if that takes its time; the worker ends with that one."""
        if len(self.cases) < 2 or time.monotonic() - self.since < QUICK:
            return None
        self.last = True
        return self.cases.pop()

    def lost(self) -> list[Case]:
        """Take back what it had not begun when it was ended."""
        lost = list(self.cases) if self.closed else []
        if lost:
            self.cases.clear()
        return lost

    def take(self, line: bytes) -> tuple[Case, dict[str, Any]] | None:
        """Take a line that the worker has answered; return the case and its result where it is one."""
        self.room.release()
        self.silent = self.silent or not line
        if self.closed or not self.cases or not line:
            return None
        try:
            told = json.loads(line)
            # The first line, before it has run anything, and no other.
            if not self.begun and told.get("begun") == self.number:
                self.begun, self.since = True, time.monotonic()
                self._is(replace(self.tree, worker=int(told["worker"])))
                return None
            if told["done"] != self.number:
                raise ValueError("of another case")
            result, clean, printed = dict(told["result"]), bool(told["clean"]), int(told["printed"])
            blank = outcome(self.cases[0], "ok")
            if result.keys() != blank.keys() or result["status"] not in STATUSES or type(result["reason"]) is not str:
                raise ValueError("another form")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            result, clean = outcome(self.cases[0], "failed", "what the worker answered is no result"), False
            printed = None
        return self._finish(result, printed, keep=clean)

    def overdue(self) -> tuple[Case, dict[str, Any]] | None:
        """Return a case that has passed a limit, or whose worker has ended, with its result; None while it runs."""
        if self.closed or not self.cases:
            return None
        case, code = self.cases[0], self.process.poll()
        limit = case.time_limit if self.begun else START_LIMIT
        if code is None and self.silent and hasattr(signal, "SIGCONT"):
            # A worker that has ended may have stopped its shield before, which then cannot tell.
            self.process.send_signal(signal.SIGCONT)
        if code is not None:
            return self._finish(outcome(case, "died", f"the worker process ended by itself ({_told(code)})"))
        if time.monotonic() - self.since > limit:
            what = f"no result within the time limit of {limit:g} s" if self.begun else "the worker did not start"
            return self._finish(outcome(case, "timeout" if self.begun else "died", what))
        if resident_mib(self.tree, whole=bool(self.code)) > case.memory_limit:
            return self._finish(outcome(case, "memory", too_much(case)))
        if self.printed.seek(0, os.SEEK_END) > MOST_PRINTED:
            self.kept, self.place = self._tail(None), 0
            self.printed.truncate(0)
        return None

    def _finish(
        self, result: dict[str, Any], printed: int | None = None, *, keep: bool = False
    ) -> tuple[Case, dict[str, Any]]:
        """Return the present case and its result with what was printed; turn to the next.

        The worker lives on if the case has left nothing behind.

        Args:
            result: without what was printed.
            printed: where in the file it ends, if not with the file.
            keep: whether the worker itself is as before.
        """
        text = self._tail(printed) if self.code or result["status"] not in ("ok", "skipped") else ""
        if text:
            result["reason"] = f"{result['reason']}; " * bool(result["reason"]) + f"printed: {text}"
        if self.code and not (keep and result["status"] == "ok" and not started(self.tree)):
            keep = False
        now = time.monotonic()
        self.quick = now - self.since < QUICK
        self.number += 1
        self.since, self.place, self.kept = now, printed or 0, ""
        if not keep or self.last:
            self.close()
        return self.cases.popleft(), result

    def _tail(self, until: int | None) -> str:
        """Return the end of what the present case has printed up to a place in the file, its end if None."""
        size = self.printed.seek(0, os.SEEK_END)
        end = size if until is None else min(max(until, 0), size)
        # A file that has been emptied meanwhile begins anew.
        start = max(self.place if self.place <= end else 0, end - 8 * MOST_SHOWN)
        self.printed.seek(start)
        words = " ".join([self.kept, *self.printed.read(end - start).decode(errors="replace").split()]).strip()
        return one_line(words if len(words) <= MOST_SHOWN else "..." + words[3 - MOST_SHOWN :], MOST_SHOWN)

    @property
    def closed(self) -> bool:
        """Whether it has been ended."""
        return self.process.stdin is None or self.process.stdin.closed

    def close(self) -> None:
        """End the worker with all that it has started, whatever they are doing."""
        if self.closed:
            return
        end(self.tree)
        self.process.kill()
        self.process.wait()
        self.guardian.forget(self.tree.mark)
        assert self.process.stdin is not None
        # What was left unsent is of no use to anybody.
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        self.printed.close()
        self.room.release()
        # It ends with the last process that could write to it.
        self.listener.join(timeout=1)


def _nameless_file() -> tuple[io.FileIO, io.FileIO]:
    """Return an empty file, to read and to append to, that is gone with the last process that has it.

    It is opened twice: what a worker appends must not move the place from which it is read.
    """
    handle, name = tempfile.mkstemp(prefix="latticebench-")
    os.close(handle)
    read, written = open(name, "r+b", buffering=0), open(name, "ab", buffering=0)  # noqa: SIM115
    # Windows keeps the name as long as the file is open.
    with contextlib.suppress(OSError):
        os.unlink(name)
    return read, written


def _told(code: int) -> str:
    """Say how a process ended."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"
