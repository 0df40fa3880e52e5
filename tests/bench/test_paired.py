"""Paired tests: Holm's correction by hand, and what may be called better."""

from __future__ import annotations

import itertools
from typing import Any, Literal

import numpy as np
import pytest
from scipy.stats import wilcoxon

from latticebench.bench.fitting import FitCase
from latticebench.bench.paired import LEVEL, SignedRank, holm, least_p, paired, signed_rank, verdict
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
    seen = np.sum(ranks * np.sign(change))
    sums = [abs(np.dot(ranks, signs)) for signs in itertools.product([-1, 1], repeat=6)]
    found = signed_rank(first, second)
    assert found.p == pytest.approx(np.mean(np.array(sums) >= abs(seen)))
    assert found.lean == pytest.approx(seen / 21)
    assert found.lean < 0
    assert signed_rank(first, first) == (1.0, 0.0)
    # A failure is worse than any error, two failures are alike.
    failed = np.array([np.inf] * 8)
    assert signed_rank(np.ones(8), failed) == (pytest.approx(2 / 2**8), -1.0)
    assert signed_rank(failed, failed) == (1.0, 0.0)


def test_p_over_pairs_is_that_of_scipy_and_beyond_many_that_of_a_normal_distribution(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(4)
    first, second = np.exp(rng.normal(size=(2, 40)) + np.array([[0.2], [0.0]]))
    exact = signed_rank(first, second).p
    assert exact == pytest.approx(wilcoxon(np.log(first / second), method="exact").pvalue, rel=1e-9)
    monkeypatch.setattr("latticebench.bench.paired.MOST_EXACT", 10)
    assert signed_rank(first, second).p == pytest.approx(exact, rel=0.05)


def test_no_cases_have_a_smaller_p_than_those_in_which_one_is_always_better() -> None:
    for count in range(1, 12):
        first = np.arange(1.0, count + 1)
        assert signed_rank(first, 3 * first).p == pytest.approx(least_p(count))
    assert least_p(5) > LEVEL > least_p(6)


def test_the_seeds_of_a_case_get_one_sign_in_a_test_over_cases() -> None:
    rng = np.random.default_rng(5)
    where = np.repeat(np.arange(7), 3)
    first, second = np.exp(rng.normal(size=(2, 21)))
    change = np.log(first / second)
    signed = (np.argsort(np.argsort(np.abs(change))) + 1) * np.sign(change)
    sums = np.bincount(where, signed)
    every = [abs(np.dot(sums, signs)) for signs in itertools.product([-1, 1], repeat=7)]
    found = signed_rank(first, second, list(where))
    assert found.p == pytest.approx(np.mean(np.array(every) >= abs(np.sum(sums))))
    # Copies of five cases are five cases, however many there are.
    copies = signed_rank(np.full(500, 0.9), np.ones(500), list(np.arange(500) % 5))
    assert copies == (pytest.approx(2 / 2**5), -1.0)


@pytest.mark.parametrize("over", ["cases", "seeds"])
def test_copies_of_two_cases_tell_nothing_apart(over: Literal["cases", "seeds"]) -> None:
    rows = [
        result(method, library, seed, error)
        for method, error in (("good", 0.1), ("bad", 0.2)) for library in ("lib1", "lib2") for seed in range(1, 21)
    ]  # fmt: skip
    found = paired(cases(rows), over).iloc[0]
    assert (found["cases"], found["pairs"], found["verdict"]) == (2, 40, "not told apart")


def test_nothing_is_better_where_the_ranks_say_one_thing_and_the_median_another() -> None:
    assert verdict("a", "b", 0.9, SignedRank(0.01, -0.5)) == "a better"
    assert verdict("a", "b", 1.1, SignedRank(0.01, 0.5)) == "b better"
    for told in (SignedRank(0.01, 0.5), SignedRank(0.06, -0.5)):
        assert verdict("a", "b", 0.9, told) == "not told apart"


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
    found = paired(cases(rows), over="seeds").set_index(["method", "against"])
    assert not any("oracle" in name for pair in found.index for name in pair)
    assert found.loc[("good", "bad"), "verdict"] == "good better"
    assert found.loc[("good", "bad"), "pairs"] == 12
    assert found.loc[("good", "bad"), "ratio"] == pytest.approx(0.8)
    assert found.loc[("bad", "lucky"), "verdict"] == "not told apart"
    assert found.loc[("good", "failing"), "pairs"] == 6
    # Six pairs alone would do, 2 / 2^6, but not as one of six tests.
    assert found.loc[("good", "failing"), "verdict"] == "not told apart"
    assert paired(cases(rows[:1])).empty
