"""Courses in time that nothing else is known of."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.bsplines import BSplines

if TYPE_CHECKING:
    from numpy import ndarray

    from latticebench.diagnosis.acting import Scene

DEGREE = 3

Course = Callable[["ndarray"], "ndarray"]
"""A function of times (B,) that returns (1, B, 1): the same at all sites."""


def courses(scene: Scene, count: int) -> list[Course]:
    """Return B-splines whose sums are smooth courses with `count` numbers over the longest recording."""
    basis = BSplines.clamped(np.linspace(scene.begin, scene.begin + scene.span, count - DEGREE + 1), DEGREE)

    def one(number: int) -> Course:
        def course(t: ndarray) -> ndarray:
            first, values, _ = basis.basis(np.clip(t, scene.begin, scene.begin + scene.span))
            own = number - first
            inside = (own >= 0) & (own <= DEGREE)
            found = np.where(inside, values[np.arange(len(t)), np.clip(own, 0, DEGREE)], 0.0)
            return np.asarray(found[None, :, None])

        return course

    return [one(number) for number in range(basis.count)]


def growing(scene: Scene) -> Course:
    """Return what grows from -1 to 1 over the longest recording."""
    return lambda t: ((t - scene.begin) / scene.span * 2 - 1)[None, :, None]
