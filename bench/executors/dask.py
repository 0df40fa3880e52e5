"""Cases on the workers of a Dask scheduler.

    executor -> crew: one coroutine for each worker -> station: one process at each worker

The store stays with the client, and nothing but users' files, cases and results travels.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from latticebench.bench.case import Case, Folders
from latticebench.bench.executors.batches import Batches
from latticebench.bench.executors.cluster import Connection
from latticebench.bench.executors.crew import Crew
from latticebench.bench.executors.executor import Ledger
from latticebench.systems.errors import InputError, printable


@dataclass(frozen=True)
class Dask:
    """Runs cases on the workers of a scheduler.

    Attributes:
        connection: the way to it.
        alike: refuse workers whose processor is another than that of the first.
        seconds: what cases took in earlier runs, by their identities.
        patience: seconds to wait for the scheduler's first answer.
    """

    connection: Connection
    alike: bool = False
    seconds: Mapping[str, float] = field(default_factory=dict)
    patience: float = 30.0

    @property
    def about(self) -> dict[str, Any]:
        """What kind of executor it is."""
        return {"executor": "dask"}

    def execute(self, cases: Sequence[Case], folders: Folders, loads: Collection[str], ledger: Ledger) -> None:
        """Run cases; see `Executor.execute`.

        Raises:
            InputError: no worker can be used, the scheduler is gone, or a result cannot be kept.
        """
        asyncio.run(self._execute(cases, folders, loads, ledger))

    async def _execute(self, cases: Sequence[Case], folders: Folders, loads: Collection[str], ledger: Ledger) -> None:
        from distributed import Client

        try:
            client = await Client(
                self.connection.address, security=self.connection.security, asynchronous=True, timeout=self.patience
            )
        except (OSError, TypeError, ValueError, asyncio.TimeoutError) as error:
            raise InputError(f"{self.connection.address}: no scheduler answers there: {error}") from None
        async with client:
            crew = Crew(client, Batches.of(cases, self.seconds), ledger, alike=self.alike, tell=_tell)
            crew.pack(cases, folders, loads)
            await crew.run()


def _tell(line: str) -> None:
    print(printable(line), file=sys.stderr)
