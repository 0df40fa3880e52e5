"""Columns in another order than the sites: whether a chain explains its readings better where some are exchanged."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.regression import regressed
from latticebench.methods.engine.record import without_halves
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples, SimulatedSamples

if TYPE_CHECKING:
    from numpy import ndarray

# Chains of so many sites are looked at, and all pairs of sites of so many at most; else neighbours.
SHORTEST, LONGEST, EVERY_PAIR = 3, 24, 8


def exchanged(problem: Problem) -> tuple[int, ...]:
    """Return the order of the columns, from 0, in which the declared equation leaves much less; () where none is.

    Pairs are exchanged, the best first, as long as one leaves less. What is compared is the share of the forces' work
    that the equation leaves of smoothed readings, with constant forces besides (see `regressed`). Sites without an
    equation keep their columns: else a bad sensor would be best where nothing is asked of it.
    """
    sites, moving = problem.chain.sites, problem.chain.moving
    if not SHORTEST <= len(moving) <= LONGEST:
        return ()
    near = len(moving) <= EVERY_PAIR
    pairs = [pair for pair in itertools.combinations(moving, 2) if near or pair[1] - pair[0] == 1]
    order, whole = list(range(sites)), _fields(problem)
    first = least = _left(problem, whole, order)
    for _ in range(sites):
        others = [_with(order, pair) for pair in pairs]
        left = [_left(problem, whole, other) for other in others]
        best = int(np.argmin(left))
        # An order and its mirror image may leave the same.
        if not left[best] < rules.OTHERWISE * least:
            break
        order, least = others[best], left[best]
    return tuple(order) if least < rules.EXCHANGED * first else ()


def of_recordings(declared: Library, order: int, data: Sequence[Samples]) -> tuple[int, ...]:
    """Return the same of recordings; () where they cannot be looked at."""
    shown = [without_halves(one.observed() if isinstance(one, SimulatedSamples) else one) for one in data]
    if not SHORTEST <= shown[0].sites <= LONGEST:
        return ()
    try:
        return exchanged(Problem.of(declared, order, shown, ()))
    except InputError:
        return ()


def _with(order: Sequence[int], pair: tuple[int, int]) -> list[int]:
    """Return an order with two of its places exchanged."""
    other = list(order)
    other[pair[0]], other[pair[1]] = order[pair[1]], order[pair[0]]
    return other


def _fields(problem: Problem) -> list[ndarray]:
    """Return the smoothed fields of all sites of each recording (T, order, parts, N)."""
    return [
        problem.plain.whole(nodes, record.stretches.driven(record.times, splines))
        for nodes, record, splines in zip(problem.nodes, problem.records, problem.splines, strict=True)
    ]


def _left(problem: Problem, whole: Sequence[ndarray], order: Sequence[int]) -> float:
    """Return the share that the equation leaves where the columns are in another order; infinity where it is none."""
    fields = [one[..., list(order)] for one in whole]
    nodes = tuple(one[..., problem.plain.moving].reshape(len(one), -1) for one in fields)
    try:
        return regressed(replace(problem, nodes=nodes))[1]
    except InputError:
        return np.inf
