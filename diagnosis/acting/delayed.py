"""The field as it was a while ago."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Force, Placed, Summand
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.methods.engine.dynamics import Factor
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from typing import Self

    from numpy import ndarray

# Delays that are tried, in units of one over the highest frequency, and the step of the derivative as a share of one.
SHORTEST, LONGEST, TRIED, STEP = 0.5, 12.0, 8, 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class Delayed(Placed, acts="delayed"):
    """The field of the same site a delay earlier, a known function of time: strength * u_n(t - delay).

    Attributes:
        delay: in the unit of time.
        past: the field of each recording at earlier times.
    """

    delay: float
    past: tuple[Factor, ...]
    shape: ClassVar[tuple[str, ...]] = ("delay",)
    timed: ClassVar[bool] = True
    fed: ClassVar[bool] = True
    separated_by: ClassVar[str] = "a motion of other frequencies: a lag turns into another phase at each of them"

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return a few delays."""
        for delay in np.geomspace(SHORTEST, LONGEST, TRIED) / scene.top if scene.terms(effect) else ():
            yield cls(effect=effect, delay=float(delay), past=scene.past, strength=(0.0,) * scene.chain.parts)

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return the field with its time."""
        label = f"u[n](t-{self.delay:.6g})"
        return (label, f"i*{label}")[: chain.parts]

    @property
    def possible(self) -> bool:
        """Whether the past comes before the present."""
        return self.delay > 0

    def with_past(self, past: tuple[Factor, ...]) -> Self:
        """Return it with another field at earlier times."""
        return replace(self, past=past)

    def forces(self, chain: Chain) -> list[Force]:
        """Return the field as it was and, for the delay, its derivative."""
        text, last, found = ("1+i" if chain.is_complex else "1"), len(self.strength), []
        for k, a in enumerate(self.strength):
            found.append(Force(text, a, {k: 1.0}, None, tuple(self._factor(one, 0.0, k) for one in self.past)))
            if a:
                step = STEP * self.delay
                found.append(Force(text, 0.0, {last: a}, None, tuple(self._factor(one, step, k) for one in self.past)))
        return found

    def _factor(self, past: Factor, step: float, turned: int) -> Factor:
        def factor(t: ndarray) -> ndarray:
            if step:
                field = (past(t - self.delay - step) - past(t - self.delay + step)) / (2 * step)
            else:
                field = past(t - self.delay)
            return np.stack([-field[1], field[0]]) if turned else field

        return factor

    def summands(self, chain: Chain) -> list[Summand]:
        """Return the field with its time."""
        import sympy

        t = sympy.Symbol("t", real=True)
        body = sympy.Function("u_{n}")(t - sympy.Float(self.delay, DIGITS))
        bodies = [body, sympy.I * body][: chain.parts]
        return [Summand(*one) for one in zip(self.labels(chain), self.strength, bodies, strict=True)]
