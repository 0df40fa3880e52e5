"""Paired tests: Holm's correction by hand, and what may be called better."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from latticebench.bench.fitting import FitCase
from latticebench.bench.paired import holm, paired, signed_rank
from latticebench.bench.tables import cases
from latticebench.bench.worker import outcome


def result(method: str, library: str, seed: int, e2: float | None, status: str = "ok") -> dict[str, Any]:
    case = FitCase(system="phi4", library=library, label=method, method=method, seed=seed)
    about = {"case": case.model_dump(mode="json"), "identity": case.identity}
    return {**outcome(case, status), **about, "e2": e2, "residual": 0.1}


def test_the_correction_of_holm_is_that_of_his_table() -> None:
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm([0.9, 0.8]), [1.0, 1.0])
    assert len(holm([])) == 0


def test_p_is_the_share_of_signs_with_as_extreme_a_sum_of_ranks() -> None:
    first, second = np.array([1.0, 2.0, 3.0, 5.0, 0.5, 7.0]), np.array([2.0, 6.0, 2.9, 30.0, 5.0, 7.7])
    change = np.log(first / second)
    ranks = np.argsort(np.argsort(np.abs(change))) + 1
    seen = abs(np.sum(ranks * np.sign(change)))
    sums = [abs(np.dot(ranks, signs)) for signs in itertools.product([-1, 1], repeat=6)]
    assert signed_rank(first, second) == pytest.approx(np.mean(np.array(sums) >= seen))
    assert signed_rank(first, first) == 1.0
    # A failure is worse than any error, two failures are alike.
    failed = np.array([np.inf] * 8)
    assert signed_rank(np.ones(8), failed) == pytest.approx(2 / 2**8)
    assert signed_rank(failed, failed) == 1.0


def test_methods_are_compared_on_the_cases_and_seeds_that_both_have() -> None:
    rng = np.random.default_rng(2)
    rows = []
    for library, seed in itertools.product(("lib1", "lib2"), range(1, 7)):
        size = float(np.exp(rng.normal()))
        rows += [
            result("good", library, seed, 0.8 * size), result("bad", library, seed, size),
            result("lucky", library, seed, float(size * np.exp(rng.normal()))),
            result("oracle", library, seed, 1e-15),
        ]  # fmt: skip
        if library == "lib1":
            rows.append(result("failing", library, seed, None, "failed"))
    found = paired(cases(rows)).set_index(["method", "against"])
    assert not any("oracle" in name for pair in found.index for name in pair)
    assert found.loc[("good", "bad"), "verdict"] == "good better"
    assert found.loc[("good", "bad"), "pairs"] == 12
    assert found.loc[("good", "bad"), "ratio"] == pytest.approx(0.8)
    assert found.loc[("bad", "lucky"), "verdict"] == "not told apart"
    assert found.loc[("good", "failing"), "pairs"] == 6
    # Six pairs alone would do, 2 / 2^6, but not as one of six tests.
    assert found.loc[("good", "failing"), "verdict"] == "not told apart"
    assert paired(cases(rows[:1])).empty
