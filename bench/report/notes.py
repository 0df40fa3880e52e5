"""What a reader of a diagnosis should know besides its result."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.report.whereabouts import scaled_residuals
from latticebench.diagnosis.catalogued import step_of
from latticebench.diagnosis.contest import EQUAL
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from latticebench.diagnosis.repair import Diagnosis

# Rounding that makes less of the noise's variance than this is not worth a word.
ROUNDING = 0.01
# So many times as far from the middle as any other reading of its site is no reading of the motion.
STRAY = 10.0


def strays(samples: Samples) -> list[str]:
    """Return which readings are so far from all others of their site that they can hardly be of the motion."""
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
                    f"{samples.source}: {letter}{site + 1} at t = {samples.t[row]:g} is {column[row]:.4g}, more than "
                    f"{STRAY:g} times as far out as any other reading of that site. If it is a slip, leave the cell "
                    "empty."
                )
    return found


def notes(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return what else a reader should know, one sentence or two each."""
    every = (
        _of_the_readings(diagnosis),
        _of_the_rounds(diagnosis),
        _of_the_fits(diagnosis),
        _of_the_names(diagnosis),
    )
    return tuple(note for part in every for note in part)


def _of_the_readings(diagnosis: Diagnosis) -> Iterator[str]:
    for samples in diagnosis.course.before.data:
        yield from strays(samples)
    step = min(step_of(_parts(samples.u)) for samples in diagnosis.course.after.data)
    share = step**2 / 12 / float(diagnosis.noise[0]) ** 2
    if step and share > ROUNDING:
        size = f"{100 * share:.2g} %" if share < 1 else "all"
        yield f"The readings are multiples of {step:.4g}: rounding alone makes {size} of the noise's variance."
    used, recorded = diagnosis.used
    if used < recorded:
        yield (
            f"Of {recorded} sample times {used} were looked at: the record is sampled more densely than it moves, "
            "or very long."
        )


def _parts(field: np.ndarray) -> np.ndarray:
    """Return all readings of a field as real numbers."""
    return np.concatenate([field.real.ravel(), field.imag.ravel()]) if np.iscomplexobj(field) else field.ravel()


def _of_the_rounds(diagnosis: Diagnosis) -> Iterator[str]:
    course = diagnosis.course
    kept = {placed.effect.name for placed in course.after.model.effects}
    gone = list(dict.fromkeys(one.added for one in course.rounds if one.added and one.added not in kept))
    if gone:
        yield f"Added in a round and taken away again, since later ones do without: {', '.join(gone)}."


def _of_the_fits(diagnosis: Diagnosis) -> Iterator[str]:
    course = diagnosis.course
    for fitted, name in ((course.before, "declared equation"), (course.after, "last model")):
        pieces, whole = len(fitted.data), len(scaled_residuals(fitted, diagnosis))
        if pieces > whole and (fitted is course.after or course.after.model.effects):
            yield (
                f"The {name} is followed in {pieces} pieces of at most {max(len(one.t) for one in fitted.data)} "
                "samples, each from a start of its own: over longer ones it loses the readings."
            )
    if not course.after.solution.converged:
        yield "The last fit's steps did not end: its numbers are less sure than their standard errors say."
    if any(len(record.stretches.dynamics.border) for record in course.after.records):
        yield "The chain's ends were not declared: sites at both ends are taken as given and have no equation."


def _of_the_names(diagnosis: Diagnosis) -> Iterator[str]:
    course = diagnosis.course
    unnamed = [one for one in course.left if not one.named]
    if unnamed and course.verdict in ("unexplained", "partly explained"):
        places = ["" if one.placed.site is None else f" (site {one.placed.site + 1})" for one in unnamed]
        listed = ", ".join(one.name + place for one, place in zip(unnamed[:3], places, strict=False))
        yield f"What would do most for what is left, though it is no effect of the catalogue: {listed}."
    for name in course.repeated:
        yield (
            f"{name} was added more than once: a few of them can stand for any course in time, so that the name is in "
            "doubt."
        )
    if course.rival is not None:
        name, lead = course.rival
        yield (
            f"{name} does {'better' if lead > EQUAL else 'as well'} in the place of the last effect (by {lead:.1f}, "
            "natural logarithms of the likelihood ratio), though it is no effect of the catalogue: the name is in "
            "doubt."
        )
    if any(placed.effect.acts == "clock" for placed in course.after.model.effects):
        yield "How late a row to come will be read cannot be known: the forecast is for the times as they are told."
