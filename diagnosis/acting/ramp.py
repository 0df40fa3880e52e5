"""A coefficient that changes steadily."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import Force, InStep, Placed, Summand, decimal, since
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from numpy import ndarray


@dataclass(frozen=True)
class Slope(InStep):
    """The factor (t - middle) / span, the same at all sites; both are in the unit of time."""

    middle: float
    span: float

    def __call__(self, t: ndarray) -> ndarray:
        """Return its values (1, B, 1)."""
        return np.asarray(((t - self.middle) / self.span)[None, :, None])

    def __str__(self) -> str:
        """Return it in the term language."""
        return f"{since(self.middle)}/{self.span:.6g}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Ramp(Placed, acts="ramp"):
    """A term times strength * (t - middle) / span: by so much its coefficient changes in the recording.

    Attributes:
        text: the term.
        slope: the factor of time; its span is that of the longest recording, about.
    """

    text: str
    slope: Slope
    slow: ClassVar[bool] = True

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every term whose coefficient may change."""
        slope = Slope(scene.middle, float(f"{scene.span:.6g}"))
        for text in changing(effect, scene):
            yield cls(effect=effect, text=text, slope=slope, strength=(0.0,))

    @property
    def place(self) -> tuple[object, ...]:
        """The effect and its term."""
        return (self.effect.name, self.text)

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the term with its factor."""
        sum_ = "+" in self.text or "-" in self.text
        return (f"{self.slope}*({self.text})" if sum_ else f"{self.slope}*{self.text}",)

    def forces(self, chain: Chain) -> list[Force]:  # noqa: ARG002
        """Return the term with its factor."""
        return [Force(self.text, self.strength[0], {0: 1.0}, None, self.slope)]

    def summands(self, chain: Chain) -> list[Summand]:
        """Return the term with its factor."""
        import sympy

        t = sympy.Symbol("t", real=True)
        # Unevaluated, so that SymPy does not multiply the bracket out.
        since_then = sympy.UnevaluatedExpr(t - decimal(self.slope.middle)) if self.slope.middle else t
        body = since_then / decimal(self.slope.span) * Term(self.text).in_decimals
        return [Summand(self.labels(chain)[0], self.strength[0], body)]


def changing(effect: Effect, scene: Scene) -> tuple[str, ...]:
    """Return the terms whose coefficient may change in time: the declared ones, and those of the effect's formula."""
    return tuple(dict.fromkeys((*scene.texts, *own))) if (own := scene.terms(effect)) else ()
