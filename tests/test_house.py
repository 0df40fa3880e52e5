"""The rules of the house, checked on the source."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from latticebench import methods, systems

ROOT = Path(__file__).parent.parent
ROOMS = ("systems", "methods", "diagnosis", "bench")


def sources(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


@pytest.mark.parametrize(
    "path", [path for room in ROOMS for path in sources(room)], ids=lambda p: f"{p.parent.name}/{p.name}"
)
def test_imports_point_downwards_only(path: Path) -> None:
    room = path.relative_to(ROOT).parts[0]
    above = ROOMS[ROOMS.index(room) + 1 :]
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        for name in names:
            assert not any(name.startswith(f"latticebench.{one}") for one in above), f"{path.name} imports {name}"


@pytest.mark.parametrize("path", sources("bench"), ids=lambda p: p.name)
def test_no_code_in_bench_names_a_method_or_a_system(path: Path) -> None:
    names = {*systems.names(), *methods.registered()}
    found = {
        node.value for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in names
    }  # fmt: skip
    assert not found


@pytest.mark.parametrize("path", sources("methods"), ids=lambda p: p.name)
def test_no_method_names_a_system(path: Path) -> None:
    found = {
        node.value for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value in systems.names()
    }  # fmt: skip
    assert not found


@pytest.mark.parametrize(
    "command", [["--help"], ["list", "systems"], ["list", "methods"], ["list", "suites"], ["fit", "--help"]]
)
def test_help_and_lists_load_nothing_heavy(command: list[str]) -> None:
    program = (
        f"import sys; sys.argv = ['latticebench', *{command!r}]\n"
        "from latticebench.bench.cli import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        "heavy = {'torch', 'pysindy', 'sympy', 'pandas', 'scipy', 'matplotlib', 'sklearn'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, cwd=ROOT)
