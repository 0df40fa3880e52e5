"""What is told to package managers and to continuous integration agrees with pyproject.toml."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path
from typing import Any

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parent.parent
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
RECIPE = (ROOT / "conda" / "meta.yaml").read_text(encoding="utf-8")
# What conda calls the packages that it names otherwise.
NAMES = {"matplotlib": "matplotlib-base", "torch": "pytorch"}
LATEST = (3, 13)


def oldest() -> tuple[int, int]:
    """The oldest Python that the project takes."""
    return 3, int(PROJECT["requires-python"].removeprefix(">=3."))


def test_the_conda_recipe_asks_for_what_the_project_asks_for() -> None:
    (block,) = re.findall(r"^  run:\n((?:    - .*\n)+)", RECIPE, re.MULTILINE)
    asked = dict(line.removeprefix("    - ").split(" ") for line in block.splitlines())
    needed = {"python": PROJECT["requires-python"]}
    for text in PROJECT["dependencies"]:
        name, bounds = re.fullmatch(r"([\w-]+)([^;]*)(?:;.*)?", text).groups()  # type: ignore[union-attr]
        needed[NAMES.get(name, name)] = bounds.strip()
    assert asked == needed
    assert f'{{% set version = "{PROJECT["version"]}" %}}' in RECIPE
    (script,) = PROJECT["scripts"].items()
    assert f"- {' = '.join(script)}\n" in RECIPE


def test_every_package_that_is_needed_and_every_link_of_a_page_is_listed_with_the_licences() -> None:
    listed = (ROOT / "docs" / "licences.md").read_text(encoding="utf-8")
    extras = [
        text
        for name, texts in PROJECT["optional-dependencies"].items()
        if name not in ("test", "dev")
        for text in texts
    ]
    for text in [*PROJECT["dependencies"], *extras]:
        name = re.split(r"[<>=;]", text)[0].lower()
        assert re.search(rf"\b{name}\b", listed.lower()), name
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]:
        for link in re.findall(r"https?://[^\s)>`\"']+", page.read_text(encoding="utf-8")):
            assert link in listed, f"{page.name}: {link}"


def test_continuous_integration_runs_every_python_on_every_system() -> None:
    text = (ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8")
    (listed,) = re.findall(r"python: \[(.*)\]", text)
    assert listed == ", ".join(f'"3.{minor}"' for minor in range(oldest()[1], LATEST[1] + 1))
    assert "os: [ubuntu-latest, macos-latest, windows-latest]" in text


@pytest.mark.parametrize("room", ["latticebench", "systems", "methods", "diagnosis", "bench", "docs/data"])
def test_every_file_is_written_in_the_language_of_the_oldest_python(room: str) -> None:
    for path in sorted((ROOT / room).rglob("*.py")):
        ast.parse(path.read_text(encoding="utf-8"), str(path), feature_version=oldest())
