"""The loss and its gradient against its formula, finite differences, and batches on torch."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.networks.arrays import Arrays
from latticebench.methods.engine.networks.loss import LossSettings, NetworkLoss
from latticebench.methods.engine.networks.network import initial_weights
from latticebench.methods.engine.networks.sizes import estimate_sizes
from latticebench.systems.lattice import Library, library
from latticebench.systems.samples import Samples


def chain(sites: int = 7, ends: str = "unknown", *, is_complex: bool = False, forced: bool = False) -> Samples:
    """Smooth made-up motion, with a velocity that is not the field's, so that every residual differs from zero."""
    t = np.linspace(0.5, 2.5, 12)
    n = np.arange(sites)
    u = np.sin(t[:, None] + 0.7 * n) + 0.3 * n
    v = np.cos(1.3 * t[:, None] - 0.4 * n)
    if is_complex:
        return Samples(t, u + 1j * v, ends=ends)  # type: ignore[arg-type]
    return Samples(t, u, v, np.cos(2 * t)[:, None] + 0 * u if forced else None, ends=ends)  # type: ignore[arg-type]


def loss_of(samples: Samples, terms: Library, order: int, *, mirror: bool = False, members: int = 0) -> NetworkLoss:
    """Return the loss of one network on NumPy arrays, or of members on torch."""
    settings = LossSettings(2, 12, 41, 100.0, (members,) if members else ())
    arrays = Arrays("cpu:0" if members else "cpu")
    sets = [samples, samples.mirrored()] if mirror else [samples]
    return NetworkLoss(sets, terms, order, estimate_sizes([samples], terms, order), settings, arrays)


CASES = {
    "interior sites": (chain(), "u[n+1]; u[n-1]; u[n]**3; sin(2*u[n]); v[n]; 1/(2+u[n]**2)", 2, False),
    "free ends": (chain(5, "free"), "u[n+1]; u[n-2]; u[n]**2*v[n+1]; sign(v[n]); abs(u[n])", 2, False),
    "antiperiodic ends": (chain(4, "antiperiodic"), "u[n+1]+u[n-1]; u[n]**5; n*u[n]; cos(1.7*t)", 2, False),
    "fixed ends and an input": (chain(4, "fixed", forced=True), "u[n+1]; f[n]; u[n]*f[n]; sqrt(abs(u[n])+1)", 2, False),
    "mirrored": (chain(), "u[n+1]; u[n]**2; u[n]**3", 2, True),
    "first order": (chain(6), "u[n+1]; u[n-1]; tanh(u[n])", 1, False),
    "complex": (
        chain(6, is_complex=True),
        "u[n+1]; i*u[n-1]; abs(u[n])**2*u[n]; i*conj(u[n])**2; abs(u[n+1])*u[n]",
        1,
        False,
    ),
    "complex, periodic": (chain(5, "periodic", is_complex=True), "u[n+1]; i*u[n]; i*u[n-1]**2", 1, True),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_the_gradient_is_that_of_finite_differences(name):
    samples, texts, order, mirror = CASES[name]
    terms = library("lib", texts)
    one = loss_of(samples, terms, order, mirror=mirror)
    draw = np.random.default_rng(2)
    weights = initial_weights(one.shapes, 2.0, draw) + 0.05 * draw.normal(size=one.count)
    xi = draw.normal(size=len(terms.texts))
    gradient, by_xi = np.zeros(one.count), np.zeros(len(xi))
    one.loss(weights, xi, gradient, by_xi)
    spare, rest = np.zeros(one.count), np.zeros(len(xi))
    for step in (draw.normal(size=one.count) / np.sqrt(one.count) for _ in range(4)):
        ahead, behind = (one.loss(weights + sign * 1e-5 * step, xi, spare, rest) for sign in (1, -1))
        assert gradient @ step == pytest.approx((ahead - behind) / 2e-5, rel=1e-6, abs=1e-7)
    for k in range(len(xi)):
        step = np.eye(len(xi))[k]
        ahead, behind = (one.loss(weights, xi + sign * 1e-5 * step, spare, rest) for sign in (1, -1))
        assert by_xi[k] == pytest.approx((ahead - behind) / 2e-5, rel=1e-6, abs=1e-7)


def test_the_loss_is_the_one_written_in_the_module():
    samples = chain(5)
    terms = library("lib", "u[n+1]; u[n-1]; u[n]**3")
    one = loss_of(samples, terms, 2)
    size = estimate_sizes([samples], terms, 2)
    weights = initial_weights(one.shapes, 2.0, np.random.default_rng(3))
    xi = np.array([0.3, -0.2, 0.7])
    found = one.loss(weights, xi, np.zeros(one.count), np.zeros(3))

    def curve(t):
        x, first = (t - 0.5) / 1.0 - 1, 0
        h = x[:, None]
        for number, (rows, width) in enumerate(one.shapes):
            layer = weights[first : first + rows * width].reshape(rows, width)
            first += rows * width
            h = h @ layer[:-1] + layer[-1]
            h = np.tanh(h) if number < len(one.shapes) - 1 else h
        return h[:, :5] * size.field, h[:, 5:] * size.velocity

    u, v = curve(samples.t)
    assert samples.v is not None
    data = np.mean((u - samples.u) ** 2) / size.field**2 + np.mean((v - samples.v) ** 2) / size.velocity**2
    t, e = np.linspace(0.5, 2.5, 41), 1e-5
    u, v = curve(t)
    du, dv = ((b - a) / (2 * e) for a, b in zip(curve(t - e), curve(t + e), strict=True))
    law = 0.3 * u[:, 2:] - 0.2 * u[:, :-2] + 0.7 * u[:, 1:-1] ** 3
    residual = np.mean((du - v) ** 2) / size.velocity**2 + np.mean((dv[:, 1:-1] - law) ** 2) / size.rate**2
    assert found == pytest.approx(100 * data + residual, rel=1e-8)


@pytest.mark.parametrize("name", CASES)
def test_a_batch_of_members_on_torch_has_the_losses_and_gradients_of_each_alone_on_numpy(name):
    pytest.importorskip("torch")
    samples, texts, order, mirror = CASES[name]
    terms = library("lib", texts)
    one = loss_of(samples, terms, order, mirror=mirror)
    batch = loss_of(samples, terms, order, mirror=mirror, members=3)
    move = batch.arrays.move
    draw = np.random.default_rng(5)
    weights = np.stack([initial_weights(one.shapes, 2.0, draw) for _ in range(3)])
    xi = draw.normal(size=(3, len(terms.texts)))
    gradient, by_xi = (move(np.zeros(array.shape)) for array in (weights, xi))
    loss = batch.loss(move(weights), move(xi), gradient, by_xi)
    missed, whole = batch.squares(move(weights), move(xi))
    for member in range(3):
        alone, rest = np.zeros(one.count), np.zeros(len(xi[0]))
        assert float(loss[member]) == pytest.approx(one.loss(weights[member], xi[member], alone, rest), rel=1e-12)
        np.testing.assert_allclose(np.asarray(gradient[member]), alone, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(np.asarray(by_xi[member]), rest, rtol=1e-9, atol=1e-11)
        expected = one.squares(weights[member], xi[member])
        np.testing.assert_allclose([float(missed[member]), float(whole[member])], expected, rtol=1e-11)
