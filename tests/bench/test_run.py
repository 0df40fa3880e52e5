"""The runner: nothing finished is lost or run twice, and no case harms another, whatever happens."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest

from latticebench import systems
from latticebench.bench.case import Folders
from latticebench.bench.fitting import FitCase
from latticebench.bench.leases import Leases
from latticebench.bench.limit import bound_of
from latticebench.bench.run import Tally, run
from latticebench.bench.store import FILE, Store, create, open_store
from latticebench.bench.suite import Suite, load
from latticebench.bench.worker import attempt
from latticebench.systems.errors import InputError
from latticebench.systems.simulate import sample_times, simulate

HERE = Path(__file__).parent
posix = pytest.mark.skipif(os.name != "posix", reason="sends POSIX signals")
# Seconds after which something that should have happened is taken to have failed: far beyond what a busy machine needs.
PATIENCE = 300.0
LONG = "time_limit = 3600"


def hostile_suite(
    folder: Path, methods: dict[str, str], *, seeds: str = "[1]", limits: dict[str, str] | None = None
) -> Suite:
    """Write a suite with one entry per method, its label and its settings; by default nothing runs into a limit."""
    folder.mkdir(exist_ok=True)
    shutil.copy(HERE / "hostile.py", folder / "hostile.py")
    text = 'title = "hostile"\n'
    for label, settings in methods.items():
        text += f'[methods."{label}"]\nmethod = "hostile.py"\nsettings = {{ {settings} }}\n'
    for label in methods:
        text += f'[[grid]]\nmethods = ["{label}"]\nsystem = "phi4"\nsites = 5\nsamples = 8\nspan = 1.0\n'
        text += f'libraries = ["lib1"]\nseeds = {seeds}\n{(limits or {}).get(label, LONG)}\n'
    (folder / "hostile.toml").write_text(text)
    return load(str(folder / "hostile.toml"))


def finished(suite: Suite, store: Store, **options: Any) -> tuple[list[dict[str, Any]], Tally]:
    """Run a suite, and return its results as a list."""
    results, tally = run(suite, store, **options)
    return list(results), tally


def count(folder: Path) -> int:
    """Count the results in a store, of whatever suite."""
    if not (folder / FILE).is_file():
        return 0
    try:
        return int(next(open_store(folder).read("SELECT COUNT(*) FROM results"))[0])
    except InputError:
        # It is being made.
        return 0


def diary_lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


def test_a_case_that_fails_hangs_dies_or_eats_memory_is_a_row_and_harms_no_other(tmp_path: Path) -> None:
    suite = hostile_suite(
        tmp_path,
        {
            "good": 'deed = "behave"', "failing": 'deed = "fail"', "eating": 'deed = "eat"',
            "hanging": 'deed = "hang in C"', "dying": 'deed = "die"', "empty": 'deed = "nan"', "slow": "seconds = 0.5",
            "imaginary": 'deed = "complex"', "odd": 'deed = "object"', "good too": "seconds = 0.01",
        },
        limits={"hanging": "time_limit = 2", "eating": f"{LONG}\nmemory_limit = 1500"},
    )  # fmt: skip
    results, tally = finished(suite, create(tmp_path / "store"), jobs=2)
    found = {r["case"]["label"]: r for r in results}
    assert len(found) == tally.ran == 10
    assert found["good"]["status"] == found["slow"]["status"] == found["good too"]["status"] == "ok"
    assert found["failing"]["status"] == "failed"
    assert "the matrix is on holiday" in found["failing"]["reason"]
    assert found["eating"]["status"] == "memory"
    assert "1500 MiB" in found["eating"]["reason"]
    assert found["hanging"]["status"] == "timeout"
    assert "2 s" in found["hanging"]["reason"]
    assert found["dying"]["status"] == "died"
    assert found["empty"]["status"] == "failed"
    assert "not finite" in found["empty"]["reason"]
    assert found["imaginary"]["status"] == found["odd"]["status"] == "failed"
    assert "real" in found["imaginary"]["reason"]
    assert "status must be a text" in found["odd"]["reason"]


def test_finished_cases_are_not_run_again_and_failures_only_when_asked(tmp_path: Path) -> None:
    diary = tmp_path / "diary"
    methods = {"good": f'diary = "{diary}"', "failing": f'deed = "fail", diary = "{diary}"'}
    suite = hostile_suite(tmp_path / "suite", methods)
    store = create(tmp_path / "store")
    first, _ = run(suite, store, jobs=1)
    again, tally = run(suite, store, jobs=1)
    assert list(again) == list(first) == list(store.results())
    assert (tally.ran, tally.reused) == (0, 2)
    assert len(diary_lines(diary)) == 2
    _, tally = run(suite, store, jobs=1, retry=True)
    assert (tally.ran, tally.reused) == (1, 1)
    assert [line.split()[0] for line in diary_lines(diary)].count("fail") == 2


def test_a_raised_time_limit_runs_a_timed_out_case_again(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    held = {"held": f'gate = "{gate}"'}
    store = create(tmp_path / "store")
    results, _ = finished(hostile_suite(tmp_path / "s", held, limits={"held": "time_limit = 0.5"}), store, jobs=1)
    assert results[0]["status"] == "timeout"
    gate.touch()
    results, _ = finished(hostile_suite(tmp_path / "s", held), store, jobs=1)
    assert results[0]["status"] == "ok"


def test_a_changed_method_is_run_again_and_its_old_result_leaves_the_store(tmp_path: Path) -> None:
    suite = hostile_suite(tmp_path / "s", {"good": 'deed = "behave"'})
    store = create(tmp_path / "store")
    run(suite, store, jobs=1)
    source = tmp_path / "s" / "hostile.py"
    source.write_text(source.read_text().replace("0.5)", "0.25)"))
    results, tally = finished(load(str(tmp_path / "s" / "hostile.toml")), store, jobs=1)
    assert tally.ran == 1
    assert results[0]["residual"] == 0.25
    assert count(tmp_path / "store") == 1


def test_the_number_of_jobs_changes_no_digit(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(
        '[methods.lines]\nmethod = "least-squares"\n[methods.weak]\nmethod = "weak"\n[[grid]]\nsystem = "phi4"\n'
        'sites = 9\nsamples = 60\nlibraries = ["lib1"]\nnoise = [0.0, 0.01]\n'
    )
    suite = load(str(tmp_path / "small.toml"))
    one, _ = finished(suite, create(tmp_path / "one"), jobs=1)
    two, _ = finished(suite, create(tmp_path / "two"), jobs=2)
    assert [result["status"] for result in one] == ["ok"] * 4
    for a, b in zip(one, two, strict=True):
        assert a["coefficients"] == b["coefficients"]
        assert a["e2"] == b["e2"]


StartRun = Callable[..., "subprocess.Popen[bytes]"]


def end_group(leader: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(leader, signal.SIGKILL)


@pytest.fixture
def start_run() -> Iterator[StartRun]:
    """Start `latticebench run` in processes that are all ended with the test, whatever happens in it."""
    with ExitStack() as ends:

        def start(suite: Path, store: Path, jobs: int = 1) -> subprocess.Popen[bytes]:
            # A shell that starts tests in the background makes their children deaf to Ctrl-C.
            program = (
                "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
                "from latticebench.bench.cli import main; main()"
            )
            options = ["run", str(suite), "--results", str(store), "--jobs", str(jobs)]
            command = [sys.executable, "-c", program, *options]
            runner = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)
            ends.enter_context(runner)
            ends.callback(end_group if os.name == "posix" else lambda _: runner.kill(), runner.pid)
            return runner

        yield start


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def gone(workers: list[psutil.Process]) -> bool:
    return not any(worker.is_running() and worker.status() != psutil.STATUS_ZOMBIE for worker in workers)


@posix
def test_after_kill_9_of_the_runner_nothing_finished_is_run_again_and_no_worker_stays(
    start_run: StartRun, tmp_path: Path
) -> None:
    diary, gate, store = tmp_path / "diary", tmp_path / "gate", tmp_path / "store"
    methods = {"quick": f'diary = "{diary}"', "held": f'deed = "held", diary = "{diary}", gate = "{gate}"'}
    hostile_suite(tmp_path / "s", methods, seeds="[1, 2, 3]")
    runner = start_run(tmp_path / "s" / "hostile.toml", store, jobs=2)
    wait_for(lambda: count(store) == 3 and len(diary_lines(diary)) == 5)
    workers = psutil.Process(runner.pid).children(recursive=True)
    runner.kill()
    runner.communicate(timeout=PATIENCE)
    wait_for(lambda: gone(workers))
    gate.touch()
    again = start_run(tmp_path / "s" / "hostile.toml", store)
    out, err = again.communicate(timeout=PATIENCE)
    assert again.returncode == 0, err
    assert b"3 run now, 3 were there" in out
    assert sorted(line.split()[0] for line in diary_lines(diary)) == ["behave"] * 3 + ["held"] * 5
    assert open_store(store).statuses() == {"ok": 6}


@posix
def test_after_kill_9_of_a_worker_its_case_is_run_again_and_all_get_their_result(
    start_run: StartRun, tmp_path: Path
) -> None:
    diary, gate = tmp_path / "diary", tmp_path / "gate"
    hostile_suite(tmp_path / "s", {"held": f'diary = "{diary}", gate = "{gate}"'}, seeds="[1, 2, 3, 4]")
    runner = start_run(tmp_path / "s" / "hostile.toml", tmp_path / "store")
    wait_for(lambda: len(diary_lines(diary)) >= 1)
    _, seed, worker = diary_lines(diary)[0].split()
    os.kill(int(worker), signal.SIGKILL)
    wait_for(lambda: sum(line.split()[1] == seed for line in diary_lines(diary)) == 2)
    gate.touch()
    out, err = runner.communicate(timeout=PATIENCE)
    assert runner.returncode == 0, err
    assert b"4 cases (4 ok)" in out


@posix
def test_ctrl_c_ends_at_once_with_the_finished_cases_kept(start_run: StartRun, tmp_path: Path) -> None:
    """At once: the case that is under way would never end by itself."""
    diary, store = tmp_path / "diary", tmp_path / "store"
    hostile_suite(tmp_path / "s", {"quick": "", "held": f'diary = "{diary}", gate = "{tmp_path / "never"}"'})
    runner = start_run(tmp_path / "s" / "hostile.toml", store, jobs=2)
    wait_for(lambda: count(store) == 1 and len(diary_lines(diary)) == 1)
    workers = psutil.Process(runner.pid).children(recursive=True)
    os.killpg(runner.pid, signal.SIGINT)
    _, err = runner.communicate(timeout=PATIENCE)
    assert runner.returncode == 130
    assert b"Traceback" not in err
    assert b"the same command continues" in err
    wait_for(lambda: gone(workers))
    assert count(store) == 1


def test_two_runs_on_one_store_share_its_cases_and_do_not_corrupt_it(start_run: StartRun, tmp_path: Path) -> None:
    diary = tmp_path / "diary"
    hostile_suite(tmp_path / "s", {"good": f'seconds = 0.1, diary = "{diary}"'}, seeds=str(list(range(10))))
    runners = [start_run(tmp_path / "s" / "hostile.toml", tmp_path / "store") for _ in range(2)]
    for runner in runners:
        out, err = runner.communicate(timeout=PATIENCE)
        assert runner.returncode == 0, err
        assert b"10 cases (10 ok)" in out
    assert len(list(open_store(tmp_path / "store").results())) == 10
    assert len(diary_lines(diary)) == 10


def test_a_lease_ends_with_its_process_and_with_its_time(tmp_path: Path) -> None:
    store = create(tmp_path)
    mine, other = Leases(store), Leases(store)
    assert mine.take("a")
    assert mine.take("a")
    assert not other.take("a")
    mine.give_back("a")
    assert other.take("a")
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        began = f"{psutil.Process(process.pid).create_time():.2f}"
        third = Leases(store, owner=f"{platform.node()} {process.pid} {began} x")
        assert third.take("b")
        assert not mine.take("b")
        process.kill()
    assert mine.take("b")
    far = Leases(store, owner="another machine 1 0.00 x")
    assert far.take("c")
    assert not mine.take("c")
    store.connection.execute("UPDATE leases SET until = until - 3600")
    assert mine.take("c")


def test_a_method_that_writes_to_its_samples_harms_no_other(tmp_path: Path) -> None:
    suite = hostile_suite(tmp_path / "s", {"writing": 'deed = "write"', "good": 'deed = "behave"'})
    results, _ = finished(suite, create(tmp_path / "store"), jobs=1)
    assert [result["status"] for result in results] == ["failed", "ok"]
    assert "read-only" in results[0]["reason"]


def test_what_is_told_of_a_users_method_has_the_hash_of_its_file(tmp_path: Path) -> None:
    suite = hostile_suite(tmp_path, {"a": "seconds = 0.02"})
    digest = hashlib.sha256((tmp_path / "hostile.py").read_bytes()).hexdigest()[:12]
    assert suite.about["settings"] == {"a": f"hostile.py, seconds=0.02, sha256={digest}"}
    (tmp_path / "hostile.py").unlink()
    with pytest.raises(InputError, match=r"hostile\.py"):
        _ = suite.about


def test_a_table_shows_the_suite_that_was_run_last_and_where_each_result_came_from(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    run(hostile_suite(tmp_path / "s", {"a": "seconds = 0.01"}), store, jobs=1)
    run(hostile_suite(tmp_path / "s", {"a": "seconds = 0.02"}), store, jobs=1, about={"command": "latticebench run s"})
    assert [result["case"]["settings"] for result in store.results()] == [{"seconds": 0.02}]
    assert count(tmp_path / "store") == 2
    assert store.about()["command"] == "latticebench run s"
    assert {"commit", "date", "machine", "kernels", "versions"} == set(next(iter(store.results()))["made"])


def test_a_noisy_case_holds_its_bound_and_one_without_noise_or_truth_none(tmp_path: Path) -> None:
    def case(**changed: Any) -> FitCase:
        return FitCase(**{
            "system": "phi4", "sites": 9, "samples": 20, "noise": 0.01, "library": "lib2", "label": "a",
            "method": "zero", **changed,
        })  # fmt: skip

    found = attempt(case(known_ends=True), Folders(tmp_path))
    system = systems.find("phi4")
    clean = replace(simulate(system, sites=9, times=sample_times(20)), ends=system.ends)
    direct = bound_of([clean], system.library("lib2"), system.order, noise=0.01)
    assert found["bound"] == pytest.approx(direct.relative, rel=1e-6)
    assert list(found["bounds"].values()) == pytest.approx(list(direct.stderr), rel=1e-6)
    assert tuple(found["verdicts"].values()) == direct.verdicts
    # Neither the seed of the noise, nor mirrored samples of the same noise, say more about the coefficients.
    assert attempt(case(known_ends=True, seed=2, mirror=True), Folders(tmp_path))["bound"] == found["bound"]
    assert attempt(case(), Folders(tmp_path))["bound"] > found["bound"]
    for without in (case(noise=0.0), case(terms=("u[n]",), library="own"), case(sites=301, samples=100, span=1.0)):
        result = attempt(without, Folders(tmp_path))
        assert result["status"] == "ok"
        assert (result["bound"], result["bounds"], result["verdicts"]) == (None, None, None)
