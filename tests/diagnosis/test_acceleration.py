"""Accelerations along a motion, from its states alone."""

import numpy as np
import pytest

from latticebench.diagnosis.acceleration import Acceleration


def times(step):
    """Three pieces of uneven steps, of which the last has its last row three times."""
    draw = np.random.default_rng(3)
    t = np.cumsum(step * draw.uniform(0.7, 1.3, (3, 12)), axis=1)
    t[2, 9:] = t[2, 9]
    return t


def quintic(t):
    """A polynomial of degree 5, with its first two derivatives."""
    one = np.polynomial.Polynomial([0.3, -1.0, 0.5, 0.7, -0.4, 0.2])
    return one(t), one.deriv()(t), one.deriv(2)(t)


def test_inside_a_piece_of_even_steps_polynomials_of_degree_five_have_exact_accelerations():
    t = np.tile(0.1 * np.arange(8.0), (2, 1))
    u, v, a = quintic(t)
    np.testing.assert_allclose(Acceleration.along(t).of(u, v)[:, 1:-1], a[:, 1:-1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("rows", "order"), [(slice(1, 8), 3), (slice(0, 1), 2)])
def test_errors_fall_with_the_third_power_of_the_step_and_at_the_ends_of_a_piece_with_its_square(rows, order):
    errors = []
    for step in (0.2, 0.1, 0.05):
        t = times(step)
        errors.append(np.max(np.abs(Acceleration.along(t).of(np.sin(t), np.cos(t)) + np.sin(t))[:, rows]))
    assert np.all(np.log2(np.array(errors[:-1]) / errors[1:]) > order - 0.4)


def test_beside_a_gap_and_where_rows_are_repeated_the_nearer_neighbour_is_used_alone():
    t = np.concatenate([0.05 * np.arange(6.0), 3 + 0.05 * np.arange(6.0), [3.25, 3.25]])[None]
    found = Acceleration.along(t).of(np.sin(t), np.cos(t))
    np.testing.assert_allclose(found[0, :12], -np.sin(t[0, :12]), atol=5e-4)
    assert np.all(found[0, 12:] == 0)


def test_derivatives_go_back_as_the_transposed_of_how_accelerations_are_made():
    draw = np.random.default_rng(5)
    one = Acceleration.along(times(0.1))
    u, v, by = draw.normal(size=(3, 3, 12, 2))
    by_u, by_v = one.back(by)
    assert np.sum(by * one.of(u, v)) == pytest.approx(np.sum(by_u * u + by_v * v))
