"""Curves held to an equation: the derivatives of its residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from latticebench import systems
from latticebench.methods.engine.collocation import ROUGHNESS, objective, place_curves, residuals
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


@pytest.mark.parametrize("bending", [False, True])
def test_the_objective_is_the_sum_of_misfits_residuals_and_roughness(bending):
    system = systems.find("phi4")
    one = system.library("lib2")
    samples = replace(simulate(system, sites=5, times=sample_times(9, 2.0)), ends="free")
    curves = place_curves(prepare(samples, one.terms, system.order), 5, 1.0)
    bent = np.random.default_rng(5).normal(size=(3, curves.basis.count * curves.each))
    curves = replace(curves, rough=bent if bending else None)
    draw = np.random.default_rng(0)
    splines, coefficients = draw.normal(size=curves.basis.count * curves.each), draw.normal(size=len(one.terms))
    sigma = np.array([0.3, 0.7])
    whole, misfit, left = objective([curves, curves], [splines, splines], coefficients, sigma, 2.5)
    read = [np.sum((y - m @ splines) ** 2) for m, y in zip(curves.maps, curves.values, strict=True)]
    np.testing.assert_allclose(misfit, 2 * np.array(read))
    assert left == pytest.approx(2 * np.sum(residuals(curves, splines, coefficients, derivatives=False).value ** 2))
    rough = 2 * ROUGHNESS * np.sum((bent @ splines) ** 2) / 0.09 if bending else 0.0
    assert whole == pytest.approx(np.sum(misfit / sigma**2) + 2.5 * left + rough, rel=1e-12)
