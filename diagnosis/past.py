"""What feeds a motion with its own past: the field at earlier times is the model's own, not what was read.

A term that is fed with readings guides the motion to them, whatever the equation lacks, as an observer does
(Luenberger, IEEE Trans. Autom. Control 16, 596 (1971)). The past of a fit is therefore the motion that an earlier fit
has found, until both are the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.diagnosis.fitting import Fitted, fit
from latticebench.diagnosis.horizon import Layout
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import Problem, course
from latticebench.diagnosis.readout import unread
from latticebench.methods.engine.dynamics import Factor

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Fits one after another, each with the motion of the last one as its past, and the nats that may change from one to
# the next where they have come to an end.
ROUNDS, SETTLED = 4, 1.0


def past_of(
    problem: Problem, layout: Layout, model: Model, nodes: Sequence[Float[ndarray, "pieces m state"]]
) -> tuple[Factor, ...]:
    """Return the field of each recording as a function of times: along the pieces their states, else what was read."""
    found = []
    for number, (rows, valid, states) in enumerate(zip(layout.rows, layout.valid, nodes, strict=True)):
        every = np.array(unread(model, layout, number, problem.nodes[number]))
        every[rows[valid]] = states[valid]
        record = layout.records[number]
        driven = record.stretches.driven(record.times, layout.splines[number])
        found.append(course(record.times, layout.plain.whole(every, driven)[:, 0]))
    return tuple(found)


def settled(
    problem: Problem, model: Model, layout: Layout, near: Sequence[Float[ndarray, "pieces m state"]], **settings: Any
) -> Fitted | None:
    """Return the fit of a model (see `fit`, which has these settings) whose past, if it is fed, is its own motion."""
    if not any(one.fed for one in model.effects):
        return fit(model, layout, near, **settings)
    last = np.inf
    for _ in range(ROUNDS):
        found = fit(model.with_past(past_of(problem, layout, model, near)), layout, near, **settings)
        if found is None or abs(found.cost - last) < SETTLED:
            return found
        model, near, last = found.model, found.followed.nodes, found.cost
        settings.update(noise=found.noise, splines=found.followed.splines)
    return found
