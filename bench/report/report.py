"""What the loop found, for programs (`content`) and for people at a terminal (`show`); `page` makes the HTML file.

Residuals are given in units of the noise, frequencies as angular ones (as in cos(omega*t)), sites are counted from 1.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.bench.report.equation import side
from latticebench.diagnosis.model import Change, Fitted
from latticebench.diagnosis.repair import EQUAL
from latticebench.diagnosis.ways import step_of
from latticebench.systems.effects import INSTRUMENT, Effect
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.repair import Candidate, Diagnosis, Round, Watcher
    from latticebench.systems.samples import Samples

# Entries of a ranking that people are shown.
SHOWN = 6
# A recording is cut into so many windows to say when the residual is large.
WINDOWS = 12
# Chance that pure noise has a site, a window or a frequency named.
CHANCE = 0.01
# Rounding that makes less of the noise's variance than this is not worth a word.
ROUNDING = 0.01
# A forecast that is so many times as large as the readings has run away.
DIVERGED = 1000.0
# So many coefficients of one effect are listed one by one.
LISTED = 8
# So many times as far from the middle as any other reading of its site is no reading of the motion.
STRAY = 10.0


@dataclass(frozen=True)
class Added:
    """An effect as it was added to the equation.

    Attributes:
        effect: its name.
        parameters: where and how it acts: site (from 1), omega, delay, at, width, s, ends, ...
        coefficients: by the text of the term, or by what the instrument does ("offset of u3").
        stderr: standard errors of coefficients and fitted parameters, as far as they are known.
        indistinguishable: effects that explain these data as well.
    """

    effect: str
    parameters: dict[str, Any]
    coefficients: dict[str, float]
    stderr: dict[str, float]
    indistinguishable: tuple[str, ...] = ()


def added(diagnosis: Diagnosis) -> list[Added]:
    """List the effects of the last model, in the order in which they were added."""
    course = diagnosis.course
    fitted = course.after
    pieces = zip(fitted.model.changes, _blocks(fitted), course.equal, strict=True)
    errors = np.sqrt(np.maximum(np.diag(fitted.solution.covariance), 0.0))
    found = []
    for number, (change, block, equal) in enumerate(pieces):
        labels = _labels(change, fitted)
        values = fitted.solution.state.coefficients[block]
        coefficients = {label: float(value) for label, value in zip(labels, values, strict=True)}
        stderr = {label: float(error) for label, error in zip(labels, errors[block], strict=True)}
        known = fitted.psi_errors[number] if number < len(fitted.psi_errors) else {}
        parameters: dict[str, Any] = {} if change.site is None else {"site": change.site + 1}
        if change.ends:
            parameters["ends"] = change.ends
        for name, value in change.psi.items():
            if name in ("inner", "origin"):
                # Of use to the fit alone.
                continue
            if change.effect.acts in INSTRUMENT and name in change.free:
                label = _reading(change, name, fitted.data[0].is_complex)
                coefficients[label] = float(value)
            else:
                label = name
                parameters[name] = bool(value) if name == "open" else int(value) if name == "reach" else float(value)
            if name in known:
                stderr[label] = float(known[name])
        if change.effect.acts == "one equation":
            # The force is what it was; the site answers it as a mass of this size would.
            parameters["mass_ratio"] = 1 / (1 + parameters["scale"])
            if "scale" in stderr:
                stderr["mass_ratio"] = stderr["scale"] * parameters["mass_ratio"] ** 2
        found.append(Added(change.effect.name, parameters, coefficients, stderr, tuple(equal)))
    return found


def _blocks(fitted: Fitted) -> list[slice]:
    """Say which coefficients are those of each change."""
    samples = fitted.data[0]
    begin, found = len(fitted.model.declared.terms), []
    for change in fitted.model.changes:
        end = begin + len(change.forces(samples.sites, samples.is_complex))
        found.append(slice(begin, end))
        begin = end
    return found


def _labels(change: Change, fitted: Fitted) -> list[str]:
    samples = fitted.data[0]
    labels = [force.label for force in change.forces(samples.sites, samples.is_complex)]
    # A force that is i times 1.
    return [label.removesuffix("*1") if label.endswith("i*1") else label for label in labels]


def _reading(change: Change, name: str, is_complex: bool) -> str:
    """Say what a parameter of the instrument is, with the names of the file's columns."""
    kind, _, number = name.partition("_")
    if change.effect.acts == "clock":
        return f"lateness of row {number}" if kind == "row" else "slowness of the clock"
    if is_complex and change.effect.acts == "offset":
        column = f"{'im' if kind == 'imaginary' else 're'}{number}"
    elif is_complex:
        column = f"re{number} and im{number}"
    else:
        column = f"u{number}" + (f" and v{number}" if change.both else "")
    return f"{change.effect.acts} of {column}"


def declared(fitted: Fitted) -> tuple[dict[str, float], dict[str, float]]:
    """Give the declared terms' coefficients and their standard errors."""
    texts = fitted.model.declared.texts
    values = fitted.solution.state.coefficients[: len(texts)]
    errors = np.sqrt(np.maximum(np.diag(fitted.solution.covariance)[: len(texts)], 0.0))
    return (
        {text: float(value) for text, value in zip(texts, values, strict=True)},
        {text: float(error) for text, error in zip(texts, errors, strict=True)},
    )


def content(diagnosis: Diagnosis) -> dict[str, Any]:
    """Write a diagnosis as what JSON can hold: texts, finite numbers, None where a number is not known.

    `declared` has the declared terms' coefficients in the last model, `noise` is the standard deviation of the noise on u (of a
    complex field in total), `residual` is in units of the noise, `forecast` and `coefficients` are relative errors, `dynamics` is the
    share of the derivative that the equation leaves, `criterion` the Bayesian information criterion less that of the
    declared equation.
    """
    course = diagnosis.course
    before, before_errors = declared(course.before)
    after, errors = declared(course.after)

    def pair(values: tuple[float, float]) -> dict[str, float]:
        return {"before": values[0], "after": values[1]}

    whole = {
        "declared": after, "declared_before": before, "declared_stderr": errors, "declared_stderr_before": before_errors,
        "noise": total_noise(diagnosis),
        "verdict": course.verdict,
        "effects": [
            {
                "effect": one.effect, "parameters": one.parameters, "coefficients": one.coefficients,
                "stderr": one.stderr, "indistinguishable": list(one.indistinguishable),
            }
            for one in added(diagnosis)
        ],
        "rounds": [
            {
                "added": one.added,
                "ranking": [
                    {"effect": entry.name, "evidence": entry.evidence, "p": entry.p, "named": entry.finding.named}
                    for entry in one.ranking
                ],
            }
            for one in course.rounds
        ],
        "error": {
            "residual": pair(diagnosis.residual), "forecast": pair(diagnosis.forecast),
            "coefficients": None if diagnosis.coefficients is None else pair(diagnosis.coefficients),
            "criterion": pair(diagnosis.criterion), "dynamics": pair(diagnosis.dynamics),
        },
        "where": {
            name: {
                "sites": [{"site": site, "residual": size} for site, size in place.sites],
                "times": [{"from": begin, "to": end, "residual": size} for begin, end, size in place.times],
                "frequencies": [{"omega": omega, "power": power} for omega, power in place.frequencies],
            }
            for name, place in (("before", whereabouts(course.before, diagnosis)), ("after", whereabouts(course.after, diagnosis)))
        },
        "left": [{"effect": one.name, "p": one.p, "named": one.named} for one in course.left],
        "rival": None if course.rival is None else {"name": course.rival[0], "lead": course.rival[1]},
        "notes": notes(diagnosis),
    }  # fmt: skip
    found: dict[str, Any] = finite(whole)
    return found


def finite(value: Any) -> Any:
    """Put None for numbers that JSON does not have, and plain numbers for NumPy's."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(entry) for entry in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value


def total_noise(diagnosis: Diagnosis) -> float:
    """Give the standard deviation of the noise on u; of a complex field that of both parts together."""
    return float(diagnosis.noise[0] * np.sqrt(diagnosis.course.after.records[0].value.shape[2]))


# Where the residual lives ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Whereabouts:
    """Sites, times and frequencies at which there is more of a residual than noise would leave, the largest first.

    Attributes:
        sites: (site from 1, RMS in units of the noise).
        times: (from, to, RMS in units of the noise).
        frequencies: (angular frequency, power over that of the noise).
        several: how many sites and windows there are in all.
    """

    sites: tuple[tuple[int, float], ...]
    times: tuple[tuple[float, float, float], ...]
    frequencies: tuple[tuple[float, float], ...]
    several: tuple[int, int]


def over_noise(
    fitted: Fitted, diagnosis: Diagnosis
) -> list[tuple[Float[ndarray, " time"], Float[ndarray, "time levels parts sites"]]]:
    """Give the residual of each trajectory: times, and what is left in units of the noise, NaN where nothing was seen.

    Pieces that a trajectory was cut into for the fit are put together again.
    """
    sizes = np.asarray(diagnosis.noise)[:, None, None]
    # What the fit took along with its parameters is missing in the residual.
    spare = np.sqrt(max(1 - fitted.parameters / fitted.count, 0.05))
    found: list[tuple[ndarray, ndarray]] = []
    source = ""
    for record, samples, left in zip(fitted.records, fitted.data, fitted.residuals(), strict=True):
        values = np.where(record.seen, left / sizes[: left.shape[1]] / spare, np.nan)
        if found and samples.source == source and record.times[0] > found[-1][0][-1]:
            found[-1] = (np.append(found[-1][0], record.times), np.concatenate([found[-1][1], values]))
        else:
            found.append((record.times, values))
        source = samples.source
    return found


def whereabouts(fitted: Fitted, diagnosis: Diagnosis) -> Whereabouts:
    """Say where there is more of a residual than noise of the estimated size would leave by chance."""
    from scipy.stats import chi2

    trajectories = over_noise(fitted, diagnosis)
    every = [left for _, left in trajectories]

    def stands_out(values: ndarray, tries: int) -> float | None:
        """Give the RMS of values where it is beyond chance."""
        seen = values[np.isfinite(values)]
        size = float(np.mean(seen**2)) if len(seen) else 0.0
        return float(np.sqrt(size)) if len(seen) and size > chi2.isf(CHANCE / tries, len(seen)) / len(seen) else None

    sites, times = [], []
    count = every[0].shape[-1]
    for site in range(count):
        size = stands_out(np.concatenate([one[..., site].ravel() for one in every]), count)
        if size is not None:
            sites.append((site + 1, size))
    windows = 0
    for t, one in trajectories:
        edges = np.unique(np.linspace(0, len(t), WINDOWS + 1).astype(int))
        for begin, end in itertools.pairwise(edges):
            windows += 1
            size = stands_out(one[begin:end], WINDOWS * len(every))
            if size is not None:
                times.append((float(t[begin]), float(t[end - 1]), size))
    lines: list[tuple[float, float]] = []
    for t, one in trajectories:
        omega, power, weight = spectrum(t, one)
        if len(omega) < 3:
            continue
        limit = chi2.isf(CHANCE / len(omega), 2 * weight) / (2 * weight)
        padded = np.concatenate([[0.0], power, [0.0]])
        peaks = (power > limit) & (power >= padded[:-2]) & (power >= padded[2:])
        lines += [(float(w), float(p)) for w, p in zip(omega[peaks], power[peaks], strict=True)]
    return Whereabouts(
        tuple(sorted(sites, key=lambda one: -one[-1])),
        tuple(sorted(times, key=lambda one: -one[-1])),
        tuple(sorted(lines, key=lambda one: -one[-1])[:WINDOWS]),
        (count, windows),
    )


def spectrum(t: ndarray, left: ndarray) -> tuple[ndarray, ndarray, int]:
    """Give the residual's power at angular frequencies, the mean over all readings; 1 is what white noise has on average.

    Args:
        t: times (T,); uneven ones are brought onto an even grid by straight lines.
        left: residual in units of the noise (T, levels, parts, N).

    Returns:
        frequencies (F,), powers (F,), and how many series went into the mean.
    """
    series = left.reshape(len(t), -1)
    series = series[:, np.sum(np.isfinite(series), axis=0) > 2]
    if series.shape[1] == 0 or len(t) < 4:
        return np.zeros(0), np.zeros(0), 1
    even = np.linspace(t[0], t[-1], len(t))
    filled = [np.interp(even, t[np.isfinite(one)], one[np.isfinite(one)]) for one in series.T]
    # The trajectories' starts were fitted, and with them the mean: there is no power at 0.
    power = np.mean(np.abs(np.fft.rfft(np.stack(filled), axis=1)) ** 2, axis=0) / len(t)
    omega = 2 * np.pi * np.fft.rfftfreq(len(t), even[1] - even[0])
    return omega[1:], power[1:], series.shape[1]


def living(place: Whereabouts) -> list[str]:
    """Say in words where a residual lives."""
    if not (place.sites or place.times or place.frequencies):
        return ["No site, time or frequency has more of it than noise would leave."]
    said = []
    for found, whole, noun in ((place.sites, place.several[0], "sites"), (place.times, place.several[1], "times")):
        # That the only site has it is no news.
        if not found or (noun == "sites" and whole == 1):
            continue
        sizes = [one[-1] for one in found]
        if len(found) == whole > 1 and sizes[0] < 1.5 * sizes[-1]:
            said.append(f"At all {noun} alike, {sizes[-1]:.2g} to {sizes[0]:.2g} times the noise.")
        elif noun == "sites":
            listed = [f"site {one[0]} ({one[-1]:.2g} times the noise)" for one in found[:3]]
            said.append(
                "Most at "
                + ", ".join(listed)
                + ("." if len(found) <= 3 else f"; {len(found)} of {whole} sites have some.")
            )
        else:
            listed = [f"t = {one[0]:.4g} to {one[1]:.4g} ({one[-1]:.2g} times the noise)" for one in place.times[:2]]
            said.append("Most at " + ", ".join(listed) + ".")
    if place.frequencies:
        listed = [f"{omega:.4g}" for omega, _ in place.frequencies[:3]]
        said.append(f"Most at the angular frequenc{'y' if len(listed) == 1 else 'ies'} {', '.join(listed)}.")
    return said or ["Nowhere in particular."]


# Words ----------------------------------------------------------------------------------------------------------------------------


def sentence(diagnosis: Diagnosis) -> str:
    """Say the verdict in one sentence."""
    course = diagnosis.course
    if course.verdict == "nothing missing":
        return "Nothing is missing: what the equation leaves cannot be told from noise."
    if course.verdict == "unexplained":
        return "Something is missing, but nothing in the catalogue explains it."
    names = [
        one.effect + (f" (or {', '.join(one.indistinguishable)})" if one.indistinguishable else "")
        for one in added(diagnosis)
    ]
    listed = " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]
    if course.verdict == "explained":
        return f"What the equation lacks: {listed}. With {'it' if len(names) == 1 else 'them'}, nothing significant is left."
    return f"What the equation lacks: {listed}. Something more is left that nothing in the catalogue explains."


def strays(samples: Samples) -> list[str]:
    """Say which readings are so far from all others of their site that they can hardly be of the motion."""
    found = []
    for letter, field in (("u", samples.u), ("v", samples.v)):
        for site, column in enumerate(() if field is None else field.T):
            seen = np.flatnonzero(np.isfinite(column))
            if len(seen) < 5:
                continue
            away = np.abs(column[seen] - np.median(column[seen].real) - 1j * np.median(column[seen].imag))
            row, others = seen[np.argmax(away)], np.sort(away)[:-1]
            if np.max(away) > STRAY * others[-1] > 0:
                found.append(
                    f"{samples.source}: {letter}{site + 1} at t = {samples.t[row]:g} is {column[row]:.4g}, more than {STRAY:g} times as "
                    "far out as any other reading of that site. If it is a slip, leave the cell empty."
                )
    return found


def notes(diagnosis: Diagnosis) -> list[str]:
    """Say what else a reader should know."""
    course = diagnosis.course
    found = [text for samples in course.before.data for text in strays(samples)]
    steps = []
    for samples in course.after.data:
        values = (
            np.concatenate([samples.u.real.ravel(), samples.u.imag.ravel()])
            if samples.is_complex
            else samples.u.ravel()
        )
        steps.append(step_of(values))
    step = min(steps)
    share = step**2 / 12 / float(diagnosis.noise[0]) ** 2
    if step and share > ROUNDING:
        size = f"{100 * share:.2g} %" if share < 1 else "all"
        found.append(f"The readings are multiples of {step:.4g}: rounding alone makes {size} of the noise's variance.")
    used, recorded = diagnosis.used
    if used < recorded:
        found.append(
            f"Of {recorded} sample times {used} were looked at: the record is sampled more densely than it moves, or very long."
        )
    kept = {change.effect.name for change in course.after.model.changes}
    gone = list(dict.fromkeys(one.added for one in course.rounds if one.added and one.added not in kept))
    if gone:
        found.append(f"Added in a round and taken away again, since later ones do without: {', '.join(gone)}.")
    for fitted, name in ((course.before, "declared equation"), (course.after, "last model")):
        pieces, whole = len(fitted.data), len(over_noise(fitted, diagnosis))
        if pieces > whole and (fitted is course.after or course.after.model.changes):
            found.append(
                f"The {name} is followed in {pieces} pieces of at most {max(len(one.t) for one in fitted.data)} samples, each from a "
                "start of its own: over longer ones it loses the readings."
            )
    if not course.after.solution.converged:
        found.append("The last fit's steps did not end: its numbers are less sure than their standard errors say.")
    if any(len(record.stretches.dynamics.border) for record in course.after.records):
        found.append("The chain's ends were not declared: sites at both ends are taken as given and have no equation.")
    unnamed = [one for one in course.left if not one.named]
    if unnamed and course.verdict in ("unexplained", "partly explained"):
        listed = ", ".join(
            one.name + ("" if one.change.site is None else f" (site {one.change.site + 1})") for one in unnamed[:3]
        )
        found.append(f"What would do most for what is left, though it is no effect of the catalogue: {listed}.")
    found += [
        f"{name} was added more than once: a few of them can stand for any course in time, so that the name is in doubt."
        for name in course.repeated
    ]
    if course.rival is not None:
        found.append(
            f"{course.rival[0]} does {'better' if course.rival[1] > EQUAL else 'as well'} in the place of the last effect (by {course.rival[1]:.1f}, natural "
            "logarithms of the likelihood ratio), though it is no effect of the catalogue: the name is in doubt."
        )
    clock = [change for change in course.after.model.changes if change.effect.acts == "clock"]
    if clock:
        found.append(
            "How late a row to come will be read cannot be known: the forecast is for the times as they are told."
        )
    return found


# What cannot be told apart --------------------------------------------------------------------------------------------------------


def separation(one: Effect, other: Effect, order: int, is_complex: bool) -> str:
    """Say which measurement would tell two effects apart, from how they act and how their terms grow."""
    first, second = one.name, other.name
    if (one.acts in INSTRUMENT) != (other.acts in INSTRUMENT):
        reading = one if one.acts in INSTRUMENT else other
        if reading.acts == "clock":
            return "a recording by a second clock: it shows the same motion, but not the same faults of time"
        if reading.acts == "rounding":
            return "a recording with a finer step: rounding goes, physics stays"
        return "the same motion read by other sensors, or by these at other sites: a fault goes with the sensor, physics stays with the site"
    local = ("one site", "one equation", "offset", "gain", "every site")
    if (one.acts in local) != (other.acts in local):
        return "a motion that is large elsewhere in the chain: what sits at one site is felt only there"
    if {one.acts, other.acts} == {"one site", "one equation"}:
        return "waves of other lengths: another mass answers all forces of its site differently, a defect only the one on the site itself"
    timed = ("harmonic", "pulse")
    if (one.acts in timed) != (other.acts in timed) or (one.acts != other.acts and one.acts in timed):
        return "another recording, begun at another time: what is driven from outside keeps its own time, whatever the chain does"
    if "ends" in (one.acts, other.acts):
        return "a motion far from the ends, and one at the ends"
    if "delayed" in (one.acts, other.acts):
        return "a motion of other frequencies: a lag turns into another phase at each of them"
    traits = [_traits(effect, order, is_complex) for effect in (one, other)]
    powers = [trait.power for trait in traits]
    if None not in powers and powers[0] != powers[1]:
        low, high = sorted(((powers[0], first), (powers[1], second)))
        return f"swings of another size: {low[1]} grows {_power(low[0])}, {high[1]} {_power(high[0])}"
    if traits[0].place != traits[1].place:
        return "a motion near the middle of the chain, and one far from it"
    if traits[0].velocity != traits[1].velocity:
        return "swings of the same size at another frequency: what acts on the velocity grows with it"
    if traits[0].input != traits[1].input:
        return "a recording without the input, or with another one"
    if traits[0].reach != traits[1].reach or traits[0].neighbours != traits[1].neighbours:
        return "waves of other lengths: what couples neighbours depends on it"
    return "a longer recording, less noise, or another initial state"


@dataclass(frozen=True)
class _Traits:
    """How a term grows: with which power of the field (None: with no single one), and what it sees."""

    power: float | None
    velocity: bool
    place: bool
    input: bool
    neighbours: bool
    reach: int


@cache
def _traits(effect: Effect, order: int, is_complex: bool) -> _Traits:
    from latticebench.systems.stencil import evaluate

    texts = effect.texts(order, is_complex) or (effect.formula or effect.complex_field or "1",)
    term = Term(texts[0])
    draw = np.random.default_rng(1)
    u, v = draw.normal(size=(2, 3, 24)) + (1j * draw.normal(size=(2, 3, 24)) if is_complex else 0)
    f, t = draw.normal(size=(3, 24)), np.arange(3.0)
    power: float | None
    with np.errstate(all="ignore"):
        small, large = (evaluate([term], k * u, k * v, k * f, t, ends="periodic") for k in (1.0, 2.0))
        ratio = np.log2(np.abs(large / small))
    ratio = ratio[np.isfinite(ratio)]
    power = round(float(np.mean(ratio)), 3) if len(ratio) and np.ptp(ratio) < 1e-6 else None
    fields = {name for name, _ in term.sites}
    far = max(term.reach) + (8 if effect.acts == "long range" else 0)
    return _Traits(power, "v" in fields, "n" in term.names, "f" in fields, far > 0, far)


def _power(power: float | None) -> str:
    named = {0.0: "not at all with the size", 1.0: "as the size", 2.0: "as its square", 3.0: "as its cube"}
    return named.get(power or 0.0, f"as its power {power:g}")


def separations(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """List each added effect, one that cannot be told from it, and what would separate them."""
    course = diagnosis.course
    samples = course.after.data[0]
    effects = {entry.name: entry.finding.change.effect for one in course.rounds for entry in one.ranking}
    effects |= {change.effect.name: change.effect for change in course.after.model.changes}
    found = []
    for change, equal in zip(course.after.model.changes, course.equal, strict=True):
        for name in equal:
            said = separation(change.effect, effects[name], course.after.model.order, samples.is_complex)
            found.append((change.effect.name, name, said))
    return found


# The equation ---------------------------------------------------------------------------------------------------------------------


def equation(fitted: Fitted, digits: int = 4) -> list[str]:
    """Write a fitted equation as lines of text: the right-hand side, then what acts at single sites and on the readings."""
    texts, values = [], []
    for _, text, value in everywhere(fitted):
        texts.append(text)
        values.append(value)
    return [f"u{chr(39) * fitted.model.order} = {side(texts, values, digits)}", *elsewhere(fitted, digits)]


def everywhere(fitted: Fitted) -> list[tuple[Change | None, str, float]]:
    """Give the terms that act at every site: the effect (None for a declared term), a text, the coefficient."""
    values = [float(value) for value in fitted.solution.state.coefficients]
    count = len(fitted.model.declared.terms)
    found: list[tuple[Change | None, str, float]] = [
        (None, text, value) for text, value in zip(fitted.model.declared.texts, values[:count], strict=True)
    ]
    for change, block in zip(fitted.model.changes, _blocks(fitted), strict=True):
        if change.effect.acts not in ("one site", "every site"):
            found += [
                (change, _text(change, label), value)
                for label, value in zip(_labels(change, fitted), values[block], strict=True)
            ]
    return found


def _text(change: Change, label: str) -> str:
    """Write a label so that it can stand in a product."""
    lead = "i*" if label.startswith("i*") else ""
    if change.effect.acts == "delayed":
        return f"{lead}u[n](t-{change.psi['delay']:.4g})"
    if change.effect.acts == "long range":
        return f"{lead}sum((u[n+r]+u[n-r]-2*u[n])/r**{change.psi['s']:.3g}, r>=2)"
    return label


def elsewhere(fitted: Fitted, digits: int = 4) -> list[str]:
    """Say what acts at single sites, at the ends and on the readings: one line each."""
    said = []
    values = fitted.solution.state.coefficients
    is_complex = fitted.data[0].is_complex
    for change, block in zip(fitted.model.changes, _blocks(fitted), strict=True):
        acts, psi = change.effect.acts, change.psi
        if acts == "one site" and change.site is not None:
            own = side(list(change.texts), [float(value) for value in values[block]], digits)
            said.append(f"site {change.site + 1} alone has {own} besides")
        elif acts == "every site":
            each = np.reshape(values[block], (len(change.texts), -1))
            named = " and ".join(change.texts)
            if change.psi.get("whole"):
                about = f"mean {np.mean(each):.3g}, standard deviation {np.std(each):.3g}"
            else:
                each = np.concatenate([each, -np.sum(each, axis=1, keepdims=True)], axis=1)
                about = f"deviations from their mean, which belongs to {named} itself; standard deviation {np.std(each):.3g}"
            said.append(f"every site has {named} besides, with a coefficient of its own: {about}")
        elif acts == "one equation" and change.site is not None:
            factor = 1 + psi["scale"]
            said.append(
                f"site {change.site + 1}: its whole right-hand side is multiplied by {factor:.{digits}g} "
                f"(a mass of {1 / factor:.{digits}g} times the others')"
            )
        elif acts == "ends":
            said.append(f"the ends are {change.ends}")
        elif acts == "rounding":
            said.append(f"readings are rounded to multiples of {psi['step']:.{digits}g}")
        elif acts in INSTRUMENT and len(change.free) <= LISTED:
            said += [f"{_reading(change, name, is_complex)}: {psi[name]:.{digits}g}" for name in change.free]
        elif acts in INSTRUMENT:
            size = float(np.sqrt(np.mean([psi[name] ** 2 for name in change.free])))
            said.append(f"{acts} of every {'row' if acts == 'clock' else 'site'}: {size:.{digits}g} (RMS)")
    return said


# The table of errors --------------------------------------------------------------------------------------------------------------


def errors(diagnosis: Diagnosis) -> list[tuple[str, str, str]]:
    """Give the table of errors before and after, as texts."""

    def share(value: float) -> str:
        if math.isnan(value):
            return "-"
        return f"{100 * value:.3g} %" if value < DIVERGED else "diverges"

    rows = [
        ("residual over the noise", *(f"{value:.3g}" for value in diagnosis.residual)),
        ("share of the derivative that is left", *(share(value) for value in diagnosis.dynamics)),
        ("forecast error on held-out data", *(share(value) for value in diagnosis.forecast)),
        ("information criterion (lower is better)", *(f"{value:.1f}" for value in diagnosis.criterion)),
    ]
    if diagnosis.coefficients is not None:
        rows.append(("error of the declared coefficients", *(share(value) for value in diagnosis.coefficients)))
    return [(one[0], one[1], one[2]) for one in rows]


def top(one: Round) -> list[Candidate]:
    """Pick the entries of a ranking that people are shown: the best few, and the best without a name if it is not among them."""
    best = list(one.ranking[:SHOWN])
    if not any(entry.finding.named for entry in best):
        best += [entry for entry in one.ranking if entry.finding.named][:2]
    return best


def chance(p: float) -> str:
    """Write a p-value; one too small for a number is said to be below the smallest that there is."""
    return f"{p:.1g}" if p > 1e-300 else "< 1e-300"


def show(diagnosis: Diagnosis) -> None:
    """Print a diagnosis."""
    from latticebench.bench.screen import console, show_rows

    screen = console()

    def say(text: str, style: str = "") -> None:
        screen.print(text, style=style, highlight=False, markup=False, soft_wrap=True)

    course = diagnosis.course
    say(sentence(diagnosis), "bold")
    say(f"\nnoise: {total_noise(diagnosis):.3g}")
    for name, fitted in (("declared", course.before), ("with what was found", course.after)):
        if name == "declared" or course.after.model.changes:
            first, *rest = equation(fitted)
            say(f"{name}: {first}")
            for line in rest:
                say(f"    {line}")
    effects = added(diagnosis)
    if effects:
        say("\nEffects", "bold")
        rows = []
        for effect in effects:
            numbers = {
                **{k: v for k, v in effect.parameters.items() if k not in ("open", "reach")},
                **effect.coefficients,
            }
            for name, value in list(numbers.items())[: LISTED + 2]:
                rows.append([effect.effect, name, _short(value), _short(effect.stderr.get(name))])
            if len(numbers) > LISTED + 2:
                rows.append([effect.effect, f"... and {len(numbers) - LISTED - 2} more", "", ""])
        show_rows(["effect", "what", "value", "standard error"], rows)
    for number, turn in enumerate(course.rounds, start=1):
        say(f"Round {number}: {'added ' + turn.added if turn.added else 'nothing added'}", "bold")
        entries = [
            [entry.name if entry.finding.named else f"(no name) {entry.name}", f"{entry.evidence:.1f}", chance(entry.p)]
            for entry in top(turn)
        ]
        show_rows(["effect", "evidence", "p"], entries)
    for first, second, said in separations(diagnosis):
        say(f"{first} cannot be told from {second} here. What would separate them: {said}.")
    show_rows(["error", "before", "after"], [list(row) for row in errors(diagnosis)])
    before, _ = declared(course.before)
    after, spread = declared(course.after)
    table = [[text, f"{before[text]:.6g}", f"{after[text]:.6g}", f"{spread[text]:.2g}"] for text in after]
    columns = ["declared term", "before", "after", "standard error"]
    if diagnosis.truth is not None:
        columns.append("truth")
        table = [[*row, f"{value:.6g}"] for row, value in zip(table, diagnosis.truth, strict=True)]
    show_rows(columns, table)
    say("Where the residual of the declared equation lives", "bold")
    for line in living(whereabouts(course.before, diagnosis)):
        say(line)
    if course.left and course.after.model.changes:
        say("Where the residual that is left lives", "bold")
        for line in living(whereabouts(course.after, diagnosis)):
            say(line)
    for line in notes(diagnosis):
        say(line, "dim")


def _short(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@contextmanager
def watching() -> Iterator[Watcher]:
    """Show on a terminal what is being done and for how long, on standard error."""
    import sys

    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    # How many effects will be fitted is not known beforehand: the bar only moves.
    columns = (BarColumn(bar_width=24), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("starting", total=None)
        yield lambda text: progress.update(task, description=escape(text))
