"""Reading tables that were published."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pandas as pd

from latticebench.bench.escape import csv_text
from latticebench.systems.errors import InputError, printable
from latticebench.systems.files import DATA, read_text, shown


def folder_of(name: str) -> Path:
    """Return the folder of published results of a name in a copy of this project's repository; it may not exist."""
    return Path(__file__).resolve().parents[1] / "results" / name


def without_results() -> str:
    """Return what to know of published runs where none are there, a part of a sentence; empty where some are."""
    if folder_of("").is_dir():
        return ""
    return "; published runs are in results/ of the project's repository, which no package has: give their path"


def read_head(path: Path) -> dict[str, str]:
    """Return the provenance in the head of a published table, by name; empty where there is none.

    Raises:
        InputError: it cannot be read.
    """
    head = itertools.takewhile(lambda line: line.startswith("# "), read_text(path, DATA).splitlines())
    return {name: value for line in head for name, _, value in [line[2:].partition(": ")]}


def read_rows(path: Path) -> tuple[list[str], list[str], list[list[str]]]:
    """Read a published table: the lines of its head, the names of its columns, and the cells of its rows.

    Raises:
        InputError: it is no CSV file, cannot be read, or a row is shorter or longer than the header.
    """
    text = read_text(path, DATA).removeprefix("\ufeff").splitlines(keepends=True)
    # The head is provenance; a sharp sign further down is part of a cell.
    head = list(itertools.takewhile(lambda line: line.startswith("#"), text))
    try:
        rows = [list(map(csv_text, row)) for row in csv.reader(io.StringIO("".join(text[len(head) :])), strict=True)]
    except csv.Error as error:
        raise InputError(f"{shown(path)}: not a table: {error}") from None
    # One column without a name is what pandas makes of the index.
    if not rows or not any(rows[0]):
        raise InputError(f"{shown(path)}: not a table: the names of its columns are missing")
    columns = rows.pop(0)
    if twice := [name for name in columns if columns.count(name) > 1]:
        raise InputError(f"{shown(path)}: not a table: two columns are called {printable(twice[0])!r}")
    for number, row in enumerate(rows, 1):
        if len(row) != len(columns):
            raise InputError(
                f"{shown(path)}: row {number}: {len(row)} cells under {len(columns)} columns; publish the table again"
            )
    return head, columns, rows


def read_table(path: Path, numbers: Collection[str] = ()) -> pd.DataFrame:
    """Read a published table, every cell as text.

    Args:
        path: the file.
        numbers: columns that hold numbers, if they are there: an empty cell becomes NaN.

    Raises:
        InputError: it is no table, see `read_rows`, or a cell that should hold a number holds another text.
    """
    _, columns, rows = read_rows(path)
    table = pd.DataFrame(rows, columns=columns, dtype=str)
    for name in columns:
        if name in numbers:
            found = pd.to_numeric(table[name], errors="coerce")
            odd = found.isna() & ~table[name].str.lower().isin(["", "nan"])
            if odd.any():
                row = int(np.argmax(odd))
                raise InputError(
                    f"{shown(path)}: row {row + 1}, column {name}: {table[name][row]!r} is no number; publish it again"
                )
            table[name] = found
    return table
