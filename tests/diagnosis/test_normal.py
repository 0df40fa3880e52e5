"""The covariance of a model's numbers beside the initial states of pieces."""

from __future__ import annotations

from types import SimpleNamespace

import mpmath
import numpy as np
import pytest

from latticebench.diagnosis.normal import normal


def eliminated(slope, size):
    """The normal equations of derivatives of pieces (pieces, readings, S + G)."""
    flat = slope.reshape(-1, 1, slope.shape[2])
    rows = np.arange(len(flat)).reshape(slope.shape[:2])
    return normal(SimpleNamespace(rows=[rows]), np.ones((len(flat), 1)), flat, size, 0.0)


def exact(slope, size):
    """The same covariance from the whole problem, in arithmetic with eighty digits."""
    pieces, count = slope.shape[0], slope.shape[2] - size
    whole = np.zeros((slope.shape[0] * slope.shape[1], pieces * size + count))
    for k, by in enumerate(slope):
        rows = slice(k * slope.shape[1], (k + 1) * slope.shape[1])
        whole[rows, k * size : (k + 1) * size], whole[rows, pieces * size :] = by[:, :size], by[:, size:]
    with mpmath.workdps(80):
        design = mpmath.matrix(whole.tolist())
        inverse = (design.T * design) ** -1
        return np.array(inverse.tolist(), dtype=float)[-count:, -count:]


@pytest.mark.parametrize("numbers", [1, 2, 3])
@pytest.mark.parametrize("growth", [0.0, 8.0, 11.0, 13.0, 18.0, 24.0])
def test_it_is_that_of_the_whole_problem_for_chaotic_motion_too(growth, numbers):
    for seed in range(3):
        draw, t = np.random.default_rng(seed), np.linspace(0, 1, 40)
        # Whatever changes, the fastest growing direction is what is seen of it.
        grown = np.exp(growth * t)[None, :, None] * draw.normal(size=(2, 1, 2 + numbers))
        slope = grown + draw.normal(size=(2, 40, 2 + numbers))
        found = eliminated(slope, 2).covariance()
        np.testing.assert_allclose(found, exact(slope, 2), rtol=1e-4, atol=1e-9)


def test_states_that_no_reading_depends_on_change_nothing():
    draw, t = np.random.default_rng(2), np.linspace(0, 1, 40)
    slope = np.exp(18 * t)[None, :, None] * draw.normal(size=(2, 1, 5)) + draw.normal(size=(2, 40, 5))
    unseen = np.concatenate([slope[:, :, :2], np.zeros((2, 40, 1)), slope[:, :, 2:]], axis=2)
    np.testing.assert_allclose(eliminated(unseen, 3).covariance(), exact(slope, 2), rtol=1e-4)


def test_numbers_that_do_one_thing_are_known_in_their_sum_alone():
    slope = np.random.default_rng(3).normal(size=(2, 40, 4))
    both = np.concatenate([slope, slope[:, :, 3:]], axis=2)
    found, one = eliminated(both, 2).covariance(), eliminated(slope, 2).covariance()
    total = np.array([0.0, 1.0, 1.0])
    assert total @ found @ total == pytest.approx(one[1, 1], rel=1e-3)
    assert found[1, 1] > 1e6 * one[1, 1]


def test_pieces_of_fewer_readings_than_their_states_tell_nothing():
    slope = np.random.default_rng(4).normal(size=(2, 2, 5))
    assert np.all(np.diag(eliminated(slope, 3).covariance()) > 1e6)
