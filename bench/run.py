"""The runner: the cases of a suite that have no result yet, by whatever executor, each result kept at once."""

from __future__ import annotations

import itertools
import json
import logging
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, Protocol

from latticebench import methods
from latticebench.bench import source
from latticebench.bench.case import Case
from latticebench.bench.executors.executor import Executor
from latticebench.bench.executors.local import Local
from latticebench.bench.leases import Leases
from latticebench.bench.pool import Turn
from latticebench.bench.presence import Presence
from latticebench.bench.store import WHOLE, Results, Shard, Store
from latticebench.bench.suite import Suite
from latticebench.bench.worker import MAX_REASON, one_line
from latticebench.methods.method import make

log = logging.getLogger(__name__)


class Watcher(Protocol):
    """What a progress display is told."""

    def count(self, left: int) -> None:
        """Learn how many cases are to be run."""

    def started(self, case: Case) -> None:
        """Learn that a case has been handed to a worker."""

    def finished(self, case: Case, result: dict[str, Any]) -> None:
        """Learn that the result of a case is kept."""

    def found(self) -> None:
        """Learn that another run on the same store has finished a case in the meantime."""


@dataclass
class Tally:
    """What a run did: how many cases were there before, were run, and ended with which status."""

    reused: int = 0
    ran: int = 0
    statuses: dict[str, int] = field(default_factory=dict)


def run(
    suite: Suite,
    store: Store,
    *,
    jobs: int = 1,
    executor: Executor | None = None,
    retry: bool = False,
    shard: Shard = WHOLE,
    watcher: Watcher | None = None,
    about: Mapping[str, Any] | None = None,
) -> tuple[Results, Tally]:
    """Run the cases of a suite that have no result yet.

    Args:
        suite: what to run.
        store: where results are kept; one that is there is used again.
        jobs: worker processes of this machine.
        executor: what runs the cases instead of them.
        retry: run failed cases again.
        shard: the part of the suite to run.
        watcher: is told of every case.
        about: the command and what else to write down of the run.

    Returns:
        the results of the shard in the order of the suite, and what was done.

    Raises:
        InputError: a result cannot be written, or the executor cannot work.
        KeyboardInterrupt: the user stopped the run; finished cases are in the store.
    """
    keys = source.keys(suite.by_identity, suite.folders)
    store.plan(keys, about or {})
    before = store.finished()
    wanted = dict(itertools.islice(zip(keys.values(), suite.cases, strict=True), shard.first - 1, None, shard.step))
    waiting = [case for key, case in wanted.items() if key not in before or not counts(case, *before[key], retry)]
    tally = Tally(reused=len(wanted) - len(waiting))
    log.info("%d of %d cases to run, kept in %s", len(waiting), len(wanted), store.path)
    if watcher is not None:
        watcher.count(len(waiting))
    if waiting:
        leases = Leases(store)
        presence = Presence(store, leases.owner, left=len(waiting))
        ledger = _Ledger(store, leases, presence, keys, before, retry, tally, watcher)
        try:
            (executor or Local(jobs)).execute(waiting, suite.folders, _loads(suite), ledger)
        finally:
            leases.give_back()
            presence.leave()
    store.forget_replaced()
    store.relabel(_renamed(wanted, store.finished() if waiting else before))
    tally.statuses = store.statuses(shard)
    return store.results(shard), tally


@dataclass(frozen=True)
class _Ledger:
    """What an executor asks and tells; see `bench.executors.executor.Ledger`."""

    store: Store
    leases: Leases
    presence: Presence
    keys: Mapping[str, str]
    before: Mapping[str, tuple[str, str]]
    retry: bool
    tally: Tally
    watcher: Watcher | None

    def begin(self, case: Case, where: str = "") -> Turn:
        """Take the lease of a case, and say whether another run has it, or has finished it in the meantime."""
        key = self.keys[case.identity]
        if not self.leases.take(key):
            return "later"
        for found in self.store.finished(key).values():
            if counts(case, *found, self.retry) or self.before.get(key) != found:
                self.leases.give_back(key)
                self.tally.reused += 1
                self.presence.found()
                if self.watcher is not None:
                    self.watcher.found()
                return "done"
        log.debug("%s: begins%s", case.title, f" at {where}" if where else "")
        self.presence.started(case, where)
        if self.watcher is not None:
            self.watcher.started(case)
        return "run"

    def keep(self, case: Case, result: dict[str, Any], made: Mapping[str, Any]) -> None:
        """Keep a result; its lease ends with it."""
        self.store.put(self.keys[case.identity], case, result, made)
        self.tally.ran += 1
        good = result["status"] in ("ok", "skipped")
        log.log(
            logging.INFO if good else logging.WARNING, "%s: %s %s", case.title, result["status"],
            one_line(str(result["reason"]), MAX_REASON),
        )  # fmt: skip
        self.presence.finished(case, result)
        if self.watcher is not None:
            self.watcher.finished(case, result)

    def pulse(self) -> None:
        """Renew the leases, and tell other shells how far the run is."""
        self.leases.renew()
        self.presence.tell()

    def together(self) -> AbstractContextManager[object]:
        """Write all that the block does at once."""
        return self.store.writing()


def _renamed(cases: Mapping[str, Case], finished: Mapping[str, tuple[str, str]]) -> dict[str, Case]:
    """Return the cases whose result is stored under another label or limit."""
    return {key: one for key, one in cases.items() if key in finished and finished[key][1] != one.model_dump_json()}


def _loads(suite: Suite) -> set[str]:
    """Return the packages that the methods of this package load for a suite; a user's code is run by workers alone."""
    known = methods.registered()
    return {
        package
        for one in suite.contestants.values()
        if one.method in known
        for package in make(known[one.method], one.settings).abilities.loads
    }


def counts(case: Case, status: str, text: str, retry: bool) -> bool:
    """Return whether a result counts: not a failure to retry, nor a limit that has been raised since.

    Args:
        case: as it is to be run.
        status: of the result.
        text: the case that it is of, as JSON.
        retry: failures do not count.
    """
    if status not in ("timeout", "memory"):
        return not (retry and status in ("failed", "died"))
    limit = "time_limit" if status == "timeout" else "memory_limit"
    try:
        return not retry and bool(getattr(case, limit) <= json.loads(text)[limit])
    except (ValueError, TypeError, LookupError, RecursionError):
        # The store is damaged: the case is run again.
        return False
