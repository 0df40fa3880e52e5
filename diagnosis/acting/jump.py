"""A sensor whose zero moves at one time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import (
    DIGITS,
    Chain,
    Force,
    InStep,
    Misreading,
    OfSensors,
    Placed,
    Scene,
    since,
)
from latticebench.diagnosis.acting.pulse import MOST_MIDDLES
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# The width of a jump over the shortest time in which the motion changes by a radian, or over the time between two
# readings, whichever is more: a smaller one hardly does anything else, and of its time less is known.
SHARP, BETWEEN = 0.02, 0.2


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
class Jump(OfSensors, acts="jump"):
    """The reading is u + b (1 + tanh((t - at) / width)) / 2: a sensor that was knocked.

    Attributes:
        at, width: in the unit of time.
        least: the width below which it is taken as sharp, in the unit of time.
        seen: the first and the last time of all recordings, between which it happens.
        parts: 1, or 2 for a complex field.
    """

    at: float
    width: float
    least: float
    seen: tuple[float, float]
    parts: int
    shape: ClassVar[tuple[str, ...]] = ("at", "width")
    timed: ClassVar[bool] = True

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site that has an equation, at times all over the recording."""
        chain, apart = scene.chain, scene.span / MOST_MIDDLES
        least = max(SHARP / scene.top, BETWEEN * scene.step)
        if not effect.texts(chain.order, chain.is_complex):
            return
        for site in chain.moving:
            for at in scene.begin + apart * np.arange(1, MOST_MIDDLES):
                yield cls(
                    effect=effect, sites=(site,), at=float(at), width=apart / 2, least=least,
                    seen=scene.seen, parts=chain.parts, strength=(0.0,) * chain.parts,
                )  # fmt: skip

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the columns whose zero moves."""
        return tuple(f"jump of {name}{self.sites[0] + 1}" for name in (("re", "im") if self.parts == 2 else ("u",)))

    @property
    def near(self) -> tuple[object, ...]:
        """The effect, its site and its time, to a width."""
        return (*self.place, f"{self.at / np.hypot(self.width, self.least):.0f}")

    @property
    def possible(self) -> bool:
        """Whether it happens between the first and the last time: before and after it is an offset."""
        return self.seen[0] < self.at < self.seen[1]

    @property
    def moot(self) -> tuple[str, ...]:
        """The width of what is as sharp as can be."""
        return ("width",) if abs(self.width) < self.least else ()

    @property
    def begins(self) -> float:
        """When it happens."""
        return self.at

    def share(self, chain: Chain) -> Float[ndarray, " sites"]:
        """Return 1 at the sensor, 0 elsewhere."""
        return np.asarray(np.eye(chain.sites)[self.sites[0]])

    def courses(self, chain: Chain) -> list[Force]:
        """Return the jump and, for time and width, its derivatives by them."""
        wide, share, found = float(np.hypot(self.width, self.least)), self.share(chain), []
        for part, (text, value) in enumerate(zip(("1", "i*1"), self.strength, strict=False)):
            found.append(Force(text, value, {part: 1.0}, share, Rise(self.at, wide)))
            if value:
                by_width = value * self.width / wide**2
                found.append(Force(text, 0.0, {self.parts: value / wide}, share, Rise(self.at, wide, 0)))
                found.append(Force(text, 0.0, {self.parts + 1: by_width}, share, Rise(self.at, wide, 1)))
        return found

    def misread(self, t: ndarray, field: ndarray) -> Misreading:
        """Return where the zero is, and what each number adds."""
        wide = float(np.hypot(self.width, self.least))
        course, by_time, by_width = (Rise(self.at, wide, power)(t)[0, :, 0] for power in (None, 0, 1))
        by = np.zeros((self.count, *field.shape))
        for part, value in enumerate(self.strength):
            here = (slice(None), 0, part, self.sites[0])
            by[(part, *here)] = course
            by[(self.parts, *here)] = value / wide * by_time
            by[(self.parts + 1, *here)] = value * self.width / wide**2 * by_width
        return Misreading(np.tensordot(self.strength, by[: self.parts], 1), np.zeros_like(field), by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return by how much the zero moves, and when."""
        pairs = zip(self.labels(chain), self.strength, strict=True)
        return [f"{label}: {value:.{DIGITS}g} at t = {self.at:.{DIGITS}g}" for label, value in pairs]
