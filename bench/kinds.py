"""The kinds of cases: the one place that knows what each kind's results are shown, published, drawn and compared by.

Modules are imported when a kind is asked for: a suite of fits needs nothing of the diagnosis, and the other way round.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from latticebench.bench.provenance import describe, lines
from latticebench.bench.store import WHOLE, Shard, Store
from latticebench.systems.errors import InputError, printable, unknown

if TYPE_CHECKING:
    import pandas as pd

    from latticebench.bench.beside import Published
    from latticebench.bench.store import Results

    Publisher = Callable[["Results", Mapping[str, Any], Path, Sequence[str]], list[Path]]


@dataclass(frozen=True)
class Kind:
    """What is made of the results of one kind of case.

    Attributes:
        tables, figures: names that can be asked for.
        table: one row per case.
        show: print results on the screen: results, and which score.
        publish: write tables: results, their description, the folder, and which tables.
        draw: the same of figures.
    """

    tables: Sequence[str]
    figures: Sequence[str]
    table: Callable[[Iterable[Mapping[str, Any]]], pd.DataFrame]
    show: Callable[[Results, str], None]
    publish: Publisher
    draw: Publisher


def _fit(beside: Published | None = None, *, spread: bool = True) -> Kind:
    from latticebench.bench import figures, publish
    from latticebench.bench.report.screen import show_results
    from latticebench.bench.tables import cases

    if beside is None:
        return Kind(
            publish.TABLES, figures.FIGURES, cases, functools.partial(show_results, spread=spread), publish.publish,
            figures.draw_all,
        )  # fmt: skip

    def table(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
        return beside.joined(cases(results))

    def show(results: Iterable[Mapping[str, Any]], value: str) -> None:
        from latticebench.bench.report.screen import show_note, show_rows
        from latticebench.bench.tables import ABOUT

        arranged = publish.matrix(table(results), value, spread=spread)
        keys = sum(name in ABOUT for name in arranged.columns)
        show_rows(list(arranged.columns), arranged.to_numpy().tolist(), keys)
        show_note(f"{value}: median over seeds; {beside.mark} published: {beside.about}")

    return Kind(
        publish.TABLES, figures.FIGURES, table, show, functools.partial(publish.publish, beside=beside),
        functools.partial(figures.draw_all, beside=beside),
    )  # fmt: skip


def _trial() -> Kind:
    from latticebench.bench.trials import scores

    return Kind(scores.TABLES, scores.FIGURES, scores.table, scores.show, scores.publish, scores.draw_all)


def _measured() -> Kind:
    from latticebench.bench.trials import recorded as found

    return Kind(found.TABLES, found.FIGURES, found.table, found.show, found.publish, found.draw_all)


def _laboratory() -> Kind:
    from latticebench.bench.trials.laboratory import tables

    return Kind(tables.TABLES, tables.FIGURES, tables.table, tables.show, tables.publish, tables.draw_all)


KINDS: Mapping[str, Callable[[], Kind]] = {
    "fit": _fit, "trial": _trial, "laboratory": _laboratory, "measured": _measured,
}  # fmt: skip


def each(
    store: Store,
    shard: Shard = WHOLE,
    *,
    history: bool = False,
    beside: Published | None = None,
    spread: bool = True,
) -> Iterator[tuple[str, Kind, Results, dict[str, Any]]]:
    """Return each kind that a store has: its name, the kind, its results, and their description.

    Raises:
        InputError: the store has no results yet; or none of fits, beside which published ones are to be put.
    """
    names = store.kinds()
    if beside is not None and "fit" not in names:
        raise InputError(f"{store.path.parent}: there are no fits in it to put beside {beside.about}")
    if not names:
        folder = store.path.parent
        raise InputError(f"{folder}: there are no results in it yet; run a suite with --results {folder}")
    with store.sound():
        about = describe(store.origins(), store.about(), store.seeds())
    for name in names:
        if name not in KINDS:
            raise InputError(f"{store.path}: it has cases of kind {name!r}, which this latticebench does not know")
        kind = _fit(beside, spread=spread) if name == "fit" else KINDS[name]()
        yield name, kind, store.results(shard, name, history=history), about


def show(
    store: Store,
    title: str = "",
    value: str = "e2",
    shard: Shard = WHOLE,
    beside: Published | None = None,
    *,
    spread: bool = True,
) -> None:
    """Print the results of a store, and where they come from; those of fits beside published ones.

    Args:
        store: the results.
        title: what stands above them.
        value: which score of fits.
        shard: which part of the store.
        beside: what was published of the fits.
        spread: whether quantiles over the seeds and their number follow a median.
    """
    from latticebench.bench.report.screen import console, show_note

    found = list(each(store, shard, beside=beside, spread=spread))
    if title:
        console().print(printable(title), style="bold", highlight=False, markup=False)
    with store.sound():
        for _, kind, results, _ in found:
            kind.show(results, value)
        for line in lines(found[0][3]):
            show_note(line)
        if others := store.others():
            show_note(f"of other cases, which were run here before: {others}; the same run again shows them")


def rows(store: Store, shard: Shard = WHOLE, beside: Published | None = None) -> list[dict[str, Any]]:
    """Return one row per case, the kinds one after the other; fits with published ones of the same cases."""
    with store.sound():
        found = [kind.table(results) for _, kind, results, _ in each(store, shard, beside=beside)]
    return [{str(name): value for name, value in row.items()} for frame in found for row in frame.to_dict("records")]


def publish(
    store: Store, folder: Path, only: Sequence[str] | None = None, beside: Published | None = None
) -> list[Path]:
    """Write the tables of a store, or those named; each kind's in a folder of its own where there are several.

    Args:
        store: the results.
        folder: where to write.
        only: names of tables.
        beside: what was published of the fits.

    Raises:
        InputError: the store has no results yet, or a file cannot be written.
    """
    several = len(store.kinds()) > 1
    with store.sound():
        return [
            path
            for name, kind, results, about in each(store, beside=beside)
            for path in kind.publish(results, about, folder / name if several else folder, _chosen(only, kind.tables))
        ]


def draw(store: Store, folder: Path, only: Sequence[str] | None = None, beside: Published | None = None) -> list[Path]:
    """Draw the figures of a store, or those named; each kind's in a folder of its own where there are several.

    Args:
        store: the results.
        folder: where to write.
        only: names of figures.
        beside: what was published of the fits.

    Raises:
        InputError: the store has no results yet, or a file cannot be written.
    """
    several = len(store.kinds()) > 1
    with store.sound():
        return [
            path
            for name, kind, results, about in each(store, history=True, beside=beside)
            for path in kind.draw(results, about, folder / name if several else folder, _chosen(only, kind.figures))
        ]


def check_tables(only: Sequence[str] | None) -> None:
    """Make sure that tables exist.

    Raises:
        InputError: no kind has a table of such a name.
    """
    _check(only, "table", lambda kind: kind.tables)


def check_figures(only: Sequence[str] | None) -> None:
    """Make sure that figures exist.

    Raises:
        InputError: no kind has a figure of such a name.
    """
    _check(only, "figure", lambda kind: kind.figures)


def _check(only: Sequence[str] | None, what: str, names: Callable[[Kind], Sequence[str]]) -> None:
    for name in only or ():
        known = list(dict.fromkeys(one for kind in KINDS.values() for one in names(kind())))
        if name not in known:
            raise unknown(what, name, known, "--only")


def _chosen(only: Sequence[str] | None, names: Sequence[str]) -> Sequence[str]:
    return [name for name in names if not only or name in only]
