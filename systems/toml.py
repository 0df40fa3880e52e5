"""Reading TOML files, with errors that name the file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from latticebench.systems.errors import InputError
from latticebench.systems.files import one_sentence, read_text, shown

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

# Tables and lists within one another, at most.
DEEPEST = 50


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file.

    Raises:
        InputError: it is missing, too long, not a regular file, not text, or not TOML.
    """
    # Some editors begin a file with a mark of its bytes' order.
    text = read_text(path).removeprefix("\ufeff")
    try:
        found = tomllib.loads(text)
        _check_depth(found)
        return found
    # A number of too many digits is a ValueError, too.
    except (ValueError, RecursionError) as error:
        raise InputError(f"{shown(path)}: not TOML: {one_sentence(error)}") from None


def _check_depth(content: dict[str, Any]) -> None:
    """Refuse tables within tables that no recursive function could walk through; dots make them without brackets.

    Raises:
        RecursionError: there are more than DEEPEST.
    """
    level: list[Any] = [content]
    for _ in range(DEEPEST):
        level = [
            inner for one in level if isinstance(one, (dict, list))
            for inner in (one.values() if isinstance(one, dict) else one)
        ]  # fmt: skip
        if not level:
            return
    raise RecursionError
