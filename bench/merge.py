"""Merging stores: the results of shards, or of several choices of a suite, as if one run had made them."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from latticebench.bench.store import CHOOSE, FILE, Store, create, open_store
from latticebench.systems.errors import InputError
from latticebench.systems.files import shown

COLUMNS = 'results.key, results.identity, kind, "case", status, reason, seed, origins.origin, content, history'
# The seed and the history.
OPTIONAL = (6, 9)


def merge(folders: Sequence[Path], out: Path) -> tuple[int, int]:
    """Write the results of several stores, each of the suite that was run last in it, into a new one.

    A case that several have is taken from the first in which it ended with a fit, else from the first.

    Args:
        folders: of the stores.
        out: a folder that does not exist, or is empty.

    Returns:
        how many results there are, and how many cases of the suite have none.

    Raises:
        InputError: a store cannot be read, they are of different suites, one case was computed by different code, or
            the new one cannot be written.
    """
    stores = [open_store(folder) for folder in folders]
    about = _about(stores)
    plan = _plan(stores)
    rows = _rows(stores)
    _check_code(rows)
    if os.path.exists(out) and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{shown(out)}: it exists and is not empty; choose another place with --out")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=".merge-") as made:
            store = create(Path(made) / "store")
            store.fill(plan, about, rows.values())
            # Closing it moves its journal into the file.
            store.connection.close()
            out.mkdir(exist_ok=True)
            os.replace(Path(made) / "store" / FILE, out / FILE)
    except OSError as error:
        raise InputError(f"{shown(out)}: {error.strerror}; {CHOOSE.replace('--results', '--out')}") from None
    return len(rows), len(plan) - len(rows)


def _about(stores: Sequence[Store]) -> dict[str, Any]:
    """Return what was written down of all runs: where they differ, every text once."""
    found: dict[str, list[Any]] = {}
    for store in stores:
        for name, value in store.about().items():
            kept = found.setdefault(name, [])
            if value not in kept:
                kept.append(value)
    suites = found.get("suite", [])
    if len(suites) > 1:
        raise InputError(f"results of different suites cannot be merged: {' and '.join(map(str, suites))}")
    return {name: _together(values) for name, values in found.items()}


def _together(values: Sequence[Any]) -> Any:
    if len(values) == 1:
        return values[0]
    if all(isinstance(value, Mapping) for value in values):
        return {key: entry for value in values for key, entry in value.items()}
    return "; ".join(str(value) for value in values if value != "")


def _plan(stores: Sequence[Store]) -> list[str]:
    """Return the keys of all cases in the order of the suite: that of the first store, then what only others have."""
    keys = (key for store in stores for (key,) in _texts(store, "SELECT key FROM suite ORDER BY place"))
    return list(dict.fromkeys(keys))


def _texts(store: Store, query: str, optional: Sequence[int] = ()) -> Iterator[tuple[Any, ...]]:
    """Ask a store for rows of texts, but for the optional columns.

    Raises:
        InputError: something else is there: told of this store, before it is in the new one.
    """
    for row in store.read(query):
        with store.sound():
            if not all(isinstance(one, str) for number, one in enumerate(row) if number not in optional):
                raise TypeError("what must be a text is none")
        yield row


def _rows(stores: Sequence[Store]) -> dict[str, tuple[Any, ...]]:
    """Return the results of all stores by their keys."""
    found: dict[str, tuple[Any, ...]] = {}
    query = (
        f"SELECT {COLUMNS} FROM suite JOIN results USING (key) JOIN origins ON origins.number = results.origin "
        "ORDER BY place"
    )
    for store in stores:
        for row in _texts(store, query, OPTIONAL):
            if row[0] not in found or (found[row[0]][4] != "ok" and row[4] == "ok"):
                found[row[0]] = row
    return found


def _check_code(rows: Mapping[str, tuple[Any, ...]]) -> None:
    """Refuse results of one case by different code.

    Raises:
        InputError: there are such results.
    """
    keys: dict[str, str] = {}
    for key, identity, *_ in rows.values():
        if keys.setdefault(identity, key) != key:
            raise InputError(
                f"the case {identity} was computed by different code in two of the stores; run the suite again in one"
            )
