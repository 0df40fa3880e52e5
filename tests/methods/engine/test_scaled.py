"""Scaled least squares are those of NumPy, with honest errors where columns depend on each other."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.scaled import Scaled, inverse_of_squares, lstsq

ROWS = np.random.default_rng(0).normal(size=(30, 3)) * [1e-6, 1.0, 1e5]
TARGET = np.random.default_rng(1).normal(size=30)


def test_the_solution_and_its_covariance_are_those_of_the_normal_equations():
    wanted = np.linalg.inv(ROWS.T @ ROWS)
    found = Scaled.of(ROWS)
    np.testing.assert_allclose(found.covariance(), wanted, rtol=1e-9)
    np.testing.assert_allclose(found.stderr(), np.sqrt(np.diag(wanted)), rtol=1e-9)
    np.testing.assert_allclose(inverse_of_squares(ROWS.T @ ROWS), wanted, rtol=1e-9)
    solution = np.linalg.lstsq(ROWS, TARGET, rcond=None)[0]
    np.testing.assert_allclose(found.solution(TARGET), solution, rtol=1e-9)
    np.testing.assert_allclose(lstsq(ROWS, TARGET, 1e-14), solution, rtol=1e-9)


def test_columns_that_depend_on_each_other_have_vast_errors_and_the_others_have_not():
    rows = np.column_stack([ROWS, 2 * ROWS[:, 0]])
    found = Scaled.of(rows)
    np.testing.assert_allclose(found.stderr()[1:3], Scaled.of(ROWS).stderr()[1:], rtol=1e-9)
    assert np.all(np.isinf(found.stderr()[[0, 3]]))
    assert np.all(np.diag(found.covariance())[[0, 3]] > 1e6 * Scaled.of(ROWS).stderr()[0] ** 2)
    solution = found.solution(TARGET)
    assert solution[0] + 2 * solution[3] == pytest.approx(Scaled.of(ROWS).solution(TARGET)[0])


def test_rows_that_say_nothing_move_nothing():
    found = Scaled.of(np.zeros((4, 2)))
    np.testing.assert_array_equal(found.solution(np.ones(4)), 0.0)
    assert np.all(np.diag(found.covariance()) > 1e100)
    assert np.all(np.isinf(found.stderr()))
