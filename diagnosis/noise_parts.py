"""Which parts of the noise model a fit on a horizon is given, and which of them may hide an effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.noise import Noise, Structure
from latticebench.diagnosis.noise_estimate import estimate
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.worth import beyond

# A misfit grows with the signal, too: noise is taken to do so only where no more than so many times the noise is left.
NEAR = 2.0
# On so few sensors each has a size and a correlation of its own whether or not that is plain.
FEW_SENSORS = 8


def shown(problem: Problem, fitted: Fitted) -> tuple[Structure, float]:
    """Return the parts that the readings show, which all models of a horizon share, and the mean correlation time.

    A white part beside a slow one is chosen for each model anew: short pieces do not show it.
    """
    followed = fitted.followed
    noise = estimate(followed.left, followed.swing, fitted.rows)
    found, few = noise.structure, len(fitted.rms) <= FEW_SENSORS
    growth, memory = found.growth and beyond(problem, fitted) < NEAR, found.memory or few
    structure = replace(found, growth=growth, own_sizes=found.own_sizes or few, memory=memory, white=memory)
    # Beside white noise, what is slow hardly matters to a curve.
    return structure, 0.0 if np.any(noise.white) else float(np.mean(noise.memory))


def hides(noise: Noise, step: float) -> bool:
    """Whether noise does the work of forces: it is correlated over more than a step, or common to all sensors."""
    slow = noise.memory * (1 - noise.white) if len(noise.white) else noise.memory
    return bool(np.max(slow) >= step) or noise.common is not None


def white(noise: Noise) -> Noise:
    """Return the noise without what may hide an effect."""
    return replace(noise, memory=0 * noise.memory, white=np.zeros(0), price=0.0, common=None)
