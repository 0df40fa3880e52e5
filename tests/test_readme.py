"""The README shows only what works: its examples are run as they stand."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pytest

from latticebench import methods
from latticebench.bench.cli import main
from latticebench.bench.demo import write_recording

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"<!-- run by tests/test_readme.py(, slowly)? -->\n```(\w+)\n(.*?)```", README, re.DOTALL)


def examples(language: str, *, slow: bool = False) -> list[str]:
    """Return the examples in a language, as they stand."""
    return [code for mark, told, code in EXAMPLES if told == language and bool(mark) == slow]


def test_the_python_example_prints_what_its_last_comment_says(capsys: pytest.CaptureFixture[str]) -> None:
    code = examples("python")[0]
    exec(compile(code, "README.md", "exec"), {})
    promised = re.search(r"# (\[.*?\])", code)
    assert promised is not None
    assert capsys.readouterr().out.strip() == promised.group(1)


def test_the_notebook_example_warns_of_its_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path / "demo" / "pendula.csv")
    exec(compile(examples("python")[1], "README.md", "exec"), {})
    shown = capsys.readouterr().out
    assert "sin(u[n])" in shown
    assert "the equation does not fit" in shown


@pytest.mark.slow
def test_the_recordings_example_runs_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (commands,) = examples("sh", slow=True)
    for line in commands.replace("\\\n", " ").strip().splitlines():
        monkeypatch.setattr(sys, "argv", shlex.split(line))
        with pytest.raises(SystemExit) as end:
            main()
        assert not end.value.code, line
    assert (tmp_path / "pendula.png").exists()
    assert (tmp_path / "pendula.html").exists()


def test_the_command_example_runs_from_top_to_bottom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Within this process, which saves the imports of a process for each line."""
    monkeypatch.chdir(tmp_path)
    for line in examples("sh")[0].strip().splitlines():
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
