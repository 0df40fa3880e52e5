"""Comparing two runs: which cases got better, and which worse.

Runs are compared case by case in a table of a common form, whatever their kind:

    identity    by which a case is known in both
    case        what people call it
    status      ok, or what went wrong
    right       for trials, whether the diagnosis was right; missing for others
    method      for fits, who made it; missing for others
    e2          for fits, the relative error of the coefficients
    residual    what is left of the derivative (fits) or of the readings, in units of the noise (diagnoses)

A single case may change for any reason; a method is called better or worse only where a paired test over its cases and
seeds says so (`bench.paired`).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from latticebench.bench.paired import FLOOR, UNDECIDED, decided, median_ratio, signed_rank
from latticebench.bench.published import read_table
from latticebench.bench.store import is_store, open_store
from latticebench.systems.errors import InputError
from latticebench.systems.files import DATA, read_json, shown

FACTOR = 2.0
TABLES = ("cases.csv", "trials.csv", "laboratory.csv")
NEEDED: Mapping[str, Sequence[str]] = {
    "fit": ("identity", "data", "library", "method", "seed", "status", "e2", "residual"),
    "trial": ("system", "effect", "z", "noise", "velocities", "seed", "status", "right", "residual_after"),
    "laboratory": ("asked", "seed", "status", "right", "residual_after"),
}
NUMBERS = ("e2", "residual", "residual_after", "z", "noise", "seed")
COLUMNS = ("identity", "case", "method", "status", "right", "e2", "residual")


@dataclass(frozen=True)
class Comparison:
    """The cases that two runs share, by what became of them.

    Attributes:
        worse, better: single cases: tables with `case`, `old`, `new` (each with its measure) and `ratio` (of the
            errors).
        same: how many did neither.
        gone: cases that only the old run has.
        fresh: cases that only the new one has.
        methods: for fits, a table with `method`, `pairs` (cases and seeds that both runs have), `ratio` (the median of
            new over old E2), `p` (of a paired test, corrected for the number of methods) and `verdict`.
    """

    worse: pd.DataFrame
    better: pd.DataFrame
    same: int
    gone: list[str]
    fresh: list[str]
    methods: pd.DataFrame


def compare(old: pd.DataFrame, new: pd.DataFrame, factor: float = FACTOR, floor: float = FLOOR) -> Comparison:
    """Compare the cases that two runs share.

    A case is worse when its diagnosis was right and is wrong; when its E2 (without one: its residual) has grown by
    more than `factor`, both counted as at least `floor`; or when it had a result and has none any more.

    Args:
        old: see `read_run` and `of_fits`.
        new: the same, to be judged.
        factor: of two errors that count as the same.
        floor: errors below it are all the same.

    Raises:
        InputError: no case is in both.
    """
    before, after = (table.drop_duplicates("identity").set_index("identity") for table in (old, new))
    shared = before.index.intersection(after.index, sort=False)
    if shared.empty:
        raise InputError("the two tables have no case in common; compare runs of the same suite")
    found: dict[int, list[dict[str, Any]]] = {-1: [], 0: [], 1: []}
    for a, b in zip(before.loc[shared].to_dict("records"), after.loc[shared].to_dict("records"), strict=True):
        measure, first, second = _errors(a, b)
        change = _change(a, b, max(first, floor), max(second, floor), factor)
        row = {"case": b["case"], "old": _shown(a, measure, first), "new": _shown(b, measure, second)}
        found[change].append({**row, "ratio": second / first if first else np.nan})
    worse, better = (pd.DataFrame(found[change], columns=["case", "old", "new", "ratio"]) for change in (1, -1))
    gone, fresh = before.index.difference(after.index, sort=False), after.index.difference(before.index, sort=False)
    named = list(before.loc[gone, "case"]), list(after.loc[fresh, "case"])
    return Comparison(worse, better, len(found[0]), *named, _by_method(before.loc[shared], after.loc[shared]))


def _by_method(before: pd.DataFrame, after: pd.DataFrame) -> pd.DataFrame:
    """Judge each method by all pairs of its errors, of tables that have the same cases in the same order."""
    rows, tests = [], []
    pairs = pd.DataFrame({"method": after["method"], "old": _counted(before), "new": _counted(after)})
    # Seeds between which nothing was drawn are one.
    pairs["kind"] = after["case"].str.rpartition(" | seed ")[0]
    # A case in which neither has an error has no truth, or cannot be had.
    known = np.isfinite(pairs[["old", "new"]].to_numpy()).any(axis=1)
    pairs = pairs[known].dropna().drop_duplicates()
    for method, group in pairs.groupby("method", sort=False):
        old, new = group["old"].to_numpy(), group["new"].to_numpy()
        rows.append((method, len(group), median_ratio(new, old)))
        tests.append(signed_rank(new, old))
    found = pd.DataFrame(rows, columns=["method", "pairs", "ratio"])
    told = decided(found.assign(method="new", against="old"), tests)
    said = {"new better": "better", "old better": "worse", UNDECIDED: UNDECIDED}
    return found.assign(p=told["p"], verdict=told["verdict"].map(said))


def _counted(frame: pd.DataFrame) -> pd.Series:
    """Return E2, infinite where a case failed and missing where it was skipped."""
    return frame["e2"].where(frame["status"] == "ok", np.inf).where(frame["status"] != "skipped")


def _change(a: Mapping[Any, Any], b: Mapping[Any, Any], first: float, second: float, factor: float) -> int:
    """Return 1 where a case got worse, -1 where it got better, else 0."""
    if not pd.isna(a["right"]) and not pd.isna(b["right"]) and a["right"] != b["right"]:
        return 1 if a["right"] else -1
    return int(second > factor * first) - int(first > factor * second)


def _errors(a: Mapping[Any, Any], b: Mapping[Any, Any]) -> tuple[str, float, float]:
    """Return the measure that two results share, and both errors; the error of a case without a result is infinite."""
    measure = "residual" if pd.isna(a["e2"]) and pd.isna(b["e2"]) else "e2"
    first, second = (
        float(one[measure]) if one["status"] == "ok" and not pd.isna(one[measure]) else np.inf for one in (a, b)
    )
    # Two failures are no change.
    return (measure, 1.0, 1.0) if first == second == np.inf else (measure, first, second)


def _shown(row: Mapping[Any, Any], measure: str, error: float) -> str:
    if row["status"] != "ok":
        return str(row["status"])
    judged = "" if pd.isna(row["right"]) else "right, " if row["right"] else "wrong, "
    return f"{judged}{'E2' if measure == 'e2' else measure} {error:.3g}"


# Reading a run --------------------------------------------------------------------------------------------------------


def read_run(path: Path) -> pd.DataFrame:
    """Read a run in the common form: a store, a folder of published tables, or one published table.

    Raises:
        InputError: there is none of these at `path`.
    """
    if is_store(path):
        from latticebench.bench.kinds import each

        store = open_store(path)
        with store.sound():
            parts = [FORMS[name](kind.table(results)) for name, kind, results, _ in each(store)]
        return pd.concat(parts, ignore_index=True)
    if os.path.isdir(path):
        # Of a suite of several kinds each kind's tables are in a folder of their own.
        parts = [part for folder in (path, *(path / kind for kind in FORMS)) for part in _published(folder)]
        if parts:
            return pd.concat(parts, ignore_index=True)
    if not os.path.isfile(path):
        raise InputError(
            f"{path}: no results; give a store of them, a folder of published tables, or one of {', '.join(TABLES)}"
        )
    frame = read_table(path, NUMBERS)
    kind = "laboratory" if "asked" in frame else "trial" if "effect" in frame else "fit"
    form, needed = FORMS[kind], NEEDED[kind]
    missing = [name for name in needed if name not in frame]
    if missing:
        raise InputError(
            f"{path}: no table of cases, trials or laboratory recordings: the column {missing[0]!r} is missing"
        )
    return form(frame)


def _published(folder: Path) -> list[pd.DataFrame]:
    """Return what was published of fits, trials and recordings in a folder itself."""
    parts = [read_run(folder / name) for name in TABLES if os.path.isfile(folder / name)]
    if os.path.isfile(folder / "measured.md"):
        parts.append(_reports(sorted(folder.glob("*.json"))))
    return parts


def of_fits(frame: pd.DataFrame) -> pd.DataFrame:
    """Bring a table of cases (`bench.tables`) into the common form."""
    parts = ["data", "library", "method"]
    title = frame[parts[0]].str.cat(frame[parts[1:]], sep=" | ") + " | seed " + frame["seed"].astype(str)
    return _common(frame, identity=frame["identity"], case=title, method=frame["method"])


def of_trials(frame: pd.DataFrame) -> pd.DataFrame:
    """Bring a table of trials (`bench.trials.scores`) into the common form; a trial is known by its settings."""
    told = frame.assign(**{name: pd.to_numeric(frame[name]).map("{:g}".format) for name in ("z", "noise", "seed")})
    seen = np.where(frame["velocities"].astype(str) == "False", " only u", "")
    title = told["system"] + " noise=" + told["noise"] + seen
    title += " | " + told["effect"] + " z=" + told["z"] + " | seed " + told["seed"]
    right = frame["right"].map({True: True, False: False, "True": True, "False": False})
    return _common(frame, identity=title, case=title, right=right, residual=frame["residual_after"])


def of_recordings(frame: pd.DataFrame) -> pd.DataFrame:
    """Bring a table of recordings (`bench.trials.recorded`) into the common form; a recording is known by its name."""
    return _common(frame, identity=frame["name"], case=frame["name"], residual=frame["residual_after"])


def of_laboratory(frame: pd.DataFrame) -> pd.DataFrame:
    """Bring a table of laboratory recordings (`bench.trials.laboratory.tables`) into the common form."""
    title = "laboratory " + frame["asked"] + " | seed " + frame["seed"].astype(str)
    right = frame["right"].map({True: True, False: False, "True": True, "False": False})
    return _common(frame, identity=title, case=title, right=right, residual=frame["residual_after"])


FORMS = {"fit": of_fits, "trial": of_trials, "laboratory": of_laboratory, "measured": of_recordings}


def _reports(paths: Iterable[Path]) -> pd.DataFrame:
    from latticebench.bench.trials.recorded import summarised

    rows = []
    for path in paths:
        try:
            found = summarised(read_json(path, DATA))
        except InputError:
            raise
        except (ValueError, KeyError, TypeError, AttributeError, IndexError):
            raise InputError(f"{shown(path)}: not the report on a recording") from None
        rows.append({"name": path.stem, "status": "ok", **found})
    return of_recordings(pd.DataFrame(rows))


def _common(frame: pd.DataFrame, **columns: Any) -> pd.DataFrame:
    made = frame.drop(columns="method", errors="ignore").assign(**columns)
    for name in COLUMNS:
        if name not in made:
            made[name] = np.nan
    return _numbers(made[list(COLUMNS)], ("e2", "residual"))


def _numbers(frame: pd.DataFrame, names: Iterable[str]) -> pd.DataFrame:
    return frame.assign(**{name: pd.to_numeric(frame[name], errors="coerce") for name in names})
