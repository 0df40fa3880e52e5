"""A library's equation on a curve: fields in, values of the terms and their slopes out, and the way back.

Fields are one matrix (..., P, blocks * N): a row per time, and per block a column for each of the N sites. The blocks
are u and, where the order is 2, v; of a complex field each is two blocks, the real and then the imaginary parts. `...`
is nothing for one curve, or one axis of members (several curves at once, on torch).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.inputs import inputs
from latticebench.methods.engine.networks.compiled_terms import CompiledTerms, compile_terms
from latticebench.systems.compiler import Slot
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import Ends, ghosts, observed

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.methods.engine.networks.arrays import Array, Arrays


@dataclass(frozen=True, eq=False)
class CurveEquation:
    """rate = sum_j xi_j T_j on one trajectory, at P times.

    Attributes:
        terms: the compiled library.
        count: the number of terms J.
        parts: 1 for a real field, 2 for a complex one.
        order: of the time derivative.
        sites: N.
        reach: how many sites the stencil sees to the left and to the right.
        inner: the sites at which the equation is asked for, as columns of a block: those whose whole stencil was
            observed, all of them where the ends of the chain are known.
        fold: matrix (N, padded) that repeats sites beyond known ends; None where nothing is repeated.
        given: values of the slots that are not fields, t, n and f: arrays (P, inner).
    """

    terms: CompiledTerms
    count: int
    parts: int
    order: int
    sites: int
    reach: tuple[int, int]
    inner: slice
    fold: Array | None
    given: dict[Slot, Array]

    @property
    def width(self) -> int:
        """The number of sites at which the equation is asked for."""
        return int(self.inner.stop - self.inner.start)

    def evaluate(self, fields: Array, xi: Array) -> tuple[list[list[Any]], list[Any]]:
        """Evaluate the terms and their slopes.

        Args:
            fields: (..., P, blocks * N).
            xi: coefficients (..., J).

        Returns:
            the terms, one list of J for each part, and the derivatives of sum_j xi_j T_j that `terms.slopes` names.
            Each is an array (..., P, inner), or a number where it is the same everywhere.
        """
        values = self.terms.function(*self._slots(fields), *multipliers(xi))
        split = self.count * self.parts
        terms = [list(values[first : first + self.count]) for first in range(0, split, self.count)]
        return terms, list(values[split:])

    def rate_columns(self, part: int) -> slice:
        """Return the columns, at the inner sites, of what the rate is the first derivative of (u, or v for order 2)."""
        first = ((self.order - 1) * self.parts + part) * self.sites
        return slice(first + self.inner.start, first + self.inner.stop)

    def pull_back(self, slopes: Sequence[Any], weights: Sequence[Array], gradient: Array) -> None:
        """Add the derivative by the fields of the sum over parts and points of weights * sum_j xi_j T_j.

        Args:
            slopes: as `evaluate` returned them.
            weights: one array (..., P, inner) per part.
            gradient: (..., P, blocks * N), to which the derivative is added in place.
        """
        padded: dict[int, Array] = {}
        for (part, slot), slope in zip(self.terms.slopes, slopes, strict=True):
            block, first = self._block(slot), self.reach[0] + slot.offset
            if self.fold is None:
                target = gradient[..., block * self.sites : (block + 1) * self.sites]
            else:
                if block not in padded:
                    padded[block] = gradient[..., :1] * self.fold[:1] * 0
                target = padded[block]
            target[..., first : first + self.width] += weights[part] * slope
        for block, weight in padded.items():
            assert self.fold is not None
            gradient[..., block * self.sites : (block + 1) * self.sites] += weight @ self.fold.T

    def _slots(self, fields: Array) -> list[Array]:
        """Return what each slot of the terms reads, (..., P, inner)."""
        blocks: dict[int, Array] = {}
        arrays = []
        for slot in self.terms.slots:
            if slot in self.given:
                arrays.append(self.given[slot])
                continue
            block = self._block(slot)
            if block not in blocks:
                columns = fields[..., block * self.sites : (block + 1) * self.sites]
                blocks[block] = columns if self.fold is None else columns @ self.fold
            first = self.reach[0] + slot.offset
            arrays.append(blocks[block][..., first : first + self.width])
        return arrays

    def _block(self, slot: Slot) -> int:
        """Return the number of the block of columns that a slot reads."""
        return (self.parts if slot.name == "v" else 0) + (slot.part == "im")


def curve_equation(
    samples: Samples, library: Library, order: int, times: Float[ndarray, " time"], arrays: Arrays
) -> CurveEquation:
    """Set a library up on one trajectory.

    Args:
        samples: the trajectory: its sites, ends and measured input.
        library: the terms.
        order: of the time derivative.
        times: where the equation is asked for (P,).
        arrays: of the device.
    """
    ends: Ends = samples.ends
    sites, reach, move = samples.sites, library.reach, arrays.move
    index, factor = ghosts(sites, *reach, ends)
    inner = observed(sites, reach, ends)
    fold = None
    if ends != "unknown" and sum(reach) > 0:
        fold = np.zeros((sites, len(index)))
        fold[index, np.arange(len(index))] = factor
    compiled = compile_terms(library.texts, samples.is_complex, "torch" if arrays.batches else "numpy")
    shape = (len(times), inner.stop - inner.start)
    given: dict[Slot, Any] = {}
    forced = inputs(samples, times)[:, index] * factor if samples.f is not None and library.uses("f") else None
    for slot in compiled.slots:
        if slot.name == "t":
            given[slot] = move(np.broadcast_to(times[:, None], shape))
        elif slot.name == "n":
            given[slot] = move(np.broadcast_to((np.arange(sites) - (sites - 1) / 2)[inner], shape))
        elif slot.name == "f":
            assert forced is not None
            first = reach[0] + slot.offset
            given[slot] = move(forced[:, first : first + shape[1]])
    return CurveEquation(
        compiled, len(library.terms), 1 + samples.is_complex, order, sites, reach, inner,
        None if fold is None else move(fold), given,
    )  # fmt: skip


def columns(samples: Samples, order: int) -> Float[ndarray, "time columns"]:
    """Write samples as fields (T, blocks * N), in the module's layout; NaN where a value was not observed.

    A complex value of which one part is missing is missing.
    """
    gap = complex(np.nan, np.nan) if samples.is_complex else np.nan
    fields = [np.where(np.isnan(samples.u), gap, samples.u)]
    if order == 2:
        fields.append(np.full_like(samples.u, np.nan) if samples.v is None else samples.v)
    blocks = [part for one in fields for part in ((one.real, one.imag) if samples.is_complex else (one,))]
    return np.concatenate(blocks, axis=1).astype(float)


def multipliers(xi: Array) -> list[Any]:
    """Return each coefficient as it multiplies a term (..., P, inner).

    Args:
        xi: coefficients (J,) of one curve, or (K, J) of K members.

    Returns:
        J numbers, or J arrays (K, 1, 1).
    """
    return list(xi.tolist()) if xi.ndim == 1 else [xi[:, k, None, None] for k in range(xi.shape[1])]
