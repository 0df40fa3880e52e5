"""The README shows only what works: its examples are run as they stand."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pytest

from latticebench import methods
from latticebench.bench.cli import main

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
EXAMPLES = dict(re.findall(r"<!-- run by tests/test_readme.py -->\n```(\w+)\n(.*?)```", README, re.DOTALL))


def test_the_python_example_prints_what_its_last_comment_says(capsys: pytest.CaptureFixture[str]) -> None:
    code = EXAMPLES["python"]
    exec(compile(code, "README.md", "exec"), {})
    promised = re.search(r"# (\[.*?\])", code)
    assert promised is not None
    assert capsys.readouterr().out.strip() == promised.group(1)


def test_the_command_example_runs_from_top_to_bottom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Within this process, which saves the imports of a process for each line."""
    monkeypatch.chdir(tmp_path)
    for line in EXAMPLES["sh"].strip().splitlines():
        monkeypatch.setattr(sys, "argv", shlex.split(line))
        assert sys.argv[0] == "latticebench"
        with pytest.raises(SystemExit) as end:
            main()
        assert not end.value.code, f"{line}\n{capsys.readouterr().err}"
    assert (tmp_path / "published" / "errors.md").exists()


@pytest.mark.parametrize("name", sorted(methods.registered()))
def test_every_method_is_named(name: str) -> None:
    assert f"`{name}`" in README


def test_the_files_that_it_links_to_exist() -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (Path(__file__).parent.parent / target).exists(), target
