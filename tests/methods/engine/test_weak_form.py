"""The weak form: its test functions, its integrals, and the derivatives of its residual."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import gamma, jv

from latticebench import systems
from latticebench.methods.engine.weak_form import WeakForm, bumps
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, sample_times, simulate


@pytest.mark.parametrize("power", [4, 12])
def test_the_test_functions_derivatives_agree_with_those_of_their_polynomial(power: int) -> None:
    t = np.linspace(-0.5, 2.5, 61)
    found = bumps(t, np.array([1.0]), 1.25, power)
    polynomial = np.polynomial.Polynomial([1.0, 0.0, -1.0]) ** power
    s = (t - 1.0) / 1.25
    for order in range(3):
        derivative = polynomial.deriv(order) if order else polynomial
        expected = np.where(np.abs(s) < 1, derivative(s) / 1.25**order, 0.0)
        np.testing.assert_allclose(found[order, 0], expected, atol=1e-9 * np.max(np.abs(expected)))


def test_the_weak_integrals_of_a_harmonic_oscillator_are_those_of_bessel_functions() -> None:
    # int (1 - s^2)^p cos(w (c + a s)) a ds = a cos(w c) sqrt(pi) Gamma(p + 1) (2 / (w a))^(p + 1/2) J_{p + 1/2}(w a)
    w, power = 1.7, 12
    t = sample_times(200)
    form = WeakForm(Samples(t, np.cos(w * t)[:, None]), library("one", "u[n]"), 2, 3.5, power)
    target, design = form.rows(form.state.seen, form.block(0))
    a = form.support
    centres = np.linspace(t[0] + a, t[-1] - a, form.count)
    expected = a * np.cos(w * centres) * np.sqrt(np.pi) * gamma(power + 1) * (2 / (w * a)) ** (power + 0.5)
    expected = expected * jv(power + 0.5, w * a)
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(design[0, :, 0], expected, atol=1e-10 * size)
    np.testing.assert_allclose(target[0], -(w**2) * expected, atol=1e-9 * size)


def test_the_trapezoidal_rule_on_test_functions_converges_faster_than_their_smoothness_lets_expect() -> None:
    def integral(points: int) -> float:
        t = np.linspace(-1.0, 1.0, points + 1)
        return float(np.sum(bumps(t, np.zeros(1), 1.0, 12)[0, 0] * np.exp(t)) * (t[1] - t[0]))

    exact = integral(2000)
    errors = [abs(integral(points) - exact) for points in (8, 16, 32)]
    assert errors[1] < 1e-3 * errors[0]
    assert errors[2] < 1e-12


def test_the_residuals_slope_is_its_finite_difference() -> None:
    terms = library("mine", "u[n+1]; u[n]**3; v[n]; v[n]**2*u[n-1]; cos(t)*u[n]; n*u[n]")
    clean = simulate(systems.find("phi4"), times=sample_times(60))
    samples = replace(observe(clean, np.random.default_rng(0), noise=0.01).observed(), ends="free")
    form = WeakForm(samples, terms, 2, 3.5, 12)
    coefficients = np.array([0.3, -1.0, 0.2, 0.5, 0.7, -0.1])
    w = form.state.seen
    direction = np.random.default_rng(0).normal(size=w.shape)

    block = form.block(0)

    def residual(state: np.ndarray) -> np.ndarray:
        target, design = form.rows(state, block)
        return np.asarray(target - design @ coefficients)

    expected = (residual(w + 1e-4 * direction) - residual(w - 1e-4 * direction)) / 2e-4
    slopes = form.slopes(w, coefficients, block)
    found = slopes.moved(direction[slopes.channel])
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.max(np.abs(expected)))
