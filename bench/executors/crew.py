"""The workers of a Dask scheduler as the run sees them: one coroutine for each, from its first hour to its last.

A worker is asked for its versions, sent users' files, and compared with what the keys of results are made of; then it
gets one batch after the other, pinned to it, and never a second before it has answered the first. So cases wait at the
client, which holds their leases, and a worker that is lost has none that another could not run.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import pickle
import platform
import time
import uuid
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib import metadata
from typing import Any

import latticebench
from latticebench.bench import source
from latticebench.bench.case import Case, Folders, Roots
from latticebench.bench.executors import station
from latticebench.bench.executors.batches import LOSSES, Batches
from latticebench.bench.executors.executor import Ledger
from latticebench.bench.executors.parcel import contents, pack
from latticebench.bench.pool import TRIES
from latticebench.bench.process import START_LIMIT
from latticebench.bench.provenance import DISTRIBUTION
from latticebench.bench.worker import outcome
from latticebench.systems.errors import InputError

PYTHON = platform.python_version()
# Seconds between two looks at which workers there are; until one that waits asks again for a case.
LOOK = 0.5
WAIT = 0.05
# Seconds that a worker has for an answer, besides what its cases may take; that it has to end its process at the end.
ANSWER = 300.0
FAREWELL = 5.0
# Seconds without any worker after which the user is told.
ALONE = 30.0


class RefusedError(Exception):
    """A worker cannot be used; the text says why."""


class GoneError(Exception):
    """A worker, or the way to it, is lost."""


class Crew:
    """The workers while a run lasts.

    Attributes:
        client: an asynchronous client of Dask's.
        batches: the cases.
        alike: refuse workers of another processor than the first has.
        tell: says a line to the user.
    """

    def __init__(self, client: Any, batches: Batches, ledger: Ledger, *, alike: bool, tell: Callable[[str], None]):
        self.client, self.batches, self.ledger, self.alike, self.tell = client, batches, ledger, alike, tell
        self.tasks: dict[str, asyncio.Task[None]] = {}
        self.ready: set[str] = set()
        self.refused: dict[str, str] = {}
        self.processor = ""
        self.longest = 0.0

    def pack(self, cases: Sequence[Case], folders: Folders, loads: Collection[str]) -> None:
        """Prepare what every worker is told of the cases."""
        self.longest = max(case.time_limit for case in cases)
        parcel, self.paths = pack(cases, folders)
        samples: dict[Roots, Case] = {case.roots: case for case in cases}
        self.prints = [source.fingerprint(roots, folders) for roots in samples]
        self.parcel, self.samples = pickle.dumps(parcel), pickle.dumps(list(samples.values()))
        self.loads = sorted(loads)

    async def run(self) -> None:
        """Run the cases.

        Raises:
            InputError: there is no worker that can be used, the scheduler is gone, or a result cannot be kept.
        """
        since: float | None = None
        try:
            while self.batches.open:
                await self._look()
                self.ledger.pulse()
                if self.tasks:
                    since = None
                    await asyncio.wait(self.tasks.values(), timeout=LOOK, return_when=asyncio.FIRST_COMPLETED)
                    continue
                now = time.monotonic()
                since = now if since is None else since
                if now - since > ALONE:
                    self.tell(f"there has been no worker for {ALONE:.0f} s: waiting for one")
                    since = math.inf
                await asyncio.sleep(LOOK)
        finally:
            await self._dismiss()

    async def _look(self) -> None:
        """Begin with workers that have come, and let go of those that are gone."""
        try:
            present = set(await self.client.nthreads())
        except (OSError, RuntimeError, ValueError) as error:
            raise self._lost(error) from None
        if self.client.status != "running":
            raise self._lost(None)
        for worker, task in list(self.tasks.items()):
            if task.done() or worker not in present:
                del self.tasks[worker]
                self.ready.discard(worker)
                await _ended(task)
        for worker in [one for one in self.refused if one not in present]:
            del self.refused[worker]
        for worker in present - self.tasks.keys() - self.refused.keys():
            self.tasks[worker] = asyncio.create_task(self._serve(worker))
        if self.refused and not self.tasks:
            raise InputError(f"no worker can be used: {next(iter(self.refused.values()))}")

    def _lost(self, error: Exception | None) -> InputError:
        told = f" ({error})" if error is not None and str(error) else ""
        return InputError(
            f"the scheduler at {self.client.scheduler.address} does not answer any more{told}; finished cases are "
            "kept, and the same command with a scheduler that runs continues from there"
        )

    async def _dismiss(self) -> None:
        """Let all workers end what they do, and their processes."""
        ready = list(self.ready)
        for task in self.tasks.values():
            task.cancel()
        for task in self.tasks.values():
            with contextlib.suppress(Exception):
                await _ended(task)
        farewells = [self._ask(worker, FAREWELL, station.close) for worker in ready]
        await asyncio.gather(*farewells, return_exceptions=True)

    async def _serve(self, worker: str) -> None:
        """Give a worker cases as long as there are any."""
        try:
            await self._employ(worker, await self._introduce(worker))
        except RefusedError as refusal:
            self.refused[worker] = f"worker {worker}: {refusal}"
            self.tell(f"worker {worker} is not used: {refusal}")
        except GoneError:
            # Should it still be there, it is met anew.
            return
        finally:
            self.ready.discard(worker)

    async def _employ(self, worker: str, made: Mapping[str, Any]) -> None:
        """Hand batches to a worker and keep what it finds.

        Raises:
            GoneError, RefusedError: it is lost, or fails; its cases are given back.
        """
        self.ready.add(worker)
        turned, answered = time.monotonic(), None
        while True:
            cases: list[Case] = []
            if answered is not None or self.batches.waiting:
                with self.ledger.together():
                    if answered is not None:
                        self._keep(*answered, made)
                    cases = self.batches.take(len(self.ready), lambda case: self.ledger.begin(case, worker))
            answered = None
            if not cases:
                await asyncio.sleep(WAIT)
                turned = time.monotonic()
                continue
            answer = await self._hand(worker, cases, made)
            answered = cases, answer["done"]
            now = time.monotonic()
            self.batches.turned(max(now - turned - answer["seconds"], 0.0))
            turned = now

    async def _introduce(self, worker: str) -> Mapping[str, Any]:
        """Learn what computes results at a worker.

        Raises:
            RefusedError: another than what computes them here.
        """
        # Functions of Python's own, which any worker knows.
        version = await self._ask(worker, ANSWER, platform.python_version)
        if version.split(".")[:2] != PYTHON.split(".")[:2]:
            raise RefusedError(f"it runs Python {version}, and this is Python {PYTHON}")
        ours = latticebench.__version__
        try:
            theirs = await self._ask(worker, ANSWER, metadata.version, DISTRIBUTION)
        except RefusedError as refusal:
            if not isinstance(refusal.__cause__, metadata.PackageNotFoundError):
                raise
            raise RefusedError(f"it has no {DISTRIBUTION}; install {DISTRIBUTION} {ours} there") from None
        if theirs != ours:
            raise RefusedError(f"it has {DISTRIBUTION} {theirs}, and this is {DISTRIBUTION} {ours}")
        lacking = await self._ask(worker, ANSWER, station.lacking, self.parcel)
        if lacking:
            await self._ask(worker, ANSWER, station.receive, contents(lacking, self.paths))
        about = await self._ask(worker, ANSWER, station.introduce, self.parcel, self.samples, self.loads)
        if about["prints"] != self.prints:
            raise RefusedError(
                f"the code of its {DISTRIBUTION} {theirs} is not that of the {DISTRIBUTION} {ours} here, although the "
                "versions agree; install the same there"
            )
        self.processor = self.processor or about["processor"]
        if self.alike and about["processor"] != self.processor:
            raise RefusedError(
                f"its processor is {about['processor']!r}, others have {self.processor!r}, and the suite compares run "
                "times; --any-processor takes it all the same"
            )
        made: Mapping[str, Any] = about["origin"]
        return made

    async def _hand(self, worker: str, cases: Sequence[Case], made: Mapping[str, Any]) -> Mapping[str, Any]:
        """Hand a batch to a worker; return its answer.

        Raises:
            GoneError, RefusedError: as `_ask`; the cases are given back.
        """
        budget = self.batches.budget
        # Long enough for whatever keeps within its limits.
        limit = budget + TRIES * (START_LIMIT + self.longest) + ANSWER
        try:
            batch = pickle.dumps(list(cases))
            found: Mapping[str, Any] = await self._ask(worker, limit, station.work, self.parcel, batch, budget)
            return found
        except RefusedError:
            self.batches.back(cases)
            raise
        except (asyncio.CancelledError, GoneError):
            self._lose(cases, made)
            raise

    def _lose(self, cases: Sequence[Case], made: Mapping[str, Any]) -> None:
        reason = f"{LOSSES} workers were lost while they ran it"
        for case in self.batches.lost(cases):
            self.ledger.keep(case, outcome(case, "died", reason), made)
            self.batches.open -= 1

    def _keep(self, cases: Sequence[Case], done: Sequence[tuple[int, float, Any]], made: Mapping[str, Any]) -> None:
        """Keep what a worker has found; what it has not begun is the next."""
        found = {number for number, _, _ in done}
        self.batches.back(case for number, case in enumerate(cases) if number not in found)
        for number, seconds, result in done:
            self.ledger.keep(cases[number], result, made)
            self.batches.done(cases[number], seconds)

    async def _ask(self, worker: str, limit: float, function: Callable[..., Any], *arguments: Any) -> Any:
        """Let a worker call a function; return what it returns, and raise what it raises.

        Raises:
            GoneError: the worker is lost before it has answered.
            RefusedError: it fails, or has not answered after so many seconds.
        """
        future = self.client.submit(
            function, *arguments, workers=[worker], allow_other_workers=False, pure=False,
            key=f"{DISTRIBUTION}-{uuid.uuid4()}",
        )  # fmt: skip
        answered = False
        try:
            found = await asyncio.wait_for(future.result(), limit)
            answered = True
            return found
        except Exception as error:
            if future.status == "error" and type(error).__name__ != "KilledWorker":
                raise RefusedError(f"it fails: {_first_line(error)}") from error
            if isinstance(error, asyncio.TimeoutError):
                raise RefusedError(f"it has not answered for {limit:.0f} s") from error
            raise GoneError from error
        finally:
            # What runs there for nobody ends.
            if not answered and self.client.status == "running":
                with contextlib.suppress(Exception):
                    await self.client.cancel([future], force=True)


async def _ended(task: asyncio.Task[None]) -> None:
    """End a coroutine; raise what it has raised."""
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
