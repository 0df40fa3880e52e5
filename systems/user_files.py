"""What users define in files of their own: a system, a catalogue of effects, a Python module."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from dataclasses import fields
from pathlib import Path
from typing import Any

from latticebench.systems.effects import CATALOGUE, Effect
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.files import check_regular
from latticebench.systems.lattice import Initial, Library, System, library
from latticebench.systems.parser import TermError
from latticebench.systems.toml import read_toml

REQUIRED = ("name", "equation", "order", "initials")
WITH_DEFAULTS = ("title", "complex", "parameters", "libraries", "source")
OPTIONAL = ("half_length", "sites", "ends", "integrator", "notes", "conserved")


def load_system(path: Path) -> System:
    """Return the system of a Python file that defines `SYSTEM`, or of a TOML file.

    A TOML file has the fields of `System` as keys, `complex` for `is_complex`; `initials` is a table of tables with `u`
    and `v`, `libraries` a table of lists of terms.

    Raises:
        InputError: the file is missing or does not hold a valid system.
    """
    if path.suffix == ".py":
        found = getattr(load_module(path), "SYSTEM", None)
        if not isinstance(found, System):
            raise InputError(f"{path}: it must define SYSTEM = System(...)")
        return found
    content = read_toml(path)
    try:
        _check_keys(content)
        return _system(content, path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


# What the names of users' modules begin with.
USER = "latticebench_user_"


def raised(error: BaseException) -> str:
    """Return the type and text of an exception, and the last line of a user's file that it went through."""
    try:
        text = str(error)
    except BaseException:
        # Code of the user's may raise anything.
        text = "it says nothing"
    lines = [
        f" ({Path(frame.f_code.co_filename).name}, line {line})"
        for frame, line in traceback.walk_tb(error.__traceback__)
        if str(frame.f_globals.get("__name__", "")).startswith(USER)
    ]
    return f"{type(error).__name__}: {text}{lines[-1] if lines else ''}"


def load_module(path: Path) -> Any:
    """Import a Python file under a name of its own, and return the module.

    Raises:
        InputError: the file is missing or fails when it is imported.
    """
    check_regular(path)
    spec = importlib.util.spec_from_file_location(f"{USER}{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up by its name.
    sys.modules[spec.name] = module
    try:
        # No bytecode is written into the user's folder.
        before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
        try:
            spec.loader.exec_module(module)
        finally:
            sys.dont_write_bytecode = before
    # Code of the user's may raise anything; Ctrl-C is no fault of its own.
    except BaseException as error:
        sys.modules.pop(spec.name, None)
        if isinstance(error, KeyboardInterrupt):
            raise
        if isinstance(error, InputError):
            raise InputError(f"{path}: {error}") from error
        raise InputError(f"{path}: it cannot be imported: {raised(error)}") from error
    return module


def load_effects(path: Path) -> tuple[Effect, ...]:
    """Return the effects of a TOML file with one table `[[effect]]` for each.

    The keys are the fields of `Effect`; `name` and `formula` are required:

        [[effect]]
        name = "cubic-drag"
        formula = "v[n]**3"
        orders = [2]
        look_for = "amplitudes that fall as one over the root of time"

    Raises:
        InputError: the file is missing or an entry is invalid; the message names the file and the entry.
    """
    content = read_toml(path)
    for key in content:
        if key != "effect":
            raise unknown("key", key, ["effect"], str(path))
    entries = content.get("effect")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: give at least one table [[effect]] with a name and a formula")
    found = []
    for number, entry in enumerate(entries, start=1):
        try:
            found.append(_effect(entry))
        except InputError as error:
            raise InputError(f"{path}: effect {number}: {error}") from None
    names = [effect.name for effect in (*CATALOGUE, *found)]
    for effect in found:
        if names.count(effect.name) > 1:
            raise InputError(f"{path}: there are two effects called {effect.name!r}")
    return tuple(found)


def _check_keys(content: dict[str, Any]) -> None:
    """Refuse a system with an unknown or missing key, or a value of the wrong kind."""
    known = (*REQUIRED, *WITH_DEFAULTS, *OPTIONAL)
    for key in content:
        if key not in known:
            raise unknown("key", key, known)
    for key in REQUIRED:
        if key not in content:
            raise InputError(f"the key {key!r} is missing")
    is_complex = content.get("complex", False)
    if not isinstance(is_complex, bool):
        raise InputError(f"complex is {is_complex!r}; it must be true or false")
    for key in ("parameters", "initials", "libraries"):
        if not isinstance(content.get(key, {}), dict):
            raise InputError(f"{key} is {content[key]!r}; it must be a table, as under [{key}]")
    for kind, texts in content["initials"].items():
        if not isinstance(texts, dict) or "u" not in texts or not set(texts) <= {"u", "v"}:
            raise InputError(f"initials.{kind} is {texts!r}; it must be a table of u and, for order 2, v")


def _system(content: dict[str, Any], path: Path) -> System:
    return System(
        name=content["name"],
        title=content.get("title", content["name"]),
        equation=content["equation"],
        order=content["order"],
        is_complex=content.get("complex", False),
        parameters=content.get("parameters", {}),
        initials={name: Initial(**texts) for name, texts in content["initials"].items()},
        libraries=tuple(_library(name, terms) for name, terms in content.get("libraries", {}).items()),
        source=content.get("source", str(path)),
        **{key: content[key] for key in OPTIONAL if key in content},
    )


def _library(name: str, terms: Any) -> Library:
    """Return the library that a file has under libraries.NAME."""
    if not isinstance(terms, str) and not (isinstance(terms, list) and all(isinstance(one, str) for one in terms)):
        raise InputError(f"libraries.{name} is {terms!r}; it must be a list of terms, or one text with ; between them")
    try:
        return library(name, terms)
    except TermError as error:
        raise InputError(f"libraries.{name}: {error}") from None


def _effect(entry: Any) -> Effect:
    """Return the effect of one table of a catalogue."""
    if not isinstance(entry, dict):
        raise InputError(f"it is {entry!r}; it must be a table [[effect]]")
    known = [one.name for one in fields(Effect)]
    for key in entry:
        if key not in known:
            raise unknown("key", key, known)
    for key in ("name", "formula"):
        if not isinstance(entry.get(key), str):
            raise InputError(f"the key {key!r} is missing or is no text")
    orders = entry.get("orders", [1, 2])
    if not isinstance(orders, list) or not orders or any(type(one) is not int or one not in (1, 2) for one in orders):
        raise InputError(f"orders is {orders!r}; it must be a list of 1 and 2")
    for key, value in entry.items():
        wanted = bool if key in ("real", "takes") else list if key == "orders" else str
        if not isinstance(value, wanted):
            raise InputError(f"{key} is {value!r}; it must be a {wanted.__name__}")
    return Effect(**{**entry, "orders": tuple(orders)})
