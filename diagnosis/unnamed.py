"""What has no name in the catalogue but may be seen in a residual: terms, and forces at single sites."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.acting import AtOneSite, Chain, Force, Placed, Scene
from latticebench.diagnosis.acting.everywhere import Everywhere
from latticebench.diagnosis.acting.harmonic import wave
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.score import Tangent
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term

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
# Frequencies of forces at single sites, at most.
MOST_FREQUENCIES = 200


@dataclass(frozen=True)
class Left:
    """Something that is significant in a residual and has no name.

    Attributes:
        name: in words, or a term.
        gain: nats that it would win.
        price: nats that noise alone reaches in its share of `rules.FALSE_DOUBT`.
        site: where it acts, from 0; None for everywhere.
    """

    name: str
    gain: float
    price: float
    site: int | None


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalForce(AtOneSite):
    """A force at one site that swings at one frequency."""

    omega: float

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site and frequency."""
        stride = len(scene.frequencies) // MOST_FREQUENCIES + 1
        for here in scene.chain.moving:
            for omega in scene.frequencies[::stride]:
                yield cls(effect=effect, here=here, omega=float(omega), strength=(0.0,) * (2 * scene.chain.parts))

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return cosine and sine."""
        return ("cos", "sin", "i*cos", "i*sin")[: 2 * chain.parts]

    def forces(self, chain: Chain) -> list[Force]:
        """Return the waves."""
        here = np.eye(chain.sites)[self.here]
        waves = [(text, function) for text in ("1", "i")[: chain.parts] for function in (np.cos, np.sin)]
        return [
            Force(text, 0.0, {k: 1.0}, here, wave(function, self.omega, 0)) for k, (text, function) in enumerate(waves)
        ]

    def sentences(self, chain: Chain) -> list[str]:  # noqa: ARG002
        """Return what many such waves are together."""
        return ["a force of its own course in time"]


def left_in(fitted: Fitted, problem: Problem) -> tuple[Left, ...]:
    """Return what is significant in the residual of a fit without having a name, the best first."""
    terms = list(_terms(problem))
    forces = [*LocalForce.places(Effect("force-at-one-site", "1"), problem.scene)] if problem.chain.sites > 1 else []
    found = []
    tangent = Tangent(fitted)
    likely = tangent.likeliest(forces, lambda _: 0.0, lambda one: one.site)
    for kind, count in ((terms, len(terms)), (likely, len(forces))):
        for one in tangent.scored(kind):
            share = rules.FALSE_DOUBT / 2 / max(count, 1)
            price = problem.chance(share, one.freedom)
            if one.freedom and one.gain > price:
                words = [*one.placed.sentences(problem.chain), *one.placed.labels(problem.chain)]
                found.append(Left(words[0], one.gain, price, one.placed.site))
    best: dict[tuple[str, int | None], Left] = {}
    for left in sorted(found, key=lambda left: left.price - left.gain):
        best.setdefault((left.name, left.site), left)
    return tuple(best.values())


def _terms(problem: Problem) -> Iterator[Placed]:
    chain = problem.chain
    texts: tuple[str, ...] = REAL_TERMS + (SECOND_ORDER_TERMS if chain.order == 2 else ())
    for text in COMPLEX_TERMS if chain.is_complex else texts:
        if max(Term(text).reach) <= chain.reach:
            both = (text, f"i*({text})")[: chain.parts]
            yield Everywhere(effect=Effect("unnamed", text), texts=both, strength=(0.0,) * len(both))
