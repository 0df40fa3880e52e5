"""The motion of a system on a chain: its equation as a first-order system in real variables, with its Jacobian."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.systems.arrays import pieces
from latticebench.systems.compiler import Slot, compiled, partials, real_parts
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import System
from latticebench.systems.stencil import Ends, Stencil, numbers
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    import scipy.sparse
    from jaxtyping import Float
    from numpy import ndarray

# Sites whose values stay in a processor's cache while a right-hand side is computed.
CACHED = 2**13


@dataclass(frozen=True)
class Motion:
    """An equation on a chain of N sites, as dy/dt = F(t, y) in real variables.

    The state y is [u] or, for a complex field, [Re u, Im u]; for order 2 the velocity follows likewise. Its length is
    order * parts * N.

    Attributes:
        term: the right-hand side of d^order u_n / dt^order = term.
        order: of the time derivative.
        is_complex: whether the field is complex.
        sites: N.
        ends: how the chain ends.
    """

    term: Term
    order: int
    is_complex: bool
    sites: int
    ends: Ends

    @property
    def parts(self) -> int:
        """1 for a real field, 2 for a complex one."""
        return 1 + self.is_complex

    def pack(self, u: ndarray, v: ndarray | None) -> Float[ndarray, " state"]:
        """Return u (N,) and v (N,) as a state; v is ignored for order 1, and zero if None."""
        fields = [u] if self.order == 1 else [u, np.zeros_like(u) if v is None else v]
        pieces = [part for one in fields for part in ((one.real, one.imag) if self.is_complex else (one,))]
        return np.concatenate(pieces).astype(float)

    def unpack(self, y: Float[ndarray, "state *times"]) -> tuple[ndarray, ndarray | None]:
        """Return u and v (None for order 1) of states, one per column: each (times, N)."""
        blocks = np.asarray(y).T.reshape(*np.shape(y)[1:], self.order, self.parts, self.sites)
        fields = blocks[..., 0, :] + 1j * blocks[..., 1, :] if self.is_complex else blocks[..., 0, :]
        return fields[..., 0, :], (fields[..., 1, :] if self.order == 2 else None)

    @functools.cached_property
    def right_hand_side(self) -> Callable[[float, ndarray], ndarray]:
        """The function F(t, y), with values (state,).

        Raises:
            InputError: the equation has a measured input.
        """
        bundle = compiled((self.term.text,), self.is_complex)
        # A part of a long chain after another: what is computed on the way stays in the processor's cache.
        parts = [(some, self._gather(bundle.slots, some)) for some in pieces(self.sites, 1, CACHED)]
        size = self.parts * self.sites

        def derivative(t: float, y: ndarray) -> ndarray:
            rate = np.empty_like(y)
            if self.order == 2:
                rate[:size] = y[size:]
            highest = rate[(self.order - 1) * size :].reshape(self.parts, self.sites)
            for some, gather in parts:
                for part, value in enumerate(bundle.function(*gather(t, y))):
                    highest[part, some] = value
            return rate

        return derivative

    @functools.cached_property
    def jacobian(self) -> Callable[[float, ndarray], scipy.sparse.csc_array]:
        """The function dF/dy (t, y), with sparse values (state, state).

        Raises:
            InputError: the equation has a measured input.
        """
        import scipy.sparse

        bundle, places = partials((self.term.text,), self.is_complex)
        gather = self._gather(bundle.slots, slice(0, self.sites))
        size, sites = self.parts * self.sites, self.sites
        rows, columns, weights = [], [], []
        for _, part, slot in places:
            index, factor = self._stencil.neighbours(slot.vector)
            block = (size if slot.name == "v" else 0) + (sites if slot.part == "im" else 0)
            rows.append((self.order - 1) * size + part * sites + np.arange(sites))
            columns.append(block + index)
            weights.append(factor)
        shape = (self.order * size, self.order * size)
        identity = (
            scipy.sparse.csc_array((np.ones(size), (np.arange(size), size + np.arange(size))), shape=shape)
            if self.order == 2
            else scipy.sparse.csc_array(shape)
        )

        def derivative(t: float, y: ndarray) -> scipy.sparse.csc_array:
            if not places:
                return identity
            values = bundle.function(*gather(t, y))
            data = np.concatenate([np.broadcast_to(value, sites) * w for value, w in zip(values, weights, strict=True)])
            place = (np.concatenate(rows), np.concatenate(columns))
            return scipy.sparse.csc_array(identity + scipy.sparse.csc_array((data, place), shape=shape))

        return derivative

    @functools.cached_property
    def _stencil(self) -> Stencil:
        return Stencil.chain(self.sites, self.term.reach, self.ends)

    def _gather(self, slots: tuple[Slot, ...], some: slice) -> Callable[[float, ndarray], list[Any]]:
        """Return the function that cuts a state into the arrays that a compiled term takes at some of the sites."""
        stencil, n = self._stencil, numbers(self.sites, some)
        (left, _), count = self.term.reach, some.stop - some.start
        places: list[tuple[Any, ...]] = [
            () if one.name in ("t", "n") else (*one.place, slice(left + one.offset, left + one.offset + count))
            for one in slots
        ]
        shape = (self.order, self.parts, self.sites)
        if any(slot.name == "f" for slot in slots):
            raise InputError(
                "an equation with a measured input f[n] cannot be simulated; write the force as a function of t"
            )

        def arrays(t: float, y: ndarray) -> list[Any]:
            padded = stencil.cut(y.reshape(shape), some)
            found: list[Any] = []
            for slot, place in zip(slots, places, strict=True):
                if slot.name == "t":
                    found.append(t)
                elif slot.name == "n":
                    found.append(n)
                else:
                    found.append(padded[place])
            return found

        return arrays


def motion(system: System, parameters: Mapping[str, float], sites: int, ends: Ends | None = None) -> Motion:
    """Return the motion of a system on a chain of `sites` sites, with its own ends if `ends` is None.

    Raises:
        InputError: the equation is complex on a real field, or first-order with a velocity.
    """
    term = system.motion(parameters)
    real_parts(term.text, system.is_complex)
    if system.order == 1 and "v" in term.names:
        raise InputError(f"system {system.name!r}: a first-order equation has no velocity v[n]")
    return Motion(term, system.order, system.is_complex, sites, ends or system.ends)
