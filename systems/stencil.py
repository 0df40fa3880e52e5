"""Sites, offsets, windows and ends of a lattice, and the values of terms along a trajectory.

A lattice has a shape, the number of sites along each axis, and an offset from one site to another is a vector. A chain
has the shape (N,) and offsets (k,): site k = 0..N-1 of an array is the paper's n = k + 1. The n of the term language is
counted from the middle of the chain, k - (N - 1)/2. All who read neighbours ask the `Stencil`.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from latticebench.systems.arrays import pieces
from latticebench.systems.compiler import compiled
from latticebench.systems.errors import InputError
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

Ends = Literal["unknown", "free", "fixed", "periodic", "antiperiodic"]
Offset = tuple[int, ...]


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


def numbers(sites: int, some: slice = slice(None)) -> Float[ndarray, " some"]:
    """Return the n of the term language at some of the sites of a chain, by default at all."""
    return np.arange(*some.indices(sites)) - (sites - 1) / 2


@dataclass(frozen=True, eq=False)
class Window:
    """Some neighbouring sites of a chain at which terms are evaluated, with the sites that are read around them.

    Attributes:
        sites: where they are in the chain.
        columns: the sites that are read, increasing: a slice, or an array where the window is at an end of the chain.
        place: where among these each site of the padded window is (padded,).
        factor: by which it is multiplied (padded,).
        n: the n of the term language (sites,).
    """

    sites: slice
    columns: slice | ndarray
    place: Int[ndarray, " padded"]
    factor: Float[ndarray, " padded"]
    n: Float[ndarray, " sites"]

    @property
    def own(self) -> Int[ndarray, " sites"]:
        """Where the sites themselves are among the columns (sites,)."""
        listed = self.columns
        if isinstance(listed, slice):
            return np.arange(self.sites.start - listed.start, self.sites.stop - listed.start)
        return np.searchsorted(listed, np.arange(self.sites.start, self.sites.stop))

    def pad(self, field: ndarray) -> ndarray:
        """Return a field on the columns (..., columns) with what the ends repeat.

        A wall holds zero even where the value that stands in for it is missing.
        """
        padded = field[..., self.place]
        if np.all(self.factor == 1):
            return padded
        return np.where(self.factor == 0, 0.0, padded * self.factor)


@dataclass(frozen=True)
class Stencil:
    """The sites that terms read around each site of a lattice.

    A field is padded with what the ends repeat; u at an offset from all inner sites is then `padded[..., *window]`.

    Attributes:
        shape: the number of sites along each axis.
        reach: the number of sites that are read downwards and upwards along each axis.
        ends: how the lattice ends; where this is unknown, the inner sites are those whose whole stencil was observed.
    """

    shape: tuple[int, ...]
    reach: tuple[tuple[int, int], ...]
    ends: Ends

    @classmethod
    def chain(cls, sites: int, reach: tuple[int, int], ends: Ends) -> Stencil:
        """Return the stencil of a chain of `sites` sites that are read `reach` to the left and to the right."""
        return cls((sites,), (reach,), ends)

    @property
    def is_ring(self) -> bool:
        """Whether the last site is a neighbour of the first."""
        return self.ends in ("periodic", "antiperiodic")

    @functools.cached_property
    def inner(self) -> tuple[slice, ...]:
        """The sites at which the terms have a value, along each axis."""
        return tuple(observed(sites, reach, self.ends) for sites, reach in zip(self.shape, self.reach, strict=True))

    @functools.cached_property
    def own(self) -> Int[ndarray, " inner"]:
        """The places of the inner sites among all sites."""
        return np.arange(np.prod(self.shape)).reshape(self.shape)[self.inner].ravel()

    @functools.cached_property
    def border(self) -> Int[ndarray, " border"]:
        """The places of the other sites."""
        return np.setdiff1d(np.arange(np.prod(self.shape)), self.own)

    @functools.cached_property
    def offsets(self) -> tuple[Offset, ...]:
        """All offsets that are read."""
        return tuple(itertools.product(*(range(-left, right + 1) for left, right in self.reach)))

    @functools.cached_property
    def _ghosts(self) -> tuple[tuple[ndarray, ndarray], ...]:
        return tuple(ghosts(sites, *reach, self.ends) for sites, reach in zip(self.shape, self.reach, strict=True))

    @functools.cached_property
    def _factor(self) -> Float[ndarray, " *padded"] | None:
        """The factor of each site of a padded field; None for 1."""
        whole = functools.reduce(np.multiply.outer, (factor for _, factor in self._ghosts))
        return None if np.all(whole == 1) else whole

    def pad(self, field: ndarray, after: int = 0) -> ndarray:
        """Return a field with what the ends repeat on all sides; its last axes but `after` hold the sites."""
        first = field.ndim - after - len(self.shape)
        if self.ends != "unknown":
            for axis, (index, _) in enumerate(self._ghosts):
                field = np.take(field, index, axis=first + axis)
        if self._factor is not None:
            field = field * self._factor.reshape(self._factor.shape + (1,) * after)
        return field

    def cut(self, field: ndarray, some: slice) -> ndarray:
        """Return what is read from some of a chain's inner sites: a part of the padded field, whose last axis it is."""
        (left, right), begin = self.reach[0], self.inner[0].start
        first, last = begin + some.start - left, begin + some.stop + right
        if first >= 0 and last <= self.shape[0]:
            return field[..., first:last]
        index, factor = (one[some.start : some.stop + left + right] for one in self._ghosts[0])
        found = np.take(field, index, axis=-1)
        return found if self._factor is None else found * factor

    def windows(self, most: int) -> Iterator[Window]:
        """Yield windows of at most `most` sites that go through the inner sites of a chain."""
        (left, right), inner = self.reach[0], self.inner[0]
        index, factor = self._ghosts[0]
        for some in pieces(inner.stop - inner.start, 1, most):
            sites = slice(inner.start + some.start, inner.start + some.stop)
            read = index[some.start : some.stop + left + right]
            listed = np.unique(read)
            columns: slice | ndarray = listed
            if len(listed) == listed[-1] - listed[0] + 1:
                columns = slice(int(listed[0]), int(listed[-1]) + 1)
            place = np.searchsorted(listed, read)
            ends = factor[some.start : some.stop + left + right]
            yield Window(sites, columns, place, ends, numbers(self.shape[0], sites))

    @functools.cached_property
    def _windows(self) -> dict[Offset, tuple[Any, ...]]:
        found = {}
        for offset in self.offsets:
            begins = [left + k for (left, _), k in zip(self.reach, offset, strict=True)]
            pairs = zip(begins, self.inner, strict=True)
            found[offset] = tuple(slice(begin, begin + inner.stop - inner.start) for begin, inner in pairs)
        return found

    def window(self, offset: Offset) -> tuple[Any, ...]:
        """Return the part of a padded field that is read at `offset` from all inner sites, a slice along each axis."""
        return self._windows[offset]

    def neighbours(self, offset: Offset) -> tuple[Int[ndarray, " inner"], Float[ndarray, " inner"]]:
        """Return the places of the sites that are read at `offset` from each inner site, and their factors."""
        windows = self.window(offset)
        parts = [(index[one], factor[one]) for (index, factor), one in zip(self._ghosts, windows, strict=True)]
        place = np.ravel_multi_index(np.ix_(*(index for index, _ in parts)), self.shape)
        return place.ravel(), functools.reduce(np.multiply.outer, (factor for _, factor in parts)).ravel()


def evaluate(
    terms: Sequence[Term],
    u: ndarray,
    v: ndarray | None,
    f: ndarray | None,
    t: Float[ndarray, " time"],
    *,
    ends: Ends,
    reach: tuple[int, int] | None = None,
    window: Window | None = None,
) -> Float[ndarray, "parts terms time sites"]:
    """Return the values of terms along a trajectory.

    Args:
        terms: what to evaluate.
        u: the field (time, N), real or complex; with a window, on its columns alone, as v and f.
        v: its velocity (time, N), or None.
        f: the measured input (time, N), or None.
        t: times.
        ends: how the chain ends; if unknown, only sites whose whole stencil lies inside are evaluated.
        reach: the stencil that decides which those are; that of `terms` if None.
        window: of a stencil of this reach and of these ends, at whose sites alone the terms are evaluated.

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
    reach = reach_of(terms) if reach is None else reach
    if window is None:
        window = next(Stencil.chain(u.shape[1], reach, ends).windows(u.shape[1]))
    fields = {name: window.pad(array) for name, array in (("u", u), ("v", v), ("f", f)) if array is not None}
    shape = (len(t), len(window.n))
    bundle = compiled(tuple(term.text for term in terms), is_complex)
    arrays: list[Any] = []
    for slot in bundle.slots:
        if slot.name == "t":
            arrays.append(np.broadcast_to(t[:, None], shape))
        elif slot.name == "n":
            arrays.append(np.broadcast_to(window.n, shape))
        else:
            field = fields[slot.name]
            part = field.imag if slot.part == "im" else field.real
            begin = reach[0] + slot.offset
            arrays.append(part[:, begin : begin + shape[1]])
    # A term that is not finite somewhere (log of 0, an overflow) says so by its value; no warning is needed.
    with np.errstate(all="ignore"):
        values = bundle.function(*arrays)
    stacked = np.stack([np.broadcast_to(value, shape) for value in values])
    return stacked.reshape(1 + is_complex, len(terms), *shape).astype(float)
