"""Minimisers on functions whose minima are known."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.networks.descent import _first_length, lockstep


@pytest.mark.parametrize("package", ["numpy", "torch"])
def test_every_member_of_a_lockstep_descent_comes_to_the_bottom_of_its_valley(package):
    xp = pytest.importorskip(package)
    # Rosenbrock's valleys of different depth, to whose ends (1, 1) no straight way leads.
    depth = xp.asarray([1.0, 100.0, 1000.0])

    def valley(point):
        x, y = point[:, 0], point[:, 1]
        bend = y - x**2
        slope = xp.stack([-2 * (1 - x) - 4 * depth * bend * x, 2 * depth * bend], -1)
        return (1 - x) ** 2 + depth * bend**2, slope

    start = xp.asarray([[-1.2, 1.0], [3.0, -4.0], [0.0, 2.0]])
    seen = []
    end = lockstep(valley, start, 400, 5, lambda step, loss, _point: seen.append((step, np.asarray(loss))), xp)
    np.testing.assert_allclose(np.asarray(end), np.ones((3, 2)), atol=1e-5)
    assert np.all(np.diff(np.stack([loss for _, loss in seen]), axis=0) <= 0)
    assert np.all(np.diff([step for step, _ in seen]) > 0)
    assert seen[-1][0] < 399


def test_a_member_at_rest_or_before_a_wall_does_not_hold_the_others_up():
    def function(point):
        # The first is at its minimum; where the second is beyond 2 it has no value; the third is a plain bowl.
        value, slope = np.sum(point**2, axis=1), 2 * point
        beyond = (np.arange(len(point)) == 1) & (np.abs(point[:, 0]) < 2)
        return np.where(beyond, np.nan, value), np.where(beyond[:, None], np.nan, slope)

    start = np.array([[0.0, 0.0], [3.0, 0.0], [5.0, -7.0]])
    end = lockstep(function, start, 500, 5, lambda *_: None, np)
    assert np.array_equal(end[0], [0, 0])
    assert 2 <= end[1, 0] < 2.1
    np.testing.assert_allclose(end[2], [0, 0], atol=1e-6)


def test_the_first_step_downhill_moves_no_farther_than_one():
    slopes = np.array([-4.0, -1.21, -0.5, 0.0])
    length = _first_length(slopes, np)
    np.testing.assert_allclose(length, [1 / 2, 1 / 1.1, 1, 1])
    # A slope of -|g|^2 is that of a step along -g.
    assert np.all(length * np.sqrt(-slopes) <= 1 + 1e-12)
