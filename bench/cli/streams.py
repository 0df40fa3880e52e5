"""Standard streams and environment, made safe before a command begins."""

from __future__ import annotations

import io
import os
import sys
from typing import Any


class _Dropping(io.FileIO):
    """A file in which what cannot be written is lost without a word."""

    def write(self, content: Any) -> int:
        """Write what can be written."""
        try:
            return super().write(content)
        except OSError:
            return len(content)


def settle() -> None:
    """Make the standard streams such that a program may use them.

    Closed ones lead nowhere, since the next file that is opened would take their place and be given what is printed.
    A full disk below standard error, where progress and remarks go, ends no work. A file's name may be of any bytes.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # It gets the lowest number that is free, which is this one; processes that are started have it, too.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    sys.stdin = sys.stdin or os.fdopen(0, closefd=False)
    sys.stdout = sys.stdout or os.fdopen(1, "w", encoding="utf-8", closefd=False)
    sys.stderr = sys.stderr or os.fdopen(2, "w", encoding="utf-8", closefd=False)
    # Whoever calls from Python may have put another stream there.
    own = sys.stderr is sys.__stderr__
    if own and isinstance(sys.stderr, io.TextIOWrapper) and not sys.stderr.isatty():
        below = io.BufferedWriter(_Dropping(2, "w", closefd=False))
        sys.stderr = io.TextIOWrapper(below, encoding=sys.stderr.encoding, line_buffering=True)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def disarm() -> None:
    """Keep environment variables from breaking other packages: no picture needs a window, and dates are in range."""
    os.environ["MPLBACKEND"] = "agg"
    # NumPy and Matplotlib make dates of these seconds, which years of five digits end with a traceback.
    seconds = os.environ.get("SOURCE_DATE_EPOCH", "0")
    if not (seconds.isdecimal() and len(seconds) <= 11):
        del os.environ["SOURCE_DATE_EPOCH"]


def lead_nowhere() -> None:
    """Let standard output lead nowhere: what could not be written would be tried again, and told, at the exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
