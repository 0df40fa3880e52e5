"""Leases: which run is on which case, so that two runs on one folder share the work.

A lease is a row of the store's file. It ends when the result is kept, when the run that has it ends (a process that is
gone holds none), and when it has not been renewed for a while.
"""

from __future__ import annotations

import functools
import os
import platform
import time
import uuid
from dataclasses import dataclass, field

import psutil

from latticebench.bench.store import Store

# Seconds until a lease that nobody renews is over, and between two renewals.
LASTS = 60.0
RENEWED = 10.0


@functools.cache
def _self() -> str:
    return f"{platform.node()} {os.getpid()} {psutil.Process().create_time():.2f}"


@dataclass
class Leases:
    """What one run holds of a store.

    Attributes:
        store: where.
        owner: the machine, the process, and the run.
    """

    store: Store
    owner: str = field(default_factory=lambda: f"{_self()} {uuid.uuid4().hex}")
    renewed: float = field(default_factory=time.monotonic)

    def take(self, key: str) -> bool:
        """Take the lease of a case, unless another run has it; return whether it is taken.

        Raises:
            InputError: the store cannot be written.
        """
        with self.store.writing(durable=False) as cursor:
            held = cursor.execute("SELECT owner, until FROM leases WHERE key = ?", (key,)).fetchone()
            if held is not None and held[0] != self.owner and _lasts(held[1]) and not is_gone(held[0]):
                return False
            cursor.execute("INSERT OR REPLACE INTO leases VALUES (?, ?, ?)", (key, self.owner, time.time() + LASTS))
        return True

    def renew(self) -> None:
        """Renew all leases, where it is time to."""
        if time.monotonic() - self.renewed > RENEWED:
            self.renewed = time.monotonic()
            with self.store.writing(durable=False) as cursor:
                cursor.execute("UPDATE leases SET until = ? WHERE owner = ?", (time.time() + LASTS, self.owner))

    def give_back(self, key: str = "%") -> None:
        """Give the lease of a case back; all of them if not given."""
        with self.store.writing(durable=False) as cursor:
            cursor.execute("DELETE FROM leases WHERE key LIKE ? AND owner = ?", (key, self.owner))


def _lasts(until: object) -> bool:
    """Return whether a lease holds: one from far ahead, of a clock that is wrong or a damaged store, does not."""
    return isinstance(until, (int, float)) and 0 < until - time.time() < 2 * LASTS


def is_gone(owner: str) -> bool:
    """Return whether the process of an owner has ended, as far as one can know: that of another machine has not."""
    node, _, rest = str(owner).rpartition(" ")[0].partition(" ")
    number, _, started = rest.partition(" ")
    if node != platform.node():
        return False
    try:
        return f"{psutil.Process(int(number)).create_time():.2f}" != started
    except (psutil.NoSuchProcess, ValueError, OverflowError):
        return True
    except psutil.Error:
        return False
