"""Rows of a recording in the order of their times, angles that go on after a full turn, and rows of the same time."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.errors import InputError
from latticebench.systems.options import option

if TYPE_CHECKING:
    from numpy import ndarray

    # t, u, v and f of one trajectory; None for what was not observed.
    Arrays = dict[str, ndarray | None]


def in_order(arrays: Arrays, source: str, column: str, *, sort: bool) -> tuple[Arrays, list[str]]:
    """Return arrays whose times increase, and what to say of it; if sorted, rows may still have the same time.

    Args:
        arrays: t, u, v, f.
        source: where they come from.
        column: the name of the times.
        sort: whether rows are put in order.

    Raises:
        InputError: times do not increase, and were not to be sorted.
    """
    t = arrays["t"]
    assert t is not None
    steps = np.diff(t)
    # What is no time is refused by the samples.
    if not np.all(np.isfinite(t)) or np.all(steps > 0):
        return arrays, []
    if not sort:
        row = int(np.flatnonzero(steps <= 0)[0]) + 1
        does = "averages rows of the same time" if t[row] == t[row - 1] else "puts the rows in order"
        remedy = f"{option('sort', True)} {does}"
        raise InputError(
            f"{source}: row {row + 1}, column {column}: time {t[row]:g} after {t[row - 1]:g}; times must "
            f"increase: {remedy}; several trajectories need a column 'trajectory'"
        )
    early = np.count_nonzero(steps < 0)
    if not early:
        return arrays, []
    order = np.argsort(t, kind="stable")
    found = {name: None if array is None else array[order] for name, array in arrays.items()}
    return found, [f"{early} row(s) came too late; all are put in the order of their times"]


def unwrapped(u: ndarray, turn: float, source: str) -> ndarray:
    """Return readings (T, N) that go on where they started anew after a full turn, along time and then along the chain.

    Neighbours are less than half a turn apart when both were first read: whole turns between sensors cannot be read.

    Raises:
        InputError: they are complex.
    """
    if np.iscomplexobj(u):
        raise InputError(f"{source}: {option('turn')} is for angles; these readings are complex")
    found = np.array(u, float)
    for column in found.T:
        seen = np.isfinite(column)
        column[seen] = np.unwrap(column[seen], period=turn)
    there = np.flatnonzero(np.any(np.isfinite(found), axis=0))
    for left, right in itertools.pairwise(there.tolist()):
        both = np.flatnonzero(np.all(np.isfinite(found[:, [left, right]]), axis=1))
        if len(both):
            found[:, right] -= turn * np.round((found[both[0], right] - found[both[0], left]) / turn)
    return found


def averaged(arrays: Arrays) -> tuple[Arrays, list[str]]:
    """Return arrays in which neighbouring rows of the same time are one, the mean of what was read, and what to say."""
    t = arrays["t"]
    assert t is not None
    # With a time that is none, rows keep their numbers: the samples refuse it by its row.
    begins = np.flatnonzero(np.diff(t, prepend=np.nan) != 0) if np.all(np.isfinite(t)) else np.arange(len(t))
    if len(begins) == len(t):
        return arrays, []
    found: Arrays = {"t": t[begins]}
    for name in ("u", "v", "f"):
        array = arrays[name]
        if array is None:
            found[name] = None
            continue
        seen = ~np.isnan(array)
        total = np.add.reduceat(np.where(seen, array, 0), begins)
        with np.errstate(invalid="ignore"):
            found[name] = total / np.add.reduceat(seen, begins, dtype=float)
    return found, [f"{len(t) - len(begins)} row(s) have the time of another one; such rows are averaged"]
