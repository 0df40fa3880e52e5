"""The arrays that the pictures of a diagnosis show: its residual, the residual's spectrum, and its forecasts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.report.whereabouts import scaled_residuals, spectrum

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.forecast import Prediction
    from latticebench.diagnosis.repair import Diagnosis


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
        moving: the sites that have an equation, from 0.
        noise: standard deviation of each real part of u at these sites.
    """

    trajectory: int
    trajectories: int
    site: int
    before: Prediction
    after: Prediction | None
    moving: tuple[int, ...]
    noise: Float[ndarray, " sites"]


@dataclass(frozen=True, eq=False)
class PictureCurves:
    """What is drawn of a diagnosis."""

    residual: WorstResidual
    forecast: WorstForecast


def curves(diagnosis: Diagnosis) -> PictureCurves:
    """Return what is drawn of a diagnosis."""
    return PictureCurves(_residuals(diagnosis), _forecasts(diagnosis))


def _residuals(diagnosis: Diagnosis) -> WorstResidual:
    before = scaled_residuals(diagnosis.before, diagnosis)
    number = int(np.argmax([np.nansum(values**2) / max(np.sum(np.isfinite(values)), 1) for _, values in before]))
    _, left = before[number]
    counts = np.sum(np.isfinite(left), axis=(0, 2, 3))
    level = int(np.argmax(np.sum(np.nan_to_num(left) ** 2, axis=(0, 2, 3)) / np.maximum(counts, 1)))

    def curve(t: ndarray, values: ndarray) -> ResidualCurve:
        omega, power, _ = spectrum(t, values)
        return ResidualCurve(t, values[:, level], omega, power)

    after = scaled_residuals(diagnosis.after, diagnosis)[number] if diagnosis.findings else None
    return WorstResidual(
        "uv"[level], number + 1, len(before), curve(*before[number]), None if after is None else curve(*after)
    )


def _forecasts(diagnosis: Diagnosis) -> WorstForecast:
    before, after = diagnosis.forecasts
    moving = diagnosis.after.chain.moving
    # A forecast that ran away is the worst; a site that was not read cannot be.
    sizes = [np.nan_to_num(forecast_error(one, moving, (0, 1)), nan=-1.0, posinf=1e300) for one in before]
    number = int(np.argmax([np.max(size) for size in sizes]))
    return WorstForecast(
        number + 1, len(before), moving[int(np.argmax(sizes[number]))] + 1, before[number],
        after[number] if diagnosis.findings else None, moving, np.asarray(diagnosis.noise)[list(moving)],
    )  # fmt: skip


def forecast_error(
    one: Prediction, moving: tuple[int, ...], axis: tuple[int, int], unit: Float[ndarray, " sites"] | float = 1.0
) -> np.ndarray:
    """Return the RMS of a forecast's error at the sites that have an equation; NaN where nothing was read.

    Args:
        one: the forecast.
        moving: the sites, from 0.
        axis: what the mean is over, of time, parts and sites.
        unit: of the error at each of the sites.
    """
    sites = list(moving)
    seen = np.isfinite(one.seen[..., sites])
    with np.errstate(all="ignore"):
        wrong = np.square((one.seen - one.predicted)[..., sites] / unit)
        return np.asarray(np.sqrt(np.sum(np.where(seen, wrong, 0.0), axis=axis) / np.sum(seen, axis=axis)))
