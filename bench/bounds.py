"""A bound that can be asked for more samples, and that of recordings: along the motion that a fit follows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from latticebench import methods
from latticebench.bench.limit import Limit, denser
from latticebench.bench.noise import left_by
from latticebench.methods.method import solve
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

# A bound for so many times the samples in the same time, and for a record so many times as long.
BoundAt = Callable[[int, int], Limit]


@dataclass(frozen=True, eq=False)
class BoundOf:
    """The bound of some samples, of as many again, and of longer records.

    Attributes:
        at: the bound.
        note: where it is taken, and the noise of each sensor, one line each.
        warnings: why it may not hold.
    """

    at: BoundAt
    note: str
    warnings: tuple[str, ...]


def of_recordings(data: Sequence[Samples], candidates: Library, order: int) -> BoundOf:
    """Fit recordings by the method that gives the motion it follows, and return the bound along that.

    Raises:
        Skipped: the method cannot take the recordings.
        InputError: the equation cannot be set up on them.
    """
    method = next(kind() for kind in methods.registered().values() if kind().abilities.motion)
    fit = solve(method, data, candidates, order, 1)
    left = left_by(data, fit)

    def bound_at(more: int, longer: int) -> Limit:
        if longer > 1:
            raise InputError("nobody knows how the motion goes on after the record")
        return denser(data, fit, more, left.noise)

    note = (
        f"{data[0].source}: bound along the motion that {fit.method!r} fits to the samples, with the noise that it "
        "leaves" + ("" if fit.status == "ok" else f" ({fit.status})")
    )
    return BoundOf(bound_at, "\n".join([note, *(f"noise of {line}" for line in left.lines)]), left.warning)
