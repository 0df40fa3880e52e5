"""Runs on the workers of a Dask scheduler: the same rows, and nothing finished is lost or stands twice."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import dask
import pandas as pd
import psutil
import pytest

import latticebench
from latticebench.bench import kinds
from latticebench.bench.executors import crew
from latticebench.bench.executors import dask as executor
from latticebench.bench.executors.cluster import Connection, Place
from latticebench.bench.executors.dask import Dask
from latticebench.bench.run import run
from latticebench.bench.store import Store, create, open_store
from latticebench.bench.suite import Suite, load
from latticebench.systems.errors import InputError

HERE = Path(__file__).parent
posix = pytest.mark.skipif(os.name != "posix", reason="sends POSIX signals")
# Seconds after which something that should have happened is taken to have failed: far beyond what a busy machine needs.
PATIENCE = 300.0
# Workers that are killed in one test.
KILLS = 3
# Columns that differ from run to run.
TIMES = ("seconds", "cpu_seconds", "peak_mib")

GRID = """
[[grid]]
methods = ["{label}"]
system = "phi4"
sites = 5
samples = 8
span = 1.0
libraries = ["lib1"]
noise = {noise}
seeds = {seeds}
time_limit = 3600
"""


def written(folder: Path, methods: dict[str, str], *, noise: str = "[0.0]", seeds: str = "[1]") -> Path:
    """Write a suite of hostile methods by their labels and settings, or of one of this package by its name."""
    folder.mkdir(exist_ok=True)
    shutil.copy(HERE / "hostile.py", folder / "hostile.py")
    text = 'title = "hostile"\ntiming = true\n'
    for label, given in methods.items():
        own = not given or "=" in given
        text += f'[methods."{label}"]\nmethod = "{"hostile.py" if own else given}"\n'
        text += f"settings = {{ {given} }}\n" if own else ""
    text += "".join(GRID.format(label=label, noise=noise, seeds=seeds) for label in methods)
    (folder / "hostile.toml").write_text(text)
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


def worker_of(case: psutil.Process) -> psutil.Process:
    """Return Dask's worker at which a case runs: behind it stand the case's process and what shields others from it."""
    return next(one for one in case.parents() if "spawn_main" in " ".join(one.cmdline()))


def table(store: Store) -> pd.DataFrame:
    """Return every column of the table of cases but times."""
    rows = kinds.rows(store)
    return pd.DataFrame(rows).drop(columns=list(TIMES), errors="ignore")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Connection]:
    """One worker, which is replaced when it is killed."""
    with Place(local=1).connected() as connection:
        yield connection


@pytest.mark.slow
def test_both_executors_make_the_same_rows_but_for_times_and_machines(cluster: Connection, tmp_path: Path) -> None:
    methods = {"lines": "least-squares", "good": "", "failing": 'deed = "fail"', "empty": 'deed = "nan"'}
    suite = suite_of(tmp_path / "s", methods, noise="[0.0, 0.01]", seeds="[1, 2]")
    here, there = create(tmp_path / "here"), create(tmp_path / "there")
    run(suite, here, jobs=1)
    _, tally = run(suite, there, executor=Dask(cluster, alike=suite.timing))
    assert (tally.ran, tally.statuses) == (16, {"failed": 8, "ok": 8})
    pd.testing.assert_frame_equal(table(here), table(there))
    assert "the matrix is on holiday" in str(table(there)["reason"].tolist())
    (made,), (own,) = there.origins(), here.origins()
    # A kernel is told where its library has been loaded.
    assert {**made, "kernels": ""} == {**own, "kernels": ""}
    # What is there is not run again, by whichever executor.
    assert run(suite, there, jobs=1)[1].ran == run(suite, here, executor=Dask(cluster))[1].ran == 0
    # A user's file that has changed is another, also at a worker that has the first.
    source = tmp_path / "s" / "hostile.py"
    source.write_text(source.read_text().replace("0.5)", "0.25)"))
    suite = load(str(tmp_path / "s" / "hostile.toml"))
    results, tally = run(suite, there, executor=Dask(cluster))
    assert tally.ran == 12
    assert {one["residual"] for one in results if one["case"]["label"] == "good"} == {0.25}


@posix
@pytest.mark.slow
def test_fits_at_a_worker_keep_freed_memory_as_those_here_do(cluster: Connection, tmp_path: Path) -> None:
    path = written(tmp_path / "s", {"good": ""})
    source = tmp_path / "s" / "hostile.py"
    source.write_text(source.read_text().replace("0.5)", 'float("MALLOC_TRIM_THRESHOLD_" in os.environ))'))
    results, tally = run(load(str(path)), create(tmp_path / "there"), executor=Dask(cluster))
    assert tally.statuses == {"ok": 1}
    assert [one["residual"] for one in results] == [0.0]


@pytest.mark.slow
def test_the_cases_of_a_worker_that_is_killed_are_run_by_the_next(cluster: Connection, tmp_path: Path) -> None:
    diary, gate = tmp_path / "diary", tmp_path / "gate"
    suite = suite_of(tmp_path / "s", {"held": f'diary = "{diary}", gate = "{gate}"'}, seeds="[1, 2, 3]")
    killed: list[psutil.Process] = []

    def kill() -> None:
        wait_for(lambda: len(lines(diary)) == 1)
        case = psutil.Process(int(lines(diary)[0].split()[2]))
        killed.append(worker_of(case))
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


StartRun = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Start programs in processes that are all ended with the test, whatever happens in it."""
    with ExitStack() as ends:

        def begin(program: str, *arguments: str) -> subprocess.Popen[bytes]:
            # A shell that starts tests in the background makes their children deaf to Ctrl-C.
            deaf = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
            command = [sys.executable, "-c", deaf + program, *arguments]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)
            ends.enter_context(process)
            ends.callback(end_group, process.pid)
            return process

        yield begin


def end_group(leader: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(leader, signal.SIGKILL)


RUN = "if __name__ == '__main__':\n    from latticebench.bench.cli import main; main()"
SCHEDULER = "from distributed.cli.dask_scheduler import main; main()"
WORKER = "if __name__ == '__main__':\n    from distributed.cli.dask_worker import main; main()"


def asked(suite: Path, store: Path, *where: str) -> list[str]:
    return ["run", str(suite), "--results", str(store), "--executor", "dask", *where]


def count(folder: Path) -> int:
    """Count the results in a store."""
    try:
        return sum(open_store(folder).statuses().values())
    except InputError:
        # It is being made.
        return 0


def family(process: subprocess.Popen[bytes]) -> list[psutil.Process]:
    return psutil.Process(process.pid).children(recursive=True)


def gone(processes: list[psutil.Process]) -> bool:
    return not any(one.is_running() and one.status() != psutil.STATUS_ZOMBIE for one in processes)


@posix
@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_after_the_client_has_ended_nothing_is_left_over_and_it_goes_on(
    start: StartRun, tmp_path: Path, how: signal.Signals
) -> None:
    diary, gate, store = tmp_path / "diary", tmp_path / "gate", tmp_path / "store"
    methods = {"quick": f'diary = "{diary}"', "held": f'deed = "held", diary = "{diary}", gate = "{gate}"'}
    path = written(tmp_path / "s", methods, seeds="[1, 2, 3]")
    runner = start(RUN, *asked(path, store, "--cluster", "local:2"))
    wait_for(lambda: count(store) == 3 and len(lines(diary)) == 5)
    processes = family(runner)
    # Two workers of Dask's, and for each a process for cases and one that watches over it.
    assert len(processes) >= 6
    os.killpg(runner.pid, how) if how == signal.SIGINT else runner.kill()
    _, err = runner.communicate(timeout=PATIENCE)
    wait_for(lambda: gone(processes))
    if how == signal.SIGINT:
        assert (runner.returncode, b"Traceback" in err) == (130, False), err.decode()
        assert b"the same command continues" in err
    gate.touch()
    again = start(RUN, *asked(path, store, "--cluster", "local:1"))
    out, err = again.communicate(timeout=PATIENCE)
    assert again.returncode == 0, err
    assert b"3 run now, 3 were there" in out
    assert sorted(line.split()[0] for line in lines(diary)) == ["behave"] * 3 + ["held"] * 5
    assert open_store(store).statuses() == {"ok": 6}


@posix
@pytest.mark.slow
def test_after_the_scheduler_was_killed_the_run_says_so_and_goes_on_with_another(
    start: StartRun, tmp_path: Path
) -> None:
    diary, gate, store = tmp_path / "diary", tmp_path / "gate", tmp_path / "store"
    path = written(tmp_path / "s", {"quick": "", "held": f'diary = "{diary}", gate = "{gate}"'})

    def started(name: str) -> tuple[str, subprocess.Popen[bytes], subprocess.Popen[bytes]]:
        told = tmp_path / name
        scheduler = start(
            SCHEDULER, "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(told)
        )
        wait_for(lambda: told.is_file() and told.stat().st_size > 0)
        address = json.loads(told.read_text())["address"]
        return address, scheduler, start(WORKER, address, "--nthreads", "1", "--no-dashboard", "--death-timeout", "20")

    address, scheduler, worker = started("first.json")
    runner = start(RUN, *asked(path, store, "--scheduler", address))
    wait_for(lambda: count(store) == 1 and len(lines(diary)) == 1)
    processes = family(worker)
    scheduler.kill()
    _, err = runner.communicate(timeout=PATIENCE)
    assert runner.returncode == 2, err
    assert b"does not answer any more" in err
    assert b"Traceback" not in err
    wait_for(lambda: gone(processes))
    gate.touch()
    address, _, _ = started("second.json")
    again = start(RUN, *asked(path, store, "--scheduler", address))
    out, err = again.communicate(timeout=PATIENCE)
    assert again.returncode == 0, err
    assert b"1 run now, 1 were there" in out
    assert b"2 cases (2 ok)" in out


@posix
@pytest.mark.slow
def test_workers_that_are_killed_at_random_moments_lose_nothing_and_make_nothing_twice(
    cluster: Connection, tmp_path: Path
) -> None:
    diary = tmp_path / "diary"
    suite = suite_of(tmp_path / "s", {"good": f'seconds = 0.2, diary = "{diary}"'}, seeds='"1-20"')
    ended, kills, draw = threading.Event(), list[int](), random.Random(1)

    def kill() -> None:
        while not ended.is_set() and len(kills) < KILLS:
            time.sleep(draw.uniform(0.2, 1.5))
            with suppress(psutil.Error, IndexError, StopIteration):
                process = worker_of(psutil.Process(int(lines(diary)[-1].split()[2])))
                if process.pid not in kills:
                    process.kill()
                    kills.append(process.pid)

    killer = threading.Thread(target=kill)
    killer.start()
    store = create(tmp_path / "store")
    try:
        results, tally = run(suite, store, executor=Dask(cluster))
    finally:
        ended.set()
        killer.join()
    assert len(kills) == KILLS
    assert (tally.ran, tally.statuses) == (20, {"ok": 20})
    assert sorted(one["case"].get("seed", 1) for one in results) == list(range(1, 21))
    # What was lost is at most the batch that each was on.
    assert list(store.read("SELECT COUNT(*), COUNT(DISTINCT identity) FROM results")) == [(20, 20)]


@posix
@pytest.mark.slow
def test_workers_that_start_too_slowly_for_dask_are_replaced(tmp_path: Path) -> None:
    suite = suite_of(tmp_path / "s", {"good": ""}, seeds="[1, 2, 3]")
    before = {one.pid for one in psutil.Process().children()}
    # Dask gives a worker up that is not back by then: 15 s, which a busy machine may need. Set after the connection has
    # imported distributed: a setting made before would take all of distributed's own with it when it ends.
    with Place(local=1).connected() as connection, dask.config.set({"distributed.deploy.lost-worker-timeout": "10ms"}):
        for one in psutil.Process().children():
            if one.pid not in before and "spawn_main" in " ".join(one.cmdline()):
                one.kill()
        time.sleep(1.0)
        _, tally = run(suite, create(tmp_path / "store"), executor=Dask(connection))
    assert (tally.ran, tally.statuses) == (3, {"ok": 3})


@posix
@pytest.mark.slow
def test_a_run_without_any_worker_says_that_it_waits(
    start: StartRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(crew, "ALONE", 1.0)
    monkeypatch.setattr(executor, "_tell", told.append)
    place = tmp_path / "scheduler.json"
    start(SCHEDULER, "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(place))
    wait_for(lambda: place.is_file() and place.stat().st_size > 0)
    address = json.loads(place.read_text())["address"]
    suite = suite_of(tmp_path / "s", {"good": ""})

    def join() -> None:
        wait_for(lambda: bool(told))
        start(WORKER, address, "--nthreads", "1", "--no-dashboard", "--death-timeout", "20")

    joining = threading.Thread(target=join)
    joining.start()
    _, tally = run(suite, create(tmp_path / "store"), executor=Dask(Connection(address)))
    joining.join()
    assert told == ["there has been no worker for 1 s: waiting for one"]
    assert tally.statuses == {"ok": 1}


@posix
@pytest.mark.slow
def test_certificates_are_asked_for_and_serve(start: StartRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("no openssl to make certificates with")
    certificate, key = tmp_path / "certificate.pem", tmp_path / "key.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=localhost",
         "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1", "-out", str(certificate), "-keyout", str(key)],
        check=True, capture_output=True,
    )  # fmt: skip
    path, told = written(tmp_path / "s", {"quick": ""}), tmp_path / "scheduler.json"
    tls = ["--tls-ca-file", str(certificate), "--tls-cert", str(certificate), "--tls-key", str(key), "--no-dashboard"]
    start(SCHEDULER, "--protocol", "tls", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(told), *tls)
    wait_for(lambda: told.is_file() and told.stat().st_size > 0)
    address = json.loads(told.read_text())["address"]
    start(WORKER, address, "--nthreads", "1", *tls)
    without = start(RUN, *asked(path, tmp_path / "store", "--scheduler", address))
    _, err = without.communicate(timeout=PATIENCE)
    assert (without.returncode, b"DASK_DISTRIBUTED__COMM__TLS__CA_FILE" in err) == (2, True)
    for name, file in (("CA_FILE", certificate), ("CLIENT__CERT", certificate), ("CLIENT__KEY", key)):
        monkeypatch.setenv(f"DASK_DISTRIBUTED__COMM__TLS__{name}", str(file))
    out, err = start(RUN, *asked(path, tmp_path / "store", "--scheduler", address)).communicate(timeout=PATIENCE)
    assert b"1 cases (1 ok)" in out, err
    assert b"warning" not in err


SLURM = """
system = "slurm"
jobs = 2
memory = "1GiB"
walltime = "00:30:00"
margin = 60
interface = "lo"
logs = "jobs"
"""


def jobs() -> list[str]:
    """Return the numbers of the user's jobs that Slurm has."""
    told = subprocess.run(["squeue", "--me", "--noheader", "--format=%i"], capture_output=True, text=True, check=True)
    return told.stdout.split()


def has_slurm() -> bool:
    return shutil.which("sinfo") is not None and not subprocess.run(["sinfo"], capture_output=True).returncode


@pytest.mark.slow
@pytest.mark.cluster
def test_slurm_runs_a_suite_through_a_cancelled_job_and_ctrl_c_ends_its_jobs(
    start: StartRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not has_slurm():
        pytest.skip("no Slurm answers here")
    before = jobs()
    diary, gate, store = tmp_path / "diary", tmp_path / "gate", tmp_path / "store"
    methods = {"quick": f'diary = "{diary}"', "held": f'deed = "held", diary = "{diary}", gate = "{gate}"'}
    path = written(tmp_path / "s", methods, seeds="[1, 2, 3]")
    (tmp_path / "cluster.toml").write_text(SLURM)
    monkeypatch.chdir(tmp_path)
    runner = start(RUN, *asked(path, store, "--cluster", "cluster.toml"))
    wait_for(lambda: count(store) == 3 and len(lines(diary)) == 5)
    mine = [one for one in jobs() if one not in before]
    assert len(mine) == 2
    # A cancelled job takes its worker away: its case begins elsewhere, and a new job takes its place.
    subprocess.run(["scancel", mine[0]], check=True)
    wait_for(lambda: len(lines(diary)) >= 6 and len([one for one in jobs() if one not in [*before, *mine]]) == 1)
    assert runner.poll() is None
    os.killpg(runner.pid, signal.SIGINT)
    _, err = runner.communicate(timeout=PATIENCE)
    assert (runner.returncode, b"Traceback" in err) == (130, False), err.decode()
    wait_for(lambda: set(jobs()) <= set(before))
    gate.touch()
    out, err = start(RUN, *asked(path, store, "--cluster", "cluster.toml")).communicate(timeout=PATIENCE)
    assert b"3 run now, 3 were there" in out, err
    assert open_store(store).statuses() == {"ok": 6}
    wait_for(lambda: set(jobs()) <= set(before))
