"""Choosing a part of a suite, what it will take, and putting parts together."""

from __future__ import annotations

import io
import shutil
import sqlite3
from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from commandline import latticebench, refused
from latticebench.bench import kinds
from latticebench.bench.case import Case, Folders
from latticebench.bench.choice import chosen
from latticebench.bench.estimate import estimate
from latticebench.bench.executors.executor import Ledger
from latticebench.bench.executors.local import Local
from latticebench.bench.fitting import FitCase
from latticebench.bench.merge import merge
from latticebench.bench.progress import PARTS, Lines, clock
from latticebench.bench.provenance import origin
from latticebench.bench.run import run
from latticebench.bench.store import Shard, create, open_store
from latticebench.bench.suite import Suite, load
from latticebench.bench.worker import attempt, outcome
from latticebench.systems.errors import InputError

RIDGE = Path(__file__).parents[2] / "docs" / "data" / "ridge.py"
SUITE = """
[methods.floor]
method = "zero"

[methods.dense]
method = "least-squares"
settings = { differentiation = "spline" }

[defaults]
sites = 9
samples = 12
span = 2.0

[[grid]]
part = "one"
system = "phi4"
libraries = ["lib1", "lib2"]
noise = [0.0, 0.01]
seeds = [1, 2]

[[grid]]
part = "two"
system = "sine-gordon"
libraries = ["sines"]
methods = ["floor"]
"""
TRIALS = """
[[made]]
effects = ["drive", "none"]
systems = ["phi4"]
z = [10]

[[measured]]
name = "chain"
file = "chain.csv"
terms = "u[n]"
order = 2
"""
SCORES = ("coefficients", "truth", "stderr", "e2", "einf", "tpr", "residual", "bound", "note", "status", "case")


@pytest.fixture
def path(tmp_path: Path) -> str:
    (tmp_path / "mine.toml").write_text(SUITE)
    return str(tmp_path / "mine.toml")


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run cases in this process: what workers do is tested elsewhere, and starting one takes seconds."""

    def execute(_: Local, cases: Sequence[Case], folders: Folders, loads: Collection[str], ledger: Ledger) -> None:
        made = origin(loads)
        for case in cases:
            if ledger.begin(case) == "run":
                ledger.keep(case, attempt(case, folders), made)

    monkeypatch.setattr(Local, "execute", execute)


def fits(suite: Suite) -> Counter[tuple[str, str]]:
    return Counter((case.part, case.label) for case in suite.cases if isinstance(case, FitCase))


def test_without_a_choice_a_suite_is_whole(path: str) -> None:
    assert load(path, choice=chosen()).cases == load(path).cases
    assert str(chosen()) == ""


@pytest.mark.parametrize(
    ("patterns", "count"),
    [
        (["phi4*"], 16), (["PHI4"], 16), (["two"], 1), (["lib2"], 8), (["*| lib2 |*seed 1"], 4), (["dense"], 8),
        (["phi4 * noise=0.01*", "sines"], 9), (["*"], 17), (["?wo"], 1),
    ],
)  # fmt: skip
def test_a_pattern_takes_the_cases_whose_title_part_system_library_or_method_is_so(
    path: str, patterns: list[str], count: int
) -> None:
    assert len(load(path, choice=chosen(patterns)).cases) == count


def test_a_label_is_run_where_the_suite_has_it_and_another_method_everywhere(path: str) -> None:
    assert fits(load(path, choice=chosen(None, ["dense"]))) == {("one", "dense"): 8}
    found = load(path, choice=chosen(None, ["dense,stlsq", "floor"]))
    assert fits(found) == {
        ("one", "dense"): 8, ("one", "stlsq"): 8, ("one", "floor"): 8, ("two", "stlsq"): 1, ("two", "floor"): 1
    }  # fmt: skip
    # What the suite has already is the same case, and its result is used again.
    assert {one.identity for one in load(path, choice=chosen(None, ["dense"])).cases} < set(load(path).by_identity)


def test_a_file_of_ones_own_is_found_from_the_working_folder(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    shutil.copy(RIDGE, tmp_path / "here" / "mine.py")
    monkeypatch.chdir(tmp_path / "here")
    suite = load(path, choice=chosen(["sines"], ["mine.py"]))
    assert {name: one.method for name, one in suite.contestants.items()} == {"mine": "here/mine.py"}
    packaged = load("tiny", choice=chosen(["phi4 | *"], ["mine.py"]))
    assert {name: one.method for name, one in packaged.contestants.items()} == {"mine": "mine.py"}
    for one in (suite, packaged):
        results, _ = run(one, create(tmp_path / one.name), jobs=1)
        assert [result["status"] for result in results] == ["ok"] * len(one.cases)
    with pytest.raises(InputError, match=r"gone\.py"):
        load("tiny", choice=chosen(None, ["gone.py"]))


def test_a_name_that_is_taken_is_that_of_the_file(path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("floor.py", "stlsq.py"):
        shutil.copy(RIDGE, tmp_path / name)
    assert list(load(path, choice=chosen(None, ["floor.py,stlsq.py"])).contestants) == ["floor.py", "stlsq.py"]


@pytest.mark.parametrize(("text", "seeds"), [("3-5", {3, 4, 5}), ("1, 3,7", {1, 3, 7}), ("2,4-5,2", {2, 4, 5})])
def test_seeds_stand_in_place_of_those_of_the_suite(path: str, text: str, seeds: set[int]) -> None:
    suite = load(path, choice=chosen(None, None, text))
    assert {getattr(case, "seed", None) for case in suite.cases} == seeds
    assert len(suite.cases) == (8 + 1) * len(seeds)


def test_trials_take_seeds_and_patterns_and_recordings_stay_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "t.toml").write_text(TRIALS)
    suite = load(str(tmp_path / "t.toml"), choice=chosen(["drive", "chain"], None, "4-6"))
    assert [case.title.rpartition("| ")[2] for case in suite.cases] == ["seed 4", "seed 5", "seed 6", "u[n]"]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ((["phi5*"],), r"there is no case of this choice: only phi5\*; there are 'one', 'two'"),
        ((None, ["denes"]), "--methods: unknown method 'denes'; did you mean 'dense'"),
        ((["two"], ["dense"]), "no case of this choice: only two; methods dense"),
        ((None, ["a,,b"]), "--methods: one of them is empty"),
        (([""],), "--only: one of them is empty"),
        ((None, None, "5-3"), "--seeds 5-3: write at most"),
        ((None, None, "1,x"), "--seeds 1,x"),
        ((None, None, ""), "--seeds"),
        ((None, None, [1, -1]), "--seeds"),
    ],
)
def test_what_cannot_be_chosen_is_one_line(path: str, given: tuple[Any, ...], told: str) -> None:
    with pytest.raises(InputError, match=told) as error:
        load(path, choice=chosen(*given))
    assert "\n" not in str(error.value)


def test_results_of_an_earlier_choice_are_told_of(
    path: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = create(tmp_path / "store")
    for only, others in (("one", 0), ("two", 16), ("*", 0)):
        run(load(path, choice=chosen([only])), store, jobs=1)
        assert store.others() == others
        kinds.show(store)
        assert ("which were run here before: 16" in capsys.readouterr().out) == (others == 16)


def test_a_setting_beside_the_method_is_told_where_it_belongs(tmp_path: Path) -> None:
    (tmp_path / "t.toml").write_text(SUITE.replace('method = "zero"', 'method = "stlsq"\nthreshold = 0.1'))
    with pytest.raises(InputError, match=r"methods\.floor\.threshold: .* settings = \{ threshold = \.\.\. \}"):
        load(str(tmp_path / "t.toml"))


def test_a_suite_of_the_diagnosis_has_no_methods_and_recordings_have_no_seeds(tmp_path: Path) -> None:
    (tmp_path / "t.toml").write_text(TRIALS)
    with pytest.raises(InputError, match="no methods to choose"):
        load(str(tmp_path / "t.toml"), choice=chosen(None, ["stlsq"]))
    (tmp_path / "t.toml").write_text(TRIALS[TRIALS.index("[[measured]]") :])
    with pytest.raises(InputError, match="measured recordings, which have none"):
        load(str(tmp_path / "t.toml"), choice=chosen(None, None, "1-5"))


def contents(folder: Path) -> list[dict[str, Any]]:
    """What a run says of each case, besides its times."""
    return [{name: result[name] for name in SCORES} for result in open_store(folder).results()]


def test_four_shards_in_one_folder_or_merged_from_four_are_one_run(here: None, path: str, tmp_path: Path) -> None:
    suite = load(path)
    run(suite, create(tmp_path / "whole"), jobs=1, about={"suite": "mine", "command": "whole"})
    for k in range(1, 5):
        about = {"suite": "mine", "command": f"latticebench run mine --shard {k}/4", "settings": {"floor": "zero"}}
        for place in ("shared", f"apart-{k}"):
            run(suite, create(tmp_path / place), jobs=1, shard=Shard(k, 4), about=about)
    assert merge([tmp_path / f"apart-{k}" for k in (3, 1, 2, 4)], tmp_path / "merged") == (17, 0)
    whole = contents(tmp_path / "whole")
    assert len(whole) == 17
    assert contents(tmp_path / "shared") == contents(tmp_path / "merged") == whole
    told = open_store(tmp_path / "merged").about()
    assert told["suite"] == "mine"
    assert all(f"--shard {k}/4" in told["command"] for k in range(1, 5))
    # And it goes on from there.
    _, tally = run(suite, create(tmp_path / "merged"), jobs=1)
    assert (tally.ran, tally.reused) == (0, 17)
    assert merge([tmp_path / "apart-1", tmp_path / "apart-3"], tmp_path / "half") == (9, 8)


def test_what_does_not_belong_together_is_not_merged(here: None, path: str, tmp_path: Path) -> None:
    shutil.copy(RIDGE, tmp_path / "ridge.py")
    choice = chosen(["phi4 *| lib1 |*"], [str(tmp_path / "ridge.py")], "1")
    for place, change in (("a", ""), ("b", "\n\nCHANGED = 1\n")):
        (tmp_path / "ridge.py").write_text(RIDGE.read_text() + change)
        run(load(path, choice=choice), create(tmp_path / place), jobs=1, about={"suite": "mine"})
    with pytest.raises(InputError, match="computed by different code"):
        merge([tmp_path / "a", tmp_path / "b"], tmp_path / "c")
    assert not (tmp_path / "c").exists()
    store = create(tmp_path / "other")
    store.plan({}, {"suite": "other"})
    with pytest.raises(InputError, match="different suites cannot be merged: mine and other"):
        merge([tmp_path / "a", tmp_path / "other"], tmp_path / "c")
    with pytest.raises(InputError, match="not empty"):
        merge([tmp_path / "a"], tmp_path / "b")


def test_an_estimate_is_what_the_same_cases_took_before(path: str, tmp_path: Path) -> None:
    suite = load(path)
    nothing = estimate(suite, suite.cases, tmp_path / "none")
    assert (nothing.cases, nothing.there, nothing.known, nothing.sources) == (17, 0, 0, ())
    store = create(tmp_path / "store")
    store.plan({one.identity: f"old {k}" for k, one in enumerate(suite.cases)}, {})
    made = {"commit": "abc", "date": "2026-01-01", "machine": "m", "versions": {}}
    for k, case in enumerate(suite.cases):
        assert isinstance(case, FitCase)
        if case.part == "one":
            status = "timeout" if case.label == "dense" and case.library == "lib2" else "ok"
            took = {"seconds": 10.0 * case.seed, "cpu_seconds": 5.0} if status == "ok" else {}
            store.put(f"old {k}", case, {**outcome(case, status), **took}, made)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.sqlite")}
    found = estimate(suite, suite.cases, tmp_path / "store").methods.set_index("method")
    # The code is another one: none of them is finished.
    assert list(found["there"]) == [0, 0]
    # Eight cases of 15 s, the median over two seeds; and for dense four of them, and four that took their limit.
    assert found.loc["floor", ["cases", "known", "seconds", "cpu_seconds"]].tolist() == [9, 8, 120.0, 40.0]
    assert found.loc["dense", "seconds"] == 60 + 4 * 120
    fresh = load(path, choice=chosen(["phi4*"], ["floor"], "7"))
    assert estimate(fresh, fresh.cases, tmp_path / "store").seconds(2) == 4 * 15 / 2
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.sqlite")} == before


def test_hours_of_work_are_told_and_need_a_confirmation(path: str, tmp_path: Path) -> None:
    suite, store, made = load(path), create(tmp_path / "store"), {"commit": "abc", "date": "", "machine": "m"}
    store.plan({one.identity: f"old {k}" for k, one in enumerate(suite.cases)}, {})
    took = 2 * 3600.0
    for k, case in enumerate(suite.cases):
        store.put(f"old {k}", case, {**outcome(case, "ok"), "seconds": took, "cpu_seconds": took}, made)
    count, options = len(suite.cases), (path, "--results", "store", "--jobs", 1)
    line = refused("run", *options, cwd=tmp_path)
    assert f"took before it takes {2 * count}.0 hours" in line
    assert "--yes" in line
    code, _, err = latticebench("run", *options, "--shard", f"1/{count}", cwd=tmp_path)
    assert (code, "about 2.0 hours" in err) == (0, True)
    code, _, err = latticebench("run", *options, "--yes", cwd=tmp_path)
    assert (code, "hours, by what" in err) == (0, True)
    # What is finished takes no time.
    code, _, err = latticebench("run", *options, cwd=tmp_path)
    assert (code, "hours, by what" in err) == (0, False)


@pytest.mark.parametrize("mode", ["delete", "wal"])
def test_a_store_that_another_run_is_making_has_nothing_to_estimate_from(path: str, tmp_path: Path, mode: str) -> None:
    (tmp_path / "store").mkdir()
    # A database begins as an empty file; then it has its journal, and its tables and mark in one moment.
    with closing(sqlite3.connect(tmp_path / "store" / "results.sqlite")) as connection:
        connection.execute(f"PRAGMA journal_mode = {mode}")
    suite = load(path)
    found = estimate(suite, suite.cases, tmp_path / "store")
    assert (found.there, found.known) == (0, 0)
    create(tmp_path / "store")
    assert estimate(suite, suite.cases, tmp_path / "store").cases == found.cases


def test_an_estimate_counts_what_is_finished_and_takes_published_times(here: None, tmp_path: Path) -> None:
    suite = load("tiny")
    run(load("tiny", choice=chosen(["phi4 | *"])), create(tmp_path / "tiny"), jobs=1)
    found = estimate(suite, suite.cases, tmp_path / "tiny")
    assert found.there == sum(case.title.startswith("phi4 |") for case in suite.cases)
    paper = load("paper", choice=chosen(["1a"], ["pinn"], "1"))
    published = estimate(paper, paper.cases, tmp_path / "none")
    assert (published.known, published.sources) == (1, ("results/paper",))
    assert published.seconds(1) > 1


def test_a_log_has_a_line_for_every_twentieth_of_the_cases(path: str) -> None:
    case = load(path).cases[0]
    text = io.StringIO()
    lines = Lines(Console(file=text, width=200), 240)
    lines.count(200)
    for k in range(200):
        lines.started(case)
        lines.finished(case, outcome(case, "failed" if k == 100 else "ok", "it broke"))
    said = text.getvalue().splitlines()
    assert said[0] == "200 of 240 cases to run, 40 are there"
    assert len(said) == 1 + PARTS + 1
    assert said[1].startswith("10 of 200 cases run (5 %), 0:00:0")
    assert said[1].endswith("remaining")
    assert f"failed: {case.title}: it broke" in said
    assert clock(3725.4) == "1:02:05"
