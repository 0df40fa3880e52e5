"""Which source a result depends on, so that a changed method is run again and an unchanged one is not."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import inspect
from collections.abc import Iterable
from pathlib import Path

from latticebench import systems

PACKAGE = "latticebench"


def fingerprint(kinds: Iterable[type], system: str, base: Path) -> str:
    """Hash the source of methods, of a system, and of every module of this project that they import.

    Comments, docstrings and layout do not count.

    Args:
        kinds: the methods' classes.
        system: a system's name or file.
        base: the folder that a relative path starts from.
    """
    files = {Path(inspect.getfile(kind)) for kind in kinds} | {_module_file("latticebench.bench.case")}
    if system.endswith((".py", ".toml")):
        files.add(base / system)
    else:
        files.add(_module_file(_home(system)))
    found: set[Path] = set()
    while files:
        path = files.pop().resolve()
        if path not in found:
            found.add(path)
            files |= _imports(path, path.stat().st_mtime_ns)
    digests = sorted(_digest(path, path.stat().st_mtime_ns) for path in found)
    return hashlib.sha256("".join(digests).encode()).hexdigest()


@functools.cache
def _home(system: str) -> str:
    """Name the module that defines a system of this package."""
    import importlib
    import pkgutil

    for info in pkgutil.iter_modules(systems.__path__):
        module = importlib.import_module(f"latticebench.systems.{info.name}")
        if getattr(getattr(module, "SYSTEM", None), "name", None) == system:
            return module.__name__
    raise AssertionError(system)


def _module_file(name: str) -> Path:
    spec = importlib.util.find_spec(name)
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin)


@functools.lru_cache(maxsize=1024)
def _imports(path: Path, changed: int) -> set[Path]:  # noqa: ARG001
    """Give the files of this project that a file imports, anywhere in it; `changed` renews the memory."""
    if path.suffix != ".py":
        return set()
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    files = set()
    # A package's __init__ looks its modules up by name and computes nothing.
    for name in names:
        if name.split(".")[0] == PACKAGE and name.count(".") > 1:
            try:
                files.add(_module_file(name))
            except (ModuleNotFoundError, AssertionError):
                continue
    return files


@functools.lru_cache(maxsize=1024)
def _digest(path: Path, changed: int) -> str:  # noqa: ARG001
    content = path.read_bytes()
    if path.suffix == ".py":
        tree = ast.parse(content)
        for node in ast.walk(tree):
            if (
                isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
                and node.body
                and isinstance(node.body[0], ast.Expr)
                and isinstance(node.body[0].value, ast.Constant)
                and isinstance(node.body[0].value.value, str)
            ):
                node.body = node.body[1:]
        content = ast.dump(tree).encode()
    return hashlib.sha256(content).hexdigest()
