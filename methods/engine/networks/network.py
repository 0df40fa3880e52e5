"""A fully connected tanh network of time, with its time derivative and its gradient written out by hand.

The scaled time x in [-1, 1] goes in, M outputs come out. With h_0 = x and the weights W_l and biases b_l of layer l,

    z_l = h_(l-1) W_l + b_l,   h_l = tanh(z_l),   out = h_(L-1) W_L + b_L
    dz_l/dx = dh_(l-1)/dx W_l,   dh_l/dx = (1 - h_l^2) dz_l/dx

R times are evaluated at once; the first P of them get their derivative by x as well. Values (R rows) and derivatives
(P rows) are rows of one matrix, so that a layer is one product, forwards and backwards.

A layer is one matrix (in + 1, out): its weights, and its bias as the last row. All layers of a network, one after the
other, row by row, are one vector of weights.

The same code runs on NumPy arrays and on torch tensors. `...` in a shape is nothing for one network, or on torch one
axis of members: networks of the same shape that are evaluated together.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.networks.arrays import Array


def layer_shapes(layers: int, width: int, outputs: int) -> list[tuple[int, int]]:
    """Return the shape (in + 1, out) of each layer of a network.

    Args:
        layers: the number of hidden layers.
        width: the number of tanh units in each.
        outputs: M.
    """
    sizes = [1, *[width] * layers, outputs]
    return [(before + 1, after) for before, after in itertools.pairwise(sizes)]


def initial_weights(
    shapes: Sequence[tuple[int, int]], frequency: float, draw: np.random.Generator
) -> Float[ndarray, " weights"]:
    """Draw a network's weights.

    The first layer's are uniform in +-frequency, its biases too, so that the units bend at different times. The others
    are uniform as in Glorot and Bengio, AISTATS (2010), their biases 0.

    Args:
        shapes: of the layers.
        frequency: of the first layer, in radians per half the time span.
        draw: the generator.
    """
    pieces = []
    for number, (rows, width) in enumerate(shapes):
        limit = frequency if number == 0 else math.sqrt(6 / (rows - 1 + width))
        layer = draw.uniform(-limit, limit, (rows, width))
        if number > 0:
            layer[-1] = 0.0
        pieces.append(layer.ravel())
    return np.concatenate(pieces)


def split_layers(weights: Array, shapes: Sequence[tuple[int, int]]) -> list[Array]:
    """Return views of a vector of weights (..., count): one matrix (..., in + 1, out) per layer."""
    layers, first = [], 0
    for rows, width in shapes:
        layers.append(weights[..., first : first + rows * width].reshape(*weights.shape[:-1], rows, width))
        first += rows * width
    return layers


@dataclass(frozen=True, eq=False)
class Workspace:
    """The arrays that `forward` and `backward` overwrite: allocating them each time would cost more than filling them.

    Attributes:
        stacks: output of each hidden layer, values above their derivatives by x: (..., R + P, width).
        slopes: 1 - h^2 of each hidden layer: (..., R, width).
        rates: dz/dx of each hidden layer: (..., P, width).
        out: the outputs, values above their derivatives by x: (..., R + P, M).
        pull: the loss's derivative by `out`, of the same shape; the caller of `backward` fills it.
        pulls: the loss's derivative by each of `stacks`.
        spare: room for a product of each layer: (..., P, width).
    """

    stacks: list[Array]
    slopes: list[Array]
    rates: list[Array]
    out: Array
    pull: Array
    pulls: list[Array]
    spare: list[Array]


def workspace(
    shapes: Sequence[tuple[int, int]],
    rows: int,
    tangents: int,
    move: Callable[..., Any],
    lead: tuple[int, ...] = (),
) -> Workspace:
    """Allocate the arrays for a network.

    Args:
        shapes: of its layers.
        rows: R, the number of times.
        tangents: P, how many of them get their derivative.
        move: function that turns a NumPy array into one of the device.
        lead: () for one network, (K,) for K members.
    """
    widths = [width for _, width in shapes[:-1]]
    total = rows + tangents

    def each(height: int) -> list[Any]:
        return [move(np.zeros((*lead, height, width))) for width in widths]

    out, pull = (move(np.zeros((*lead, total, shapes[-1][1]))) for _ in range(2))
    return Workspace(each(total), each(rows), each(tangents), out, pull, each(total), each(tangents))


def forward(layers: Sequence[Array], x: Array, work: Workspace, xp: Any) -> Array:
    """Evaluate a network and its derivative by x.

    Args:
        layers: one matrix (..., in + 1, out) per layer.
        x: scaled times (R, 1); the first P of them get their derivative as well.
        work: where the results go, and what `backward` needs of them.
        xp: numpy or torch.

    Returns:
        the outputs (..., R + P, M), values above their derivatives by x: `work.out`, which the next call overwrites.
    """
    rows = len(x)
    for number, layer in enumerate(layers[:-1]):
        stack, slope, rate = work.stacks[number], work.slopes[number], work.rates[number]
        value = stack[..., :rows, :]
        if number == 0:
            xp.multiply(x, layer[..., :1, :], out=value)
            rate[:] = layer[..., :1, :]
        else:
            xp.matmul(work.stacks[number - 1], layer[..., :-1, :], out=stack)
            rate[:] = stack[..., rows:, :]
        value += layer[..., -1:, :]
        xp.tanh(value, out=value)
        xp.multiply(value, value, out=slope)
        slope *= -1
        slope += 1
        xp.multiply(slope[..., : rate.shape[-2], :], rate, out=stack[..., rows:, :])
    xp.matmul(work.stacks[-1], layers[-1][..., :-1, :], out=work.out)
    work.out[..., :rows, :] += layers[-1][..., -1:, :]
    return work.out


def backward(layers: Sequence[Array], x: Array, work: Workspace, result: Sequence[Array], xp: Any) -> None:
    """Compute the loss's derivative by the weights from its derivative `work.pull` by the outputs.

    Args:
        layers: as in `forward`.
        x: as in `forward`.
        work: as `forward` left it, with `pull` filled.
        result: one matrix (..., in + 1, out) per layer, overwritten with the derivative.
        xp: numpy or torch.
    """
    rows = len(x)
    gradient = work.pull
    for number in range(len(layers) - 1, 0, -1):
        stack, slope, rate = work.stacks[number - 1], work.slopes[number - 1], work.rates[number - 1]
        xp.matmul(stack.mT, gradient, out=result[number][..., :-1, :])
        result[number][..., -1, :] = gradient[..., :rows, :].sum(-2)
        down, spare = work.pulls[number - 1], work.spare[number - 1]
        xp.matmul(gradient, layers[number][..., :-1, :].mT, out=down)
        # dh/dx = s(z) dz/dx with s = 1 - h^2, whose derivative by z is -2 h s dz/dx.
        points = rate.shape[-2]
        xp.multiply(stack[..., :points, :], rate, out=spare)
        spare *= down[..., rows:, :]
        spare *= 2
        down[..., :points, :] -= spare
        down[..., :rows, :] *= slope
        down[..., rows:, :] *= slope[..., :points, :]
        gradient = down
    result[0][..., :1, :] = x.mT @ gradient[..., :rows, :]
    result[0][..., 0, :] += gradient[..., rows:, :].sum(-2)
    result[0][..., 1, :] = gradient[..., :rows, :].sum(-2)
