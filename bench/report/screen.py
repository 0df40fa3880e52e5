"""What a run and its results look like on a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from latticebench.bench.report import rows
from latticebench.bench.report.mathematics import written
from latticebench.bench.report.units import UNKNOWN, Units, in_words
from latticebench.systems.errors import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text as RichText

    from latticebench.bench.adequacy import Adequacy
    from latticebench.bench.limit import Design, Limit
    from latticebench.methods.method import Fit

# Lines of what is said of a bound's noise, at most.
MOST_LINES = 10
# Characters between two columns of a table, and those that a column of names keeps where there is little room.
GAP, NARROW = 3, 16
# Seconds between two lines of a log that say what is being done.
LINE_EVERY = 20.0
MEANINGS = {"e2": "relative error of the coefficients, median over seeds"}
SPREAD_MEANS = "; [10 %, 90 %] of n seeds, of at most five the least and the largest"


def console() -> Console:
    """Return the console that results are printed on."""
    from rich.console import Console

    class Screen(Console):
        def on_broken_pipe(self) -> None:
            """Let the program end as it does when the reader of a plain print stops reading."""
            raise BrokenPipeError

    # A pipe has no width: let nothing be cut off there.
    return Screen() if sys.stdout.isatty() else Screen(width=200)


def show_rows(columns: Sequence[str], cells: Sequence[Sequence[Any]], keys: int = 0) -> None:
    """Print a table; lists and dictionaries within a cell are written out.

    Args:
        columns: their names.
        cells: of each row.
        keys: how many columns say what a row is. With them, a table that is wider than the screen is printed in parts.
    """
    from rich import box
    from rich.table import Table

    screen = console()
    heads, body = [str(name) for name in columns], [[_text(value) for value in row] for row in cells]
    for part in _parts(heads, body, keys, screen.width):
        table = Table(box=box.SIMPLE_HEAD)
        for column in part:
            # Names are broken before numbers are.
            table.add_column(_shown(heads[column]), overflow="fold", no_wrap=0 < keys <= column and len(part) > keys)
        for row in body:
            table.add_row(*(_shown(row[column]) for column in part))
        screen.print(table)


def _parts(heads: Sequence[str], body: Sequence[Sequence[str]], keys: int, width: int) -> list[list[int]]:
    """Return which columns stand beside each other: all, or with keys as many of the others as there is room for."""
    from rich.cells import cell_len

    longest = [max(cell_len(line) for row in (heads, *body) for line in row[k].split("\n")) for k in range(len(heads))]
    room = width - GAP * (keys + 1) - sum(min(one, NARROW) for one in longest[:keys])
    parts: list[list[int]] = [[]]
    used = 0
    for column in range(keys, len(heads)):
        used += longest[column] + GAP
        if keys and parts[-1] and used > room:
            parts.append([])
            used = longest[column] + GAP
        parts[-1].append(column)
    return [[*range(keys), *part] for part in parts]


def _shown(text: str) -> RichText:
    """Return a text as it is, whatever markup it looks like."""
    from rich.text import Text

    return Text("\n".join(map(printable, text.split("\n"))))


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name}={entry}" for name, entry in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(str(entry) for entry in value)
    return str(value)


def show_warnings(warnings: Sequence[str]) -> None:
    """Print what is wrong with a result, before it."""
    for line in warnings:
        stop = "" if line.endswith("?") else "."
        console().print(f"Warning: {line}{stop}", style="bold red", highlight=False, markup=False, soft_wrap=True)


def show_fit(fit: Fit, quality: Adequacy | None = None, units: Units = UNKNOWN) -> None:
    """Print a fit: what is wrong with it, its coefficients, its equation, and what it leaves."""
    if quality is not None:
        show_warnings(quality.warnings)
    show_rows(*rows.fitted(fit, units))
    left = (
        ""
        if fit.residual != fit.residual
        else f"; {100 * fit.residual:.3g} % of {'the readings' if fit.motion else 'the derivative'} is left, "
        "its noise included"
    )
    state = fit.status if quality is None else quality.state(fit.status)
    lines = [written(fit), f"{fit.method}: {state}{left}; {fit.seconds:.2f} s"]
    if told := in_words(units):
        lines.append(f"units: {told}")
    if quality is not None:
        lines.append(quality.in_words)
    for line in lines:
        console().print(printable(line), highlight=False, markup=False, soft_wrap=True)


def show_limit(
    limit: Limit, design: Design, note: str, warnings: Sequence[str] = (), units: Sequence[str] = ()
) -> None:
    """Print a bound: warnings, each coefficient with its smallest error and a verdict, and what more would need."""
    show_warnings(warnings)
    columns = ["term", "coefficient", "smallest error", "verdict, if it fitted" if warnings else "verdict"]
    every = zip(limit.library.texts, limit.coefficients, limit.stderr, limit.verdicts, strict=True)
    cells = [[text, f"{value:.6g}", f"{error:.2g}", verdict] for text, value, error, verdict in every]
    if units:
        columns.insert(3, "unit")
        cells = [[*row[:3], unit, *row[3:]] for row, unit in zip(cells, units, strict=True)]
    show_rows(columns, cells)
    wanted = f"{100 * design.target:.3g} %"
    for group in limit.groups:
        listed = "; ".join(limit.library.texts[k] for k in group)
        console().print(f"Hard to tell apart: {listed}", highlight=False, markup=False, soft_wrap=True)
    told = note.splitlines()
    if len(told) > MOST_LINES:
        told = [*told[: MOST_LINES - 1], f"... and {len(told) - MOST_LINES + 1} lines more, in the JSON"]
    state = (
        f"{chr(10).join(told)}\n{limit.samples} samples, noise level {limit.noise:.3g}; the terms' conditioning is "
        f"{limit.conditioning:.2g}"
    )
    if not warnings:
        state += f"\nAll coefficients together can be known to {100 * limit.relative:.2g} % (root-mean-square of E2)."
    if warnings:
        text = "How well all can be known, and what more readings would bring, is told of an equation that fits."
    elif design.relative <= design.target:
        text = f"{wanted} is within reach as things are, up to a noise level of {design.noise:.2g}."
    else:
        options = [f"a noise level of {design.noise:.2g}"]
        if design.samples is not None:
            options.append(f"{design.samples} samples in the same time")
        if design.span is not None:
            options.append(f"a record of length {design.span:.3g} with as many samples per time")
        options.append(f"{design.records} records like this one")
        text = f"{wanted} would need {', or '.join(options)}."
    for line in (state, text):
        console().print(line, highlight=False, markup=False, soft_wrap=True)


def show_results(results: Iterable[Mapping[str, Any]], value: str = "e2", *, spread: bool = True) -> None:
    """Print the results of fits: one score by data and method, and what went wrong."""
    from latticebench.bench.publish import matrix
    from latticebench.bench.tables import ABOUT, cases

    every = cases(results)
    screen = console()
    arranged = matrix(every, value, spread=spread)
    show_rows(
        list(arranged.columns), arranged.to_numpy().tolist(), keys=sum(name in ABOUT for name in arranged.columns)
    )
    for _, row in every[~every["status"].isin(["ok", "skipped"])].iterrows():
        place = f"{row['data']} | {row['library']} | {row['method']} | seed {row['seed']}"
        screen.print(
            printable(f"{row['status']}: {place}: {row['reason']}"), style="red", highlight=False, markup=False
        )
    show_note(f"{value}: {MEANINGS.get(value, 'median over seeds')}{SPREAD_MEANS if spread else ''}")


def show_note(line: str) -> None:
    """Print a line about what was shown."""
    console().print(line, style="dim", highlight=False, markup=False)


@contextmanager
def waiting(text: str) -> Iterator[None]:
    """Show what is being waited for, on a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(text):
        yield


@contextmanager
def watching() -> Iterator[Callable[[str], None]]:
    """Show on standard error what is being done and for how long; the function takes the text.

    A terminal shows a bar that moves; a log gets a line now and then, and none of what is done before the first.
    """
    if not sys.stderr.isatty():
        yield _now_and_then(time.monotonic())
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    # How many effects will be fitted is not known beforehand: the bar only moves.
    columns = (BarColumn(bar_width=24), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("starting", total=None)
        yield lambda text: progress.update(task, description=escape(text))


def _now_and_then(start: float) -> Callable[[str], None]:
    """Return what writes a text to standard error if the last one, or the start, was `LINE_EVERY` seconds ago."""
    last = start

    def tell(text: str) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= LINE_EVERY:
            last = now
            sys.stderr.write(f"after {now - start:.0f} s: {printable(text)}\n")
            sys.stderr.flush()

    return tell


@contextmanager
def progress(total: int) -> Iterator[Callable[[], None]]:
    """Show on standard error how many of `total` pieces of work are done; calling the function counts one more."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    columns = (BarColumn(bar_width=24), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=total)
        yield lambda: bar.advance(task)
