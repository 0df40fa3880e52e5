"""Cases in processes of this machine."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from latticebench.bench.case import Case, Folders
from latticebench.bench.executors.executor import Ledger
from latticebench.bench.pool import Pool
from latticebench.bench.provenance import origin


@dataclass(frozen=True)
class Local:
    """Runs cases on so many worker processes."""

    jobs: int

    @property
    def about(self) -> dict[str, Any]:
        """The number of processes."""
        return {"jobs": self.jobs}

    def execute(self, cases: Sequence[Case], folders: Folders, loads: Collection[str], ledger: Ledger) -> None:
        """Run cases; see `Executor.execute`."""
        with Pool(min(self.jobs, len(cases))) as pool:
            pool.start(cases)
            # The workers import meanwhile what they need.
            made = origin(loads)
            pool.run(
                cases, folders, begin=ledger.begin, keep=lambda case, found: ledger.keep(case, found, made),
                pulse=ledger.pulse,
            )  # fmt: skip
