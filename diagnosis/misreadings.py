"""Unnamed errors of an instrument, which compete with the catalogue's effects (for motions see `diagnosis.unnamed`).

- Readings that are wrong by any smooth function of the field: a scale that is bent, a range that ends; or by one of its
  rate: a needle that sticks.
- Readings in which those of the neighbours are mixed, or the hum of something else.
- Readings that are all scaled or lifted alike, by another amount at each time; or by an amount that changes smoothly
  along the chain, as that of sensors which are each a little off does not.
- Readings that come late, one site's or each by its own; one site's that are wrong by any course in time.
- Patterns in space and time of what is left, which catch whatever else there is.

What is wrong with u may be wrong with v, too, or not: there are candidates for both.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.candidate import MOST_NUMBERS, UNNAMED, Candidate, Group, as_candidate, group
from latticebench.diagnosis.catalogued import frequencies
from latticebench.diagnosis.courses import at_each, course_waves, modes_of
from latticebench.diagnosis.model import rates
from latticebench.diagnosis.modulated import elapsed
from latticebench.diagnosis.smooth import polynomials
from latticebench.diagnosis.tangent import Path, Tangent

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float
    from numpy import ndarray

# Of the field's own size: a step for derivatives of a function of it.
STEP = 1e-4
BANDS = ((0, 4), (4, 12))
# Fewer sites cannot show a smooth course.
FEWEST_SITES = 6


def misreadings(tangent: Tangent) -> list[Group]:
    """Return all of them by what they are called in a ranking."""
    kinds = (_bent, _sticky, _mixed, _hums, _flickering, _slanted, _belated, _courses, _patterns)
    return [found for kind in kinds for found in kind(tangent)]


def _levels_read(tangent: Tangent) -> int:
    """Return 1 where u is read, 2 where u and v are."""
    return int(tangent.paths[0].weight.shape[1])


def _as_rows(
    path: Path, u: Float[ndarray, "columns time sites"], v: Float[ndarray, "columns time sites"] | None
) -> ndarray:
    """Return as columns what u, and v where it is given, are wrong by; complex ones once more, turned by i."""
    levels = path.weight.shape[1]
    wrong = np.stack([u, np.zeros_like(u) if v is None else v][:levels], axis=2)
    if path.is_complex:
        wrong = np.concatenate([wrong, 1j * wrong])
        return path.rows(np.stack([wrong.real, wrong.imag], axis=3))
    return path.rows(wrong[:, :, :, None])


def _seen(path: Path) -> tuple[ndarray, ndarray | None]:
    """Return u and v of every site at the sample times."""
    u, v = path.fields()
    return u[:: path.steps], None if v is None else v[:: path.steps]


def by_law(tangent: Tangent, wrong: Callable[[Path, ndarray], ndarray], *, random: bool) -> list[Candidate | None]:
    """Return candidates for readings that are wrong by functions of the field at the same time.

    Either u alone is wrong, or both are, as v is the slope of u.
    """

    def columns(_number: int, path: Path, both: bool) -> ndarray:
        u, v = _seen(path)
        slopes = None
        if both and v is not None:
            step = STEP * float(np.max(np.abs(u))) / max(float(np.max(np.abs(v))), 1e-300)
            slopes = (wrong(path, u + step * v) - wrong(path, u - step * v)) / (2 * step)
        return _as_rows(path, wrong(path, u), slopes)

    candidates = []
    for both in (False, True)[: _levels_read(tangent)]:
        every = tangent.columns(lambda k, path, both=both: columns(k, path, both))  # type: ignore[misc]
        candidates.append(as_candidate(tangent, UNNAMED, every, random=random))
    return candidates


def _bent(tangent: Tangent) -> list[Group]:
    """Return candidates for scales that are bent: of a complex field by its size, or of each of its parts."""

    def by_part(path: Path, u: ndarray) -> ndarray:
        now = _seen(path)[0]
        if path.is_complex:
            most = float(max(np.max(np.abs(now.real)), np.max(np.abs(now.imag))))
            real, imaginary = (polynomials(part + most, np.ones(part.shape), 2 * most) for part in (u.real, u.imag))
            return real + 1j * imaginary
        return polynomials(u - np.min(now), np.ones_like(u), float(np.ptp(now)))

    def by_size(path: Path, u: ndarray) -> ndarray:
        return polynomials(np.abs(u), u, float(np.max(np.abs(_seen(path)[0]))))

    laws = (by_part, by_size) if tangent.paths[0].is_complex else (by_part,)
    candidates = [one for law in laws for one in by_law(tangent, law, random=True)]
    return group("readings wrong by a function of the field", candidates)


def _mixed(tangent: Tangent) -> list[Group]:
    sites = tangent.paths[0].record.stretches.dynamics.sites
    if sites < 2:
        return []

    def wrong(_path: Path, u: ndarray) -> ndarray:
        return np.stack([u @ np.eye(sites, k=1), u @ np.eye(sites, k=-1)])

    return group("readings mixed with the neighbours'", by_law(tangent, wrong, random=False))


def _sticky(tangent: Tangent) -> list[Group]:
    """Return candidates for readings of u wrong by a function of du/dt, its sign first.

    Each part of a complex field is wrong alike.
    """
    state = tangent.fitted.solution.state

    def columns(number: int, path: Path) -> ndarray:
        rate = rates(path.record, state, number)[:, 0]
        most = float(np.max(np.abs(rate)))
        wrong = np.concatenate([np.sign(rate)[None], polynomials(rate + most, np.ones_like(rate), 2 * most)])
        whole = np.zeros((len(wrong), *path.weight.shape))
        whole[:, :, 0] = wrong
        return path.rows(whole)

    every = tangent.columns(columns)
    candidates = [as_candidate(tangent, UNNAMED, every[:, :1]), as_candidate(tangent, UNNAMED, every, random=True)]
    return group("readings wrong by a function of the rate", candidates)


def _hums(tangent: Tangent) -> list[Group]:
    """Return candidates for a harmonic that all readings of a kind have alike."""
    omegas, levels = frequencies(tangent), _levels_read(tangent)
    parts = tangent.paths[0].record.stretches.dynamics.parts

    def columns(_number: int, path: Path, level: int) -> ndarray:
        angle = omegas[:, None] * path.record.times
        beats = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        wrong = np.zeros((len(omegas), 2, parts, *path.weight.shape))
        for part in range(parts):
            wrong[:, :, part, :, level, part] = beats[..., None]
        return path.rows(wrong.reshape(-1, *path.weight.shape))

    candidates, each = [], 2 * parts
    for level in range(levels):
        every = tangent.columns(lambda k, path, level=level: columns(k, path, level))  # type: ignore[misc]
        candidates += [as_candidate(tangent, UNNAMED, every[:, k : k + each]) for k in range(0, every.shape[1], each)]
    return group("a hum in all readings", candidates)


def _flickering(tangent: Tangent) -> list[Group]:
    """Return candidates for readings of each time scaled or lifted by its own amount."""
    dynamics, rows = tangent.paths[0].record.stretches.dynamics, len(tangent.paths[0].record.times)
    if len(tangent.paths) > 1 or dynamics.sites < 2 or len(tangent.residual) * rows * dynamics.parts > MOST_NUMBERS:
        return []

    def scaled(path: Path, u: ndarray) -> ndarray:
        return np.asarray(np.eye(len(path.record.times))[:, :, None] * u)

    def lifted(path: Path, u: ndarray) -> ndarray:
        return scaled(path, np.ones_like(u))

    return [
        *group("readings scaled at each time by its own", by_law(tangent, scaled, random=True)),
        *group("readings lifted at each time by its own", by_law(tangent, lifted, random=True)[:1]),
    ]


def _slanted(tangent: Tangent) -> list[Group]:
    """Return candidates for readings scaled or lifted by an amount that is smooth along the chain.

    Long half waves are likelier.
    """
    sites = tangent.paths[0].record.stretches.dynamics.sites
    if sites < FEWEST_SITES:
        return []
    # Every half wave, as the slopes at a smooth course's ends make them fall off: by their number squared.
    numbers, place = np.arange(sites)[:, None], (np.arange(sites) + 0.5) / sites
    profiles = np.cos(np.pi * numbers * place) / np.maximum(numbers, 1) ** 2

    def scaled(_path: Path, u: ndarray) -> ndarray:
        return np.asarray(profiles[:, None] * u)

    def lifted(path: Path, u: ndarray) -> ndarray:
        return scaled(path, np.ones_like(u))

    return [
        *group("readings scaled by a smooth course along the chain", by_law(tangent, scaled, random=True)),
        *group("readings lifted by a smooth course along the chain", by_law(tangent, lifted, random=True)[:1]),
    ]


def _belated(tangent: Tangent) -> list[Group]:
    """Return candidates for readings as they would be a little earlier or later, of one site or of each by its own."""
    dynamics, state = tangent.paths[0].record.stretches.dynamics, tangent.fitted.solution.state
    if dynamics.sites < 2:
        return []

    def columns(number: int, path: Path, both: bool) -> ndarray:
        rate = rates(path.record, state, number)[:, : path.weight.shape[1]]
        if not both:
            rate[:, 1:] = 0.0
        return path.rows(np.stack([rate * one for one in np.eye(dynamics.sites)]))

    one, each = [], []
    for both in (False, True)[: _levels_read(tangent)]:
        every = tangent.columns(lambda k, path, both=both: columns(k, path, both))  # type: ignore[misc]
        one += [as_candidate(tangent, replace(UNNAMED, site=site), every[:, [site]]) for site in range(dynamics.sites)]
        each.append(as_candidate(tangent, UNNAMED, every, random=True))
    return [*group("one site's readings late", one), *group("readings late, each site's by its own", each)]


def _courses(tangent: Tangent) -> list[Group]:
    """Return candidates for readings of one site that are wrong by any course in time."""
    dynamics, waves = tangent.paths[0].record.stretches.dynamics, course_waves(tangent)
    if not waves:
        return []
    sites, parts = dynamics.sites, dynamics.parts

    def columns(_number: int, path: Path, level: int) -> ndarray:
        curves = np.cos(np.pi * np.arange(waves)[:, None] * elapsed(path.record.times))
        wrong = np.zeros((sites, waves, parts, *path.weight.shape))
        for site in range(sites):
            for part in range(parts):
                wrong[site, :, part, :, level, part, site] = curves
        return path.rows(wrong.reshape(-1, *path.weight.shape))

    groups: list[Group] = []
    for level in range(_levels_read(tangent)):
        every = tangent.columns(lambda k, path, level=level: columns(k, path, level))  # type: ignore[misc]
        name = f"readings of {'uv'[level]} at one site wrong by any course"
        groups += group(name, at_each(tangent, every, range(sites), waves))
    return groups


def _patterns(tangent: Tangent) -> list[Group]:
    """Return candidates for smooth patterns of what is left."""
    dynamics = tangent.paths[0].record.stretches.dynamics

    def columns(_number: int, path: Path, level: int, low: int, high: int) -> ndarray:
        rows = len(path.record.times)
        x = (np.arange(rows) + 0.5) / rows
        found = []
        for k in range(low, high):
            for mode in modes_of(dynamics.sites):
                for part in range(dynamics.parts):
                    wrong = np.zeros(path.weight.shape)
                    wrong[:, level, part] = np.cos(np.pi * k * x)[:, None] * mode
                    found.append(wrong)
        return path.rows(np.stack(found))

    groups: list[Group] = []
    for level in range(_levels_read(tangent)):
        for low, high in BANDS:
            make = functools.partial(columns, level=level, low=low, high=high)
            every = tangent.columns(make)
            name = f"a pattern in {'uv'[level]}, {low}-{high - 1} half waves in time"
            groups += group(name, [as_candidate(tangent, UNNAMED, every)])
    return groups
