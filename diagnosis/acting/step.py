"""A coefficient that is another one from one time on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Force, Placed
from latticebench.diagnosis.acting.pulse import MOST_MIDDLES
from latticebench.diagnosis.acting.ramp import changing
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.diagnosis.acting.sudden import Sudden
from latticebench.systems.effects import Effect

# The width of a step over the shortest time in which the motion changes by a radian: what moves has no time to notice
# whether it is less, and a sharper one asks for shorter steps of integration.
SHARP = 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class Step(Sudden, acts="step"):
    """A term times strength * (1 + tanh((t - at) / width)) / 2: a spring that slips, a screw that comes loose.

    Attributes:
        text: the term.
    """

    text: str

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every term whose coefficient may change, at times all over the recording."""
        apart = scene.span / MOST_MIDDLES
        for text in changing(effect, scene):
            for at in scene.begin + apart * np.arange(1, MOST_MIDDLES):
                yield cls(
                    effect=effect, text=text, at=float(at), width=apart / 2, least=SHARP / scene.top, seen=scene.seen,
                    strength=(0.0,),
                )  # fmt: skip

    @property
    def place(self) -> tuple[object, ...]:
        """The effect and its term."""
        return (self.effect.name, self.text)

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the term with its factor."""
        return (f"step of {self.text}",)

    def forces(self, chain: Chain) -> list[Force]:  # noqa: ARG002
        """Return the step and, for time and width, its derivatives by them."""
        return self.rising(self.text)

    def sentences(self, chain: Chain) -> list[str]:  # noqa: ARG002
        """Return by how much the coefficient changes, and when."""
        more = f"{self.strength[0]:.{DIGITS}g}"
        return [f"from t = {self.at:.{DIGITS}g} on, the coefficient of {self.text} changes by {more}"]
