"""Members of a batch: their draws, the best of them, their spread."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.networks.members import best_member, member_draws, spread
from latticebench.systems.lattice import library


def test_members_start_differently_and_the_first_as_one_alone():
    first, second, third = (draw.normal(size=5) for draw in member_draws(7, 3))
    assert np.array_equal(first, np.random.default_rng(7).normal(size=5))
    assert not np.array_equal(first, second)
    assert not np.array_equal(second, third)


def test_a_member_whose_loss_is_not_a_number_is_not_the_best_and_the_spread_is_a_standard_deviation():
    assert best_member(np.array([np.nan, 3.0, 2.0, np.inf])) == 2
    terms = library("lib", "u[n]; u[n]**3")
    assert spread(np.array([[1.0, 2.0]]), terms) == {}
    assert spread(np.array([[1.0, 2.0], [3.0, 2.0]]), terms) == {
        "members": 2.0, "spread of u[n]": pytest.approx(np.sqrt(2)), "spread of u[n]**3": 0.0,
    }  # fmt: skip
