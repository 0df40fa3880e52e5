"""Methods against one of them: wins, losses and ties per case, and mean ranks with their critical difference.

A case is one kind of data and one library; what is compared in it is log E2, seed by seed. Where there are seeds
enough, a case is won if the 95 % interval of the median difference, by a bootstrap over the seeds, lies below 0; with
fewer seeds, if the error is smaller by more than a hundredth. Over all cases the same bootstrap is over the cases,
since the seeds of one case are alike, and so is the test, that of `bench.paired`.

Ranks are of the median errors within each case (1 is the best), over the cases that all ranked methods have. Two
methods whose mean ranks differ by less than the critical difference of the Nemenyi test,

    q_alpha sqrt(k (k + 1) / (6 N)),        q_alpha: the studentized range of k groups over sqrt(2),

for k methods and N cases are not told apart (Demsar, J. Machine Learning Research 7, 1 (2006)).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from latticebench.bench.paired import FLOOR, LEVEL, SignedRank, decided, tested
from latticebench.bench.tables import ABOUT, FEW, counted, shown_truth
from latticebench.systems.errors import InputError, unknown

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Errors that differ by less, relatively, are a tie where there are too few seeds for an interval.
ALIKE = 0.01
# Decades that stand for infinity: one of two failed.
ENDLESS = 99.0
RESAMPLES = 2000
# A method is ranked if it has at least this share of the cases of the one that all are compared with.
ENOUGH = 0.5
# With fewer there is nothing to rank.
LEAST_METHODS, LEAST_CASES = 3, 2
METHODS = ("method", "against", "cases", "wins", "losses", "ties", "ratio", "low", "high", "p", "verdict")
CASES = (*ABOUT, "method", "against", "seeds", "ratio", "low", "high", "outcome")


@dataclass(frozen=True)
class Ranks:
    """Mean ranks of methods.

    Attributes:
        mean: by method, the best first.
        cases: over how many they are taken.
        distance: the critical difference.
        p: of equal methods, by Friedman's test.
        left_out: methods that have too few of the cases.
    """

    mean: pd.Series[float]
    cases: int
    distance: float
    p: float
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class Contest:
    """Methods against one of them.

    Attributes:
        methods: one row per method: cases won, lost and tied; the median ratio of its errors to the other's over the
            cases with its 95 % interval; p after Holm's correction, and which is better, if either.
        cases: one row per method and case.
        ranks: None where there are fewer than LEAST_METHODS methods or LEAST_CASES cases that all have.
    """

    methods: pd.DataFrame
    cases: pd.DataFrame
    ranks: Ranks | None


def against(table: pd.DataFrame, reference: str) -> Contest:
    """Compare all methods of a table of cases with one of them.

    A failure is an infinite error; what was skipped or has no truth is no pair, and a method that is shown the truth is
    no contestant.

    Args:
        table: see `bench.tables.cases`.
        reference: the method; the mark of published ones may be left out.

    Raises:
        InputError: the table lacks a column, there is no such method, or no other has a case of it.
    """
    missing = [name for name in (*ABOUT, "method", "noise", "seed") if name not in table]
    if missing:
        raise InputError(f"not a table of cases: the column {missing[0]!r} is missing")
    errors = counted(table)
    errors = errors[errors["e2"].notna() & ~errors["method"].map(shown_truth)]
    wide = errors.pivot_table(
        index=[*ABOUT, "noise", "seed"], columns="method", values="e2", sort=False, aggfunc="first"
    )
    chosen = _named(reference, list(wide.columns))
    cases: list[tuple[Any, ...]] = []
    methods: list[tuple[Any, ...]] = []
    tests: list[SignedRank] = []
    for name in wide.columns.drop(chosen):
        both = wide[[name, chosen]].dropna()
        if both.empty:
            continue
        own = [(*place, name, chosen, *_case(group)) for place, group in both.groupby(level=ABOUT, sort=False)]
        cases += own
        counts = [sum(row[-1] == outcome for row in own) for outcome in ("win", "loss", "tie")]
        decades = np.log10(np.array([row[6] for row in own], dtype=float).clip(10.0**-ENDLESS, 10.0**ENDLESS))
        spread = [_ratio(value) for value in interval(decades)]
        methods.append((name, chosen, len(own), *counts, _ratio(float(np.median(decades))), *spread))
        tests.append(tested(both, "cases"))
    if not methods:
        raise InputError(f"--against {reference}: no other method has a case that it has")
    found = decided(pd.DataFrame(methods, columns=list(METHODS[:-2])), tests)
    return Contest(found, pd.DataFrame(cases, columns=list(CASES)), _ranks(wide, chosen))


def interval(values: Float[ndarray, " value"]) -> tuple[float, float]:
    """Return the 95 % interval of the median by a bootstrap of percentiles; NaN with fewer than FEW values."""
    from scipy.stats import bootstrap

    if len(values) < FEW:
        return np.nan, np.nan
    found = bootstrap(
        (values,), np.median, confidence_level=1 - LEVEL, n_resamples=RESAMPLES, method="percentile",
        vectorized=True, random_state=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return float(found.low), float(found.high)


def critical_difference(methods: int, cases: int, level: float = LEVEL) -> float:
    """Return by how much mean ranks must differ for two methods to be told apart (Nemenyi)."""
    from scipy.stats import studentized_range

    quantile = float(studentized_range.ppf(1 - level, methods, np.inf)) / np.sqrt(2)
    return float(quantile * np.sqrt(methods * (methods + 1) / (6 * cases)))


def _named(reference: str, names: list[str]) -> str:
    marked = [name for name in names if name == reference] or [name for name in names if name.rstrip("*") == reference]
    if not marked:
        error = unknown("method", reference, names, "--against")
        raise InputError(f"{error}; --with DIR brings those of a published run")
    return marked[0]


def _case(group: pd.DataFrame) -> tuple[int, float, float, float, str]:
    """Return of one case: seeds, ratio of errors with its interval, and who has won."""
    first, second = (np.maximum(group[name].to_numpy(), FLOOR) for name in group.columns)
    with np.errstate(invalid="ignore"):
        decades = np.nan_to_num(np.log10(first) - np.log10(second), nan=0.0, posinf=ENDLESS, neginf=-ENDLESS)
    middle = float(np.median(decades))
    low, high = interval(decades)
    margin = np.log10(1 + ALIKE)
    below, above = (middle < -margin, middle > margin) if np.isnan(low) else (high < 0, low > 0)
    return len(decades), _ratio(middle), _ratio(low), _ratio(high), "win" if below else "loss" if above else "tie"


def _ratio(decades: float) -> float:
    """Return a ratio from its decades, infinite or 0 where one of two has failed."""
    if abs(decades) >= ENDLESS:
        return np.inf if decades > 0 else 0.0
    return float(10.0**decades)


def _ranks(wide: pd.DataFrame, chosen: str) -> Ranks | None:
    from scipy.stats import friedmanchisquare

    medians = wide.groupby(level=ABOUT, sort=False).median()
    known = medians[medians[chosen].notna()]
    enough = known.notna().mean() >= ENOUGH
    full = known.loc[:, enough].dropna()
    if len(full.columns) < LEAST_METHODS or len(full) < LEAST_CASES:
        return None
    # Equal to rounding, and so of equal rank.
    logs = full.clip(lower=FLOOR).map(np.log10).round(9)
    mean = logs.rank(axis=1).mean().sort_values(kind="stable")
    alike = bool((logs.nunique(axis=1) == 1).all())
    p = 1.0 if alike else float(friedmanchisquare(*(logs[name] for name in logs)).pvalue)
    distance = critical_difference(len(mean), len(full))
    return Ranks(mean, len(full), distance, p, tuple(map(str, known.columns[~enough])))
