"""Comparing two tables of cases: what got better, what got worse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from latticebench.systems.errors import InputError

# Round-off differs between machines; errors below this are all the same.
FLOOR = 1e-9
FACTOR = 2.0


@dataclass(frozen=True)
class Comparison:
    """The cases that two tables share, by what became of them: each a table with `case`, `old` and `new`.

    `gone` are cases that only the old table has, `fresh` those that only the new one has.
    """

    worse: pd.DataFrame
    better: pd.DataFrame
    same: int
    gone: list[str]
    fresh: list[str]


def compare(old: pd.DataFrame, new: pd.DataFrame, factor: float = FACTOR, floor: float = FLOOR) -> Comparison:
    """Compare the coefficient errors of the cases that two tables share.

    A case is worse when its E2 (without a truth: its residual) has grown by more than `factor`, both counted as at least
    `floor`, or when it had a fit and has none any more.

    Raises:
        InputError: no case is in both.
    """
    if not set(old["identity"]) & set(new["identity"]):
        raise InputError("the two tables have no case in common; compare runs of the same suite")
    before, after = (table.drop_duplicates("identity").set_index("identity") for table in (old, new))
    worse, better, same = [], [], 0
    for identity in before.index:
        if identity not in after.index:
            continue
        a, b = before.loc[identity], after.loc[identity]
        name = f"{b['data']} | {b['library']} | {b['method']} | seed {b['seed']}"
        error_a, error_b = _error(a, b)
        row = {
            "case": name,
            "old": _shown(a, error_a),
            "new": _shown(b, error_b),
            "ratio": error_b / error_a if error_a else np.nan,
        }
        first, second = max(error_a, floor), max(error_b, floor)
        if second > factor * first:
            worse.append(row)
        elif first > factor * second:
            better.append(row)
        else:
            same += 1
    columns = ["case", "old", "new", "ratio"]
    return Comparison(
        pd.DataFrame(worse, columns=columns),
        pd.DataFrame(better, columns=columns),
        same,
        [_name(before.loc[i]) for i in before.index if i not in after.index],
        [_name(after.loc[i]) for i in after.index if i not in before.index],
    )


def _error(a: pd.Series, b: pd.Series) -> tuple[float, float]:
    """Give both errors by the same measure; one that has no fit, be it skipped, is infinite."""
    measure = "residual" if pd.isna(a["e2"]) and pd.isna(b["e2"]) else "e2"

    def one(row: pd.Series) -> float:
        value = row.get(measure, np.nan)
        return float(value) if row["status"] == "ok" and not pd.isna(value) else np.inf

    first, second = one(a), one(b)
    # Two failures are no change.
    return (1.0, 1.0) if first == second == np.inf else (first, second)


def _shown(row: pd.Series, error: float) -> str:
    return f"{error:.3g}" if row["status"] == "ok" else str(row["status"])


def _name(row: pd.Series) -> str:
    return f"{row['data']} | {row['library']} | {row['method']} | seed {row['seed']}"
