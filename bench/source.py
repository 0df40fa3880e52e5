"""The key under which a result is stored: a hash of the case and of the code that decides its result.

A changed method, engine or system is run again, an unchanged one is not; comments, docstrings, layout, and every
module that the computation does not import (pages, tables, the runner, the command line) do not count.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib
import importlib.util
import inspect
import os
import pkgutil
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from latticebench import methods, systems
from latticebench.bench.case import Case, Folders, Roots, code_file
from latticebench.systems import packages
from latticebench.systems.errors import unknown

PACKAGE = "latticebench"
# Where a statement holds others.
BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")
# Hexadecimal digits of a key: 128 bits.
DIGITS = 32


def keys(cases: Mapping[str, Case], folders: Folders) -> dict[str, str]:
    """Return the keys of cases.

    Args:
        cases: by their identities.
        folders: where relative paths start from.

    Returns:
        the keys by the identities, in the same order.
    """
    prints: dict[Roots, str] = {}
    found = {}
    for identity, case in cases.items():
        roots = case.roots
        if roots not in prints:
            prints[roots] = fingerprint(roots, folders)
        found[identity] = hashlib.sha256(f"{identity}\n{prints[roots]}".encode()).hexdigest()[:DIGITS]
    return found


def fingerprint(roots: Roots, folders: Folders) -> str:
    """Hash all that a result is computed from: code without its comments and docstrings, other files as they are."""
    digests = sorted(_digest(path, path.stat().st_mtime_ns) for path in files(roots, folders))
    return hashlib.sha256("".join(digests).encode()).hexdigest()


def files(roots: Roots, folders: Folders) -> set[Path]:
    """Return the files that a result is computed from: the roots, and every module of this package that they import.

    A recording that does not exist is left out: it has another key once it is there.
    """
    waiting = {_module_file(roots.module)}
    if roots.method:
        own = code_file(roots.method)
        waiting |= _home_of_method(roots.method) if own is None else {folders.methods / own}
    if roots.system:
        path = folders.suite / roots.system
        waiting |= {path} if path.suffix in (".py", ".toml") else _home_of_system(roots.system)
    if roots.recording and os.path.isfile(folders.data / roots.recording):
        waiting.add(folders.data / roots.recording)
    found: set[Path] = set()
    while waiting:
        path = waiting.pop().resolve()
        if path not in found:
            found.add(path)
            waiting |= _imports(path, path.stat().st_mtime_ns)
    return found


def _home_of_method(name: str) -> set[Path]:
    """Return the module that defines a method; of one that another package brings, all modules of that package."""
    others = methods.brought()
    return packages.sources(others[name]) if name in others else {Path(inspect.getfile(methods.find(name)))}


def _home_of_system(name: str) -> set[Path]:
    """Return the same of a system."""
    others = systems.brought()
    return packages.sources(others[name]) if name in others else {_own_home(name)}


@functools.cache
def _own_home(name: str) -> Path:
    """Return the module that defines a system of this package."""
    for info in pkgutil.iter_modules(systems.__path__):
        module = importlib.import_module(f"{PACKAGE}.systems.{info.name}")
        if getattr(getattr(module, "SYSTEM", None), "name", None) == name:
            return Path(inspect.getfile(module))
    raise unknown("system", name, systems.names())


def _module_file(name: str) -> Path:
    spec = importlib.util.find_spec(name)
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin)


@functools.lru_cache(maxsize=1024)
def _imports(path: Path, changed: int) -> frozenset[Path]:
    """Return the files of this package that a file imports, anywhere in it; `changed` renews the memory."""
    # A package that looks its modules up uses all of them.
    looks = path.name == "__init__.py" and b"iter_modules" in path.read_bytes()
    found = set(path.parent.glob("*.py")) if looks else set()
    for name in _read(path, changed)[1]:
        parts = name.split(".")
        # The __init__ of a room looks its modules up by name and computes nothing.
        for length in range(3, len(parts) + 1 if parts[0] == PACKAGE else 0):
            try:
                found.add(_module_file(".".join(parts[:length])))
            except (ModuleNotFoundError, AssertionError):
                # The name of something in a module.
                break
    return frozenset(found)


def _digest(path: Path, changed: int) -> str:
    return _read(path, changed)[0]


@functools.lru_cache(maxsize=1024)
def _read(path: Path, changed: int) -> tuple[str, tuple[str, ...]]:  # noqa: ARG001
    """Return the hash of a file, and the names that it may import."""
    content = path.read_bytes()
    tree = _tree(content) if path.suffix == ".py" else None
    if tree is None:
        return hashlib.sha256(content).hexdigest(), ()
    names = tuple(_names(tree))
    for node in _statements(tree, types=True):
        if (
            isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
            and node.body
            and isinstance(node.body[0], ast.Expr)
            and isinstance(node.body[0].value, ast.Constant)
            and isinstance(node.body[0].value.value, str)
        ):
            node.body = node.body[1:]
    # What is nested too deeply counts as it is.
    with suppress(RecursionError):
        content = ast.dump(tree).encode()
    return hashlib.sha256(content).hexdigest(), names


def _tree(content: bytes) -> ast.Module | None:
    """Return the syntax tree of a file; None for one of a user's that is no Python, which its cases will say."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)
            return ast.parse(content)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None


def _names(tree: ast.Module) -> Iterator[str]:
    """Return the names that a file may import, but for what only a type checker reads."""
    for node in _statements(tree, types=False):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _statements(tree: ast.Module, *, types: bool) -> Iterator[ast.AST]:
    """Return a file and its statements at any depth, those that only a type checker reads if `types` is set."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        yield node
        only_types = isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for name in BLOCKS[1:] if only_types and not types else BLOCKS:
            waiting += getattr(node, name, ())
