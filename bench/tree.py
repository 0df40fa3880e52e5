"""The processes that a worker has started: how much memory they take, and how to end them all.

A worker leads a session of its own, and carries a mark in its environment that its children inherit. On Linux it also
adopts what its descendants leave behind, so that one that has detached itself is still found below it (when it has
ended, below its shield: `bench.shield`), and has a control group where it can (`bench.cgroup`).
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import psutil

from latticebench.bench import cgroup

# The mark: an environment variable with a text of the worker's own.
MARK = "LATTICEBENCH_WORKER"
# How often the descendants of a worker are looked for and killed, should they keep making new ones, and the pause.
ROUNDS = 200
PAUSE = 0.01
# Pauses within which a shield sees that its worker has ended.
GRACE = 50
ADOPT_ORPHANS = 36  # PR_SET_CHILD_SUBREAPER of linux/prctl.h


def adopt_orphans() -> None:
    """Let this process be the parent of those among its descendants whose own parent ends, where it can (Linux)."""
    if sys.platform.startswith("linux"):
        import ctypes

        ctypes.CDLL(None).prctl(ADOPT_ORPHANS, 1, 0, 0, 0)


def bury_orphans() -> None:
    """Take what is left of adopted processes that have ended off the system's list."""
    if hasattr(os, "WNOHANG"):
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass


@dataclass(frozen=True)
class Tree:
    """The processes of a worker.

    Attributes:
        mark: a text of its own.
        shield: the number of the process that the runner has started, which has started the worker.
        worker: its number; the shield's until it is known.
    """

    mark: str
    shield: int
    worker: int


def started(tree: Tree) -> list[psutil.Process]:
    """Return what a worker has started and is alive: what descends from it, and what is in its control group."""
    found: set[psutil.Process] = set()
    for leader in _leaders(tree):
        with contextlib.suppress(psutil.Error):
            found.update(leader.children(recursive=True))
    for number in cgroup.members(tree.mark):
        with contextlib.suppress(psutil.Error):
            found.add(psutil.Process(number))
    return [one for one in found if one.pid not in (tree.worker, tree.shield) and _alive(one)]


def resident_mib(tree: Tree, *, whole: bool) -> float:
    """Return the memory of a worker in MiB.

    Args:
        tree: its processes.
        whole: with all that it has started; what several of them share counts once, where the system knows (Linux).
    """
    try:
        lone = psutil.Process(tree.worker)
        others = started(tree) if whole else []
        if not others:
            return float(lone.memory_info().rss) / 2**20
    except psutil.Error:
        return 0.0
    return sum(_share(one) for one in (lone, *others)) / 2**20


def end(tree: Tree) -> None:
    """End a worker with all that it has started, whatever they are doing; some of them may have ended before."""
    leaders = _leaders(tree)
    # The worker, or its shield where that has ended: while it is held it adopts, and makes no more itself.
    for one in leaders[:1]:
        with contextlib.suppress(psutil.Error):
            one.suspend()
    _end_all(lambda: started(tree))
    for one in leaders[:1]:
        with contextlib.suppress(psutil.Error):
            one.kill()
    # The shield ends as the worker does.
    for _ in range(GRACE):
        if not any(map(_alive, leaders)):
            break
        time.sleep(PAUSE)
    _end_all(lambda: [one for one in psutil.process_iter() if _marked(one, tree)])
    # Last: what has left the group is found below its leader only while that is there.
    cgroup.end(tree.mark)


def end_descendants(process: int) -> None:
    """End what descends from a process, whatever it is doing, but not the process itself."""
    _end_all(lambda: [one for one in psutil.Process(process).children(recursive=True) if _alive(one)])


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


def _leaders(tree: Tree) -> list[psutil.Process]:
    """Return the worker and its shield, those that are alive."""
    found = []
    for number in dict.fromkeys((tree.worker, tree.shield)):
        with contextlib.suppress(psutil.Error):
            found.append(psutil.Process(number))
    # A number may be another process's by now.
    return [one for one in found if _marked(one, tree)]


def _alive(process: psutil.Process) -> bool:
    try:
        return process.status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    except psutil.Error:
        return False


def _marked(process: psutil.Process, tree: Tree) -> bool:
    """Return whether a process is of the session of a worker or its shield, or has inherited its mark."""
    if process.pid == os.getpid() or not _alive(process):
        return False
    try:
        if os.name == "posix" and os.getsid(process.pid) in (tree.worker, tree.shield):
            return True
        return process.environ().get(MARK) == tree.mark
    except (OSError, psutil.Error):
        return False


def _share(process: psutil.Process) -> float:
    try:
        full = process.memory_full_info()
        return float(getattr(full, "pss", full.uss))
    except psutil.Error:
        return 0.0
