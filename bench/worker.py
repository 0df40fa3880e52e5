"""What happens in a worker process: one case at a time, whose failure becomes its result."""

from __future__ import annotations

import json
import os
import pickle
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, BinaryIO

from latticebench.bench.case import Case, Folders
from latticebench.bench.memory import memory_limit
from latticebench.bench.tree import adopt_orphans, bury_orphans
from latticebench.methods.method import Skipped
from latticebench.systems.errors import InputError
from latticebench.systems.user_files import raised

MAX_REASON = 300
# Bytes of a result as JSON.
MOST_BYTES = 64 * 2**20
# Bytes that tell how long a request is.
LENGTH = 8


def serve() -> None:
    """Take cases from standard input and answer on standard output, a line of JSON each, until there are no more.

    A case gets neither: it reads nothing, and what it prints, by whatever way, goes to standard error.
    """
    requests, answers = _own_pipes()
    adopt_orphans()
    own, number = os.getpid(), 0
    while head := requests.read(LENGTH):
        case, folders = pickle.loads(requests.read(int.from_bytes(head, "big")))
        number += 1
        # The first case has waited for this process to start; each later one is taken as it comes.
        if number == 1:
            _answer(answers, {"begun": number, "worker": own})
        threads = threading.active_count()
        result = attempt(case, folders)
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        # A copy of this process that the case has made ends here.
        if os.getpid() != own:
            os._exit(0)
        bury_orphans()
        printed = os.fstat(2).st_size
        clean = threading.active_count() <= threads
        _answer(answers, {"done": number, "result": result, "clean": clean, "printed": printed})
    # A thread that a case has left must not hold the end up.
    os._exit(0)


def _own_pipes() -> tuple[BinaryIO, BinaryIO]:
    """Return standard input and output, moved to where nobody looks for them."""
    requests, answers = os.dup(0), os.dup(1)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    return os.fdopen(requests, "rb"), os.fdopen(answers, "wb")


def _answer(pipe: BinaryIO, content: Mapping[str, Any]) -> None:
    pipe.write(json.dumps(content).encode() + b"\n")
    pipe.flush()


def attempt(case: Case, folders: Folders) -> dict[str, Any]:
    """Run a case; whatever goes wrong becomes its status and reason.

    Returns:
        `status` (ok, skipped, failed or memory), `reason`, and the names of `Case.blank` with what is known of them.
    """
    found = case.blank()
    try:
        with memory_limit(case.memory_limit):
            case.run(folders, found)
        _check(found)
    except Skipped as skipped:
        return outcome(case, "skipped", str(skipped), found)
    except MemoryError:
        return outcome(case, "memory", too_much(case), found)
    # Even SystemExit and KeyboardInterrupt: a method may raise anything, and nobody else does so here.
    except BaseException as error:
        text = _text(error)
        if "allocate memory" in text or "Unable to allocate" in text:
            return outcome(case, "memory", too_much(case), found)
        told = text if isinstance(error, InputError) else raised(error)
        return outcome(case, "failed", told, found if _is_result(found) else None)
    return outcome(case, "ok", "", found)


def outcome(case: Case, status: str, reason: str = "", found: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return a result: a status of `bench.case.STATUSES`, the reason in one short line, and what was found."""
    return {
        "status": status,
        "reason": one_line(reason, MAX_REASON),
        **(case.blank() if found is None else found),
    }


def one_line(text: str, most: int) -> str:
    """Return a text in one line, at most so long, with a question mark for every character that cannot be printed."""
    return "".join(sign if sign.isprintable() else "?" for sign in " ".join(text[: 8 * most].split()))[:most]


def too_much(case: Case) -> str:
    """Return the reason of a case that was stopped at its memory limit."""
    return f"more than {case.memory_limit} MiB of memory were needed"


def _text(error: BaseException) -> str:
    """Return what an error says; one of a user's may fail to say anything."""
    try:
        return str(error)
    except BaseException:
        return "it says nothing"


def _check(found: Mapping[str, Any]) -> None:
    """Refuse what is no result: what a user's method returns may be anything.

    Raises:
        TypeError, ValueError: JSON cannot hold it.
        RecursionError: it is nested too deeply.
        InputError: it is too long.
    """
    size = len(json.dumps(found, allow_nan=False))
    if size > MOST_BYTES:
        raise InputError(f"the result is too long: {size / 2**20:.0f} MiB as text, at most {MOST_BYTES // 2**20}")


def _is_result(found: Mapping[str, Any]) -> bool:
    try:
        _check(found)
    except (TypeError, ValueError, RecursionError, MemoryError):
        return False
    return True
