"""The normal equations against finite differences and plain linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.networks.arrays import Arrays
from latticebench.methods.engine.networks.projection import Curve, CurveSettings, projected_step
from latticebench.methods.engine.networks.sizes import estimate_sizes
from latticebench.systems.lattice import Library, library
from latticebench.systems.samples import Samples


def chain(sites: int, ends: str = "unknown", *, is_complex: bool = False) -> Samples:
    t = np.linspace(0.5, 2.5, 15)
    u = np.sin(t[:, None] + 0.7 * np.arange(sites)) + 0.2
    v = np.cos(1.3 * t[:, None] - 0.4 * np.arange(sites))
    if is_complex:
        return Samples(t, u + 1j * v, ends=ends)  # type: ignore[arg-type]
    return Samples(t, u, v, ends=ends)  # type: ignore[arg-type]


def curve_of(samples: Samples, terms: Library, order: int, width: int, draw: np.random.Generator) -> Curve:
    sizes = estimate_sizes([samples], terms, order)
    return Curve(samples, terms, order, sizes, CurveSettings(width, 3.0, 21), [draw], Arrays("cpu"))


CASES = {
    "interior sites": (chain(5), "u[n+1]; u[n-1]; u[n]**3; v[n]", 2),
    "free ends": (chain(4, "free"), "u[n+1]+u[n-1]; u[n]**2*v[n+1]", 2),
    "antiperiodic ends": (chain(4, "antiperiodic"), "u[n+1]; n*u[n]; cos(1.7*t)", 2),
    "fixed ends": (chain(4, "fixed"), "u[n+1]; u[n-1]; u[n]", 1),
    "complex": (chain(5, is_complex=True), "u[n+1]; i*u[n-1]; abs(u[n])**2*u[n]", 1),
}


@pytest.mark.parametrize("name", CASES)
def test_the_right_hand_side_is_minus_half_the_slope_of_the_objective(name):
    samples, texts, order = CASES[name]
    terms = library("lib", texts)
    draw = np.random.default_rng(1)
    curve = curve_of(samples, terms, order, 6, draw)
    a, xi = curve.weights + 0.1 * draw.normal(size=curve.weights.shape), draw.normal(size=len(terms.texts))
    matrix, right = curve.normal(a, xi, 0.7)
    np.testing.assert_allclose(matrix, matrix.T, rtol=1e-9, atol=1e-9 * np.max(np.abs(matrix)))

    def objective(shift: np.ndarray) -> float:
        moved = a + shift[: curve.unknowns].reshape(curve.outputs, curve.units).T
        data, law = curve.misfits(moved, xi + shift[curve.unknowns :])
        return data + 0.7**2 * law

    for _ in range(5):
        way = draw.normal(size=len(right)) / np.sqrt(len(right))
        slope = (objective(1e-5 * way) - objective(-1e-5 * way)) / 2e-5
        assert -2 * right @ way == pytest.approx(slope, rel=1e-5, abs=1e-6 * np.max(np.abs(right)))


def test_a_step_and_the_trace_of_the_hat_matrix_are_those_of_plain_linear_algebra():
    samples, texts, order = CASES["interior sites"]
    curve = curve_of(samples, library("lib", texts), order, 5, np.random.default_rng(2))
    xi = np.array([0.5, 0.2, -0.3, 0.1])
    matrix, right = curve.normal(curve.weights, xi, 0.3)
    change = np.linalg.solve(matrix, right)
    found = projected_step([curve], [curve.weights], xi, 0.3, np.float64(0.0), hat=True)
    np.testing.assert_allclose(found.coefficients - xi, change[curve.unknowns :], rtol=1e-5, atol=1e-8)
    moved = change[: curve.unknowns].reshape(curve.outputs, curve.units).T
    np.testing.assert_allclose(found.weights[0] - curve.weights, moved, rtol=1e-4, atol=1e-7)
    inverse = np.linalg.inv(matrix)
    np.testing.assert_allclose(found.covariance, inverse[curve.unknowns :, curve.unknowns :], rtol=1e-5)
    of_data, _ = curve.normal(curve.weights, xi, 0.0)
    # Between the trace without and with the coefficients' share, which is counted whole.
    exact = float(np.trace(inverse @ of_data))
    assert exact - 1e-6 <= found.freedom <= exact + len(xi) + 1e-6
