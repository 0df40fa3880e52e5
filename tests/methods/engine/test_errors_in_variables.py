"""The selection of terms on whitened rows."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.errors_in_variables import _total, eliminate, estimate
from latticebench.methods.engine.regression import Regression
from latticebench.methods.engine.weak_form import WeakForm
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples


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


def forms(noise: float) -> list[WeakForm]:
    """The weak form of u'' = -4 u - 0.1 v, seen in positions."""
    t = np.linspace(0, 20, 401)
    u = np.exp(-0.05 * t) * np.cos(np.sqrt(4 - 0.05**2) * t)
    u += noise * np.random.default_rng(1).normal(size=t.shape)
    return [WeakForm(Samples(t, u[:, None], ends="free"), library("oscillator", "u[n]; v[n]"), 2, 3.5, 12)]


def test_an_iteration_that_ends_before_it_settles_gives_its_last_estimate_and_says_so() -> None:
    short, whole = (estimate(forms(0.02), np.ones(2, dtype=bool), rounds) for rounds in (1, 20))
    assert (short.settled, whole.settled) == (False, True)
    np.testing.assert_allclose(short.coefficients, whole.coefficients, atol=0.1)


@pytest.mark.parametrize("noise", [1e-3, 0.05])
def test_total_least_squares_finds_an_equation_with_noise_in_all_columns(noise: float) -> None:
    found = _total(forms(noise), np.ones(2, dtype=bool), 0)
    assert found is not None
    np.testing.assert_allclose(found, [-4, -0.1], atol=0.2 * noise + 0.01)
