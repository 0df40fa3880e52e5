"""Linear algebra that is the same on NumPy arrays and torch tensors."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.networks.arrays import Arrays


@pytest.mark.parametrize("device", ["cpu", "cpu:0"])
def test_a_matrix_that_cannot_be_factorised_is_told_and_the_others_are_right(device):
    pytest.importorskip("torch")
    arrays = Arrays(device)
    good = np.array([[4.0, 1.0], [1.0, 3.0]])
    bad = np.array([[1.0, 2.0], [2.0, 1.0]])
    batches = [good, bad] if device == "cpu" else [np.stack([good, bad])]
    results = [arrays.cholesky(arrays.move(one.copy())) for one in batches]
    sound = np.concatenate([np.atleast_1d(np.asarray(one)) for _, one in results])
    assert sound.tolist() == [True, False]
    factor = results[0][0]
    right = arrays.move(np.ones((2, 1)) if device == "cpu" else np.ones((2, 2, 1)))
    solved, inverse = np.asarray(arrays.solve(factor, right)), np.asarray(arrays.inverse(factor))
    if device != "cpu":
        solved, inverse = solved[0], inverse[0]
    np.testing.assert_allclose(good @ solved, np.ones((2, 1)), rtol=1e-14)
    np.testing.assert_allclose(np.tril(inverse).T @ np.tril(inverse) @ good, np.eye(2), atol=1e-14)
