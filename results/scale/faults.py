"""Break runs on the workers of a Dask scheduler at random moments, and count what is lost: faults.csv and faults.md.

    python results/scale/faults.py [MOMENTS [FAULT ...]]

Each fault strikes at so many random moments (50 if not given) of a run of naps: cases that write a line into a diary,
sleep for a twentieth of a second and fit nothing. What had its result in the store at any moment has to be there at the
end, and once. Where a fault ends the run, the same command is typed again. Processes are known by a mark in their
environment; those that are there a minute after the last run are left over. Faults that are named are played anew; the
rows of the others stay as they are.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import resource
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import psutil

from latticebench.bench.provenance import lines, origin
from latticebench.bench.publish import markdown_list, markdown_table, render
from latticebench.bench.store import open_store
from latticebench.systems.errors import InputError
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
MARK = "LATTICEBENCH_FAULTS"
SEED = 1
# Naps for each moment, more where a fault costs little time, and seconds between two moments and to wait for what must
# happen.
NAPS, MANY, BETWEEN, PATIENCE = 40, 100, (0.3, 2.5), 300.0
# Seconds that a worker stands still or hears nothing; every so manieth time it is a minute.
STILL, MINUTE_EVERY = (0.2, 3.0), 25
LOCAL = ("--cluster", "local:2")
METHODS = """
import os, time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from latticebench.methods.method import Abilities, Fit


@dataclass(frozen=True)
class Nap:
    name: ClassVar[str] = "nap"
    diary: str = ""
    eats: bool = False

    @property
    def abilities(self):
        return Abilities()

    def fit(self, data, library, order, seed):
        with open(self.diary, "a") as diary:
            diary.write(f"{seed} {os.getpid()}\\n")
        eaten = np.ones(2**28) if self.eats else np.ones(1)
        time.sleep(0.05 * eaten[-1])
        return Fit(self.name, library, order, np.zeros(len(library.terms)), 1.0)


METHODS = (Nap,)
"""
GRID = """
[[grid]]
methods = ["{label}"]
system = "phi4"
sites = 5
samples = 8
span = 1.0
libraries = ["lib1"]
noise = [0.01]
seeds = "1-{count}"
memory_limit = 1024
"""


@dataclass
class Stage:
    """Where a fault is played: a folder with a suite of naps, its store and its diary; what was seen there."""

    folder: Path
    moments: int
    naps: int
    eaters: int = 0
    mark: str = field(default_factory=lambda: uuid.uuid4().hex)
    draw: random.Random = field(default_factory=lambda: random.Random(SEED))
    seen: set[str] = field(default_factory=set)
    struck: list[int] = field(default_factory=list)
    codes: list[int] = field(default_factory=list)
    started: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        (self.folder / "nap.py").write_text(METHODS)
        labels = {"nap": self.naps * self.moments, "eater": self.eaters}
        text = 'title = "naps"\n'
        for label, count in labels.items():
            given = f'diary = "{self.folder / "diary"}", eats = {str(label == "eater").lower()}'
            text += f'[methods.{label}]\nmethod = "nap.py"\nsettings = {{ {given} }}\n' if count else ""
        text += "".join(GRID.format(label=label, count=count) for label, count in labels.items() if count)
        (self.folder / "naps.toml").write_text(text)

    @property
    def cases(self) -> int:
        """How many cases the suite has."""
        return self.naps * self.moments + self.eaters

    @property
    def diary(self) -> list[str]:
        """One line for each case that began: its seed and its process."""
        path = self.folder / "diary"
        return path.read_text().splitlines() if path.exists() else []

    def start(self, *command: str) -> subprocess.Popen[bytes]:
        """Start a program in a session of its own, with the mark."""
        environment = {**os.environ, MARK: self.mark, "OMP_NUM_THREADS": "1"}
        log = (self.folder / "log").open("ab")
        # A shell makes what it starts in the background deaf to Ctrl-C.
        process = subprocess.Popen(
            command, stdout=log, stderr=log, env=environment, start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip
        self.started.append(process)
        return process

    def run(self, *where: str) -> subprocess.Popen[bytes]:
        """Start the run, or start it again."""
        command = (sys.executable, "-m", "latticebench", "run", str(self.folder / "naps.toml"))
        return self.start(*command, "--results", str(self.folder / "store"), "--executor", "dask", *where)

    def finished(self) -> list[str]:
        """Return which cases have a result, each as often as it has one."""
        try:
            return [one for (one,) in open_store(self.folder / "store").read("SELECT identity FROM results")]
        except InputError:
            # It is being made.
            return []

    def look(self) -> int:
        """Remember what is finished; return how much that is."""
        found = self.finished()
        self.seen.update(found)
        return len(found)

    def strike(self, deed: Callable[[], object]) -> None:
        """Do a deed, and remember when it was."""
        self.struck.append(self.look())
        deed()

    def marked(self) -> list[psutil.Process]:
        """Return the processes that are left of all that was started."""
        found = []
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                if process.status() != psutil.STATUS_ZOMBIE and process.environ().get(MARK) == self.mark:
                    found.append(process)
        return found

    def workers(self) -> list[psutil.Process]:
        """Return the workers that have begun a case lately and are there."""
        found: dict[int, psutil.Process] = {}
        for line in self.diary[-20:]:
            with suppress(psutil.Error, IndexError, ValueError):
                worker = psutil.Process(int(line.split()[1])).parent()
                if worker is not None and worker.environ().get(MARK) == self.mark:
                    found[worker.pid] = worker
        return list(found.values())

    def pause(self) -> None:
        """Wait until the next moment."""
        time.sleep(self.draw.uniform(*BETWEEN))

    def wait(self, process: subprocess.Popen[bytes]) -> int:
        """Wait for a run, and remember how it ended."""
        self.codes.append(process.wait(PATIENCE + self.cases))
        self.look()
        return self.codes[-1]

    def rest(self) -> None:
        """Run what is left, on two workers of this machine."""
        self.wait(self.run(*LOCAL))


def _wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError("what had to happen did not")
        time.sleep(0.02)


def _within(stage: Stage, run: subprocess.Popen[bytes], deed: Callable[[], object]) -> None:
    """Strike at all moments of one run."""
    _wait_for(lambda: bool(stage.diary))
    while len(stage.struck) < stage.moments and run.poll() is None:
        stage.pause()
        if stage.workers():
            stage.strike(deed)
    stage.wait(run)


def _again_and_again(stage: Stage, begin: Callable[[], subprocess.Popen[bytes]], deed: Callable[..., object]) -> None:
    """Strike once in each run, at a random moment after its start, and run what is left in the end."""
    while len(stage.struck) < stage.moments and len(set(stage.finished())) < stage.cases:
        run, before = begin(), len(stage.diary)
        _wait_for(lambda run=run, before=before: len(stage.diary) > before or run.poll() is not None)  # type: ignore[misc]
        time.sleep(stage.draw.uniform(0.0, 1.5))
        if run.poll() is None:
            stage.strike(lambda run=run: deed(run))  # type: ignore[misc]
        stage.wait(run)
    stage.rest()


def worker_killed(stage: Stage) -> None:
    """Kill one of two workers (SIGKILL)."""
    _within(stage, stage.run(*LOCAL), lambda: stage.draw.choice(stage.workers()).kill())


def all_workers_killed(stage: Stage) -> None:
    """Kill all workers (SIGKILL)."""

    def kill() -> None:
        for one in stage.workers():
            one.kill()

    _within(stage, stage.run(*LOCAL), kill)


def worker_hangs(stage: Stage) -> None:
    """Let one of two workers stand still (SIGSTOP) for 0.2 to 3 s."""

    def stop() -> None:
        worker = stage.draw.choice(stage.workers())
        worker.suspend()
        time.sleep(stage.draw.uniform(*STILL))
        with suppress(psutil.Error):
            worker.resume()

    _within(stage, stage.run(*LOCAL), stop)


def network_lost(stage: Stage) -> None:
    """Let nothing get to or from the only worker for 0.2 to 3 s, every 25th time for a minute."""
    address, _ = _scheduler(stage)
    silence = Silence(int(address.rpartition(":")[2]))
    own, seen = silence.ports
    listen = ("--listen-address", f"tcp://127.0.0.1:{own}", "--contact-address", f"tcp://127.0.0.1:{seen}")
    worker = stage.start(*_dask("worker"), f"tcp://127.0.0.1:{silence.port}", "--nthreads", "1", "--no-nanny", *listen)

    def cut() -> None:
        minute = len(stage.struck) % MINUTE_EVERY == 0
        silence.keep(60.0 if minute else stage.draw.uniform(*STILL))

    _within(stage, stage.run("--scheduler", address), cut)
    worker.terminate()
    stage.started[0].terminate()


def scheduler_killed(stage: Stage) -> None:
    """Kill the scheduler (SIGKILL), and start the run again with another."""
    schedulers: list[subprocess.Popen[bytes]] = []

    def begin() -> subprocess.Popen[bytes]:
        address, scheduler = _scheduler(stage)
        schedulers.append(scheduler)
        stage.start(*_dask("worker"), address, "--nthreads", "1", "--no-dashboard", "--death-timeout", "20")
        return stage.run("--scheduler", address)

    _again_and_again(stage, begin, lambda _: schedulers[-1].kill())


def client_killed(stage: Stage) -> None:
    """Kill the client (SIGKILL), in which scheduler and store live, and start the run again."""
    _again_and_again(stage, lambda: stage.run(*LOCAL), lambda run: run.kill())


def client_interrupted(stage: Stage) -> None:
    """Interrupt the client and its workers (SIGINT, as Ctrl-C does), and start the run again."""
    _again_and_again(stage, lambda: stage.run(*LOCAL), lambda run: os.killpg(run.pid, signal.SIGINT))


def disk_full(stage: Stage) -> None:
    """Let no file of the client grow any more, by its limit of file size, and start the run again."""

    def fill(run: subprocess.Popen[bytes]) -> None:
        size = max((path.stat().st_size for path in (stage.folder / "store").iterdir()), default=0)
        psutil.Process(run.pid).rlimit(resource.RLIMIT_FSIZE, (size, size))

    _again_and_again(stage, lambda: stage.run(*LOCAL), fill)


def memory_exceeded(stage: Stage) -> None:
    """Run cases that take 2 GiB where their limit is 1 GiB among the others."""
    run = stage.run(*LOCAL)
    stage.wait(run)
    rows = open_store(stage.folder / "store").statuses()
    stage.struck = [0] * rows.get("memory", 0)


FAULTS = {
    one.__name__.replace("_", " "): one
    for one in (
        worker_killed, all_workers_killed, worker_hangs, network_lost, memory_exceeded, scheduler_killed, client_killed,
        client_interrupted, disk_full,
    )
}  # fmt: skip


def _dask(part: str) -> tuple[str, ...]:
    program = f"if __name__ == '__main__':\n    from distributed.cli.dask_{part} import main; main()"
    return sys.executable, "-c", program


def _scheduler(stage: Stage) -> tuple[str, subprocess.Popen[bytes]]:
    told = stage.folder / f"scheduler-{uuid.uuid4().hex}.json"
    process = stage.start(
        *_dask("scheduler"), "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(told)
    )
    _wait_for(lambda: told.is_file() and told.stat().st_size > 0)
    return json.loads(told.read_text())["address"], process


class Silence:
    """A way to a scheduler and one to a worker, over which at times nothing gets.

    Attributes:
        port: where a worker finds the scheduler.
        ports: where a worker has to listen, and where others find it.
    """

    def __init__(self, scheduler: int) -> None:
        self.open, self.port, self.ports = threading.Event(), 0, (0, 0)
        self.open.set()
        ready = threading.Event()
        threading.Thread(target=lambda: asyncio.run(self._serve(scheduler, ready)), daemon=True).start()
        ready.wait(PATIENCE)

    def keep(self, seconds: float) -> None:
        """Let nothing pass for some seconds."""
        self.open.clear()
        time.sleep(seconds)
        self.open.set()

    async def _serve(self, scheduler: int, ready: threading.Event) -> None:
        free = await asyncio.start_server(lambda *_: None, "127.0.0.1", 0)
        own = free.sockets[0].getsockname()[1]
        free.close()
        ways = [await asyncio.start_server(self._way_to(port), "127.0.0.1", 0) for port in (scheduler, own)]
        self.port, seen = (way.sockets[0].getsockname()[1] for way in ways)
        self.ports = own, seen
        ready.set()
        await asyncio.gather(*(way.serve_forever() for way in ways))

    def _way_to(self, port: int) -> Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]:
        async def pass_on(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
            with suppress(OSError):
                while piece := await source.read(65536):
                    while not self.open.is_set():
                        await asyncio.sleep(0.01)
                    target.write(piece)
                    await target.drain()
            target.close()

        async def meet(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            try:
                back, forth = await asyncio.open_connection("127.0.0.1", port)
            except OSError:
                writer.close()
                return
            await asyncio.gather(pass_on(reader, forth), pass_on(back, writer))

        return meet


def played(names: list[str], moments: int) -> Iterator[dict[str, object]]:
    """Yield what each fault did."""
    for name in names:
        fault, began = FAULTS[name], time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            naps, eaters = (
                MANY if fault in (worker_hangs, network_lost, disk_full) else NAPS,
                moments * (fault is memory_exceeded),
            )
            stage = Stage(Path(folder).resolve(), moments, naps, eaters)
            fault(stage)
            final = stage.finished()
            with suppress(TimeoutError):
                end = time.monotonic() + 60.0
                _wait_for(lambda stage=stage, end=end: not stage.marked() or time.monotonic() > end)  # type: ignore[misc]
            left = stage.marked()
            for one in left:
                one.kill()
            yield {
                "fault": name, "what": (fault.__doc__ or "").strip(), "struck": len(stage.struck), "cases": stage.cases,
                "finished at the first": min(stage.struck, default=0), "at the last": max(stage.struck, default=0),
                "lost": len(stage.seen - set(final)), "twice": len(final) - len(set(final)),
                "never run": stage.cases - len(set(final)), "begun again": len(stage.diary) - stage.cases,
                "left over": len(left), "exit codes": " ".join(f"{code}: {stage.codes.count(code)}" for code in
                sorted(set(stage.codes), reverse=True)), "seconds": round(time.monotonic() - began),
            }  # fmt: skip


def page(table: pd.DataFrame) -> str:
    """Return the text of faults.md, without its provenance."""
    told = "\n".join(f"- *{row.fault}*: {row.what}" for row in table.itertuples())
    about = (__doc__ or "").split("[FAULT ...]]\n")[1].strip()
    return (
        f"# What breaks while a run lasts, and what is lost\n\n{about}\n\n"
        f"{markdown_table(table.drop(columns='what').astype(str))}\n\n"
        "`finished` is how many cases had their results when the fault struck; `begun again` counts cases whose first "
        "run was broken off, or whose result was not kept; exit codes are those of the runs, with how many there were "
        f"of each (negative: the signal).\n\n{told}"
    )


def main() -> None:
    """Break runs, and write the two files."""
    moments = int(sys.argv[1]) if len(sys.argv) > 1 else 50
    names, path = sys.argv[2:] or list(FAULTS), HERE / "faults.csv"
    about = {"command": shlex.join(["python", "results/scale/faults.py", *sys.argv[1:]]), **origin(), "seed": SEED}
    kept = pd.read_csv(path, comment="#") if sys.argv[2:] and path.exists() else pd.DataFrame()
    rows: dict[str, Any] = {str(row["fault"]): row for row in kept.to_dict("records")}
    for row in played(names, moments):
        rows[str(row["fault"])] = {**row, "commit": about["commit"]}
        print(row, flush=True)
        table = pd.DataFrame([rows[name] for name in FAULTS if name in rows])
        write_text(path, render(table, about, "csv"))
        provenance = "".join(f"{line}\n" for line in markdown_list(lines(about)))
        write_text(HERE / "faults.md", f"{page(table)}\n\n{provenance}")


if __name__ == "__main__":
    main()
