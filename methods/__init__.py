"""How it is found: the protocol of a method, and one file per method."""

from __future__ import annotations

import functools
import importlib
import pkgutil
from pathlib import Path
from typing import TYPE_CHECKING

from latticebench.systems import packages
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.user_files import load_module

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

    from latticebench.methods.method import Method

# What a fit uses when no method is named.
DEFAULT = "trajectory"
# Methods of earlier versions, and what they are called now.
RENAMED = {"pinn-vp": "pielm"}


def registered() -> dict[str, type[Method]]:
    """Return every method of this package by its name: what the modules list in `METHODS`."""
    return dict(_own())


@functools.cache
def _own() -> dict[str, type[Method]]:
    found: dict[str, type[Method]] = {}
    for info in pkgutil.iter_modules(__path__):
        module = importlib.import_module(f"{__name__}.{info.name}")
        found.update({kind.name: kind for kind in getattr(module, "METHODS", ())})
    return dict(sorted(found.items()))


def brought() -> dict[str, EntryPoint]:
    """Return the methods that other packages bring, by name; none of them is imported, and none hides one of ours."""
    own = registered()
    return {name: entry for name, entry in packages.brought(packages.METHODS).items() if name not in own}


def find(name: str, base: Path | None = None) -> type[Method]:
    """Return a method by its name, or from a user's file.

    Args:
        name: a name from `registered()` or `brought()`, or the path of a Python file that defines `METHODS`; where
            that has several methods, `FILE.py:NAME`.
        base: the folder that a relative path starts from; the working directory when None.

    Raises:
        InputError: there is no such method or file, or the package that brings it cannot be imported.
    """
    path, _, wanted = name.rpartition(":") if ".py:" in name else (name, "", "")
    if path.endswith(".py"):
        full = (base or Path()) / path
        listed = getattr(load_module(full), "METHODS", ())
        if not isinstance(listed, (tuple, list)) or not listed or not all(hasattr(kind, "name") for kind in listed):
            raise InputError(f"{full}: it must define METHODS = (YourMethod,), classes with a name")
        kinds: dict[str, type[Method]] = {kind.name: kind for kind in listed}
        for kind in kinds.values():
            _check(kind, str(full))
        if not wanted and len(kinds) > 1:
            raise InputError(f"{full}: it has several methods; choose one as {path}:{sorted(kinds)[0]}")
        if wanted and wanted not in kinds:
            raise unknown("method", wanted, kinds, str(full))
        return kinds[wanted or next(iter(kinds))]
    known = registered()
    if name in RENAMED:
        raise InputError(f"method {name!r} is called {RENAMED[name]!r} now; write {RENAMED[name]}")
    if name in known:
        return known[name]
    others = brought()
    if name in others:
        loaded: type[Method] = packages.load(others[name])
        _check(loaded, packages.package(others[name]))
        return loaded
    raise InputError(f"{unknown('method', name, {*known, *others})} (or the path of a .py file)")


def _check(kind: type[Method], where: str) -> None:
    """Refuse what is no method."""
    lacking = [part for part in ("name", "abilities", "fit") if not hasattr(kind, part)]
    if lacking:
        called = getattr(kind, "name", kind)
        raise InputError(f"{where}: method {called!r} has no {lacking[0]!r}; see methods/method.py for the protocol")
