"""Frequencies and decay rates: of a recording by its spectrum, of a model by its equation linearised about rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.problem import Problem

if TYPE_CHECKING:
    from numpy import ndarray

# Modes that are listed, at most.
MOST_MODES = 8
# A decay rate below this share of the largest eigenvalue is none.
ROUNDING = 1e-9
# A motion leads into a direction where its variance there is more than this share of what its states have.
WHERE_IT_LEADS = 1e-3
# A state swings at least by this share of all.
SMALLEST = 1e-4


@dataclass(frozen=True)
class Mode:
    """One frequency of a motion.

    Attributes:
        frequency: angular.
        decay: rate at which its amplitude falls, one over the unit of time; NaN where it is not known.
    """

    frequency: float
    decay: float


def of_recording(problem: Problem) -> tuple[Mode, ...]:
    """Return the peaks of the longest recording's spectrum, the strongest first."""
    return tuple(Mode(float(one), float("nan")) for one in problem.spectrum.peaks[:MOST_MODES])


def of_model(fitted: Fitted) -> tuple[Mode, ...]:
    """Return the modes of a model linearised over its motion, those of lowest frequency first.

    The linear equation is the one whose forces come closest to the model's in the least squares over the motion
    (equivalent linearisation; Caughey, J. Acoust. Soc. Am. 35, 1706 (1963)): the frequency of a pendulum is that of its
    swing, a damping that grows with the swing counts as it acts, and dry friction, which jumps at rest, damps. Where
    the motion does not lead, it has the slopes between a standard deviation of the motion to either side of the mean.
    Forces without the field have no part in it. A pair of real eigenvalues has the frequency 0.
    """
    layout = fitted.layout
    assembled = fitted.model.assembled(layout.plain, layout.chain)
    dynamics, stretches = assembled.dynamics, layout.records[0].stretches
    valid = layout.valid[0]
    states, t = fitted.followed.nodes[0][valid], layout.records[0].times[layout.rows[0][valid]]
    mean, size = np.mean(states, axis=0), float(np.sqrt(np.mean(states**2)))
    if dynamics.order == 2:
        mean[len(mean) // 2 :] = 0.0
    step = np.maximum(np.std(states, axis=0), SMALLEST * size + 1e-300)

    def rate(t: ndarray, states: ndarray) -> ndarray:
        f = None if stretches.inputs is None else np.zeros((len(t), layout.chain.sites))
        driven = stretches.driven(t, layout.splines[0])
        return dynamics.linear(assembled.coefficients, t, states, f, driven, derivatives=False)[0]

    with np.errstate(all="ignore"):
        around = np.concatenate([np.diag(step), -np.diag(step)])
        ends = rate(np.full(len(around), t[0]), mean + around)
        local = (ends[: len(mean)] - ends[len(mean) :]) / 2
        moved = (states - mean) / step
        forced = rate(t, states) - rate(t, np.broadcast_to(mean, states.shape)) - moved @ local
        moved, forced = moved - np.mean(moved, axis=0), forced - np.mean(forced, axis=0)
        if not np.all(np.isfinite(forced)):
            return ()
        gram = moved.T @ moved / len(moved) + WHERE_IT_LEADS * np.eye(len(mean))
        matrix = (local + np.linalg.solve(gram, moved.T @ forced / len(moved))).T / step
    values = np.linalg.eigvals(matrix)
    upper = values[values.imag >= 0]
    upper = np.where(np.abs(upper.real) < ROUNDING * np.max(np.abs(values)), 1j * upper.imag, upper)
    found = [Mode(float(one.imag), float(-one.real) + 0.0) for one in upper[np.argsort(upper.imag)]]
    return tuple(found[:MOST_MODES])
