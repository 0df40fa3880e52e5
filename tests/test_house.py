"""The rules of the house, checked on the source: which way imports run, how long things are, what is loaded when."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from latticebench import methods, systems

ROOT = Path(__file__).parent.parent
# From the bottom to the top: a room imports from those before it.
ROOMS = ("systems", "methods", "diagnosis", "bench")
MOST_LINES_OF_A_FILE = 500
MOST_LINES_OF_A_FUNCTION = 60
# The search and the verdict of the diagnosis, which are going to be replaced as a whole.
LONG_FILES: set[str] = set()
# What a method may share with others.
SHARED = ("latticebench.methods.method", "latticebench.methods.engine")
SOURCES = {
    ".".join(("latticebench", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): path
    for room in ROOMS
    for path in sorted((ROOT / room).rglob("*.py"))
}
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in SOURCES.items()}
EVERY = pytest.mark.parametrize("module", SOURCES)


def imports(module: str) -> Iterator[tuple[str, str]]:
    """Yield the module and the name that each import of this project takes, wherever it stands."""
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{module}: write imports from `latticebench`, not relative ones"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                yield (whole, "") if whole in SOURCES else (node.module or "", alias.name)


def room(module: str) -> str:
    return module.split(".")[1] if module.count(".") else ""


def is_method(module: str) -> bool:
    """Whether a module is a file of `methods/` that holds a method."""
    return module.startswith("latticebench.methods.") and not module.startswith(SHARED)


@EVERY
def test_imports_point_downwards_only(module: str) -> None:
    above = ROOMS[ROOMS.index(room(module)) + 1 :]
    for name, _ in imports(module):
        assert room(name) not in above or not name.startswith("latticebench."), f"{module} imports {name}"


def test_imports_run_in_no_circle() -> None:
    graph = {module: {name for name, _ in imports(module) if name in SOURCES} - {module} for module in SOURCES}
    # A room's face looks its modules up by name, and app.py of the command line is what its face hands on.
    list(TopologicalSorter(graph).static_order())


@EVERY
def test_no_private_name_is_used_by_another_module(module: str) -> None:
    aliases = set()
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.ImportFrom):
            aliases |= {alias.asname or alias.name for alias in node.names if f"{node.module}.{alias.name}" in SOURCES}
    taken = [name for where, name in imports(module) if where.startswith("latticebench") and name.startswith("_")]
    taken += [
        f"{node.value.id}.{node.attr}"
        for node in ast.walk(TREES[module])
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
        and node.value.id in aliases and node.attr.startswith("_") and not node.attr.startswith("__")
    ]  # fmt: skip
    assert not [name for name in taken if not name.startswith("__")]


@EVERY
def test_a_method_is_imported_by_its_registry_alone(module: str) -> None:
    assert not [name for name, _ in imports(module) if is_method(name) and name != module]


@pytest.mark.parametrize("module", [module for module in SOURCES if room(module) in ("diagnosis", "bench")])
def test_no_code_above_the_methods_names_a_method_or_a_system(module: str) -> None:
    assert not texts(module) & {*systems.names(), *methods.registered()}


@pytest.mark.parametrize("module", [module for module in SOURCES if room(module) == "methods"])
def test_no_method_names_a_system(module: str) -> None:
    assert not texts(module) & set(systems.names())


def texts(module: str) -> set[str]:
    found = (node.value for node in ast.walk(TREES[module]) if isinstance(node, ast.Constant))
    return {value for value in found if isinstance(value, str)}


@pytest.mark.parametrize("path", [*SOURCES.values(), *sorted((ROOT / "results").rglob("*.py"))], ids=lambda p: p.stem)
def test_files_and_functions_are_short_enough_to_be_read(path: Path) -> None:
    source = path.read_text(encoding="utf-8")
    long = {
        node.name: node.end_lineno - node.lineno + 1
        for node in ast.walk(ast.parse(source))
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        and (node.end_lineno or 0) - node.lineno >= MOST_LINES_OF_A_FUNCTION
    }
    assert not long
    name = path.relative_to(ROOT).as_posix()
    assert (source.count("\n") > MOST_LINES_OF_A_FILE) == (name in LONG_FILES), name


def test_every_package_is_listed_for_the_wheel() -> None:
    tomllib = pytest.importorskip("tomllib", reason="Python 3.10 cannot read TOML")
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"]
    packages = {name for name, path in SOURCES.items() if path.name == "__init__.py"}
    folders = {name.rpartition(".")[0] for name, path in SOURCES.items() if path.name != "__init__.py"}
    assert sorted(listed) == sorted({"latticebench", *packages})
    assert folders <= packages, "a folder of modules needs an __init__.py"


HEAVY = {"torch", "pysindy", "sympy", "pandas", "scipy", "matplotlib", "sklearn", "jinja2", "pyarrow"}


def loaded_by(program: str, cwd: Path) -> set[str]:
    """Return the top-level names of the modules that a program has loaded at its end."""
    script = f"import sys\n{program}\nprint('', *{{name.split('.')[0] for name in sys.modules}}, sep='\\n', end='')"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.splitlines())


@pytest.mark.parametrize(
    "command", [["--help"], ["--version"], ["list", "systems"], ["list", "methods"], ["list", "suites"], ["fit", "-h"]],
    ids=" ".join,
)  # fmt: skip
def test_help_and_lists_load_nothing_heavy(command: list[str], tmp_path: Path) -> None:
    program = (
        f"sys.argv = ['latticebench', *{command!r}]\n"
        "from latticebench.bench.cli import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code"
    )
    assert not loaded_by(program, tmp_path) & HEAVY


def test_the_package_itself_loads_nothing_until_a_room_is_asked_for(tmp_path: Path) -> None:
    assert not loaded_by("import latticebench", tmp_path) & {*HEAVY, "numpy", "typer", "pydantic"}
    assert "numpy" in loaded_by("import latticebench; latticebench.systems.find('phi4')", tmp_path)


def test_modules_of_a_user_with_our_rooms_names_disturb_nothing(tmp_path: Path) -> None:
    for name in (*ROOMS, "cli"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('a module of the user was imported')\n")
    done = subprocess.run(
        [sys.executable, "-m", "latticebench", "list", "systems"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "phi4" in done.stdout
