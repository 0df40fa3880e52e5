"""The equations of a step against a dense least-squares problem whose derivatives are differences; on a device too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from latticebench.methods.engine.networks.arrays import Arrays, host
from latticebench.methods.engine.networks.curve_batch import batch_equations, curve_batch
from latticebench.methods.engine.networks.hidden_layer import draw_layer
from latticebench.methods.engine.networks.trained_curve import Weights, place_curve, step_equations
from latticebench.methods.engine.record import prepare
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

STEP = 1e-6


def recording(sites, ends, *, is_complex=False):
    draw = np.random.default_rng(7)
    t = np.sort(draw.uniform(0, 3, 12))
    u = np.sin(t[:, None] + 0.7 * np.arange(sites)) + 0.1 * draw.normal(size=(12, sites))
    v = np.cos(t[:, None] + 0.7 * np.arange(sites))
    u[3, 1] = np.nan
    return Samples(t, u + 1j * v, ends=ends) if is_complex else Samples(t, u, v, ends=ends)


CASES = {
    "free": (recording(5, "free"), "u[n+1]; u[n-1]; u[n]**3; v[n]", 2),
    "unknown": (recording(6, "unknown"), "u[n+1]+u[n-1]-2*u[n]; u[n]**3", 2),
    "ring": (recording(6, "periodic"), "u[n+1]; u[n-1]; v[n+1]-v[n]", 2),
    "complex": (recording(4, "fixed", is_complex=True), "i*(u[n+1]+u[n-1]-2*u[n]); abs(u[n])**2*u[n]", 1),
}


def residuals(curve, weights, xi, sigma, weight):
    layer = curve.layer(weights.theta)
    missed = (curve.value - curve.fitted(layer, weights.a)) / sigma[:, None, None]
    left, _, _ = curve.law(layer, weights.a, xi, derivatives=False)
    law = left * np.sqrt(weight * curve.measure)[:, None, None]
    return np.concatenate([missed[curve.seen], law.ravel(), (weights.a / curve.decay).ravel()])


@pytest.mark.parametrize("activation", ["sine", "tanh"])
@pytest.mark.parametrize("name", CASES)
def test_a_step_solves_the_linearised_least_squares_problem(name, activation):
    samples, terms, order = CASES[name]
    record = prepare(samples, library("mine", terms).terms, order)
    draw = np.random.default_rng(3)
    curve = place_curve(record, activation, 11, decay=3.0)
    theta = draw_layer(activation, 3, 0.0, draw)
    weights = Weights(theta, draw.normal(size=(7, curve.place.size)) / 3)
    xi = draw.normal(size=len(record.stretches.dynamics.terms))
    sigma, weight = np.array([0.3, 0.4])[: len(curve.value)], 2.0
    step = step_equations(curve, weights, xi, sigma, weight, train=True)
    inner, numbers = len(step.own), len(theta)

    def moved(change):
        a = weights.a + step.turn @ change[:inner].reshape(curve.place.size, -1).T
        there = Weights(theta + change[inner : inner + numbers], a)
        return residuals(curve, there, xi + change[inner + numbers :], sigma, weight)

    units = np.eye(inner + numbers + len(xi))
    dense = np.stack([(moved(STEP * unit) - moved(-STEP * unit)) / (2 * STEP) for unit in units], axis=1)
    expected = np.linalg.lstsq(dense, -moved(0 * units[0]), rcond=None)[0]
    last = np.linalg.solve(step.schur, step.aim)
    found = np.concatenate([step.own - step.across @ last, last])
    np.testing.assert_allclose(dense @ found, dense @ expected, atol=1e-5 * np.linalg.norm(dense @ expected))


@pytest.mark.parametrize("train", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_members_on_a_device_take_the_steps_of_single_networks(name, train):
    pytest.importorskip("torch")
    samples, terms, order = CASES[name]
    given = library("mine", terms)
    curve = place_curve(prepare(samples, given.terms, order), "tanh" if name == "free" else "sine", 11, decay=3.0)
    draw, arrays = np.random.default_rng(3), Arrays("cpu:0")
    members = [
        Weights(draw_layer(curve.activation, 3, 0.0, draw), draw.normal(size=(7, curve.place.size)) / 3)
        for _ in range(3)
    ]
    xi, values = draw.normal(size=(3, len(given.terms))), curve.value + draw.normal(size=(3, *curve.value.shape))
    values *= curve.seen
    sigma, weight = np.array([0.3, 0.4])[: len(curve.value)], 2.0
    batch = curve_batch(curve, samples, given, values, arrays)
    weights = Weights(*(arrays.move(np.stack(parts)) for parts in zip(*members, strict=True)))
    steps = batch_equations(batch, weights, arrays.move(xi), arrays.move(sigma), weight, train=train)
    signs = draw.choice([-1.0, 1.0], size=(*curve.value.shape, 5))
    freedom = host(steps.freedom(batch, arrays.move(sigma), arrays.move(signs)))
    missed = [host(one) for one in batch.misfits(weights, arrays.move(xi))]
    for member, one in enumerate(members):
        alone = replace(curve, value=values[member])
        step = step_equations(alone, one, xi[member], sigma, weight, train=train)
        for found, expected in (
            (host(steps.schur)[member], step.schur),
            (host(steps.aim)[member], step.aim),
            (host(steps.damped)[member], step.damped),
            # The orthonormal functions are others, the units' weights are not.
            (
                host(steps.turn)[member] @ host(steps.own)[member].reshape(curve.place.size, -1).T,
                step.turn @ step.own.reshape(curve.place.size, -1).T,
            ),
            (freedom[member], step.freedom(alone, sigma, signs)),
            (
                np.append(missed[0][member], [one[member] for one in missed[1:]]),
                np.hstack(alone.misfits(one, xi[member])),
            ),
        ):
            np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.max(np.abs(expected), initial=0))


def test_the_degrees_of_freedom_are_the_trace_of_the_hat_matrix():
    samples, terms, order = CASES["free"]
    curve = place_curve(prepare(samples, library("mine", terms).terms, order), "sine", 11, decay=3.0)
    draw = np.random.default_rng(3)
    weights = Weights(draw_layer("sine", 3, 0.0, draw), draw.normal(size=(7, curve.place.size)) / 3)
    sigma = np.array([0.3, 0.4])
    step = step_equations(curve, weights, np.ones(4), sigma, 1.0, train=False)
    # One probe per observed number, instead of random signs, gives the trace itself.
    count = curve.value[0].size
    probes = np.eye(count).reshape(*curve.value[0].shape, count) * count**0.5
    exact = step.freedom(curve, sigma, np.stack([probes, probes]))
    signs = draw.choice([-1.0, 1.0], size=(*curve.value.shape, 4000))
    np.testing.assert_allclose(step.freedom(curve, sigma, signs), exact, rtol=0.05)
    assert np.all(exact > 0)
    assert np.sum(exact) < curve.place.size * weights.a.shape[0]
