"""Curves held to an equation: the derivatives of its residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from latticebench import systems
from latticebench.methods.engine.collocation import place_curves, residuals
from latticebench.methods.engine.record import prepare
from latticebench.systems.simulate import sample_times, simulate


@pytest.mark.parametrize(("name", "candidates"), [("phi4", "lib4"), ("dnls", "ten")])
@pytest.mark.parametrize("ends", ["free", "unknown", "antiperiodic"])
def test_the_equations_derivatives_are_those_of_differences(name, candidates, ends):
    system = systems.find(name)
    one = system.library(candidates)
    samples = replace(simulate(system, sites=7, times=sample_times(9, 2.0)), ends=ends)
    curves = place_curves(prepare(samples, one.terms, system.order), 5, 1.0)
    draw = np.random.default_rng(0)
    splines = draw.normal(size=curves.basis.count * curves.each)
    coefficients = draw.normal(size=len(one.terms))
    found = residuals(curves, splines, coefficients)
    along = draw.normal(size=splines.size)
    across = draw.normal(size=coefficients.size)
    step = 1e-5
    plus = residuals(curves, splines + step * along, coefficients + step * across, derivatives=False).value
    minus = residuals(curves, splines - step * along, coefficients - step * across, derivatives=False).value
    expected = (plus - minus) / (2 * step)
    got = found.by_spline @ along + found.by_coefficient @ across
    np.testing.assert_allclose(got, expected, atol=1e-6 * np.max(np.abs(expected)))
