"""Forces without a name: terms of the equation, and what depends on time, on the place, or on both."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting import Chain, Force
from latticebench.diagnosis.acting.swinging import Wave
from latticebench.diagnosis.unnamed.course import Course, courses, growing
from latticebench.diagnosis.unnamed.nameless import EFFECT, Nameless
from latticebench.methods.engine.dynamics import Factor
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.problem import Problem

COUPLING = "u[n+1]+u[n-1]-2*u[n]"
# Terms of a real field, those of them with a velocity, and of a complex one.
REAL = (
    "u[n]**2", "u[n]**3", "u[n]**4", "u[n]**5", "u[n]**6", "u[n]**7", "abs(u[n])*u[n]",
    "u[n+2]+u[n-2]-2*u[n]", "u[n+3]+u[n-3]-2*u[n]", "(u[n+1]-u[n-1])/2", "(u[n+1]**3-u[n-1]**3)/2",
    "(u[n+1]-u[n])**2-(u[n-1]-u[n])**2", "(u[n+1]-u[n])**3+(u[n-1]-u[n])**3",
    "u[n]**2*(u[n+1]+u[n-1])", "u[n]*(u[n+1]+u[n-1])", "u[n-1]*u[n]*u[n+1]",
    *(f"{name}({size}*u[n])" for size in (1, 2, 3, 4, 6, 8) for name in ("sin", "cos")),
)  # fmt: skip
MOVING = (
    "abs(v[n])*v[n]", "v[n]**3", "sign(v[n])", "sqrt(abs(v[n]))*sign(v[n])", "u[n]*v[n]", "u[n]**2*v[n]",
    "u[n]*v[n]**2", "v[n+1]+v[n-1]-2*v[n]", "(v[n+1]-v[n-1])/2",
)  # fmt: skip
COMPLEX = (
    "u[n+2]+u[n-2]-2*u[n]", "u[n+3]+u[n-3]-2*u[n]", "(u[n+1]-u[n-1])/2",
    "abs(u[n])*u[n]", "abs(u[n])**2*u[n]", "abs(u[n])**4*u[n]", "abs(u[n])**6*u[n]", "u[n]/(1+abs(u[n])**2)",
    "u[n]/(1+4*abs(u[n])**2)", "conj(u[n])", "u[n]**2", "abs(u[n])**2", "u[n]**3",
    "abs(u[n])**2*(u[n+1]+u[n-1])", "u[n]*(abs(u[n+1])**2+abs(u[n-1])**2)", "u[n]**2*conj(u[n+1]+u[n-1])",
    "abs(u[n+1])**2*u[n+1]+abs(u[n-1])**2*u[n-1]", "(abs(u[n+1])**2*u[n+1]-abs(u[n-1])**2*u[n-1])/2",
    "u[n-1]*conj(u[n])*u[n+1]",
)  # fmt: skip
# Sums of these are functions of a displacement, a velocity and a stretch of their own course.
WAVES = (0.5, 1, 2, 3, 4, 6)
FUNCTIONS = {
    "a function of u": [f"{name}({size}*u[n])" for size in WAVES for name in ("sin", "cos")],
    "a function of v": [f"sin({size}*v[n])" for size in WAVES],
    "a function of the stretch": [f"sin({size}*(u[n+1]-u[n]))+sin({size}*(u[n-1]-u[n]))" for size in WAVES],
}
COMPLEX_FUNCTIONS = {"a function of abs(u), times u": [f"abs(u[n])**{power}*u[n]" for power in range(1, 7)]}
# Times at which something may begin; numbers of a course in time; widths of the ends of a chain, in sites.
BEGINNINGS, SLOW, FAST, EDGE = 10, 8, 64, 1.5
# Frequencies of forces, at most.
MOST_FREQUENCIES = 200


@dataclass(frozen=True, eq=False, kw_only=True)
class Pushed(Nameless):
    """Forces, each with the strength of a number: strength * weights[n] * factor(t) * text.

    Attributes:
        parts: of each number.
    """

    parts: tuple[tuple[Force, ...], ...]

    def forces(self, chain: Chain) -> list[Force]:  # noqa: ARG002
        """Return the forces with their strengths."""
        numbered = enumerate(zip(self.parts, self.strength, strict=True))
        return [
            Force(one.text, value, {k: 1.0}, one.weights, one.factor)
            for k, (several, value) in numbered
            for one in several
        ]


def terms(problem: Problem) -> list[Pushed]:
    """Return terms at every site and time."""
    chain = problem.chain
    texts = COMPLEX if chain.is_complex else REAL + (MOVING if chain.order == 2 else ())
    single = {text: [text] for text in texts}
    functions = (
        {} if chain.order == 1 and not chain.is_complex else COMPLEX_FUNCTIONS if chain.is_complex else FUNCTIONS
    )
    return [
        _pushed(chain, said, sum_)
        for said, sum_ in {**single, **functions}.items()
        if max(max(Term(text).reach) for text in sum_) <= chain.reach
    ]


def changing(problem: Problem) -> Iterator[Pushed]:
    """Yield what changes in time: grows, or has a slow course; forces alike at all sites have a fast one."""
    chain, scene = problem.chain, problem.scene
    rows = max(len(one.t) for one in problem.data)
    for text in _base(problem):
        yield _pushed(chain, f"t*{text}" if _single(text) else f"t*({text})", [text], factors=[growing(scene)])
        yield _pushed(chain, f"{text}, of a slow course in time", [text], factors=courses(scene, SLOW))
    for count in sorted({min(rows // 4, FAST // 2), min(rows // 2, FAST)}):
        if count > SLOW:
            said = "a force of its own course in time, alike at all sites"
            yield _pushed(chain, said, ["1"], factors=courses(scene, count))


def placed(problem: Problem) -> Iterator[Pushed]:
    """Yield what differs from site to site: grows along the chain or towards its ends, or is different at each."""
    chain = problem.chain
    if len(chain.moving) < 2:
        return
    place = np.arange(chain.sites) - (chain.sites - 1) / 2
    edge = np.exp((np.abs(place) - np.max(place)) / EDGE)
    for text in _base(problem):
        if chain.sites > 3:
            yield _pushed(chain, f"{text}, growing along the chain", [text], [place / np.max(place)])
            yield _pushed(chain, f"{text}, growing towards both ends", [text], [(place / np.max(place)) ** 2])
            yield _pushed(chain, f"{text}, at both ends", [text], [edge])
        yield _pushed(chain, f"{text}, different at each site", [text], np.eye(chain.sites)[list(chain.moving)])
    bonds = [_bond(problem, here) for here in chain.moving if chain.reach and here + 1 in chain.moving]
    if len(bonds) > 1:
        yield _of(chain, "bonds of different strengths", bonds)


def beginning(problem: Problem) -> Iterator[Pushed]:
    """Yield what begins at some time: terms at all sites, forces and springs at single ones."""
    chain, scene = problem.chain, problem.scene
    for at in scene.begin + scene.span * np.arange(1, BEGINNINGS + 1) / (BEGINNINGS + 1):
        for text in _base(problem):
            yield _pushed(chain, f"{text}, from t = {at:.3g} on", [text], factors=[_from(at)])
        for here in chain.moving if chain.sites > 1 else ():
            for text in ("1", "u[n]"):
                said = f"{text}, from t = {at:.3g} on"
                yield _pushed(chain, said, [text], [np.eye(chain.sites)[here]], [_from(at)], here)


def at_sites(problem: Problem) -> Iterator[Pushed]:
    """Yield what is at single sites: terms, and bonds that one of their sites feels alone."""
    chain, sites = problem.chain, np.eye(problem.chain.sites)
    for here in chain.moving if chain.sites > 1 else ():
        for text in _base(problem):
            yield _pushed(chain, text, [text], [sites[here]], here=here)
        if chain.reach and here + 1 in chain.moving:
            for site, one in zip((here, here + 1), _bond(problem, here), strict=True):
                yield _of(chain, f"the bond to site {2 * here + 2 - site}, felt by this site alone", [(one,)], site)


def _bond(problem: Problem, here: int) -> tuple[Force, Force]:
    """Return what the bond from one site to the next does to both."""
    sites = np.eye(problem.chain.sites)
    return Force("u[n+1]-u[n]", 0.0, {}, sites[here]), Force("u[n-1]-u[n]", 0.0, {}, sites[here + 1])


def swinging(problem: Problem) -> Iterator[Pushed]:
    """Yield what swings at one frequency: forces at single sites, waves along the chain, terms at all sites."""
    chain, scene = problem.chain, problem.scene
    stride = len(scene.frequencies) // MOST_FREQUENCIES + 1
    sites = np.eye(chain.sites)
    texts = [text for text in _base(problem) if text not in ("1", "u[n]")]
    for omega in scene.frequencies[::stride]:
        waves = [Wave("cos", float(omega)), Wave("sin", float(omega))]
        for here in chain.moving if chain.sites > 1 else ():
            yield _pushed(chain, "a force of its own course in time", ["1"], [sites[here]], waves, here)
        for number in range(1, chain.sites // 2 + 1):
            angle = 2 * np.pi * number / chain.sites
            shapes = [function(angle * np.arange(chain.sites)) for function in (np.cos, np.sin)]
            yield _pushed(chain, f"a wave of wave number {angle:.3g} and angular frequency {omega:.3g}", ["1"], shapes,
                          waves)  # fmt: skip
        for text in texts:
            yield _pushed(chain, f"{text}, swinging at the angular frequency {omega:.3g}", [text], factors=waves)


def _pushed(
    chain: Chain,
    said: str,
    texts: Sequence[str],
    weights: Sequence[Float[ndarray, " sites"] | None] | ndarray = (None,),
    factors: Sequence[Course | Factor | None] = (None,),
    here: int | None = None,
) -> Pushed:
    every = ((text, weight, factor) for text in texts for weight in weights for factor in factors)
    parts = [(Force(text, 0.0, {}, weight, factor),) for text, weight, factor in every]
    return _of(chain, said, parts, here)


def _of(chain: Chain, said: str, parts: Sequence[tuple[Force, ...]], here: int | None = None) -> Pushed:
    """Return forces with a strength each, of a complex field with one for either part."""
    turned = [tuple(replace(one, text=f"i*({one.text})") for one in several) for several in parts]
    every = (*parts, *(turned if chain.is_complex else ()))
    return Pushed(effect=EFFECT, said=said, parts=every, here=here, strength=(0.0,) * len(every))


def _base(problem: Problem) -> list[str]:
    """Return the terms that may change with time and place: those declared, and those of any lattice."""
    own = [text for text in problem.declared.texts if not text.startswith("i*")]
    every = dict.fromkeys([*own, "1", "u[n]", *(["v[n]"] if problem.order == 2 else []), COUPLING])
    return [text for text in every if max(Term(text).reach) <= problem.chain.reach]


def _single(text: str) -> bool:
    return not any(sign in text for sign in "+-")


def _from(at: float) -> Factor:
    """Return 1 from a time on, 0 before."""
    return lambda t: np.asarray(t >= at, dtype=float)[None, :, None]
