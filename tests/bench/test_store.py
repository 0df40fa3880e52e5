"""The store: whole results or none."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from bench.store import create, open_store
from systems.errors import InputError


def test_what_is_put_comes_back(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    store.put("abc", {"status": "ok", "e2": 1e-17})
    assert store.has("abc")
    assert open_store(tmp_path / "store").get("abc") == {"status": "ok", "e2": 1e-17}
    assert create(tmp_path / "store").all() == [{"status": "ok", "e2": 1e-17}]


def test_terms_keep_the_order_of_their_library(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    found = {"u[n+1]": 1.0, "u[n-1]": 2.0, "abs(u[n])": 3.0}
    store.put("abc", {"coefficients": found})
    assert list(store.get("abc")["coefficients"]) == list(found)


def test_a_store_of_another_version_is_refused_with_the_remedy(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    (store.folder / "store.json").write_text('{"version": 99}')
    with pytest.raises(InputError, match=r"version 99.*reads version 1.*--results"):
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
        store.all()


def test_a_result_that_is_being_written_does_not_count(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    (store.folder / "cases" / ".abc-1x.json").write_text("{")
    assert store.all() == []


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files as Linux does")
def test_a_full_disk_is_one_clear_line_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    store.put("old", {"status": "ok"})
    program = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from bench.store import open_store; from systems.errors import InputError\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
        f"store = open_store(Path({str(store.folder)!r}))\n"
        "try:\n    store.put('new', {'x': 'y' * 10000})\n"
        "except InputError as error:\n    print(error)\n"
    )
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert "new.json: cannot be written: File too large; nothing was changed" in out
    assert [path.name for path in (store.folder / "cases").iterdir()] == ["old.json"]
    assert json.loads(store.path("old").read_text()) == {"status": "ok"}
