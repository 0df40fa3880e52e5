"""Coefficient errors must not grow: the suite `accuracy` against the committed baseline, case by case.

A case has grown when its E2 (without a truth: its residual) exceeds FACTOR times that of the baseline, both counted as
at least the floor of `bench.compare`. After a change that is meant to move errors, write the baseline anew and read its
difference:

    latticebench run accuracy --results runs/accuracy && python tests/accuracy/write_baseline.py runs/accuracy
"""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import pandas as pd
import pytest

from latticebench.bench.compare import compare, of_fits, read_run
from latticebench.bench.score import Forecast
from latticebench.bench.suite import load
from latticebench.bench.tables import cases
from latticebench.bench.worker import attempt
from latticebench.systems.errors import InputError

BASELINE = Path(__file__).parent / "baseline.csv"
FACTOR = 2.0

SUITE = load("accuracy")


@pytest.fixture(scope="module")
def tables() -> tuple[pd.DataFrame, pd.DataFrame]:
    """The errors of the baseline and of this code; bounds and forecasts, which take half of the time, are left out."""
    with (
        mock.patch("latticebench.bench.fitting.bound", side_effect=InputError("not asked for")),
        mock.patch("latticebench.bench.fitting.forecast", return_value=Forecast(0.0, 0.0)),
    ):
        found = [{**attempt(case, SUITE.folders), "case": case.model_dump()} for case in SUITE.cases]
    identities = [{"identity": case.identity} for case in SUITE.cases]
    new = cases({**one, **identity} for one, identity in zip(found, identities, strict=True))
    return read_run(BASELINE), of_fits(new)


@pytest.mark.parametrize("label", sorted({case.label for case in SUITE.cases}))
def test_the_error_of_no_case_of_a_method_has_grown(label: str, tables: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    own = {case.identity for case in SUITE.cases if case.label == label}
    old, new = (one[one["identity"].isin(own)] for one in tables)
    found = compare(old, new, FACTOR)
    assert found.worse.empty, found.worse.to_string(index=False)
    assert not found.fresh, "no baseline for these cases; write the baseline anew"
    assert found.same + len(found.better) == len(own)


def test_a_worse_method_would_be_noticed(tables: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    old, new = tables
    spoiled = new.assign(e2=new["e2"].clip(lower=1e-9) * 3, residual=new["residual"] * 3)
    assert len(compare(old, spoiled, FACTOR).worse) == int((new["status"] == "ok").sum())
