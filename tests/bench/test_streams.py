"""Standard streams that are closed, full or gone, and a working folder that is: each command ends in order."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from commandline import SUITE, content

posix = pytest.mark.skipif(os.name != "posix", reason="closes streams as POSIX shells do")
needs_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no device that is full")


def in_shell(line: str, cwd: Path, encoding: str = "utf-8") -> subprocess.CompletedProcess[str]:
    """Run a line of shell, in which $LB is the program."""
    program = f"'{sys.executable}' -m latticebench"
    command = ["sh", "-c", line.replace("$LB", program)]
    return subprocess.run(command, cwd=cwd, capture_output=True, encoding=encoding)


@posix
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", "<&- >&- 2>&-"])
def test_a_run_with_closed_streams_keeps_whole_results(closed: str, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SUITE)
    done = in_shell(f"$LB run s.toml --jobs 1 --results store {closed}", tmp_path)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
    again = in_shell("$LB run s.toml --jobs 1 --results store", tmp_path)
    assert "4 cases (4 ok); 0 run now, 4 were there" in again.stdout


@posix
@pytest.mark.parametrize("line", ["list systems", "table store", "fit t.csv --terms 'u[n]' --order 2 --method zero"])
def test_a_reader_that_has_seen_enough_is_no_failure(line: str, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SUITE)
    in_shell("$LB run s.toml --jobs 1 --results store", tmp_path)
    (tmp_path / "t.csv").write_text("t,u1\n" + "".join(f"{k},{k % 5}\n" for k in range(20)))
    done = in_shell(f"{{ $LB {line}; echo $? > code; }} | true", tmp_path)
    assert (tmp_path / "code").read_text().strip() == "0"
    assert "Traceback" not in done.stderr


@posix
@needs_full
def test_a_full_standard_error_ends_no_work_and_changes_no_exit_code(tmp_path: Path) -> None:
    # What is printed there is a warning of many hours, which comes before any work.
    (tmp_path / "s.toml").write_text(SUITE + "time_limit = 1e9\n")
    long = in_shell("$LB run s.toml --yes --jobs 1 --results store 2>/dev/full", tmp_path)
    assert long.returncode == 0
    assert "4 cases (4 ok)" in long.stdout
    assert in_shell("$LB fit nowhere.csv --system phi4 --library lib1 2>/dev/full", tmp_path).returncode == 2


@posix
@needs_full
def test_a_full_screen_costs_no_file_that_was_asked_for(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SUITE)
    assert in_shell("$LB run s.toml --jobs 1 --results store", tmp_path).returncode == 0
    assert in_shell("$LB simulate phi4 --sites 5 --samples 12 --out t.csv", tmp_path).returncode == 0
    of_file = 't.csv --terms "u[n]; u[n]**3" --order 2 --json fit.json --html fit.html'
    for line, places in (
        (f"fit {of_file}", ("fit.json", "fit.html")),
        ("limit --system phi4 --library lib1 --sites 5 --json limit.json", ("limit.json",)),
        ("table store --out tables", ("tables/cases.csv", "tables/summary.md")),
        ("compare store --against other --out against.csv", ("against.csv",)),
    ):
        done = in_shell(f"$LB {line} > /dev/full", tmp_path)
        assert done.returncode == 2, done.stderr
        assert "standard output cannot be written" in done.stderr
        assert all((tmp_path / place).stat().st_size for place in places)


@posix
@pytest.mark.parametrize("seconds", ["x", "99999999999999999", "9999999999999"])
def test_what_the_environment_says_to_packages_of_others_ends_nothing(seconds: str, tmp_path: Path) -> None:
    wrong = f"MPLBACKEND=nonsense SOURCE_DATE_EPOCH={seconds}"
    done = in_shell(f"{wrong} $LB simulate phi4 --sites 5 --samples 12 --out t.csv", tmp_path)
    assert done.returncode == 0, done.stderr
    done = in_shell(f'{wrong} $LB fit t.csv --terms "u[n]" --order 2 --html fit.html', tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


@posix
def test_a_run_understands_itself_whatever_encoding_the_environment_asks_for(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SUITE)
    done = in_shell("PYTHONIOENCODING=utf-16 $LB run s.toml --jobs 1 --results store 2>err", tmp_path, "utf-16")
    assert "4 cases (4 ok)" in done.stdout
    # What is left of a run that is killed ends by a process of its own, whose complaints would be here.
    assert b"U\0n\0i\0c\0o\0d\0e\0E\0r\0r\0o\0r" not in (tmp_path / "err").read_bytes()


@posix
def test_a_working_folder_that_is_gone_is_told_in_one_line(tmp_path: Path) -> None:
    before = content(tmp_path)
    done = in_shell("mkdir gone; cd gone; rmdir ../gone; $LB simulate phi4 --out x.csv", tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: the working folder cannot be used: ")
    assert done.stderr.count("\n") == 1
    assert content(tmp_path) == before
    assert in_shell("mkdir gone; cd gone; rmdir ../gone; $LB --version", tmp_path).returncode == 0


@posix
def test_what_is_done_is_told_to_who_asks_for_it(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SUITE)
    quiet = in_shell("$LB run s.toml --jobs 1 --results quiet", tmp_path)
    told = in_shell("$LB --log info run s.toml --jobs 1 --results told", tmp_path)
    assert "latticebench.bench.run" not in quiet.stderr
    lines = [line for line in told.stderr.splitlines() if "INFO latticebench.bench.run: " in line]
    assert "4 of 4 cases to run, kept in told/results.sqlite" in lines[0]
    assert sum(": ok" in line for line in lines) == 4
    assert "4 cases (4 ok); 4 run now" in told.stdout
    assert in_shell("$LB --log loud run s.toml", tmp_path).returncode == 2
