"""Sizes of the field, its velocity, its rate and each term, estimated from samples, by which a loss is scaled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import evaluate

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@dataclass(frozen=True)
class Sizes:
    """Root mean squares over all samples and sites, all > 0; of a complex quantity, of its modulus.

    Attributes:
        field: of u about its mean.
        velocity: of du/dt.
        rate: of the derivative that the equation describes, du/dt (order 1) or d^2u/dt^2 (order 2).
        terms: of each term (terms,).
    """

    field: float
    velocity: float
    rate: float
    terms: Float[ndarray, " terms"]

    def coefficients(self) -> Float[ndarray, " terms"]:
        """Return the size of each coefficient (terms,): that at which its term alone is as large as the rate."""
        return self.rate / self.terms


def estimate_sizes(data: Sequence[Samples], library: Library, order: int) -> Sizes:
    """Estimate sizes from samples, derivatives by differences between neighbouring samples.

    A size that is 0, or that no sample tells, is 1.
    """
    fields, velocities, rates, terms = [], [], [], []
    for samples in data:
        u = samples.u
        velocity = _slope(samples.t, u) if samples.v is None or order == 1 else samples.v
        rate = velocity if order == 1 else _slope(samples.t, velocity)
        with np.errstate(all="ignore"):
            values = evaluate(
                library.terms, u, velocity if order == 2 else None, samples.f, samples.t, ends=samples.ends
            )
        fields.append((u - np.nanmean(u)).ravel())
        velocities.append(velocity.ravel())
        rates.append(rate.ravel())
        terms.append(np.sqrt(np.sum(values**2, axis=0)).reshape(len(library.terms), -1))

    def size(parts: list[ndarray]) -> float:
        squares = np.abs(np.concatenate(parts)) ** 2
        squares = squares[np.isfinite(squares)]
        found = float(np.sqrt(np.mean(squares))) if len(squares) else 0.0
        return found if found > 0 and np.isfinite(found) else 1.0

    each = [size([part[k] for part in terms]) for k in range(len(library.terms))]
    return Sizes(size(fields), size(velocities), size(rates), np.array(each))


def _slope(t: ndarray, field: ndarray) -> ndarray:
    """Return differences between neighbouring samples over the time between them (T, N); NaN without a neighbour."""
    slope = np.full(field.shape, np.nan, dtype=field.dtype)
    for site in range(field.shape[1]):
        seen = np.isfinite(field[:, site])
        if np.sum(seen) > 1:
            slope[seen, site] = np.gradient(field[seen, site], t[seen])
    return slope
