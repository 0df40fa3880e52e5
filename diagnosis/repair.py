"""The diagnosis of recordings: the search for what an equation lacks, and the errors before and after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from latticebench.diagnosis.contest import Watcher
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.residual import (
    Prediction,
    alike,
    dynamics_share,
    noise_of_fit,
    pooled,
    predict,
    residual_rms,
)
from latticebench.diagnosis.search import Course, search
from latticebench.methods.method import check_fit
from latticebench.systems.effects import Effect
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples, SimulatedSamples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What the search found, and the errors before and after it.

    Attributes:
        course: how the search went.
        noise: standard deviation of the noise on u and, where it was observed, v; of each part of a complex field.
        residual: RMS of what the fits leave of the readings, in units of the noise, before and after.
        dynamics: RMS of what the equation leaves of the derivative over that of the derivative, before and after.
        forecasts: of the held-out data, before and after; one per trajectory.
        criterion: the Bayesian information criterion, before and after, less a common constant.
        declared: coefficients of the declared terms, before and after, both fitted to the same pieces.
        used: number of sample times that the search used, and number of those recorded.
        truth: the true coefficients of the declared terms, or None where they are not known (see `against`).
    """

    course: Course
    noise: Float[ndarray, " levels"]
    residual: tuple[float, float]
    dynamics: tuple[float, float]
    forecasts: tuple[list[Prediction], list[Prediction]]
    criterion: tuple[float, float]
    declared: tuple[Float[ndarray, " terms"], Float[ndarray, " terms"]]
    used: tuple[int, int] = (0, 0)
    truth: Float[ndarray, " terms"] | None = None

    def against(self, truth: Float[ndarray, " terms"] | None) -> Diagnosis:
        """Return the same diagnosis with the true coefficients of the declared terms, which `coefficients` needs."""
        return replace(self, truth=truth)

    @property
    def forecast(self) -> tuple[float, float]:
        """Root mean square error of the forecasts over that of the readings, before and after."""
        return pooled(self.forecasts[0]), pooled(self.forecasts[1])

    @property
    def coefficients(self) -> tuple[float, float] | None:
        """Relative error of the declared coefficients, |xi - xi*| / |xi*|, before and after; None without a truth."""
        if self.truth is None:
            return None
        size = np.linalg.norm(self.truth)
        before, after = (float(np.linalg.norm(one - self.truth) / size) for one in self.declared)
        return before, after


def diagnose(
    declared: Library,
    order: int,
    data: Sequence[Samples],
    catalogue: Sequence[Effect],
    seed: int = 1,
    *,
    held_out: Sequence[Samples] = (),
    watcher: Watcher = lambda _: None,
    start: Float[ndarray, " terms"] | None = None,
) -> Diagnosis:
    """Find what a declared equation lacks of recordings.

    Args:
        declared: terms of the equation that is believed, their coefficients free.
        order: of the time derivative.
        data: recordings; the truth of simulated ones is not used.
        catalogue: effects that may be missing.
        seed: of the surrogates.
        held_out: recordings to judge forecasts on; the last 30 % of each of `data` when there are none.
        watcher: called with a text that says what is being done.
        start: coefficients of the declared equation to start from, where another method has fitted them.

    Raises:
        InputError: the equation cannot be set up on the data.
    """
    shown = [one.observed() if isinstance(one, SimulatedSamples) else one for one in data]
    check_fit(shown, declared, order)
    for one in shown:
        if not np.nanmax(np.abs(one.u - np.nanmean(one.u))) > 0:
            raise InputError(f"{one.source}: nothing moves; a diagnosis needs a motion")
    # More threads than this are slower on matrices of these sizes.
    with threadpool_limits(1):
        course = search(
            Model(declared, order), shown, catalogue, np.random.default_rng(seed), watcher=watcher, start=start
        )
        watcher("forecasting")
        return _with_errors(course, held_out, sum(len(one.t) for one in shown))


def _with_errors(course: Course, held_out: Sequence[Samples], recorded: int) -> Diagnosis:
    """Return the diagnosis with the errors before and after.

    Args:
        course: how the search went.
        held_out: recordings to judge forecasts on.
        recorded: number of sample times in the recordings.
    """
    sides = (course.before, alike(course.after, course.before))
    size = noise_of_fit(course.after)
    gain = sides[1].gain(sides[0])
    more = course.after.parameters - course.before.parameters
    count = len(course.before.model.declared.terms)
    before, after = (one.solution.state.coefficients[:count] for one in sides)
    return Diagnosis(
        course,
        size,
        residual=(residual_rms(course.before, size), residual_rms(course.after, size)),
        dynamics=(dynamics_share(course.before), dynamics_share(course.after)),
        # As far ahead as the last model can go, however soon the declared one loses the readings.
        forecasts=(predict(alike(course.before, course.after), held_out), predict(course.after, held_out)),
        criterion=(0.0, more * float(np.log(course.after.count)) - gain),
        declared=(before, after),
        used=(sum(len(one.t) for one in course.after.data), recorded),
    )
