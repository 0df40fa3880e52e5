"""Tidy tables of fits: one row per case, one row per coefficient, and a summary over seeds."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from latticebench import methods
from latticebench.bench.fitting import described
from latticebench.bench.published import read_table, without_results
from latticebench.bench.store import FILE, is_store, open_store
from latticebench.systems.errors import InputError

SCORES = (
    "e2", "einf", "spurious", "tpr", "bound", "forecast_error", "forecast_horizon", "residual", "conditioning",
    "seconds", "cpu_seconds", "peak_mib",
)  # fmt: skip
# Over fewer seeds a root-mean-square error says little.
FEW = 3
# Standard errors to each side of a 95 % interval.
INTERVAL = 1.96
# The part of its seeds that a spread holds.
SPREAD = (0.1, 0.9)
# What stands behind the name of a method that is no contestant.
SHOWN = " (shown the truth)"
# What a row of the matrix is about; a column of it is a method.
ABOUT = ["part", "data", "library"]


# Columns of the tables; those that a program reads are the last.
CASES = (
    "part", "data", "library", "method", "noise", "seed", "status", *SCORES, "covered", "reason", "settings",
    "identity",
)  # fmt: skip
COEFFICIENTS = (
    "part", "data", "library", "method", "noise", "seed", "term", "coefficient", "truth", "error", "stderr", "bound",
    "verdict",
)  # fmt: skip
LIMITS = (*ABOUT, "term", "truth", "bound", "verdict")


def tables(results: Iterable[Mapping[str, Any]]) -> dict[str, pd.DataFrame]:
    """Make the tables that `cases`, `coefficients` and `limits` make, reading the results once."""
    rows: list[tuple[Any, ...]] = []
    terms: list[tuple[Any, ...]] = []
    bounds: dict[tuple[str, ...], tuple[Any, ...]] = {}
    for result in results:
        head = _head(result["case"])
        rows.append(_case(head, result))
        terms += _coefficients(head, result)
        for about, found in _limits(head, result):
            # Where the bound depends on the seed, the first one stands for all.
            bounds.setdefault(about, found)
    return {
        "cases": pd.DataFrame(rows, columns=list(CASES)),
        "coefficients": pd.DataFrame(terms, columns=list(COEFFICIENTS)),
        "limits": pd.DataFrame([(*about, *found) for about, found in bounds.items()], columns=list(LIMITS)),
    }


def cases(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of cases: one row each, its settings first.

    Scores of a case that gave none are NaN; `status` and `reason` say why. An error that is infinite stays infinite.
    """
    return pd.DataFrame([_case(_head(result["case"]), result) for result in results], columns=list(CASES))


def coefficients(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of coefficients: one row each, with truth and error where there are any.

    `bound` is the smallest standard error that an unbiased method can have on these samples, `verdict` what follows
    from it.
    """
    return tables(results)["coefficients"]


def limits(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of what can be known: one row per term of the data and libraries that have a bound.

    `bound` is the smallest standard error of an unbiased method, in units of the coefficient.
    """
    return tables(results)["limits"]


def _head(case: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the first columns of both tables: part, data, library, method, noise, seed."""
    return case["part"], described(case), case["library"], named(case), case["noise"], case["seed"]


def named(case: Mapping[str, Any]) -> str:
    """Return what a case's method is called in tables and figures: its label, marked where it is shown the truth."""
    return f"{case['label']}{SHOWN if takes_truth(case['method']) else ''}"


def shown_truth(name: str) -> bool:
    """Return whether a name of `named` is that of a method that is shown the truth."""
    return name.endswith(SHOWN)


@functools.cache
def takes_truth(method: str) -> bool:
    """Return whether a method of this package is shown the truth; code of a user's is not run to draw a table."""
    kind = methods.registered().get(method)
    return kind is not None and kind().abilities.truth


def _case(head: tuple[Any, ...], result: Mapping[str, Any]) -> tuple[Any, ...]:
    case = result["case"]
    covered = _covered(result) if case["noise"] else np.nan
    settings = ", ".join(f"{name}={value}" for name, value in case["settings"].items())
    about = (covered, result["reason"] or result["note"], settings, result["identity"])
    return (*head, result["status"], *[_number(result[name]) for name in SCORES], *about)


def _coefficients(head: tuple[Any, ...], result: Mapping[str, Any]) -> Iterator[tuple[Any, ...]]:
    truths, errors, bounds = (result[name] or {} for name in ("truth", "stderr", "bounds"))
    verdicts = result["verdicts"] or {}
    for term, value in (result["coefficients"] or {}).items():
        truth = truths.get(term, np.nan)
        known = _number(errors.get(term)), _number(bounds.get(term))
        yield (*head, term, value, truth, value - truth, *known, verdicts.get(term, ""))


def _limits(head: tuple[Any, ...], result: Mapping[str, Any]) -> Iterator[tuple[tuple[str, ...], tuple[Any, ...]]]:
    for term, verdict in (result["verdicts"] or {}).items():
        yield (*head[:3], term), (result["truth"][term], _number(result["bounds"][term]), verdict)


def _covered(result: Mapping[str, Any]) -> float:
    """Return the share of a case's 95 % intervals that hold the truth; NaN without truth or standard errors.

    Without noise there is nothing that an interval could be of.
    """
    errors, truth = result["stderr"], result["truth"]
    if not errors or not truth or not result["coefficients"]:
        return np.nan
    held = [
        abs(value - truth[term]) <= INTERVAL * _number(errors[term]) for term, value in result["coefficients"].items()
    ]
    return float(sum(held) / len(held))


def counted(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table of cases in which what failed or ran out of time has an infinite error, where there is a truth."""
    found = table.copy()
    missed = ~found["status"].isin(["ok", "skipped"])
    # Where fits ended and yet none has an E2, there is no truth.
    ended = (found["status"] == "ok").groupby([found[name] for name in ABOUT]).transform("any")
    no_truth = ended & found.groupby(ABOUT)["e2"].transform(lambda e: bool(e.isna().all()))
    for name in ("e2", "einf", "forecast_error", "tpr", "forecast_horizon"):
        found[name] = found[name].astype(float) if name in found else np.nan
    found.loc[missed & ~no_truth, ["e2", "einf", "forecast_error"]] = np.inf
    found.loc[missed, ["tpr", "forecast_horizon"]] = 0.0
    return found


def summary(table: pd.DataFrame, value: str = "e2") -> pd.DataFrame:
    """Sum the table of cases up over seeds: one row for data, library and method.

    Scores are medians. Of `value`, `_low` and `_high` are the quantiles of SPREAD among the seeds, of which `seeds` is
    the number. A case that failed or ran out of time counts as an infinite error and stays in the median; one that was
    skipped leaves no figure. `ok` counts the cases that ended with a fit. `efficiency` is the Cramer-Rao bound over the
    root-mean-square of E2 over the seeds: 1 is the best that an unbiased method can do, a failure makes it 0, and
    with fewer than FEW seeds it is left out; a biased method may pass 1 where the samples say little, since 0 for
    every coefficient is never more than 100 % off. `coverage` is the share of the 95 % intervals (1.96 standard
    errors to each side) that hold the truth.
    """
    if table.empty:
        return pd.DataFrame(columns=[*ABOUT, "method"])
    full = counted(table)
    grouped = full.groupby([*ABOUT, "method"], sort=False)
    found = grouped[[*SCORES]].median()
    place = list(found.columns).index(value) + 1
    for number, (share, end) in enumerate(zip(SPREAD, ("low", "high"), strict=True)):
        # The nearest of the seeds: between a number and a failure there is nothing.
        found.insert(place + number, f"{value}_{end}", grouped[value].quantile(share, interpolation="nearest"))
    found["efficiency"] = grouped[["bound", "e2"]].apply(_efficiency)
    if "covered" in full:
        found["coverage"] = grouped["covered"].mean()
    found.insert(0, "ok", grouped["status"].agg(lambda s: f"{int((s == 'ok').sum())}/{len(s)}"))
    found.insert(1, "seeds", grouped[value].count())
    keys = pd.MultiIndex.from_frame(full[[*ABOUT, "method"]].drop_duplicates())
    return found.reindex(keys).reset_index()


def _efficiency(group: pd.DataFrame) -> float:
    """Divide the bound by the root-mean-square of E2 over the seeds; a case that failed has no bound of its own."""
    e2, bound = group["e2"].dropna(), group["bound"].dropna()
    if len(e2) < FEW or bound.empty or not np.any(e2 > 0):
        return np.nan
    return float(np.sqrt(np.mean(bound**2) / np.mean(e2**2)))


def file_of_cases(path: Path) -> Path:
    """Return the file that a table of cases is read from: of a store, a folder, or the table itself."""
    if is_store(path):
        return path / FILE
    return path / "cases.csv" if os.path.isdir(path) else path


def read_cases(path: Path) -> pd.DataFrame:
    """Read a published table of cases, or make it from a store.

    Raises:
        InputError: there is neither at `path`.
    """
    if is_store(path):
        store = open_store(path)
        with store.sound():
            return cases(store.results(kind="fit"))
    path = file_of_cases(path)
    if not os.path.isfile(path):
        raise InputError(
            f"{path}: no such table; give a store of results, a folder with cases.csv, or a cases.csv"
            f"{without_results()}"
        )
    table = read_table(path, (*SCORES, "covered", "noise", "seed"))
    missing = [name for name in ("identity", "status", "e2") if name not in table]
    if missing:
        raise InputError(f"{path}: not a table of cases: the column {missing[0]!r} is missing")
    return table


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)
