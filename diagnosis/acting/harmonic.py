"""A term that swings at a frequency of its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

from latticebench.diagnosis.acting.lasting import Lasting, windows
from latticebench.diagnosis.acting.placed import Force, Placed, Summand, decimal
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.diagnosis.acting.step import SHARP
from latticebench.diagnosis.acting.swinging import Swinging
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term


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
        still = (0.0,) * (2 * len(texts))
        for omega in scene.frequencies if texts else ():
            yield cls(effect=effect, texts=texts, omega=float(omega), middle=scene.middle, strength=still)
        if any(Term(text).names & {"u", "v"} for text in texts) and len(scene.frequencies):
            # It is tuned to the frequency of what it stands in for.
            any_ = float(scene.frequencies[0])
            for text in scene.texts:
                if text not in texts and Term(text).names & {"u", "v"}:
                    yield Modulated(effect=effect, texts=(text,), omega=any_, middle=scene.middle, strength=(0.0, 0.0))
        elif texts and len(scene.frequencies):
            for begin, end, middle in windows(scene):
                yield Burst(
                    effect=effect, texts=texts, omega=float(scene.frequencies[0]), middle=middle, strength=still,
                    begin=begin, end=end, edge=SHARP / scene.top, seen=scene.seen,
                )  # fmt: skip

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


@dataclass(frozen=True, eq=False, kw_only=True)
class Burst(Lasting, Harmonic):
    """A force that swings for a while, at every site alike."""

    def summands(self, chain: Chain) -> list[Summand]:
        """Return the waves, each where it lasts."""
        import sympy

        t = sympy.Symbol("t", real=True)
        signs = {"begin": 1, "end": -1}
        steps = [sympy.Heaviside(signs[name] * (t - decimal(time))) for name, time in self.times().items()]
        return [replace(one, body=sympy.Mul(one.body, *steps)) for one in super().summands(chain)]
