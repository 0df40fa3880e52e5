"""The pages and the scripts in results/."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

RESULTS = Path(__file__).parents[2] / "results"
SCRIPTS = sorted(path.relative_to(RESULTS).as_posix() for path in RESULTS.rglob("*.py"))


@pytest.mark.parametrize("path", SCRIPTS)
def test_a_script_can_be_imported(script: Callable[[str], ModuleType], path: str) -> None:
    assert script(path).__doc__


@pytest.mark.parametrize("path", ["cross/cross.py", "limits/which.py", "paper/claims.py"])
def test_a_page_is_what_its_script_makes_of_the_tables_beside_it(
    script: Callable[[str], ModuleType], path: str
) -> None:
    published = (RESULTS / path).with_suffix(".md").read_text(encoding="utf-8")
    assert script(path).page() == published
