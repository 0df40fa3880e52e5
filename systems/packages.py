"""What other installed packages bring: each method or system under an entry point with its name.

    [project.entry-points."latticebench.methods"]
    ridge = "my_package.ridge:Ridge"

    [project.entry-points."latticebench.systems"]
    toda = "my_package.toda:SYSTEM"

Names are known without importing anything; a package is imported when one of its names is asked for.
"""

from __future__ import annotations

import functools
import importlib.util
import sys
from collections.abc import Iterable
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from latticebench.systems.errors import InputError

METHODS = "latticebench.methods"
SYSTEMS = "latticebench.systems"


def brought(group: str) -> dict[str, EntryPoint]:
    """Return what packages bring, METHODS or SYSTEMS, by name; of two of one name the first that Python finds."""
    return dict(_brought(group, tuple(sys.path)))


def hidden(group: str, own: Iterable[str]) -> dict[str, str]:
    """Return by its name why something that a package brings cannot be used: the name is one of our `own`."""
    entries = brought(group)
    return {
        name: f"{package(entries[name])}: not used, since latticebench has {name!r} itself; it needs another name"
        for name in own if name in entries
    }  # fmt: skip


@functools.lru_cache(maxsize=16)
def _brought(group: str, path: tuple[str, ...]) -> dict[str, EntryPoint]:  # noqa: ARG001
    found: dict[str, EntryPoint] = {}
    for entry in entry_points(group=group):
        found.setdefault(entry.name, entry)
    return dict(sorted(found.items()))


def load(entry: EntryPoint) -> Any:
    """Import what an entry point names.

    Raises:
        InputError: it cannot be imported; the text names the package.
    """
    try:
        return entry.load()
    # Code of somebody else's may raise anything when it is imported.
    except (Exception, SystemExit) as error:
        raise InputError(
            f"{package(entry)}: {entry.name!r} cannot be imported from {entry.value}: {type(error).__name__}: {error}"
        ) from None


def package(entry: EntryPoint) -> str:
    """Return the name and the version of the package that an entry point is of."""
    return f"package {entry.dist.name} {entry.dist.version}" if entry.dist is not None else "a package without a name"


def sources(entry: EntryPoint) -> set[Path]:
    """Return the Python files of the module or package that an entry point names, without importing it."""
    try:
        spec = importlib.util.find_spec(entry.module.partition(".")[0])
    except (ImportError, ValueError):
        spec = None
    if spec is None:
        return set()
    folders = spec.submodule_search_locations or ()
    alone = {Path(spec.origin)} if spec.origin is not None and not folders else set()
    return alone | {path for folder in folders for path in Path(folder).rglob("*.py")}
