"""Reading tables that were published."""

from __future__ import annotations

import io
import itertools
from pathlib import Path

import pandas as pd

from latticebench.bench.escape import csv_text
from latticebench.systems.errors import InputError
from latticebench.systems.files import DATA, read_text, shown


def folder_of(name: str) -> Path:
    """Return the folder of published results of a name in a copy of this project's repository; it may not exist."""
    return Path(__file__).resolve().parents[1] / "results" / name


def read_head(path: Path) -> dict[str, str]:
    """Return the provenance in the head of a published table, by name; empty where there is none.

    Raises:
        InputError: it cannot be read.
    """
    head = itertools.takewhile(lambda line: line.startswith("# "), read_text(path, DATA).splitlines())
    return {name: value for line in head for name, _, value in [line[2:].partition(": ")]}


def read_table(path: Path) -> pd.DataFrame:
    """Read a published table, every cell as text.

    Raises:
        InputError: it is no CSV file, or cannot be read.
    """
    try:
        text = read_text(path, DATA).splitlines(keepends=True)
        # The head is provenance; a sharp sign further down is part of a cell.
        body = itertools.dropwhile(lambda line: line.startswith("#"), text)
        return pd.read_csv(io.StringIO("".join(body)), dtype=str, keep_default_na=False).map(csv_text)
    except InputError:
        raise
    except (ValueError, OverflowError) as error:
        raise InputError(f"{shown(path)}: not a table: {str(error).strip()}") from None
