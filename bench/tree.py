"""The processes that a worker has started: how much memory they take, and how to end them all.

A worker leads a session of its own, and carries a mark in its environment that its children inherit. On Linux it also
adopts what its descendants leave behind, so that one that has detached itself is still found below it, and has a
control group where it can (`bench.cgroup`).
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable

import psutil

from latticebench.bench import cgroup

# The mark: an environment variable with a text of the worker's own.
MARK = "LATTICEBENCH_WORKER"
# How often the descendants of a worker are looked for and killed, should they keep making new ones, and the pause.
ROUNDS = 200
PAUSE = 0.01
ADOPT_ORPHANS = 36  # PR_SET_CHILD_SUBREAPER of linux/prctl.h


def adopt_orphans() -> None:
    """Let this process be the parent of those among its descendants whose own parent ends, where it can (Linux)."""
    if sys.platform.startswith("linux"):
        import ctypes

        ctypes.CDLL(None).prctl(ADOPT_ORPHANS, 1, 0, 0, 0)


def started(process: int, mark: str) -> list[psutil.Process]:
    """Return what a worker has started and is alive: what descends from it, and what is in its control group.

    Args:
        process: its number.
        mark: its mark.
    """
    found: set[psutil.Process] = set()
    with contextlib.suppress(psutil.Error):
        found.update(psutil.Process(process).children(recursive=True))
    for number in cgroup.members(mark):
        with contextlib.suppress(psutil.Error):
            found.add(psutil.Process(number))
    return [one for one in found if one.pid != process and _alive(one)]


def resident_mib(process: int, mark: str, *, whole: bool) -> float:
    """Return the memory of a worker in MiB.

    Args:
        process: its number.
        mark: its mark.
        whole: with all that it has started; what several of them share counts once, where the system knows (Linux).
    """
    try:
        lone = psutil.Process(process)
        others = started(process, mark) if whole else []
        if not others:
            return float(lone.memory_info().rss) / 2**20
    except psutil.Error:
        return 0.0
    return sum(_share(one) for one in (lone, *others)) / 2**20


def end(process: int, mark: str) -> None:
    """End a worker with all that it has started, whatever they are doing.

    Args:
        process: its number; it may have ended before.
        mark: its mark.
    """
    with contextlib.suppress(psutil.Error):
        leader = psutil.Process(process)
        # Its number may be another process's by now.
        if _marked(leader, process, mark):
            # While it is held it adopts, and makes no more itself.
            leader.suspend()
            _end_all(lambda: started(process, mark))
            leader.kill()
    _end_all(lambda: [one for one in psutil.process_iter() if _marked(one, process, mark)])
    # Last: what has left the group is found below its leader only while that is there.
    cgroup.end(mark)


def _end_all(look: Callable[[], list[psutil.Process]]) -> None:
    """Kill what is found until nothing is."""
    for _ in range(ROUNDS):
        found = look()
        if not found:
            return
        # All are held before the first is killed: one that sees another end may start a third.
        for one in found:
            with contextlib.suppress(psutil.Error):
                one.suspend()
        for one in found:
            with contextlib.suppress(psutil.Error):
                one.kill()
        time.sleep(PAUSE)


def _alive(process: psutil.Process) -> bool:
    try:
        return process.status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    except psutil.Error:
        return False


def _marked(process: psutil.Process, leader: int, mark: str) -> bool:
    """Return whether a process is of the session of a worker, or has inherited its mark."""
    if process.pid == os.getpid() or not _alive(process):
        return False
    try:
        if os.name == "posix" and os.getsid(process.pid) == leader:
            return True
        return process.environ().get(MARK) == mark
    except (OSError, psutil.Error):
        return False


def _share(process: psutil.Process) -> float:
    try:
        full = process.memory_full_info()
        return float(getattr(full, "pss", full.uss))
    except psutil.Error:
        return 0.0
