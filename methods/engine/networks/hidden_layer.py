"""A hidden layer of units of time, with exact derivatives by time and by the layer's own numbers.

With tau = (t - middle) / half in [-1, 1], the units of a layer with the numbers theta are

    sine:   1, cos(theta_k tau), sin(theta_k tau)
    tanh:   1, tanh(theta_k tau + theta'_k)

The phase of a sine is a matter of the output layer, which sees it and its cosine (Tancik et al., NeurIPS (2020), whose
Fourier features are drawn; Sitzmann et al., NeurIPS (2020), whose sines are trained).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.networks.arrays import Array

Activation = Literal["sine", "tanh"]

# Highest frequency of a layer of M frequencies, as a share of M pi / 2 in radians per half the span. A share of 1 is
# a Fourier series on twice the span; a smaller one is redundant, and follows curves closely up to their ends.
REDUNDANT = 0.5


class Move(NamedTuple):
    """What some numbers of a layer do to some of its units, one to one.

    Attributes:
        numbers: of the layer, as a slice of theta.
        units: as a slice of all units.
        levels: derivative of the units, and of their first and second time derivative, by their numbers
            (3, ..., R, units).
    """

    numbers: slice
    units: slice
    levels: Array


@dataclass(frozen=True, eq=False)
class Layer:
    """A layer evaluated at R times, or those of several networks: `...` is nothing, or one axis of members.

    Attributes:
        levels: the K units and their first and second time derivative (3, ..., R, K).
        moves: their derivatives by theta.
    """

    levels: Array
    moves: tuple[Move, ...]


def draw_layer(
    activation: Activation, count: int, least: float, draw: np.random.Generator
) -> Float[ndarray, " number"]:
    """Draw the numbers of a layer of 2 * count units beside the constant: frequencies spread evenly up to the highest.

    Args:
        activation: of the units.
        count: M.
        least: what the highest frequency is at least, in radians per half the span.
        draw: the generator.
    """
    highest = max(REDUNDANT * math.pi / 2 * count, least)
    if activation == "sine":
        return highest * np.arange(1, count + 1) / count * draw.uniform(0.97, 1.03, count)
    slopes = draw.uniform(-highest, highest, 2 * count)
    # Units that bend a little beyond the span serve its ends.
    return np.concatenate([slopes, -slopes * draw.uniform(-1.1, 1.1, 2 * count)])


def evaluate_layer(activation: Activation, theta: Array, tau: Array, half: float, xp: Any = np) -> Layer:
    """Evaluate a layer.

    Args:
        activation: of the units.
        theta: the layer's numbers (..., n).
        tau: scaled times (R,).
        half: half the span, in units of time.
        xp: numpy, or torch for tensors.
    """
    column = tau[:, None]
    constant = xp.ones_like(theta[..., :1][..., None, :] * column)
    levels, moves = (_sines if activation == "sine" else _bends)(theta[..., None, :], column, xp)
    scaled = tuple(move._replace(levels=_in_time(move.levels, half, xp)) for move in moves)
    constants = xp.stack([constant, 0 * constant, 0 * constant])
    return Layer(xp.concatenate([_in_time(levels, half, xp), constants], axis=-1), scaled)


def _in_time(levels: Sequence[Array], half: float, xp: Any) -> Array:
    """Return units and derivatives by tau as one array of units and derivatives by time."""
    return xp.stack([one * (1 / half**level) for level, one in enumerate(levels)])


def _sines(w: Array, tau: Array, xp: Any) -> tuple[Sequence[Array], tuple[Move, ...]]:
    count = w.shape[-1]
    c, s = xp.cos(w * tau), xp.sin(w * tau)
    pairs = [(c, s), (-w * s, w * c), (-w * w * c, -w * w * s)]
    by_cos = (-tau * s, -s - w * tau * c, -2 * w * c + w * w * tau * s)
    by_sin = (tau * c, c - w * tau * s, -2 * w * s - w * w * tau * c)
    every = slice(0, count)
    moves = Move(every, every, by_cos), Move(every, slice(count, 2 * count), by_sin)
    return [xp.concatenate(pair, axis=-1) for pair in pairs], moves


def _bends(theta: Array, tau: Array, xp: Any) -> tuple[Sequence[Array], tuple[Move, ...]]:
    count = theta.shape[-1] // 2
    w, shift = theta[..., :count], theta[..., count:]
    h = xp.tanh(w * tau + shift)
    first = 1 - h * h
    second = -2 * h * first
    third = (6 * h * h - 2) * first
    by_shift = (first, w * second, w * w * third)
    by_w = (tau * first, first + w * tau * second, 2 * w * second + w * w * tau * third)
    every = slice(0, count)
    return [h, w * first, w * w * second], (Move(every, every, by_w), Move(slice(count, 2 * count), every, by_shift))
