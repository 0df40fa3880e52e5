"""The store: whole results or none, and one clear line for whatever is not a store."""

from __future__ import annotations

import hashlib
import os
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from latticebench.bench.fitting import FitCase
from latticebench.bench.store import FILE, VERSION, Shard, create, is_store, open_store
from latticebench.bench.trials.measured import Measured
from latticebench.bench.trials.trial import Trial
from latticebench.bench.worker import outcome
from latticebench.systems.errors import InputError

MADE = {"commit": "abc", "date": "2026-01-01", "machine": "m", "versions": {"numpy": "2"}}
CASE = FitCase(system="phi4", library="lib1", label="a", method="a")
CASES = {
    "fit": CASE,
    "trial": Trial(system="phi4", effect="damping"),
    "measured": Measured(name="x", file="x.csv", terms="u[n]", order=2),
}


def result(**more: Any) -> dict[str, Any]:
    return {**outcome(CASE, "ok"), **more}


def test_what_is_put_comes_back_in_the_order_of_the_run(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    for seed, key in enumerate(("abc", "aaa", "zzz")):
        store.put(key, CASE.model_copy(update={"seed": seed}), result(e2=1e-17, note=key), MADE)
    assert list(store.results()) == []
    store.plan({"third": "zzz", "fourth": "missing", "first": "abc"}, {"command": "latticebench run x"})
    again = open_store(tmp_path / "store")
    assert [one["note"] for one in again.results()] == ["zzz", "abc"]
    assert again.about() == {"command": "latticebench run x"}
    assert (again.kinds(), again.origins(), again.seeds(), again.statuses()) == (["fit"], [MADE], [0, 2], {"ok": 2})
    assert set(again.finished("abc")) == {"abc"}
    (first, _) = again.results()
    case = CASE.model_copy(update={"seed": 2})
    assert first == {
        **result(e2=1e-17, note="zzz"), "case": case.model_dump(mode="json"), "identity": case.identity, "made": MADE
    }  # fmt: skip


def test_results_of_a_shard_are_those_of_every_nth_case_beginning_at_its_place(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    keys = {f"identity {k}": f"key {k}" for k in range(7)}
    store.plan(keys, {})
    for key in keys.values():
        store.put(key, CASE, result(note=key), MADE)
    assert [one["note"] for one in store.results(Shard(2, 3))] == ["key 1", "key 4"]
    assert len(store.results(Shard(1, 3))) == 3
    assert store.statuses(Shard(3, 3)) == {"ok": 2}
    for first, step in ((0, 3), (4, 3), (1, 0)):
        with pytest.raises(InputError, match="K from 1 to N"):
            Shard(first, step)


def test_histories_are_read_only_where_they_are_asked_for(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    store.plan({"one": "abc"}, {})
    store.put("abc", CASE, result(history={"step": [1.0]}), MADE)
    assert [one["history"] for one in store.results()] == [None]
    assert [one["history"] for one in store.results(history=True)] == [{"step": [1.0]}]


def test_what_an_older_source_made_is_forgotten_once_it_is_made_anew_and_nothing_else(tmp_path: Path) -> None:
    def keys() -> list[str]:
        return [key for (key,) in store.read("SELECT key FROM results ORDER BY key")]

    store = create(tmp_path / "store")
    other, third = (CASE.model_copy(update={"seed": seed}) for seed in (2, 3))
    for key, case in (("old", CASE), ("kept", other), ("old, too", third)):
        store.put(key, case, result(), MADE)
    store.plan({CASE.identity: "new", other.identity: "kept", third.identity: "never made"}, {})
    store.forget_replaced()
    assert keys() == ["kept", "old", "old, too"]
    assert set(store.finished()) == {"kept"}
    store.put("new", CASE, result(), MADE)
    store.forget_replaced()
    assert keys() == ["kept", "new", "old, too"]


def test_a_run_goes_by_its_own_plan_whatever_another_one_plans_on_the_same_store(tmp_path: Path) -> None:
    mine, theirs = create(tmp_path / "store"), create(tmp_path / "store")
    mine.plan({"a": "key a"}, {})
    theirs.plan({"b": "key b"}, {})
    mine.put("key a", CASE, result(note="a"), MADE)
    theirs.put("key b", CASE, result(note="b"), MADE)
    assert [one["note"] for one in mine.results()] == ["a"]
    assert [one["note"] for one in open_store(tmp_path / "store").results()] == ["b"]


def test_the_version_changes_with_the_form_of_a_result() -> None:
    form = [
        name for kind, case in CASES.items() for name in (kind, *sorted(case.blank()), *sorted(type(case).model_fields))
    ]
    digest = hashlib.sha256(" ".join(form).encode()).hexdigest()[:12]
    known = {5: "386e8cc5bdb4"}
    assert known.get(VERSION) == digest, (
        f"the form of a result has changed: raise VERSION in bench/store.py, and note {digest} here"
    )


@pytest.mark.parametrize("broken", [{"x": 1}, {"status": "fine"}, {"e2": None}], ids=["more", "status", "less"])
def test_what_is_no_result_of_the_case_is_never_written(tmp_path: Path, broken: dict[str, Any]) -> None:
    store = create(tmp_path / "store")
    store.plan({CASE.identity: "abc"}, {})
    wrong = {**result(), **broken}
    if "e2" in broken:
        del wrong["e2"]
    with pytest.raises(ValueError, match="not a result of phi4"):
        store.put("abc", CASE, wrong, MADE)
    with pytest.raises(ValueError, match="JSON compliant"):
        store.put("abc", CASE, result(e2=float("nan")), MADE)
    assert not store.finished()


def test_terms_keep_the_order_of_their_library(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    found = {"u[n+1]": 1.0, "u[n-1]": 2.0, "abs(u[n])": 3.0}
    store.plan({"one": "abc"}, {})
    store.put("abc", CASE, result(coefficients=found), MADE)
    assert [list(one["coefficients"]) for one in store.results()] == [list(found)]


def filled(folder: Path) -> Path:
    """Make a store with results that fill many pages, and return its file."""
    store = create(folder)
    store.plan({f"identity {k}": f"key {k}" for k in range(50)}, {})
    for k in range(50):
        store.put(f"key {k}", CASE, result(note="x" * 1000), MADE)
    store.connection.close()
    return folder / FILE


def changed(path: Path, statement: str) -> None:
    connection = sqlite3.connect(path)
    connection.execute(statement)
    connection.commit()
    connection.close()


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "text": (lambda path: path.write_text("thesis" * 1000), "file is not a database"),
    "empty": (lambda path: path.write_bytes(b""), "not a store of results"),
    "truncated": (lambda path: os.truncate(path, 20_000), "malformed"),
    "torn": (lambda path: path.write_bytes(path.read_bytes()[:40_000] + os.urandom(40_000)), "not a store of results"),
    "foreign": (lambda path: (path.unlink(), changed(path, "CREATE TABLE thesis (x)")), "not a store of results"),
    "old": (lambda path: changed(path, "PRAGMA user_version = 99"), "version 99.*reads version 5.*--results"),
    "emptied": (lambda path: changed(path, "DROP TABLE suite"), "tables are missing"),
    "broken row": (lambda path: changed(path, "UPDATE results SET content = '{'"), "the result key 0 is not one"),
    "no origin": (lambda path: changed(path, "UPDATE results SET origin = 77"), "the result key 0 is not one"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_or_foreign_store_is_one_clear_line(tmp_path: Path, damage: str) -> None:
    path = filled(tmp_path / "store")
    harm, told = DAMAGES[damage]
    harm(path)
    with pytest.raises(InputError, match=told) as error:
        list(open_store(tmp_path / "store").results())
    assert FILE in str(error.value) or "version" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_store_of_json_files_as_there_were_is_refused_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "store.json").write_text('{"version": 2}')
    assert is_store(tmp_path)
    for opened in (open_store, create):
        with pytest.raises(InputError, match=r"version 2 or older.*reads version 5.*--results"):
            opened(tmp_path)


def test_a_folder_with_other_things_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="not a store of results and not empty"):
        create(tmp_path)
    with pytest.raises(InputError, match="a file, not a folder"):
        create(tmp_path / "thesis.tex")
    with pytest.raises(InputError, match="latticebench run"):
        open_store(tmp_path)
    (tmp_path / "folder" / FILE).mkdir(parents=True)
    with pytest.raises(InputError, match=FILE):
        create(tmp_path / "folder")
    with pytest.raises(InputError, match=FILE):
        open_store(tmp_path / "folder")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "thesis.tex"]


@pytest.mark.skipif(sys.platform != "linux", reason="needs a place that nobody can write")
def test_a_place_that_cannot_be_written_is_one_clear_line() -> None:
    with pytest.raises(InputError, match="--results"):
        create(Path("/proc/latticebench"))


def test_a_store_in_a_place_that_cannot_be_written_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    filled(tmp_path / "store")
    connect = sqlite3.connect

    def no_writing(place: str, **options: Any) -> sqlite3.Connection:
        if "mode=rw" in place:
            raise sqlite3.OperationalError("unable to open database file")
        return connect(place, **options)

    monkeypatch.setattr(sqlite3, "connect", no_writing)
    assert len(list(open_store(tmp_path / "store").results())) == 50


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files as Linux does")
def test_a_full_disk_is_one_clear_line_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    path = filled(tmp_path / "store")
    program = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from latticebench.bench.store import create; from latticebench.systems.errors import InputError\n"
        "from latticebench.bench.fitting import FitCase; from latticebench.bench.worker import outcome\n"
        "case = FitCase(system='phi4', library='lib1', label='a', method='a')\n"
        f"store = create(Path({str(path.parent)!r}))\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try:\n    store.put('new', case, {**outcome(case, 'ok'), 'note': 'y' * 1_000_000}, {})\n"
        "except InputError as error:\n    print(error)\n"
    )
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert "results.sqlite: cannot be written" in out
    assert "nothing that was there is lost" in out
    store = open_store(tmp_path / "store")
    assert len(list(store.results())) == 50
    assert next(store.read("SELECT COUNT(*) FROM results")) == (50,)


def test_runs_that_make_a_store_at_the_same_moment_all_have_it(tmp_path: Path) -> None:
    with ThreadPoolExecutor(4) as pool:
        for number in range(50):
            stores = list(pool.map(create, [tmp_path / str(number)] * 4))
            assert {one.path for one in stores} == {tmp_path / str(number) / FILE}
