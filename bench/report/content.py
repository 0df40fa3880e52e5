"""The content of a diagnosis: all that its text, its JSON document and its page say.

Residuals are in units of the noise, frequencies are angular ones (as in cos(omega*t)), sites are counted from 1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, cast

import pydantic

from latticebench.bench.report.document import Content, Document, Number, Pair, Provenance
from latticebench.bench.report.equation import Equation, equation
from latticebench.bench.report.findings import AddedEffect, added, declared
from latticebench.bench.report.notes import notes
from latticebench.bench.report.separation import Separation, separations
from latticebench.bench.report.whereabouts import Whereabouts, scaled_residuals, whereabouts

if TYPE_CHECKING:
    from latticebench.diagnosis.repair import Diagnosis
    from latticebench.diagnosis.search import Round

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
    """

    sources: tuple[str, ...]
    sites: int
    rows: int
    trajectories: int
    field: Literal["real", "complex"]
    ends: str


class Ranked(Content):
    """An entry of a ranking: its evidence (natural logarithm), its p-value, and whether it is in the catalogue."""

    effect: str
    evidence: Number
    p: float = pydantic.Field(ge=0, le=1)
    named: bool


class Turn(Content):
    """A round: the effect that was added, those that explain as much, and all that was tried, the best first."""

    added: str | None
    equal: tuple[str, ...]
    ranking: tuple[Ranked, ...]


class Errors(Content):
    """Errors before and after.

    Attributes:
        residual: of the fit, in units of the noise.
        forecast: of held-out readings, relative.
        coefficients: of the declared coefficients, relative; None where the truth is not known.
        criterion: the Bayesian information criterion less that of the declared equation.
        dynamics: the share of the derivative that the equation leaves.
    """

    residual: Pair
    forecast: Pair
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
    """Something that is significant in the last residual."""

    effect: str
    p: float
    named: bool


class Rival(Content):
    """What has no name and does as well in the place of the last effect, and by how much (natural logarithm)."""

    name: str
    lead: Number


class Report(Content):
    """A diagnosis as people and programs see it.

    Attributes:
        sentence: the verdict in one sentence.
        declared, declared_stderr: coefficients of the declared terms in the last model, with standard errors.
        declared_before, declared_stderr_before: the same in the declared equation alone.
        declared_truth: their true values, or None.
        noise: standard deviation of the noise on u, of a complex field in total.
        effects: what was added.
        separations: what cannot be told apart, and what would separate it.
        rounds: what was tried.
        left: what is significant in the last residual.
    """

    verdict: Verdict
    sentence: str
    recording: RecordingSummary
    declared: dict[str, Number]
    declared_before: dict[str, Number]
    declared_stderr: dict[str, Number]
    declared_stderr_before: dict[str, Number]
    declared_truth: dict[str, Number] | None
    noise: Number
    effects: tuple[AddedEffect, ...]
    separations: tuple[Separation, ...]
    equation: Equations
    rounds: tuple[Turn, ...]
    error: Errors
    where: Where
    left: tuple[Left, ...]
    rival: Rival | None
    notes: tuple[str, ...]


class DiagnosisDocument(Report, Document):
    """A diagnosis, see `latticebench diagnose`."""

    schema_: Literal["latticebench/diagnosis/1"] = pydantic.Field(
        default="latticebench/diagnosis/1", validation_alias="schema", serialization_alias="schema"
    )


def content(diagnosis: Diagnosis) -> Report:
    """Return the content of a diagnosis."""
    course = diagnosis.course
    before, before_errors = declared(course.before)
    after, after_errors = declared(course.after)
    found = added(diagnosis)
    return Report(
        verdict=cast(Verdict, course.verdict), sentence=_sentence(course.verdict, found),
        recording=_recording(diagnosis),
        declared=after, declared_before=before, declared_stderr=after_errors, declared_stderr_before=before_errors,
        declared_truth=None if diagnosis.truth is None else dict(zip(after, map(float, diagnosis.truth), strict=True)),
        noise=diagnosis.noise[0] * course.after.records[0].value.shape[2] ** 0.5,
        effects=found, separations=separations(diagnosis),
        equation=Equations(before=equation(course.before), after=equation(course.after)),
        rounds=tuple(_turn(one) for one in course.rounds), error=_errors(diagnosis),
        where=Where(before=whereabouts(course.before, diagnosis), after=whereabouts(course.after, diagnosis)),
        left=tuple(Left(effect=one.name, p=one.p, named=one.named) for one in course.left),
        rival=None if course.rival is None else Rival(name=course.rival[0], lead=course.rival[1]),
        notes=notes(diagnosis),
    )  # fmt: skip


def diagnosis_document(report: Report, about: Provenance) -> DiagnosisDocument:
    """Return the document of a diagnosis."""
    return DiagnosisDocument(provenance=about, **{name: getattr(report, name) for name in Report.model_fields})


def _sentence(verdict: str, found: tuple[AddedEffect, ...]) -> str:
    """Return the verdict in one sentence."""
    if verdict == "nothing missing":
        return "Nothing is missing: what the equation leaves cannot be told from noise."
    if verdict == "unexplained":
        return "Something is missing, but nothing in the catalogue explains it."
    names = [
        one.effect + (f" (or {', '.join(one.indistinguishable)})" if one.indistinguishable else "") for one in found
    ]
    listed = " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]
    if verdict == "explained":
        them = "it" if len(names) == 1 else "them"
        return f"What the equation lacks: {listed}. With {them}, nothing significant is left."
    return f"What the equation lacks: {listed}. Something more is left that nothing in the catalogue explains."


def _recording(diagnosis: Diagnosis) -> RecordingSummary:
    data = diagnosis.course.after.data
    return RecordingSummary(
        sources=tuple(dict.fromkeys(samples.source for samples in data)), sites=data[0].sites,
        rows=sum(len(samples.t) for samples in data),
        trajectories=len(scaled_residuals(diagnosis.course.after, diagnosis)),
        field="complex" if data[0].is_complex else "real", ends=data[0].ends,
    )  # fmt: skip


def _turn(one: Round) -> Turn:
    ranking = [
        Ranked(effect=entry.name, evidence=entry.evidence, p=entry.p, named=entry.screened.named)
        for entry in one.ranking
    ]
    return Turn(added=one.added, equal=one.equal, ranking=tuple(ranking))


def _errors(diagnosis: Diagnosis) -> Errors:
    def pair(values: tuple[float, float]) -> Pair:
        return Pair(before=values[0], after=values[1])

    return Errors(
        residual=pair(diagnosis.residual), forecast=pair(diagnosis.forecast),
        coefficients=None if diagnosis.coefficients is None else pair(diagnosis.coefficients),
        criterion=pair(diagnosis.criterion), dynamics=pair(diagnosis.dynamics),
    )  # fmt: skip
