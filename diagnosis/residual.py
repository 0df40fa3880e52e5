"""The residual of a fitted model, as two things, and the noise that it is measured against.

- Of the forecast: what a motion that follows the equation exactly, from the best starting state, leaves of the
  readings.
- Of the dynamics: what the equation leaves of the acceleration (order 2) or rate (order 1) along the state that the
  readings themselves suggest, a smoothing spline.

The noise is estimated from the readings alone, by a spline whose knots cross-validation chooses
(`methods.engine.spline_state`), and from what the last model leaves; the smaller of the two counts, since a spline that
cannot follow the field takes some of it for noise.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.model import ACCURACY, Fitted, carried, corrected, refit, rows_of, without
from latticebench.methods.engine.derivatives import differentiate
from latticebench.methods.engine.dynamics import split_parts
from latticebench.methods.engine.shooting import maximise, tolerances
from latticebench.methods.engine.spline_state import estimate_state
from latticebench.methods.engine.starts import guess
from latticebench.systems.effects import INSTRUMENT
from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# The share of a record that forecasts are judged on.
HELD_OUT = 0.3
# Samples of a long record that the noise is estimated from at a time.
GLANCE = 1000
# Forecasts of a record in many pieces, at most.
MOST_FORECASTS = 8
FEWEST_ROWS = 4
LONGEST_LAG = 200


def noise_of_fit(fitted: Fitted) -> Float[ndarray, " levels"]:
    """Return the standard deviation of the noise on u and, where observed, on v; per part of a complex field."""
    own = fitted.sigma * np.sqrt(dof_share(fitted))
    spline = noise_of_readings(fitted.data, fitted.model.order, len(own))
    return np.asarray(np.where(np.isfinite(spline), np.minimum(spline, own), own))


def noise_of_readings(data: Sequence[Samples], order: int, levels: int) -> Float[ndarray, " levels"]:
    """Estimate the noise on u (and v) from the readings alone; NaN where there are too few for a spline.

    Long records are looked at in a few places.
    """
    found = []
    for samples in data:
        for begin in np.linspace(0, max(len(samples.t) - GLANCE, 0), 4 if len(samples.t) > GLANCE else 1).astype(int):
            try:
                state = estimate_state(rows_of(samples, int(begin), int(begin) + GLANCE), order)
            except (InputError, ValueError, np.linalg.LinAlgError):
                continue
            found.append(np.array(state.noise[:levels]))
    if not found:
        return np.full(levels, np.nan)
    spline = np.sqrt(np.nanmean(np.stack(found) ** 2, axis=0))
    return np.where(spline > 0, spline, np.nan)


def dof_share(fitted: Fitted) -> float:
    """Return the factor of the noise's variance that the fit of the effects' parameters makes necessary."""
    spare = fitted.count - fitted.solution.parameters
    return float(max(spare, 1) / max(fitted.count - fitted.parameters, 1))


def residual_rms(fitted: Fitted, noise: Float[ndarray, " levels"]) -> float:
    """Return the RMS of what a fit leaves of the readings, in units of the noise: 1 when nothing is missing."""
    counts = fitted.solution.counts
    ratio = (fitted.sigma**2 * dof_share(fitted)) / noise**2
    return float(np.sqrt(np.sum(counts * ratio) / np.sum(counts)))


def correlation_time(fitted: Fitted) -> float:
    """Return the number of samples per independent number of the residual, at least 1.

    This is 1 + 2 sum of its autocorrelation up to the first zero: 1 for white noise. What a model that is far off
    leaves is correlated, and tells less than its count of numbers.
    """
    together: dict[int, float] = {}
    for left in fitted.residuals():
        series = left.reshape(len(left), -1)
        for lag in range(min(len(series), LONGEST_LAG)):
            together[lag] = together.get(lag, 0.0) + float(np.sum(series[lag:] * series[: len(series) - lag]))
    if not together.get(0, 0.0) > 0:
        return 1.0
    found = 1.0
    for lag in range(1, len(together)):
        if together[lag] <= 0:
            break
        found += 2 * together[lag] / together[0]
    return found


@dataclass(frozen=True, eq=False)
class DynamicsResidual:
    """What an equation leaves of the highest time derivative along smoothed readings.

    Attributes:
        t: times.
        left: derivative minus equation (T, parts, M), in units of the derivative.
        rate: the derivative (T, parts, M).
    """

    t: Float[ndarray, " time"]
    left: Float[ndarray, "time parts sites"]
    rate: Float[ndarray, "time parts sites"]


def of_dynamics(fitted: Fitted) -> list[DynamicsResidual]:
    """Return the residual of the dynamics of each trajectory."""
    found = []
    coefficients = fitted.solution.state.coefficients
    for record, samples in zip(fitted.records, fitted.data, strict=True):
        dynamics = record.stretches.dynamics
        parts = []
        for part in range(dynamics.parts):
            reading = np.where(record.seen[:, 0, part], record.value[:, 0, part], np.nan)
            parts.append(differentiate(samples.t, reading, "smoothing-spline"))
        u = np.stack([one.value for one in parts], axis=1)
        v = np.stack([one.first for one in parts], axis=1)
        if record.value.shape[1] > 1:
            readings = np.where(record.seen[:, 1], record.value[:, 1], np.nan)
            again = [differentiate(samples.t, readings[:, k], "smoothing-spline") for k in range(dynamics.parts)]
            v = np.stack([one.value for one in again], axis=1)
            rate = np.stack([one.first for one in again], axis=1)
        else:
            rate = v if dynamics.order == 1 else np.stack([one.second for one in parts], axis=1)
        whole = np.stack([u, v][: dynamics.order], axis=1)
        states = whole[..., dynamics.moving].reshape(len(samples.t), -1)
        f = samples.forcing()(samples.t) if record.stretches.inputs is not None else None
        driven = whole[..., dynamics.border] if len(dynamics.border) else None
        right = dynamics.linear(coefficients, samples.t, states, f, driven, derivatives=False)[0]
        right = right.reshape(len(samples.t), dynamics.order, dynamics.parts, dynamics.count)[:, -1]
        rate = rate[..., dynamics.moving]
        found.append(DynamicsResidual(samples.t, rate - right, rate))
    return found


def dynamics_share(fitted: Fitted) -> float:
    """Return the share of the derivative that the equation leaves: RMS over RMS, all trajectories together.

    NaN where they are too short to smooth.
    """
    try:
        every = of_dynamics(fitted)
    except InputError:
        return float("nan")
    left, rate = (
        sum(float(np.nansum(part**2)) for part in parts)
        for parts in zip(*((one.left, one.rate) for one in every), strict=True)
    )
    return float(np.sqrt(left / rate)) if rate > 0 else float("nan")


# The forecast of what was not fitted ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Prediction:
    """A motion predicted from a fitted state, beside what was observed.

    Attributes:
        t: times (T,).
        seen: readings of u (T, parts, N), NaN where missing.
        predicted: the same from the model, instrument included.
        error: RMS of the difference over the RMS of the readings, dimensionless.
    """

    t: Float[ndarray, " time"]
    seen: Float[ndarray, "time parts sites"]
    predicted: Float[ndarray, "time parts sites"]
    error: float


def predict(fitted: Fitted, held_out: Sequence[Samples] = ()) -> list[Prediction]:
    """Return forecasts of what was not fitted.

    Without other recordings the coefficients are fitted again to the first 70 % of each trajectory, the model being
    that of `fitted`, and the rest is predicted; a pulse that comes later cannot be foreseen and is left out. Of other
    recordings only the initial state is fitted, to their first 30 %.
    """
    if held_out:
        # How a chain ends is known as well as for the recordings that were fitted.
        return [_follow(fitted, samples, HELD_OUT, None) for samples in held_out if len(samples.t) >= FEWEST_ROWS]
    enough = [number for number, samples in enumerate(fitted.data) if len(samples.t) >= FEWEST_ROWS]
    chosen = (
        [enough[k] for k in np.unique(np.linspace(0, len(enough) - 1, MOST_FORECASTS).astype(int))] if enough else []
    )
    cuts = [max(2, round(len(samples.t) * (1 - HELD_OUT))) for samples in fitted.data]
    early = [rows_of(samples, 0, cut) for samples, cut in zip(fitted.data, cuts, strict=True)]
    fitted = _foreseeable(fitted, early)
    data = [fitted.data[k] for k in chosen]
    state = fitted.solution.state
    start = replace(state, nodes=tuple(nodes[:cut] for nodes, cut in zip(state.nodes, cuts, strict=True)))
    again = refit(fitted.model, early, start)
    return [
        _follow(again, samples, cuts[number] / len(samples.t), number)
        for number, samples in zip(chosen, data, strict=True)
    ]


def _foreseeable(fitted: Fitted, early: Sequence[Samples]) -> Fitted:
    """Return a fit without pulses whose middle the early samples do not show: nothing is known of their strength."""
    for number in reversed(range(len(fitted.model.effects))):
        placed = fitted.model.effects[number]
        if placed.effect.acts == "pulse" and not any(one.t[0] <= placed.psi["at"] <= one.t[-1] for one in early):
            fitted = without(fitted, number)
    return fitted


def pooled(forecasts: Sequence[Prediction]) -> float:
    """Return the root mean square error of forecasts over that of the readings; infinite where one runs away."""
    left, size = 0.0, 0.0
    for one in forecasts:
        with np.errstate(all="ignore"):
            left += float(np.nansum((one.seen - one.predicted) ** 2)) if np.all(np.isfinite(one.predicted)) else np.inf
        size += float(np.nansum(one.seen**2))
    return float(np.sqrt(left / size)) if size > 0 else float("nan")


def alike(fitted: Fitted, other: Fitted) -> Fitted:
    """Return a fit to the same pieces as another, so that both can be compared."""
    sizes = [len(samples.t) for samples in other.data]
    if [len(samples.t) for samples in fitted.data] == sizes:
        return fitted
    return refit(fitted.model, other.data, carried(fitted, other.data))


def _follow(fitted: Fitted, samples: Samples, known: float, number: int | None) -> Prediction:
    """Return the forecast of the rest of a record, from a state fitted to its first part."""
    cut = max(2, round(len(samples.t) * known))
    model, sigma = fitted.model, fitted.sigma
    coefficients = fitted.solution.state.coefficients
    if number is None:
        early = [rows_of(samples, 0, cut)]
        records = model.records(early)
        start = replace(guess(early, records), coefficients=coefficients)
        records = corrected(model, start, records)
        state = maximise(records, start, steps=20, tolerance=0.02, noise=sigma, held=True).state
        nodes = state.nodes[0]
    else:
        nodes = fitted.solution.state.nodes[number]
    past = _Past(samples, nodes, fitted)
    model = replace(model, effects=tuple(replace(one, past=(past,)) if one.past else one for one in model.effects))
    full = model.records([samples])[0]
    stretches, dynamics = full.stretches, full.stretches.dynamics
    # At unknown ends the border's own readings are the drive.
    splines = guess([samples], [full]).splines[0] if stretches.drive is not None else None
    states = [nodes[cut - 1]]
    accuracy = tolerances(full, sigma, ACCURACY * float(np.min(sigma)))
    for begin, end in itertools.pairwise(full.times[cut - 1 :]):
        one = replace(stretches, begin=np.array([begin]), end=np.array([end]))
        steps = one.substeps(coefficients, states[-1][None], accuracy, splines)
        states.append(one.run(coefficients, states[-1][None], steps, splines)[0])
        past.learn(end, states[-1])
    late = full.times[cut:]
    driven = stretches.driven(late, splines) if stretches.drive is not None else None
    field = dynamics.whole(np.stack(states[1:]), driven)[:, :1]
    predicted = field.copy()
    for placed in model.effects:
        # Which way a clock errs in rows to come cannot be known.
        if placed.effect.acts in INSTRUMENT and placed.effect.acts != "clock":
            predicted += placed.misreading(late, field, np.zeros_like(field))
    seen = split_parts(samples.u[cut:], samples.is_complex)
    moving = seen[..., dynamics.moving]
    with np.errstate(all="ignore"):
        left = moving - predicted[:, 0][..., dynamics.moving]
        error = float(np.sqrt(np.nanmean(left**2) / max(float(np.nanmean(moving**2)), 1e-300)))
    return Prediction(late, seen, predicted[:, 0], error if np.isfinite(error) else float("inf"))


class _Past:
    """The field at earlier times of a motion that is still being followed."""

    def __init__(self, samples: Samples, nodes: ndarray, fitted: Fitted) -> None:
        self.record = fitted.model.records([rows_of(samples, 0, len(nodes))])[0] if _remembers(fitted) else None
        self.times = list(samples.t[: len(nodes)])
        self.nodes = list(nodes)

    def learn(self, t: float, node: ndarray) -> None:
        """Add a state."""
        self.times.append(float(t))
        self.nodes.append(node)

    def __call__(self, t: ndarray) -> ndarray:
        assert self.record is not None
        from scipy.interpolate import CubicSpline

        field = self.record.stretches.dynamics.whole(np.stack(self.nodes), None)[:, 0]
        u = field[:, 0] + 1j * field[:, 1] if field.shape[1] > 1 else field[:, 0]
        return np.asarray(CubicSpline(self.times, u)(np.clip(t, self.times[0], self.times[-1])))


def _remembers(fitted: Fitted) -> bool:
    return any(placed.past for placed in fitted.model.effects)
