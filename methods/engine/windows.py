"""Windows of a long chain, whose outer sites move as they were read.

A window is samples of its own at unknown ends: the sites beyond it are no boundary condition but data. Every site
belongs to one window, and is read by the next one, too, where the stencil asks for it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Int
    from numpy import ndarray

# Sites of a window, besides those that are read around it: at 64 the outer ones cost a few per cent of what is told.
WINDOW = 64


@dataclass(frozen=True, eq=False)
class Part:
    """A window of a trajectory.

    Attributes:
        samples: what was observed there and around it, at unknown ends.
        sites: the sites of the chain that are its own.
        own: where these are among its samples' sites.
    """

    samples: Samples
    sites: Int[ndarray, " own"]
    own: slice


def is_wide(data: Sequence[Samples], library: Library, most: int) -> bool:
    """Return whether trajectories of more than `most` sites can be fitted by windows.

    Terms that ask for the number of a site cannot: in a window it would be another.
    """
    return not library.uses("n") and any(samples.sites > most for samples in data)


def cut(samples: Samples, reach: tuple[int, int], size: int = WINDOW) -> Iterator[Part]:
    """Yield windows of about `size` sites that go through a chain; a single one where it is shorter than two.

    Args:
        samples: the trajectory.
        reach: how many sites the equation reads to the left and to the right.
        size: of a window.
    """
    number = samples.sites // size
    if number < 2:
        yield Part(samples, np.arange(samples.sites), slice(None))
        return
    cuts = np.arange(number + 1) * samples.sites // number
    for begin, end in itertools.pairwise(cuts.tolist()):
        yield window(samples, reach, begin, end)


def window(samples: Samples, reach: tuple[int, int], begin: int, end: int) -> Part:
    """Return the window of the sites from `begin` to before `end`."""
    first, last = begin - reach[0], end + reach[1]
    if samples.ends != "periodic":
        first, last = max(first, 0), min(last, samples.sites)
    columns = np.arange(first, last) % samples.sites
    some = slice(first, last) if first >= 0 and last <= samples.sites else columns

    def part(field: ndarray | None) -> ndarray | None:
        return None if field is None else np.array(field[:, some])

    u = part(samples.u)
    assert u is not None
    source = f"{samples.source}, sites {begin + 1} to {end}"
    own = replace(samples, u=u, v=part(samples.v), f=part(samples.f), ends="unknown", source=source)
    return Part(own, np.arange(begin, end), slice(begin - first, end - first))
