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


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file.

    Raises:
        InputError: it is missing, too long, not a regular file, not text, or not TOML.
    """
    text = read_text(path)
    try:
        return tomllib.loads(text)
    # A number of too many digits is a ValueError, too.
    except (ValueError, RecursionError) as error:
        raise InputError(f"{shown(path)}: not TOML: {one_sentence(error)}") from None
