"""A term that swings at a frequency of its own."""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.acting.placed import Force, InStep, Placed, Summand, decimal, since
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from numpy import ndarray
    from typing_extensions import Self


@dataclass(frozen=True)
class Wave(InStep):
    """The factor s**power * cos(omega s), or sin(omega s), with s = t - middle, the same at all sites.

    Attributes:
        name: "cos" or "sin".
        omega: angular frequency, one over the unit of time.
        middle: the time of phase zero.
        power: of s, for derivatives by omega.
    """

    name: Literal["cos", "sin"]
    omega: float
    middle: float = 0.0
    power: int = 0

    def __call__(self, t: ndarray) -> ndarray:
        """Return its values (1, B, 1)."""
        function = np.cos if self.name == "cos" else np.sin
        s = t - self.middle
        return np.asarray((s**self.power * function(self.omega * s))[None, :, None])

    def __str__(self) -> str:
        """Return it in the term language."""
        s = since(self.middle)
        return f"{f'{s}**{self.power}*' if self.power else ''}{self.name}({self.omega!r}*{s})"


@dataclass(frozen=True, eq=False, kw_only=True)
class Swinging(Placed):
    """A term times a cos(omega s) + b sin(omega s) with s = t - middle.

    Attributes:
        texts: T, or T and i*T for complex coefficients.
        omega: angular frequency, one over the unit of time.
        middle: the time of phase zero, near the middle of the recording, where phase and frequency are independent.
    """

    texts: tuple[str, ...]
    omega: float
    middle: float = 0.0
    shape: ClassVar[tuple[str, ...]] = ("omega",)
    timed: ClassVar[bool] = True

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return cosine and sine of each term."""
        waves = (f"{name}({self.omega:.6g}*{since(self.middle)})" for name in ("cos", "sin"))
        return tuple(wave if text == "1" else f"{wave}*{_factor(text)}" for wave in waves for text in self.texts)

    @property
    def near(self) -> tuple[object, ...]:
        """The effect and its frequency, to two digits."""
        return (*self.place, f"{self.omega:.2g}")

    @property
    def frequency(self) -> float:
        """The angular frequency."""
        return self.omega

    def tuned(self, frequency: float) -> Self:
        """Return it at another angular frequency."""
        return replace(self, omega=frequency)

    def beside(self, others: Sequence[Placed]) -> Sequence[Placed]:
        """Return the waves at the next frequencies to both sides, without those in the line that this one makes."""
        alike = [
            one for one in others
            if one.effect is self.effect and isinstance(one, Swinging) and one.place == self.place
        ]  # fmt: skip
        alike.sort(key=lambda one: one.omega)
        here = bisect.bisect(alike, self.omega, key=lambda one: one.omega)
        near, far = rules.LINE, rules.AROUND
        return [*alike[max(here - far, 0) : max(here - near, 0)], *alike[here + near : here + far]]

    def waves(self, chain: Chain) -> list[Force]:
        """Return the waves and, for the frequency, their derivatives by it."""
        last, count, share, found = len(self.strength), len(self.texts), self.share(chain), []
        for k, text in enumerate(self.texts):
            a, b = self.strength[k], self.strength[count + k]
            found += [
                Force(text, a, {k: 1.0}, share, Wave("cos", self.omega, self.middle)),
                Force(text, b, {count + k: 1.0}, share, Wave("sin", self.omega, self.middle)),
            ]
            if a or b:
                found += [
                    Force(text, 0.0, {last: -a}, share, Wave("sin", self.omega, self.middle, 1)),
                    Force(text, 0.0, {last: b}, share, Wave("cos", self.omega, self.middle, 1)),
                ]
        return found


@dataclass(frozen=True, eq=False, kw_only=True)
class Harmonic(Swinging, acts="harmonic"):
    """A force that swings, at every site alike."""

    separated_by: ClassVar[str] = (
        "another recording, begun at another time: what is driven from outside keeps its own time, whatever the chain "
        "does"
    )

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every frequency of the scene; besides, what acts through the field does so through declared terms."""
        texts = scene.terms(effect)
        for omega in scene.frequencies if texts else ():
            still = (0.0,) * (2 * len(texts))
            yield cls(effect=effect, texts=texts, omega=float(omega), middle=scene.middle, strength=still)
        if any(Term(text).names & {"u", "v"} for text in texts) and len(scene.frequencies):
            # It is tuned to the frequency of what it stands in for.
            any_ = float(scene.frequencies[0])
            for text in scene.texts:
                if text not in texts and Term(text).names & {"u", "v"}:
                    yield Modulated(effect=effect, texts=(text,), omega=any_, middle=scene.middle, strength=(0.0, 0.0))

    def forces(self, chain: Chain) -> list[Force]:
        """Return the waves and, for the frequency, their derivatives by it."""
        return self.waves(chain)

    def summands(self, chain: Chain) -> list[Summand]:
        """Return the waves."""
        import sympy

        t = sympy.Symbol("t", real=True)
        # Unevaluated, so that SymPy does not multiply the bracket out.
        since_then = sympy.UnevaluatedExpr(t - decimal(self.middle)) if self.middle else t
        phase = sympy.Float(self.omega, 6) * since_then
        bodies = [wave(phase) * Term(text).in_decimals for wave in (sympy.cos, sympy.sin) for text in self.texts]
        return [Summand(*one) for one in zip(self.labels(chain), self.strength, bodies, strict=True)]


@dataclass(frozen=True, eq=False, kw_only=True)
class Modulated(Harmonic):
    """A declared term whose coefficient swings."""

    general: ClassVar[bool] = True

    @property
    def place(self) -> tuple[object, ...]:
        """The effect and its term."""
        return (self.effect.name, *self.texts)


def _factor(text: str) -> str:
    """Return a term as one that is multiplied: a sum in brackets."""
    return f"({text})" if "+" in text or "-" in text else text
