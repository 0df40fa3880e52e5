"""The rules of the house, checked on the source: which way imports run, how long things are, what is loaded when."""

from __future__ import annotations

import ast
import re
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
MOST_CHARACTERS = 120
# What a method may share with others.
SHARED = ("latticebench.methods.method", "latticebench.methods.engine")
SOURCES = {
    ".".join(("latticebench", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__"): path
    for room in ROOMS
    for path in sorted((ROOT / room).rglob("*.py"))
}
TREES = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in SOURCES.items()}


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


def test_imports_point_downwards_only() -> None:
    def above(module: str) -> tuple[str, ...]:
        return ROOMS[ROOMS.index(room(module)) + 1 :]

    assert not [
        (one, name) for one in SOURCES for name, _ in imports(one) if name in SOURCES and room(name) in above(one)
    ]


def test_imports_run_in_no_circle() -> None:
    graph = {module: {name for name, _ in imports(module) if name in SOURCES} - {module} for module in SOURCES}
    list(TopologicalSorter(graph).static_order())


def test_no_private_name_is_used_by_another_module() -> None:
    assert not [(module, name) for module in SOURCES for name in private_names(module)]


def private_names(module: str) -> Iterator[str]:
    """Yield the names with a leading underscore that a module takes from others of this project."""
    ours = set()
    for node in ast.walk(TREES[module]):
        if isinstance(node, ast.ImportFrom):
            ours |= {alias.asname or alias.name for alias in node.names if f"{node.module}.{alias.name}" in SOURCES}
    for where, name in imports(module):
        if where.startswith("latticebench") and name.startswith("_") and not name.startswith("__"):
            yield f"{where}.{name}"
    for node in ast.walk(TREES[module]):
        if (
            isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ours
            and node.attr.startswith("_") and not node.attr.startswith("__")
        ):  # fmt: skip
            yield f"{node.value.id}.{node.attr}"


def test_a_method_is_imported_by_its_registry_alone() -> None:
    assert not [(one, name) for one in SOURCES for name, _ in imports(one) if is_method(name) and name != one]


def test_nothing_above_the_methods_names_a_method_or_a_system() -> None:
    names = {*systems.names(), *methods.registered()}
    assert not [
        (one, texts(one) & names) for one in SOURCES if room(one) in ("diagnosis", "bench") if texts(one) & names
    ]


def test_no_method_names_a_system() -> None:
    names = set(systems.names())
    assert not [(one, texts(one) & names) for one in SOURCES if room(one) == "methods" and texts(one) & names]


def texts(module: str) -> set[str]:
    found = (node.value for node in ast.walk(TREES[module]) if isinstance(node, ast.Constant))
    return {value for value in found if isinstance(value, str)}


def test_files_and_functions_are_short_enough_to_be_read() -> None:
    long = []
    others = [path for folder in ("results", "tests") for path in sorted((ROOT / folder).rglob("*.py"))]
    for path in [*SOURCES.values(), *others]:
        name, source = path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")
        if source.count("\n") > MOST_LINES_OF_A_FILE:
            long.append(name)
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                lines = (node.end_lineno or 0) - node.lineno + 1
                long += [f"{name}: {node.name}"] if lines > MOST_LINES_OF_A_FUNCTION else []
    assert not long


def test_prose_stands_in_lines_of_120_characters() -> None:
    for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        lines = re.sub(r"```.*?```", "", (ROOT / name).read_text(encoding="utf-8"), flags=re.DOTALL).splitlines()
        assert not [line for line in lines if len(line) > MOST_CHARACTERS and not line.lstrip().startswith("|")], name


# What gathers something while a run lasts.
GATHERING = {"_Sums", "Batches", "_Station", "Leases", "Presence", "Lines", "Tally"}


def test_every_dataclass_is_frozen_but_those_that_gather() -> None:
    thawed = {
        node.name
        for tree in TREES.values() for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        for one in map(ast.unparse, node.decorator_list)
        if one.startswith(("dataclass", "dataclasses.dataclass")) and "frozen=True" not in one
    }  # fmt: skip
    assert thawed == GATHERING


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


COMMANDS = (
    "--help", "--version", "list systems", "list methods", "list suites", "fit -h", "diagnose --help", "data",
    "data --json", "data take --help",
)  # fmt: skip


def test_help_and_lists_load_nothing_heavy(tmp_path: Path) -> None:
    program = (
        "from latticebench.bench.cli import main\n"
        f"for command in {COMMANDS!r}:\n"
        "    sys.argv = ['latticebench', *command.split()]\n"
        "    try:\n        main()\n    except SystemExit as end:\n        assert not end.code, command\n"
        f"    assert not {HEAVY!r} & set(sys.modules), command"
    )
    loaded_by(program, tmp_path)


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
