"""What a motion has to do with its past: what it is fed with, and where what is not read may be.

What feeds a motion with its past, the field at earlier times, is the model's own, not what was read.

A term that is fed with readings guides the motion to them, whatever the equation lacks, as an observer does
(Luenberger, IEEE Trans. Autom. Control 16, 596 (1971)). The past of a fit is therefore the motion that an earlier fit
has found, until both are the same.

What hangs beside a site and is not read has a state of its own. A fit begins with where it would be if it was at rest
as the recording began, or with where an earlier fit has found it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.acting.scene import Course
from latticebench.diagnosis.fitting import Fitted, fit
from latticebench.diagnosis.horizon import Layout
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.readout import unread
from latticebench.methods.engine.resonator import Resonator

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Fits one after another, each with the motion of the last one as its past, and the nats that may change from one to
# the next where they have come to an end.
ROUNDS, SETTLED = 4, 1.0


def past_of(
    problem: Problem, layout: Layout, model: Model, nodes: Sequence[Float[ndarray, "pieces m state"]]
) -> tuple[Course, ...]:
    """Return the field of each recording as a function of times: along the pieces their states, else what was read."""
    found = []
    for number, (rows, valid, states) in enumerate(zip(layout.rows, layout.valid, nodes, strict=True)):
        every = np.array(unread(model, layout, number, problem.nodes[number]))
        every[rows[valid]] = states[valid][:, : layout.plain.read]
        found.append(_course(layout, number, every))
    return tuple(found)


def with_unread(
    problem: Problem, layout: Layout, model: Model, near: Sequence[Float[ndarray, "pieces m read"]]
) -> tuple[Float[ndarray, "pieces m state"], ...]:
    """Return states with those of what is not read, as far as the past tells; as they are where they have these."""
    read, hanging = layout.plain.read, model.hanging(layout.chain)
    if near[0].shape[-1] == read + Resonator.size * len(hanging):
        return tuple(near)
    seen = tuple(one[..., :read] for one in near)
    if not hanging:
        return seen
    times = (record.times[rows] for record, rows in zip(layout.records, layout.rows, strict=True))
    return tuple(_with(hanging, *each) for each in zip(past_of(problem, layout, model, seen), times, seen, strict=True))


def with_known(fitted: Fitted, number: int, states: Float[ndarray, "time read"]) -> Float[ndarray, "time state"]:
    """Return states of a recording with those of what is not read, as a fit knows it where its pieces are."""
    layout, nodes = fitted.layout, fitted.followed.nodes[number]
    if not (hanging := fitted.model.hanging(layout.chain)):
        return states
    found = _with(hanging, _course(layout, number, states), layout.records[number].times, states)
    rows, valid = layout.rows[number], layout.valid[number]
    found[rows[valid], layout.plain.read :] = nodes[valid][:, layout.plain.read :]
    return found


def _with(
    hanging: Sequence[Placed], past: Course, t: Float[ndarray, "*rows"], states: Float[ndarray, "*rows read"]
) -> Float[ndarray, "*rows state"]:
    return np.concatenate([states, *(one.unread(past, t) for one in hanging)], axis=-1)


def _course(layout: Layout, number: int, states: Float[ndarray, "time read"]) -> Course:
    """Return the field of one recording as a function of times, from its states."""
    record = layout.records[number]
    driven = record.stretches.driven(record.times, layout.splines[number])
    return Course.of(record.times, layout.plain.whole(states, driven)[:, 0])


def settled(
    problem: Problem, model: Model, layout: Layout, near: Sequence[Float[ndarray, "pieces m state"]], **settings: Any
) -> Fitted | None:
    """Return the fit of a model (see `fit`, which has these settings) whose past, if it is fed, is its own motion."""
    near = with_unread(problem, layout, model, near)
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
