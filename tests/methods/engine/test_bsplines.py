"""B-splines are those of SciPy."""

from __future__ import annotations

import numpy as np

from latticebench.methods.engine.bsplines import BSplines


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
