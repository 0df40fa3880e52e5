"""The README shows only what works: its examples are run as they stand."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from latticebench import methods

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
EXAMPLES = dict(re.findall(r"<!-- run by tests/test_readme.py -->\n```(\w+)\n(.*?)```", README, re.DOTALL))


def test_the_python_example_prints_what_its_last_comment_says(tmp_path: Path) -> None:
    code = EXAMPLES["python"]
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    promised = re.search(r"# (\[.*?\])", code)
    assert promised is not None
    assert done.stdout.strip() == promised.group(1)


def test_the_command_example_runs_from_top_to_bottom(tmp_path: Path) -> None:
    for line in EXAMPLES["sh"].strip().splitlines():
        program, *arguments = shlex.split(line)
        assert program == "latticebench"
        command = [sys.executable, "-m", "latticebench", *arguments]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{line}\n{done.stderr}"
    assert (tmp_path / "published" / "errors.md").exists()


@pytest.mark.parametrize("name", sorted(methods.registered()))
def test_every_method_is_named(name: str) -> None:
    assert f"`{name}`" in README


def test_the_files_that_it_links_to_exist() -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (Path(__file__).parent.parent / target).exists(), target
