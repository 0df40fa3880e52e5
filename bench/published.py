"""Reading tables that were published."""

from __future__ import annotations

import io
import itertools
from pathlib import Path

import pandas as pd

from latticebench.systems.errors import InputError


def read_table(path: Path) -> pd.DataFrame:
    """Read a published table, every cell as text.

    Raises:
        InputError: it is no CSV file.
    """
    try:
        text = path.read_text(encoding="utf-8").splitlines(keepends=True)
        # The head is provenance; a sharp sign further down is part of a cell.
        body = itertools.dropwhile(lambda line: line.startswith("#"), text)
        return pd.read_csv(io.StringIO("".join(body)), dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a table: {error}") from None
