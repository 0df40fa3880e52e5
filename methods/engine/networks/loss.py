"""The loss of networks that follow samples and obey an equation, and its gradient by weights and coefficients.

One trajectory's network gives u_n(t) at every site, for order 2 also v_n(t). Its loss is

    data_weight * mean |u - samples|^2 / s_u^2  (and the same of v, where it was observed)
    + mean |du/dt - v|^2 / s_v^2                (order 2)
    + mean |rate - sum_j xi_j T_j|^2 / s_r^2    with rate = du/dt (order 1) or dv/dt (order 2)

The first line is over the samples, the others over P evenly spaced collocation times; s_u, s_v and s_r are the sizes of
field, velocity and rate. The network's outputs are u / s_u and v / s_v, its time runs from -1 to 1. Where there are
several trajectories, each has a network of its own, and all share the coefficients.

`...` in a shape is nothing for one network, or on torch one axis of members.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.networks.equation import CurveEquation, columns, curve_equation, multipliers
from latticebench.methods.engine.networks.network import (
    backward,
    forward,
    initial_weights,
    layer_shapes,
    split_layers,
    workspace,
)
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.networks.arrays import Array, Arrays
    from latticebench.methods.engine.networks.sizes import Sizes


@dataclass(frozen=True)
class LossSettings:
    """The shape of a network and what it is trained on.

    Attributes:
        layers: the number of hidden layers.
        width: the number of tanh units in each.
        collocation: P, the number of evenly spaced times, ends included, at which the equation is asked for.
        data_weight: weight of the samples against the equation.
        lead: () for one network, (K,) for K members.
    """

    layers: int
    width: int
    collocation: int
    data_weight: float
    lead: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class SampleSet:
    """One set of samples that a network learns.

    Attributes:
        equation: the library at the collocation times.
        data: the samples in the network's units (T, outputs); 0 where a value was not observed.
        share: the weight of each value in the mean over the samples (T, outputs); 0 where it was not observed.
    """

    equation: CurveEquation
    data: Array
    share: Array


class NetworkLoss:
    """The loss of one trajectory's network; its samples may be joined by others, such as mirrored ones.

    Every set of samples has outputs of its own in the same network.

    Attributes:
        shapes: (in + 1, out) of each layer.
        count: the number of weights.
        sets: the sets of samples.
        x: the scaled collocation times, then the scaled sample times (R, 1).
    """

    def __init__(
        self,
        sets: Sequence[Samples],
        library: Library,
        order: int,
        sizes: Sizes,
        settings: LossSettings,
        arrays: Arrays,
        share: float = 1.0,
    ) -> None:
        """Set the arrays up.

        Args:
            sets: samples at the same times; the first is the trajectory.
            library: the terms.
            order: of the time derivative.
            sizes: by which outputs and residuals are scaled.
            settings: of the network.
            arrays: of the device.
            share: weight of this trajectory in the whole loss.
        """
        self.arrays = arrays
        samples = sets[0]
        start, end = float(samples.t[0]), float(samples.t[-1])
        self.half = (end - start) / 2
        grid = np.linspace(-1, 1, settings.collocation)
        times = start + self.half * (grid + 1)
        self.points = settings.collocation
        self.x = arrays.move(np.concatenate([grid, (samples.t - start) / self.half - 1])[:, None])
        self.order, self.sizes = order, sizes
        level = (1 + samples.is_complex) * samples.sites
        self.outputs = level * order
        units = np.repeat([sizes.field, sizes.velocity][:order], level)
        self.units = arrays.move(units)
        self.shapes = layer_shapes(settings.layers, settings.width, self.outputs * len(sets))
        self.count = sum(rows * width for rows, width in self.shapes)
        self.work = workspace(self.shapes, len(self.x), self.points, arrays.move, settings.lead)
        self.sets = []
        # Means over the samples and over the collocation points, shared among the sets.
        self.data_weight = share * settings.data_weight / len(sets)
        self.residual_weight = share / len(sets)
        for one in sets:
            target = columns(one, order)
            seen = np.isfinite(target)
            # u and v have means of their own; a complex field's two parts add up to |.|^2.
            shares = [
                seen[:, k : k + level] / max(1, np.sum(seen[:, k : k + samples.sites]))
                for k in range(0, self.outputs, level)
            ]
            scaled = arrays.move(np.where(seen, target, 0.0) / units)
            law = curve_equation(one, library, order, times, arrays)
            self.sets.append(SampleSet(law, scaled, arrays.move(np.concatenate(shares, axis=1))))

    def loss(self, weights: Array, xi: Array, gradient: Array, coefficient_gradient: Array) -> Array:
        """Return the loss (...), and compute its gradient.

        Args:
            weights: of the network (..., count).
            xi: coefficients in the data's units (..., J).
            gradient: (..., count), overwritten with the derivative by the weights.
            coefficient_gradient: (..., J), to which the derivative by the coefficients is added in place.
        """
        xp, points, rows = self.arrays.xp, self.points, len(self.x)
        layers = split_layers(weights, self.shapes)
        out, pull = forward(layers, self.x, self.work, xp), self.work.pull
        total: Array = 0.0
        for number, one in enumerate(self.sets):
            block = self._block(number)
            miss = out[..., points:rows, block] - one.data
            weighted = miss * one.share
            total = total + self.data_weight * (weighted * miss).sum((-2, -1))
            pull[..., points:rows, block] = (2 * self.data_weight) * weighted
            total = total + self._residuals(one.equation, block, xi, coefficient_gradient)
        backward(layers, self.x, self.work, split_layers(gradient, self.shapes), xp)
        return total

    def squares(self, weights: Array, xi: Array) -> tuple[Array, Array]:
        """Return the sums of squares (...) of rate - sum_j xi_j T_j and of the rate over the collocation points."""
        forward(split_layers(weights, self.shapes), self.x, self.work, self.arrays.xp)
        missed: Array = 0.0
        whole: Array = 0.0
        factors = multipliers(xi)
        for number, one in enumerate(self.sets):
            law = one.equation
            fields, rates = self._fields(self._block(number))
            terms, _ = law.evaluate(fields, xi)
            for part in range(law.parts):
                rate = rates[..., law.rate_columns(part)]
                gap = rate - sum(x * term for x, term in zip(factors, terms[part], strict=True))
                missed = missed + (gap * gap).sum((-2, -1))
                whole = whole + (rate * rate).sum((-2, -1))
        return missed, whole

    def _block(self, number: int) -> slice:
        """Return the network's outputs that belong to a set of samples."""
        return slice(number * self.outputs, (number + 1) * self.outputs)

    def _fields(self, block: slice) -> tuple[Array, Array]:
        """Return a set's fields and their time derivatives at the collocation times (..., P, outputs) in data units."""
        out = self.work.out
        return out[..., : self.points, block] * self.units, out[..., len(self.x) :, block] * (self.units / self.half)

    def _residuals(self, law: CurveEquation, block: slice, xi: Array, coefficient_gradient: Array) -> Array:
        """Return the loss (...) of a set's residuals, write its derivative by the outputs and add that by xi."""
        fields, rates = self._fields(block)
        by_fields, by_rates = self.arrays.xp.zeros_like(fields), self.arrays.xp.zeros_like(rates)
        factors = multipliers(xi)
        terms, slopes = law.evaluate(fields, xi)
        total: Array = 0.0
        weights = []
        scale = self.residual_weight / (self.sizes.rate**2 * self.points * law.width)
        for part in range(law.parts):
            where = law.rate_columns(part)
            left = rates[..., where] * 1.0
            for x, term in zip(factors, terms[part], strict=True):
                left -= x * term
            total = total + scale * (left * left).sum((-2, -1))
            left *= 2 * scale
            by_rates[..., where] += left
            coefficient_gradient -= self.arrays.xp.stack([(left * term).sum((-2, -1)) for term in terms[part]], -1)
            weights.append(-left)
        law.pull_back(slopes, weights, by_fields)
        if self.order == 2:
            level = law.parts * law.sites
            gap = rates[..., :level] - fields[..., level:]
            scale = self.residual_weight / (self.sizes.velocity**2 * self.points * law.sites)
            total = total + scale * (gap * gap).sum((-2, -1))
            gap *= 2 * scale
            by_rates[..., :level] += gap
            by_fields[..., level:] -= gap
        pull = self.work.pull
        pull[..., : self.points, block] = by_fields * self.units
        pull[..., len(self.x) :, block] = by_rates * (self.units / self.half)
        return total


class JointLoss:
    """The sum of several trajectories' losses as a function of one vector.

    A point (..., n) holds the weights of each network, one after the other, and then the coefficients in multiples of
    `units`.
    """

    def __init__(self, losses: Sequence[NetworkLoss], units: Float[ndarray, " terms"]) -> None:
        """Join the losses.

        Args:
            losses: one per trajectory, all on one device.
            units: of the coefficients (J,).
        """
        self.losses = losses
        self.arrays = losses[0].arrays
        self.units = self.arrays.move(units)
        bounds = [0, *itertools.accumulate(loss.count for loss in losses)]
        self.slices = [slice(first, last) for first, last in itertools.pairwise(bounds)]
        self.weights = bounds[-1]

    def start(self, frequency: float, draws: Sequence[np.random.Generator], lead: tuple[int, ...]) -> Array:
        """Return a point with drawn weights and the coefficients 0.

        Args:
            frequency: of the first layers, see `initial_weights`.
            draws: one generator per network or member.
            lead: () for one network, (K,) for K members.
        """
        first_weights = [
            np.concatenate([initial_weights(loss.shapes, frequency, draw) for loss in self.losses]) for draw in draws
        ]
        point = np.pad(np.stack(first_weights), ((0, 0), (0, len(self.units))))
        return self.arrays.move(point.reshape(*lead, -1))

    def coefficients(self, point: Array) -> Array:
        """Return the coefficients (..., J) of a point, in the data's units."""
        return point[..., self.weights :] * self.units

    def value_and_gradient(self, point: Array) -> tuple[Array, Array]:
        """Return the loss (...) and its gradient (..., n)."""
        xp = self.arrays.xp
        gradient, xi = xp.zeros_like(point), self.coefficients(point)
        by_coefficients = xp.zeros_like(xi)
        total = 0.0
        for loss, own in zip(self.losses, self.slices, strict=True):
            total = total + loss.loss(point[..., own], xi, gradient[..., own], by_coefficients)
        gradient[..., self.weights :] = by_coefficients * self.units
        return total, gradient

    def squares(self, point: Array) -> tuple[Array, Array]:
        """Return the sums of squares (...) of rate - sum_j xi_j T_j and of the rate over all collocation points."""
        xi = self.coefficients(point)
        parts = [loss.squares(point[..., own], xi) for loss, own in zip(self.losses, self.slices, strict=True)]
        return sum(missed for missed, _ in parts), sum(whole for _, whole in parts)
