"""Recordings of a shape that nobody expects, of thousands of sites or times over decades: read soon, or told."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import pytest

from commandline import EQUATION, FIT, refused, soon

DECADES = range(12)


def written(path: Path, times: list[str], sites: int) -> Path:
    """Write readings of which every seventh site has the same."""
    names = ["t", *(f"u{site}" for site in range(1, sites + 1))]
    rows = [[t, *(str((row * site) % 7) for site in range(sites))] for row, t in enumerate(times)]
    path.write_text("\n".join(",".join(row) for row in [names, *rows]) + "\n")
    return path


def test_thousands_of_sites_are_inspected_soon_and_each_copy_is_told_once(tmp_path: Path) -> None:
    written(tmp_path / "wide.csv", list("012345"), 4000)
    code, out, err = soon("inspect", "wide.csv", cwd=tmp_path)
    assert (code, err) == (0, "")
    assert out.count("u15: the same readings as u1;") == 1
    assert "u15: the same readings as u8" not in out
    assert "3800 more sensors; --json has all" in out


def test_a_chain_that_no_memory_holds_is_refused_before_it_is_diagnosed(tmp_path: Path) -> None:
    written(tmp_path / "wide.csv", list("0123456789"), 40)
    with mock.patch("latticebench.diagnosis.repair.free_memory", return_value=2.0**23):
        line = refused("diagnose", "wide.csv", *EQUATION, cwd=tmp_path)
    assert "wide.csv: a diagnosis of 40 sites would take at least 0.012 GiB, and 0.0078 GiB may be used" in line


@pytest.mark.parametrize("each", [4, 6])
def test_times_over_many_decades_are_inspected_and_refused_for_fits_with_the_remedy(each: int, tmp_path: Path) -> None:
    written(tmp_path / "wide.csv", [f"1e{each * (row - 5)}" for row in DECADES], 3)
    code, out, err = soon("inspect", "wide.csv", "--out", "wide.svg", cwd=tmp_path)
    assert (code, err) == (0, "")
    assert "unevenly" in out
    for method in ("stlsq", "trajectory"):
        line = refused("fit", "wide.csv", *FIT, "--method", method, cwd=tmp_path)
        assert "wide.csv: the longest of its steps in time is" in line
        assert "--method stlsq --set differentiation=FiniteDifference" in line
    assert "cut the recording there" in refused("diagnose", "wide.csv", *EQUATION, cwd=tmp_path)


def test_a_label_or_a_column_that_steers_a_terminal_is_shown_as_what_it_is(tmp_path: Path) -> None:
    path = written(tmp_path / "odd.csv", list("01234567"), 3)
    steering = "\x1b[31m\u202e"
    head, *rows = path.read_text().splitlines()
    lines = [f"trajectory,{head.replace('u3', steering)}", *(f"{steering},{row}" for row in rows)]
    path.write_text("\n".join(lines).replace("u1,u2", f"{steering}1,{steering}2"))
    reading = ("odd.csv", "--columns", f"{steering}*")
    for command in (
        ("inspect", *reading), ("plot", *reading, "--out", "odd.png"),
        ("fit", *reading, *FIT), ("diagnose", *reading, *EQUATION),
    ):  # fmt: skip
        code, out, err = soon(*command, cwd=tmp_path)
        assert code in (0, 2)
        assert not {"\x1b", "\u202e"} & {*out, *err}, command
