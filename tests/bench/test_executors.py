"""What executors are made of: batches, parcels of users' files, cluster files; and what is refused before any case."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from commandline import refused, succeed
from latticebench.bench.case import Folders
from latticebench.bench.executors.batches import LONGEST, LOSSES, SHARE, Batches
from latticebench.bench.executors.cluster import is_open, place_of, read_jobs
from latticebench.bench.executors.parcel import Shelf, contents, moved, named_as_sent, pack
from latticebench.bench.fitting import FitCase
from latticebench.bench.leases import Leases
from latticebench.bench.presence import Presence, running
from latticebench.bench.source import fingerprint
from latticebench.bench.store import create
from latticebench.systems.errors import InputError


def case(seed: int = 1, label: str = "a", method: str = "zero", system: str = "phi4") -> FitCase:
    return FitCase(system=system, sites=5, samples=8, span=1.0, library="lib1", label=label, method=method, seed=seed)


def seeds(cases: list[FitCase]) -> list[int]:
    return [one.seed for one in cases]


def test_a_batch_is_as_long_as_makes_its_messages_two_per_cent_of_it() -> None:
    batches = Batches.of([case(seed) for seed in range(6000)], {})
    assert len(batches.take(2, lambda _: "run")) == 1, "nothing is known of such cases yet"
    for seconds, overhead, size in (
        (0.01, 0.01, 50),
        (0.001, 0.02, 1000),
        (0.5, 0.004, 1),
        (0.01, 9.0, LONGEST / 0.01),
    ):
        for seed in range(50):
            batches.done(case(seed), seconds)
            batches.turned(overhead)
        assert len(batches.take(2, lambda _: "run")) == pytest.approx(size, abs=2)
        assert batches.budget == pytest.approx(min(overhead / SHARE, LONGEST), rel=0.01)


def test_a_case_of_unknown_length_keeps_no_other_waiting() -> None:
    batches = Batches.of([case(1), case(2), case(3, label="b"), case(4), case(5)], {})
    batches.overhead = 1.0
    batches.done(case(), 0.001)
    assert [seeds(batches.take(1, lambda _: "run")) for _ in range(4)] == [[1, 2], [3], [4], [5]]  # type: ignore[arg-type]


def test_batches_shrink_at_the_end_and_every_case_is_in_one() -> None:
    batches = Batches.of([case(seed) for seed in range(1000)], {})
    batches.done(case(), 0.001)
    batches.overhead = 1.0
    sizes = []
    taken: list[int] = []
    while batch := batches.take(2, lambda _: "run"):
        sizes.append(len(batch))
        taken += seeds(batch)  # type: ignore[arg-type]
    assert sorted(taken) == list(range(1000))
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] == 1
    # Whatever is handed out, the other worker still finds as much.
    assert all(size <= -(-sum(sizes[number:]) // 4) for number, size in enumerate(sizes))


def test_cases_that_took_long_before_begin_first_and_code_of_users_last() -> None:
    cases = [case(1), case(2), case(3, method="mine.py"), case(4), case(5)]
    took = {cases[0].identity: 1.0, cases[1].identity: 9.0, cases[2].identity: 99.0, cases[4].identity: 2.0}
    batches = Batches.of(cases, took)
    order = [seeds(batches.take(1, lambda _: "run"))[0] for _ in range(5)]  # type: ignore[arg-type]
    assert order == [2, 4, 5, 1, 3]


def test_a_case_that_was_lost_goes_alone_and_is_given_up_in_the_end() -> None:
    batches = Batches.of([case(seed) for seed in range(40)], {})
    batches.done(case(), 0.001)
    batch = batches.take(1, lambda _: "run")
    assert len(batch) > 1
    for _ in range(LOSSES - 1):
        assert batches.lost(batch[:1]) == []
        taken = [[]]
        while batch[0] not in taken[-1]:
            taken.append(batches.take(1, lambda _: "run"))  # type: ignore[arg-type]
        assert taken[-1] == batch[:1]
    assert batches.lost(batch[:1]) == batch[:1]


def test_a_case_that_another_run_has_waits_and_one_that_it_has_done_is_closed() -> None:
    batches = Batches.of([case(1), case(2)], {})
    assert batches.take(1, lambda one: "later" if one == case(1) else "done") == []
    assert (batches.open, batches.waiting) == (1, True)


def test_users_files_lie_at_a_worker_as_they_lay_and_paths_lead_where_they_led(tmp_path: Path) -> None:
    suite, away = tmp_path / "suite", tmp_path / "away"
    for place in (suite, away):
        place.mkdir()
    (suite / "mine.py").write_text("a = 1\n")
    (away / "mine.py").write_text("a = 2\n")
    folders = Folders(suite, tmp_path)
    cases = [case(method="mine.py"), case(method="../away/mine.py:A"), case(method=str(away / "mine.py"))]
    parcel, paths = pack(cases, folders)
    assert len(parcel.hashes) == 2
    shelf = Shelf(tmp_path / "worker")
    shelf.root.mkdir()
    assert shelf.lacking(parcel) == parcel.hashes
    shelf.receive(contents(shelf.lacking(parcel), paths))
    assert shelf.lacking(parcel) == set()
    laid, there = shelf.lay_out(parcel)
    assert (there.methods / "mine.py").read_text() == "a = 1\n"
    for one in cases:
        sent = moved(one, laid)
        assert fingerprint(sent.roots, there) == fingerprint(one.roots, folders)
    told = {"reason": f"{there.methods / 'mine.py'}: no METHODS"}
    assert named_as_sent(told, laid) == {"reason": f"{suite / 'mine.py'}: no METHODS"}
    # Another content is another parcel, and nothing of the first stands in its way.
    (suite / "mine.py").write_text("a = 3\n")
    with pytest.raises(InputError, match=r"mine\.py: it has changed"):
        contents(parcel.hashes, paths)
    assert pack(cases, folders)[0].name != parcel.name
    with pytest.raises(ValueError, match="damaged"):
        shelf.receive({next(iter(parcel.hashes)): b"other"})


CLUSTER = 'system = "slurm"\njobs = 3\ncores = 2\nmemory = "4GiB"\nwalltime = "01:00:00"\nmargin = 60\n'


def test_a_cluster_file_is_checked_key_by_key(tmp_path: Path) -> None:
    path = tmp_path / "cluster.toml"
    path.write_text(CLUSTER)
    assert read_jobs(path).lifetime == 3540
    assert place_of(None, str(path)).workers == 6
    for change, told in {
        ('"slurm"', '"cron"'): "system", ("jobs = 3", "jobs = 0"): "jobs", ('"4GiB"', '"much"'): "memory",
        ('"01:00:00"', '"an hour"'): "write hours:minutes:seconds", ("margin = 60", "margin = 7200"): "leaves nothing",
        ("jobs", "jops"): "jops",
    }.items():  # fmt: skip
        path.write_text(CLUSTER.replace(*change))
        with pytest.raises(InputError, match=told) as error:
            read_jobs(path)
        assert str(path) in str(error.value)


def test_a_scheduler_that_others_may_reach_without_tls_is_known() -> None:
    assert is_open("tcp://192.0.2.1:8786")
    assert not is_open("tls://192.0.2.1:8786")
    assert not is_open("tcp://127.0.0.1:8786")
    assert not is_open("tcp://localhost:8786")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--executor", "dask"], "give one of --scheduler"),
        (["--executor", "dask", "--cluster", "local:0"], "local:N"),
        (["--executor", "dask", "--cluster", "local:2", "--scheduler", "tcp://a:1"], "give one of"),
        (["--executor", "dask", "--scheduler", "somewhere"], "write an address"),
        (["--executor", "dask", "--cluster", "local:2", "--jobs", "2"], "--jobs"),
        (["--executor", "dask", "--cluster", "nowhere.toml"], "nowhere.toml"),
        (["--scheduler", "tcp://a:1"], "goes with --executor dask"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options: list[str], told: str, tmp_path: Path) -> None:
    assert told in refused("run", "tiny", "--dry-run", *options, cwd=tmp_path)


def test_without_dask_its_executor_is_refused_with_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "distributed" else found(name))
    line = refused("run", "tiny", "--executor", "dask", "--cluster", "local:1", cwd=tmp_path)
    assert "pip install 'latticebench[cluster]'" in line


def test_the_local_runner_loads_nothing_of_dask() -> None:
    program = (
        "import sys\nfrom latticebench.bench import run\n"
        "from latticebench.bench.cli import run\n"
        "from latticebench.bench.executors import cluster, local\n"
        "assert not {'dask', 'distributed', 'tornado'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_status_says_what_is_done_what_runs_where_and_what_went_wrong(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    one, two = case(1), case(2)
    store.plan({one.identity: "k1", two.identity: "k2", case(3).identity: "k3"}, {})
    made = {"versions": {}}
    presence = Presence(store, Leases(store).owner, left=3)
    presence.began -= 60
    for each in (one, two):
        presence.started(each, "tcp://node7:1234")
    store.put("k1", one, {"status": "failed", "reason": "no\nluck", **one.blank()}, made)
    presence.finished(one, {"status": "failed", "reason": "no luck"})
    presence.tell()
    (run,) = running(store)
    assert (run.left, run.done) == (3, 1)
    assert run.remaining == pytest.approx(2 * run.seconds)
    out = succeed("status", "store", cwd=tmp_path)
    assert "1 of 3 cases are done (1 failed)" in out
    assert f"{two.title} | on tcp://node7:1234 for 0:00:0" in out
    assert f"failed: {one.title}: no luck" in out
    assert re.search(r"1 of 3, (1|0\.\d+) a minute, about 0:0\d:\d\d left", out)
    assert out.count("tcp://node7") == 1
    presence.leave()
    out = succeed("status", "store", cwd=tmp_path)
    assert "no run is on it now; the command that began it continues it" in out
    assert "not a store of results" in refused("status", "nowhere", cwd=tmp_path)
