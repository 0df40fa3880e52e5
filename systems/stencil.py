"""Sites, offsets, windows and ends of a chain, and the values of terms along a trajectory.

The last axis of an array holds the sites: site k = 0..N-1 of an array is the paper's n = k + 1. The n of the term
language is counted from the middle of the chain, k - (N - 1)/2.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from latticebench.systems.compiler import compiled
from latticebench.systems.errors import InputError
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

Ends = Literal["unknown", "free", "fixed", "periodic", "antiperiodic"]


@functools.lru_cache(maxsize=256)
def ghosts(sites: int, left: int, right: int, ends: Ends) -> tuple[Int[ndarray, " padded"], Float[ndarray, " padded"]]:
    """Return what the sites beyond the ends repeat: padded[j] = factor[j] * u[index[j]].

    free: mirrored about the last bond, u_0 = u_1 and u_{-1} = u_2 (the paper, section 2.1); fixed: walls, zero outside;
    periodic: u_{n+N} = u_n; antiperiodic: u_{n+N} = -u_n; unknown: no ghosts, so that only sites whose whole stencil
    was observed count.

    Args:
        sites: N.
        left: the number of sites added on the left.
        right: the number of sites added on the right.
        ends: how the chain ends.

    Raises:
        InputError: the chain is shorter than the stencil.
    """
    if ends == "unknown":
        if sites <= left + right:
            raise InputError(
                f"the library's stencil needs {left + right + 1} sites, the data have {sites}; "
                "use terms with fewer neighbours, or say how the chain ends (free, fixed, periodic, antiperiodic)"
            )
        return np.arange(sites), np.ones(sites)
    if sites < max(left, right) and ends != "fixed":
        raise InputError(f"the library's stencil reaches {max(left, right)} sites, the chain has {sites}")
    place = np.arange(-left, sites + right)
    inside = (place >= 0) & (place < sites)
    if ends == "free":
        index = np.where(place < 0, -1 - place, np.where(place >= sites, 2 * sites - 1 - place, place))
        return index, np.ones(len(place))
    if ends == "fixed":
        return np.clip(place, 0, sites - 1), inside.astype(float)
    sign = np.where(inside, 1.0, -1.0) if ends == "antiperiodic" else np.ones(len(place))
    return place % sites, sign


def observed(sites: int, reach: tuple[int, int], ends: Ends) -> slice:
    """Return the sites at which terms of this reach can be evaluated: all unless the ends are unknown."""
    return slice(reach[0], sites - reach[1]) if ends == "unknown" else slice(0, sites)


def reach_of(terms: Sequence[Term]) -> tuple[int, int]:
    """Return the number of sites that the widest of `terms` read to the left and to the right."""
    return max(term.reach[0] for term in terms), max(term.reach[1] for term in terms)


@dataclass(frozen=True)
class Stencil:
    """The sites that terms read around each site of a chain.

    A field is padded with what the ends repeat; u[n+k] at all inner sites is then `padded[..., window(k)]`.

    Attributes:
        sites: N.
        reach: the number of sites that are read to the left and to the right.
        ends: how the chain ends; where this is unknown, the inner sites are those whose whole stencil was observed.
    """

    sites: int
    reach: tuple[int, int]
    ends: Ends

    @functools.cached_property
    def ghosts(self) -> tuple[Int[ndarray, " padded"], Float[ndarray, " padded"]]:
        """Index and factor of each site of a padded field (see the function `ghosts`)."""
        return ghosts(self.sites, *self.reach, self.ends)

    @property
    def inner(self) -> slice:
        """The sites at which the terms have a value."""
        return observed(self.sites, self.reach, self.ends)

    @property
    def numbers(self) -> Float[ndarray, " inner"]:
        """The n of the term language at the inner sites."""
        return (np.arange(self.sites) - (self.sites - 1) / 2)[self.inner]

    def pad(self, field: ndarray) -> ndarray:
        """Return a field (..., N) with what the ends repeat on both sides."""
        index, factor = self.ghosts
        return np.asarray(field[..., index] * factor)

    def window(self, offset: int) -> slice:
        """Return the part of a padded field that is read at `offset` from all inner sites."""
        first = self.reach[0] + offset
        return slice(first, first + self.inner.stop - self.inner.start)


def evaluate(
    terms: Sequence[Term],
    u: ndarray,
    v: ndarray | None,
    f: ndarray | None,
    t: Float[ndarray, " time"],
    *,
    ends: Ends,
    reach: tuple[int, int] | None = None,
) -> Float[ndarray, "parts terms time sites"]:
    """Return the values of terms along a trajectory.

    Args:
        terms: what to evaluate.
        u: the field (time, N), real or complex.
        v: its velocity (time, N), or None.
        f: the measured input (time, N), or None.
        t: times.
        ends: how the chain ends; if unknown, only sites whose whole stencil lies inside are evaluated.
        reach: the stencil that decides which those are; that of `terms` if None.

    Returns:
        the real parts of the terms, followed for a complex field by their imaginary parts; NaN where the data are NaN.

    Raises:
        InputError: a term needs v or f and there is none, or the chain is too short.
    """
    needed = {name for term in terms for name in term.names}
    for name, array, what in (("v", v, "velocities v1..vN"), ("f", f, "measured inputs f1..fN")):
        if name in needed and array is None:
            raise InputError(f"the library uses {name}[n], but the data have no {what}")
    is_complex = np.iscomplexobj(u)
    stencil = Stencil(u.shape[1], reach_of(terms) if reach is None else reach, ends)
    walls = stencil.ghosts[1] == 0
    fields: dict[str, ndarray] = {}
    for name, array in (("u", u), ("v", v), ("f", f)):
        if array is not None:
            # A wall holds zero even where the value that stands in for it is missing.
            fields[name] = np.where(walls, 0.0, stencil.pad(array))
    shape = (len(t), len(stencil.numbers))
    bundle = compiled(tuple(term.text for term in terms), is_complex)
    arrays: list[Any] = []
    for slot in bundle.slots:
        if slot.name == "t":
            arrays.append(np.broadcast_to(t[:, None], shape))
        elif slot.name == "n":
            arrays.append(np.broadcast_to(stencil.numbers, shape))
        else:
            field = fields[slot.name]
            arrays.append((field.imag if slot.part == "im" else field.real)[:, stencil.window(slot.offset)])
    # A term that is not finite somewhere (log of 0, an overflow) says so by its value; no warning is needed.
    with np.errstate(all="ignore"):
        values = bundle.function(*arrays)
    stacked = np.stack([np.broadcast_to(value, shape) for value in values])
    return stacked.reshape(1 + is_complex, len(terms), *shape).astype(float)
