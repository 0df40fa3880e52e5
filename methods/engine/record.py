"""A trajectory as a fit sees it: real numbers, a mask of what was observed, and the equation set up on its chain."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.border import choose_basis
from latticebench.methods.engine.dynamics import Dynamics, Factor, split_parts
from latticebench.methods.engine.sensitivity import Stretches
from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray


@dataclass(frozen=True, eq=False)
class Record:
    """One trajectory, with 0 where nothing was observed.

    Attributes:
        stretches: the motion between the sample times.
        value: u and, for order 2 if it was observed, v: (T, levels, parts, N).
        seen: whether a value was observed, likewise.
        times: T sample times.
    """

    stretches: Stretches
    value: Float[ndarray, "time levels parts sites"]
    seen: Bool[ndarray, "time levels parts sites"]
    times: Float[ndarray, " time"]

    def piece(self, begin: int, end: int) -> Record:
        """Return the samples `begin` to `end` - 1 as a record of their own, with the drive held as it is."""
        whole = self.stretches
        # What the drive lacks matters little over a short time.
        stretches = replace(whole, begin=whole.begin[begin : end - 1], end=whole.end[begin : end - 1], held=True)
        return Record(stretches, self.value[begin:end], self.seen[begin:end], self.times[begin:end])

    def with_terms(self, terms: tuple[Term, ...]) -> Record:
        """Return the record with an equation of other terms; at unknown ends the same sites have an equation."""
        dynamics = self.stretches.dynamics
        least = dynamics.reach if dynamics.ends == "unknown" else dynamics.least_reach
        return replace(
            self, stretches=replace(self.stretches, dynamics=replace(dynamics, terms=terms, least_reach=least))
        )


def prepare(
    samples: Samples,
    terms: tuple[Term, ...],
    order: int,
    weights: Float[ndarray, "terms sites"] | None = None,
    factors: tuple[Factor | None, ...] | None = None,
    least_reach: tuple[int, int] = (0, 0),
) -> Record:
    """Set the equation up on the chain of a trajectory.

    Args:
        samples: what was observed.
        terms: of the equation.
        order: of the time derivative.
        weights: of each term at each site, see `latticebench.methods.engine.dynamics.Dynamics`.
        factors: of each term in time, likewise.
        least_reach: of the stencil, likewise.

    Raises:
        InputError: the order is neither 1 nor 2, or the chain is shorter than the stencil.
    """
    if order not in (1, 2):
        raise InputError(f"order is {order!r}; it must be 1 (du/dt) or 2 (d^2u/dt^2)")
    dynamics = Dynamics(terms, order, samples.is_complex, samples.sites, samples.ends, weights, factors, least_reach)
    fields = [samples.u] if order == 1 or samples.v is None else [samples.u, samples.v]
    value = np.stack([split_parts(one, samples.is_complex) for one in fields], axis=1)
    # A complex value of which one part is missing is missing.
    known = np.isfinite(value)
    seen = known & np.all(known, axis=2, keepdims=True)
    drive = choose_basis(samples, dynamics) if len(dynamics.border) else None
    inputs = None
    if samples.f is not None and any("f" in term.names for term in terms):
        inputs = samples.forcing()
    stretches = Stretches(dynamics, samples.t[:-1], samples.t[1:], inputs, drive)
    return Record(stretches, np.where(seen, value, 0.0), seen, samples.t)


def without_halves(samples: Samples) -> Samples:
    """Make both parts of a missing complex value NaN; as a number it may be nan + 0i."""

    def whole(field: ndarray | None) -> ndarray | None:
        if field is None or not np.iscomplexobj(field):
            return field
        return np.where(np.isnan(field), complex(np.nan, np.nan), field)

    u = whole(samples.u)
    assert u is not None
    return replace(samples, u=u, v=whole(samples.v))
