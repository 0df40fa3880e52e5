"""What a model is worth: its cost, the price of what it has, and what it misfits."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.glance import crowding
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.score import Tangent
from latticebench.methods.engine.resonator import Resonator

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

COUPLING = "u[n+1]+u[n-1]-2*u[n]"
# Models whose costs and readings differ by less (nats; share of the noise) are one model said in two ways.
SAME_COST, SAME_READING = 0.3, 0.05
# A size of u that does not matter: a share of the readings at first, then of the noise, but at least the last share of
# the readings. Of thousands of readings without noise the integrator's errors would otherwise look like forces.
SMALL_SHARE, SMALL_NOISE, SMALLEST = 1e-3, 0.1, 1e-8


def over(problem: Problem, fitted: Fitted) -> Float[ndarray, " sensors"]:
    """Return how many times the noise that its readings show a model leaves at each sensor; NaN where none is known."""
    known = problem.noise > 0
    return np.where(known, fitted.rms / np.where(known, problem.noise, 1.0), np.nan)


def beyond(problem: Problem, fitted: Fitted) -> float:
    """Return how many times the noise that the readings show a model leaves, at the sensor where that is most."""
    return float(np.nanmax(over(problem, fitted), initial=0.0))


def fine(problem: Problem, fitted: Fitted | None = None) -> float:
    """Return a size of u that does not matter beside the noise of the best sensor where the signal is least.

    Before anything is fitted it is a share of the readings.
    """
    if fitted is None:
        return SMALL_SHARE * problem.height
    least = min(float(np.nanmin(fitted.rms)), float(np.nanmin(fitted.noise.deviation())))
    return max(SMALL_NOISE * least, SMALLEST * problem.height)


def lost(problem: Problem, fitted: Fitted) -> bool:
    """Return whether a model leaves a part of the motion: much more than the readings' own noise, and not a hundredth.

    Of correlated noise, and of outliers, readings alone show only a part.
    """
    of_u = float(np.sqrt(np.nanmean(fitted.rms[: problem.chain.sites] ** 2)))
    large = beyond(problem, fitted) > rules.LOST and of_u > rules.FOLLOWED * problem.height
    return large and fitted.has_lines()


def surprises(problem: Problem, fitted: Fitted, ahead: Sequence[Fitted]) -> bool:
    """Return whether a model follows what was looked at, but is not among those that follow more on longer pieces."""
    more = fitted.layout.readings() < ahead[0].layout.readings()
    same = (one for one in ahead if one.model.key == fitted.model.key)
    return more and beyond(problem, fitted) < rules.LOST <= min((beyond(problem, one) for one in same), default=np.inf)


def misfits(problem: Problem, fitted: Fitted, *, anywhere: bool = False) -> bool:
    """Return whether even what is new from one reading to the next swings, and is far beyond noise.

    Args:
        problem: the recordings.
        fitted: the model.
        anywhere: whether it is enough that it is so at one sensor; else it is at all that have noise.
    """
    known = problem.noise > 0
    large = fitted.noise.fresh(problem.step)[known] > rules.LOST * problem.noise[known]
    return bool(np.any(large) and (anywhere or np.all(large))) and fitted.has_lines()


def repelling(problem: Problem, model: Model) -> float:
    """Return what a chain costs whose neighbours push each other away: a sensor that looks from the other side."""
    if problem.chain.is_complex or model.order != 2 or problem.chain.sites == 1:
        return 0.0
    pairs = zip(model.declared.texts, model.coefficients, strict=True)
    return rules.REPELLING if any(text == COUPLING and value < 0 for text, value in pairs) else 0.0


@functools.lru_cache(maxsize=64)
def displaced(fitted: Fitted) -> float:
    """Return the nats that a motion costs which is farther from its zero than its readings are from theirs.

    It is ln(1 + d^2), with d the difference between the two distances of the mean from zero, as root mean squares over
    the sites and beside the swing of the motion. What a sensor reads counts in units of the motion there, and swings
    that are less than the noise count as the noise.
    """
    curves, moving = fitted.curves(), list(fitted.chain.moving)
    read = np.concatenate([one.level[:, 0][..., moving] for one in curves])
    there = np.concatenate([one.field[:, 0][..., moving] for one in curves])
    noise = fitted.noise.deviation()[: fitted.chain.sites][moving]
    swings = [np.sqrt(np.nanvar(one, axis=0) + noise**2) for one in (there, read)]
    means = np.nanmean(there, axis=0), np.nanmean(read, axis=0) * swings[0] / swings[1]
    size = float(np.mean(swings[0] ** 2))
    distances = [float(np.sqrt(np.mean(one**2) / size)) if size > 0 else 0.0 for one in means]
    return rules.DISPLACED * float(np.log1p(max(distances[0] - distances[1], 0.0) ** 2))


@functools.lru_cache(maxsize=64)
def pushed(fitted: Fitted) -> float:
    """Return the nats that forces with a frequency or a time of their own cost which push harder than all else.

    Each costs ln(1 + d^2), with d its root mean square beside that of all terms that are no such forces, at the sites
    where it acts.
    """
    effects, hanging = fitted.model.effects, fitted.model.hanging(fitted.chain)
    own = [one for one in effects if one.timed and not one.instrument and one not in hanging]
    if not own:
        return 0.0
    plain = replace(fitted.model, effects=tuple(one for one in effects if one not in own))
    rest, found = _rates(fitted, plain), 0.0
    for one in own:
        push = _rates(fitted, plain.with_effect(one)) - rest
        acts = np.any(push != 0, axis=0)
        size = float(np.sum(rest[:, acts] ** 2))
        # A force on what nothing else moves is as likely as one that is as strong as all else.
        found += float(np.log1p(np.sum(push[:, acts] ** 2) / size if size > 0 else 1.0))
    return rules.PUSHED * found


@functools.lru_cache(maxsize=64)
def swung(fitted: Fitted) -> float:
    """Return the nats that masses cost which are not read and swing farther than their sites.

    Each costs ln(1 + d^2), with d the root mean square of its motion beside that of its site. Of a mass that hardly
    weighs anything and may be anywhere, the force is any wave that dies out.
    """
    layout, model, found = fitted.layout, fitted.model, 0.0
    if not model.hanging(fitted.chain):
        return found
    pairs = zip(fitted.followed.nodes, layout.valid, strict=True)
    states = np.concatenate([nodes[valid] for nodes, valid in pairs])
    dynamics = model.assembled(layout.plain, layout.chain).dynamics
    for _, place, v in dynamics.beside:
        u = states[:, v - dynamics.count]
        found += float(np.log1p(np.sum(states[:, place] ** 2) / max(float(np.mean(u**2)) * len(u), 1e-300)))
    return rules.PUSHED * found


def unlikely(fitted: Fitted) -> float:
    """Return the nats that a model costs for how far its motion goes, read or not, and how hard its forces push."""
    return displaced(fitted) + pushed(fitted) + swung(fitted)


def _rates(fitted: Fitted, model: Model) -> Float[ndarray, "rows channels"]:
    """Return the highest time derivatives that a model gives along a fitted motion, of all recordings."""
    layout, rates = fitted.layout, []
    for number, record in enumerate(layout.records):
        assembled = model.assembled(layout.plain, layout.chain, number)
        t = record.times[layout.rows[number]].ravel()
        states = fitted.followed.nodes[number].reshape(len(t), -1)
        inputs = None if record.stretches.inputs is None else record.stretches.inputs(t)
        driven = layout.driven(number, fitted.followed.splines[number])
        # What hangs beside sites hands a force at one of them on to others.
        dynamics = replace(assembled.dynamics, resonators=())
        rate = dynamics.linear(assembled.coefficients, t, states, inputs, driven, derivatives=False)[0]
        rate = rate[:, : layout.plain.read].reshape(len(t), layout.plain.order, -1)
        rates.append(rate[layout.valid[number].ravel(), -1])
    return np.concatenate(rates)


def wald(fitted: Fitted, number: int) -> float:
    """Return the nats that an effect brings as far as the model is linear: half of Wald's statistic.

    What has no strengths is beyond all doubt.
    """
    strength = np.array(fitted.model.effects[number].strength)
    begin = fitted.model.blocks[number].start
    kept = slice(begin, begin + len(strength))
    if not len(strength):
        return float("inf")
    return float(strength @ np.linalg.pinv(fitted.covariance[kept, kept]) @ strength) / 2


def same(one: Fitted, other: Fitted) -> bool:
    """Return whether two fits say the same of the readings."""
    levels = one.followed.level, other.followed.level
    if abs(one.cost - other.cost) > SAME_COST or levels[0].shape != levels[1].shape:
        return False
    size = other.noise.deviation()[other.rows.sensor]
    return float(np.sqrt(np.nanmean(((levels[0] - levels[1]) / size) ** 2))) < SAME_READING


@functools.lru_cache(maxsize=64)
def crowdings(problem: Problem, fitted: Fitted) -> tuple[float, ...]:
    """Return for each effect how many times as many nats as noise lets them others beside it still win."""
    if not any(one.timed for one in fitted.model.effects):
        return (1.0,) * len(fitted.model.effects)
    tangent = Tangent(fitted)
    return tuple(crowding(tangent, one, problem.candidates) for one in fitted.model.effects)


@dataclass(frozen=True, eq=False)
class Worth:
    """What models are worth beside the best of them, whose misfit says how much evidence counts.

    Attributes:
        problem: the recordings.
        best: the fit of least cost; none of a search that has not begun.
    """

    problem: Problem
    best: Fitted | None = None

    @functools.cached_property
    def least(self) -> tuple[float, float]:
        """Nats that an effect must bring at least, and an influence with a frequency or a time of its own."""
        if self.best is None or not misfits(self.problem, self.best):
            return 0.0, 0.0
        readings = self.best.layout.readings() / self.best.dispersion
        return -float(np.log1p(-rules.SHARE)) * readings, -float(np.log1p(-rules.SHARE_TIMED)) * readings

    def price_of(self, placed: Placed) -> float:
        """Return the nats that an effect must bring; where it begins on each piece wins a nat for two numbers, too."""
        free = 0.0
        if self.best is not None and placed.resonator(self.problem.chain) is not None:
            free = Resonator.size / 2 * self.best.pieces
        return max(self.problem.price_of(placed) + free, self.least[placed.timed])

    def price(self, fitted: Fitted) -> float:
        """Return the price of a model: of its effects and of the noise's parameters."""
        noise = fitted.noise.parameters / 2 * np.log(max(fitted.layout.readings(), 2))
        effects = zip(fitted.model.effects, crowdings(self.problem, fitted), strict=True)
        misfit = 1.0 if self.best is None else self.best.dispersion
        prices = sum(self.price_of(one) * max(1.0, many / misfit) for one, many in effects)
        return prices + float(noise) + repelling(self.problem, fitted.model) + unlikely(fitted)

    def value(self, fitted: Fitted) -> float:
        """Return the cost of a fit, as much less as the best one misfits, and its price, in nats."""
        return fitted.cost / (1.0 if self.best is None else self.best.dispersion) + self.price(fitted)

    def better(self, found: Fitted, fitted: Fitted) -> bool:
        """Return whether one model is better than another."""
        return self.value(found) < self.value(fitted)
