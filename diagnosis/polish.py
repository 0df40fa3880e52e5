"""Fits of a model with all its parameters: Gauss-Newton steps on its tangent."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.catalogued import SHORTEST_DELAY
from latticebench.diagnosis.model import Fitted, Model, pace, refit
from latticebench.diagnosis.placed import PlacedEffect
from latticebench.diagnosis.tangent import Tangent, linearise

if TYPE_CHECKING:
    from numpy import ndarray

POLISH = 8


def polish(model: Model, start: Fitted) -> Fitted | None:
    """Return the fit of a model with its parameters, from the fit of a smaller one; None where it fails."""
    fitted = refit(model, start.data, start.solution.state)
    if not np.all(np.isfinite(fitted.solution.state.coefficients)):
        return None
    if not any(placed.free for placed in model.effects):
        return fitted
    for _ in range(POLISH):
        tangent = linearise(fitted)
        step, error = _joint_step(tangent)
        effects, errors, begin, largest = [], [], len(fitted.solution.state.coefficients), 0.0
        for placed in fitted.model.effects:
            free = placed.free
            end = begin + len(free)
            size = np.array([_longest(placed, name, fitted) for name in free])
            least = np.array([_least(placed, name, fitted) for name in free])
            move = np.maximum(np.clip(step[begin:end], -size, size), least)
            with np.errstate(divide="ignore", invalid="ignore"):
                largest = max(
                    largest, float(np.max(np.nan_to_num(np.abs(step[begin:end]) / error[begin:end]), initial=0.0))
                )
            effects.append(
                placed.moved({name: placed.psi[name] + float(m) for name, m in zip(free, move, strict=True)})
            )
            errors.append(dict(zip(free, (float(e) for e in error[begin:end]), strict=True)))
            begin = end
        moved = refit(replace(fitted.model, effects=tuple(effects)), fitted.data, fitted.solution.state)
        if not np.all(np.isfinite(moved.solution.state.coefficients)):
            break
        worse = moved.gain(fitted) < -1.0
        if worse:
            break
        fitted = replace(moved, psi_errors=tuple(errors))
        if largest < 0.1:
            break
    return fitted


def _joint_step(tangent: Tangent) -> tuple[ndarray, ndarray]:
    """Return the Gauss-Newton step of all parameters, and their standard errors.

    Random parameters are held by their spread.
    """
    matrix, target = tangent.jacobian, tangent.raw
    begin = len(tangent.fitted.solution.state.coefficients)
    for placed in tangent.fitted.model.effects:
        end = begin + len(placed.free)
        if placed.spread is not None and placed.free:
            prior = np.zeros((end - begin, matrix.shape[1]))
            prior[:, begin:end] = np.eye(end - begin) / placed.spread
            matrix = np.concatenate([matrix, prior])
            target = np.concatenate([target, -np.array([placed.psi[name] for name in placed.free]) / placed.spread])
        begin = end
    length = np.linalg.norm(matrix, axis=0)
    length[length == 0] = 1.0
    left, values, right = np.linalg.svd(matrix / length, full_matrices=False)
    kept = values > 1e-7 * values[0]
    inverse = np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)
    step = right.T @ (inverse * (left.T @ target)) / length
    error = np.sqrt(np.sum((right.T * inverse) ** 2, axis=1)) / length
    return step, error


def _longest(placed: PlacedEffect, name: str, fitted: Fitted) -> float:
    """Return how far a parameter may move in one step."""
    times = fitted.data[0].t
    span, gap = float(times[-1] - times[0]), float(np.median(np.diff(times)))
    limits = {
        "omega": 0.5 * np.pi / span,
        "delay": min(gap, 0.5 * placed.psi.get("delay", gap)),
        "at": 2 * gap,
        "width": 0.3 * placed.psi.get("width", 1.0),
        "s": 0.5,
        "scale": 0.5 * (1 + placed.psi.get("scale", 0.0)),
    }
    return float(limits.get(name, np.inf))


def _least(placed: PlacedEffect, name: str, fitted: Fitted) -> float:
    """Return how far down a parameter may move in one step.

    What has less than a whole wave in the record is no wave, and a delay much shorter than the motion's own time no
    memory.
    """
    if name == "omega":
        span = max(float(one.t[-1]) for one in fitted.data) - min(float(one.t[0]) for one in fitted.data)
        return 2 * np.pi / span - placed.psi["omega"]
    if name == "delay":
        return SHORTEST_DELAY / max(pace(fitted.curves()), 1e-300) - placed.psi["delay"]
    return -np.inf
