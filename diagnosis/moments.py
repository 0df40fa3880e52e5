"""Times at which something happens, as small steps do not find them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.acting.lasting import Lasting
from latticebench.diagnosis.acting.sudden import Sudden

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.fitting import Fitted
    from latticebench.diagnosis.model import Model
    from latticebench.diagnosis.problem import Problem

# Times beside that of something sharp, in widths: about half a reading and one away where frames are missing.
BESIDE = (-5.0, -2.5, 2.5, 5.0)
# Within half a wave of a kick, what is left is so many times the noise (mean squares) if it came at another time.
LEFT = 2.0


def beside(problem: Problem, fitted: Fitted) -> Iterator[tuple[Model, list[Float[ndarray, "pieces m state"]]]]:
    """Yield a model with what happens at one time a little earlier or later, with states to start from.

    Of what happens to readings between two of them, it hardly matters when: a fit that came there does not leave. A
    kick half a wave off, the other way round, does the same to all that comes after both; likewise of forces that are
    switched on or off.
    """
    for number, placed in enumerate(fitted.model.effects):
        for moved in _moved(problem, fitted, placed):
            if moved.possible:
                yield fitted.model.without(number).with_effect(moved), list(fitted.followed.nodes)


def _moved(problem: Problem, fitted: Fitted, placed: Placed) -> Iterator[Placed]:
    """Yield an effect at times beside its own."""
    if isinstance(placed, Sudden) and placed.instrument and placed.moot:
        yield from (replace(placed, at=placed.at + widths * placed.wide) for widths in BESIDE)
    if isinstance(placed, Lasting):
        yield from placed.switched
    if placed.moment is not None and problem.main:
        (at, width), half = placed.moment, np.pi / problem.main
        if width < half and _left(problem, fitted, at - half, at + half) > LEFT:
            other = placed.moved([*(-np.array(placed.strength)), *placed.numbers[len(placed.strength) :]])
            yield from (other.at_moment((at + shift, width)) for shift in (-half, half))


def _left(problem: Problem, fitted: Fitted, begin: float, end: float) -> float:
    """Return the mean square of what is left within some time, over that of the noise, at the sensor with most."""
    # A model that leaves much takes it for noise.
    noise = np.where(problem.noise > 0, problem.noise, fitted.noise.deviation())
    noise = noise.reshape(fitted.chain.levels, 1, fitted.chain.sites)
    found = [((one.seen - one.level) / noise)[(one.t > begin) & (one.t < end)] for one in fitted.curves()]
    squares = np.concatenate(found) ** 2
    read = np.isfinite(squares)
    means = np.sum(squares, axis=0, where=read) / np.maximum(np.sum(read, axis=0), 1)
    return float(np.max(means))
