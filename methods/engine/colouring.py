"""Which site a disturbance came from, where sites far apart were disturbed together.

Sites of one colour are so far apart that their effects do not overlap (Curtis, Powell & Reid, IMA J. Appl. Math. 13,
117 (1974)).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.dynamics import Dynamics

if TYPE_CHECKING:
    import scipy.sparse
    from numpy import ndarray

# The largest share of a disturbance that may be left beyond its reach.
TAIL = 1e-9


@dataclass(frozen=True, eq=False)
class Pairs:
    """Derivatives of sites by sites of their neighbourhood.

    Attributes:
        entries: (pair, stretch, block of the start, block of the end).
        source, target: the sites of each pair.
    """

    entries: ndarray
    source: ndarray
    target: ndarray

    @classmethod
    def of(cls, grouped: ndarray, dynamics: Dynamics, colours: int, far: int) -> Pairs | None:
        """Separate the sites of each group; None where the effects of two sites overlap."""
        count, blocks = dynamics.count, dynamics.order * dynamics.parts
        ring = dynamics.stencil.is_ring
        site = np.arange(count)
        offset = np.arange(-far, far + 1)
        source = site[:, None] + offset
        inside = np.ones(source.shape, dtype=bool) if ring else (source >= 0) & (source < count)
        target = np.broadcast_to(site[:, None], source.shape)[inside]
        source = (source % count)[inside]
        edge = np.abs(np.broadcast_to(offset, inside.shape)[inside]) == far
        shaped = grouped.reshape(len(grouped), blocks, colours, blocks, count)
        # NumPy puts the axis of the paired indices first.
        entries = shaped[:, :, source % colours, :, target]
        if np.any(edge) and np.max(np.abs(entries[edge]), initial=0.0) > TAIL * np.max(np.abs(entries)):
            return None
        return cls(entries, source, target)


def spread(grouped: ndarray, dynamics: Dynamics, colours: int, far: int) -> list[scipy.sparse.csr_array] | None:
    """Return one sparse (S, S) matrix per stretch, with rows for the start; None where effects overlap."""
    import scipy.sparse

    pairs = Pairs.of(grouped, dynamics, colours, far)
    if pairs is None:
        return None
    count, blocks = dynamics.count, dynamics.order * dynamics.parts
    into, out = np.meshgrid(np.arange(blocks), np.arange(blocks), indexing="ij")
    rows = (into[None] * count + pairs.source[:, None, None]).ravel()
    columns = (out[None] * count + pairs.target[:, None, None]).ravel()
    # All stretches have their entries in the same places, which are sorted once.
    order = np.lexsort((columns, rows))
    indices = columns[order].astype(np.int32)
    pointers = np.searchsorted(rows[order], np.arange(dynamics.size + 1)).astype(np.int32)
    entries = np.moveaxis(pairs.entries, 1, 0).reshape(len(grouped), -1)[:, order]
    shape = (dynamics.size, dynamics.size)
    return [scipy.sparse.csr_array((one, indices, pointers), shape=shape) for one in entries]


def spread_dense(grouped: ndarray, dynamics: Dynamics, colours: int, far: int) -> ndarray | None:
    """Return the (K, S, S) derivatives of the ends by the start; None where effects overlap."""
    pairs = Pairs.of(grouped, dynamics, colours, far)
    if pairs is None:
        return None
    count, blocks = dynamics.count, dynamics.order * dynamics.parts
    found = np.zeros((len(grouped), blocks, count, blocks, count))
    found[:, :, pairs.source, :, pairs.target] = pairs.entries
    return found.reshape(len(grouped), dynamics.size, dynamics.size)
