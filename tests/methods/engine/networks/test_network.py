"""The network against automatic differentiation."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.methods.engine.networks.network import forward, initial_weights, layer_shapes, split_layers, workspace


def test_the_tangent_is_the_derivative_that_torch_finds_by_forward_mode():
    torch = pytest.importorskip("torch")
    shapes = layer_shapes(3, 9, 5)
    weights = initial_weights(shapes, 3.0, np.random.default_rng(1)) + 0.1
    layers = split_layers(weights, shapes)
    x = np.linspace(-1, 1, 11)[:, None]
    out = forward(layers, x, workspace(shapes, 11, 8, lambda a: a), np)
    tensors = [torch.from_numpy(layer) for layer in layers]

    def network(time):
        h = time
        for layer in tensors[:-1]:
            h = torch.tanh(h @ layer[:-1] + layer[-1])
        return h @ tensors[-1][:-1] + tensors[-1][-1]

    value, tangent = torch.func.jvp(network, (torch.from_numpy(x),), (torch.ones(11, 1, dtype=torch.float64),))
    np.testing.assert_allclose(out[:11], value.numpy(), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(out[11:], tangent.numpy()[:8], rtol=1e-12, atol=1e-13)
