"""MIOSR: the best subsets by trying all of them, and what happens without its solver."""

from __future__ import annotations

import importlib.util
import itertools

import numpy as np
import pytest

from latticebench import methods, systems
from latticebench.methods.engine.regression import Regression
from latticebench.methods.method import Skipped, make, solve
from latticebench.methods.miosr import best_subsets
from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples


def test_each_number_of_terms_has_the_support_that_a_search_of_all_finds() -> None:
    pytest.importorskip("gurobipy", reason="its solver is not installed: pip install gurobipy")
    rng = np.random.default_rng(1)
    design = rng.normal(size=(80, 6))
    # Neighbouring columns are much alike, so that greedy selections fail.
    design[:, 1:] += 2 * design[:, :-1]
    target = design @ [1.0, 0.0, -0.6, 0.3, 0.0, 0.0] + 0.5 * rng.normal(size=80)
    for terms, found in enumerate(best_subsets(Regression(design, target), 10.0, 1), start=1):
        least = min(
            float(np.linalg.lstsq(design[:, list(some)], target, rcond=None)[1][0])
            for some in itertools.combinations(range(6), terms)
        )
        assert np.count_nonzero(found) == terms
        assert np.sum((target - design @ found) ** 2) == pytest.approx(least, rel=1e-6)


def test_without_its_solver_it_is_skipped_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    known = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "gurobipy" else known(name))
    samples = Samples(np.linspace(0, 1, 20), np.ones((20, 5)))
    with pytest.raises(Skipped, match="needs gurobipy, not installed; try: pip install gurobipy"):
        solve(methods.find("miosr")(), [samples], systems.find("phi4").library("lib2"), 2, seed=1)


def test_a_setting_out_of_range_is_refused() -> None:
    with pytest.raises(InputError, match=r"setting patience = 0\.0: it must be above 0"):
        make(methods.find("miosr"), {"patience": 0.0})
