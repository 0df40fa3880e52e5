"""A worker process as the runner sees it: started, given one case at a time, watched, and ended."""

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
from queue import SimpleQueue
from typing import Any

from latticebench.bench.case import STATUSES, Case, Folders
from latticebench.bench.guardian import Guardian, search_path
from latticebench.bench.threads import ONE_THREAD
from latticebench.bench.tree import MARK, descendants, end, resident_mib
from latticebench.bench.worker import LENGTH, MOST_BYTES, one_line, outcome, too_much

# Nothing is imported from the working folder.
START = "import sys; sys.path[:] = sys.argv[1].split('\\n'); from latticebench.bench.worker import serve; serve()"
# Seconds until a new worker has imported what it needs.
START_LIMIT = 120.0
# Characters of what a case has printed that are shown in its row; bytes that are kept of it while it runs.
MOST_SHOWN = 200
MOST_PRINTED = 2**20

Events = SimpleQueue["tuple[Process, bytes]"]


class Process:
    """One worker.

    Attributes:
        code: what code of a user's it runs (see `bench.pool.foreign`); a worker is kept for cases of the same.
        case: what it is on; None while it waits.
    """

    def __init__(self, code: str, events: Events, guardian: Guardian) -> None:
        """Start it; what it answers, line by line and at its end nothing, is put into `events`."""
        self.code = code
        self.case: Case | None = None
        self.number, self.since, self.begun = 0, 0.0, False
        self.kept = ""
        self.mark = uuid.uuid4().hex
        self.printed = _nameless_file()
        self.process = subprocess.Popen(
            [sys.executable, "-X", "faulthandler", "-c", START, search_path()],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.printed,
            env={**os.environ, **ONE_THREAD, MARK: self.mark}, start_new_session=True,
        )  # fmt: skip
        self.guardian = guardian
        guardian.watch_over(self.process.pid, self.mark)
        self.listener = threading.Thread(target=self._listen, args=(events,), daemon=True)
        self.listener.start()

    def _listen(self, events: Events) -> None:
        assert self.process.stdout is not None
        # A line that is longer than a result can be is cut, and then none.
        with self.process.stdout as answers, contextlib.suppress(OSError):
            while line := answers.readline(2 * MOST_BYTES):
                events.put((self, line))
        events.put((self, b""))

    def start(self, case: Case, folders: Folders) -> None:
        """Hand a case to the worker."""
        assert self.process.stdin is not None
        self.case, self.begun, self.since = case, False, time.monotonic()
        self.number += 1
        self.printed.truncate(0)
        self.kept = ""
        request = pickle.dumps((self.number, case, folders))
        # A worker that has ended is found out by `late`.
        with contextlib.suppress(OSError):
            self.process.stdin.write(len(request).to_bytes(LENGTH, "big") + request)
            self.process.stdin.flush()

    def take(self, line: bytes) -> dict[str, Any] | None:
        """Take a line that the worker has answered; return the result of the case where it is one."""
        if self.case is None or not line:
            return None
        try:
            told = json.loads(line)
            if told.get("begun") == self.number:
                self.begun, self.since = True, time.monotonic()
                return None
            if told["done"] != self.number:
                return None
            result, clean = dict(told["result"]), bool(told["clean"])
            blank = outcome(self.case, "ok")
            if result.keys() != blank.keys() or result["status"] not in STATUSES or type(result["reason"]) is not str:
                raise ValueError("another form")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            result, clean = outcome(self.case, "failed", "what the worker answered is no result"), False
        return self._finish(result, keep=clean)

    def overdue(self) -> dict[str, Any] | None:
        """Return the result of a case that has passed a limit, or whose worker has ended; None while it runs."""
        if self.case is None:
            return None
        case, code = self.case, self.process.poll()
        limit = case.time_limit if self.begun else START_LIMIT
        if code is not None:
            return self._finish(outcome(case, "died", f"the worker process ended by itself ({_told(code)})"))
        if time.monotonic() - self.since > limit:
            what = f"no result within the time limit of {limit:g} s" if self.begun else "the worker did not start"
            return self._finish(outcome(case, "timeout" if self.begun else "died", what))
        if resident_mib(self.process.pid, whole=bool(self.code)) > case.memory_limit:
            return self._finish(outcome(case, "memory", too_much(case)))
        if self.printed.seek(0, os.SEEK_END) > MOST_PRINTED:
            self.kept = self._tail()
            self.printed.truncate(0)
        return None

    def _finish(self, result: dict[str, Any], *, keep: bool = False) -> dict[str, Any]:
        """Return the result with what was printed; the worker lives on if the case has left nothing behind."""
        text = self._tail() if self.code or result["status"] not in ("ok", "skipped") else ""
        if text:
            result["reason"] = f"{result['reason']}; " * bool(result["reason"]) + f"printed: {text}"
        self.case = None
        if self.code and not (keep and result["status"] == "ok" and not descendants(self.process.pid)):
            keep = False
        if not keep:
            self.close()
        return result

    def _tail(self) -> str:
        self.printed.seek(max(0, self.printed.seek(0, os.SEEK_END) - 8 * MOST_SHOWN))
        words = " ".join([self.kept, *self.printed.read(8 * MOST_SHOWN).decode(errors="replace").split()]).strip()
        return one_line(words if len(words) <= MOST_SHOWN else "..." + words[3 - MOST_SHOWN :], MOST_SHOWN)

    @property
    def closed(self) -> bool:
        """Whether it has been ended."""
        return self.process.stdin is None or self.process.stdin.closed

    def close(self) -> None:
        """End the worker with all that it has started, whatever they are doing."""
        self.case = None
        if self.closed:
            return
        end(self.process.pid, self.mark)
        self.process.kill()
        self.process.wait()
        self.guardian.forget(self.mark)
        assert self.process.stdin is not None
        # What was left unsent is of no use to anybody.
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        self.printed.close()
        # It ends with the last process that could write to it.
        self.listener.join(timeout=1)


def _nameless_file() -> io.FileIO:
    """Return an empty file that is gone with the last process that has it; writing appends, whoever writes."""
    handle, name = tempfile.mkstemp(prefix="latticebench-")
    os.close(handle)
    opened = open(name, "a+b", buffering=0)  # noqa: SIM115
    # Windows keeps the name as long as the file is open.
    with contextlib.suppress(OSError):
        os.unlink(name)
    return opened


def _told(code: int) -> str:
    """Say how a process ended."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"
