"""What a reader of a diagnosis should know besides its result."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.report.units import with_unit
from latticebench.diagnosis.instrument import step_of
from latticebench.diagnosis.modes import MOST_MODES
from latticebench.systems.layout import UNITS
from latticebench.systems.options import option
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.held import Held
    from latticebench.diagnosis.repair import Diagnosis
    from latticebench.systems.lattice import Library

# Rounding that makes less of the noise's variance than this is not worth a word.
ROUNDING = 0.01
# So many times as far from the middle as any other reading of its site is no reading of the motion.
STRAY = 10.0
# Readings at the very end of a range are clipped where there are so many, and so many times those at the next level.
CLIPPED, CROWDED = 5, 4
# A force of so many times the highest frequency of the chain moves its neighbours hardly more than noise does.
HUM = 2.0
# A full turn where no unit is known, the share of one that an angle moves by from one reading to the next at most, and
# how many times as far where it starts anew as elsewhere.
TURNS, STEADY, LANDING = (2 * np.pi, 360.0), 0.3, 3.0
# An argument of a sine beyond this is hardly an angle in radians, unless something turns over and over.
ANGLE = 10.0
PERIODIC = ("sin", "cos", "tan")
# A sensor has stopped where so many of its readings on end, and this share of all, are one number, while another moves
# by this share of its range.
STOPPED, LONG, MOVES = 20, 0.1, 0.2
# Sensors that one line names.
NAMED = 4


def at_ends(values: Float[ndarray, " values"]) -> Iterator[tuple[float, int, str]]:
    """Yield the levels at which readings crowd at an end of their range, how many they are, and which end it is.

    Args:
        values: readings of one sensor, none of them missing.
    """
    levels, counts = np.unique(values, return_counts=True)
    if len(levels) < 2:
        return
    for level, count, beside, end in ((levels[-1], *counts[:-3:-1], "above"), (levels[0], *counts[:2], "below")):
        if count >= CLIPPED and count > CROWDED * beside:
            yield float(level), int(count), end


def doubts(data: Sequence[Samples], terms: Library) -> tuple[str, ...]:
    """Return what makes readings hard to believe under an equation: `degrees` and `resting` of all recordings."""
    return tuple(dict.fromkeys(line for one in data for line in (*degrees(one, terms), *resting(one))))


def degrees(samples: Samples, terms: Library) -> list[str]:
    """Return where readings make no sense in the sines of an equation."""
    names = [name for name in PERIODIC if terms.uses(name)]
    largest = float(np.nanmax(np.abs(samples.u))) if names else 0.0
    if largest <= ANGLE:
        return []
    unit = samples.origin.unit
    # Radians of several turns are what a pendulum does that goes round.
    if samples.origin.becomes == "rad":
        return []
    known = unit in ("deg", "arcmin")
    remedy = option("scale", unit if known else "deg")
    remedy = f"read the angles with {remedy}" if known else f"if these are degrees: {remedy}"
    return [f"u reaches {largest:.3g} in {names[0]}(...), which takes radians; {remedy}"]


def resting(samples: Samples) -> list[str]:
    """Return which sensors always read the same, or do so from some time on while others move."""
    dead: dict[str, list[str]] = {}
    stopped = []
    names = samples.origin.columns or [f"u{site + 1}" for site in range(samples.sites)]
    for site in _still(samples.u):
        rows = np.flatnonzero(np.isfinite(samples.u[:, site]))
        values = samples.u[rows, site]
        if np.all(values == values[0]):
            dead.setdefault(f"{values[0].real / samples.origin.scale:g}", []).append(names[site])
            continue
        edges = np.flatnonzero(np.diff(values) != 0) + 1
        # What begins with the record may not have been set in motion yet.
        for first, last in zip(edges, [*edges[1:], len(rows)], strict=True):
            if last - first < max(STOPPED, LONG * len(rows)):
                continue
            some = slice(rows[first], rows[last - 1] + 1)
            if any(_range(samples.u[some, k]) > MOVES * _range(samples.u[:, k]) > 0 for k in range(samples.sites)):
                stopped.append(
                    f"{names[site]}: {values[first].real / samples.origin.scale:g} from t = {samples.t[rows[first]]:g} "
                    f"to {samples.t[rows[last - 1]]:g}, while others move; if it had stopped, leave these cells empty"
                )
    return [_dead(columns, level) for level, columns in dead.items()] + stopped


def _still(u: ndarray) -> list[int]:
    """Return the sites that were read and may have been at rest: half of STOPPED pairs of readings are the same."""
    seen = np.isfinite(u)
    alike = np.sum(u[1:] == u[:-1], axis=0)
    few = np.sum(seen, axis=0) <= STOPPED
    return np.flatnonzero(np.any(seen, axis=0) & ((alike >= STOPPED // 2) | few | ~np.all(seen, axis=0))).tolist()


def _dead(columns: Sequence[str], level: str) -> str:
    if len(columns) == 1:
        return f"{columns[0]}: always {level}; does this sensor work?"
    more = f" and {len(columns) - NAMED} more" if len(columns) > NAMED else ""
    return f"{', '.join(columns[:NAMED])}{more}: always {level}; do these sensors work?"


def _range(values: ndarray) -> float:
    """Return by how much the real parts of readings differ; 0 where there are none."""
    seen = values.real[np.isfinite(values)]
    return float(np.ptp(seen)) if len(seen) else 0.0


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
                    f"{samples.source}: {letter}{site + 1} at t = {samples.t[row]:g} is "
                    f"{column[row] / samples.origin.scale:.4g}, more than "
                    f"{STRAY:g} times as far out as any other reading of that site. If it is a slip, leave the cell "
                    "empty."
                )
    return found


def turns(samples: Samples) -> list[str]:
    """Return which readings look like an angle that starts anew after a full turn."""
    found: list[str] = []
    if samples.is_complex:
        return found
    origin = samples.origin
    factor, becomes = UNITS.get(origin.unit, (1.0, origin.unit))
    full = TURNS if not origin.unit else (2 * np.pi / factor,) if becomes == "rad" else ()
    for site, column in enumerate((samples.u / origin.scale).T):
        steps = np.diff(column)
        steps = steps[np.isfinite(steps)]
        for turn in full:
            rest = np.abs(steps - turn * np.round(steps / turn))
            anew = np.abs(steps) > turn / 2
            # What jumps for another reason does not land where it would have been.
            lands = np.max(rest[anew], initial=0.0) <= LANDING * np.max(rest[~anew], initial=0.0)
            if np.any(anew) and lands and np.max(rest) < STEADY * turn and np.ptp(column[np.isfinite(column)]) <= turn:
                found.append(
                    f"{samples.source}: u{site + 1} jumps by about {turn:.4g} at {np.sum(anew)} places and moves by no "
                    f"more than {np.max(rest):.2g} elsewhere. It looks like an angle that starts anew after a full "
                    f"turn; {option('turn', float(turn))} unwraps it."
                )
    return found


def notes(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return what else a reader should know, one sentence or two each."""
    every = (_of_the_readings(diagnosis), _of_the_fits(diagnosis))
    return tuple(note for part in every for note in part)


def _of_the_readings(diagnosis: Diagnosis) -> Iterator[str]:
    if diagnosis.dead:
        names = diagnosis.data[0].origin.columns or [f"u{site + 1}" for site in range(diagnosis.data[0].sites)]
        dead = [names[site] for site in diagnosis.dead]
        more = f" and {len(dead) - NAMED} more" if len(dead) > NAMED else ""
        yield (
            f"{', '.join(dead[:NAMED])}{more}: always the same reading, which is taken for a sensor that does not "
            "work; what it reads was left out, and its site moves as the equation says."
        )
    if diagnosis.exchanged:
        yield f"{mixed_up(diagnosis.data[0], diagnosis.exchanged)}."
    for held in diagnosis.held:
        yield resting_at(held)
    for samples in _joined(diagnosis.data):
        for line in doubts([samples], diagnosis.before.model.declared):
            yield f"{samples.source}: {line}."
        yield from strays(samples)
        yield from turns(samples)
        yield from _clipped(samples)
    yield from _steps(diagnosis)
    used, recorded = diagnosis.used
    if used < recorded:
        yield (
            f"Of {recorded} sample times {used} were looked at: the record is sampled more densely than it moves, "
            "or very long."
        )
    if diagnosis.inputs:
        yield f"Between its samples the measured input was taken as {diagnosis.inputs}, which the readings suit best."


def mixed_up(samples: Samples, order: Sequence[int]) -> str:
    """Return in which order of the columns an equation leaves much less, and what reads them so."""
    names = [samples.columns([site]) for site in order]
    line = f"{samples.source}: the declared equation leaves much less with the columns in the order {', '.join(names)}"
    if samples.is_complex or samples.v is not None or samples.f is not None:
        return f"{line}; if they are mixed up, so may be what else was read of these sites"
    return f"{line}; if they are mixed up, {option('columns', ','.join(names))} reads them so"


def resting_at(held: Held) -> str:
    """Return how long a recording shows no motion, and what a diagnosis makes of it."""
    what, rows = ("as before it is let go", "first") if held.early else ("caught or stuck", "last")
    return (
        f"{held.source}: nothing moves from t = {held.begin:g} to {held.end:g}, away from the middle of the motion, "
        f"{what}: a diagnosis leaves the {rows} {held.rows} readings out."
    )


def _joined(data: Sequence[Samples]) -> Iterator[Samples]:
    """Yield each recording once: windows of one are put together, with a row without readings between them."""
    for source in dict.fromkeys(one.source for one in data):
        first, *others = [one for one in data if one.source == source]
        for part in others:
            between = (first.t[-1] + part.t[0]) / 2
            v = None if first.v is None or part.v is None else _apart(first.v, part.v)
            t = np.concatenate([first.t, [between], part.t])
            first = replace(first, t=t, u=_apart(first.u, part.u), v=v, f=None)
        yield first


def _apart(field: ndarray, later: ndarray) -> ndarray:
    """Return both with a row of NaN between them."""
    return np.concatenate([field, np.full((1, field.shape[1]), np.nan), later])


def _clipped(samples: Samples) -> Iterator[str]:
    """Yield which sensors may be clipped."""
    for site in range(samples.sites):
        values = _parts(samples.u[:, site]) / samples.origin.scale
        for level, count, end in at_ends(values[np.isfinite(values)]):
            yield (
                f"{samples.source}: {count} readings of u{site + 1} are just {level:g} and none is {end}. If the "
                "sensor is clipped there, leave these cells empty: they were taken as readings."
            )


def _steps(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield what the steps of converters make of the noise."""
    found: dict[tuple[str, str], list[str]] = {}
    origin = diagnosis.data[0].origin
    for site in range(diagnosis.data[0].sites):
        step = min(step_of(_parts(samples.u[:, site])) for samples in diagnosis.data)
        share = step**2 / 12 / float(diagnosis.noise[site]) ** 2 if diagnosis.noise[site] > 0 else 0.0
        if step and share > ROUNDING:
            size = f"{100 * share:.2g} %" if share < 1 else "all"
            found.setdefault((with_unit(f"{step / abs(origin.scale):.4g}", origin.unit), size), []).append(
                f"u{site + 1}"
            )
    for (step_, size), columns in found.items():
        listed = "The readings" if len(columns) == diagnosis.data[0].sites else f"Readings of {', '.join(columns)}"
        yield f"{listed} are multiples of {step_}: rounding alone makes {size} of the noise's variance."


def _parts(field: np.ndarray) -> np.ndarray:
    """Return all readings of a field as real numbers."""
    return np.concatenate([field.real.ravel(), field.imag.ravel()]) if np.iscomplexobj(field) else field.ravel()


def _hum(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield which forces are too fast for the chain to carry them on: only the site's own reading shows them."""
    own, chain = [one.frequency for one in diagnosis.modes[2]], diagnosis.after.chain
    if not own or len(own) == MOST_MODES:
        return
    for found in diagnosis.findings:
        frequency = found.placed.frequency or 0.0
        texts = {force.text for force in (*found.placed.forces(chain), *found.placed.courses(chain))}
        if texts and texts <= {"1", "i*1"} and frequency > HUM * max(own) > 0:
            other = "a force on that site" if found.placed.instrument else "hum that a sensor picks up"
            yield (
                f"The frequency of {found.name} is {frequency / max(own):.2g} times the highest of the chain's own: "
                f"{other} would look the same. A recording of the chain held fast tells them apart."
            )


def _of_the_fits(diagnosis: Diagnosis) -> Iterator[str]:
    for fitted, name in ((diagnosis.before, "declared equation"), (diagnosis.after, "last model")):
        last = fitted is diagnosis.after
        if fitted.pieces > len(diagnosis.data) and (last or diagnosis.findings) and not (last and diagnosis.whole):
            yield (
                f"The {name} is followed in {fitted.pieces} pieces of at most {fitted.longest} samples, each from a "
                "start of its own: over longer ones it loses the readings."
            )
    yield from _hum(diagnosis)
    if not diagnosis.after.converged:
        yield "The last fit's steps did not end: its numbers are less sure than their standard errors say."
    chain = diagnosis.after.chain
    if len(chain.moving) < chain.sites:
        yield "The chain's ends were not declared: sites at both ends are taken as given and have no equation."
