"""The loop: test whether anything is missing, trace it, add it, and again, until nothing is left or nothing explains it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

from latticebench.diagnosis.coherence import coherence, farthest
from latticebench.diagnosis.model import Change, Fitted, Model, carried, cut, first_fit, pace, refit, strengths, without
from latticebench.diagnosis.residual import (
    Forecast,
    alike,
    correlation_time,
    dynamics_share,
    forecast,
    noise,
    noise_of_readings,
    over_noise,
    pooled,
)
from latticebench.diagnosis.tangent import Tangent, linearise
from latticebench.diagnosis.trace import Finding, screen, variance_gain
from latticebench.diagnosis.ways import SHORTEST_DELAY
from latticebench.methods.engine.dynamics import split_parts
from latticebench.methods.method import check_fit
from latticebench.systems.effects import Effect
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples, SimulatedSamples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Chance of calling something missing where nothing is, over everything that is tried in a round.
FALSE_ALARM = 0.004
# Effects whose evidence is this near the best one's cannot be told from it (natural logarithms).
EQUAL = 3.0
# So much better must a term without a name be before no name is given; twice as good where a model loses the readings.
BETTER = 5.0
# What sensors' offsets are called that only forces can be.
FORCES = "a constant force of its own at each site"
# Terms without a name that are fitted in full beside the names in a round, and what share of their evidence in the screen they must have: what
# is far off the declared equation is screened roughly.
OTHER_FITS, OTHER_SHARE = 4, 0.6
# What acts at its own frequency or time.
TIMED = ("harmonic", "pulse")
# So many times the largest declared force is more than a memory can be.
CANCELLED = 2.0
# How far behind the best an effect may be in the screen and still be fitted: where the readings are lost, and as a share of the evidence.
FAR, ROUGH = 20.0, 0.15
# Effects refitted in a round, at most.
FULL_FITS = 8
MOST_EFFECTS = 4
POLISH = 8
# A residual of more than so many times the noise is gross: the model is then followed over shorter pieces.
GROSS = 3.0
# Names that leave the readings lost, and more than this share of what was beyond the noise, are none.
HARDLY = 0.5
# What cannot be told from an effect has at least this share of its evidence.
COMPARABLE = 0.5
MOST_PIECES = 64
# Readings beyond twice the number of unknowns that a test of what is left needs.
SPARE = 10
ARITHMETIC = 1e-6
LONGEST = 4000
MOST_SAMPLES = 16_000
# Thinning leaves at least so many samples.
ENOUGH = 2000


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect that was tried, in the screen and, where it came near, by a fit of its own.

    Attributes:
        finding: what the screen says.
        gain: twice the log likelihood ratio, of its own fit where there was one.
        evidence: the ranking goes by it.
        p: chance that noise alone does as well, corrected for the search.
        fitted: the model with it, or None.
    """

    finding: Finding
    gain: float
    evidence: float
    p: float
    fitted: Fitted | None = None

    @property
    def name(self) -> str:
        """The effect, or the term without a name."""
        return self.finding.name


@dataclass(frozen=True, eq=False)
class Round:
    """One turn of the loop.

    Attributes:
        ranking: all that was tried, the best first.
        added: the effect that was added, or None.
        equal: the names of effects that explain it as well.
    """

    ranking: tuple[Candidate, ...]
    added: str | None = None
    equal: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Course:
    """How the loop went.

    Attributes:
        before: the declared equation's fit.
        after: the fit with everything that was added.
        equal: for each change of the last model, the effects that cannot be told from it.
        rounds: the turns.
        left: what is significant in the last residual, the best first.
        verdict: "nothing missing", "explained", "partly explained" or "unexplained".
        rival: what has no name and does better in the last effect's place, if only by little, and by how much (natural logarithms); or None.
    """

    before: Fitted
    after: Fitted
    equal: tuple[tuple[str, ...], ...]
    rounds: tuple[Round, ...]
    left: tuple[Finding, ...]
    verdict: str
    rival: tuple[str, float] | None = None

    @property
    def repeated(self) -> tuple[str, ...]:
        """Effects with a frequency or time of their own that were added more than once: together they can stand for any course in time."""
        return _repeated(self.after)


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What the loop found, and the errors before and after.

    Attributes:
        course: how it went.
        noise: standard deviation of the noise on u and, where it was observed, v; of each part of a complex field.
        residual: of the forecast in units of the noise, before and after.
        dynamics: RMS of what the equation leaves of the derivative over that of the derivative, before and after.
        forecasts: of the held-out data, before and after; one a trajectory.
        criterion: the Bayesian information criterion, before and after, less a common constant.
        coefficients: relative error of the declared coefficients, |xi - xi*| / |xi*|, before and after, where a truth is known.
        truth: the true declared coefficients, or None.
        used: how many sample times the loop looked at, and how many there are.
    """

    course: Course
    noise: Float[ndarray, " levels"]
    residual: tuple[float, float]
    dynamics: tuple[float, float]
    forecasts: tuple[list[Forecast], list[Forecast]]
    criterion: tuple[float, float]
    coefficients: tuple[float, float] | None = None
    truth: Float[ndarray, " terms"] | None = None
    used: tuple[int, int] = (0, 0)

    @property
    def forecast(self) -> tuple[float, float]:
        """Root mean square error of the forecasts over that of the readings, before and after."""
        return pooled(self.forecasts[0]), pooled(self.forecasts[1])


Watcher = Callable[[str], None]


def diagnose(
    declared: Library,
    order: int,
    data: Sequence[Samples],
    catalogue: Sequence[Effect],
    seed: int = 1,
    *,
    held_out: Sequence[Samples] = (),
    truth: Float[ndarray, " terms"] | None = None,
    watcher: Watcher = lambda _: None,
    start: Float[ndarray, " terms"] | None = None,
) -> Diagnosis:
    """Run the loop on recordings.

    Args:
        declared: terms of the equation that is believed, their coefficients free.
        order: of the time derivative.
        data: recordings; a simulated one's truth is not looked at.
        catalogue: effects that may be missing.
        seed: of the surrogates.
        held_out: recordings to judge forecasts on; the last 30 % of each of `data` when there are none.
        truth: the declared coefficients' true values, only to report their error.
        watcher: is told what is being done.
        start: coefficients of another method's fit, to begin the declared equation's with.

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
        course = close(
            Model(declared, order), shown, catalogue, np.random.default_rng(seed), watcher=watcher, start=start
        )
        return _judge(course, declared, held_out, truth, sum(len(one.t) for one in shown), watcher)


def _judge(
    course: Course,
    declared: Library,
    held_out: Sequence[Samples],
    truth: Float[ndarray, " terms"] | None,
    recorded: int,
    watcher: Watcher,
) -> Diagnosis:
    """Measure the errors before and after."""
    watcher("forecasting")
    sides = (course.before, alike(course.after, course.before))
    size = noise(course.after)
    gain = sides[1].gain(sides[0])
    more = course.after.parameters - course.before.parameters
    errors = None
    if truth is not None:
        count = len(declared.terms)
        errors = [
            float(np.linalg.norm(one.solution.state.coefficients[:count] - truth) / np.linalg.norm(truth))
            for one in sides
        ]
    return Diagnosis(
        course, size,
        (over_noise(course.before, size), over_noise(course.after, size)),
        (dynamics_share(course.before), dynamics_share(course.after)),
        # As far ahead as the last model can go, however soon the declared one loses the readings.
        (forecast(alike(course.before, course.after), held_out), forecast(course.after, held_out)),
        (0.0, more * float(np.log(course.after.count)) - gain),
        None if errors is None else (errors[0], errors[1]), truth,
        (sum(len(one.t) for one in course.after.data), recorded),
    )  # fmt: skip


def close(
    model: Model,
    data: Sequence[Samples],
    catalogue: Sequence[Effect],
    draw: np.random.Generator,
    *,
    watcher: Watcher = lambda _: None,
    most: int = MOST_EFFECTS,
    surrogates: int = 200,
    start: Float[ndarray, " terms"] | None = None,
) -> Course:
    """Go round the loop.

    A long record that is sampled far more densely than it moves is thinned first, and of a very long one parts are looked at.

    Args:
        model: the declared equation.
        data: recordings.
        catalogue: the effects that may be missing.
        draw: for the surrogates.
        watcher: is told what is being done.
        most: effects that are added at most.
        surrogates: simulated recordings that the null distribution comes from.
        start: the declared coefficients to begin with, where another method has fitted them.
    """
    watcher("fitting the declared equation")
    horizon = Horizon.of([thinned(samples, model.order) for samples in data], model)
    before = horizon.first(model, start)
    if before.count < 2 * before.parameters + SPARE:
        raise InputError(
            f"{data[0].source}: {before.count:.0f} readings are too few for {before.parameters:.0f} unknowns (the coefficients and each "
            "trajectory's start); give longer or more records"
        )
    fitted, lost = before, not horizon.follows(before)
    rounds: list[Round] = []
    equal: list[tuple[str, ...]] = []
    doubted: _Doubted | None = None
    rival: tuple[str, float] | None = None
    left: tuple[Finding, ...] = ()
    while True:
        watcher(f"tracing what is left, round {len(rounds) + 1}")
        findings = screen(linearise(fitted), catalogue, draw, surrogates)
        left = () if _exact(fitted) else significant(findings)
        named = [one for one in findings if one.named]
        if not left or len(fitted.model.changes) >= most:
            left = left or _anything(fitted, draw, surrogates)
            rounds.append(Round(tuple(_unfitted(findings))))
            break
        ranking = _contest(fitted, findings, watcher, lost=not horizon.follows(fitted))
        best, margin = _chosen(_steady(ranking, horizon) if lost else ranking)
        count = len(named)
        if best is None or best.fitted is None or best.p * count > FALSE_ALARM:
            rounds.append(Round(tuple(ranking)))
            break
        found = _rival(ranking, best)
        if doubted is not None:
            # The second of two names: together they must do clearly more than the term without a name did alone.
            if best.evidence + doubted.named < doubted.unnamed + EQUAL:
                rounds.append(Round(tuple(ranking)))
                break
            doubted = None
        elif found[1] > (BETTER if horizon.sees_all(fitted) else best.evidence):
            doubted = _Doubted(fitted, tuple(equal), len(rounds), best.evidence, best.evidence + found[1])
        least = max(best.evidence - margin, COMPARABLE * best.evidence)
        near = tuple(
            one.name for one in ranking
            if one is not best and one.finding.named and one.fitted is not None and one.evidence > least
        )  # fmt: skip
        # A name that something without one explains as well is no explanation yet.
        rival = found if found[1] > 0 and horizon.sees_all(fitted) else None
        rounds.append(Round(tuple(ranking), best.name, near))
        fitted, equal = best.fitted, [*equal, near]
        fitted, equal = _prune(fitted, equal)
        watcher("looking farther")
        fitted = settled(horizon.lengthen(fitted))
    if doubted is not None:
        # A term without a name explains more than every name, alone or with another: none of them is right.
        fitted, equal = doubted.fitted, list(doubted.equal)
        rounds = rounds[: doubted.round + 1]
        rounds[-1] = replace(rounds[-1], added=None, equal=())
        left = significant([one.finding for one in rounds[-1].ranking])
    fitted, equal = _prune(fitted, equal, all_of_them=True)
    if len(fitted.model.changes) > 1:
        fitted, equal, left = _reconsider(fitted, equal, left, horizon, catalogue, draw, surrogates, watcher)
    if fitted.model.changes and not horizon.follows(fitted) and _hardly(before, fitted, horizon):
        fitted, equal = before, []
        rounds = [replace(rounds[0], added=None, equal=())]
        left = significant([one.finding for one in rounds[0].ranking])
    if not fitted.model.changes:
        rival = None
    elif rival is None and horizon.follows(fitted):
        rival = _forced(fitted)
    verdict = (
        ("partly explained" if left or rival or _repeated(fitted) else "explained")
        if fitted.model.changes
        else ("unexplained" if left else "nothing missing")
    )
    return Course(before, fitted, tuple(equal), tuple(rounds), left, verdict, rival)


def _hardly(before: Fitted, after: Fitted, horizon: Horizon) -> bool:
    """Say whether what was added takes away only a small part of what is beyond the noise."""
    shares = [over_noise(one, horizon.noise) ** 2 - 1 for one in (alike(before, after), after)]
    return shares[1] > HARDLY * shares[0]


def _repeated(fitted: Fitted) -> tuple[str, ...]:
    timed = Counter(change.effect.name for change in fitted.model.changes if change.effect.acts in TIMED)
    return tuple(name for name, count in timed.items() if count > 1)


@dataclass(frozen=True, eq=False)
class _Doubted:
    """Where the loop was when a term without a name did better than the best name, and the evidence of both."""

    fitted: Fitted
    equal: tuple[tuple[str, ...], ...]
    round: int
    named: float
    unnamed: float


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
        """Find the lengths that make sense."""
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
        """Say whether a model does not lose the readings."""
        if not fitted.solution.converged:
            return False
        if not np.all(np.isfinite(self.noise)):
            return True
        return over_noise(fitted, self.noise) < GROSS

    def sees_all(self, fitted: Fitted) -> bool:
        """Say whether a model follows the readings from end to end, so that small differences between terms mean something."""
        return self.follows(fitted) and max(len(samples.t) for samples in fitted.data) >= self.lengths[0]

    def first(self, model: Model, start: Float[ndarray, " terms"] | None = None) -> Fitted:
        """Fit a model as far as it can follow; the shortest pieces where it never does."""
        for length in self.lengths:
            last = length == self.lengths[-1]
            fitted = first_fit(model, cut(self.data, length), steps=40 if last else 15, coefficients=start)
            if self.follows(fitted):
                break
        return fitted

    def lengthen(self, fitted: Fitted) -> Fitted:
        """Fit a model to longer pieces as long as it follows them."""
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
    """Leave out samples that a cubic through the others tells to within the noise; not where an input was measured with them."""
    step = 1
    levels = 1 if order == 1 or samples.v is None else 2
    size = noise_of_readings([samples], order, levels)[0]
    while samples.f is None and np.isfinite(size) and len(samples.t) // (2 * step) >= ENOUGH:
        if _told(samples, 2 * step) > 1.5 * size:
            break
        step *= 2
    if step == 1:
        return samples
    u, v = samples.u[::step], None if samples.v is None else samples.v[::step]
    return replace(samples, t=samples.t[::step], u=u, v=v)


def _told(samples: Samples, step: int) -> float:
    """RMS of what a cubic spline through every `step`-th sample leaves of the others, in each real part."""
    from scipy.interpolate import CubicSpline

    left = []
    for part in np.moveaxis(split_parts(samples.u, samples.is_complex).reshape(len(samples.t), -1), 1, 0):
        seen = np.isfinite(part)
        t, value = samples.t[seen], part[seen]
        if len(t) < 4 * step:
            return float("inf")
        left.append(value - CubicSpline(t[::step], value[::step])(t))
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))


def _steady(ranking: Sequence[Candidate], horizon: Horizon) -> list[Candidate]:
    """Leave out what acts at its own frequency or time where that is no more than in step with the motion.

    Where the declared equation loses the readings, such a force can stand for nearly anything; but a term without a name does clearly better then, or it
    does not find the readings again while something else was tried.
    """

    def timed(one: Candidate) -> bool:
        return one.finding.change.effect.acts in TIMED

    ahead = [one for one in ranking if not timed(one) or _rival(ranking, one)[1] <= max(BETTER, ROUGH * one.evidence)]
    kept = [one for one in ahead if not timed(one) or (one.fitted is not None and horizon.follows(one.fitted))]
    return kept if any(one.finding.named and one.fitted is not None for one in kept) else ahead


def _exact(fitted: Fitted) -> bool:
    """Say whether a model leaves less than any instrument could show; what is left is arithmetic."""
    values = [record.value[record.seen] for record in fitted.records]
    return float(np.max(fitted.sigma)) < ARITHMETIC * float(np.sqrt(np.mean(np.concatenate(values) ** 2)))


def significant(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Pick what noise alone would hardly do, counting all that was tried; half of the chance is for the catalogue's effects."""
    found = []
    for named in (True, False):
        group = [one for one in findings if one.named is named]
        found += [one for one in group if one.rarity > np.log(len(group)) - np.log(FALSE_ALARM / 2)]
    return tuple(sorted(found, key=lambda one: -one.rarity))


def _anything(fitted: Fitted, draw: np.random.Generator, surrogates: int) -> tuple[Finding, ...]:
    """Look for anything at all where nothing that has a form is significant."""
    if _exact(fitted):
        return ()
    tangent = linearise(fitted)
    found = (coherence(tangent, draw, surrogates), farthest(tangent))
    return tuple(one for one in found if one.p < FALSE_ALARM / 2)


def _unfitted(findings: Sequence[Finding]) -> list[Candidate]:
    return [Candidate(one, one.gain, one.evidence, one.p) for one in findings]


def _contest(
    fitted: Fitted, findings: Sequence[Finding], watcher: Watcher, *, window: float = 2 * EQUAL, lost: bool = False
) -> list[Candidate]:
    """Fit the best few effects in full and rank all; more of them where the readings are lost, as the screen is rough there."""
    ranking: list[Candidate] = []
    screened, fits, others = 0.0, 0, 0
    for one in findings:
        timed = one.change.effect.acts in TIMED
        # Where the readings are lost such a one is fitted to see whether it finds them again; the others are measured against each other.
        apart = timed and lost and one.named
        # What is plainly visible is screened roughly; and other ends change the motion by more than to first order. What has a frequency or
        # a time of its own can stand for nearly anything, and is not given that much.
        behind = window if timed else max(FAR if lost else window, ROUGH * screened)
        near = one.evidence > screened - behind or (one.change.ends is not None and one.evidence > EQUAL)
        if apart:
            near = one.evidence > EQUAL
        # A term without a name is measured as the names are, where the screen puts it beside them.
        if not one.named:
            near = bool(one.change.texts) and one.evidence > OTHER_SHARE * screened and others < OTHER_FITS
        if not near or (fits >= FULL_FITS and not apart):
            ranking.append(Candidate(one, one.gain, one.evidence, one.p))
            continue
        watcher(f"fitting {one.name}")
        with_it = polish(fitted.model.with_change(one.change), fitted)
        if with_it is None or _impossible(one.change, with_it, fitted):
            ranking.append(Candidate(one, 0.0, 0.0, 1.0))
            continue
        gain = with_it.gain(fitted)
        # Of a random effect the evidence is that of its variance: a fit has as many coefficients as there are sites.
        again = one if one.random or "step" in one.change.psi else replace(one, gain=gain)
        ranking.append(Candidate(one, gain, again.evidence, again.p, with_it))
        if not one.named:
            others += 1
        elif not apart:
            fits, screened = fits + 1, max(screened, one.evidence)
    return sorted(ranking, key=lambda one: -one.evidence)


def _impossible(change: Change, with_it: Fitted, fitted: Fitted) -> bool:
    """Say whether a fit makes of an effect what it cannot be.

    A friction that drives is none. Nor is a memory so strong that the other terms must cancel it: with the present it makes a derivative.
    """
    own = slice(len(fitted.solution.state.coefficients), None)
    if change.effect.takes:
        return bool(np.any(with_it.solution.state.coefficients[own] > 0))
    if change.effect.acts == "delayed":
        return bool(np.max(strengths(with_it)[own]) > CANCELLED * np.max(strengths(fitted)))
    return False


def _chosen(ranking: Sequence[Candidate]) -> tuple[Candidate | None, float]:
    """Choose the name to add, and say how near others must come to be as good.

    Of those as good as the best one without a parameter that was searched goes before one with. What is left of a model that is far off is
    correlated, and differences count for so much less.
    """
    tried = [one for one in ranking if one.finding.named and one.fitted is not None]
    if not tried or tried[0].fitted is None:
        return None, EQUAL
    margin = EQUAL * correlation_time(tried[0].fitted)
    plain = [one for one in tried if one.evidence > tried[0].evidence - margin and not one.finding.searched]
    return (plain or tried)[0], margin


def _rival(ranking: Sequence[Candidate], best: Candidate) -> tuple[str, float]:
    """Find what has no name and does best beside the best name, and by how much it is ahead.

    A fit of the name may find a better place or frequency for it than the screen's grid; what is only screened must beat that, too.
    """
    found = ("", -np.inf)
    for one in ranking:
        if not one.finding.named:
            theirs = best.evidence if one.fitted is not None else max(best.evidence, best.finding.evidence)
            found = max(found, (one.name, float(one.evidence - theirs)), key=lambda pair: pair[1])
    return found


def polish(model: Model, start: Fitted) -> Fitted | None:
    """Fit a model with its parameters, from the fit of a smaller one; None where it fails."""
    fitted = refit(model, start.data, start.solution.state)
    if not np.all(np.isfinite(fitted.solution.state.coefficients)):
        return None
    if not any(change.free for change in model.changes):
        return fitted
    for _ in range(POLISH):
        tangent = linearise(fitted)
        step, error = _joint_step(tangent)
        changes, errors, begin, largest = [], [], len(fitted.solution.state.coefficients), 0.0
        for change in fitted.model.changes:
            free = change.free
            end = begin + len(free)
            size = np.array([_longest(change, name, fitted) for name in free])
            least = np.array([_least(change, name, fitted) for name in free])
            move = np.maximum(np.clip(step[begin:end], -size, size), least)
            with np.errstate(divide="ignore", invalid="ignore"):
                largest = max(
                    largest, float(np.max(np.nan_to_num(np.abs(step[begin:end]) / error[begin:end]), initial=0.0))
                )
            changes.append(
                change.moved({name: change.psi[name] + float(m) for name, m in zip(free, move, strict=True)})
            )
            errors.append(dict(zip(free, (float(e) for e in error[begin:end]), strict=True)))
            begin = end
        moved = refit(replace(fitted.model, changes=tuple(changes)), fitted.data, fitted.solution.state)
        if not np.all(np.isfinite(moved.solution.state.coefficients)):
            break
        worse = moved.gain(fitted) < -1.0
        if worse:
            break
        fitted = replace(moved, psi_errors=tuple(errors))
        if largest < 0.1:
            break
    return fitted


def settled(fitted: Fitted) -> Fitted:
    """Write offsets that were found as forces as offsets, where that fits as well."""
    for number, change in enumerate(fitted.model.changes):
        other = _as_offset(fitted, number) if change.as_force else None
        if other is not None and other.gain(fitted) > -EQUAL:
            fitted = other
    return fitted


def _as_offset(fitted: Fitted, number: int) -> Fitted | None:
    """Fit a change that is written as forces as offsets; None where it cannot be."""
    change, rest = fitted.model.changes[number], _rest(fitted)
    if rest is None:
        return None
    smaller = without(fitted, number)
    psi = dict(zip(change.psi, (float(x) for x in rest), strict=True))
    changes = list(fitted.model.changes)
    changes[number] = replace(change, as_force=False, psi=psi)
    return polish(replace(fitted.model, changes=tuple(changes)), smaller)


def _forced(fitted: Fitted) -> tuple[str, float] | None:
    """Say by how much forces do better than the offsets that they are called: by so much no sensor is off."""
    for number, change in enumerate(fitted.model.changes):
        other = _as_offset(fitted, number) if change.as_force else None
        if other is not None and fitted.gain(other) > 2 * BETTER:
            return FORCES, fitted.gain(other) / 2
    return None


def _rest(fitted: Fitted) -> ndarray | None:
    """Find the reading of each site at which the equation with the constant forces rests."""
    from scipy.optimize import root

    record = fitted.records[0]
    dynamics = record.stretches.dynamics
    sites, size = dynamics.sites, dynamics.size
    if dynamics.count != sites:
        return None
    start = np.mean(np.concatenate(fitted.solution.state.nodes), axis=0)[:sites]
    t = record.times[:1]

    def push(u: ndarray) -> ndarray:
        y = np.concatenate([u, np.zeros(sites)])[None]
        f = np.zeros((1, sites)) if record.stretches.inputs is not None else None
        rate = dynamics.linear(fitted.solution.state.coefficients, t, y, f, None, derivatives=False)[0]
        return np.asarray(rate[0, size - sites :])

    found = root(push, start)
    return np.asarray(found.x) if found.success else None


def _joint_step(tangent: Tangent) -> tuple[ndarray, ndarray]:
    """Give the Gauss-Newton step of all parameters with their standard errors; random ones are held by their spread."""
    matrix, target = tangent.jacobian, tangent.raw
    begin = len(tangent.fitted.solution.state.coefficients)
    for change in tangent.fitted.model.changes:
        end = begin + len(change.free)
        if change.spread is not None and change.free:
            prior = np.zeros((end - begin, matrix.shape[1]))
            prior[:, begin:end] = np.eye(end - begin) / change.spread
            matrix = np.concatenate([matrix, prior])
            target = np.concatenate([target, -np.array([change.psi[name] for name in change.free]) / change.spread])
        begin = end
    length = np.linalg.norm(matrix, axis=0)
    length[length == 0] = 1.0
    left, values, right = np.linalg.svd(matrix / length, full_matrices=False)
    kept = values > 1e-7 * values[0]
    inverse = np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)
    step = right.T @ (inverse * (left.T @ target)) / length
    error = np.sqrt(np.sum((right.T * inverse) ** 2, axis=1)) / length
    return step, error


def _longest(change: Change, name: str, fitted: Fitted) -> float:
    """How far a parameter may move in one step."""
    times = fitted.data[0].t
    span, gap = float(times[-1] - times[0]), float(np.median(np.diff(times)))
    limits = {
        "omega": 0.5 * np.pi / span, "delay": min(gap, 0.5 * change.psi.get("delay", gap)), "at": 2 * gap, "width": 0.3 * change.psi.get("width", 1.0), "s": 0.5,
        "scale": 0.5 * (1 + change.psi.get("scale", 0.0)),
    }  # fmt: skip
    return float(limits.get(name, np.inf))


def _least(change: Change, name: str, fitted: Fitted) -> float:
    """How far down a parameter may move in one step.

    What has less than a whole wave in the record is no wave, and a delay much shorter than the motion's own time no memory.
    """
    if name == "omega":
        span = max(float(one.t[-1]) for one in fitted.data) - min(float(one.t[0]) for one in fitted.data)
        return 2 * np.pi / span - change.psi["omega"]
    if name == "delay":
        return SHORTEST_DELAY / max(pace(fitted.curves()), 1e-300) - change.psi["delay"]
    return -np.inf


def _taken_away(fitted: Fitted, number: int) -> Fitted | None:
    """Fit the model without one of its changes."""
    smaller = without(fitted, number)
    return polish(smaller.model, smaller)


def _prune(
    fitted: Fitted, equal: list[tuple[str, ...]], *, all_of_them: bool = False
) -> tuple[Fitted, list[tuple[str, ...]]]:
    """Take away earlier effects that the later ones made superfluous.

    A random effect has one parameter, the variance of its coefficients, however many of these there are.
    """
    number = 0
    while len(fitted.model.changes) > 1 and number < len(fitted.model.changes) - (not all_of_them):
        change = fitted.model.changes[number]
        smaller = _taken_away(fitted, number)
        if smaller is not None and _worth(change, fitted, smaller) < np.log(fitted.count):
            fitted = smaller
            equal = equal[:number] + equal[number + 1 :]
            continue
        number += 1
    return fitted, equal


def _reconsider(
    fitted: Fitted,
    equal: list[tuple[str, ...]],
    left: tuple[Finding, ...],
    horizon: Horizon,
    catalogue: Sequence[Effect],
    draw: np.random.Generator,
    surrogates: int,
    watcher: Watcher,
) -> tuple[Fitted, list[tuple[str, ...]], tuple[Finding, ...]]:
    """Look at each effect again, now that the others are in, for another that does better in its place, or as well.

    As long as something is left unexplained, it could tilt the balance by as much as its own evidence.
    """
    margin = max(EQUAL, left[0].evidence) if left else EQUAL
    for number in range(len(fitted.model.changes)):
        own = fitted.model.changes[number]
        watcher(f"reconsidering {own.effect.name}")
        smaller = _taken_away(fitted, number)
        if smaller is None or not horizon.follows(smaller):
            # Without it the readings are lost: its place is not in doubt.
            continue
        ranking = _contest(
            smaller, screen(linearise(smaller), catalogue, draw, surrogates), watcher, window=max(2 * EQUAL, margin)
        )
        tried = [one for one in ranking if one.finding.named and one.fitted is not None]
        if not tried:
            continue
        best = tried[0]
        present = next((one for one in ranking if one.name == own.effect.name), best).finding
        mine = present.evidence if own.spread is not None else replace(present, gain=fitted.gain(smaller)).evidence
        if best.name != own.effect.name and best.evidence > mine + margin and best.fitted is not None:
            # The better one goes to the end, where polish put it.
            fitted = best.fitted
            equal = [*equal[:number], *equal[number + 1 :], ()]
            return fitted, equal, significant(screen(linearise(fitted), catalogue, draw, surrogates))
        top = max(best.evidence, mine)
        least = max(top - margin, COMPARABLE * top)
        equal[number] = tuple(one.name for one in tried if one.name != own.effect.name and one.evidence > least)
    return fitted, equal, left


def _worth(change: Change, fitted: Fitted, smaller: Fitted) -> float:
    """Give twice the log likelihood ratio to a model without a change, for each parameter that this has."""
    if change.spread is not None:
        return variance_gain(linearise(smaller), change.effect)
    samples = fitted.data[0]
    columns = len(change.forces(samples.sites, samples.is_complex)) + len(change.free)
    return fitted.gain(smaller) / max(columns, 1)
