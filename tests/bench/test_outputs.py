"""Outputs of commands that read results: none replaces what is read; and stores and tables that are damaged."""

from __future__ import annotations

import json
import random
import re
import shutil
import sqlite3
import time
from pathlib import Path

import numpy as np
import pytest

from commandline import SUITE, Seeds, latticebench, refused, unchanged
from latticebench.bench.fitting import FitCase
from latticebench.bench.leases import Leases
from latticebench.bench.published import read_table
from latticebench.bench.run import counts
from latticebench.bench.store import FILE, create
from latticebench.systems.errors import InputError

# A figure of damaged numbers may be told to have an odd layout.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::RuntimeWarning")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a suite, its results, and its tables."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "s.toml").write_text(SUITE)
    assert latticebench("run", "s.toml", "--jobs", 1, "--results", "store", cwd=folder)[0] == 0
    assert latticebench("table", "store", "--out", "tables", cwd=folder)[0] == 0
    with sqlite3.connect(folder / "store" / FILE) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    return folder


def test_tables_that_are_read_are_not_replaced(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / "tables", tmp_path / "tables")
    (tmp_path / "link").symlink_to("tables")
    (tmp_path / "both").mkdir()
    shutil.copytree(made / "tables", tmp_path / "both" / "fit")
    store, table = made / "store", Path("tables") / "cases.csv"
    with unchanged(tmp_path):
        for arguments in (
            ["table", store, "--with", "tables", "--out", "tables"], ["table", store, "--with", table, "--out", "link"],
            ["table", store, "--with", "both/fit", "--out", "both"],
            ["compare", table, "--against", "other", "--out", table],
            ["compare", "tables", "--against", "other", "--out", "link/cases.csv"],
            ["compare", store, "--with", "tables", "--against", "other", "--out", table],
        ):  # fmt: skip
            assert "read by the same command" in refused(*arguments, cwd=tmp_path)


def test_places_of_tables_and_figures_are_looked_at_before_anything_is_shown(made: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with unchanged(tmp_path):
        for command in (["table", made / "store"], ["figures", made / "store"]):
            code, out, err = latticebench(*command, "--out", "file/within", cwd=tmp_path)
            assert (code, out) == (2, "")
            assert "cannot be written" in err
        code, out, err = latticebench("compare", made / "store", "--against", "other", "--out", "file/x", cwd=tmp_path)
        assert (code, out) == (2, "")
        assert "cannot be written" in err


# Stores whose plan and times are damaged: a run continues, and a dry run tells, or both say what is wrong.

STATEMENTS = (
    "UPDATE results SET identity = '[1]' WHERE rowid = 1", "UPDATE results SET identity = x'ff'",
    "UPDATE results SET content = json_set(content, '$.seconds', 'nan')",
    "UPDATE results SET content = json_set(content, '$.cpu_seconds', 1e300)",
    "UPDATE results SET status = 'timeout', \"case\" = '{}'", "UPDATE results SET status = 'memory', \"case\" = '[['",
    "INSERT INTO leases SELECT key, 'another machine 1 0.00 x', 1e300 FROM results; DELETE FROM results",
    "INSERT INTO leases SELECT key, x'ff', 'x' FROM results; DELETE FROM results",
)  # fmt: skip


def survive_run(made: Path, folder: Path, statement: str, *options: str) -> None:
    folder.mkdir()
    shutil.copy(made / "store" / FILE, folder / FILE)
    connection = sqlite3.connect(folder / FILE)
    connection.executescript(statement)
    connection.close()
    code, _, err = latticebench("run", "s.toml", "--jobs", 1, "--results", folder, *options, cwd=made)
    assert code in (0, 2), err
    assert code == 0 or err.splitlines()[-1].startswith("error: "), err


@pytest.mark.parametrize("statement", STATEMENTS)
def test_what_a_run_would_take_on_a_damaged_store_is_told_or_refused_in_one_line(
    statement: str, made: Path, tmp_path: Path
) -> None:
    survive_run(made, tmp_path / "store", statement, "--dry-run")


@pytest.mark.slow
@pytest.mark.parametrize("statement", STATEMENTS)
def test_a_run_on_a_damaged_store_goes_on_or_is_refused_in_one_line(statement: str, made: Path, tmp_path: Path) -> None:
    survive_run(made, tmp_path / "store", statement)


def test_a_result_whose_case_cannot_be_read_does_not_count() -> None:
    case = FitCase(system="phi4", library="lib1", label="a", method="zero")
    assert counts(case, "timeout", case.model_dump_json(), retry=False)
    for text in ("{}", "[[", "5", '{"time_limit": null}'):
        assert not counts(case, "timeout", text, retry=False)


def test_a_name_of_a_folder_steers_no_terminal(made: Path, tmp_path: Path) -> None:
    odd = "\x1b[31m"
    shutil.copytree(made / "store", tmp_path / odd)
    connection = sqlite3.connect(tmp_path / odd / FILE)
    connection.execute("UPDATE results SET status = ?", (odd,))
    connection.close()
    for arguments in (
        ["run", made / "s.toml", "--dry-run", "--results", odd], ["table", odd, "--out", f"{odd}2"],
        ["schema", "fit", "--out", odd], ["run", odd], ["figures", odd],
    ):  # fmt: skip
        _, out, err = latticebench(*arguments, cwd=tmp_path)
        assert out or err
        assert "\x1b" not in out + err, arguments


def test_a_lease_from_far_ahead_keeps_nobody_waiting(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    mine, other = Leases(store), Leases(store, owner="another machine 1 0.00 x")
    assert other.take("key")
    assert not mine.take("key")
    for until in (time.time() + 1e9, "never", float("inf")):
        store.connection.execute("UPDATE leases SET owner = ?, until = ?", (other.owner, until))
        assert mine.take("key"), until


@pytest.mark.parametrize(
    "told",
    [
        "[", "[]", '{"left": "x"}', '{"left": 1e300}', '{"done": -1}', '{"began": NaN}', '{"began": 1e300}',
        '{"began": "\\u001b"}', '{"running": {"a": 1}}', '{"running": {"\\u001b[1m": ["\\u001b", 1e300]}}',
        '{"running": {"\\u001b[1m": ["\\u001b", 5]}}', '{"wrong": 5}', '{"wrong": ["\\u001b[1m", null]}', "{}",
    ],
)  # fmt: skip
def test_what_a_damaged_store_says_of_a_run_is_told_or_refused_in_one_line(told: str, tmp_path: Path) -> None:
    whole = {"left": 4, "done": 2, "began": time.time() - 5, "running": {}, "wrong": []}
    store = create(tmp_path / "store")
    content = f"{json.dumps(whole)[:-1]}, {told[1:]}" if len(told) > 2 else told
    until = time.time() + 30
    store.connection.execute("INSERT INTO runs VALUES (?, ?, ?)", ("another machine 1 0.00 x", until, content))
    code, out, err = latticebench("status", "store", cwd=tmp_path)
    assert code in (0, 2)
    assert code == 0 or (err.startswith("error: ") and err.count("\n") == 1), err
    assert "\x1b" not in out + err


# Published tables.


def cells_damaged(text: str, draw: random.Random) -> str:
    lines = text.split("\n")
    for _ in range(draw.choice((1, 2, 5))):
        row = draw.randrange(len(lines))
        cells = lines[row].split(",")
        column = draw.randrange(len(cells))
        match draw.randrange(5):
            case 0:
                cells[column] = draw.choice(("nan", "inf", "x", "", '"', "1e999", "=1", "\x1b[31m", "[/x] $\\frac{"))
            case 1:
                del cells[column]
            case 2:
                cells.insert(column, "1")
            case 3:
                cells = cells[:column]
            case 4:
                cells[column] = cells[column][: len(cells[column]) // 2]
        lines[row] = ",".join(cells)
    return "\n".join(lines)


def survive_tables(made: Path, folder: Path, seeds: range) -> None:
    for seed in seeds:
        tables = folder / f"tables{seed}"
        shutil.copytree(made / "tables", tables)
        draw = random.Random(seed)
        for name in [*draw.sample(sorted(path.name for path in tables.glob("*.csv")), 3), "cases.csv"]:
            (tables / name).write_text(cells_damaged((tables / name).read_text(), draw))
        for command in (
            ["table", made / "store", "--with", tables, "--out", folder / "out"], ["compare", tables, made / "store"],
            ["figures", made / "store", "--with", tables, "--only", "noise", "--out", folder / "out"],
            ["compare", tables, "--against", "other"], ["publish", tables, "--out", folder / "site"],
        ):  # fmt: skip
            code, out, err = latticebench(*command, cwd=folder)
            assert code in (0, 1, 2), (seed, command)
            assert code != 2 or (err.startswith("error: ") and err.count("\n") == 1), (seed, command, err)
            assert "\x1b" not in out + err, (seed, command)


def test_damaged_tables_are_read_or_refused_in_one_line(made: Path, tmp_path: Path, seeds: Seeds) -> None:
    survive_tables(made, tmp_path, seeds(0, 4))


@pytest.mark.slow
def test_many_damaged_tables_are_read_or_refused_in_one_line(made: Path, tmp_path: Path, seeds: Seeds) -> None:
    survive_tables(made, tmp_path, seeds(100, 250))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a,e2\n1\n", "row 1: 1 cells under 2 columns"), ("a,e2\n1,2\n1,2,3\n", "row 2: 3 cells"),
        ("a,a\n1,2\n", "two columns are called 'a'"), ("", "names of its columns"), ('a,e2\n"1,2\n', "not a table"),
        ("a,e2\n1,2\n1,two\n", "row 2, column e2: 'two' is no number"), ("a,e2\n1,=1\n", "column e2: '=1'"),
    ],
)  # fmt: skip
def test_a_damaged_row_of_a_published_table_is_refused_with_its_place(text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "cases.csv").write_text("# a: b\n" + text)
    with pytest.raises(InputError, match=re.escape(told)) as refusal:
        read_table(tmp_path / "cases.csv", ("e2",))
    assert "cases.csv: " in str(refusal.value)


def test_a_table_that_another_program_has_saved_is_read(tmp_path: Path) -> None:
    (tmp_path / "cases.csv").write_text("\ufeffa,e2\r\n'=x,1e-3\r\ny,\r\nz,inf\r\n", encoding="utf-8")
    table = read_table(tmp_path / "cases.csv", ("e2",))
    assert list(table["a"]) == ["=x", "y", "z"]
    np.testing.assert_array_equal(table["e2"], [1e-3, np.nan, np.inf])


def test_a_fit_whose_motion_cannot_be_drawn_is_written_all_the_same(tmp_path: Path) -> None:
    assert latticebench("simulate", "phi4", "--sites", 4, "--samples", 10, "--out", "t.csv", cwd=tmp_path)[0] == 0
    given = ["fit", "t.csv", "--order", 2, "--terms", "u[n]**0.5"]
    assert latticebench(*given, "--method", "least-squares", "--json", "r.json", cwd=tmp_path)[0] == 0
    assert json.loads((tmp_path / "r.json").read_text())["method"] == "least-squares"
    for method in ("trajectory", "weak"):
        assert "not finite" in refused(*given, "--method", method, cwd=tmp_path)
