"""How far a model is followed from one initial state, and which samples of a long record are looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.model import Fitted, Model, carried, cut, first_fit
from latticebench.diagnosis.polish import polish
from latticebench.diagnosis.residual import noise_of_readings, residual_rms
from latticebench.methods.engine.dynamics import split_parts
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# A residual of more than so many times the noise is gross: the model is then followed over shorter pieces.
GROSS = 3.0
MOST_PIECES = 64
LONGEST = 4000
MOST_SAMPLES = 16_000
# Thinning leaves at least so many samples.
ENOUGH = 2000


@dataclass(frozen=True, eq=False)
class Horizon:
    """How far the model is followed without a new start: as far as it can go without losing the readings.

    Attributes:
        data: the whole trajectories.
        noise: of the readings, estimated from them alone; NaN where that cannot be done.
        lengths: of pieces in samples, from whole trajectories down.
    """

    data: tuple[Samples, ...]
    noise: Float[ndarray, " levels"]
    lengths: tuple[int, ...]

    @classmethod
    def of(cls, data: Sequence[Samples], model: Model) -> Horizon:
        """Return the horizon of recordings: the lengths of pieces from which a model's parameters can be told."""
        longest = max(len(samples.t) for samples in data)
        if sum(len(samples.t) for samples in data) > MOST_SAMPLES:
            # Of a very long record evenly spaced parts are enough.
            parts = cut(data, LONGEST)
            data = [parts[k] for k in np.linspace(0, len(parts) - 1, MOST_SAMPLES // LONGEST).astype(int)]
            longest = LONGEST
        levels = 1 if model.order == 1 or data[0].v is None else 2
        least = max(4 * model.order // levels + 2, -(-sum(len(samples.t) for samples in data) // MOST_PIECES))
        lengths = [min(longest, LONGEST)]
        while lengths[-1] / 3 >= least:
            lengths.append(-(-lengths[-1] // 3))
        return cls(tuple(data), noise_of_readings(data, model.order, levels), tuple(lengths))

    def follows(self, fitted: Fitted) -> bool:
        """Return whether a model stays near the readings."""
        if not fitted.solution.converged:
            return False
        if not np.all(np.isfinite(self.noise)):
            return True
        return residual_rms(fitted, self.noise) < GROSS

    def sees_all(self, fitted: Fitted) -> bool:
        """Return whether a model follows the readings from end to end.

        Only then do small differences between terms mean something.
        """
        return self.follows(fitted) and max(len(samples.t) for samples in fitted.data) >= self.lengths[0]

    def first(self, model: Model, start: Float[ndarray, " terms"] | None = None) -> Fitted:
        """Return the fit to the longest pieces that a model can follow; to the shortest ones where it follows none."""
        for length in self.lengths:
            last = length == self.lengths[-1]
            fitted = first_fit(model, cut(self.data, length), steps=40 if last else 15, coefficients=start)
            if self.follows(fitted):
                break
        return fitted

    def lengthen(self, fitted: Fitted) -> Fitted:
        """Return the fit to the longest pieces that a model follows, from a fit to shorter ones."""
        present = max(len(samples.t) for samples in fitted.data)
        for length in reversed(self.lengths):
            if length <= present:
                continue
            pieces = cut(self.data, length)
            longer = polish(
                fitted.model,
                replace(fitted, data=tuple(pieces), solution=replace(fitted.solution, state=carried(fitted, pieces))),
            )
            if longer is None or not self.follows(longer):
                break
            fitted = longer
        return fitted


def thinned(samples: Samples, order: int) -> Samples:
    """Return samples without those that a cubic spline through the others gives to within the noise.

    Nothing is left out where an input was measured, too.
    """
    step = 1
    levels = 1 if order == 1 or samples.v is None else 2
    size = noise_of_readings([samples], order, levels)[0]
    while samples.f is None and np.isfinite(size) and len(samples.t) // (2 * step) >= ENOUGH:
        if _left_by_spline(samples, 2 * step) > 1.5 * size:
            break
        step *= 2
    if step == 1:
        return samples
    u, v = samples.u[::step], None if samples.v is None else samples.v[::step]
    return replace(samples, t=samples.t[::step], u=u, v=v)


def _left_by_spline(samples: Samples, step: int) -> float:
    """Return the RMS of what a cubic spline through every `step`-th sample leaves of the others, per real part."""
    from scipy.interpolate import CubicSpline

    left = []
    for part in np.moveaxis(split_parts(samples.u, samples.is_complex).reshape(len(samples.t), -1), 1, 0):
        seen = np.isfinite(part)
        t, value = samples.t[seen], part[seen]
        if len(t) < 4 * step:
            return float("inf")
        left.append(value - CubicSpline(t[::step], value[::step])(t))
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))
