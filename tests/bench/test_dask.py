"""Runs on the workers of a Dask scheduler: the same rows, and nothing finished is lost or stands twice."""

from __future__ import annotations

import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import psutil
import pytest

import latticebench
from latticebench.bench import kinds
from latticebench.bench.executors import crew
from latticebench.bench.executors.cluster import Connection, Place
from latticebench.bench.executors.dask import Dask
from latticebench.bench.run import run
from latticebench.bench.store import Store, create
from latticebench.bench.suite import Suite, load
from latticebench.systems.errors import InputError

HERE = Path(__file__).parent
posix = pytest.mark.skipif(os.name != "posix", reason="sends POSIX signals")
# Seconds after which something that should have happened is taken to have failed: far beyond what a busy machine needs.
PATIENCE = 300.0
# Columns that differ from run to run.
TIMES = ("seconds", "cpu_seconds", "peak_mib")

SUITE = """
title = "hostile"
timing = true
{methods}
[[grid]]
system = "phi4"
sites = 5
samples = 8
span = 1.0
libraries = ["lib1"]
noise = {noise}
seeds = {seeds}
time_limit = 3600
"""


def written(folder: Path, methods: dict[str, str], *, noise: str = "0.0", seeds: str = "[1]") -> Path:
    """Write a suite with one entry per method, its label and its settings; names are of this package."""
    folder.mkdir(exist_ok=True)
    shutil.copy(HERE / "hostile.py", folder / "hostile.py")
    entries = [
        f'[methods."{label}"]\n' + (f'method = "hostile.py"\nsettings = {{ {text} }}\n' if "=" in text or not text
                                    else f'method = "{text}"\n')
        for label, text in methods.items()
    ]  # fmt: skip
    (folder / "hostile.toml").write_text(SUITE.format(methods="\n".join(entries), noise=noise, seeds=seeds))
    return folder / "hostile.toml"


def suite_of(folder: Path, methods: dict[str, str], **options: str) -> Suite:
    return load(str(written(folder, methods, **options)))


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


def table(store: Store) -> pd.DataFrame:
    """Return every column of the table of cases but times."""
    rows = kinds.rows(store)
    return pd.DataFrame(rows).drop(columns=list(TIMES), errors="ignore")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Connection]:
    """One worker, which is replaced when it is killed."""
    with Place(local=1).connected() as connection:
        yield connection


def test_both_executors_make_the_same_rows_but_for_times_and_machines(cluster: Connection, tmp_path: Path) -> None:
    methods = {"lines": "least-squares", "good": "", "failing": 'deed = "fail"', "empty": 'deed = "nan"'}
    suite = suite_of(tmp_path / "s", methods, noise="[0.0, 0.01]", seeds="[1, 2]")
    here, there = create(tmp_path / "here"), create(tmp_path / "there")
    run(suite, here, jobs=1)
    _, tally = run(suite, there, executor=Dask(cluster, alike=suite.timing))
    assert (tally.ran, tally.statuses) == (16, {"failed": 8, "ok": 8})
    pd.testing.assert_frame_equal(table(here), table(there))
    assert "the matrix is on holiday" in str(table(there)["reason"].tolist())
    (made,) = there.origins()
    assert made == here.origins()[0]
    # What is there is not run again, by whichever executor.
    assert run(suite, there, jobs=1)[1].ran == run(suite, here, executor=Dask(cluster))[1].ran == 0
    # A user's file that has changed is another, also at a worker that has the first.
    source = tmp_path / "s" / "hostile.py"
    source.write_text(source.read_text().replace("0.5)", "0.25)"))
    suite = suite_of_file = load(str(tmp_path / "s" / "hostile.toml"))
    results, tally = run(suite_of_file, there, executor=Dask(cluster))
    assert tally.ran == 12
    assert {one["residual"] for one in results if one["case"]["label"] == "good"} == {0.25}


@posix
def test_the_cases_of_a_worker_that_is_killed_are_run_by_the_next(cluster: Connection, tmp_path: Path) -> None:
    diary, gate = tmp_path / "diary", tmp_path / "gate"
    suite = suite_of(tmp_path / "s", {"held": f'diary = "{diary}", gate = "{gate}"'}, seeds="[1, 2, 3]")
    killed: list[psutil.Process] = []

    def kill() -> None:
        wait_for(lambda: len(lines(diary)) == 1)
        case = psutil.Process(int(lines(diary)[0].split()[2]))
        killed.extend([case.parent() or case, case])
        killed[0].kill()
        wait_for(lambda: not case.is_running() or case.status() == psutil.STATUS_ZOMBIE)
        gate.touch()

    killer = threading.Thread(target=kill)
    killer.start()
    results, tally = run(suite, create(tmp_path / "store"), executor=Dask(cluster))
    killer.join()
    assert (tally.ran, tally.statuses) == (3, {"ok": 3})
    assert len(list(results)) == 3
    # The case that was under way is the only one that began twice.
    assert len(lines(diary)) == 4
    assert len({line.split()[1] for line in lines(diary)}) == 3


def test_a_worker_of_another_version_is_refused_by_both_names(
    cluster: Connection, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    suite = suite_of(tmp_path / "s", {"lines": "least-squares"})
    store = create(tmp_path / "store")
    ours = latticebench.__version__
    with monkeypatch.context() as patch:
        patch.setattr(latticebench, "__version__", "9.9.9", raising=False)
        with pytest.raises(InputError, match=rf"it has latticebench {ours}, and this is latticebench 9\.9\.9"):
            run(suite, store, executor=Dask(cluster))
    monkeypatch.setattr(crew, "PYTHON", "3.4.1")
    running = ".".join(map(str, sys.version_info[:3]))
    with pytest.raises(InputError, match=rf"it runs Python {running}, and this is Python 3\.4\.1"):
        run(suite, store, executor=Dask(cluster))
    assert store.statuses() == {}


def test_a_scheduler_that_is_not_there_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["latticebench"])
    suite = suite_of(tmp_path / "s", {"lines": "least-squares"})
    with pytest.raises(InputError, match="no scheduler answers there"):
        run(suite, create(tmp_path / "store"), executor=Dask(Connection("tcp://127.0.0.1:1"), patience=1.0))
