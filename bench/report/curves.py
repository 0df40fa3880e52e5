"""The arrays that the pictures of a diagnosis show: its residual, the residual's spectrum, and its forecasts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.report.whereabouts import scaled_residuals, spectrum

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.repair import Diagnosis
    from latticebench.diagnosis.residual import Prediction


@dataclass(frozen=True, eq=False)
class ResidualCurve:
    """What an equation leaves of one trajectory.

    Attributes:
        t: times (T,).
        values: the residual of u or v in units of the noise, NaN where nothing was read (T, parts, N).
        omega, power: the spectrum over all readings, white noise having 1.
    """

    t: Float[ndarray, " time"]
    values: Float[ndarray, "time parts sites"]
    omega: Float[ndarray, " frequency"]
    power: Float[ndarray, " frequency"]


@dataclass(frozen=True, eq=False)
class WorstResidual:
    """The residual where it is largest: one trajectory, and of u and v the one that shows more.

    Attributes:
        reading: "u" or "v".
        trajectory, trajectories: its number (from 1), and how many there are.
        before, after: what the declared equation leaves, and what the one with the effects leaves, if there are any.
        limit: all but the few largest values of `before` are below it.
    """

    reading: str
    trajectory: int
    trajectories: int
    before: ResidualCurve
    after: ResidualCurve | None

    @property
    def limit(self) -> float:
        """The end of the scale that values are drawn on."""
        seen = np.abs(self.before.values[np.isfinite(self.before.values)])
        return max(3.0, float(np.quantile(seen, 0.995))) if len(seen) else 3.0


@dataclass(frozen=True, eq=False)
class WorstForecast:
    """The forecasts of the trajectory and site that the declared equation predicts worst.

    Attributes:
        trajectory, trajectories: its number (from 1), and how many there are.
        site: its number, from 1.
        before, after: by the declared equation, and by the one with the effects, if there are any.
        moving: the sites that have an equation.
        noise: standard deviation of each real part of u.
    """

    trajectory: int
    trajectories: int
    site: int
    before: Prediction
    after: Prediction | None
    moving: slice
    noise: float


@dataclass(frozen=True, eq=False)
class PictureCurves:
    """What is drawn of a diagnosis."""

    residual: WorstResidual
    forecast: WorstForecast


def curves(diagnosis: Diagnosis) -> PictureCurves:
    """Return what is drawn of a diagnosis."""
    return PictureCurves(_residuals(diagnosis), _forecasts(diagnosis))


def _residuals(diagnosis: Diagnosis) -> WorstResidual:
    course = diagnosis.course
    before = scaled_residuals(course.before, diagnosis)
    number = int(np.argmax([float(np.nanmean(values**2)) for _, values in before]))
    _, left = before[number]
    counts = np.sum(np.isfinite(left), axis=(0, 2, 3))
    level = int(np.argmax(np.sum(np.nan_to_num(left) ** 2, axis=(0, 2, 3)) / np.maximum(counts, 1)))

    def curve(t: ndarray, values: ndarray) -> ResidualCurve:
        omega, power, _ = spectrum(t, values)
        return ResidualCurve(t, values[:, level], omega, power)

    after = scaled_residuals(course.after, diagnosis)[number] if course.after.model.effects else None
    return WorstResidual(
        "uv"[level], number + 1, len(before), curve(*before[number]), None if after is None else curve(*after)
    )


def _forecasts(diagnosis: Diagnosis) -> WorstForecast:
    before, after = (_joined(side) for side in diagnosis.forecasts)
    moving = diagnosis.course.after.records[0].stretches.dynamics.moving
    # A forecast that ran away is the worst; a site that was not read cannot be.
    sizes = [np.nan_to_num(forecast_error(one, moving, (0, 1)), nan=-1.0, posinf=1e300) for one in before]
    number = int(np.argmax([np.max(size) for size in sizes]))
    first = range(before[number].seen.shape[-1])[moving][0]
    return WorstForecast(
        number + 1, len(before), first + int(np.argmax(sizes[number])) + 1, before[number],
        after[number] if diagnosis.course.after.model.effects else None, moving, float(diagnosis.noise[0]),
    )  # fmt: skip


def _joined(forecasts: Sequence[Prediction]) -> list[Prediction]:
    """Return the forecasts of trajectories, whose pieces are put together with gaps between them."""
    found: list[Prediction] = []
    for one in forecasts:
        if not found or one.t[0] <= found[-1].t[-1]:
            found.append(one)
            continue
        last = found[-1]
        gap = np.full_like(last.seen[:1], np.nan)
        found[-1] = replace(
            last,
            t=np.concatenate([last.t, [(last.t[-1] + one.t[0]) / 2], one.t]),
            seen=np.concatenate([last.seen, gap, one.seen]),
            predicted=np.concatenate([last.predicted, gap, one.predicted]),
        )
    return found


def forecast_error(one: Prediction, moving: slice, axis: tuple[int, int]) -> np.ndarray:
    """Return the RMS of a forecast's error at the sites that have an equation; NaN where nothing was read."""
    seen = np.isfinite(one.seen[..., moving])
    with np.errstate(all="ignore"):
        wrong = np.square(one.seen - one.predicted)[..., moving]
        return np.asarray(np.sqrt(np.sum(np.where(seen, wrong, 0.0), axis=axis) / np.sum(seen, axis=axis)))
