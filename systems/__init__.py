"""What is studied: terms, lattices, samples, simulation, effects, and one file per system.

"The paper" is S. Saqlain, W. Zhu, E. G. Charalampidis and P. G. Kevrekidis, Discovering Governing Equations in Discrete
Systems Using PINNs; its equations, libraries, initial states and sampling are where the benchmark starts.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from pathlib import Path
from typing import TYPE_CHECKING

from latticebench.systems.errors import InputError, unknown

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from latticebench.systems.lattice import System


def names() -> list[str]:
    """Return the names of all systems of this package, one per module that defines `SYSTEM`."""
    return sorted(
        module.SYSTEM.name
        for name in _modules()
        if hasattr(module := importlib.import_module(f"{__name__}.{name}"), "SYSTEM")
    )


@functools.cache
def _modules() -> tuple[str, ...]:
    return tuple(info.name for info in pkgutil.iter_modules(__path__))


def brought() -> dict[str, EntryPoint]:
    """Return the systems that other packages bring, by name; none of them is imported, and none hides one of ours."""
    from latticebench.systems import packages

    own = names()
    return {name: entry for name, entry in packages.brought(packages.SYSTEMS).items() if name not in own}


def find(name: str, base: Path | None = None) -> System:
    """Return a system by its name, or load it from a user's `.py` or `.toml` file.

    Args:
        name: a name from `names()` or `brought()`, or the path of a file.
        base: the folder that a relative path starts from; the working directory if None.

    Raises:
        InputError: there is no such system or file, or the file or the package does not hold a valid system.
    """
    from latticebench.systems import packages
    from latticebench.systems.lattice import System
    from latticebench.systems.user_files import load_system

    if name.endswith((".py", ".toml")):
        return load_system((base or Path()) / name)
    for module in _modules():
        system = getattr(importlib.import_module(f"{__name__}.{module}"), "SYSTEM", None)
        if system is not None and system.name == name:
            return system  # type: ignore[no-any-return]
    others = brought()
    if name in others:
        found = packages.load(others[name])
        if not isinstance(found, System):
            raise InputError(f"{packages.package(others[name])}: {others[name].value} must be a System")
        return found
    error = unknown("system", name, [*names(), *others])
    raise InputError(f"{error} (or the path of a .py or .toml file)")
