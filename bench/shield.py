"""A process between the runner and a worker: what a case does to its parent process, it does to this one.

It makes the worker as a copy of itself, before much is imported, and ends as the worker ends. Windows has none: there
a process cannot be copied.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
from contextlib import suppress

from latticebench.bench.tree import adopt_orphans, end_descendants


def serve() -> None:
    """Wait for a byte on standard input, then be the shield of a worker, and the worker (see `bench.worker`)."""
    # Until then, what is started here would not be in this process's control group.
    os.read(0, 1)
    if hasattr(os, "fork"):
        adopt_orphans()
        if worker := os.fork():
            _end_as(worker)
        os.setsid()
    faulthandler.enable()
    from latticebench.bench.worker import serve as run_cases

    run_cases()


def _end_as(worker: int) -> None:
    """Wait for the end of the worker, end what it has left behind, and end in the same way."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    # The pipes are the worker's, and end with it.
    os.close(0)
    os.close(1)
    _, status = os.waitpid(worker, 0)
    # Whatever it has done to this process, such as to its limits, must not hide how it ended.
    with suppress(Exception):
        end_descendants(os.getpid())
    if os.WIFSIGNALED(status):
        _kill_itself(os.WTERMSIG(status))
    os._exit(os.WEXITSTATUS(status))


def _kill_itself(by: int) -> None:
    if sys.platform != "win32":
        import resource

        # The worker has left its memory on the disk already, where that is wanted.
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with suppress(OSError, ValueError):
            signal.signal(by, signal.SIG_DFL)
        os.kill(os.getpid(), by)
