"""The content of a diagnosis: all that its text, its JSON document and its page say.

Residuals are in units of the noise, frequencies are angular ones (as in cos(omega*t)), sites are counted from 1.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Literal, cast

import numpy as np
import pydantic

from latticebench.bench.report.document import Content, Document, Number, Pair, Provenance
from latticebench.bench.report.equation import Equation, equation
from latticebench.bench.report.findings import AddedEffect, added, declared
from latticebench.bench.report.horizons import HorizonReport, horizons
from latticebench.bench.report.modes import Modes, modes
from latticebench.bench.report.noise import SensorNoise, noise_in_numbers, noise_in_words
from latticebench.bench.report.notes import notes
from latticebench.bench.report.separation import Separation, separations
from latticebench.bench.report.shown import Shown
from latticebench.bench.report.units import Units, in_sentence, of_coefficients, units_of
from latticebench.bench.report.whereabouts import Whereabouts, whereabouts
from latticebench.diagnosis.instrument import step_of, two_digits
from latticebench.diagnosis.repair import NOT_FOLLOWED, NOT_REACHED, shortfalls
from latticebench.methods.engine.dynamics import split_parts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from latticebench.bench.overlay import Overlay
    from latticebench.diagnosis.acting import Chain
    from latticebench.diagnosis.fitting import Fitted
    from latticebench.diagnosis.noise import Noise
    from latticebench.diagnosis.repair import Diagnosis

# A model that leaves less than so many times the noise comes down to it.
REACHED = 1.05
Verdict = Literal["nothing missing", "explained", "partly explained", "unexplained"]


class RecordingSummary(Content):
    """What was looked at.

    Attributes:
        sources: the files.
        sites: the length of the chain.
        rows: sample times that were fitted; a dense record may have been thinned.
        trajectories: how many there are.
        field: "real" or "complex".
        ends: how the chain ends.
        units: of times, readings and the equation.
    """

    sources: tuple[str, ...]
    sites: int
    rows: int
    trajectories: int
    field: Literal["real", "complex"]
    ends: str
    units: Units


class Errors(Content):
    """Errors before and after.

    Attributes:
        residual: of the fit, in units of the noise.
        rms: of the fit, in the units of the readings.
        forecast: of held-out readings, relative.
        forecast_by_noise: the forecast error if only the noise of these readings were left, relative.
        coefficients: of the declared coefficients, relative; None where the truth is not known.
        criterion: the Bayesian information criterion less that of the declared equation.
        dynamics: the share of the derivative that the equation leaves.
    """

    residual: Pair
    rms: Pair
    forecast: Pair
    forecast_by_noise: Number = math.nan
    coefficients: Pair | None
    criterion: Pair
    dynamics: Pair


class Where(Content):
    """Where the residual lives, before and after."""

    before: Whereabouts
    after: Whereabouts


class Equations(Content):
    """The declared equation with its coefficients, and the one with what was found."""

    before: Equation
    after: Equation


class Left(Content):
    """Something without a name: significant in the last residual, or better than effects that were named.

    Attributes:
        effect: what it is.
        site: where it acts (from 1), if at one site.
        gain: natural logarithm of how much likelier it can make the readings, by a score test; in the place of effects,
            by how many nats it is better.
        price: what chance alone may gain, or by how many nats it must be better.
        instead: the named effects in whose place it does better; none for what is in the residual.
    """

    effect: str
    site: int | None
    gain: Number
    price: Number
    instead: tuple[str, ...] = ()


class Report(Content):
    """A diagnosis as people and programs see it.

    Attributes:
        sentence: the verdict in one sentence.
        partly: why what is named explains only a part, see `latticebench.diagnosis.repair.shortfalls`.
        declared, declared_stderr: coefficients of the declared terms in the last model, with standard errors.
        declared_before, declared_stderr_before: the same in the declared equation alone.
        declared_truth: their true values, or None.
        noise: root mean square of what the last model leaves of each sensor, or where that is more than noise, the
            readings' own noise; in the units of the readings, of each part of a complex one.
        noise_lines: the noise in words.
        sensors: the parts of the noise of each sensor; empty in a document of a version that did not say them.
        effects: what was added.
        separations: what cannot be told apart, and what would separate it.
        modes: eigenfrequencies and decay rates beside the peaks of the recording's spectrum.
        horizons: how the search went.
        left: what is significant in the last residual.
        interrupted: whether the search was stopped; this is then what was known after the last of `horizons`.
        declared_units: units of the declared coefficients; "" where one is not known, empty where none is.
    """

    verdict: Verdict
    sentence: str
    recording: RecordingSummary
    declared: dict[str, Number]
    declared_before: dict[str, Number]
    declared_stderr: dict[str, Number]
    declared_stderr_before: dict[str, Number]
    declared_truth: dict[str, Number] | None
    noise: dict[str, Number]
    noise_lines: tuple[str, ...]
    effects: tuple[AddedEffect, ...]
    separations: tuple[Separation, ...]
    equation: Equations
    modes: Modes
    horizons: tuple[HorizonReport, ...]
    error: Errors
    where: Where
    left: tuple[Left, ...]
    notes: tuple[str, ...]
    interrupted: bool
    partly: tuple[str, ...] = ()
    declared_units: dict[str, str] = {}
    sensors: dict[str, SensorNoise] = {}


class DiagnosisDocument(Report, Document):
    """A diagnosis, see `latticebench diagnose`.

    Attributes:
        shown: what `latticebench plot` draws of it; None in a document of a version that did not draw.
    """

    schema_: Literal["latticebench/diagnosis/2"] = pydantic.Field(
        default="latticebench/diagnosis/2", validation_alias="schema", serialization_alias="schema"
    )
    shown: Shown | None = None


def content(diagnosis: Diagnosis, *, interrupted: bool = False) -> Report:
    """Return the content of a diagnosis, or of what was known when it was interrupted."""
    before, before_errors = declared(diagnosis.before)
    after, after_errors = declared(diagnosis.after)
    units = units_of(diagnosis.data[0].origin)
    found, chain = added(diagnosis), diagnosis.after.chain
    own = of_coefficients(diagnosis.after.model.declared.terms, chain.order, units)
    size = abs(units.scale)
    sensors = [f"{letter}{site + 1}" for letter in "uv"[: chain.levels] for site in range(chain.sites)]
    return Report(
        verdict=cast(Verdict, diagnosis.verdict),
        sentence=_interrupted(found) if interrupted else _sentence(diagnosis, found), recording=_recording(diagnosis),
        declared=after, declared_before=before, declared_stderr=after_errors, declared_stderr_before=before_errors,
        declared_truth=None if diagnosis.truth is None else dict(zip(after, map(float, diagnosis.truth), strict=True)),
        noise=dict(zip(sensors, map(float, diagnosis.noise / size), strict=True)),
        noise_lines=_noise_lines(diagnosis, units),
        effects=found, separations=separations(diagnosis),
        equation=Equations(
            before=_equation(diagnosis.before, chain, units), after=_equation(diagnosis.after, chain, units)
        ),
        modes=modes(diagnosis), horizons=horizons(diagnosis), error=_errors(diagnosis, size),
        where=Where(before=whereabouts(diagnosis.before, diagnosis), after=whereabouts(diagnosis.after, diagnosis)),
        left=tuple(
            Left(effect=one.name, site=None if one.site is None else one.site + 1, gain=one.gain, price=one.price,
                 instead=one.instead)
            for one in diagnosis.left
        ),
        notes=notes(diagnosis), interrupted=interrupted, partly=shortfalls(diagnosis),
        declared_units=dict(zip(after, own, strict=bool(own))),
        sensors=dict(zip(sensors, _sensors(diagnosis, units), strict=True)),
    )  # fmt: skip


def diagnosis_document(report: Report, about: Provenance, overlay: Overlay | None = None) -> DiagnosisDocument:
    """Return the document of a diagnosis, with what is drawn of it."""
    said = {name: getattr(report, name) for name in Report.model_fields}
    return DiagnosisDocument(provenance=about, shown=None if overlay is None else Shown.of(overlay), **said)


def _sentence(diagnosis: Diagnosis, found: tuple[AddedEffect, ...]) -> str:
    """Return the verdict in words."""
    if diagnosis.verdict == "nothing missing":
        return "Nothing is missing: what the equation leaves cannot be told from noise."
    if diagnosis.verdict == "unexplained":
        return "Something is missing, but nothing in the catalogue explains it."
    every = [
        one.effect + (f" (or {', '.join(one.indistinguishable)})" if one.indistinguishable else "") for one in found
    ]
    names = [f"{name} ({every.count(name)} times)" if every.count(name) > 1 else name for name in dict.fromkeys(every)]
    said = [f"What the equation lacks: {_listed(names)}."]
    rivals = [one for one in diagnosis.left if one.instead]
    if rivals:
        best = rivals[0]
        where = "" if best.site is None else f" at site {best.site + 1}"
        said.append(
            f"Something without a name, {best.name}{where}, does better in the place of {_listed(best.instead)}."
        )
    short = shortfalls(diagnosis)
    lost = NOT_REACHED in short
    if len(rivals) < len(diagnosis.left):
        size = "" if lost else f"; in all, the model leaves {diagnosis.residual[1]:.3g} times the noise"
        if diagnosis.residual[1] < REACHED:
            size = f"; it is small: in all, the model leaves {diagnosis.residual[1]:.3g} times the noise"
        said.append(f"Something more is left that nothing in the catalogue explains{size}.")
    elif diagnosis.whole and not rivals:
        them = "it" if len(every) == 1 else "them"
        said.append(f"With {them}, nothing significant is left.")
    if NOT_FOLLOWED in short:
        said.append(
            f"Even so, it is followed over pieces of {diagnosis.after.longest} samples only: over longer ones it loses "
            "the readings, so the names are in doubt."
        )
    if lost:
        said.append(
            f"The model does not reach the readings: it leaves {two_digits(diagnosis.residual[1])} times their noise."
        )
    return " ".join(said)


def _interrupted(found: tuple[AddedEffect, ...]) -> str:
    """Return what was known when the search was stopped; what is missing, or left, was not known yet."""
    names = _listed([one.effect for one in found]) if found else "nothing"
    return f"Interrupted: this is what was known after the last horizon. Named by then: {names}."


def _listed(names: Sequence[str], last: str = "and") -> str:
    return f" {last} ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]


def _recording(diagnosis: Diagnosis) -> RecordingSummary:
    data = diagnosis.data
    return RecordingSummary(
        sources=tuple(dict.fromkeys(samples.source for samples in data)), sites=data[0].sites,
        rows=sum(len(samples.t) for samples in data), trajectories=len(data),
        field="complex" if data[0].is_complex else "real", ends=data[0].ends, units=units_of(data[0].origin),
    )  # fmt: skip


def _noise_lines(diagnosis: Diagnosis, units: Units) -> tuple[str, ...]:
    """Return the noise in words, in the unit of the readings where it is known."""
    if not units.reading and units.scale == 1:
        return diagnosis.noise_lines
    first, noise, interval = diagnosis.data[0], _read(diagnosis), _interval(diagnosis)
    fields = [first.u] if len(noise.size) == first.sites or first.v is None else [first.u, first.v]
    steps = [step_of(split_parts(one[:, k], first.is_complex).ravel()) for one in fields for k in range(first.sites)]
    return tuple(noise_in_words(noise, steps, interval, first.sites, units, _span(diagnosis)))


def _sensors(diagnosis: Diagnosis, units: Units) -> tuple[SensorNoise, ...]:
    """Return the noise of each sensor in numbers."""
    return noise_in_numbers(_read(diagnosis), units, _span(diagnosis), _interval(diagnosis))


def _read(diagnosis: Diagnosis) -> Noise:
    """Return the noise of the last model; its size is NaN for sensors that were not read."""
    found = diagnosis.after.noise
    return replace(found, size=np.where(np.isnan(diagnosis.noise), np.nan, found.size))


def _interval(diagnosis: Diagnosis) -> float:
    """Return the usual time from one reading to the next."""
    return float(np.median(np.diff(diagnosis.data[0].t)))


def _span(diagnosis: Diagnosis) -> float:
    """Return the length of the longest recording."""
    return max(float(one.t[-1] - one.t[0]) for one in diagnosis.data)


def _equation(fitted: Fitted, chain: Chain, units: Units) -> Equation:
    """Return the equation of a fitted model, with units in its sentences."""
    found = equation(fitted.model, chain)
    return found.model_copy(update={"elsewhere": tuple(in_sentence(line, units) for line in found.elsewhere)})


def _errors(diagnosis: Diagnosis, size: float) -> Errors:
    """Return the errors; `size` is what one unit of a reading is in the equation."""

    def pair(values: tuple[float, float]) -> Pair:
        return Pair(before=values[0], after=values[1])

    before, after = diagnosis.rms
    return Errors(
        residual=pair(diagnosis.residual), rms=pair((before / size, after / size)), forecast=pair(diagnosis.forecast),
        forecast_by_noise=diagnosis.forecast_by_noise,
        coefficients=None if diagnosis.coefficients is None else pair(diagnosis.coefficients),
        criterion=pair(diagnosis.criterion), dynamics=pair(diagnosis.dynamics),
    )  # fmt: skip
