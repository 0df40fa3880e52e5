"""What runs cases, and what it asks and tells the run that it works for."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol

from latticebench.bench.case import Case, Folders
from latticebench.bench.pool import Turn


class Ledger(Protocol):
    """The run's side: it holds the store, which alone says what is finished."""

    def begin(self, case: Case, where: str = "") -> Turn:
        """Say whether a case is to be run now.

        Args:
            case: the case, as it is about to begin.
            where: the worker that it is for; empty for this machine.
        """

    def keep(self, case: Case, result: dict[str, Any], made: Mapping[str, Any]) -> None:
        """Keep a result; `made` describes what computed it, see `bench.provenance.origin`."""

    def pulse(self) -> None:
        """Do what is due; to be called every second or so."""

    def together(self) -> AbstractContextManager[object]:
        """Write what the block asks and tells at once, or nothing of it where it fails."""


class Executor(Protocol):
    """Runs cases."""

    @property
    def about(self) -> dict[str, Any]:
        """What is written down of it with the run."""

    def execute(self, cases: Sequence[Case], folders: Folders, loads: Collection[str], ledger: Ledger) -> None:
        """Run cases, and keep each result.

        Args:
            cases: in the order of their suite.
            folders: where relative paths start from.
            loads: packages that the methods load.
            ledger: what is asked and told.
        """
