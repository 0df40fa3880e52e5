"""Ways for a motion without a name to be there, that compete with the catalogue's effects (readings without one: `diagnosis.misreadings`).

- Single terms that physicists use and the catalogue lacks; they can be fitted in full.
- One bond, between neighbours or any two sites, that is another than declared.
- Smooth functions of one variable, whatever their form: a force that depends on the field, on how far it is from its mean, on the velocity, on a spring's stretch or how fast it is stretched; a
  declared term that changes in time, along the chain, or in both. They are random effects of unknown variance (`diagnosis.trace`).
- A declared term that is another at one site or at each, from some moment on, that comes late, or that acts on the neighbours.
- A force or a declared term of any course in time; a force at one site, of its own at each, or alike at all; a force at one site and a
  declared term that swing at one frequency; a force that travels as a wave.
- Smooth forces in space and time: nets for whatever else there is.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.model import Change, Force
from latticebench.diagnosis.tangent import Path, Tangent, force_along, forces
from latticebench.diagnosis.ways import Try, attempt, lags, places, too_wide
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

REAL_TERMS = (
    "u[n]**4", "u[n]**6", "u[n]**7", "sin(u[n])", "sin(2*u[n])", "cos(u[n])", "cos(2*u[n])",
    "abs(u[n])*u[n]", "t*u[n]", "t", "n*u[n]",
    "u[n+3]+u[n-3]-2*u[n]", "(u[n+1]-u[n])**2-(u[n-1]-u[n])**2", "u[n]**2*(u[n+1]+u[n-1])", "n*(u[n+1]+u[n-1]-2*u[n])",
    "t*(u[n+1]+u[n-1]-2*u[n])", "u[n]*(u[n+1]+u[n-1])",
)  # fmt: skip
SECOND_ORDER_TERMS = (
    "v[n]**3", "u[n]*v[n]", "u[n]**2*v[n]", "u[n]*v[n]**2", "n*v[n]", "t*v[n]", "v[n+1]+v[n-1]-2*v[n]", "(v[n+1]-v[n-1])/2",
    "sqrt(abs(v[n]))*sign(v[n])",
)  # fmt: skip
COMPLEX_TERMS = (
    "u[n+1]+u[n-1]-2*u[n]", "abs(u[n])**6*u[n]", "conj(u[n])", "u[n]**2", "abs(u[n])**2", "u[n]**3", "u[n]*(abs(u[n+1])**2+abs(u[n-1])**2)",
    "abs(u[n+1])**2*u[n+1]+abs(u[n-1])**2*u[n-1]", "u[n]**2*conj(u[n+1]+u[n-1])", "t*u[n]", "n*(u[n+1]+u[n-1]-2*u[n])",
    "t*(u[n+1]+u[n-1]-2*u[n])", "u[n]/(1+abs(u[n])**2)", "u[n+3]+u[n-3]-2*u[n]", "t*abs(u[n])**2*u[n]",
)  # fmt: skip
# Chebyshev polynomials of a smooth function, and half waves of what changes in time.
DEGREES, HALF_WAVES = 12, 6
MODES = 6
# Half waves of a course in time at one place; fewer where the columns of all sites would be more numbers than this.
COURSE, MOST_NUMBERS = 16, 20_000_000
# Half waves of what is alike at all sites.
SUPPLY = 24
MOMENTS = 16
# Whole waves in the record and half waves along the chain of a travelling force, at most.
WAVES, STANDING = 12, 24

Group = tuple[str, list[Try]]


def unnamed(tangent: Tangent) -> list[Group]:
    """List all of them by what they are called in a ranking."""
    kinds = (_terms, _bonds, _wires, _functions, _uneven, _moments, _lags, _beside, _courses, _unsteady, _waves, _nets)
    return [found for kind in kinds for found in kind(tangent)]


def _parts(path: Path) -> tuple[str, ...]:
    """Give the factors of a term: a complex field's coefficients are complex."""
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
        return path.answer(force_along(path, [Force(Term(text)) for group in kept for text in group]))

    every = tangent.columns(columns)
    found = []
    for k, group in enumerate(kept):
        each = len(group)
        one = attempt(tangent, Change(Effect("unnamed", group[0]), group), every[:, k * each : (k + 1) * each])
        if one is not None:
            found.append((group[0], [one]))
    return found


def _bonds(tangent: Tangent) -> list[Group]:
    """Give one bond of another strength, and every bond of its own."""
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
    change = Change(Effect("unnamed", "u[n+1]-u[n]"))
    each = len(parts)
    tries = [attempt(tangent, change, every[:, j * each : (j + 1) * each]) for j in range(len(left_ones))]
    return [
        *group("another bond", tries),
        *group("uneven bonds", [attempt(tangent, change, every, random=True)]),
    ]


def _wires(tangent: Tangent) -> list[Group]:
    """Give bonds between any two sites that are no neighbours."""
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
    change = Change(Effect("unnamed", "0"))
    tries = [
        attempt(tangent, replace(change, site=int(moving[a])), every[:, k * parts : (k + 1) * parts])
        for k, (a, _) in enumerate(pairs)
    ]
    return group("a bond between two distant sites", tries)


def _functions(tangent: Tangent) -> list[Group]:
    """Give forces that are smooth functions of one variable, and declared terms that change in time."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    kinds: dict[str, Callable[[Path], ndarray]] = {
        "a force that depends on u": _of_field,
        "a force that depends on how far u is from its mean": _of_distance,
        "a coupling that depends on the stretch": _of_stretch,
        "terms that change in time": _in_time,
        "terms that change along the chain": _along,
        "terms that change in time and along the chain": _in_both,
    }
    if dynamics.order == 2:
        kinds["a force that depends on v"] = _of_velocity
        kinds["a coupling that depends on how fast it is stretched"] = functools.partial(_of_stretch, field="v")
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
        found += group(name, [attempt(tangent, Change(Effect("unnamed", "0")), columns[:, kept], random=True)])
    return found


def polynomials(size: ndarray, factor: ndarray, largest: float) -> ndarray:
    """Give Chebyshev polynomials of a variable between 0 and its largest size, times a factor: (degrees, fine, N); higher ones are less likely."""
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


def _of_field(path: Path) -> ndarray:
    u = path.fields()[0]
    if path.is_complex:
        return _sources(path, polynomials(np.abs(u), u, float(np.max(np.abs(u)))))
    return _sources(path, polynomials(u - np.min(u), np.ones_like(u), float(np.ptp(u))))


def _of_distance(path: Path) -> ndarray:
    u = path.fields()[0]
    moved = u - np.mean(u, axis=0)
    if path.is_complex:
        return _sources(path, polynomials(np.abs(moved), moved, float(np.max(np.abs(moved)))))
    return _sources(path, polynomials(moved - np.min(moved), np.ones_like(moved), float(np.ptp(moved))))


def _of_velocity(path: Path) -> ndarray:
    v = path.fields()[1]
    assert v is not None
    return _sources(path, polynomials(v - np.min(v), np.ones_like(v), float(np.ptp(v))))


def _of_stretch(path: Path, field: str = "u") -> ndarray:
    """Give functions of each spring's stretch, or with v of its rate, odd as action and reaction are."""
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


def _steady(path: Path, *, field: bool = True) -> ndarray:
    """Give each term of the model that does not know the time, the velocity and, if wanted, the field itself: (terms, fine, parts, M).

    Complex ones once more, turned by i.
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
    """Give the numbers of the terms that are not an earlier one times 1, -1, i or -i."""
    import sympy

    found: list[int] = []
    expressions = [Term(text).expression for text in texts]
    for k, one in enumerate(expressions):
        turns = (one - factor * expressions[j] for j in found for factor in (1, -1, sympy.I, -sympy.I))
        if not any(sympy.expand(turn) == 0 for turn in turns):
            found.append(k)
    return tuple(found)


def turned(values: ndarray) -> ndarray:
    """Multiply complex values (..., 2, M) by i."""
    return np.stack([-values[..., 1, :], values[..., 0, :]], axis=-2)


def _in_time(path: Path) -> ndarray:
    """Give those terms times half waves in time."""
    each, x = _steady(path), share(path.times)
    return np.concatenate([each * np.cos(np.pi * k * x)[:, None, None] / k for k in range(1, HALF_WAVES + 1)])


def _along(path: Path) -> ndarray:
    """Give those terms times half waves along the chain."""
    dynamics = path.record.stretches.dynamics
    each = _steady(path)
    place = ((np.arange(dynamics.sites) + 0.5) / dynamics.sites)[dynamics.moving]
    return np.concatenate([each * np.cos(np.pi * k * place) / k for k in range(1, MODES + 1)])


def _in_both(path: Path) -> ndarray:
    """Give those terms times products of both."""
    each, along = _steady(path), _along(path)
    x = share(path.times)
    waves = range(1, HALF_WAVES)
    return np.concatenate([some * np.cos(np.pi * k * x)[:, None, None] / k for some in (each, along) for k in waves])


def share(t: ndarray) -> ndarray:
    """Give times as shares of a record."""
    return np.asarray((t - t[0]) / (t[-1] - t[0]))


def _uneven(tangent: Tangent) -> list[Group]:
    """Give each of those terms as it would be at one site, and of its own at each; with the field itself both have names."""
    moving, dynamics = places(tangent), tangent.paths[0].record.stretches.dynamics
    if len(moving) < 2 or len(tangent.residual) * len(moving) * len(dynamics.terms) > MOST_NUMBERS:
        return []
    if not len(_steady(tangent.paths[0], field=False)):
        return []
    each = dynamics.parts

    def columns(_number: int, path: Path) -> ndarray:
        terms = _steady(path, field=False)
        sites = np.eye(dynamics.sites)[moving][:, dynamics.moving]
        # Of each term all sites, and of each site the term and what it is turned by i.
        kinds = terms.reshape(-1, 1, each, *terms.shape[1:]) * sites[:, None, None, None]
        return path.answer(kinds.reshape(-1, *terms.shape[1:]))

    every = tangent.columns(columns)
    tries = [
        attempt(
            tangent, Change(Effect("unnamed", "0"), site=moving[k % len(moving)]), every[:, k * each : (k + 1) * each]
        )
        for k in range(every.shape[1] // each)
    ]
    apart = np.split(every, every.shape[1] // (each * len(moving)), axis=1)
    change = Change(Effect("unnamed", "0"))
    return [
        *group("a term that is another at one site", tries),
        *group("a term that is another at each site", [attempt(tangent, change, one, random=True) for one in apart]),
    ]


def _moments(tangent: Tangent) -> list[Group]:
    """Give each of those terms as it would be from some moment on."""
    begin, end = min(path.times[0] for path in tangent.paths), max(path.times[-1] for path in tangent.paths)
    moments = np.linspace(begin, end, MOMENTS + 2)[1:-1]

    def later(path: Path) -> ndarray:
        each = _steady(path)
        return np.concatenate([each * (path.times > moment)[:, None, None] for moment in moments])

    return _in_turn(tangent, "a term that changes at one moment", later)


def _in_turn(tangent: Tangent, name: str, make: Callable[[Path], ndarray]) -> list[Group]:
    """Try forces one after the other, a complex one with what it is turned by i."""
    every = tangent.columns(lambda _, path: path.answer(make(path)))
    change, each = Change(Effect("unnamed", "0")), tangent.paths[0].record.stretches.dynamics.parts
    return group(name, [attempt(tangent, change, every[:, k : k + each]) for k in range(0, every.shape[1], each)])


def _lags(tangent: Tangent) -> list[Group]:
    """Give each of those terms, and the neighbours' sum, as it was some time before; before the record it is what it was at its beginning.

    The field itself as it was has a name: memory.
    """
    dynamics = tangent.paths[0].record.stretches.dynamics
    beside = Term("u[n+1]+u[n-1]")
    alone = dynamics.sites < 2 or too_wide(beside, dynamics)
    delays = lags(tangent) if not alone or len(_steady(tangent.paths[0], field=False)) else []

    def late(path: Path) -> ndarray:
        from scipy.interpolate import CubicSpline

        kinds = [_steady(path, field=False)]
        if not alone:
            (sum_of_both,) = path.sources([beside])
            kinds.append(np.stack([sum_of_both, turned(sum_of_both)] if path.is_complex else [sum_of_both]))
        curve = CubicSpline(path.times, np.concatenate(kinds), axis=1)
        return np.concatenate([curve(np.maximum(path.times - delay, path.times[0])) for delay in delays])

    return _in_turn(tangent, "a term that comes late", late) if len(delays) else []


def _beside(tangent: Tangent) -> list[Group]:
    """Give each of those terms, and the whole right-hand side (inertia that is shared), as the neighbours have it."""
    if len(places(tangent)) < 2:
        return []
    coefficients = tangent.fitted.solution.state.coefficients

    def shared(path: Path) -> ndarray:
        whole = np.tensordot(coefficients, forces(path), (0, 0))
        every = np.concatenate([_steady(path), np.stack([whole, turned(whole)] if path.is_complex else [whole])])
        count = every.shape[-1]
        return np.asarray(every @ (np.eye(count, k=1) + np.eye(count, k=-1)))

    return _in_turn(tangent, "a term that acts on the neighbours", shared)


def course(tangent: Tangent) -> int:
    """Say of how many half waves a course in time at one place is made; 0 where there are too few, or no places."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    waves = min(COURSE, MOST_NUMBERS // (len(tangent.residual) * dynamics.sites * dynamics.parts))
    return waves if len(places(tangent)) > 1 and waves >= HALF_WAVES else 0


def at_each(tangent: Tangent, every: ndarray, sites: Sequence[int], waves: int) -> list[Try | None]:
    """Try courses in time at one site after the other; the higher half waves are less likely."""
    found = []
    for site, own in zip(sites, np.split(every, len(sites), axis=1), strict=True):
        rare = 1 + np.repeat(np.arange(waves), own.shape[1] // waves)
        found.append(attempt(tangent, Change(Effect("unnamed", "0"), site=site), own / rare, random=True))
    return found


def _courses(tangent: Tangent) -> list[Group]:
    """Give forces of any course in time, at one site and at all of them."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    moving, parts, waves = places(tangent), dynamics.parts, course(tangent)
    if not waves:
        return []

    def columns(_number: int, path: Path) -> ndarray:
        curves = np.cos(np.pi * np.arange(waves)[:, None] * share(path.times))
        found = []
        for site in moving:
            source = np.zeros((waves, parts, len(path.times), parts, dynamics.sites))
            for part in range(parts):
                source[:, part, :, part, site] = curves
            found.append(path.answer(source.reshape(-1, *source.shape[2:])[..., dynamics.moving]))
        return np.concatenate(found, axis=1)

    every = tangent.columns(columns)
    change = Change(Effect("unnamed", "0"))
    beats = swings(waves)
    tries = [
        attempt(tangent, replace(change, site=site), own @ beat)
        for site, own in zip(moving, np.split(every, len(moving), axis=1), strict=True)
        for beat in _each_part(beats, parts, waves)
    ]
    return [
        *group("a force at one site, of any course", at_each(tangent, every, moving, waves)),
        *group("forces at all sites, of any course", [attempt(tangent, change, every, random=True)]),
        *group("a force at one site that swings at one frequency", tries),
    ]


def swings(waves: int) -> Float[ndarray, "frequencies waves two"]:
    """Write cosine and sine of each frequency that so many half waves can show as sums of them; x runs from 0 to 1 in the record.

    Frequencies are half a wave apart, so that one between two of them is within a quarter.
    """
    x = np.linspace(0, 1, 20 * waves)
    halves = np.cos(np.pi * np.arange(waves) * x[:, None])
    # Less than a whole wave is no wave; the highest are not those of the half waves alone.
    angles = np.pi * np.arange(2, waves - 1)[:, None] * x
    beats = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.stack([np.linalg.lstsq(halves, beat, rcond=None)[0] for beat in beats])


def _each_part(beats: ndarray, parts: int, waves: int) -> list[ndarray]:
    """Let a swing act on each part of a field: columns are sorted as (waves, parts)."""
    return [np.einsum("wb,pq->wpbq", beat, np.eye(parts)).reshape(waves * parts, -1) for beat in beats]


def _unsteady(tangent: Tangent) -> list[Group]:
    """Give a force alike at all sites, and each term of the model, of any course in time."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    waves = min(SUPPLY, min(len(path.record.times) for path in tangent.paths) // 2)
    if waves < HALF_WAVES or len(tangent.residual) * waves * (len(dynamics.terms) + 3) * dynamics.parts > MOST_NUMBERS:
        return []

    def columns(_number: int, path: Path) -> ndarray:
        alike = np.zeros((dynamics.parts, len(path.times), dynamics.parts, dynamics.count))
        for part in range(dynamics.parts):
            alike[part, :, part] = 1.0
        courses = np.cos(np.pi * np.arange(waves)[:, None] * share(path.times))
        kinds = np.concatenate([alike, _steady(path)])
        kinds = kinds.reshape(-1, 1, dynamics.parts, *kinds.shape[1:]) * courses[:, None, :, None, None]
        return path.answer(kinds.reshape(-1, *alike.shape[1:]))

    every = tangent.columns(columns)
    change = Change(Effect("unnamed", "0"))
    kinds = np.split(every, every.shape[1] // (waves * dynamics.parts), axis=1)
    force, *terms = (attempt(tangent, change, one, random=True) for one in kinds)
    # A uniform force that does has a name; the field itself, too, which then does as well.
    beats = _each_part(swings(waves), dynamics.parts, waves)
    steady = [attempt(tangent, change, one @ beat) for one in kinds[1:] for beat in beats]
    return [
        *group("a force alike at all sites, of any course", [force]),
        *group("a term of any course in time", terms),
        *group("a term that swings at one frequency", steady),
    ]


def _waves(tangent: Tangent) -> list[Group]:
    """Give forces that run along the chain as a wave, or stand."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    sites, parts = dynamics.sites, dynamics.parts
    highest = min(WAVES, (min(len(path.record.times) for path in tangent.paths) - 1) // 2)
    lengths = range(2, min(STANDING, sites) + 1, 2)
    if len(places(tangent)) < 4 or len(tangent.residual) * highest * len(lengths) * 4 * parts > MOST_NUMBERS:
        return []
    n = np.arange(sites) - (sites - 1) / 2

    def columns(_number: int, path: Path) -> ndarray:
        x = share(path.times)
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
    change, each = Change(Effect("unnamed", "0")), 4 * parts
    tries = [attempt(tangent, change, every[:, k : k + each]) for k in range(0, every.shape[1], each)]
    return group("a wave of force along the chain", tries)


def _weights(path: Path) -> ndarray:
    dynamics = path.record.stretches.dynamics
    weights = np.ones((len(dynamics.terms), dynamics.sites)) if dynamics.weights is None else dynamics.weights
    return np.asarray(weights[:, dynamics.moving])


def modes_of(sites: int) -> list[ndarray]:
    """Give half waves along a chain."""
    place = (np.arange(sites) + 0.5) / sites
    return [np.cos(np.pi * k * place) for k in range(min(MODES, sites))]


def _nets(tangent: Tangent) -> list[Group]:
    """Give smooth forces in space and time."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    sites = dynamics.sites

    def smooth(_number: int, path: Path, low: int, high: int) -> ndarray:
        x = share(path.times)
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
        groups += group(name, [attempt(tangent, Change(Effect("unnamed", "0")), columns, random=True)])
    return groups


def group(name: str, tries: Sequence[Try | None]) -> list[Group]:
    """Give a group of what can be tried, if there is any."""
    found = [one for one in tries if one is not None]
    return [(name, found)] if found else []
