"""A hidden layer's derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.networks.hidden_layer import draw_layer, evaluate_layer

STEP = 1e-6


@pytest.mark.parametrize("activation", ["sine", "tanh"])
def test_the_levels_of_the_units_are_derivatives_by_time(activation):
    theta = draw_layer(activation, 4, 0.0, np.random.default_rng(1))
    tau, half = np.linspace(-1, 1, 9), 2.5
    levels = evaluate_layer(activation, theta, tau, half).levels
    assert levels.shape == (3, 9, 9)
    after, before = (evaluate_layer(activation, theta, tau + sign * STEP, half).levels for sign in (1, -1))
    slopes = (after - before)[:2] / (2 * STEP * half)
    np.testing.assert_allclose(levels[1:], slopes, atol=1e-7 * np.max(np.abs(levels)))


@pytest.mark.parametrize("activation", ["sine", "tanh"])
def test_the_moves_are_derivatives_by_the_numbers_of_the_layer(activation):
    theta = draw_layer(activation, 3, 0.0, np.random.default_rng(2))
    tau, half = np.linspace(-1, 1, 7), 0.5
    layer = evaluate_layer(activation, theta, tau, half)
    whole = np.zeros((*layer.levels.shape, len(theta)))
    for move in layer.moves:
        numbers, units = np.arange(len(theta))[move.numbers], np.arange(whole.shape[2])[move.units]
        whole[:, :, units, numbers] += move.levels
    for number in range(len(theta)):
        shift = STEP * np.eye(len(theta))[number]
        after, before = (evaluate_layer(activation, theta + sign * shift, tau, half).levels for sign in (1, -1))
        differences = (after - before) / (2 * STEP)
        np.testing.assert_allclose(whole[..., number], differences, atol=1e-7 * np.max(np.abs(layer.levels)))
