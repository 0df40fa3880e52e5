"""The command line within this process, which saves the imports of a process of its own; what several tests type."""

from __future__ import annotations

import io
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

import pytest

from latticebench.bench.cli import main
from latticebench.bench.report import screen
from pace import pace

# Gives the seeds of an attack from one number to before another; `--fresh` moves them.
Seeds = Callable[[int, int], range]
# A long attack runs one of so many of its blocks again and again with the same seeds, and all of them with `--fresh`.
REPEATED = 3
# Processor seconds of a 2.5 GHz core after which what is small, or refused, counts as a hang.
SOON = 20.0
# A suite of four small cases; an equation for any recording, and its fit.
SUITE = """
[methods.zero]
method = "zero"
[methods.other]
method = "least-squares"
[[grid]]
system = "phi4"
sites = 5
samples = 8
span = 1.0
libraries = ["lib1"]
noise = [0.0, 0.01]
"""
EQUATION = ("--terms", "u[n]; u[n]**3", "--order", 2, "--ends", "free")
FIT = (*EQUATION, "--method", "least-squares")


def blocks(first: int, end: int, length: int) -> list[Any]:
    """Return where the blocks of a long attack begin, which takes the seeds from one number to before another."""
    return [
        pytest.param(begin, marks=[pytest.mark.fresh] if number % REPEATED else [])
        for number, begin in enumerate(range(first, end, length))
    ]


def latticebench(*arguments: object, cwd: Path) -> tuple[int, str, str]:
    """Run a command; return its exit code, what it prints, and what it complains of."""
    out, err, before = io.StringIO(), io.StringIO(), Path.cwd()
    os.chdir(cwd)
    try:
        with (
            mock.patch.object(sys, "argv", ["latticebench", *map(str, arguments)]), redirect_stdout(out),
            # How long a command takes is no matter of what it complains of.
            mock.patch.object(screen, "LINE_EVERY", float("inf")),
            redirect_stderr(err), mock.patch.dict(os.environ), pytest.raises(SystemExit) as end,
        ):  # fmt: skip
            main()
    finally:
        os.chdir(before)
    return int(end.value.code or 0), out.getvalue(), err.getvalue()


def soon(*arguments: object, cwd: Path) -> tuple[int, str, str]:
    """Run a command that must not take long."""
    with no_longer_than(SOON):
        return latticebench(*arguments, cwd=cwd)


def succeed(*arguments: object, cwd: Path) -> str:
    """Run a command that must succeed, and return what it prints."""
    code, out, err = latticebench(*arguments, cwd=cwd)
    assert code == 0, (arguments, err)
    return out


def refused(*arguments: object, cwd: Path) -> str:
    """Run a command that must be refused soon and print nothing, and return the one line that says why."""
    code, out, err = soon(*arguments, cwd=cwd)
    assert (code, out) == (2, ""), (arguments, err)
    assert err.startswith("error: "), err
    assert err.count("\n") == 1, err
    return err


class Hang(BaseException):
    """A command takes longer than it may."""


@contextmanager
def no_longer_than(seconds: float) -> Iterator[None]:
    """Raise Hang in what takes more processor seconds of a 2.5 GHz core, where the system can."""
    if not hasattr(signal, "setitimer"):
        yield
        return

    def late(_number: int, _frame: FrameType | None) -> None:
        # A slow processor has the rest of its time; how slow it is need only be known of what takes long.
        rest = began + seconds * pace() - time.process_time()
        if rest <= 0:
            raise Hang
        signal.setitimer(signal.ITIMER_VIRTUAL, rest)

    before = signal.signal(signal.SIGVTALRM, late)
    began = time.process_time()
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def content(folder: Path) -> dict[str, bytes]:
    """Return what is in the files below a folder."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@contextmanager
def unchanged(folder: Path) -> Iterator[None]:
    """Check that nothing below a folder is changed."""
    before = content(folder)
    yield
    assert content(folder) == before
