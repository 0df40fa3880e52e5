"""The store: whole results or none."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from latticebench.bench.case import blank
from latticebench.bench.store import RESULT, VERSION, create, open_store
from latticebench.bench.suite import Case
from latticebench.systems.errors import InputError


def result(**more: Any) -> dict[str, Any]:
    case = Case(system="phi4", library="lib1", label="a", method="a")
    return json.loads(json.dumps({**blank(case), "made": {}, **more}))


def test_what_is_put_comes_back_in_the_order_of_the_run(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    for key in ("abc", "aaa", "zzz"):
        store.put(key, result(e2=1e-17, note=key))
    assert store.has("abc")
    assert open_store(tmp_path / "store").get("abc") == result(e2=1e-17, note="abc")
    assert store.all() == []
    store.put_about({"keys": ["zzz", "missing", "abc"]})
    assert [one["note"] for one in create(tmp_path / "store").all()] == ["zzz", "abc"]


def test_the_version_changes_with_the_form_of_a_result() -> None:
    form = [*sorted(RESULT), *sorted(Case.model_fields)]
    digest = hashlib.sha256(" ".join(form).encode()).hexdigest()[:12]
    known = {1: "eafd71871312", 2: "5b97f7d82809"}
    assert known.get(VERSION) == digest, (
        f"the form of a result has changed: raise VERSION in bench/store.py, and note {digest} here"
    )


def test_a_result_of_another_form_is_refused(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    for broken in (
        {"x": 1},
        {**result(), "case": {"system": "phi4"}},
        {k: v for k, v in result().items() if k != "history"},
    ):
        store.put("abc", broken)
        with pytest.raises(InputError, match=r"abc\.json: not a result that this version writes"):
            store.get("abc")


def test_a_store_that_another_run_is_just_making_can_be_joined(tmp_path: Path) -> None:
    folder = tmp_path / "store"
    folder.mkdir()
    (folder / ".store-x1.json").write_text("")
    store = create(folder)
    store.put("abc", result())
    assert create(folder).get("abc") == result()


def test_terms_keep_the_order_of_their_library(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    found = {"u[n+1]": 1.0, "u[n-1]": 2.0, "abs(u[n])": 3.0}
    store.put("abc", result(coefficients=found))
    assert list(store.get("abc")["coefficients"]) == list(found)


def test_a_store_of_another_version_is_refused_with_the_remedy(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    (store.folder / "store.json").write_text('{"version": 99}')
    with pytest.raises(InputError, match=r"version 99.*reads version 2.*--results"):
        open_store(store.folder)
    with pytest.raises(InputError, match="version 99"):
        create(store.folder)


def test_a_folder_with_other_things_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="not a store of results and not empty"):
        create(tmp_path)
    with pytest.raises(InputError, match="a file, not a folder"):
        create(tmp_path / "thesis.tex")
    with pytest.raises(InputError, match="latticebench run"):
        open_store(tmp_path)


def test_a_damaged_result_is_named(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    store.path("abc").write_text('{"status": ')
    with pytest.raises(InputError, match=r"abc\.json: not JSON.*delete it"):
        store.get("abc")


def test_a_result_that_is_being_written_does_not_count(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    (store.folder / "cases" / ".abc-1x.json").write_text("{")
    assert store.paths() == []


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files as Linux does")
def test_a_full_disk_is_one_clear_line_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    store.put("old", {"status": "ok"})
    program = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from latticebench.bench.store import open_store; from latticebench.systems.errors import InputError\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
        f"store = open_store(Path({str(store.folder)!r}))\n"
        "try:\n    store.put('new', {'x': 'y' * 10000})\n"
        "except InputError as error:\n    print(error)\n"
    )
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert "new.json: cannot be written: File too large; nothing was changed; free some space" in out
    assert [path.name for path in (store.folder / "cases").iterdir()] == ["old.json"]
    assert json.loads(store.path("old").read_text()) == {"status": "ok"}
