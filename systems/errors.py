"""The one error that a user can cause."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Something a user gave is wrong; the text says what, where, and what to do.

    The command line prints the text as one line and exits with code 2.
    """


def unknown(kind: str, given: str, known: Iterable[str], where: str = "") -> InputError:
    """Build the error for a name that is not among the known ones, with the nearest as a suggestion."""
    names = sorted(known)
    near = difflib.get_close_matches(given, names, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    prefix = f"{where}: " if where else ""
    return InputError(f"{prefix}unknown {kind} {given!r}; {hint}there are: {', '.join(names) or 'none'}")
