"""The selection of terms on whitened rows."""

from __future__ import annotations

import numpy as np

from latticebench.methods.engine.errors_in_variables import eliminate
from latticebench.methods.engine.regression import Regression


def test_a_term_that_explains_nothing_is_taken_away_and_one_that_does_stays() -> None:
    rng = np.random.default_rng(0)
    design = rng.normal(size=(500, 4)) * [1.0, 10.0, 1.0, 0.1]
    target = design @ [1.0, 0.0, 0.0, 5.0] + rng.normal(size=500)
    kept = eliminate(Regression(design, target), np.ones(4, dtype=bool), 1.0)
    assert list(kept) == [True, False, False, True]


def test_which_terms_stay_does_not_depend_on_their_units_and_a_term_that_is_nought_goes() -> None:
    rng = np.random.default_rng(0)
    design = rng.normal(size=(500, 4))
    design[:, 2] = 0.0
    target = design @ [1.0, 0.0, 0.0, 0.5] + rng.normal(size=500)
    for units in (np.ones(4), np.array([1e12, 1e-12, 1.0, 1e9])):
        kept = eliminate(Regression(design * units, target), np.array([True, True, False, True]), 1.0)
        assert list(kept) == [True, False, False, True]
