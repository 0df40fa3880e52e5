"""Coefficient errors must not grow: the suite `accuracy` against the committed baseline, case by case.

A case has grown when its E2 (without a truth: its residual) exceeds FACTOR times that of the baseline, both counted as
at least the floor of `bench.compare`. After a change that is meant to move errors, write the baseline anew and read its
difference:

    latticebench run accuracy --results runs/accuracy && python tests/accuracy/write_baseline.py runs/accuracy
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from latticebench.bench.compare import compare, of_fits, read_run
from latticebench.bench.run import run
from latticebench.bench.store import create
from latticebench.bench.suite import load
from latticebench.bench.tables import cases

BASELINE = Path(__file__).parent / "baseline.csv"
FACTOR = 2.0

SUITE = load("accuracy")


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The errors of the baseline and of this code."""
    results, _ = run(SUITE, create(tmp_path_factory.mktemp("accuracy") / "store"), jobs=1)
    return read_run(BASELINE), of_fits(cases(results))


def test_the_error_of_no_case_has_grown(tables: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    old, new = tables
    found = compare(old, new, FACTOR)
    assert found.worse.empty, found.worse.to_string(index=False)
    assert not found.fresh, "no baseline for these cases; write the baseline anew"
    assert found.same + len(found.better) == len(SUITE.cases)


def test_a_worse_method_would_be_noticed(tables: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    old, new = tables
    spoiled = new.assign(e2=new["e2"].clip(lower=1e-9) * 3, residual=new["residual"] * 3)
    assert len(compare(old, spoiled, FACTOR).worse) == int((new["status"] == "ok").sum())
