"""Frequencies and decay rates: of a recording by its spectrum, of a model by the linear equation nearest to its motion.

The linear equation is the one whose forces come closest to the model's in the least squares over the motion
(equivalent linearisation; Caughey, J. Acoust. Soc. Am. 35, 1706 (1963)).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.problem import Problem

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


# Modes that are listed, at most.
MOST_MODES = 8
# A decay rate below this share of the largest eigenvalue is none.
ROUNDING = 1e-9
# Directions in which a motion has less than this share of the variance of its states keep the local slope.
WHERE_IT_LEADS = 1e-3
# The smallest step of a local slope, as a share of the root mean square of all states.
SMALLEST = 1e-4
# Times at which local slopes are taken, at most: what depends on time is averaged over them.
MOST_TIMES = 16


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

    The frequency of a pendulum is that of its swing, a damping that grows with the swing counts as it acts, and dry
    friction, which jumps at rest, damps. The motion counts with its mirror image in time, so that forces that keep the
    energy damp nothing however short the recording is. Where the motion does not lead, the linear equation has the
    slopes between a standard deviation to either side of the mean. Forces that do not depend on the present field have
    no part in it. A pair of real eigenvalues has the frequency 0.
    """
    longest = int(np.argmax([one.size for one in fitted.layout.rows]))
    valid, rows = fitted.layout.valid[longest], fitted.layout.rows[longest]
    t, states = fitted.layout.records[longest].times[rows[valid]], fitted.followed.nodes[longest][valid]
    with np.errstate(all="ignore"):
        matrix = _linearised(fitted, longest, t, states)
    if not np.all(np.isfinite(matrix)):
        return ()
    values = np.linalg.eigvals(matrix)
    upper = values[values.imag >= 0]
    upper = np.where(np.abs(upper.real) < ROUNDING * np.max(np.abs(values)), 1j * upper.imag, upper)
    found = [Mode(float(one.imag), float(-one.real) + 0.0) for one in upper[np.argsort(upper.imag)]]
    return tuple(found[:MOST_MODES])


def _linearised(fitted: Fitted, number: int, t: ndarray, states: ndarray) -> Float[ndarray, "state state"]:
    """Return the matrix of the linear equation nearest to a model along states (T, S) of one recording."""
    layout = fitted.layout
    assembled, stretches = fitted.model.assembled(layout.plain, layout.chain, number), layout.records[number].stretches
    signs = assembled.dynamics.mirror
    mirrored = np.concatenate([states, states * signs]) if np.any(signs < 0) else states
    t, states = np.tile(t, len(mirrored) // len(states)), mirrored
    mean, count = np.mean(states, axis=0), states.shape[1]
    step = np.maximum(np.std(states, axis=0), SMALLEST * float(np.sqrt(np.mean(states**2))) + 1e-300)

    def rate(t: ndarray, states: ndarray) -> ndarray:
        f = None if stretches.inputs is None else np.zeros((len(t), layout.chain.sites))
        driven = stretches.driven(t, layout.splines[number])
        return assembled.dynamics.linear(assembled.coefficients, t, states, f, driven, derivatives=False)[0]

    some = t[np.unique(np.linspace(0, len(t) - 1, MOST_TIMES).astype(int))]
    ends = np.concatenate([mean + np.diag(step), mean - np.diag(step)])
    local = rate(np.repeat(some, 2 * count), np.tile(ends, (len(some), 1))).reshape(len(some), 2, count, count)
    slopes = np.mean(local[:, 0] - local[:, 1], axis=0) / 2
    moved = (states - mean) / step
    forced = rate(t, states) - rate(t, np.broadcast_to(mean, states.shape)) - moved @ slopes
    forced -= np.mean(forced, axis=0)
    gram = moved.T @ moved / len(moved) + WHERE_IT_LEADS * np.eye(count)
    slopes = slopes + np.linalg.solve(gram, moved.T @ forced / len(moved))
    return np.asarray(slopes.T / step)
