"""Attacks from outside: damaged stores, files and suites, and outputs in wrong places, each ends in one clear line.

The seeds of the quick suite are few; the slow tests take more of them.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from commandline import EQUATION, FIT, SOON, Seeds, blocks, latticebench, no_longer_than, refused, soon
from latticebench.bench.store import FILE
from latticebench.bench.suite import load
from latticebench.systems.errors import InputError

# A figure of damaged numbers may be told to have an odd layout.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning", "ignore::RuntimeWarning")
posix = pytest.mark.skipif(os.name != "posix", reason="pipes and devices as POSIX has them")
MARKUP = """
title = "{title}"
[methods."{label}"]
method = "zero"
[methods.other]
method = "least-squares"
[defaults]
sites = 5
samples = 8
span = 1.0
libraries = ["lib1"]
[[grid]]
part = "{label}"
system = "phi4"
noise = [0.0, 0.01]
"""
ODD = ("null", "[]", "{}", "5", '"x"', "true", "{", "", "[" * 100_000, "1" * 10_000, '{"a": {"b": [1, null, "c"]}}')


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a suite whose names are markup, its results, and samples."""
    folder = tmp_path_factory.mktemp("made")
    text = MARKUP.format(title="[/x] <b> \\\\input", label="=$\\\\input{{x}}$ [/x] <script>|_ ](x)")
    (folder / "s.toml").write_text(text.replace("{{", "{").replace("}}", "}"))
    assert latticebench("run", "s.toml", "--jobs", 1, "--results", "store", cwd=folder)[0] == 0
    assert latticebench("simulate", "phi4", "--sites", 5, "--samples", 12, "--out", "t.csv", cwd=folder)[0] == 0
    return folder


# Stores


def bytes_damaged(store: Path, draw: random.Random) -> None:
    content = bytearray((store / FILE).read_bytes())
    match draw.randrange(3):
        case 0:
            for _ in range(draw.choice((1, 10, 200))):
                content[draw.randrange(len(content))] = draw.randrange(256)
        case 1:
            del content[draw.randrange(len(content)) :]
        case 2:
            first = draw.randrange(len(content))
            content[first : first + 4096] = bytes(4096)
    (store / FILE).write_bytes(content)


COLUMNS = (
    ("results", '"case"'), ("results", "content"), ("results", "history"), ("results", "status"), ("results", "kind"),
    ("results", "reason"), ("results", "identity"), ("results", "origin"), ("origins", "origin"), ("about", "value"),
    ("about", "name"), ("suite", "place"), ("results", "seed"),
)  # fmt: skip


def content_damaged(store: Path, draw: random.Random) -> None:
    """Replace a column, or one value within the JSON of one."""
    table, column = draw.choice(COLUMNS)
    with sqlite3.connect(store / FILE) as connection:
        value: Any = draw.choice((*ODD, b"\xff\xfe", 5, None))
        if column in ('"case"', "content") and draw.random() < 0.7:
            whole = json.loads(next(connection.execute(f"SELECT {column} FROM {table}"))[0])
            key = draw.choice(sorted(whole))
            whole[key] = draw.choice((None, [], {}, "x", -1, True, [[1]], {"a": "b"}, "inf", 1e300))
            if draw.random() < 0.2:
                del whole[key]
            value = json.dumps(whole)
        try:
            connection.execute(f"UPDATE OR REPLACE {table} SET {column} = ?", (value,))
        except sqlite3.IntegrityError:
            connection.execute(f"DELETE FROM {table}")
    connection.close()


def replaced(store: Path, draw: random.Random) -> None:
    (store / FILE).unlink()
    match draw.randrange(5):
        case 0:
            (store / FILE).mkdir()
        case 1:
            os.mkfifo(store / FILE)
        case 2:
            (store / FILE).symlink_to("/dev/zero")
        case 3:
            (store / FILE).symlink_to(FILE)
        case 4:
            (store / FILE).write_text("{}")


def survive_damage(made: Path, folder: Path, seeds: range) -> None:
    # The journal is written into the file before it is copied.
    with sqlite3.connect(made / "store" / FILE) as connection:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    for seed in seeds:
        draw = random.Random(seed)
        harm: Callable[[Path, random.Random], None] = draw.choice((bytes_damaged, content_damaged, replaced))
        store = folder / f"store{seed}"
        store.mkdir()
        shutil.copy(made / "store" / FILE, store / FILE)
        harm(store, draw)
        for command in (
            ["table", store, "--out", folder / "out"], ["table", store, "--json"],
            ["figures", store, "--out", folder / "out"], ["compare", store, made / "store"], ["status", store],
            ["merge", made / "store", store, "--out", folder / "merged"], ["publish", store, "--out", folder / "site"],
        ):  # fmt: skip
            code, _, err = soon(*command, cwd=folder)
            assert code in (0, 1, 2), (seed, command)
            assert code != 2 or (err.startswith("error: ") and err.count("\n") == 1), (seed, command, err)
            # What is told is the store that is damaged, not one that is made of it.
            assert ".merge-" not in err, (seed, command, err)
            for made_of_it in ("merged", "site"):
                shutil.rmtree(folder / made_of_it, ignore_errors=True)


@posix
def test_a_store_whose_plan_is_damaged_is_named_where_it_is_merged(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / "store", tmp_path / "broken")
    with sqlite3.connect(tmp_path / "broken" / FILE) as connection:
        connection.execute("CREATE TABLE other (place INTEGER PRIMARY KEY, key TEXT)")
        connection.execute("INSERT INTO other SELECT place, NULL FROM suite")
        connection.execute("DROP TABLE suite")
        connection.execute("ALTER TABLE other RENAME TO suite")
    connection.close()
    line = refused("merge", made / "store", "broken", "--out", "merged", cwd=tmp_path)
    assert line.startswith(f"error: {Path('broken', FILE)}: not a store of results that can be read")
    assert not (tmp_path / "merged").exists()


@posix
def test_a_damaged_store_is_read_or_refused_in_one_line(made: Path, tmp_path: Path, seeds: Seeds) -> None:
    survive_damage(made, tmp_path, seeds(0, 8))


@posix
@pytest.mark.slow
@pytest.mark.parametrize("first", blocks(1000, 1200, 50))
def test_many_damaged_stores_are_read_or_refused_in_one_line(
    made: Path, tmp_path: Path, seeds: Seeds, first: int
) -> None:
    survive_damage(made, tmp_path, seeds(first, first + 50))


# Data


def data_damaged(path: Path, draw: random.Random) -> None:
    content = bytearray(path.read_bytes())
    for _ in range(draw.choice((1, 3, 30))):
        place = draw.randrange(len(content))
        match draw.randrange(4):
            case 0:
                content[place] = draw.randrange(256)
            case 1:
                del content[place : place + draw.randrange(1, 20)]
            case 2:
                content[place:place] = content[: draw.randrange(1, 40)]
            case 3:
                odd = (b"\0", b"nan", b"inf", b"1e999", b"-", b'"', b",", b"\n", b"#", b"\xff", b"True", b"9" * 5000)
                content[place:place] = draw.choice(odd)
    path.write_bytes(content)


def survive_data(made: Path, folder: Path, seeds: range) -> None:
    for ending in ("csv", "npz", "parquet"):
        name = f"t.{ending}"
        assert latticebench("simulate", "phi4", "--sites", 3, "--samples", 8, "--out", name, cwd=folder)[0] == 0
        for seed in seeds:
            damaged = folder / f"damaged{seed}.{ending}"
            shutil.copy(folder / name, damaged)
            data_damaged(damaged, random.Random(seed))
            before = damaged.read_bytes()
            for command in (["fit", damaged, *FIT], ["diagnose", damaged, *EQUATION])[: 1 + (seed % 3 == 0)]:
                code, _, err = soon(*command, cwd=folder)
                assert code in (0, 2), (seed, ending, command)
                assert code == 0 or (err.startswith("error: ") and err.count("\n") == 1), (seed, ending, err)
            assert damaged.read_bytes() == before
            damaged.unlink()


def test_damaged_data_are_fitted_or_refused_in_one_line(made: Path, tmp_path: Path, seeds: Seeds) -> None:
    survive_data(made, tmp_path, seeds(0, 12))


@pytest.mark.slow
@pytest.mark.parametrize("first", blocks(1000, 1400, 100))
def test_many_damaged_data_are_fitted_or_refused_in_one_line(
    made: Path, tmp_path: Path, seeds: Seeds, first: int
) -> None:
    survive_data(made, tmp_path, seeds(first, first + 100))


@posix
def test_what_is_no_regular_file_is_not_read(made: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.csv")
    os.mkfifo(tmp_path / "pipe.toml")
    os.mkfifo(tmp_path / "pipe.py")
    (tmp_path / "zero.csv").symlink_to("/dev/zero")
    (tmp_path / "zero.toml").symlink_to("/dev/zero")
    assert "a pipe" in refused("fit", "pipe.csv", *FIT, cwd=tmp_path)
    assert "a device" in refused("fit", "zero.csv", *FIT, cwd=tmp_path)
    assert "a pipe" in refused("run", "pipe.toml", cwd=tmp_path)
    assert "a device" in refused("run", "zero.toml", cwd=tmp_path)
    assert "a device" in refused("diagnose", made / "t.csv", "--system", "phi4", "--effects", "zero.toml", cwd=tmp_path)
    assert "a pipe" in refused("fit", made / "t.csv", *FIT, "--method", "pipe.py", cwd=tmp_path)
    assert "no results" in refused("compare", "zero.csv", "zero.csv", cwd=tmp_path)
    assert "a device" in refused("data", "take", "gliders", "zero.csv", cwd=tmp_path)


def test_names_of_any_length_and_bytes_are_told_and_written(made: Path, tmp_path: Path) -> None:
    long = "x" * 300
    for arguments in (
        ["fit", f"{long}.csv", *FIT], ["run", f"{long}.toml"], ["run", "tiny", "--results", long], ["table", long],
        ["figures", long], ["compare", long, long], ["fit", made / "t.csv", *FIT, "--method", f"{long}.py"],
        ["fit", made / "t.csv", *FIT, "--json", long], ["data", "take", "gliders", made / "t.csv", long],
    ):  # fmt: skip
        refused(*arguments, cwd=tmp_path)
    if os.name == "posix":
        odd = os.fsdecode(b"\xff\x1b[31m.csv")
        shutil.copy(made / "t.csv", tmp_path / odd)
        code, out, _ = latticebench("fit", odd, *FIT, "--json", "-", cwd=tmp_path)
        assert code == 0
        assert json.loads(out)["schema"] == "latticebench/fit/1"
        assert "\x1b" not in refused("fit", odd + "x", *FIT, cwd=tmp_path)


# Outputs


def test_no_output_replaces_an_input_or_another_output(made: Path, tmp_path: Path) -> None:
    shutil.copy(made / "t.csv", tmp_path / "t.csv")
    (tmp_path / "own.toml").write_text("x = 1")
    before = (tmp_path / "t.csv").read_bytes()
    (tmp_path / "link.csv").symlink_to("t.csv")
    os.link(tmp_path / "t.csv", tmp_path / "hard.csv")
    for arguments in (
        ["fit", "t.csv", *FIT, "--json", "t.csv"], ["fit", "t.csv", *FIT, "--json", "./x/../t.csv"],
        ["fit", "t.csv", *FIT, "--json", "link.csv"], ["fit", "link.csv", *FIT, "--json", "t.csv"],
        ["fit", "t.csv", *FIT, "--json", "hard.csv"], ["diagnose", "t.csv", "--system", "phi4", "--html", "t.csv"],
        ["diagnose", "t.csv", "--system", "phi4", "--effects", "own.toml", "--html", "own.toml"],
        ["diagnose", "link.csv", "--system", "phi4", "--holdout", "t.csv", "--json", "t.csv"],
        ["limit", "t.csv", "--system", "phi4", "--library", "lib1", "--json", "t.csv"],
        ["simulate", "own.toml", "--out", "own.toml"],
    ):  # fmt: skip
        assert "read by the same command" in refused(*arguments, cwd=tmp_path)
    both = ["--json", "r", "--html", "./r"]
    assert "the same file" in refused("diagnose", "t.csv", "--system", "phi4", *both, cwd=tmp_path)
    assert (tmp_path / "t.csv").read_bytes() == before
    assert (tmp_path / "own.toml").read_text() == "x = 1"
    assert not (tmp_path / "r").exists()


@posix
def test_places_that_cannot_be_written_are_refused_before_the_work(made: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "full").symlink_to("/dev/full")
    (tmp_path / "file").write_text("x")
    with mock.patch("latticebench.methods.method.solve", side_effect=AssertionError("it has begun")):
        for place in ("pipe", "full", ".", "file/x.json", "/proc/x.json", "x" * 300):
            refused("fit", made / "t.csv", *FIT, "--json", place, cwd=tmp_path)
    assert Path("/dev/full").is_char_device()
    assert (tmp_path / "full").is_symlink()


def test_empty_names_stand_for_nothing(made: Path, tmp_path: Path) -> None:
    for arguments in (
        ["fit", made / "t.csv", *FIT[:-2], "--method", ""], ["run", "tiny", "--results", ""],
        ["table", made / "store", "--out", " "], ["fit", made / "t.csv", *FIT, "--json", ""],
        ["simulate", "phi4", "--out", ""], ["schema", "--out", ""], ["run", "tiny", "--data", ""],
    ):  # fmt: skip
        assert "it is empty" in refused(*arguments, cwd=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_link_is_kept_and_what_it_leads_to_is_replaced(made: Path, tmp_path: Path) -> None:
    (tmp_path / "real.json").write_text("old")
    (tmp_path / "link.json").symlink_to("real.json")
    assert latticebench("fit", made / "t.csv", *FIT, "--json", "link.json", cwd=tmp_path)[0] == 0
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "real.json").read_text())["method"] == "least-squares"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no device that is full")
def test_a_full_screen_is_one_line(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "latticebench", "list", "suites"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: standard output")
    assert done.stderr.count("\n") == 1


# Suites


VALUES = (
    "true", "-1", "0", "1e300", "inf", "nan", '""', '"x"', "[]", "{}", "[[]]", "1" + "0" * 400, '"\\u0000"', '"$[/b]"',
    '"../../x.py"', "[1, 2, 3]", '"1-9999"', "1979-05-27", '["a", 1]', "[" * 200 + "]" * 200,
)  # fmt: skip
KEYS = (
    "system", "parameters", "libraries", "terms", "initial", "sites", "ends", "integrator", "samples", "span", "uneven",
    "velocities", "trajectories", "noise", "missing", "mirror", "seeds", "methods", "time_limit", "memory_limit",
    "part",
)  # fmt: skip
OTHER_BLOCKS = {
    "made": ("effects", "systems", "noise", "z", "seeds", "sites", "samples", "velocities", "time_limit"),
    "measured": ("name", "file", "rows", "terms", "order", "ends", "time_limit", "memory_limit"),
}


ZERO = '"zero"'


def survive_suites(folder: Path, seeds: range) -> None:
    for seed in seeds:
        draw = random.Random(seed)
        given = {"system": '"phi4"', "libraries": '["lib1"]', "sites": "5", "samples": "8"}
        given |= {draw.choice(KEYS): draw.choice(VALUES) for _ in range(draw.randrange(3))}
        text = f"[methods.a]\nmethod = {draw.choice((ZERO, *VALUES))}\n[[grid]]\n"
        text += "".join(f"{key} = {value}\n" for key, value in given.items())
        kind = draw.choice(list(OTHER_BLOCKS))
        if draw.random() < 0.3:
            text += f"[[{kind}]]\n" + "".join(f"{key} = {draw.choice(VALUES)}\n" for key in OTHER_BLOCKS[kind])
        path = folder / f"s{seed}.toml"
        path.write_text(text)
        try:
            with no_longer_than(SOON):
                load(str(path))
        except InputError as error:
            assert str(path) in str(error) or path.name in str(error), (seed, str(error))  # noqa: PT017
        except Exception as error:
            raise AssertionError((seed, text)) from error


def test_odd_suites_are_loaded_or_refused_with_their_name(tmp_path: Path, seeds: Seeds) -> None:
    survive_suites(tmp_path, seeds(0, 30))


@pytest.mark.slow
def test_many_odd_suites_are_loaded_or_refused_with_their_name(tmp_path: Path, seeds: Seeds) -> None:
    survive_suites(tmp_path, seeds(1000, 1600))


def test_absurd_sizes_need_a_confirmation(tmp_path: Path) -> None:
    head = '[methods.a]\nmethod = "zero"\n[[grid]]\nsystem = "phi4"\nlibraries = ["lib1"]\n'
    for text, told in (
        ('seeds = "1-9999"\nnoise = [' + ", ".join(f"{k}" for k in range(1001)) + "]", "cases"),
        ("sites = 1_000_000\nsamples = 1_000_000", "MiB"), ("sites = 1" + "0" * 400, "MiB"),
        ("span = 1e300", "time of 1e+300"), ("trajectories = 100_000_000", "trajectories"),
    ):  # fmt: skip
        (tmp_path / "s.toml").write_text(head + text)
        line = refused("run", "s.toml", cwd=tmp_path)
        assert told in line
        assert "--yes" in line
    long = "time_limit = 1e9\nsamples = 8\nsites = 5\nspan = 1.0"
    (tmp_path / "s.toml").write_text(head + long)
    assert "hours" in refused("run", "s.toml", cwd=tmp_path)
    code, _, err = latticebench("run", "s.toml", "--yes", "--jobs", 1, cwd=tmp_path)
    assert code == 0
    assert "at most 277778 hours" in err
    for option in (["--span", "1e300"], ["--trajectories", 10**8], ["--samples", 10**10], ["--sites", 10**30]):
        assert "--yes" in refused("simulate", "phi4", *option, "--out", "x.csv", cwd=tmp_path)


def test_texts_that_break_parsers_are_told(tmp_path: Path) -> None:
    for name, text in {
        "deep": "a = " + "[" * 100_000 + "]" * 100_000, "long": "a = " + "1" * 100_000, "nul": "title = 'a\0'",
        "...": "title = 'a'", "bytes": "title = '\udcff'",
    }.items():  # fmt: skip
        (tmp_path / f"{name}.toml").write_bytes(text.encode(errors="surrogateescape"))
        assert f"{name}.toml: " in refused("run", f"{name}.toml", cwd=tmp_path)


def test_a_file_beyond_the_largest_size_is_refused_and_the_option_raises_it(made: Path, tmp_path: Path) -> None:
    row = ",".join(["0.25"] * 6)
    lines = ["t,u1,u2,u3,u4,u5", *(f"{k}{row[4:]}" for k in range(60_000))]
    (tmp_path / "large.csv").write_text("\n".join(lines))
    line = refused("--largest-file", 1, "fit", "large.csv", *FIT, cwd=tmp_path)
    assert "--largest-file" in line
    assert "large.csv" in line


# Labels


def test_labels_that_are_markup_are_shown_as_they_are(made: Path, tmp_path: Path) -> None:
    code, out, _ = latticebench("table", "store", "--out", tmp_path / "out", cwd=made)
    assert code == 0
    assert "=$\\input{x}$ [/x] <script>|_ ](x)" in out
    assert latticebench("figures", "store", "--out", tmp_path / "drawn", cwd=made)[0] == 0
    for path in (tmp_path / "out").iterdir():
        text = path.read_text()
        match path.suffix:
            case ".md":
                assert "<script" not in text
                assert "](x)" not in text
            case ".tex":
                body = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
                assert "\\input" not in body
            case ".csv":
                body = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
                assert not any(
                    cell.lstrip('"').startswith("=") for line in body.splitlines() for cell in line.split(",")
                )
    assert latticebench("compare", tmp_path / "out", "store", cwd=made)[0] == 0


def test_settings_that_make_no_case_are_refused_with_their_key(tmp_path: Path) -> None:
    head = '[methods.a]\nmethod = "stlsq"\n[[grid]]\nsystem = "phi4"\nlibraries = ["lib1"]\n'
    for text, told in (
        (head + "time_limit = inf", "grid 1: time_limit"),
        (head.replace("[[", "settings = {threshold = true}\n[["), "methods.a"),
        (head.replace("[[", "settings = {threshold = -1}\n[["), "methods.a: method 'stlsq': setting threshold"),
        (head.replace("stlsq", "pinn").replace("[[", "settings = {device = 'nope'}\n[["), "methods.a: method 'pinn'"),
        ('[[made]]\neffects = ["none"]\nsystems = ["phi4"]\nsites = -5', "made 1: sites"),
    ):  # fmt: skip
        (tmp_path / "s.toml").write_text(text)
        assert told in refused("run", "s.toml", cwd=tmp_path)
