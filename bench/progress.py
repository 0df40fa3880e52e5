"""The progress of a run on standard error: a bar on a terminal, now and then a line elsewhere."""

from __future__ import annotations

import datetime
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from latticebench.systems.errors import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

    from latticebench.bench.case import Case

# Lines of a whole run where there is no terminal: one for each so many parts of it.
PARTS = 20


@dataclass
class Lines:
    """The progress as a log keeps it: a line for every twentieth of the cases, and one for each that went wrong."""

    console: Console
    total: int
    left: int = 0
    done: int = 0
    began: float = field(default_factory=time.monotonic)

    def count(self, left: int) -> None:
        """Set how many cases are left to be run."""
        self.left, self.began = left, time.monotonic()
        if left:
            there = f", {self.total - left} are there" if self.total > left else ""
            self._say(f"{left} of {self.total} cases to run{there}")

    def started(self, case: Case) -> None:
        """Say nothing."""

    def finished(self, case: Case, result: dict[str, Any]) -> None:
        """Say what went wrong with a case, and count it."""
        if result["status"] not in ("ok", "skipped"):
            self._say(wrong(case, result))
        self.found()

    def found(self) -> None:
        """Count a case, and say how far the run is."""
        part = PARTS * self.done // max(self.left, 1)
        self.done += 1
        if PARTS * self.done // max(self.left, 1) > part:
            elapsed = time.monotonic() - self.began
            remaining = elapsed / self.done * (self.left - self.done)
            self._say(
                f"{self.done} of {self.left} cases run ({100 * self.done // self.left} %), {clock(elapsed)} elapsed, "
                f"about {clock(remaining)} remaining"
            )

    def _say(self, line: str) -> None:
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)


class Bar:
    """The progress on a terminal: a bar with what is left, and what is running."""

    def __init__(self, progress: Progress, task: TaskID, total: int) -> None:
        """Draw on `progress`; there are `total` cases in all."""
        self.progress, self.task, self.total = progress, task, total
        self.running: list[str] = []

    def count(self, left: int) -> None:
        """Set how many cases are left to be run."""
        self.progress.update(self.task, total=self.total, completed=self.total - left)

    def started(self, case: Case) -> None:
        """Show a case as running."""
        self.running = [*(title for title in self.running if title != case.title), case.title]
        self._name_running()

    def finished(self, case: Case, result: dict[str, Any]) -> None:
        """Print what went wrong with a case, and count it."""
        self.running = [title for title in self.running if title != case.title]
        if result["status"] not in ("ok", "skipped"):
            self.progress.console.print(wrong(case, result), markup=False, highlight=False, soft_wrap=True)
        self.found()
        self._name_running()

    def found(self) -> None:
        """Count a case."""
        self.progress.advance(self.task)

    def _name_running(self) -> None:
        self.progress.update(self.task, running="   ".join(self.running[:3]))


def wrong(case: Case, result: Mapping[str, Any]) -> str:
    """Return in one line what went wrong with a case."""
    reason = f": {result['reason']}" if result["reason"] else ""
    return printable(f"{result['status']}: {case.title}{reason}")


def clock(seconds: float) -> str:
    """Write a time as hours, minutes and seconds, as a second at least where it is not 0."""
    return str(datetime.timedelta(seconds=max(round(seconds), int(seconds > 0))))


@contextmanager
def progress_of(total: int) -> Iterator[Bar | Lines]:
    """Show a run's progress on standard error while the block lasts; there are `total` cases in all."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TimeRemainingColumn
    from rich.text import Text

    class Running(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(printable(task.fields["running"]), style="dim", overflow="ellipsis", no_wrap=True)

    console = Console(stderr=True)
    if not console.is_terminal:
        yield Lines(console, total)
        return
    columns = (BarColumn(bar_width=24), MofNCompleteColumn(), TimeRemainingColumn(), Running())
    with Progress(*columns, console=console, transient=True) as progress:
        yield Bar(progress, progress.add_task("cases", total=total, running=""), total)
