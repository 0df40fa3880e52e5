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

    known: list[tuple[ndarray, ndarray]] = []

    def design(t: ndarray) -> ndarray:
        # All courses are asked for the same times, one after the other.
        if not known or not np.array_equal(known[0][0], t):
            within = np.clip(t, scene.begin, scene.begin + scene.span)
            known[:] = [(t.copy(), basis.design(within, 0).T)]
        return known[0][1]

    return [lambda t, number=number: design(t)[number][None, :, None] for number in range(basis.count)]  # type: ignore[misc]


def growing(scene: Scene) -> Course:
    """Return what grows from -1 to 1 over the longest recording."""
    return lambda t: ((t - scene.begin) / scene.span * 2 - 1)[None, :, None]
