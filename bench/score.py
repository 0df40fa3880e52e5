"""Scores of a fit against the truth.

With xi* the true and xi the found coefficients over the library:

    E2       |xi - xi*| / |xi*|
    Einf     max over the true terms |xi_j - xi*_j| / |xi*_j|
    spurious max |xi_j| over the absent terms (in units of the derivative over those of the term)
    support  TPR = TP / (TP + FP + FN); a term is found when its share |xi_j| RMS(T_j), on the noise-free samples, is
             nearer to that of the least true term than to 0: one cutoff for every method, which follows from the
             equation and is no method's own threshold
    forecast relative L2 error of a simulation from an initial state that no method saw, and the time until it exceeds
             0.1
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.motion import Motion
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import follow
from latticebench.systems.terms import combination

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

# Of the least true share: half way to 0.
PRESENT = 0.5
LOST = 0.1
FORECAST_TOLERANCE = 1e-9
MAX_EVALUATIONS = 200_000


@dataclass(frozen=True)
class Score:
    """Errors of the coefficients; dimensionless but for `spurious`."""

    e2: float
    einf: float
    spurious: float
    tpr: float

    @property
    def exact(self) -> bool:
        """Whether the support is right."""
        return self.tpr == 1.0


def score(found: Float[ndarray, " terms"], truth: Float[ndarray, " terms"], shares: Float[ndarray, " terms"]) -> Score:
    """Score coefficients.

    Args:
        found: xi.
        truth: xi*, with at least one true term.
        shares: RMS(T_j) over the RMS of the derivative, on the noise-free samples.
    """
    true = truth != 0
    present = support(found, truth, shares)
    hits, false, missed = np.sum(present & true), np.sum(present & ~true), np.sum(~present & true)
    return Score(
        e2=float(np.linalg.norm(found - truth) / np.linalg.norm(truth)),
        einf=float(np.max(np.abs(found - truth)[true] / np.abs(truth)[true])),
        spurious=float(np.max(np.abs(found[~true]), initial=0.0)),
        tpr=float(hits / (hits + false + missed)),
    )


def support(
    found: Float[ndarray, " terms"], truth: Float[ndarray, " terms"], shares: Float[ndarray, " terms"]
) -> Bool[ndarray, " terms"]:
    """Return which terms count as found; the arguments are those of `score`."""
    least = np.min((np.abs(truth) * shares)[truth != 0])
    present: ndarray = np.abs(found) * shares >= PRESENT * least
    return present


@dataclass(frozen=True)
class Forecast:
    """How far a found equation foretells a motion that no method saw.

    Attributes:
        error: |u - u*| / |u*| over all sites and times; inf where the simulation breaks off.
        horizon: the last time before the error at one time exceeds LOST times the RMS size of u*, in units of time.
    """

    error: float
    horizon: float


def forecast(
    found: Float[ndarray, " terms"], library: Library, true: Motion, start: Float[ndarray, " state"], exact: Samples
) -> Forecast:
    """Simulate the found equation and compare.

    Args:
        found: xi.
        library: its terms.
        true: the true motion, for its chain; the found one gets the same ends.
        start: the unseen initial state.
        exact: the true trajectory from there.
    """
    chain = replace(true, term=combination(library.terms, [float(value) for value in found]))
    scale = np.sqrt(np.mean(np.abs(exact.u) ** 2))
    try:
        states, reached = follow(chain, start, exact.t, FORECAST_TOLERANCE, MAX_EVALUATIONS)
    except InputError:
        return Forecast(float("inf"), 0.0)
    u, _ = chain.unpack(states)
    off = np.sqrt(np.mean(np.abs(u - exact.u[:reached]) ** 2, axis=1)) / scale
    lost = np.flatnonzero(off > LOST)
    last = lost[0] - 1 if len(lost) else reached - 1
    whole = reached == len(exact.t)
    error = np.linalg.norm(u - exact.u[:reached]) / np.linalg.norm(exact.u) if whole else np.inf
    return Forecast(float(error), float(exact.t[max(last, 0)] - exact.t[0]))
