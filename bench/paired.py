"""Which of two is better: the Wilcoxon signed-rank test on pairs of errors, with Holm's correction for many tests.

A pair is one case and seed that both have solved, and what is compared is the logarithm of E2. So a difference counts
only where it is of one sign on enough cases, however large one of them is (Wilcoxon, Biometrics Bulletin 1, 80 (1945);
Holm, Scand. J. Statist. 6, 65 (1979)). With fewer than six pairs nothing can be better.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from latticebench.bench.tables import ABOUT, counted, shown_truth

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# The probability of calling one better that is not, over all tests of a table.
LEVEL = 0.05
# Round-off differs between machines; errors below this are all the same.
FLOOR = 1e-9
COLUMNS = ("method", "against", "pairs", "ratio", "p", "verdict")
UNDECIDED = "not told apart"


def signed_rank(first: Float[ndarray, " pair"], second: Float[ndarray, " pair"]) -> float:
    """Return the two-sided p of equal errors; an infinite error is larger than any, two infinite ones are alike."""
    from scipy.stats import wilcoxon

    logs = np.log(np.maximum([first, second], FLOOR))
    with np.errstate(invalid="ignore"):
        change = np.nan_to_num(logs[0] - logs[1], nan=0.0, posinf=1e9, neginf=-1e9)
    # Equal to rounding, and so of equal rank.
    change = np.round(change, 9)
    if not np.any(change):
        return 1.0
    return float(wilcoxon(change[change != 0]).pvalue)


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


def paired(table: pd.DataFrame) -> pd.DataFrame:
    """Compare every two methods of a table of cases on the cases and seeds that both have.

    A failure is an infinite error; what was skipped or has no truth is no pair, and a method that is shown the truth is
    no contestant.

    Returns:
        one row per two methods: the number of pairs, the median ratio of their E2, p after Holm's correction over all
        rows, and which is better, if either.
    """
    errors = counted(table)
    errors = errors[errors["e2"].notna() & ~errors["method"].map(shown_truth)]
    wide = errors.pivot_table(
        index=[*ABOUT, "noise", "seed"], columns="method", values="e2", sort=False, aggfunc="first"
    )
    rows = []
    for a, b in itertools.combinations(wide.columns, 2):
        both = wide[[a, b]].dropna()
        if not both.empty:
            first, second = both[a].to_numpy(), both[b].to_numpy()
            rows.append((a, b, len(both), median_ratio(first, second), signed_rank(first, second)))
    found = pd.DataFrame(rows, columns=list(COLUMNS[:-1]))
    found["p"] = holm(found["p"].tolist())
    found["verdict"] = [
        verdict(str(row["method"]), str(row["against"]), row["ratio"], row["p"]) for _, row in found.iterrows()
    ]
    return found


def verdict(first: str, second: str, ratio: float, p: float) -> str:
    """Return which of two is better; neither where the test does not say so, or the median pair is alike."""
    if p > LEVEL or ratio == 1:
        return UNDECIDED
    return f"{first if ratio < 1 else second} better"
