"""Banded systems of several members against dense ones."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.networks.arrays import Arrays, host
from latticebench.methods.engine.networks.block_band import factor_band

MEMBERS, R = 3, 2


@pytest.mark.parametrize(("outputs", "diagonals"), [(1, 1), (4, 1), (5, 2), (7, 3), (6, 5)])
def test_dividing_solves_each_member_and_an_indefinite_matrix_is_told(outputs, diagonals):
    pytest.importorskip("torch")
    draw, arrays = np.random.default_rng(outputs), Arrays("cpu:0")
    size = outputs * R
    place = np.arange(size) // R
    inside = np.abs(place[:, None] - place) < diagonals
    dense = draw.normal(size=(MEMBERS, size, size)) * inside
    dense = (dense + np.swapaxes(dense, 1, 2)) / 2 + np.eye(size) * 4 * size
    # Members of unlike scale, the last of them not positive.
    dense *= np.array([1e-6, 1.0, 1e6])[:, None, None]
    dense[2, 0, 0] = -dense[2, 0, 0]
    band = np.zeros((MEMBERS, outputs, diagonals, R, R))
    for column in range(outputs):
        for d in range(min(diagonals, outputs - column)):
            rows, columns = (slice(k * R, (k + 1) * R) for k in (column + d, column))
            band[:, column, d] = dense[:, rows, columns]
    divide, sound = factor_band(arrays.move(band), arrays, 0.0)
    right = draw.normal(size=(MEMBERS, size, 4))
    found = host(divide(arrays.move(right)))
    assert host(sound).tolist() == [True, True, False]
    np.testing.assert_allclose(found[:2], np.linalg.solve(dense[:2], right[:2]), rtol=1e-9)
