"""Candidates for terms of the model that are not what they are declared to be.

They change in time, along the chain, at one site or from some moment on, come late, or act on the neighbours.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.candidate import MOST_NUMBERS, UNNAMED, Group, as_candidate, group, places, too_wide
from latticebench.diagnosis.catalogued import lags
from latticebench.diagnosis.tangent import Path, Tangent, own_forces
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from numpy import ndarray

# Half waves of what changes in time, and along the chain.
HALF_WAVES, MODES = 6, 6
MOMENTS = 16


def turned(values: ndarray) -> ndarray:
    """Multiply complex values (..., 2, M) by i."""
    return np.stack([-values[..., 1, :], values[..., 0, :]], axis=-2)


def steady_terms(path: Path, *, field: bool = True) -> ndarray:
    """Return the values of the terms that may be modulated (terms, fine, parts, M).

    These are the model's own terms that do not depend on the time, the velocity by itself and, with `field`, the field
    by itself. Complex ones are there once more, turned by i.
    """
    dynamics = path.record.stretches.dynamics
    own = [
        (term, weights) for term, weights in zip(dynamics.terms, _weights(path), strict=True) if "t" not in term.names
    ]
    own += [(Term(f"{name}[n]"), np.ones(dynamics.count)) for name in "uv"[: dynamics.order]]
    plain = [own[k] for k in _distinct(tuple(term.text for term, _ in own))]
    if not field:
        plain = [(term, weights) for term, weights in plain if term.text not in ("u[n]", "i*u[n]")]
    if not plain:
        return np.zeros((0, len(path.times), dynamics.parts, dynamics.count))
    each = path.sources([term for term, _ in plain]) * np.stack([weights for _, weights in plain])[:, None, None]
    return np.concatenate([np.stack([one, turned(one)]) for one in each]) if path.is_complex else each


@functools.cache
def _distinct(texts: tuple[str, ...]) -> tuple[int, ...]:
    """Return the numbers of the terms that are not an earlier one times 1, -1, i or -i."""
    import sympy

    found: list[int] = []
    expressions = [Term(text).expression for text in texts]
    for k, one in enumerate(expressions):
        turns = (one - factor * expressions[j] for j in found for factor in (1, -1, sympy.I, -sympy.I))
        if not any(sympy.expand(turn) == 0 for turn in turns):
            found.append(k)
    return tuple(found)


def _weights(path: Path) -> ndarray:
    dynamics = path.record.stretches.dynamics
    weights = np.ones((len(dynamics.terms), dynamics.sites)) if dynamics.weights is None else dynamics.weights
    return np.asarray(weights[:, dynamics.moving])


def elapsed(t: ndarray) -> ndarray:
    """Return times as shares of a record."""
    return np.asarray((t - t[0]) / (t[-1] - t[0]))


def in_time(path: Path) -> ndarray:
    """Return the steady terms times half waves in time."""
    each, x = steady_terms(path), elapsed(path.times)
    return np.concatenate([each * np.cos(np.pi * k * x)[:, None, None] / k for k in range(1, HALF_WAVES + 1)])


def along_chain(path: Path) -> ndarray:
    """Return the steady terms times half waves along the chain."""
    dynamics = path.record.stretches.dynamics
    each = steady_terms(path)
    place = ((np.arange(dynamics.sites) + 0.5) / dynamics.sites)[dynamics.moving]
    return np.concatenate([each * np.cos(np.pi * k * place) / k for k in range(1, MODES + 1)])


def in_both(path: Path) -> ndarray:
    """Return the steady terms times products of both kinds of half waves."""
    each, along = steady_terms(path), along_chain(path)
    x = elapsed(path.times)
    waves = range(1, HALF_WAVES)
    return np.concatenate([some * np.cos(np.pi * k * x)[:, None, None] / k for some in (each, along) for k in waves])


def at_single_sites(tangent: Tangent) -> list[Group]:
    """Return candidates for a steady term at one site, and with a coefficient of its own at each.

    For the field itself both are in the catalogue.
    """
    moving, dynamics = places(tangent), tangent.paths[0].record.stretches.dynamics
    if len(moving) < 2 or len(tangent.residual) * len(moving) * len(dynamics.terms) > MOST_NUMBERS:
        return []
    if not len(steady_terms(tangent.paths[0], field=False)):
        return []
    each = dynamics.parts

    def columns(_number: int, path: Path) -> ndarray:
        terms = steady_terms(path, field=False)
        sites = np.eye(dynamics.sites)[moving][:, dynamics.moving]
        # Of each term all sites, and of each site the term and what it is turned by i.
        kinds = terms.reshape(-1, 1, each, *terms.shape[1:]) * sites[:, None, None, None]
        return path.answer(kinds.reshape(-1, *terms.shape[1:]))

    every = tangent.columns(columns)
    candidates = [
        as_candidate(
            tangent,
            replace(UNNAMED, site=moving[k % len(moving)]),
            every[:, k * each : (k + 1) * each],
        )
        for k in range(every.shape[1] // each)
    ]
    apart = np.split(every, every.shape[1] // (each * len(moving)), axis=1)
    return [
        *group("a term that is another at one site", candidates),
        *group(
            "a term that is another at each site", [as_candidate(tangent, UNNAMED, one, random=True) for one in apart]
        ),
    ]


def from_a_moment_on(tangent: Tangent) -> list[Group]:
    """Return candidates for a steady term that changes at one moment."""
    begin, end = min(path.times[0] for path in tangent.paths), max(path.times[-1] for path in tangent.paths)
    moments = np.linspace(begin, end, MOMENTS + 2)[1:-1]

    def later(path: Path) -> ndarray:
        each = steady_terms(path)
        return np.concatenate([each * (path.times > moment)[:, None, None] for moment in moments])

    return in_turn(tangent, "a term that changes at one moment", later)


def in_turn(tangent: Tangent, name: str, make: Callable[[Path], ndarray]) -> list[Group]:
    """Return a group of forces, one candidate each; a complex one with what it is turned by i."""
    every = tangent.columns(lambda _, path: path.answer(make(path)))
    each = tangent.paths[0].record.stretches.dynamics.parts
    return group(name, [as_candidate(tangent, UNNAMED, every[:, k : k + each]) for k in range(0, every.shape[1], each)])


def coming_late(tangent: Tangent) -> list[Group]:
    """Return candidates for a steady term, and the neighbours' sum, as it was some time before.

    Before the record it is what it was at its beginning. The field itself as it was is in the catalogue: memory.
    """
    dynamics = tangent.paths[0].record.stretches.dynamics
    beside = Term("u[n+1]+u[n-1]")
    alone = dynamics.sites < 2 or too_wide(beside, dynamics)
    delays = lags(tangent) if not alone or len(steady_terms(tangent.paths[0], field=False)) else []

    def late(path: Path) -> ndarray:
        from scipy.interpolate import CubicSpline

        kinds = [steady_terms(path, field=False)]
        if not alone:
            (sum_of_both,) = path.sources([beside])
            kinds.append(np.stack([sum_of_both, turned(sum_of_both)] if path.is_complex else [sum_of_both]))
        curve = CubicSpline(path.times, np.concatenate(kinds), axis=1)
        return np.concatenate([curve(np.maximum(path.times - delay, path.times[0])) for delay in delays])

    return in_turn(tangent, "a term that comes late", late) if len(delays) else []


def on_neighbours(tangent: Tangent) -> list[Group]:
    """Return candidates for a steady term, or the whole right-hand side (shared inertia), as the neighbours have it."""
    if len(places(tangent)) < 2:
        return []
    coefficients = tangent.fitted.solution.state.coefficients

    def shared(path: Path) -> ndarray:
        whole = np.tensordot(coefficients, own_forces(path), (0, 0))
        every = np.concatenate([steady_terms(path), np.stack([whole, turned(whole)] if path.is_complex else [whole])])
        count = every.shape[-1]
        return np.asarray(every @ (np.eye(count, k=1) + np.eye(count, k=-1)))

    return in_turn(tangent, "a term that acts on the neighbours", shared)
