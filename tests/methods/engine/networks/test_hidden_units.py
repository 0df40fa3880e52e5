"""Drawn tanh units: orthonormal, with their exact derivatives."""

from __future__ import annotations

import numpy as np

from latticebench.methods.engine.networks.hidden_units import draw_basis


def test_the_hidden_layer_is_orthonormal_and_its_derivatives_are_those_of_finite_differences():
    times = np.linspace(1, 4, 81)
    inner = np.array([1.7, 2.2, 3.9])
    e = 1e-4
    basis, at = draw_basis(times, np.concatenate([inner - e, inner, inner + e]), 15, 4.0, np.random.default_rng(0))
    units = basis.value.shape[1]
    np.testing.assert_allclose(basis.value.T @ basis.value / 81, np.eye(units), atol=1e-5)
    before, here, after = np.split(at.value, 3)
    well = np.max(np.abs(here), axis=0) < 1e3
    np.testing.assert_allclose(at.first[3:6][:, well], ((after - before) / (2 * e))[:, well], rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(
        at.second[3:6][:, well], ((after - 2 * here + before) / e**2)[:, well], rtol=1e-2, atol=1
    )
