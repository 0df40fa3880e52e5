"""Control groups of Linux (version 2): what a worker starts stays in its group, however it hides.

A group is a folder. A worker has one where this process may make folders in its own group or beside it, as in a desktop
session or below `systemd-run --user --scope -p Delegate=yes`; elsewhere it has none, and nothing here does anything.
"""

from __future__ import annotations

import contextlib
import os
import time
from functools import cache
from pathlib import Path

NAME = "latticebench-"
# How often what is in a group is killed until it is empty, and the pause.
ROUNDS = 200
PAUSE = 0.01


def enter(process: int, mark: str) -> None:
    """Put a process into a group of its own, where it can be.

    Args:
        process: its number.
        mark: a text of its own, by which the group is found again.
    """
    for place in _places():
        folder = place / (NAME + mark)
        try:
            folder.mkdir()
        except OSError:
            continue
        try:
            (folder / "cgroup.procs").write_text(str(process))
        except OSError:
            with contextlib.suppress(OSError):
                folder.rmdir()
        else:
            return


def members(mark: str) -> list[int]:
    """Return the numbers of the processes in a group and in those within it; none where there is no group."""
    found: list[int] = []
    for folder in _folders(mark):
        with contextlib.suppress(OSError):
            found += [int(line) for line in (folder / "cgroup.procs").read_text().split()]
    return found


def end(mark: str) -> None:
    """Kill what is in a group, and remove it."""
    for _ in range(ROUNDS):
        folders = _folders(mark)
        if not folders:
            return
        with contextlib.suppress(OSError):
            (folders[0] / "cgroup.kill").write_text("1")
        # Linux before 5.14 cannot kill a group at once.
        for process in members(mark):
            with contextlib.suppress(OSError):
                os.kill(process, 9)
        try:
            for folder in reversed(folders):
                folder.rmdir()
        except OSError:
            time.sleep(PAUSE)


def _folders(mark: str) -> list[Path]:
    """Return the folder of a group and those within it, each before its own."""
    for place in _places():
        folder = place / (NAME + mark)
        if folder.is_dir():
            return [Path(name) for name, _, _ in os.walk(folder)]
    return []


@cache
def _places() -> tuple[Path, ...]:
    """Return the folder of this process's own group and the one above; none where there are no such groups."""
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
        own = next(line.removeprefix("0::") for line in lines if line.startswith("0::"))
        mounts = Path("/proc/self/mountinfo").read_text().splitlines()
        root, mount = next(line.split()[3:5] for line in mounts if " - cgroup2 " in line)
    except (OSError, StopIteration):
        return ()
    path = os.path.relpath(own, root)
    if path.startswith(".."):
        return ()
    folder = Path(mount) / path
    return (folder,) if path == "." else (folder, folder.parent)
