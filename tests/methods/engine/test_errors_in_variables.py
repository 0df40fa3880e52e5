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
