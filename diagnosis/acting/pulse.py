"""A term that acts for a while."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.acting.placed import DIGITS, Force, InStep, Placed, Summand, decimal, since
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from typing import Self

    from numpy import ndarray

# Middles that are tried of each width, at most, and the ratio of one width to the next.
MOST_MIDDLES, WIDER = 60, 3.0


@dataclass(frozen=True)
class Bell(InStep):
    """The factor x**power * exp(-x^2 / 2) with x = (t - at) / width, the same at all sites.

    Attributes:
        at, width: in the unit of time.
        power: of x, for derivatives by middle and width.
    """

    at: float
    width: float
    power: int = 0

    def __call__(self, t: ndarray) -> ndarray:
        """Return its values (1, B, 1)."""
        x = (t - self.at) / self.width
        return np.asarray((x**self.power * np.exp(-(x**2) / 2))[None, :, None])

    def __str__(self) -> str:
        """Return it in the term language."""
        x = f"((t-{self.at!r})/{abs(self.width)!r})"
        return f"{x}**{self.power}*exp(-{x}**2/2)" if self.power else f"exp(-{x}**2/2)"


@dataclass(frozen=True, eq=False, kw_only=True)
class Pulse(Placed, acts="pulse"):
    """A term times exp(-((t - at) / width)^2 / 2), at every site alike.

    Attributes:
        texts: T, or T and i*T for a complex coefficient.
        at, width: in the unit of time.
        seen: the first and the last time of all recordings, between which its middle is.
    """

    texts: tuple[str, ...]
    at: float
    width: float
    seen: tuple[float, float] = (-np.inf, np.inf)
    shape: ClassVar[tuple[str, ...]] = ("at", "width")
    timed: ClassVar[bool] = True
    separated_by: ClassVar[str] = (
        "another recording, begun at another time: what is driven from outside keeps its own time, whatever the chain "
        "does"
    )

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return pulses of several widths all over the recording."""
        texts = scene.terms(effect)
        still = (0.0,) * len(texts)
        for at, width in bells(scene) if texts else ():
            yield cls(effect=effect, texts=texts, at=at, width=width, seen=scene.seen, strength=still)

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the pulse of each term."""
        shape = f"exp(-({since(self._middle)}/{abs(self.width):.6g})**2/2)"
        return tuple(shape if text == "1" else f"{shape}*{text}" for text in self.texts)

    @property
    def _middle(self) -> float:
        """Its middle with as many digits as its width asks for, whatever the clock counts from."""
        return round(self.at, 3 - int(np.floor(np.log10(abs(self.width) + 1e-300))))

    @property
    def near(self) -> tuple[object, ...]:
        """The effect and its middle, to a width."""
        return (*self.place, f"{self.at / max(abs(self.width), 1e-300):.0f}")

    @property
    def moment(self) -> tuple[float, float]:
        """Its middle and its width."""
        return self.at, abs(self.width)

    def at_moment(self, moment: tuple[float, float]) -> Self:
        """Return it at another time, of another width."""
        at, width = moment
        return replace(self, at=at, width=width)

    def beside(self, others: Sequence[Placed]) -> Sequence[Placed]:
        """Return the next pulses of its width, before and after, that hardly overlap with it."""
        own = max(abs(self.width), 1e-300)
        alike = [one for one in others if isinstance(one, Pulse) and one.place == self.place]
        width = min((one.width for one in alike), key=lambda one: abs(np.log(one / own)), default=own)
        apart = [one for one in alike if one.width == width and abs(one.at - self.at) > rules.APART * max(own, width)]
        return sorted(apart, key=lambda one: abs(one.at - self.at))[: rules.AROUND]

    @property
    def possible(self) -> bool:
        """Whether its middle is between the first and the last time: a flank alone tells no strength, time or width."""
        return self.seen[0] <= self.at <= self.seen[1]

    @property
    def begins(self) -> float:
        """Its middle: before, its strength is not known."""
        return self.at

    def forces(self, chain: Chain) -> list[Force]:
        """Return the pulse and, for middle and width, its derivatives by them."""
        last, share, found = len(self.strength), self.share(chain), []
        for k, (text, a) in enumerate(zip(self.texts, self.strength, strict=True)):
            found.append(Force(text, a, {k: 1.0}, share, Bell(self.at, self.width)))
            if a:
                found.append(Force(text, 0.0, {last: a / self.width}, share, Bell(self.at, self.width, 1)))
                found.append(Force(text, 0.0, {last + 1: a / self.width}, share, Bell(self.at, self.width, 2)))
        return found

    def summands(self, chain: Chain) -> list[Summand]:
        """Return the pulse."""
        import sympy

        t = sympy.Symbol("t", real=True)
        square = (t - decimal(self._middle)) ** 2
        # Unevaluated, so that the numbers stand where a reader looks for them.
        below = sympy.Mul(2, sympy.Pow(sympy.Float(abs(self.width), DIGITS), 2, evaluate=False), evaluate=False)
        exponent = sympy.Mul(-1, square, sympy.Pow(below, -1, evaluate=False), evaluate=False)
        body = sympy.exp(sympy.UnevaluatedExpr(exponent))
        bodies = [body * Term(text).in_decimals for text in self.texts]
        return [Summand(*one) for one in zip(self.labels(chain), self.strength, bodies, strict=True)]


def bells(scene: Scene) -> Iterator[tuple[float, float]]:
    """Return middles and widths of pulses all over the recording, in the unit of time."""
    width = 1.0 / scene.top
    while width < scene.span / 6:
        for at in scene.begin + np.arange(0, scene.span, max(1.5 * width, scene.span / MOST_MIDDLES)):
            yield float(at), width
        width *= WIDER
