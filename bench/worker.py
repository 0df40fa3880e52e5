"""What happens in a worker process: one case at a time, whose failure becomes its result."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import redirect_stdout
from typing import Any

from latticebench.bench.case import Case, Folders
from latticebench.bench.memory import memory_limit
from latticebench.methods.method import Skipped
from latticebench.systems.errors import InputError

MAX_REASON = 300
# How often a worker looks whether its runner still lives, in seconds.
WATCH = 0.5


def ready(kind: type[Case]) -> int:  # noqa: ARG001
    """Return the number of the process, which has imported what a kind of case needs: that is none of a case's time."""
    return os.getpid()


def attempt(case: Case, folders: Folders) -> dict[str, Any]:
    """Run a case; whatever goes wrong becomes its status and reason.

    Returns:
        `status` (ok, skipped, failed or memory), `reason`, and the names of `Case.blank` with what is known of them.
    """
    found = case.blank()
    try:
        # What a method prints is for people, not for a program that reads the result.
        with memory_limit(case.memory_limit), redirect_stdout(sys.stderr):
            case.run(folders, found)
        # What a method of the user's returns may be anything; a result is what JSON can hold.
        json.dumps(found, allow_nan=False)
    except Skipped as skipped:
        return outcome(case, "skipped", str(skipped), found)
    except MemoryError:
        return outcome(case, "memory", too_much(case), found)
    except Exception as error:
        if "allocate memory" in str(error) or "Unable to allocate" in str(error):
            return outcome(case, "memory", too_much(case), found)
        text = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        return outcome(case, "failed", text, found if _is_json(found) else None)
    return outcome(case, "ok", "", found)


def outcome(case: Case, status: str, reason: str = "", found: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return a result: a status of `bench.case.STATUSES`, the reason in one short line, and what was found."""
    return {
        "status": status,
        "reason": " ".join(reason.split())[:MAX_REASON],
        **(case.blank() if found is None else found),
    }


def _is_json(found: Mapping[str, Any]) -> bool:
    try:
        json.dumps(found, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        return False
    return True


def too_much(case: Case) -> str:
    """Return the reason of a case that was stopped at its memory limit."""
    return f"more than {case.memory_limit} MiB of memory were needed"


def follow_runner(runner: int) -> None:
    """Leave Ctrl-C to the runner, and end when the runner is gone.

    Args:
        runner: the number of its process.
    """
    import signal

    import psutil

    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        try:
            parent = psutil.Process(runner)
            while parent.is_running() and parent.status() != psutil.STATUS_ZOMBIE:
                time.sleep(WATCH)
        except psutil.Error:
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
