"""Forecasts of readings that were not fitted."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acceleration import with_rates
from latticebench.diagnosis.fitting import Fitted, fit
from latticebench.diagnosis.horizon import Layout
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.past import past_of, with_known, with_unread
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.reading import read_by
from latticebench.methods.engine.dynamics import split_parts
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# The share of a recording that forecasts are judged on, and its rows, at most.
HELD_OUT, MOST_ROWS = 0.3, 1500
FEWEST_ROWS = 12
STEPS = 8


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


def pooled(forecasts: Sequence[Prediction]) -> float:
    """Return the root mean square error of forecasts over that of the readings; infinite where one runs away."""
    left, size = 0.0, 0.0
    for one in forecasts:
        with np.errstate(all="ignore"):
            there = np.isfinite(one.seen)
            wrong = np.where(there, np.nan_to_num(one.predicted, nan=np.inf) - np.where(there, one.seen, 0.0), 0.0)
            left += float(np.sum(wrong**2)) if np.all(np.isfinite(wrong)) else np.inf
        size += float(np.nansum(one.seen**2))
    return float(np.sqrt(left / size)) if size > 0 else float("nan")


def by_noise(forecasts: Sequence[Prediction], noise: Float[ndarray, " sensors"]) -> float:
    """Return the error that forecasts would have if only the noise of the readings were left, as a share of these.

    How far zeros wander is not counted, and sensors without a known noise are left out. Dimensionless; NaN where
    nothing was read.

    Args:
        forecasts: of the held-out data.
        noise: standard deviation of each sensor, those of u first.
    """
    left, size = 0.0, 0.0
    for one in forecasts:
        variance = noise[: one.seen.shape[-1]] ** 2
        known = np.where(np.isfinite(variance), one.seen, np.nan)
        left += float(np.nansum(np.sum(np.isfinite(known), axis=(0, 1)) * variance))
        size += float(np.nansum(known**2))
    return float(np.sqrt(left / size)) if size > 0 else float("nan")


def ahead(one: Sequence[Prediction], other: Sequence[Prediction], noise: Float[ndarray, " sensors"]) -> float:
    """Return by how many nats one model forecasts better than another.

    It is minus infinity where the first runs away, else infinity where the second does.

    Args:
        one: the first model's forecasts.
        other: the second's, of the same readings.
        noise: standard deviation of each sensor, those of u first; what is left is taken for white noise of this size.
    """
    if not np.isfinite(pooled(one)):
        return -np.inf
    if not np.isfinite(pooled(other)):
        return np.inf
    found = 0.0
    for mine, its in zip(one, other, strict=True):
        more = (its.predicted - its.seen) ** 2 - (mine.predicted - mine.seen) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            found += float(np.nansum(more / noise[: mine.seen.shape[-1]] ** 2)) / 2
    return found


def predict(fitted: Fitted, problem: Problem, held_out: Sequence[Samples] = ()) -> list[Prediction]:
    """Return forecasts.

    Without other recordings the numbers are fitted again to the first 70 % of each, the model's effects being those of
    `fitted`, and the rest is predicted. Of other recordings only the initial state is fitted, to their first 30 %.

    Args:
        fitted: the model.
        problem: the recordings that it was fitted to.
        held_out: other recordings.
    """
    if held_out:
        other = Problem.of(problem.declared, problem.order, held_out, ()).interpolated(problem.degree)
        share, steps = HELD_OUT, 0
        model = fitted.model.of_others(len(problem.data))
    else:
        other, share, steps = problem, 1 - HELD_OUT, STEPS
        model = _foreseeable(fitted.model, _ends(problem))
    other = replace(other, plain=replace(other.plain, rest=fitted.layout.plain.rest))
    early = other.first(share)
    layout = Layout.of(early, max(len(one.t) for one in early.data), None, fitted.layout.small, fitted.layout.memory)
    shorter = not held_out or len(other.plain.border)
    if shorter and fitted.longest < max(len(one.t) for one in problem.data):
        layout = Layout.of(early, fitted.longest, None, fitted.layout.small, fitted.layout.memory)
    near = [nodes[rows] for nodes, rows in zip(early.nodes, layout.rows, strict=True)]
    if not held_out:
        near = _from(fitted, layout, problem)
    model = model.with_past(past_of(early, layout, model, near))
    near = list(with_unread(early, layout, model, near))
    layout = layout.with_substeps(model, near, other.top)
    again, noise, most = None, fitted.noise, max(steps, STEPS)
    # A model may be followed by all readings and run away by the early ones.
    with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError):
        again = fit(model, layout, near, structure=noise.structure, noise=noise, steps=most)
    if again is None:
        return [_lost(record.times[len(part.times) :], samples) for record, part, samples in
                zip(other.records, early.records, other.data, strict=True)]  # fmt: skip
    model = again.model if not held_out else model
    return [_follow(model, again, other, number) for number in range(len(other.records))]


def unforeseen(model: Model, problem: Problem) -> float:
    """Return the time of the first thing that happens in a model after the early readings; infinity for none.

    What comes later can be foreseen neither by this model nor by one that lacks what happens.
    """
    later = (one.begins for one in model.effects if one.begins > _ends(problem))
    return min(later, default=np.inf)


def up_to(forecasts: Sequence[Prediction], time: float) -> list[Prediction]:
    """Return forecasts up to a time; all of each where nothing would be left of it."""
    found = []
    for one in forecasts:
        rows = one.t < time
        if np.any(rows) and not np.all(rows):
            part = Prediction(one.t[rows], one.seen[rows], one.predicted[rows], 0.0)
            one = replace(part, error=pooled([part]))
        found.append(one)
    return found


def _ends(problem: Problem) -> float:
    """Return the last time of all early readings."""
    return max(float(one.t[round(len(one.t) * (1 - HELD_OUT))]) for one in problem.data)


def _foreseeable(model: Model, end: float) -> Model:
    """Return a model without what happens after the early readings, such as a pulse: they do not tell its strength."""
    return replace(model, effects=tuple(one for one in model.effects if one.begins <= end))


def _from(fitted: Fitted, layout: Layout, problem: Problem) -> list[ndarray]:
    """Return the states of a fit at the early rows, with those of what is not read: it may swing by itself."""
    found = []
    for number, rows in enumerate(layout.rows):
        nodes = np.array(problem.nodes[number])
        old, valid = fitted.layout.rows[number], fitted.layout.valid[number]
        nodes[old[valid]] = fitted.followed.nodes[number][valid][:, : layout.plain.read]
        found.append(with_known(fitted, number, nodes)[rows])
    return found


def _lost(t: ndarray, samples: Samples) -> Prediction:
    seen = split_parts(samples.u[len(samples.t) - len(t) :], samples.is_complex)
    return Prediction(t, seen, np.full_like(seen, np.inf), float("inf"))


def _follow(model: Model, again: Fitted, problem: Problem, number: int) -> Prediction:
    """Return the forecast of the rest of one recording from where the early fit ends."""
    record, samples = problem.records[number], problem.data[number]
    rows, nodes = again.layout.rows[number], again.followed.nodes[number]
    cut = int(np.max(rows)) + 1
    late = record.times[cut : cut + MOST_ROWS]
    # A piece that is shorter than others has its last row again and again.
    last = again.layout.valid[number][-1]
    past = _Past(record.times[rows[-1][last]], nodes[-1][last], problem)
    model = model.with_past((past,))
    assembled = model.assembled(problem.plain, problem.chain, number)
    state, found = nodes[-1, -1], []
    times = np.concatenate([[record.times[cut - 1]], late])
    stretches = replace(record.stretches, dynamics=assembled.dynamics, held=True)
    dense = 2 * max(1, int(np.median(again.layout.substeps[number])))
    with np.errstate(all="ignore"):
        for begin, end in itertools.pairwise(times):
            one = replace(stretches, begin=np.array([begin]), end=np.array([end]))
            substeps = np.full(1, np.ceil(dense * max(1.0, (end - begin) / problem.step)), dtype=int)
            state = one.run(assembled.coefficients, state[None], substeps, problem.splines[number])[0]
            found.append(state)
            past.learn(float(end), state)
        whole = problem.plain.whole(np.stack(found), record.stretches.driven(late, problem.splines[number]))
        instruments = [placed for placed, _ in model.instruments(number)]
        predicted = whole[:, 0] + read_by(instruments, late, with_rates(late[None], whole)).added[:, 0]
        # Nothing is likelier of a zero that wanders than that it stays where it is.
        predicted += again.zeros(number)[0]
        seen = split_parts(samples.u[cut : cut + MOST_ROWS], samples.is_complex)
        seen[..., problem.plain.border] = np.nan
        forecast = Prediction(late, seen, predicted, 0.0)
    return replace(forecast, error=pooled([forecast]))


class _Past:
    """The field at earlier times of a motion that is still being followed."""

    def __init__(self, times: ndarray, nodes: ndarray, problem: Problem) -> None:
        self.times, self.nodes, self.problem = list(times), list(nodes), problem

    def learn(self, t: float, state: ndarray) -> None:
        """Add a state."""
        self.times.append(t)
        self.nodes.append(state)

    def __call__(self, t: ndarray) -> ndarray:
        """Return u at times (B,) that have been: (parts, B, N)."""
        times = np.array(self.times)
        first = max(0, int(np.searchsorted(times, np.min(t))) - 4)
        field = self.problem.plain.whole(np.stack(self.nodes[first:]), None)[:, 0]
        from scipy.interpolate import CubicSpline

        curve = CubicSpline(times[first:], field)
        return np.moveaxis(np.asarray(curve(np.clip(t, times[first], times[-1]))), 0, 1)
