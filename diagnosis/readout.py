"""What instruments make of a motion, undone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.model import Model
from latticebench.diagnosis.reading import Sensitivity, read_by

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.horizon import Layout

# Newton steps that undo what instruments do.
UNREAD = 6


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
        level, sensitivity = field[:, : chain.levels] + wrong.added, Sensitivity.of(wrong)
        field[:, : chain.levels] += sensitivity.undone(reading[:, : chain.levels] - level)
    if chain.levels < field.shape[1]:
        field[:, 1] = sensitivity.undone(reading[:, 1:2])[:, 0]
    return np.asarray(field[..., layout.plain.moving].reshape(nodes.shape))
