"""What all instruments of a model together make of a motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting import Misreading, Placed
from latticebench.diagnosis.acting.late import Late, misread_late

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


def read_by(instruments: Sequence[Placed], t: ndarray, field: Float[ndarray, "rows levels parts sites"]) -> Misreading:
    """Return what instruments make of a motion; numbers are those of the instruments one after another.

    First readings are late by all that makes them so; all the rest is done to what is read then, and adds up.

    Args:
        instruments: in the order of their numbers.
        t: times of the rows.
        field: u and, where the motion has them, v and its rate.
    """
    late = [one for one in instruments if isinstance(one, Late)]
    first = misread_late(late, t, field) if late else None
    seen = field if first is None else field + first.added
    rest = [one.misread(t, seen) for one in instruments if not isinstance(one, Late)]
    added, slope = np.zeros_like(field), np.zeros_like(field)
    for wrong in rest:
        added, slope = added + wrong.added, slope + wrong.slope
    by, others, begin = [], iter(rest), 0
    for one in instruments:
        if isinstance(one, Late) and first is not None:
            by.append((1 + slope) * first.by[begin : begin + one.count])
            begin += one.count
        else:
            by.append(next(others).by)
    numbers = np.concatenate(by) if by else np.zeros((0, *field.shape))
    if first is None:
        return Misreading(added, slope, numbers)
    by_rates = (1 + slope)[:, :, None] * (0.0 if first.by_rates is None else first.by_rates)
    return Misreading(first.added + added, (1 + slope) * (1 + first.slope) - 1, numbers, by_rates)


def is_late(instruments: Sequence[Placed]) -> bool:
    """Return whether any of them makes readings late: it needs the rate of v, too."""
    return any(isinstance(one, Late) for one in instruments)


def seen_by(instruments: Sequence[Placed], t: ndarray, field: ndarray) -> ndarray:
    """Return the motion as it was when it was read: what else a sensor might do, it would do to that."""
    late = [one for one in instruments if isinstance(one, Late)]
    return field + misread_late(late, t, field).added if late else field
