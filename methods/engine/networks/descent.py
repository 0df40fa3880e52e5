"""Minimisers for a network's loss: Adam, L-BFGS, and L-BFGS for several members at once.

Each takes a function that returns the loss and its gradient at a point, and calls `note(step, loss, point)` as it goes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy import ndarray

    from latticebench.methods.engine.networks.arrays import Array

    # The loss and its gradient at a point.
    Evaluate = Callable[[Array], tuple[Any, Array]]
    # Step, loss, point.
    Note = Callable[[int, Any, Array], None]

# Trials of a line search before a member gives it up.
SEARCH = 30


def adam(evaluate_at: Evaluate, start: Array, steps: int, learning_rate: float, note: Note, xp: Any = np) -> Array:
    """Minimise by Adam (Kingma & Ba, ICLR (2015)), the learning rate falling to 0 along half a cosine.

    Args:
        evaluate_at: returns the loss (...) and its gradient (..., n) at a point (..., n).
        start: the first point (..., n).
        steps: number of steps.
        learning_rate: the first learning rate.
        note: called before each step.
        xp: numpy or torch.

    Returns:
        the last point (..., n).
    """
    point = start * 1.0
    mean, square = xp.zeros_like(point), xp.zeros_like(point)
    for step in range(steps):
        value, gradient = evaluate_at(point)
        note(step, value, point)
        mean += 0.1 * (gradient - mean)
        square += 0.001 * (gradient * gradient - square)
        rate = learning_rate * 0.5 * (1 + math.cos(math.pi * step / steps)) / (1 - 0.9 ** (step + 1))
        point -= rate * mean / (xp.sqrt(square / (1 - 0.999 ** (step + 1))) + 1e-8)
    return point


def lbfgs(evaluate_at: Evaluate, start: ndarray, steps: int, memory: int, note: Note) -> ndarray:
    """Minimise one loss by L-BFGS (SciPy's L-BFGS-B without bounds).

    Where its line search gives up it starts again from the same point with an empty memory, until that does not help.

    Args:
        evaluate_at: returns the loss and its gradient (n,) at a point (n,).
        start: the first point (n,).
        steps: maximum number of evaluations.
        memory: number of steps that are remembered.
        note: called after each iteration, with the number of evaluations so far.

    Returns:
        the best point (n,).
    """
    from scipy.optimize import minimize

    point, value, done = start, math.inf, 0

    def counted(x: ndarray) -> tuple[float, ndarray]:
        nonlocal done
        done += 1
        return evaluate_at(x)

    def accepted(intermediate_result: Any) -> None:
        note(done, float(intermediate_result.fun), intermediate_result.x)

    while done < steps:
        options = {"maxcor": memory, "maxfun": steps - done, "maxiter": steps, "maxls": 30, "ftol": 0.0, "gtol": 0.0}
        found = minimize(counted, point, jac=True, method="L-BFGS-B", callback=accepted, options=options)
        better = float(found.fun) < value
        if better:
            point, value = np.asarray(found.x), float(found.fun)
        if found.nit < 2 or not better:
            break
    return point


def lockstep(evaluate_at: Evaluate, start: Array, steps: int, memory: int, note: Note, xp: Any) -> Array:
    """Minimise the losses of K members by L-BFGS, each on its own, with one evaluation of all of them at a time.

    Each member looks for a step that satisfies the weak Wolfe conditions by bisection and doubling (Lewis & Overton,
    Math. Program. 141, 135 (2013)). One that has found it moves on while the others still look; in that round the
    others add an empty pair to the memory. One whose search fails starts again downhill with an empty memory, once.

    Args:
        evaluate_at: returns the losses (K,) and gradients (K, n) at the points (K, n).
        start: the first points (K, n).
        steps: maximum number of evaluations.
        memory: number of steps that are remembered.
        note: called whenever a member has moved, with the number of evaluations so far.
        xp: numpy or torch.

    Returns:
        the last points (K, n).
    """
    point = start * 1.0
    value, gradient = evaluate_at(point)
    pairs = _Memory(point, memory, xp)
    zero = xp.zeros_like(value)
    way, slope = -gradient, -_dot(gradient, gradient, xp)
    bracket = _Bracket(_first_length(slope, xp), zero, zero + math.inf)
    fresh, alive, tries = zero == 0, slope < 0, zero
    for done in range(1, steps):
        length = bracket.length
        lower, steeper = evaluate_at(point + xp.where(alive, length, zero)[:, None] * way)
        short = alive & (lower <= value + 1e-4 * length * slope)
        found = short & (_dot(steeper, way, xp) >= 0.9 * slope)
        bracket = bracket.narrowed(short, alive & ~short, xp)
        if bool(found.any()):
            moved = xp.where(found, length, zero)[:, None] * way
            pairs.add(moved, xp.where(found[:, None], steeper - gradient, xp.zeros_like(gradient)))
            value, point = xp.where(found, lower, value), point + moved
            gradient = xp.where(found[:, None], steeper, gradient)
            note(done, value, point)
            way = xp.where(found[:, None], -pairs.inverse_times(gradient), way)
        slope = _dot(gradient, way, xp)
        # Nothing found in many trials, or no way down: forget the pairs and go downhill, once.
        tries = xp.where(found, zero, tries + 1)
        lost = alive & ((tries >= SEARCH) | (slope >= 0))
        if bool(lost.any()):
            alive = alive & ~(lost & fresh & ~found)
            pairs.forget(lost)
            way = xp.where(lost[:, None], -gradient, way)
            slope = xp.where(lost, -_dot(gradient, gradient, xp), slope)
            alive, tries = alive & (slope < 0), xp.where(lost, zero, tries)
            if not bool(alive.any()):
                break
        fresh = xp.where(found | lost, lost, fresh)
        bracket = bracket.next(found, lost, slope, xp)
    return point


def _dot(a: Array, b: Array, xp: Any) -> Array:
    """Return the products (K,) of the members' vectors (K, n)."""
    return xp.einsum("kn,kn->k", a, b)


def _first_length(slope: Array, xp: Any) -> Array:
    """Return the length (K,) of the first step downhill, which moves no farther than 1."""
    return 1 / xp.sqrt(xp.where(slope < -1, -slope, xp.ones_like(slope)))


@dataclass(frozen=True, eq=False)
class _Bracket:
    """The line search of each member: the length to try, and a shorter and a longer one between which to look (K,)."""

    length: Array
    low: Array
    high: Array

    def narrowed(self, short: Array, long: Array, xp: Any) -> _Bracket:
        """Move the bounds of the members whose trial was too short or too long."""
        return _Bracket(self.length, xp.where(short, self.length, self.low), xp.where(long, self.length, self.high))

    def next(self, found: Array, lost: Array, slope: Array, xp: Any) -> _Bracket:
        """Return the next lengths: doubled or bisected within a search, 1 after a step, short after a fresh start."""
        zero = xp.zeros_like(slope)
        middle = xp.where(xp.isinf(self.high), 2 * self.length, (self.low + self.high) / 2)
        length = xp.where(lost, _first_length(slope, xp), xp.where(found, xp.ones_like(slope), middle))
        begun = found | lost
        return _Bracket(length, xp.where(begun, zero, self.low), xp.where(begun, zero + math.inf, self.high))


class _Memory:
    """The last steps of each member and how they changed its gradient, which approximate its inverse Hessian."""

    def __init__(self, point: Array, count: int, xp: Any) -> None:
        """Begin with `count` empty pairs for points (K, n)."""
        self.xp = xp
        self.zero = xp.zeros_like(point[:, 0])
        self.size = self.zero
        self.pairs = [(xp.zeros_like(point), xp.zeros_like(point), self.zero) for _ in range(count)]

    def add(self, moved: Array, turned: Array) -> None:
        """Add steps and changes of gradient (K, n), zero for a member that stayed, in place of the oldest."""
        xp, one = self.xp, self.zero + 1
        product, square = _dot(moved, turned, xp), _dot(turned, turned, xp)
        curved = product > 1e-14 * square
        weight = xp.where(curved, 1 / xp.where(curved, product, one), self.zero)
        self.pairs = [*self.pairs[1:], (moved, turned, weight)]
        self.size = xp.where(curved, product / xp.where(curved, square, one), self.size)

    def forget(self, lost: Array) -> None:
        """Empty the pairs of the members that are `lost` (K,)."""
        keep = self.xp.where(lost, self.zero, self.zero + 1)
        self.pairs = [(moved, turned, weight * keep) for moved, turned, weight in self.pairs]

    def inverse_times(self, gradient: Array) -> Array:
        """Multiply vectors (K, n) by the inverse Hessians (Nocedal & Wright, Numerical Optimization, algorithm 7.4)."""
        left = gradient * 1.0
        shares = []
        for moved, turned, weight in reversed(self.pairs):
            shares.append(weight * _dot(moved, left, self.xp))
            left -= shares[-1][:, None] * turned
        left *= self.size[:, None]
        for (moved, turned, weight), share in zip(self.pairs, reversed(shares), strict=True):
            left += (share - weight * _dot(turned, left, self.xp))[:, None] * moved
        return left
