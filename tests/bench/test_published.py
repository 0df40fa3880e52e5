"""What is published is what its script makes of the published tables."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("page", ["limits/which", "cross/cross"])
def test_a_page_of_prose_is_made_of_the_tables_beside_it(page: str, tmp_path: Path) -> None:
    folder, name = page.split("/")
    for path in (ROOT / "results" / folder).glob("*.*"):
        if path.suffix in (".csv", ".py"):
            shutil.copy(path, tmp_path)
    subprocess.run([sys.executable, str(tmp_path / f"{name}.py")], check=True, cwd=ROOT)
    published = (ROOT / "results" / folder / f"{name}.md").read_text(encoding="utf-8")
    assert (tmp_path / f"{name}.md").read_text(encoding="utf-8") == published
