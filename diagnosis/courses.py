"""Forces of any course in time: at one site, at all of them, as waves along the chain, as smooth patterns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.candidate import MOST_NUMBERS, UNNAMED, Candidate, Group, as_candidate, group, places
from latticebench.diagnosis.modulated import HALF_WAVES, MODES, elapsed, steady_terms
from latticebench.diagnosis.tangent import Path, Tangent

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Half waves of a course in time at one place; fewer where the columns of all sites would be too many numbers.
COURSE = 16
# Half waves of what is alike at all sites.
SUPPLY = 24
# Whole waves in the record and half waves along the chain of a travelling force, at most.
WAVES, STANDING = 12, 24


def course_waves(tangent: Tangent) -> int:
    """Return the number of half waves in a course in time at one place; 0 where there are too few, or no places."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    waves = min(COURSE, MOST_NUMBERS // (len(tangent.residual) * dynamics.sites * dynamics.parts))
    return waves if len(places(tangent)) > 1 and waves >= HALF_WAVES else 0


def at_each(tangent: Tangent, every: ndarray, sites: Sequence[int], waves: int) -> list[Candidate | None]:
    """Return candidates for a course in time, one per site; the higher half waves are less likely."""
    found = []
    for site, own in zip(sites, np.split(every, len(sites), axis=1), strict=True):
        rare = 1 + np.repeat(np.arange(waves), own.shape[1] // waves)
        found.append(as_candidate(tangent, replace(UNNAMED, site=site), own / rare, random=True))
    return found


def forces_of_any_course(tangent: Tangent) -> list[Group]:
    """Return candidates for forces of any course in time, at one site and at all of them."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    moving, parts, waves = places(tangent), dynamics.parts, course_waves(tangent)
    if not waves:
        return []

    def columns(_number: int, path: Path) -> ndarray:
        curves = np.cos(np.pi * np.arange(waves)[:, None] * elapsed(path.times))
        found = []
        for site in moving:
            source = np.zeros((waves, parts, len(path.times), parts, dynamics.sites))
            for part in range(parts):
                source[:, part, :, part, site] = curves
            found.append(path.answer(source.reshape(-1, *source.shape[2:])[..., dynamics.moving]))
        return np.concatenate(found, axis=1)

    every = tangent.columns(columns)
    beats = swings(waves)
    candidates = [
        as_candidate(tangent, replace(UNNAMED, site=site), own @ beat)
        for site, own in zip(moving, np.split(every, len(moving), axis=1), strict=True)
        for beat in _each_part(beats, parts, waves)
    ]
    return [
        *group("a force at one site, of any course", at_each(tangent, every, moving, waves)),
        *group("forces at all sites, of any course", [as_candidate(tangent, UNNAMED, every, random=True)]),
        *group("a force at one site that swings at one frequency", candidates),
    ]


def swings(waves: int) -> Float[ndarray, "frequencies waves two"]:
    """Return cosine and sine of each frequency that so many half waves can show, as sums of them.

    The half waves are cos(pi k x), x running from 0 to 1 in the record. Frequencies are half a wave apart, so
    that one between two of them is within a quarter.
    """
    x = np.linspace(0, 1, 20 * waves)
    halves = np.cos(np.pi * np.arange(waves) * x[:, None])
    # Less than a whole wave is no wave; the highest are not those of the half waves alone.
    angles = np.pi * np.arange(2, waves - 1)[:, None] * x
    beats = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.stack([np.linalg.lstsq(halves, beat, rcond=None)[0] for beat in beats])


def _each_part(beats: ndarray, parts: int, waves: int) -> list[ndarray]:
    """Return swings that act on each part of a field; columns are sorted as (waves, parts)."""
    return [np.einsum("wb,pq->wpbq", beat, np.eye(parts)).reshape(waves * parts, -1) for beat in beats]


def unsteady_terms(tangent: Tangent) -> list[Group]:
    """Return candidates for a force alike at all sites, and each term of the model, of any course in time."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    waves = min(SUPPLY, min(len(path.record.times) for path in tangent.paths) // 2)
    if waves < HALF_WAVES or len(tangent.residual) * waves * (len(dynamics.terms) + 3) * dynamics.parts > MOST_NUMBERS:
        return []

    def columns(_number: int, path: Path) -> ndarray:
        alike = np.zeros((dynamics.parts, len(path.times), dynamics.parts, dynamics.count))
        for part in range(dynamics.parts):
            alike[part, :, part] = 1.0
        courses = np.cos(np.pi * np.arange(waves)[:, None] * elapsed(path.times))
        kinds = np.concatenate([alike, steady_terms(path)])
        kinds = kinds.reshape(-1, 1, dynamics.parts, *kinds.shape[1:]) * courses[:, None, :, None, None]
        return path.answer(kinds.reshape(-1, *alike.shape[1:]))

    every = tangent.columns(columns)
    kinds = np.split(every, every.shape[1] // (waves * dynamics.parts), axis=1)
    force, *terms = (as_candidate(tangent, UNNAMED, one, random=True) for one in kinds)
    # A uniform force that does has a name; the field itself, too, which then does as well.
    beats = _each_part(swings(waves), dynamics.parts, waves)
    steady = [as_candidate(tangent, UNNAMED, one @ beat) for one in kinds[1:] for beat in beats]
    return [
        *group("a force alike at all sites, of any course", [force]),
        *group("a term of any course in time", terms),
        *group("a term that swings at one frequency", steady),
    ]


def travelling_waves(tangent: Tangent) -> list[Group]:
    """Return candidates for forces that run along the chain as a wave, or stand."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    sites, parts = dynamics.sites, dynamics.parts
    highest = min(WAVES, (min(len(path.record.times) for path in tangent.paths) - 1) // 2)
    lengths = range(2, min(STANDING, sites) + 1, 2)
    if len(places(tangent)) < 4 or len(tangent.residual) * highest * len(lengths) * 4 * parts > MOST_NUMBERS:
        return []
    n = np.arange(sites) - (sites - 1) / 2

    def columns(_number: int, path: Path) -> ndarray:
        x = elapsed(path.times)
        found = []
        for k in range(1, highest + 1):
            beats = np.stack([np.cos(2 * np.pi * k * x), np.sin(2 * np.pi * k * x)])
            for q in lengths:
                shapes = np.stack([np.cos(np.pi * q * n / sites), np.sin(np.pi * q * n / sites)])
                source = np.zeros((2, 2, parts, len(x), parts, sites))
                for part in range(parts):
                    source[:, :, part, :, part] = beats[:, None, :, None] * shapes[:, None]
                found.append(source.reshape(-1, *source.shape[3:])[..., dynamics.moving])
        return np.concatenate([path.answer(some) for some in found], axis=1)

    every = tangent.columns(columns)
    each = 4 * parts
    candidates = [as_candidate(tangent, UNNAMED, every[:, k : k + each]) for k in range(0, every.shape[1], each)]
    return group("a wave of force along the chain", candidates)


def modes_of(sites: int) -> list[ndarray]:
    """Return half waves along a chain."""
    place = (np.arange(sites) + 0.5) / sites
    return [np.cos(np.pi * k * place) for k in range(min(MODES, sites))]


def smooth_patterns(tangent: Tangent) -> list[Group]:
    """Return candidates for smooth forces in space and time."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    sites = dynamics.sites

    def smooth(_number: int, path: Path, low: int, high: int) -> ndarray:
        x = elapsed(path.times)
        sources = []
        for k in range(low, high):
            for mode in modes_of(sites):
                for part in range(dynamics.parts):
                    source = np.zeros((len(x), dynamics.parts, sites))
                    source[:, part] = np.cos(np.pi * k * x)[:, None] * mode
                    sources.append(source[..., dynamics.moving])
        return path.answer(np.stack(sources))

    groups: list[Group] = []
    for low, high in ((0, 3), (3, 9), (9, 18)):
        columns = tangent.columns(lambda k, path, a=low, b=high: smooth(k, path, a, b))  # type: ignore[misc]
        name = f"a smooth force, {low}-{high - 1} half waves in time"
        groups += group(name, [as_candidate(tangent, UNNAMED, columns, random=True)])
    return groups
