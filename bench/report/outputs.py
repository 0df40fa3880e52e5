"""The JSON documents of a fit, a bound, a run, a comparison and a list; that of a diagnosis is in `content`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Field, JsonValue

from latticebench.bench.report.document import Content, Document, Number, Provenance
from latticebench.bench.report.shown import Shown
from latticebench.bench.report.units import Units, of_coefficients

if TYPE_CHECKING:
    from latticebench.bench.adequacy import Adequacy
    from latticebench.bench.against import Contest
    from latticebench.bench.bounds import BoundOf
    from latticebench.bench.compare import Comparison
    from latticebench.bench.inspection import Inspection
    from latticebench.bench.limit import Design, Limit
    from latticebench.bench.overlay import Overlay
    from latticebench.methods.method import Fit

# pandas has NaN where a text or a truth value is missing.
Text = Annotated[str | None, BeforeValidator(lambda value: None if value != value else value)]
Words = Annotated[str, BeforeValidator(lambda value: "" if value != value else value)]
Flag = Annotated[bool | None, BeforeValidator(lambda value: None if value != value else value)]


class Quality(Content):
    """How well an equation fits, see `bench.adequacy.Adequacy`."""

    work: Number
    r2: Number
    times: Number
    fits: bool


class FitDocument(Document):
    """A fit, see `latticebench fit`.

    Attributes:
        coefficients: by term, in the units of the derivative over those of the term.
        stderr: standard errors by term; None where the method gives none.
        residual: RMS of what the equation leaves of the derivative over the RMS of the derivative.
        seconds: wall time of the fit alone.
        status: "ok", or what to know about the fit.
        quality: how well the equation describes the readings.
        warnings: what has to be known before a number is used; empty where the equation fits.
        units: of times, readings and the equation.
        shown: what `latticebench plot` draws of it; None in a document of a version that did not draw.
        coefficient_units: of the coefficients by term; "" where one is not known, empty where none is.
    """

    schema_: Literal["latticebench/fit/1"] = Field(
        default="latticebench/fit/1", validation_alias="schema", serialization_alias="schema"
    )
    method: str
    order: int
    coefficients: dict[str, Number]
    stderr: dict[str, Number] | None
    residual: Number
    seconds: Number
    status: str
    quality: Quality
    warnings: list[str]
    units: Units
    shown: Shown | None = None
    coefficient_units: dict[str, str] = {}


class TermLimit(Content):
    """How well a coefficient can be known: smallest standard error, the same relative, and what follows from it."""

    coefficient: Number
    stderr: Number
    error: Number
    verdict: str


class Needed(Content):
    """What a wanted relative error of the coefficients needs; see `bench.limit.Design`."""

    target: Number
    relative: Number
    noise: Number
    samples: int | None
    span: Number | None
    records: int


class LimitDocument(Document):
    """The Cramer-Rao bound, see `latticebench limit`.

    Attributes:
        about: where the bound was taken.
        noise: the noise level, sigma over the RMS of the field about its mean.
        samples, span: how many samples in all trajectories, and how long the longest lasts.
        conditioning: of the terms' values, columns scaled to 1.
        relative: the smallest root-mean-square of E2.
        terms: by term.
        groups: terms that are hard to tell apart.
        needed: what a smaller error needs.
        warnings: why the bound may not hold; empty where nothing speaks against it.
        coefficient_units: of the coefficients by term; "" where one is not known, empty where none is.
    """

    schema_: Literal["latticebench/limit/1"] = Field(
        default="latticebench/limit/1", validation_alias="schema", serialization_alias="schema"
    )
    about: str
    noise: Number
    samples: int
    span: Number
    conditioning: Number
    relative: Number
    terms: dict[str, TermLimit]
    groups: list[list[str]]
    needed: Needed
    warnings: list[str]
    coefficient_units: dict[str, str] = {}


class FitRow(Content):
    """A row of the table of fits; a score that a case has not is null.

    `published` is the commit that made a row which was published, and empty in one's own.
    """

    part: Words
    data: str
    library: str
    method: str
    noise: Number
    seed: int
    status: str
    e2: Number
    einf: Number
    spurious: Number
    tpr: Number
    bound: Number
    forecast_error: Number
    forecast_horizon: Number
    residual: Number
    conditioning: Number
    seconds: Number
    cpu_seconds: Number
    peak_mib: Number
    covered: Number
    reason: Words
    settings: Words
    identity: str
    published: Words = ""


class Diagnosed(Content):
    """What the rows of trials and of recordings have in common; null where there is no diagnosis."""

    status: str
    verdict: Text
    partly: Text
    named: Text
    residual_before: Number
    residual_after: Number
    forecast_before: Number
    forecast_after: Number
    seconds: Number
    message: Text


class TrialRow(Diagnosed):
    """A row of the table of trials of the diagnosis."""

    system: str
    effect: str
    z: Number
    noise: Number
    velocities: bool
    seed: int
    size: Number
    apart: Number
    alike: str
    right: Flag
    extra: Number
    coefficients_before: Number
    coefficients_after: Number
    cpu_seconds: Number


class LaboratoryRow(Diagnosed):
    """A row of the table of laboratory recordings; residuals are in units of the noise that was added."""

    part: Words
    asked: str
    seed: int
    instrument: str
    sites: Number
    ends: Text
    readings: Number
    periods: Number
    declared: Text
    count: Number
    truth: str
    right: Flag
    right_alike: Flag
    missed: Text
    invented: Text
    placed: Text
    covered: Number
    intervals: Number
    pieces: Number
    cpu_seconds: Number


class RecordingRow(Diagnosed):
    """A row of the table of measured recordings."""

    name: str
    file: str
    terms: str


class RunDocument(Document):
    """The results of a run, one row per case, see `latticebench run` and `latticebench table`."""

    schema_: Literal["latticebench/run/1"] = Field(
        default="latticebench/run/1", validation_alias="schema", serialization_alias="schema"
    )
    cases: list[FitRow | TrialRow | LaboratoryRow | RecordingRow]


class ComparedCase(Content):
    """A case that got worse or better: what it was in both runs, in words, and the ratio of its errors."""

    case: str
    old: str
    new: str
    ratio: Number


class ComparedMethod(Content):
    """A method judged by all cases and seeds that both runs have, see `bench.compare`."""

    method: str
    pairs: int
    ratio: Number
    p: Number
    verdict: str


class CompareDocument(Document):
    """One run judged by another, see `latticebench compare`.

    Attributes:
        worse, better: single cases whose error grew or fell by more than a factor.
        methods: what a paired test says of each method.
        same: how many did neither.
        gone, new: cases that only one of the runs has.
    """

    schema_: Literal["latticebench/compare/1"] = Field(
        default="latticebench/compare/1", validation_alias="schema", serialization_alias="schema"
    )
    worse: list[ComparedCase]
    better: list[ComparedCase]
    methods: list[ComparedMethod]
    same: int
    gone: list[str]
    new: list[str]


class AgainstMethod(Content):
    """How a method does against another over all cases, see `bench.against.Contest`."""

    method: str
    against: str
    cases: int
    wins: int
    losses: int
    ties: int
    ratio: Number
    low: Number
    high: Number
    p: Number
    verdict: str


class AgainstCase(Content):
    """One case of a method against another: ratio of their errors with its interval, and who has won."""

    part: Words
    data: str
    library: str
    method: str
    against: str
    seeds: int
    ratio: Number
    low: Number
    high: Number
    outcome: Literal["win", "loss", "tie"]


class MeanRanks(Content):
    """Mean ranks of methods, see `bench.against.Ranks`."""

    mean: dict[str, Number]
    cases: int
    distance: Number
    p: Number
    left_out: list[str]


class AgainstDocument(Document):
    """Methods against one of them, see `latticebench compare --against`.

    Attributes:
        published: where the methods with an asterisk are from; empty where there are none.
        ranks: None where there are too few methods or cases.
    """

    schema_: Literal["latticebench/against/1"] = Field(
        default="latticebench/against/1", validation_alias="schema", serialization_alias="schema"
    )
    published: str
    methods: list[AgainstMethod]
    cases: list[AgainstCase]
    ranks: MeanRanks | None


class FiguresDocument(Document):
    """The figures that were drawn of a run, see `latticebench figures`.

    Attributes:
        published: where the methods with an asterisk are from; empty where there are none.
        files: where the figures lie.
    """

    schema_: Literal["latticebench/figures/1"] = Field(
        default="latticebench/figures/1", validation_alias="schema", serialization_alias="schema"
    )
    published: str
    files: list[str]


class SensorReadings(Content):
    """The readings of one sensor, see `bench.inspection.Sensor`."""

    name: str
    readings: int
    missing: int
    least: Number
    most: Number
    noise: Number
    step: Number


class Inspected(Content):
    """What one trajectory is like, see `bench.inspection.Inspection`."""

    source: str
    sites: int
    rows: int
    begin: Number
    end: Number
    interval: Number
    uneven: bool
    gaps: list[tuple[float, float]]
    seen: list[str]
    sensors: list[SensorReadings]
    frequencies: list[float]
    suspicious: list[str]
    notes: list[str]


class InspectionDocument(Document):
    """What recordings are like, see `latticebench inspect`; readings, times and frequencies are in the files' units."""

    schema_: Literal["latticebench/inspection/1"] = Field(
        default="latticebench/inspection/1", validation_alias="schema", serialization_alias="schema"
    )
    units: Units
    trajectories: list[Inspected]


class ListDocument(Document):
    """What there is of a kind, see `latticebench list` and `latticebench data`."""

    schema_: Literal["latticebench/list/1"] = Field(
        default="latticebench/list/1", validation_alias="schema", serialization_alias="schema"
    )
    kind: Literal["systems", "libraries", "methods", "suites", "effects", "recordings"]
    rows: list[dict[str, JsonValue]]


def fit_document(
    found: Fit, quality: Adequacy, units: Units, about: Provenance, overlay: Overlay | None = None
) -> FitDocument:
    """Return the document of a fit, with what is drawn of it."""
    texts, own = found.library.texts, of_coefficients(found.library.terms, found.order, units)
    return FitDocument(
        provenance=about, method=found.method, order=found.order,
        coefficients=dict(zip(texts, map(float, found.coefficients), strict=True)),
        stderr=None if found.stderr is None else dict(zip(texts, map(float, found.stderr), strict=True)),
        residual=found.residual, seconds=found.seconds, status=quality.state(found.status),
        quality=Quality(work=quality.work, r2=quality.r2, times=quality.times, fits=quality.fits),
        warnings=list(quality.warnings), units=units,
        shown=None if overlay is None else Shown.of(overlay), coefficient_units=dict(zip(texts, own, strict=bool(own))),
    )  # fmt: skip


def limit_document(found: Limit, needed: Design, bound: BoundOf, about: Provenance) -> LimitDocument:
    """Return the document of a bound and of what a wanted one needs."""
    texts = found.library.texts
    rows = zip(texts, found.coefficients, found.stderr, found.errors, found.verdicts, strict=True)
    return LimitDocument(
        provenance=about, about=bound.note, noise=found.noise, samples=found.samples, span=found.span,
        conditioning=found.conditioning, relative=found.relative,
        terms={
            text: TermLimit(coefficient=value, stderr=stderr, error=error, verdict=verdict)
            for text, value, stderr, error, verdict in rows
        },
        groups=[[texts[k] for k in group] for group in found.groups],
        needed=Needed(**dataclasses.asdict(needed)), warnings=list(bound.warnings),
        coefficient_units=dict(zip(texts, bound.units, strict=bool(bound.units))),
    )  # fmt: skip


def inspection_document(found: Sequence[Inspection], units: Units, about: Provenance) -> InspectionDocument:
    """Return the document of recordings."""
    return InspectionDocument.model_validate(
        {"provenance": about, "units": units, "trajectories": [dataclasses.asdict(one) for one in found]}
    )


def run_document(rows: Sequence[Mapping[str, Any]], about: Mapping[str, Any]) -> RunDocument:
    """Return the document of a run.

    Args:
        rows: of the table of cases, see `bench.kinds.rows`.
        about: the description of the results, see `bench.provenance.describe`.
    """
    return RunDocument.model_validate({"provenance": {"command": "", **about}, "cases": rows})


def compare_document(found: Comparison, about: Provenance) -> CompareDocument:
    """Return the document of a comparison."""
    return CompareDocument(
        provenance=about, same=found.same, gone=found.gone, new=found.fresh,
        worse=[ComparedCase.model_validate(row) for row in found.worse.to_dict("records")],
        better=[ComparedCase.model_validate(row) for row in found.better.to_dict("records")],
        methods=[ComparedMethod.model_validate(row) for row in found.methods.to_dict("records")],
    )  # fmt: skip


def against_document(found: Contest, about: Provenance, published: str = "") -> AgainstDocument:
    """Return the document of methods against one of them."""
    ranks = found.ranks
    return AgainstDocument(
        provenance=about, published=published,
        methods=[AgainstMethod.model_validate(row) for row in found.methods.to_dict("records")],
        cases=[AgainstCase.model_validate(row) for row in found.cases.to_dict("records")],
        ranks=None if ranks is None else MeanRanks(
            mean={str(name): float(rank) for name, rank in ranks.mean.items()}, cases=ranks.cases,
            distance=ranks.distance, p=ranks.p, left_out=list(ranks.left_out),
        ),
    )  # fmt: skip
