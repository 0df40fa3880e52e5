"""Forces that are smooth functions of one variable, whatever their form."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.candidate import UNNAMED, Group, as_candidate, group, places, too_wide
from latticebench.diagnosis.modulated import along_chain, in_both, in_time, turned
from latticebench.diagnosis.tangent import Path, Tangent
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from numpy import ndarray

# Chebyshev polynomials of a smooth function.
DEGREES = 12


def functions_of_one_variable(tangent: Tangent) -> list[Group]:
    """Return candidates for functions of one variable, and for terms that change in time or along the chain."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    kinds: dict[str, Callable[[Path], ndarray]] = {
        "a force that depends on u": of_field,
        "a force that depends on how far u is from its mean": of_distance,
        "a coupling that depends on the stretch": of_stretch,
        "terms that change in time": in_time,
        "terms that change along the chain": along_chain,
        "terms that change in time and along the chain": in_both,
    }
    if dynamics.order == 2:
        kinds["a force that depends on v"] = of_velocity
        kinds["a coupling that depends on how fast it is stretched"] = functools.partial(of_stretch, field="v")
    if dynamics.sites < 2 or too_wide(Term("u[n+1]+u[n-1]"), dynamics):
        kinds = {name: make for name, make in kinds.items() if not name.startswith("a coupling")}
    if len(places(tangent)) < 2:
        del kinds["terms that change along the chain"], kinds["terms that change in time and along the chain"]
    found: list[Group] = []
    for name, make in kinds.items():
        columns = tangent.columns(lambda _, path, make=make: path.answer(make(path)))  # type: ignore[misc]
        length = np.linalg.norm(columns, axis=0)
        # Equal visibility for each, but for what is too small to be seen.
        kept = length > 1e-6 * np.max(length, initial=0.0)
        found += group(name, [as_candidate(tangent, UNNAMED, columns[:, kept], random=True)])
    return found


def polynomials(size: ndarray, factor: ndarray, largest: float) -> ndarray:
    """Return Chebyshev polynomials of a variable, times a factor: (degrees, fine, N).

    Args:
        size: the variable, between 0 and `largest`.
        factor: of the polynomials.
        largest: value of the variable.

    Higher degrees are divided by their number, which makes them less likely.
    """
    x = 2 * size / max(largest, 1e-300) - 1
    values = np.polynomial.chebyshev.chebvander(x, DEGREES - 1)
    return np.asarray(np.moveaxis(values / (1.0 + np.arange(DEGREES)), -1, 0) * factor)


def _sources(path: Path, values: ndarray) -> ndarray:
    """Bring forces (columns, fine, N) into the shape of sources; complex ones once more, turned by i."""
    dynamics = path.record.stretches.dynamics
    if dynamics.is_complex:
        values = np.concatenate([values, 1j * values])
        parts = np.stack([values.real, values.imag], axis=2)
    else:
        parts = values[:, :, None].real
    return np.asarray(parts[..., dynamics.moving])


def of_field(path: Path) -> ndarray:
    """Return functions of u; of |u| times u for complex fields."""
    u = path.fields()[0]
    if path.is_complex:
        return _sources(path, polynomials(np.abs(u), u, float(np.max(np.abs(u)))))
    return _sources(path, polynomials(u - np.min(u), np.ones_like(u), float(np.ptp(u))))


def of_distance(path: Path) -> ndarray:
    """Return functions of the difference of u to its mean over the record."""
    u = path.fields()[0]
    moved = u - np.mean(u, axis=0)
    if path.is_complex:
        return _sources(path, polynomials(np.abs(moved), moved, float(np.max(np.abs(moved)))))
    return _sources(path, polynomials(moved - np.min(moved), np.ones_like(moved), float(np.ptp(moved))))


def of_velocity(path: Path) -> ndarray:
    """Return functions of v."""
    v = path.fields()[1]
    assert v is not None
    return _sources(path, polynomials(v - np.min(v), np.ones_like(v), float(np.ptp(v))))


def of_stretch(path: Path, field: str = "u") -> ndarray:
    """Return functions of each spring's stretch, or with v of its rate, odd as action and reaction are."""
    dynamics = path.record.stretches.dynamics
    first, second = path.sources([Term(f"{field}[n+1]-{field}[n]"), Term(f"{field}[n-1]-{field}[n]")])
    stretches = np.stack([first, second])
    size = np.linalg.norm(stretches, axis=2, keepdims=True)
    x = 2 * size / max(float(np.max(size)), 1e-300) - 1
    values = np.polynomial.chebyshev.chebvander(x, DEGREES - 1) / (1.0 + np.arange(DEGREES))
    pulls = np.moveaxis(np.sum(values * stretches[..., None], axis=0), -1, 0)
    if dynamics.is_complex:
        pulls = np.concatenate([pulls, turned(pulls)])
    return np.asarray(pulls)
