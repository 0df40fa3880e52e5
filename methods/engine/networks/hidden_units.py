"""A layer of tanh units that is drawn, not trained, and made orthonormal: a basis for curves in time.

Units phi_k(t) = tanh(s_k (t - c_k)) with random slopes s_k and centres c_k, and the constant, are combined by a
singular value decomposition into functions that are orthonormal on given times, so that least squares for the weights
of a curve are well conditioned. The first and second time derivative of each function are exact.

`...` in a shape is nothing for one network, or on torch one axis of members, whose units were drawn differently.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.networks.arrays import Array, Arrays

# Singular values below this share of the largest are round-off of nearly equal units.
CUT = 1e-10


@dataclass(frozen=True, eq=False)
class Basis:
    """Functions of time at given times, each array (..., times, units).

    Attributes:
        value: the functions.
        first: their time derivatives.
        second: their second time derivatives.
    """

    value: Array
    first: Array
    second: Array

    def level(self, number: int) -> Array:
        """Return the functions' time derivative of order 0, 1 or 2."""
        return (self.value, self.first, self.second)[number]


def draw_basis(
    times: Float[ndarray, " collocation"],
    more: Float[ndarray, " time"],
    width: int,
    steepness: float,
    draw: np.random.Generator,
) -> tuple[Basis, Basis]:
    """Draw units and make them orthonormal on the collocation times: the mean square of each function there is 1.

    Args:
        times: collocation times (P,); their first and last are the span.
        more: further times, the samples' (T,).
        width: number of tanh units.
        steepness: largest slope |s_k|, in 1/time.
        draw: the generator.

    Returns:
        the basis at the collocation times (P, units) and at the further times (T, units). There are at most width + 1
        units: combinations that are round-off are left out.
    """
    slopes = draw.uniform(-steepness, steepness, width)
    middle, half = (times[0] + times[-1]) / 2, (times[-1] - times[0]) / 2
    # Units that bend a little beyond the span serve its ends.
    centres = middle + half * draw.uniform(-1.1, 1.1, width)
    t = np.concatenate([times, more])[:, None]
    h = np.tanh(slopes * (t - centres))
    first = (1 - h * h) * slopes
    second = -2 * h * first * slopes
    constant = np.ones_like(t)
    layers = [np.hstack([h, constant]), np.hstack([first, 0 * constant]), np.hstack([second, 0 * constant])]
    count = len(times)
    _, size, modes = np.linalg.svd(layers[0][:count], full_matrices=False)
    kept = size > CUT * size[0]
    turn = modes[kept].T / size[kept] * math.sqrt(count)
    whole = [layer @ turn for layer in layers]
    return Basis(*(level[:count] for level in whole)), Basis(*(level[count:] for level in whole))


def stack_bases(bases: Sequence[Basis], arrays: Arrays, lead: tuple[int, ...]) -> Basis:
    """Move the bases of networks or members to the device as one.

    Args:
        bases: one per network or member, (times, units) each; where one has fewer units it is filled up with zeros.
        arrays: of the device.
        lead: () for one network, (K,) for K members.
    """
    units = max(basis.value.shape[-1] for basis in bases)

    def filled(levels: Sequence[ndarray]) -> Array:
        whole = np.stack([np.pad(one, ((0, 0), (0, units - one.shape[-1]))) for one in levels])
        return arrays.move(whole.reshape(*lead, -1, units))

    return Basis(*(filled([basis.level(number) for basis in bases]) for number in range(3)))
