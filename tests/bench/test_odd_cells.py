"""Recordings with a few odd cells, which are numbers all the same: fitted, inspected and drawn, or refused in one line.

A warning of Python is an error here, as in all tests.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from commandline import Seeds, blocks, soon, succeed

ODD = ("1e49", "-1e49", "1e-300", "0", "-0", "", "nan", "+3", "1E1", ".5", "123456789012345678901234567890")
FACTORS = (1e-300, 1e-150, 1e-60, 1e-6, -1.0, 1e6, 1e45)
MODELS = {
    "phi4": ("--terms", "u[n]; u[n]**3; u[n+1]+u[n-1]-2*u[n]", "--order", 2),
    "dnls": ("--terms", "u[n]; u[n+1]; i*u[n]; i*u[n+1]", "--order", 1),
}


def scaled(rows: Iterable[list[str]], columns: slice, factor: float) -> None:
    for row in rows:
        row[columns] = [f"{float(cell) * factor!r}" if cell else "" for cell in row[columns]]


def spoil(rows: list[list[str]], draw: random.Random) -> None:
    """Do one thing to the cells of a table with a header."""
    row, column = draw.randrange(1, len(rows)), draw.randrange(1, len(rows[0]))
    match draw.randrange(8):
        case 0:
            rows[row][draw.randrange(len(rows[0]))] = draw.choice(ODD)
        case 1:
            same = draw.choice(ODD)
            for one in rows[1:]:
                one[column] = same
        case 2 if len(rows) > 4:
            del rows[row]
        case 3:
            rows[row][1:] = [""] * (len(rows[0]) - 1)
        case 4:
            for one in rows[row:]:
                one[column] = ""
        case 5:
            scaled(rows[1:], slice(1, None), draw.choice(FACTORS))
        case 6:
            scaled(rows[1:], slice(1), draw.choice(FACTORS))
        case _:
            for one in rows[1:]:
                one[column] = one[draw.randrange(1, len(rows[0]))]


def spoiled(folder: Path, seeds: Iterable[int]) -> Iterator[tuple[int, random.Random, str]]:
    """Write the recording of each seed, and yield the seed, what else to draw from and the system."""
    for system in MODELS:
        succeed(
            "simulate", system, "--sites", 3, "--samples", 30, "--noise", 0.01, "--out", f"{system}.csv", cwd=folder
        )
    for seed in seeds:
        draw = random.Random(seed)
        system = draw.choice(list(MODELS))
        rows = [line.split(",") for line in (folder / f"{system}.csv").read_text().splitlines()]
        for _ in range(draw.choice((1, 1, 2, 4))):
            spoil(rows, draw)
        (folder / "odd.csv").write_text("".join(",".join(row) + "\n" for row in rows))
        yield seed, draw, system


def taken_or_refused(seed: int, command: tuple[object, ...], folder: Path) -> None:
    """Run a command, which must end soon with its outputs or with one line and without them."""
    code, _, err = soon(*command, cwd=folder)
    told = (seed, command, err)
    assert code in (0, 2), told
    assert code == 0 or (err.startswith("error: ") and err.count("\n") == 1), told
    assert " failed: " not in err, told
    places = [folder / name for name in ("out", "page", "out.png") if name in command]
    assert all(place.exists() == (code == 0) for place in places), told
    for place in places:
        place.unlink(missing_ok=True)


def survive_cells(folder: Path, seeds: range, methods: tuple[str, ...]) -> None:
    for seed, draw, system in spoiled(folder, seeds):
        fit = ("fit", "odd.csv", *MODELS[system], "--method", draw.choice(methods), "--json", "out", "--html", "page")
        for command in (fit, ("inspect", "odd.csv", "--out", "out.png"), ("plot", "odd.csv", "--out", "out.png")):
            taken_or_refused(seed, command, folder)


def survive_diagnosis(folder: Path, seeds: range) -> None:
    for seed, _, system in spoiled(folder, seeds):
        taken_or_refused(seed, ("diagnose", "odd.csv", *MODELS[system], "--json", "out", "--html", "page"), folder)


def test_recordings_with_odd_cells_are_taken_or_refused_in_one_line(tmp_path: Path, seeds: Seeds) -> None:
    survive_cells(tmp_path, seeds(0, 5), ("least-squares", "stlsq"))


@pytest.mark.slow
@pytest.mark.parametrize("first", blocks(1000, 1150, 25))
def test_many_recordings_with_odd_cells_are_taken_or_refused_in_one_line(
    tmp_path: Path, seeds: Seeds, first: int
) -> None:
    survive_cells(tmp_path, seeds(first, first + 25), ("least-squares", "stlsq", "weak", "sr3", "trajectory"))


def test_recordings_with_odd_cells_are_diagnosed_or_refused_in_one_line_and_soon(tmp_path: Path, seeds: Seeds) -> None:
    survive_diagnosis(tmp_path, seeds(3, 5))


@pytest.mark.slow
@pytest.mark.parametrize("first", blocks(2000, 2030, 10))
def test_many_recordings_with_odd_cells_are_diagnosed_or_refused_in_one_line_and_soon(
    tmp_path: Path, seeds: Seeds, first: int
) -> None:
    survive_diagnosis(tmp_path, seeds(first, first + 10))
