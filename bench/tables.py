"""Tidy tables of results: one row per case, one row per coefficient, and a summary over seeds."""

from __future__ import annotations

import io
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from latticebench.bench.suite import Case
from latticebench.systems.errors import InputError

SCORES = (
    "e2", "einf", "spurious", "tpr", "bound", "forecast_error", "forecast_horizon", "residual", "conditioning",
    "seconds", "cpu_seconds", "peak_mib",
)  # fmt: skip
# Over fewer seeds a root-mean-square error says little.
FEW = 3
# Standard errors to each side of a 95 % interval.
INTERVAL = 1.96
# What a row of the matrix is about; a column of it is a method.
ABOUT = ["part", "data", "library"]


def cases(results: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of cases: one row each, its settings first.

    Scores of a case that gave none are NaN; `status` and `reason` say why. An error that is infinite stays infinite.
    """
    rows = []
    for result in results:
        case = Case.model_validate(result["case"])
        rows.append(
            {
                "part": case.part, "data": case.data, "library": case.library, "method": case.label, "noise": case.noise,
                "seed": case.seed, "status": result["status"],
                **{name: _number(result[name]) for name in SCORES}, "covered": _covered(result) if case.noise else np.nan,
                "reason": result["reason"] or result["note"], "settings": _settings(case.settings), "identity": case.identity,
            }
        )  # fmt: skip
    columns = [
        "part",
        "data",
        "library",
        "method",
        "noise",
        "seed",
        "status",
        *SCORES,
        "covered",
        "reason",
        "settings",
        "identity",
    ]
    return pd.DataFrame(rows, columns=columns)


def coefficients(results: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of coefficients: one row each, with truth and error where there are any.

    `bound` is the smallest standard error that an unbiased method can have on these samples, `verdict` what follows from it.
    """
    rows = []
    for result in results:
        case = Case.model_validate(result["case"])
        for term, value in (result["coefficients"] or {}).items():
            truth = np.nan if result["truth"] is None else result["truth"][term]
            stderr, bound = (
                np.nan if result[name] is None else _number(result[name][term]) for name in ("stderr", "bounds")
            )
            rows.append(
                {
                    "part": case.part, "data": case.data, "library": case.library, "method": case.label,
                    "noise": case.noise, "seed": case.seed, "term": term, "coefficient": value, "truth": truth, "error": value - truth,
                    "stderr": stderr, "bound": bound, "verdict": (result["verdicts"] or {}).get(term, ""),
                }
            )  # fmt: skip
    columns = [
        "part", "data", "library", "method", "noise", "seed", "term", "coefficient", "truth", "error", "stderr", "bound", "verdict",
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=columns)


def limits(results: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of what can be known: one row for each term of the data and libraries that have a bound.

    `bound` is the smallest standard error of an unbiased method, in units of the coefficient.
    """
    rows: dict[tuple[str, ...], dict[str, Any]] = {}
    for result in results:
        case = Case.model_validate(result["case"])
        for term, verdict in (result["verdicts"] or {}).items():
            # Where the bound depends on the seed, the first one stands for all.
            about = {"part": case.part, "data": case.data, "library": case.library, "term": term}
            found = {"truth": result["truth"][term], "bound": _number(result["bounds"][term]), "verdict": verdict}
            rows.setdefault(tuple(about.values()), {**about, **found})
    return pd.DataFrame(list(rows.values()), columns=[*ABOUT, "term", "truth", "bound", "verdict"])


def _covered(result: Mapping[str, Any]) -> float:
    """Give the share of a case's 95 % intervals that hold the truth; NaN without truth or standard errors.

    Without noise there is nothing that an interval could be of.
    """
    errors, truth = result["stderr"], result["truth"]
    if not errors or not truth or not result["coefficients"]:
        return np.nan
    held = [
        abs(value - truth[term]) <= INTERVAL * _number(errors[term]) for term, value in result["coefficients"].items()
    ]
    return float(np.mean(held))


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Sum the table of cases up over seeds: one row for data, library and method.

    A case that failed or ran out of time counts as an infinite error and stays in the median; one that was skipped leaves no
    figure. `ok` counts the cases that ended with a fit. `efficiency` is the Cramer-Rao bound over the root-mean-square of E2
    over the seeds: 1 is the best that an unbiased method can do, a failure makes it 0, and with fewer than FEW seeds it is left
    out. `coverage` is the share of the 95 % intervals (1.96 standard errors to each side) that hold the truth. A biased method may pass 1 where the samples say little: 0 for every coefficient is never more than 100 % off.
    """
    if table.empty:
        return pd.DataFrame(columns=[*ABOUT, "method"])
    counted = table.copy()
    missed = ~counted["status"].isin(["ok", "skipped"])
    # Where fits ended and yet none has an E2, there is no truth.
    ended = (counted["status"] == "ok").groupby([counted[name] for name in ABOUT]).transform("any")
    no_truth = ended & counted.groupby(ABOUT)["e2"].transform(lambda e: bool(e.isna().all()))
    counted.loc[missed & ~no_truth, ["e2", "einf", "forecast_error"]] = np.inf
    counted.loc[missed, ["tpr", "forecast_horizon"]] = 0.0
    grouped = counted.groupby([*ABOUT, "method"], sort=False)
    found = grouped[[*SCORES]].median()
    found["efficiency"] = grouped[["bound", "e2"]].apply(_efficiency)
    if "covered" in counted:
        found["coverage"] = grouped["covered"].mean()
    found.insert(0, "ok", grouped["status"].agg(lambda s: f"{int((s == 'ok').sum())}/{len(s)}"))
    keys = pd.MultiIndex.from_frame(counted[[*ABOUT, "method"]].drop_duplicates())
    return found.reindex(keys).reset_index()


def _efficiency(group: pd.DataFrame) -> float:
    """Divide the bound by the root-mean-square of E2 over the seeds; a case that failed has no bound of its own."""
    e2, bound = group["e2"].dropna(), group["bound"].dropna()
    if len(e2) < FEW or bound.empty or not np.any(e2 > 0):
        return np.nan
    return float(np.sqrt(np.mean(bound**2) / np.mean(e2**2)))


def read_cases(path: Path) -> pd.DataFrame:
    """Read a published table of cases, or make it from a store.

    Raises:
        InputError: there is neither at `path`.
    """
    if path.is_dir():
        if (path / "store.json").is_file():
            from latticebench.bench.store import open_store

            return cases(open_store(path).all())
        path = path / "cases.csv"
    if not path.is_file():
        raise InputError(f"{path}: no such table; give a store of results, a folder with cases.csv, or a cases.csv")
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        body = itertools.dropwhile(lambda line: line.startswith("#"), lines)
        table = pd.read_csv(io.StringIO("".join(body)), dtype=str, keep_default_na=False)
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a table of cases: {error}") from None
    missing = [name for name in ("identity", "status", "e2") if name not in table]
    if missing:
        raise InputError(f"{path}: not a table of cases: the column {missing[0]!r} is missing")
    for name in (*SCORES, "covered", "noise", "seed"):
        if name in table:
            table[name] = pd.to_numeric(table[name], errors="coerce")
    return table


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)


def _settings(given: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value}" for name, value in given.items())
