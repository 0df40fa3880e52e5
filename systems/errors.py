"""The error that is raised for everything a user can give wrongly."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Raised for wrong input; the message says what is wrong, where, and what to do.

    The command line prints the message as one line and exits with code 2.
    """


def printable(text: str) -> str:
    """Return a text in one line in which every sign that does not show is written as an escape.

    So neither a file's name nor a label can steer a terminal or end a line of a file.
    """
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)


def unknown(kind: str, given: str, known: Iterable[str], where: str = "") -> InputError:
    """Return the error for a name that is not among the known ones, with the closest one as a suggestion."""
    names = sorted(known)
    near = difflib.get_close_matches(given, names, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    prefix = f"{where}: " if where else ""
    return InputError(f"{prefix}unknown {kind} {given!r}; {hint}known: {', '.join(names) or 'none'}")
