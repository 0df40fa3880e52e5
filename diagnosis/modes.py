"""Frequencies and decay rates: of a recording by its spectrum, of a model by its equation linearised about rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.problem import Problem

# Modes that are listed, at most.
MOST_MODES = 8
# A decay rate below this share of the largest eigenvalue is none.
ROUNDING = 1e-9


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
    """Return the modes of a model linearised over the swing of its motion, those of lowest frequency first.

    Its slopes are those between a standard deviation of the motion to either side of the mean, as a describing function
    has them: the frequency of a pendulum is that of its swing, and dry friction, which jumps at rest, damps it. Forces
    that depend on time have no part in them. A pair of real eigenvalues has the frequency 0.
    """
    layout = fitted.layout
    assembled = fitted.model.assembled(layout.plain, layout.chain)
    dynamics = assembled.dynamics
    states = np.concatenate([one.reshape(-1, fitted.followed.size) for one in fitted.followed.nodes])
    mean, size = np.mean(states, axis=0), float(np.sqrt(np.mean(states**2)))
    if dynamics.order == 2:
        mean[len(mean) // 2 :] = 0.0
    step = np.maximum(np.std(states, axis=0), 1e-4 * size + 1e-300)
    t = np.zeros(2 * len(mean))
    around = np.concatenate([mean + np.diag(step), mean - np.diag(step)])
    driven = layout.records[0].stretches.driven(t + layout.records[0].times[0], layout.splines[0])
    f = None if layout.records[0].stretches.inputs is None else np.zeros((len(t), layout.chain.sites))
    with np.errstate(all="ignore"):
        rate = dynamics.linear(assembled.coefficients, t, around, f, driven, derivatives=False)[0]
        matrix = ((rate[: len(mean)] - rate[len(mean) :]) / (2 * step[:, None])).T
    if not np.all(np.isfinite(matrix)):
        return ()
    values = np.linalg.eigvals(matrix)
    upper = values[values.imag >= 0]
    upper = np.where(np.abs(upper.real) < ROUNDING * np.max(np.abs(values)), 1j * upper.imag, upper)
    found = [Mode(float(one.imag), float(-one.real) + 0.0) for one in upper[np.argsort(upper.imag)]]
    return tuple(found[:MOST_MODES])
