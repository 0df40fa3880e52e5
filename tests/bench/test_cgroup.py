"""Control groups: a process that hides from all else that finds it is found, and ended with its group."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from latticebench.bench import cgroup, tree

# Leaves its session, its parent and its environment behind, and tells the number of what is left.
HIDES = """
import os, subprocess, sys
if not os.fork():
    os.setsid()
    left = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"], env={}, stdout=subprocess.DEVNULL)
    print(left.pid, flush=True)
    os._exit(0)
os.wait()
"""


@pytest.fixture
def mark(groups: bool) -> Iterator[str]:
    """The mark of a group, ended with the test."""
    if not groups:
        pytest.skip("no control group can be made here")
    text = uuid.uuid4().hex
    yield text
    cgroup.end(text)


def soon(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)


def gone(process: int) -> bool:
    return not psutil.pid_exists(process) or psutil.Process(process).status() == psutil.STATUS_ZOMBIE


def test_what_hides_is_found_in_the_group_and_ended_with_it(mark: str) -> None:
    program = f"import sys; sys.stdin.readline()\n{HIDES}"
    with subprocess.Popen([sys.executable, "-c", program], stdin=-1, stdout=-1, text=True) as leader:
        cgroup.enter(leader.pid, mark)
        out, _ = leader.communicate("go\n")
    left = int(out)
    assert [one.pid for one in tree.started(tree.Tree(mark, leader.pid, leader.pid))] == [left]
    tree.end(tree.Tree(mark, leader.pid, leader.pid))
    soon(lambda: gone(left))
    assert cgroup.members(mark) == []


def test_the_memory_of_what_hides_counts(mark: str) -> None:
    program = "import sys, time; x = b'1' * 2**27; print(1, flush=True); time.sleep(600)"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as other:
        cgroup.enter(other.pid, mark)
        assert other.stdout is not None
        other.stdout.readline()
        own = psutil.Process().memory_info().rss / 2**20
        assert tree.resident_mib(tree.Tree(mark, os.getpid(), os.getpid()), whole=True) > 128
        assert tree.resident_mib(tree.Tree(mark, os.getpid(), os.getpid()), whole=False) == pytest.approx(own, rel=0.5)
        cgroup.end(mark)
        assert other.wait(60) == -9


def test_a_group_with_groups_within_is_ended_and_removed(mark: str) -> None:
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]) as one:
        cgroup.enter(one.pid, mark)
        (folder,) = cgroup._folders(mark)
        (folder / "within" / "deeper").mkdir(parents=True)
        (folder / "within" / "deeper" / "cgroup.procs").write_text(str(one.pid))
        assert cgroup.members(mark) == [one.pid]
        cgroup.end(mark)
        assert one.wait(60) == -9
    assert not folder.exists()


@pytest.mark.parametrize(
    ("own", "mounts", "expected"),
    [
        ("0::/a/b\n", "31 1 0:3 / /m rw - cgroup2 cgroup2 rw\n", ("/m/a/b", "/m/a")),
        ("3:cpu:/x\n0::/\n", "30 1 0:2 / /v1 rw - cgroup x rw\n31 1 0:3 / /m rw - cgroup2 c rw\n", ("/m",)),
        ("0::/box/a\n", "31 1 0:3 /box /m rw - cgroup2 cgroup2 rw\n", ("/m/a", "/m")),
        ("0::/../other\n", "31 1 0:3 /box /m rw - cgroup2 cgroup2 rw\n", ()),
        ("3:cpu:/x\n", "31 1 0:3 / /m rw - cgroup2 cgroup2 rw\n", ()),
        ("0::/\n", "30 1 0:2 / /v1 rw - cgroup x rw\n", ()),
    ],
)
def test_the_group_of_a_process_is_found_where_it_is_mounted(
    own: str, mounts: str, expected: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = {"/proc/self/cgroup": own, "/proc/self/mountinfo": mounts}
    monkeypatch.setattr(Path, "read_text", lambda self: texts[str(self)])
    assert tuple(map(str, cgroup._places.__wrapped__())) == expected
