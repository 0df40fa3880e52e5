"""What happens at one time, sharply or within a while."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import Force, InStep, Placed, since

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@dataclass(frozen=True)
class Rise(InStep):
    """(1 + tanh x) / 2 with x = (t - at) / wide, or its derivative -x**power / (2 cosh(x)^2), alike at all sites.

    Attributes:
        at, wide: in the unit of time.
        power: of x in the derivatives by `at` and by `wide`, of which each is that over `wide`; None for the rise.
    """

    at: float
    wide: float
    power: int | None = None

    def __call__(self, t: ndarray) -> ndarray:
        """Return its values (1, B, 1)."""
        x = (t - self.at) / self.wide
        rise = np.tanh(x)
        values = (1 + rise) / 2 if self.power is None else -(x**self.power) * (1 - rise**2) / 2
        return np.asarray(values[None, :, None])

    def __str__(self) -> str:
        """Return it in the term language."""
        x = f"({since(self.at)}/{self.wide!r})"
        slope = f"(1-tanh({x})**2)/2"
        return f"(1+tanh({x}))/2" if self.power is None else f"-{x}*{slope}" if self.power else f"-{slope}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Sudden(Placed):
    """What rises as (1 + tanh((t - at) / width)) / 2.

    Attributes:
        at, width: in the unit of time.
        least: the width below which it is taken as sharp, in the unit of time.
        seen: the first and the last time of all recordings, between which it happens.
    """

    at: float
    width: float
    least: float
    seen: tuple[float, float]
    shape: ClassVar[tuple[str, ...]] = ("at", "width")
    timed: ClassVar[bool] = True

    @property
    def near(self) -> tuple[object, ...]:
        """The effect, its place and its time, to a width."""
        return (*self.place, f"{self.at / self.wide:.0f}")

    @property
    def possible(self) -> bool:
        """Whether it happens between the first and the last time: before and after, nothing changes."""
        return self.seen[0] < self.at < self.seen[1]

    @property
    def moot(self) -> tuple[str, ...]:
        """The width of what is as sharp as can be."""
        return ("width",) if abs(self.width) < self.least else ()

    @property
    def begins(self) -> float:
        """When it happens."""
        return self.at

    @property
    def wide(self) -> float:
        """The width with which it is computed."""
        return float(np.hypot(self.width, self.least))

    def rising(self, text: str, number: int = 0, weights: Float[ndarray, " sites"] | None = None) -> list[Force]:
        """Return a term that rises with one of the strengths and, for time and width, its derivatives by them."""
        value, count, wide = self.strength[number], len(self.strength), self.wide
        found = [Force(text, value, {number: 1.0}, weights, Rise(self.at, wide))]
        if value:
            by_width = value * self.width / wide**2
            found.append(Force(text, 0.0, {count: value / wide}, weights, Rise(self.at, wide, 0)))
            found.append(Force(text, 0.0, {count + 1: by_width}, weights, Rise(self.at, wide, 1)))
        return found

    def risen(self, t: Float[ndarray, " rows"], number: int = 0) -> Float[ndarray, "3 rows"]:
        """Return the rise, and by how much one of the strengths times it changes with time and width."""
        value, wide = self.strength[number], self.wide
        rise, by_time, by_width = (Rise(self.at, wide, power)(t)[0, :, 0] for power in (None, 0, 1))
        return np.stack([rise, value / wide * by_time, value * self.width / wide**2 * by_width])
