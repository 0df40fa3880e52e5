"""README and pages show only what works: their commands and examples are run as they stand."""

from __future__ import annotations

import doctest
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from latticebench import methods
from latticebench.bench.cli import main
from latticebench.bench.demo import write_recording
from latticebench.bench.grid import Grid
from latticebench.bench.published import read_head

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = {path.stem: path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs").glob("*.md"))}
COMMANDS = {name: re.findall(r"^```\{command-output\} (.*)$", text, re.MULTILINE) for name, text in PAGES.items()}
# Pages whose commands take seconds; those of the others take up to a minute.
QUICK = ("start", "system", "protocol", "site")
Run = Callable[[str, Path], str]
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command of a page within this process, which saves its imports, and return what it prints."""

    def run(line: str, folder: Path) -> str:
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", shlex.split(line))
        assert sys.argv[0] == "latticebench"
        with pytest.raises(SystemExit) as end:
            main()
        said = capsys.readouterr()
        assert not end.value.code, f"{line}\n{said.err}"
        return said.out

    return run


@pytest.fixture
def page_folder(tmp_path: Path) -> Path:
    """Make the folder that the commands of a page run in, as docs/conf.py does."""
    shutil.copytree(ROOT / "docs" / "data", tmp_path / "data")
    shutil.copytree(ROOT / "docs" / "data", tmp_path / "docs" / "data")
    (tmp_path / "run").mkdir()
    shutil.copy(ROOT / "docs" / "data" / "pendula.csv", tmp_path / "run")
    return tmp_path


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name, lines in COMMANDS.items() if lines],
)
def test_the_commands_of_a_page_run_from_top_to_bottom(name: str, page_folder: Path, ran: Run) -> None:
    for line in COMMANDS[name]:
        ran(line, page_folder / "run")
    for target in re.findall(r"\]\(run/([^)]+)\)", PAGES[name]):
        assert (page_folder / "run" / target).exists(), target


def consoles() -> list[tuple[str, str]]:
    """Return each command that the README shows, with what it prints."""
    blocks = re.findall(r"```console\n(.*?)```", README, re.DOTALL)
    every = [one.split("\n", 1) for block in blocks for one in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]]
    return [(command, rest) for command, rest in every]


@pytest.mark.slow
def test_the_commands_of_the_readme_print_what_it_shows(page_folder: Path, ran: Run) -> None:
    checker = doctest.OutputChecker()
    assert consoles()
    for command, shown in consoles():
        found = ran(command, page_folder)
        assert checker.check_output(shown, found, FLAGS), f"{command}\n{found}"


@pytest.mark.parametrize("name", sorted(name for name, text in PAGES.items() if "\n>>> " in text))
def test_the_examples_in_python_print_what_a_page_shows(name: str) -> None:
    failed, tried = doctest.testfile(str(ROOT / "docs" / f"{name}.md"), module_relative=False, optionflags=FLAGS)
    assert tried
    assert not failed


def test_the_notebook_example_warns_of_its_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_recording(tmp_path / "demo" / "pendula.csv")
    (code,) = re.findall(r"<!-- run by tests/test_readme.py -->\n```python\n(.*?)```", PAGES["recording"], re.DOTALL)
    exec(compile(code, "recording.md", "exec"), {})
    shown = capsys.readouterr().out
    assert "sin(u[n])" in shown
    assert "the equation does not fit" in shown


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "examples").glob("plot_*.py")), ids=lambda path: path.stem)
def test_the_examples_of_the_gallery_run(path: Path) -> None:
    environment = {**os.environ, "MPLBACKEND": "agg"}
    command = [sys.executable, "-W", "error", path.name]
    done = subprocess.run(command, cwd=path.parent, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", sorted(methods.registered()))
def test_every_method_is_named(name: str) -> None:
    assert f"`{name}`" in PAGES["method"]


@pytest.mark.parametrize("name", ["README.md", *(f"docs/{name}.md" for name in PAGES)])
def test_the_files_that_a_page_links_to_exist(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        # The commands of a page make what is in run/, its build the gallery.
        if not target.startswith(("run/", "gallery/")):
            assert (ROOT / name).parent.joinpath(target).exists(), target


def test_the_result_that_the_readme_shows_is_the_published_one() -> None:
    published = pd.read_csv(ROOT / "results" / "default" / "errors.csv", comment="#", dtype=str)
    (shown,) = re.findall(r"<!-- result -->\n(.*?)<!-- end -->", README, re.DOTALL)
    head = read_head(ROOT / "results" / "default" / "errors.csv")
    assert all(head[name] in shown for name in ("commit", "date"))
    names, _, *rows = (
        [cell.strip() for cell in row.strip("|").split("|")] for row in re.findall(r"^\|.*", shown, re.M)
    )
    assert rows
    for row in rows:
        wanted = published[(published["data"] == row[0]) & (published["library"] == row[1])].iloc[0]
        assert row == [re.sub(r" n=\d+$", "", str(wanted[name])) for name in names]


def test_the_readme_has_at_most_600_words() -> None:
    assert len(re.sub(r"<!--.*?-->", "", README, flags=re.DOTALL).split()) <= 600


def test_the_page_on_methods_explains_every_key_of_a_grid() -> None:
    table = PAGES["method"][PAGES["method"].index("| keys of a grid") :]
    explained = set(re.findall(r"`(\w+)`", "".join(line.split("|")[1] for line in table.splitlines() if "|" in line)))
    assert set(Grid.model_fields) <= explained
