"""What instruments make of a motion, undone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.model import Model
from latticebench.diagnosis.reading import read_by

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.horizon import Layout

# Newton steps that undo what instruments do, and the least slope of a reading that can be undone.
UNREAD, LEAST_SLOPE = 6, 0.05


def unread(model: Model, layout: Layout, number: int, nodes: Float[ndarray, "time state"]) -> ndarray:
    """Return states whose readings by a model's instruments are given states.

    Args:
        model: whose instruments are undone.
        layout: the recordings.
        number: of the recording.
        nodes: smoothed readings as states, at all its times.
    """
    instruments = [placed for placed, _ in model.instruments(number)]
    if not instruments:
        return nodes
    record, chain = layout.records[number], layout.chain
    t, driven = record.times, record.stretches.driven(record.times, layout.splines[number])
    reading = layout.plain.whole(nodes, driven)
    field = reading.copy()
    for _ in range(UNREAD):
        wrong = read_by(instruments, t, field).read(chain.levels)
        level, own = field[:, : chain.levels] + wrong.added, 1 + wrong.slope
        own = np.where(np.abs(own) > LEAST_SLOPE, own, 1.0)
        field[:, : chain.levels] += (reading[:, : chain.levels] - level) / own
    if chain.levels < field.shape[1]:
        field[:, 1] = reading[:, 1] / own[:, 0]
    return np.asarray(field[..., layout.plain.moving].reshape(nodes.shape))
