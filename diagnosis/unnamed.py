"""Unnamed terms of the motion, which compete with the catalogue's effects (for readings see `diagnosis.misreadings`).

- Single terms that physicists use and the catalogue lacks; they can be fitted in full.
- One bond, between neighbours or any two sites, that is another than declared.
- Smooth functions of one variable, whatever their form (`diagnosis.smooth`): a force that depends on the field, on how
  far it is from its mean, on the velocity, on a spring's stretch or how fast it is stretched; a declared term that
  changes in time, along the chain, or in both. They are random effects of unknown variance (`diagnosis.trace`).
- A declared term that is another at one site or at each, from some moment on, that comes late, or that acts on the
  neighbours (`diagnosis.modulated`).
- A force or a declared term of any course in time (`diagnosis.courses`): a force at one site, of its own at each, or
  alike at all; a force at one site and a declared term that swing at one frequency; a force that travels as a wave.
- Smooth forces in space and time, which catch whatever else there is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.candidate import MOST_NUMBERS, UNNAMED, Group, as_candidate, group, places, too_wide
from latticebench.diagnosis.courses import forces_of_any_course, smooth_patterns, travelling_waves, unsteady_terms
from latticebench.diagnosis.modulated import at_single_sites, coming_late, from_a_moment_on, on_neighbours, turned
from latticebench.diagnosis.placed import Force, PlacedEffect
from latticebench.diagnosis.smooth import functions_of_one_variable
from latticebench.diagnosis.tangent import Path, Tangent, force_along
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from numpy import ndarray

REAL_TERMS = (
    "u[n]**4", "u[n]**6", "u[n]**7", "sin(u[n])", "sin(2*u[n])", "cos(u[n])", "cos(2*u[n])",
    "abs(u[n])*u[n]", "t*u[n]", "t", "n*u[n]",
    "u[n+3]+u[n-3]-2*u[n]", "(u[n+1]-u[n])**2-(u[n-1]-u[n])**2", "u[n]**2*(u[n+1]+u[n-1])", "n*(u[n+1]+u[n-1]-2*u[n])",
    "t*(u[n+1]+u[n-1]-2*u[n])", "u[n]*(u[n+1]+u[n-1])",
)  # fmt: skip
SECOND_ORDER_TERMS = (
    "v[n]**3", "u[n]*v[n]", "u[n]**2*v[n]", "u[n]*v[n]**2", "n*v[n]", "t*v[n]", "v[n+1]+v[n-1]-2*v[n]",
    "(v[n+1]-v[n-1])/2", "sqrt(abs(v[n]))*sign(v[n])",
)  # fmt: skip
COMPLEX_TERMS = (
    "u[n+1]+u[n-1]-2*u[n]", "abs(u[n])**6*u[n]", "conj(u[n])", "u[n]**2", "abs(u[n])**2", "u[n]**3",
    "u[n]*(abs(u[n+1])**2+abs(u[n-1])**2)",
    "abs(u[n+1])**2*u[n+1]+abs(u[n-1])**2*u[n-1]", "u[n]**2*conj(u[n+1]+u[n-1])", "t*u[n]", "n*(u[n+1]+u[n-1]-2*u[n])",
    "t*(u[n+1]+u[n-1]-2*u[n])", "u[n]/(1+abs(u[n])**2)", "u[n+3]+u[n-3]-2*u[n]", "t*abs(u[n])**2*u[n]",
)  # fmt: skip


def unnamed(tangent: Tangent) -> list[Group]:
    """Return all of them by what they are called in a ranking."""
    kinds = (
        _terms,
        _bonds,
        _wires,
        functions_of_one_variable,
        at_single_sites,
        from_a_moment_on,
        coming_late,
        on_neighbours,
        forces_of_any_course,
        unsteady_terms,
        travelling_waves,
        smooth_patterns,
    )
    return [found for kind in kinds for found in kind(tangent)]


def _parts(path: Path) -> tuple[str, ...]:
    """Return the factors of a term: a complex field's coefficients are complex."""
    return ("", "i*") if path.is_complex else ("",)


def _terms(tangent: Tangent) -> list[Group]:
    dynamics = tangent.paths[0].record.stretches.dynamics
    real = REAL_TERMS + (SECOND_ORDER_TERMS if dynamics.order == 2 else ())
    texts: tuple[str, ...] = COMPLEX_TERMS if dynamics.is_complex else real
    kept = [
        (text, f"i*({text})") if dynamics.is_complex else (text,)
        for text in texts
        if not too_wide(Term(text), dynamics)
    ]

    def columns(_number: int, path: Path) -> ndarray:
        return path.answer(force_along(path, [Force(Term(text)) for texts in kept for text in texts]))

    every = tangent.columns(columns)
    found = []
    for k, own in enumerate(kept):
        each = len(own)
        placed = PlacedEffect(Effect("unnamed", own[0]), own)
        found += group(own[0], [as_candidate(tangent, placed, every[:, k * each : (k + 1) * each])])
    return found


def _bonds(tangent: Tangent) -> list[Group]:
    """Return candidates for one bond of another strength, and for every bond of its own."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    moving = places(tangent)
    left_ones = [k for k in moving if k + 1 in moving]
    if len(left_ones) < 2:
        return []
    parts = _parts(tangent.paths[0])

    def columns(_number: int, path: Path) -> ndarray:
        terms = [Term(f"{part}(u[n+1]-u[n])") for part in parts] + [Term(f"{part}(u[n-1]-u[n])") for part in parts]
        right, left = np.split(path.sources(terms), 2)
        sites = np.eye(dynamics.sites)[:, dynamics.moving]
        return path.answer(np.concatenate([right * sites[k] + left * sites[k + 1] for k in left_ones]))

    every = tangent.columns(columns)
    placed = PlacedEffect(Effect("unnamed", "u[n+1]-u[n]"))
    each = len(parts)
    candidates = [as_candidate(tangent, placed, every[:, j * each : (j + 1) * each]) for j in range(len(left_ones))]
    return [
        *group("another bond", candidates),
        *group("uneven bonds", [as_candidate(tangent, placed, every, random=True)]),
    ]


def _wires(tangent: Tangent) -> list[Group]:
    """Return candidates for bonds between any two sites that are no neighbours."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    moving, parts = np.array(places(tangent)), dynamics.parts
    pairs = [(a, b) for a in range(len(moving)) for b in range(a + 2, len(moving))]
    if len(pairs) < 2 or len(tangent.residual) * len(pairs) * parts > MOST_NUMBERS:
        return []

    def columns(_number: int, path: Path) -> ndarray:
        field = path.field[:, 0][..., dynamics.moving]
        found = []
        for a in range(len(moving) - 2):
            others = np.arange(a + 2, len(moving))
            pull = np.zeros((len(others), len(path.times), dynamics.parts, len(moving)))
            stretch = np.moveaxis(field[..., others] - field[..., [a]], -1, 0)
            pull[..., a] = stretch
            pull[np.arange(len(others)), ..., others] = -stretch
            every = np.stack([pull, turned(pull)], axis=1).reshape(-1, *pull.shape[1:]) if path.is_complex else pull
            found.append(path.answer(every))
        return np.concatenate(found, axis=1)

    every = tangent.columns(columns)
    candidates = [
        as_candidate(tangent, replace(UNNAMED, site=int(moving[a])), every[:, k * parts : (k + 1) * parts])
        for k, (a, _) in enumerate(pairs)
    ]
    return group("a bond between two distant sites", candidates)
