"""The diagnosis of recordings: what an equation lacks, and the errors before and after it."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from latticebench.diagnosis import modes, rules
from latticebench.diagnosis.exchanged import exchanged
from latticebench.diagnosis.finding import Compared, Finding, compared, findings
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.forecast import Prediction, ahead, by_noise, pooled, predict, unforeseen, up_to
from latticebench.diagnosis.held import Held, freed
from latticebench.diagnosis.inputs import in_words
from latticebench.diagnosis.instrument import dead_sensors, describe, without
from latticebench.diagnosis.modes import Mode
from latticebench.diagnosis.past import with_known
from latticebench.diagnosis.problem import Problem, derivative_share
from latticebench.diagnosis.progress import Found, Horizon
from latticebench.diagnosis.readout import unread
from latticebench.diagnosis.search import Search, Watcher
from latticebench.diagnosis.unnamed import Left, without_name
from latticebench.diagnosis.worth import Worth, lost, misfits
from latticebench.methods.engine.record import without_halves
from latticebench.methods.method import check_fit
from latticebench.systems.arrays import free_memory
from latticebench.systems.effects import Effect
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.options import option
from latticebench.systems.samples import Samples, SimulatedSamples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

One = TypeVar("One")
# Forecasts of a fit, up to what another one has happening later than the early readings.
Foreseen = Callable[[Fitted, Fitted], "list[Prediction]"]

# Why named effects may explain only a part.
SMALL, NAMELESS = "something small is left", "something without a name does better"
NOT_REACHED, NOT_FOLLOWED = "the readings are not reached", "the recording is followed in pieces only"
# Readings beyond twice the number of unknowns that a diagnosis needs.
SPARE = 10
# Bytes for each row and each pair of numbers of a state, at least: a fit has some two dozen derivatives by the start.
MOTIONS = 200
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What was found, and the errors before and after it.

    Attributes:
        before, after: the declared equation, and with all that was found.
        findings: the effects of the last model.
        verdict: "nothing missing", "explained", "partly explained" or "unexplained".
        whole: whether the last model follows whole recordings, or as much of them as unknown ends allow.
        horizons: how the search went.
        left: what is significant in the last residual without having a name, the best first.
        data: recordings as they were used.
        dead: sites whose sensors always read the same, which were not used.
        held: what was left out of recordings in which nothing moves at first or at last.
        exchanged: the order of the columns, from 0, in which the declared equation leaves much less; () where none is.
        used: sample times that were used, and those recorded but for the latter.
        noise: standard deviation of each sensor: u of site 1, ..., N, then v; NaN where nothing was read. It is what
            the last model leaves; where something is left in that, no more than the readings alone show.
        noise_lines: the noise of each sensor in words.
        residual: RMS of what is left over the noise, before and after.
        rms: the same in units of the readings.
        dynamics: share of the derivative, along smoothed readings, that the equation leaves, before and after.
        forecasts: of the held-out data, before and after; one per recording.
        criterion: the Bayesian information criterion less that of the declared equation, before and after.
        declared: coefficients of the declared terms, before and after.
        inputs: how measured inputs were taken to go on between their samples; "" where the equation has none.
        modes: of the recording, and of the model before and after.
        truth: the true coefficients of the declared terms, or None where they are not known (see `against`).
    """

    before: Fitted
    after: Fitted
    findings: tuple[Finding, ...]
    verdict: str
    whole: bool
    horizons: tuple[Horizon, ...]
    left: tuple[Left, ...]
    data: tuple[Samples, ...]
    used: tuple[int, int]
    noise: Float[ndarray, " sensors"]
    noise_lines: tuple[str, ...]
    residual: tuple[float, float]
    rms: tuple[float, float]
    dynamics: tuple[float, float]
    forecasts: tuple[list[Prediction], list[Prediction]]
    criterion: tuple[float, float]
    declared: tuple[Float[ndarray, " terms"], Float[ndarray, " terms"]]
    modes: tuple[tuple[Mode, ...], tuple[Mode, ...], tuple[Mode, ...]]
    inputs: str = ""
    dead: tuple[int, ...] = ()
    held: tuple[Held, ...] = ()
    exchanged: tuple[int, ...] = ()
    truth: Float[ndarray, " terms"] | None = None

    def against(self, truth: Float[ndarray, " terms"] | None) -> Diagnosis:
        """Return the same diagnosis with the true coefficients of the declared terms, which `coefficients` needs."""
        return replace(self, truth=truth)

    @property
    def forecast(self) -> tuple[float, float]:
        """Root mean square error of the forecasts over that of the readings, before and after."""
        return pooled(self.forecasts[0]), pooled(self.forecasts[1])

    @property
    def forecast_by_noise(self) -> float:
        """That error if only the noise of the held-out readings were left."""
        return by_noise(self.forecasts[1], self.noise)

    @property
    def coefficients(self) -> tuple[float, float] | None:
        """Relative error of the declared coefficients, |xi - xi*| / |xi*|, before and after; None without a truth."""
        if self.truth is None:
            return None
        size = np.linalg.norm(self.truth)
        before, after = (float(np.linalg.norm(one - self.truth) / size) for one in self.declared)
        return before, after


class Interrupted(Exception):
    """A diagnosis was interrupted; what is known so far is in `diagnosis`."""

    def __init__(self, diagnosis: Diagnosis) -> None:
        super().__init__("interrupted")
        self.diagnosis = diagnosis


def shortfalls(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return why what is named explains only a part, in the words above; nothing with another verdict."""
    if diagnosis.verdict != "partly explained":
        return ()
    rivals, reached = [bool(one.instead) for one in diagnosis.left], diagnosis.residual[1] <= rules.LOST
    found = {
        SMALL: reached and not all(rivals), NAMELESS: any(rivals), NOT_REACHED: not reached,
        NOT_FOLLOWED: not diagnosis.whole,
    }  # fmt: skip
    return tuple(words for words, holds in found.items() if holds)


def diagnose(
    declared: Library,
    order: int,
    data: Sequence[Samples],
    catalogue: Sequence[Effect],
    *,
    held_out: Sequence[Samples] = (),
    watcher: Watcher | None = None,
) -> Diagnosis:
    """Find what a declared equation lacks of recordings.

    Args:
        declared: terms of the equation that is believed, their coefficients free.
        order: of the time derivative.
        data: recordings; the truth of simulated ones is not used.
        catalogue: effects that may be missing.
        held_out: recordings to judge forecasts on; the last 30 % of each of `data` when there are none.
        watcher: called with a text that says what is being done.

    Raises:
        InputError: the equation cannot be set up on the data.
        Interrupted: the user stopped it (KeyboardInterrupt) when something was known already.
    """
    shown = [without_halves(one.observed() if isinstance(one, SimulatedSamples) else one) for one in data]
    check_fit(shown, declared, order)
    _check_motion(shown)
    # More threads than this are slower on matrices of these sizes.
    with threadpool_limits(1):
        problem, dead = _problem(declared, order, shown, catalogue)
        held_out = [freed(without_halves(without(one, dead)))[0] for one in held_out]
        search = Search(problem, functools.partial(_say, data[0].source, watcher))
        found = None

        # Models are forecast once, to be named and to be reported.
        @functools.cache
        def forecast(fitted: Fitted) -> list[Prediction]:
            return predict(fitted, search.problem, held_out)

        def foreseen(fitted: Fitted, beside: Fitted) -> list[Prediction]:
            return up_to(forecast(fitted), np.inf if held_out else unforeseen(beside.model, search.problem))

        recorded = sum(len(one.t) for one in shown) - sum(one.rows for one in problem.held)
        try:
            for step in search.horizons():
                # A model that loses the readings over longer pieces is judged by those that it can follow.
                if found is None or not lost(problem, step.models[0]) or lost(problem, found.models[0]):
                    found = step
            if found is None:
                raise InputError(f"{shown[0].source}: the declared equation cannot be followed even over a few samples")
            best = _named(search, found, foreseen)
            found = _decided(search, found, best.fitted)
            search.say("looking for what has no name")
            left = without_name(search, best.fitted)
        except KeyboardInterrupt:
            if found is None:
                raise
            plain = Compared(found.models[0], (np.nan,) * len(found.models[0].model.effects), _none_equal(found))
            raise Interrupted(_diagnosis(search.problem, found, plain, (), foreseen, recorded, dead)) from None
        search.say("forecasting")
        return _diagnosis(search.problem, found, best, left, foreseen, recorded, dead)


def _none_equal(found: Found) -> tuple[tuple[str, ...], ...]:
    return ((),) * len(found.models[0].model.effects)


def _say(source: str, watcher: Watcher | None, text: str) -> None:
    """Tell what is being done, to the log and to a watcher."""
    log.info("%s: %s", source, text)
    if watcher is not None:
        watcher(text)


def _problem(
    declared: Library, order: int, data: Sequence[Samples], catalogue: Sequence[Effect]
) -> tuple[Problem, tuple[int, ...]]:
    """Return the problem without the readings of sensors that do not work, and the sites of these.

    Columns that look exchanged are told to the log at once.

    Raises:
        InputError: there are too few readings, or there is too little memory.
    """
    problem = Problem.of(declared, order, data, catalogue)
    # Near an unknown end, what is read stands for what lies beyond: there, a site may be held.
    dead = tuple(site for site in dead_sensors(data) if site in problem.chain.moving)
    if dead:
        problem = Problem.of(declared, order, [without(one, dead) for one in data], catalogue)
    _check_outer(problem)
    _check_enough(problem)
    _check_room(problem)
    problem = replace(problem, exchanged=exchanged(problem))
    if problem.exchanged:
        columns = ", ".join(data[0].columns([site]) for site in problem.exchanged)
        log.warning("%s: with columns in the order %s the equation leaves much less", data[0].source, columns)
    return problem, dead


def _check_motion(data: Sequence[Samples]) -> None:
    for one in data:
        if not np.nanmax(np.abs(one.u - np.nanmean(one.u))) > 0:
            raise InputError(f"{one.source}: nothing moves; a diagnosis needs a motion")


def _check_outer(problem: Problem) -> None:
    """Refuse recordings without readings of a site that unknown ends leave without an equation.

    Raises:
        InputError: there are none in any recording.
    """
    sites, moving = problem.chain.sites, problem.chain.moving
    unread = [not any(np.any(np.isfinite(one.u[:, site])) for one in problem.data) for site in range(sites)]
    for site in set(range(sites)).difference(moving):
        if unread[site]:
            first, last = (0, site) if site < moving[0] else (site, sites - 1)
            raise InputError(
                f"{problem.data[0].source}: u{site + 1} has no readings; what a site near an unknown end does can only "
                f"be read. Leave all columns from u{first + 1} to u{last + 1} out, or say how the chain ends "
                f"({option('ends')})"
            )


def _check_enough(problem: Problem) -> None:
    """Refuse recordings with fewer readings than a model has unknowns.

    Raises:
        InputError: there are too few readings.
    """
    count = sum(int(np.sum(record.seen)) for record in problem.records)
    unknown = len(problem.declared.terms) + sum(nodes.shape[1] for nodes in problem.nodes)
    if count < 2 * unknown + SPARE:
        raise InputError(
            f"{problem.data[0].source}: {count} readings are too few for {unknown} unknowns "
            "(the coefficients and each trajectory's start); give longer or more records"
        )


def _check_room(problem: Problem) -> None:
    """Refuse chains whose derivatives alone take more memory than there is.

    Raises:
        InputError: there is too little.
    """
    size = problem.plain.size
    needed, there = float(MOTIONS * size**2 * sum(len(one.t) for one in problem.data)), free_memory()
    if needed > there:
        raise InputError(
            f"{problem.data[0].source}: a diagnosis of {problem.chain.sites} sites would take at least "
            f"{needed / 2**30:.2g} GiB, and {there / 2**30:.2g} GiB may be used; give some of the sites, with "
            f"{option('columns')} or in a file of their own, or fewer rows"
        )


def _named(search: Search, found: Found, foreseen: Foreseen) -> Compared:
    """Return the best model after exchanges, without effects that make the forecast worse."""
    search.say("trying what could stand in the place of each effect")
    best = compared(search, found.models[0])
    plainer = _plainer(search, best.fitted, found.models, foreseen)
    best = best if plainer is None else plainer
    if not best.fitted.model.effects:
        return best
    named = best.fitted
    before, now = (pooled(foreseen(one, named)) for one in (found.before, named))
    of_u = best.fitted.rms[: search.problem.chain.sites]
    least = rules.BEYOND_NOISE * float(np.sqrt(np.nanmean(of_u**2))) / search.problem.height
    while best.fitted.model.effects and now > max((1 + rules.WORSE) * before, least):
        search.say("the forecast is worse than before: trying without each effect, the weakest first")
        better = _with_one_less(search, best, now, lambda one: pooled(foreseen(one, named)))
        if better is None:
            break
        best, now = better
    return best


def _plainer(search: Search, best: Fitted, rivals: Sequence[Fitted], foreseen: Foreseen) -> Compared | None:
    """Return the best rival without influences that may stand in for something else; None if it is not the better one.

    It is where it forecasts better by more nats than it is behind, and leaves of the forecast little more than noise.
    """
    worth = Worth(search.problem, best)
    plain = min((one for one in rivals if not one.model.may_stand_in), key=worth.value, default=None)
    if plain is None or not best.model.may_stand_in:
        return None
    behind, noise = worth.value(plain) - worth.value(best), np.maximum(plain.rms, search.problem.finest)
    its, other = foreseen(plain, best), foreseen(best, best)
    if behind > rules.PLAINER or pooled(its) > rules.BEYOND_NOISE * by_noise(its, noise):
        return None
    if ahead(its, other, noise) / best.dispersion <= behind:
        return None
    search.say("the forecast is better without influences that have a frequency or a time of their own")
    found = compared(search, plain)
    if found.fitted.model.may_stand_in:
        search.worth = worth
        return None
    return found


def _decided(search: Search, found: Found, best: Fitted) -> Found:
    """Return how far the search came, with an entry of its own where a model was named that the readings put behind."""
    leader, last = found.models[0], found.horizons[-1]
    if best.model.may_stand_in or not leader.model.may_stand_in:
        return found
    search.screened(best)
    models = ((best.model.names, 0.0), (leader.model.names, search.value(leader) - search.value(best)))
    tried, misfit = search.tried[best.model.key], misfits(search.problem, best)
    return replace(found, horizons=(*found.horizons, replace(last, models=models, tried=tried, misfit=misfit)))


def _with_one_less(
    search: Search, best: Compared, now: float, forecast: Callable[[Fitted], float]
) -> tuple[Compared, float] | None:
    """Return a model without the weakest effect that makes the forecast worse, and its error; None where none does."""
    for number in np.argsort(best.evidence):
        fitted = search.without(best.fitted, int(number))
        error = np.inf if fitted is None else forecast(fitted)
        if fitted is not None and error < now:
            kept = [k for k in range(len(best.evidence)) if k != number]
            evidence = tuple(best.evidence[k] for k in kept)
            return Compared(fitted, evidence, tuple(best.alternatives[k] for k in kept)), error
    return None


def _diagnosis(
    problem: Problem,
    found: Found,
    best: Compared,
    left: tuple[Left, ...],
    foreseen: Foreseen,
    recorded: int,
    dead: tuple[int, ...],
) -> Diagnosis:
    """Return the diagnosis with the errors before and after."""
    before, after = found.before, best.fitted
    if not after.model.effects:
        before = after
    named = findings(best)
    noise = np.maximum(_noise(problem, after) if left else after.rms, problem.finest)
    more = len(after.model.numbers) - len(before.model.numbers)
    count = len(before.model.coefficients)
    comparable = before.longest == after.longest
    gain = 2 * (before.cost - after.cost) if comparable else float("nan")

    def both(function: Callable[[Fitted], One]) -> tuple[One, One]:
        return function(before), function(after)

    return Diagnosis(
        before, after, named, _verdict(named, left, found.whole), found.whole, found.horizons, left, problem.data,
        (sum(len(one.t) for one in problem.data), recorded), noise, _noise_lines(problem, after),
        residual=both(lambda one: _over(one, noise)),
        rms=both(lambda one: float(np.sqrt(np.nanmean(one.left**2)))),
        dynamics=both(lambda one: _dynamics(problem, one)),
        forecasts=both(lambda one: foreseen(one, after)),
        criterion=(0.0, more * float(np.log(after.layout.readings())) - gain),
        declared=both(lambda one: np.array(one.model.coefficients[:count])),
        modes=(modes.of_recording(problem), modes.of_model(before), modes.of_model(after)),
        inputs=in_words(problem), dead=dead, held=problem.held, exchanged=problem.exchanged,
    )  # fmt: skip


def _verdict(named: Sequence[Finding], left: Sequence[Left], whole: bool) -> str:
    if named:
        return "explained" if whole and not left else "partly explained"
    return "unexplained" if left else "nothing missing"


def _noise(problem: Problem, after: Fitted) -> Float[ndarray, " sensors"]:
    """Return the noise of each sensor where something is left: by the last model or, if less, by the readings alone."""
    own, readings = after.rms, problem.noise
    return np.where(np.isfinite(readings) & (readings > 0), np.fmin(own, readings), own)


def _over(fitted: Fitted, noise: ndarray) -> float:
    """Return the RMS of what a fit leaves, in units of the noise."""
    ratio = fitted.left / noise[fitted.rows.sensor]
    return float(np.sqrt(np.nanmean(ratio**2)))


def _noise_lines(problem: Problem, after: Fitted) -> tuple[str, ...]:
    noise, span = after.noise, problem.scene.span
    seen = np.any([np.any(one.seen, axis=(0, 2)) for one in problem.records], axis=0)
    read = replace(noise, size=np.where(seen.ravel(), noise.size, np.nan))
    return tuple(describe(read, problem.steps, interval=problem.step, least=after.rows.least, span=span))


def _dynamics(problem: Problem, fitted: Fitted) -> float:
    """Return the share of the derivative that a model leaves along the smoothed motion, its instruments undone."""
    motion, right = [], []
    for number, (record, nodes, splines) in enumerate(
        zip(problem.records, problem.nodes, problem.splines, strict=True)
    ):
        assembled = fitted.model.assembled(problem.plain, problem.chain, number)
        dynamics, t = assembled.dynamics, record.times
        states = unread(fitted.model, fitted.layout, number, nodes)
        driven = record.stretches.driven(t, splines)
        states = with_known(fitted, number, states)
        f = None if record.stretches.inputs is None else record.stretches.inputs(t)
        with np.errstate(all="ignore"):
            rate = dynamics.linear(assembled.coefficients, t, states, f, driven, derivatives=False)[0]
        rate = rate[:, : dynamics.read]
        shape = (len(t), dynamics.order, dynamics.parts, dynamics.count)
        right.append(rate.reshape(shape)[:, -1])
        seen = np.where(record.seen, record.value, np.nan)[..., problem.plain.moving]
        raw = np.concatenate([seen, nodes.reshape(shape)[:, seen.shape[1] :]], axis=1).reshape(nodes.shape)
        read = unread(fitted.model, fitted.layout, number, raw).reshape(shape)
        motion.append(read[:, problem.chain.levels - 1])
    return derivative_share(problem, motion, right)
