"""Which of two is better: the Wilcoxon signed-rank test on pairs of errors, with Holm's correction for many tests.

A pair is one case and seed that both have solved, and what is compared is the logarithm of E2. So a difference counts
only where it is of one sign on enough cases, however large one of them is (Wilcoxon, Biometrics Bulletin 1, 80 (1945);
Holm, Scand. J. Statist. 6, 65 (1979)). The seeds of a case are alike, so that a test over cases gives all of them one
sign: p is the share of the 2^k signs of k cases with as large a sum of ranks, which is exact (the clustered test of
Rosner, Glynn & Lee, Biometrics 62, 185 (2006), here by its permutations). With fewer than six cases nothing can be
better. A test over seeds speaks of these cases alone; equal pairs of a case, where nothing was drawn, count as one.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from latticebench.bench.tables import ABOUT, counted, shown_truth

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

# The probability of calling one better that is not, over all tests of a table.
LEVEL = 0.05
# Round-off differs between machines; errors below this are all the same.
FLOOR = 1e-9
# Choices of signs are counted for so many sums at most.
MOST_EXACT = 300
COLUMNS = ("method", "against", "cases", "pairs", "ratio", "p", "verdict")
UNDECIDED = "not told apart"


class SignedRank(NamedTuple):
    """What a signed-rank test says.

    Attributes:
        p: two-sided, of equal errors.
        lean: the sum of the signed ranks over that of all ranks, from -1, where the first is always smaller, to 1.
    """

    p: float
    lean: float


def signed_rank(
    first: Float[ndarray, " pair"], second: Float[ndarray, " pair"], cases: Sequence[Any] | None = None
) -> SignedRank:
    """Compare pairs of errors; an infinite error is larger than any, two infinite ones are alike.

    Args:
        first: errors of one method.
        second: errors of the other.
        cases: the case of each pair, for a test over cases; None for one over pairs.
    """
    from scipy.stats import rankdata

    logs = np.log(np.maximum([first, second], FLOOR))
    with np.errstate(invalid="ignore"):
        change = np.nan_to_num(logs[0] - logs[1], nan=0.0, posinf=1e9, neginf=-1e9)
    # Equal to rounding, and so of equal rank.
    change = np.round(change, 9)
    there = change != 0
    if not np.any(there):
        return SignedRank(1.0, 0.0)
    # Twice the ranks, which are whole where some are shared.
    ranks = np.rint(2 * rankdata(np.abs(change[there]))).astype(int) * np.sign(change[there]).astype(int)
    group = np.arange(len(ranks)) if cases is None else pd.factorize(pd.Index(cases)[there])[0]
    sums = np.bincount(group, weights=ranks).astype(int)
    return SignedRank(_share(sums), float(np.sum(sums) / np.sum(np.abs(ranks))))


def _share(sums: Int[ndarray, " case"]) -> float:
    """Return the share of all choices of signs for which the sum is as large as with those given.

    It is exact up to MOST_EXACT sums, and that of a normal distribution beyond.
    """
    from scipy.stats import norm

    sizes, seen = np.abs(sums), abs(int(np.sum(sums)))
    if len(sizes) > MOST_EXACT:
        return float(2 * norm.sf(seen / np.sqrt(np.sum(sizes.astype(float) ** 2))))
    # The distribution of the sum of those with a plus; the sum of all is twice that less the total.
    chances = np.zeros(int(np.sum(sizes)) + 1)
    chances[0] = 1.0
    for size in sizes:
        chances[size:] = (chances[size:] + chances[: len(chances) - size]) / 2 if size else chances
        chances[:size] /= 2
    values = 2 * np.arange(len(chances)) - int(np.sum(sizes))
    return float(min(np.sum(chances[np.abs(values) >= seen]), 1.0))


def least_p(cases: int) -> float:
    """Return the smallest p that so many cases can have, before a correction: one method is better in each of them."""
    return float(2.0 ** (1 - cases))


def holm(p: Sequence[float]) -> Float[ndarray, " test"]:
    """Return p values corrected for their number: the k-th smallest of m is multiplied by m + 1 - k, in order."""
    values = np.asarray(p, dtype=float)
    order = np.argsort(values)
    corrected = np.empty(len(values))
    steps = values[order] * np.arange(len(values), 0, -1)
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return corrected


def median_ratio(first: Float[ndarray, " pair"], second: Float[ndarray, " pair"]) -> float:
    """Return the median of the ratios of errors, each error at least FLOOR; two infinite ones are alike."""
    with np.errstate(invalid="ignore"):
        ratios = np.maximum(first, FLOOR) / np.maximum(second, FLOOR)
    return float(np.median(np.nan_to_num(ratios, nan=1.0, posinf=np.inf)))


def paired(table: pd.DataFrame, over: Literal["cases", "seeds"] = "cases") -> pd.DataFrame:
    """Compare every two methods of a table of cases on the cases and seeds that both have.

    A failure is an infinite error; what was skipped or has no truth is no pair, and a method that is shown the truth is
    no contestant.

    Args:
        table: see `bench.tables.cases`.
        over: what a test is over: cases, of which these are some, or the seeds of these cases.

    Returns:
        one row per two methods: the number of cases and pairs, the median ratio of their E2 (over cases, that of the
        medians of each case), p after Holm's correction over all rows, and which is better, if either.
    """
    errors = counted(table)
    errors = errors[errors["e2"].notna() & ~errors["method"].map(shown_truth)]
    wide = errors.pivot_table(
        index=[*ABOUT, "noise", "seed"], columns="method", values="e2", sort=False, aggfunc="first"
    )
    rows, tests = [], []
    for a, b in itertools.combinations(wide.columns, 2):
        both = wide[[a, b]].dropna()
        if both.empty:
            continue
        rows.append((a, b, both.groupby(level=ABOUT).ngroups, len(both), ratio_of(both, over)))
        tests.append(tested(both, over))
    return decided(pd.DataFrame(rows, columns=list(COLUMNS[:-2])), tests)


def decided(found: pd.DataFrame, tests: Sequence[SignedRank]) -> pd.DataFrame:
    """Return a table of `method`, `against` and `ratio` with p after Holm's correction over all rows, and verdicts."""
    p = holm([test.p for test in tests])
    rows = zip(found["method"], found["against"], found["ratio"], p, tests, strict=True)
    verdicts = [verdict(a, b, ratio, SignedRank(value, test.lean)) for a, b, ratio, value, test in rows]
    return found.assign(p=p, verdict=verdicts)


def tested(both: pd.DataFrame, over: Literal["cases", "seeds"]) -> SignedRank:
    """Compare two methods, whose errors are the columns of a table by case and seed."""
    if over == "seeds":
        both = both[~both.reset_index(ABOUT).duplicated().to_numpy()]
    cases = both.index.droplevel([name for name in both.index.names if name not in ABOUT])
    first, second = (both[name].to_numpy() for name in both.columns)
    return signed_rank(first, second, list(cases) if over == "cases" else None)


def ratio_of(both: pd.DataFrame, over: Literal["cases", "seeds"]) -> float:
    """Return the median ratio of the errors of two methods; see `paired`."""
    groups = [both] if over == "seeds" else [group for _, group in both.groupby(level=ABOUT, sort=False)]
    each = [median_ratio(*(group[name].to_numpy() for name in both.columns)) for group in groups]
    return float(np.median(each))


def verdict(first: str, second: str, ratio: float, test: SignedRank) -> str:
    """Return which of two is better; neither where the test does not say so, or the median says something else."""
    if test.p > LEVEL or ratio == 1 or (ratio < 1) != (test.lean < 0):
        return UNDECIDED
    return f"{first if ratio < 1 else second} better"
