"""`latticebench status`: how far a run is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from latticebench.bench.cli.options import place
from latticebench.systems.errors import printable
from latticebench.systems.files import shown

if TYPE_CHECKING:
    from latticebench.bench.presence import Running

EPILOG = "Example:  latticebench status runs/default"
# Cases under way that are named.
MOST_NAMED = 20


def status(
    folder: Annotated[Path, typer.Argument(parser=place, metavar="DIR", help="A store of results.")],
) -> None:
    """Show how far the runs on a store are: what is done, what runs where, what went wrong, and the time that is left.

    It may be asked at any time, from anywhere that sees the folder; nothing of a run is disturbed.
    """
    from latticebench.bench.presence import running
    from latticebench.bench.store import open_store

    store = open_store(folder)
    ((total,),) = store.read("SELECT COUNT(*) FROM suite")
    statuses = store.statuses()
    done = sum(statuses.values())
    told = f" ({', '.join(f'{n} {name}' for name, n in statuses.items())})" if statuses else ""
    print(f"{shown(folder)}: {done} of {total} cases are done{printable(told)}")
    runs = running(store)
    for one in runs:
        _show(one)
    if not runs:
        print("no run is on it now" + ("; the command that began it continues it" if done < total else ""))


def _show(run: Running) -> None:
    from latticebench.bench.progress import clock

    rate = f"{60 * run.done / run.seconds:.3g} a minute" if run.done else "none yet"
    left = f", about {clock(run.remaining)} left" if run.remaining is not None else ""
    print(f"a run from {printable(run.machine)}, {clock(run.seconds)} old: {run.done} of {run.left}, {rate}{left}")
    for title, where, seconds in run.cases[:MOST_NAMED]:
        print(printable(f"  {title} | on {where} for {clock(seconds)}"))
    if len(run.cases) > MOST_NAMED:
        print(f"  and {len(run.cases) - MOST_NAMED} more")
    for line in run.wrong:
        print(printable(f"  {line}"))
