"""A site shows what was published, all of it and nothing else, and harms no folder."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest

from commandline import refused, succeed
from latticebench.bench.colours import series
from latticebench.bench.figures import save
from latticebench.bench.overlay import Overlay, of_recording
from latticebench.bench.plots import plot
from latticebench.bench.report.shown import Shown
from latticebench.bench.site.build import MANIFEST, build
from latticebench.bench.site.folders import check_still
from latticebench.bench.site.pages import number
from latticebench.systems.samples import Samples

RESULTS = Path(__file__).parents[3] / "results"
HERE = {"command": "latticebench publish"}
MEASURED = json.loads((RESULTS / "measured" / "gliders.json").read_text(encoding="utf-8"))
UNSOUND = json.dumps(
    MEASURED | {"shown": {"source": "a.csv", "rows": 1, "t": [0], "seen": [[[0]]], "noise": None, "curves": {}}}
)


def read(path: Path) -> list[dict[str, str]]:
    """Read a table as it lies in the results, with a reader of this file's own."""
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


@pytest.mark.parametrize("name", ["default", "efficiency", "paper", "limits"])
def test_every_number_of_a_suite_is_that_of_its_csv_file(whole_site: Path, page: Callable[..., Any], name: str) -> None:
    shown = page(whole_site / name / "index.html")
    columns = [one[0] for one in shown.data[0]["columns"]]
    rows = [dict(zip(columns, row, strict=True)) for row in shown.data[0]["rows"]]
    source = read(RESULTS / name / "summary.csv")
    assert len(rows) == len(source)
    for row, cells, published in zip(rows, shown.tables[0][1:], source, strict=True):
        words = published["data"].split()
        assert row["system"] == words[0]
        assert f"noise={row['noise']}" in words or (row["noise"], "noise=" in published["data"]) == ("0", False)
        for column, text in published.items():
            if column in ("data", "part") and column not in row:
                continue
            if column in ("e2_low", "e2_high") and published["seeds"] in ("0", "1"):
                # One seed has no spread to show.
                text = ""
            assert column == "data" or row.get(column, "") == text, column
        for column, cell in zip(columns, cells, strict=True):
            if column not in ("ok", "data", "library", "method", "system", "part") and row[column]:
                assert float(cell) == pytest.approx(float(row[column]), rel=5e-3)


@pytest.mark.slow
def test_every_table_here_is_whole_on_some_page(whole_site: Path, page: Callable[..., Any]) -> None:
    for path in sorted(RESULTS.rglob("*.csv")):
        folder = whole_site / path.parent.relative_to(RESULTS)
        own = folder / f"table-{path.stem}.html"
        shown = page(own if own.is_file() else folder / "index.html")
        source = read(path)
        sizes = [len(one["rows"]) for one in shown.data]
        assert len(source) in sizes, path
        # A suite's summary has columns of its own; the test above compares it.
        if own.is_file():
            (data,) = shown.data
            plain = [[cell.removeprefix("'") for cell in one.values()] for one in source]
            assert [[cell.removeprefix("'") for cell in row] for row in data["rows"]] == plain


def test_the_spread_is_the_middle_80_percent_of_the_seeds(whole_site: Path, page: Callable[..., Any]) -> None:
    shown = page(whole_site / "limits" / "index.html").data[0]
    columns = [one[0] for one in shown["columns"]]
    source, cases = read(RESULTS / "limits" / "summary.csv"), read(RESULTS / "limits" / "cases.csv")
    checked = 0
    for published, row in list(zip(source, shown["rows"], strict=True))[::37]:
        keys = ("part", "data", "library", "method")
        same = [float(one["e2"]) for one in cases if all(one[key] == published[key] for key in keys)]
        found = dict(zip(columns, row, strict=True))
        assert found["seeds"] == str(len(same))
        if len(same) > 1:
            checked += 1
            ordered = sorted(same)
            # The nearest of the seeds to each end: some seed on its side, and no other nearer to it.
            for name, share in (("e2_low", 0.1), ("e2_high", 0.9)):
                place = share * (len(same) - 1)
                assert float(found[name]) in [ordered[int(np.floor(place))], ordered[int(np.ceil(place))]]
            assert float(found["e2_low"]) <= float(found["e2"]) <= float(found["e2_high"])
        else:
            assert (found["e2_low"], found["e2_high"]) == ("", "")
    assert checked > 5


def test_every_row_of_a_suite_tells_its_seeds_and_settings_and_every_page_what_made_it(
    whole_site: Path, page: Callable[..., Any]
) -> None:
    for name in ("ablation", "cross", "default", "efficiency", "limits", "paper"):
        shown = page(whole_site / name / "index.html")
        about = dict(shown.data[0]["about"])
        assert {"command", "commit", "machine", "date"} <= set(about)
        assert all(text in shown.text for text in about.values())
        methods = {one[0]: one[1] for one in shown.data[0]["figure"]["methods"]}
        assert methods == {method: series(place) for place, method in enumerate(methods)}
        column = [one[0] for one in shown.data[0]["columns"]].index("method")
        for row, details in zip(shown.data[0]["rows"], shown.data[0]["details"], strict=True):
            told = dict(details)
            assert told["seeds"]
            assert told.get("settings", f"{row[column]} ").startswith(f"{row[column]} ")
    assert shown.links.count("#made") > len(shown.data[0]["rows"])


def test_every_file_is_in_the_site_and_every_link_leads_to_one(whole_site: Path, page: Callable[..., Any]) -> None:
    sources = [one for one in RESULTS.rglob("*") if one.is_file() and "__pycache__" not in one.parts]
    for one in sources:
        assert (whole_site / "files" / one.relative_to(RESULTS)).read_bytes() == one.read_bytes()
    linked = set()
    for path in whole_site.rglob("*.html"):
        for link in page(path).links:
            if not link.startswith(("#", "https://", "http://")):
                target = (path.parent / unquote(link.partition("#")[0])).resolve()
                assert target.is_file(), (path, link)
                linked.add(target)
    assert {(whole_site / "files" / one.relative_to(RESULTS)).resolve() for one in sources} <= linked


def test_labels_that_attack_are_shown_as_they_are(site: Path, page: Callable[..., Any], published: Path) -> None:
    hostile = {one["method"].removeprefix("'") for one in read(published / "cases.csv")}
    assert len(hostile) == 7
    for name in ("index.html", "table-cases.html"):
        shown = page(site / "mine" / name)
        # The script of the page and the data of its table; none of a label's.
        assert shown.tags.count("script") == 2
        assert not {"b", "i", "img"} & set(shown.tags)
        assert hostile <= {cell for row in shown.tables[0] for cell in row}
    prose = page(site / "mine" / "text-which.html")
    assert prose.tags.count("script") == 1
    assert "<script>alert(1)</script>" in prose.text
    assert not [link for link in prose.links if "javascript" in link or "none" in link]
    assert "../files/mine/summary.csv" in prose.links


def test_a_failure_counts_as_an_infinite_error_and_says_why(site: Path, page: Callable[..., Any]) -> None:
    shown = page(site / "mine" / "index.html").data[0]
    columns = [one[0] for one in shown["columns"]]
    rows = [dict(zip(columns, row, strict=True)) for row in shown["rows"]]
    place = next(k for k, row in enumerate(rows) if row["method"] == "[/x]")
    assert rows[place]["e2"] == rows[place]["e2_high"] == "inf"
    assert "a <b>reason</b>" in dict(shown["details"][place])["reason"]


def test_what_trials_named_is_counted(site: Path, page: Callable[..., Any]) -> None:
    shown = page(site / "mine" / "within" / "index.html")
    assert ["damping", "2", "1", "damping 1, nothing 1"] in shown.tables[0]


def test_the_page_of_a_diagnosis_draws_the_readings_that_its_document_has(tmp_path: Path) -> None:
    t = np.linspace(0, 3, 30)
    seen = np.cos(t)[:, None, None] * np.ones((1, 1, 2))
    shown = Shown.of(Overlay("a.csv", 30, t, seen, None, np.ones(2), {"declared": 0.9 * seen}, "px", "s"))
    folder = tmp_path / "mine"
    folder.mkdir()
    for name, has in (("with", shown.model_dump()), ("without", None)):
        (folder / f"{name}.json").write_text(json.dumps({**MEASURED, "shown": has}))
    build([folder], tmp_path / "site", HERE)
    made = tmp_path / "site" / "mine"
    assert '<img src="diagnosis-with.svg"' in (made / "diagnosis-with.html").read_text(encoding="utf-8")
    assert (made / "diagnosis-with.svg").read_text(encoding="utf-8").startswith("<?xml")
    assert "The readings are not published here" in (made / "diagnosis-without.html").read_text(encoding="utf-8")
    assert not (made / "diagnosis-without.svg").exists()


def test_a_page_loads_nothing_from_elsewhere_and_allows_no_other_script(whole_site: Path) -> None:
    for path in whole_site.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        assert "default-src 'none'" in text
        assert "unsafe" not in text.partition("</head>")[0]
        assert "<link" not in text
        assert "<script src" not in text


@pytest.mark.parametrize(
    ("cell", "shown"),
    [("0.0003433575", "3.43e-04"), ("133.7", "134"), ("9.9", "9.9"), ("12345.6", "12346"), ("0.0", "0"), ("3", "3"),
     ("inf", "inf"), ("", ""), ("known to 2 %", "known to 2 %"), ("1234567.0", "1.23e+06"), ("-0.05", "-0.05")],
)  # fmt: skip
def test_a_number_is_written_with_three_digits(cell: str, shown: str) -> None:
    assert number(cell) == shown


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("summary.csv", "a,b\n1\n", "row 1: 1 cells under 2 columns"),
        ("summary.csv", "a,a\n1,2\n", "two columns are called 'a'"),
        ("summary.csv", "", "the names of its columns are missing"),
        ("summary.csv", 'a,b\n"1,2\n', "not a table"),
        ("summary.csv", "a,b\n\x00,2\n", "line 2: not a text file"),
        ("one.json", "{", "not JSON"),
        ("one.json", '{"schema": "latticebench/diagnosis/2"}', "not a whole diagnosis: provenance"),
        ("one.json", UNSOUND, "shown: times, readings and curves do not match"),
        ("one.png", "no picture", "not a PNG"),
        ("a\nb.csv", "a\n1\n", "signs that cannot be shown"),
        (".hidden", "", "there is nothing in it"),
        ("a.svg", '<svg xmlns="http://www.w3.org/2000/svg"><script>alert(1)</script></svg>', "could run or load"),
        ("a.svg", "<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'/>", "could run or load"),
        ("a.svg", '<svg><image href="http://x.org/a.png"/></svg>', "could run or load"),
        ("a.svg", '<svg><a href="javascript:alert(1)">x</a></svg>', "could run or load"),
        ("a.svg", "<svg><g></svg>", "not an SVG"),
        ("a.svg", "<svg><style>@import url(//x.org/a.css)</style></svg>", "could run or load"),
    ],
)  # fmt: skip
def test_a_damaged_folder_is_refused_in_one_line_and_nothing_is_written(
    tmp_path: Path, name: str, content: str, told: str,
) -> None:  # fmt: skip
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / name).write_text(content)
    line = refused("publish", folder, "--out", "site", cwd=tmp_path)
    assert told in line
    assert str(folder) in line
    assert not (tmp_path / "site").exists()


def test_pictures_of_this_program_are_only_pictures(tmp_path: Path) -> None:
    t = np.arange(20.0)
    drawn = plot(of_recording(Samples(t, np.cos(np.multiply.outer(t, [1.0, 2.0, 3.0, 4.0, 5.0])))))
    check_still(save(drawn, tmp_path / "a.svg", {"command": "one = 'two'"}))


@pytest.mark.skipif(os.name != "posix", reason="makes links")
def test_what_a_link_leads_to_outside_of_the_folder_is_not_published(tmp_path: Path, published: Path) -> None:
    shutil.copytree(published, tmp_path / "mine")
    (tmp_path / "secret.txt").write_text("secret")
    (tmp_path / "mine" / "here.csv").symlink_to(min(tmp_path.glob("mine/*.csv")).name)
    succeed("publish", "mine", "--out", "site", cwd=tmp_path)
    for target in ("../secret.txt", tmp_path / "secret.txt"):
        (tmp_path / "mine" / "z.md").symlink_to(target)
        assert "z.md: a link to what does not lie in the folder" in refused(
            "publish", "mine", "--out", "site", cwd=tmp_path
        )
        (tmp_path / "mine" / "z.md").unlink()


def test_what_is_no_folder_of_results_is_refused(tmp_path: Path, published: Path) -> None:
    (tmp_path / "a" / "mine").mkdir(parents=True)
    shutil.copytree(published, tmp_path / "b" / "mine")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "store.json").write_text("{}")
    for given, told in (
        (["none"], "no such folder"), ([published / "cases.csv"], "a file, not a folder"),
        ([published, "b/mine"], "two folders are called 'mine'"),
        (["a/mine"], "there is nothing in it"),
        (["run"], "publish their tables first: latticebench table"),
    ):  # fmt: skip
        assert told in refused("publish", *given, "--out", "site", cwd=tmp_path)


def test_only_a_site_of_this_command_is_replaced(tmp_path: Path, published: Path) -> None:
    mine = tmp_path / "letters"
    mine.mkdir()
    (mine / "index.html").write_text("mine")
    assert "not a site of this command" in refused("publish", published, "--out", mine, cwd=tmp_path)
    assert [one.name for one in mine.iterdir()] == ["index.html"]
    for place in (published, published / "site", published.parent):
        assert "it lies in" in refused("publish", published, "--out", place, cwd=tmp_path)
    out = tmp_path / "site"
    first = build([published], out, HERE)
    (out / "mine" / "index.html").write_text("old")
    assert build([published], out, HERE) == first
    assert (out / "mine" / "index.html").read_text() != "old"
    assert {one.relative_to(out).as_posix() for one in out.rglob("*") if one.is_file()} == {*first, MANIFEST}
    (out / "notes.txt").write_text("mine")
    assert "notes.txt is not of the site" in refused("publish", published, "--out", out, cwd=tmp_path)
    assert (out / "notes.txt").read_text() == "mine"
    assert sorted(one.name for one in tmp_path.iterdir()) == ["letters", "site"]


def test_the_command_writes_a_site_and_says_where(published: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "latticebench", "publish", str(published), "--out", "site"],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.startswith("site/index.html: 5 pages, ") or "site\\index.html" in done.stdout
    assert (tmp_path / "site" / "mine" / "index.html").is_file()
    assert done.stderr == ""


def test_a_suite_of_this_package_is_introduced_by_what_it_is_for(whole_site: Path) -> None:
    front = (whole_site / "index.html").read_text(encoding="utf-8")
    assert "The paper&#39;s lattices and libraries, 50 noise-free samples" in front
    assert "The published cases under three kernels" not in front
