"""B-splines are those of SciPy."""

from __future__ import annotations

import numpy as np

from latticebench.methods.engine.bsplines import BSplines, through


def test_the_basis_and_its_slopes_are_those_of_scipy():
    from scipy.interpolate import BSpline

    splines = BSplines(np.concatenate([np.zeros(6), [0.2, 0.5, 0.7], np.ones(6)]), 5)
    t = np.linspace(0, 1, 17)
    first, value, slope = splines.basis(t)
    every = BSpline(splines.knots, np.eye(splines.count), 5)
    for k in range(len(t)):
        np.testing.assert_allclose(value[k], every(t)[k, first[k] : first[k] + 6], atol=1e-12)
        np.testing.assert_allclose(slope[k], every(t, 1)[k, first[k] : first[k] + 6], atol=1e-10)
    for derivative in (0, 1):
        np.testing.assert_allclose(splines.design(t, derivative), every(t, derivative), atol=1e-10)


def test_clamped_knots_and_the_curve_through_values():
    splines = BSplines.clamped(np.linspace(0, 1, 5), 3)
    np.testing.assert_array_equal(splines.knots, [0, 0, 0, 0, 0.25, 0.5, 0.75, 1, 1, 1, 1])
    t = np.linspace(0, 2, 12)
    values = np.stack([t**5, 1 - t**2], axis=1)
    basis, coefficients = through(t, values, 5)
    at = np.linspace(0, 2, 33)
    np.testing.assert_allclose(basis.design(at, 0) @ coefficients, np.stack([at**5, 1 - at**2], axis=1), atol=1e-11)
    np.testing.assert_allclose(basis.design(at, 2) @ coefficients[:, 1], -2.0, atol=1e-9)
