"""What a run on a store is doing, so that another shell can tell: a row of the store's file, written every few seconds.

It is gone with the run. Of one that was killed it stays, and is known by that nobody renews it.
"""

from __future__ import annotations

import json
import platform
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from latticebench.bench.case import Case
from latticebench.bench.leases import LASTS, is_gone
from latticebench.bench.progress import wrong
from latticebench.bench.store import Store

# Seconds between two tellings; how many of the last cases that went wrong are named.
TOLD = 2.0
NAMED = 10
# More cases than any run has.
MOST = 10**12


@dataclass
class Presence:
    """A run's own row.

    Attributes:
        owner: of its leases.
        left: cases that it had to run at its beginning.
        done: those that have their result since.
        running: by their titles, where cases are run, and since when.
        wrong: the last that went wrong, a line each.
    """

    store: Store
    owner: str
    left: int
    done: int = 0
    began: float = field(default_factory=time.time)
    running: dict[str, tuple[str, float]] = field(default_factory=dict)
    wrong: deque[str] = field(default_factory=lambda: deque(maxlen=NAMED))
    told: float = 0.0

    def started(self, case: Case, where: str) -> None:
        """Learn that a case has been handed to a worker."""
        self.running[case.title] = (where or platform.node(), time.time())

    def finished(self, case: Case, result: Mapping[str, Any]) -> None:
        """Learn that a case has its result."""
        if result["status"] not in ("ok", "skipped"):
            self.wrong.append(wrong(case, result))
        self.running.pop(case.title, None)
        self.done += 1

    def found(self) -> None:
        """Learn that another run has finished a case."""
        self.done += 1

    def tell(self) -> None:
        """Write it, where it is time to."""
        if time.monotonic() - self.told > TOLD:
            self.told = time.monotonic()
            content = {name: getattr(self, name) for name in ("left", "done", "began", "running")}
            content["wrong"] = list(self.wrong)
            with self.store.writing(durable=False) as cursor:
                cursor.execute(
                    "INSERT OR REPLACE INTO runs VALUES (?, ?, ?)",
                    (self.owner, time.time() + LASTS, json.dumps(content)),
                )

    def leave(self) -> None:
        """Remove it."""
        with self.store.writing(durable=False) as cursor:
            cursor.execute("DELETE FROM runs WHERE owner = ?", (self.owner,))


@dataclass(frozen=True)
class Running:
    """A run that is on a store now, as it was some seconds ago.

    Attributes:
        machine: where it was started.
        left, done: cases that it had to run at its beginning, and has run.
        seconds: since then.
        cases: the titles of those under way, where they are run, and for how many seconds.
        wrong: the last that went wrong, a line each.
    """

    machine: str
    left: int
    done: int
    seconds: float
    cases: tuple[tuple[str, str, float], ...]
    wrong: tuple[str, ...]

    @property
    def remaining(self) -> float | None:
        """Seconds until it ends, by how fast it has been; None where nothing is known."""
        return self.seconds / self.done * (self.left - self.done) if self.done else None


def running(store: Store) -> list[Running]:
    """Return the runs that are on a store now.

    Raises:
        InputError: what is told of one is damaged.
    """
    # An older store has no such table until it is written to.
    if not list(store.read("SELECT 1 FROM sqlite_schema WHERE name = 'runs'")):
        return []
    found: list[Running] = []
    now = time.time()
    with store.sound():
        for owner, until, text in store.read("SELECT owner, until, content FROM runs"):
            if until > now and not is_gone(owner):
                told = json.loads(text)
                cases = tuple((title, where, _age(now, since)) for title, (where, since) in told["running"].items())
                machine, age = str(owner).partition(" ")[0], _age(now, told["began"])
                # The store may be anybody's.
                left, done = (int(told[name]) for name in ("left", "done"))
                if not (0 <= left <= MOST and 0 <= done <= MOST):
                    raise ValueError(f"{done} of {left} cases")
                found.append(Running(machine, left, done, age, cases, tuple(map(str, told["wrong"]))))
    return found


def _age(now: float, since: float) -> float:
    """Return for how many seconds something has been so, at least a little; clocks of two machines may differ."""
    if not 0 <= since <= 2 * now:
        raise ValueError(f"a time of {since!r}")
    return max(now - since, 0.001)
