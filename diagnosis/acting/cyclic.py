"""Sensors whose error repeats with the reading."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Misreading, OfSensors, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from numpy import ndarray

# Cycles that are tried, in the largest reading from zero, and fewest of them: less of one is a curve.
CYCLES, FEWEST = (0.5, 1.0, 2.0, 4.0, 8.0), 0.2


@dataclass(frozen=True, eq=False, kw_only=True)
class Cyclic(OfSensors, acts="cyclic"):
    """The reading of u is u + a sin(k u) + b (cos(k u) - 1), at one sensor or with one a, b and k for all.

    Encoders that turn about another centre than their axis do this once in a turn, interferometers once in a fringe.

    Attributes:
        per_reading: k, in radians over the unit of the readings.
        largest: reading from zero.
    """

    per_reading: float
    largest: float
    shape: ClassVar[tuple[str, ...]] = ("per_reading",)
    # On short pieces, an error that repeats with the reading does what many a force does.
    slow: ClassVar[bool] = True

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return all sensors alike, and every one of several, with a few k; not of complex amplitudes."""
        chain = scene.chain
        if chain.is_complex or not effect.texts(chain.order, chain.is_complex) or not scene.largest > 0:
            return
        every = tuple(range(chain.sites))
        for sites in [every, *((site,) for site in chain.moving if chain.sites > 1)]:
            for cycles in CYCLES:
                yield cls(
                    effect=effect, sites=sites, per_reading=2 * np.pi * cycles / scene.largest, largest=scene.largest,
                    strength=(0.0, 0.0),
                )  # fmt: skip

    @property
    def near(self) -> tuple[object, ...]:
        """The place, with the cycles roughly."""
        return (*self.place, f"{2 * np.log2(self.cycles):.0f}")

    @property
    def cycles(self) -> float:
        """How often it repeats from zero to the largest reading."""
        return abs(self.per_reading) * self.largest / (2 * np.pi)

    @property
    def possible(self) -> bool:
        """Whether more than a curve is seen of it, and the reading grows with the motion everywhere."""
        return self.cycles > FEWEST and abs(complex(*self.strength)) * abs(self.per_reading) < 1

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return the waves of the reading, and whose."""
        which = "" if len(self.sites) == chain.sites else str(self.sites[0] + 1)
        return (f"sin of u{which}", f"cos of u{which}")

    def misread(self, t: ndarray, field: ndarray) -> Misreading:  # noqa: ARG002
        """Return the error, and what each number adds; velocities are read right."""
        by, slope = np.zeros((3, *field.shape)), np.zeros_like(field)
        a, b = self.strength
        u = field[:, 0][..., list(self.sites)]
        sin, cos = np.sin(self.per_reading * u), np.cos(self.per_reading * u)
        for k, one in enumerate((sin, cos - 1, u * (a * cos - b * sin))):
            by[k][:, 0][..., list(self.sites)] = one
        slope[:, 0][..., list(self.sites)] = self.per_reading * (a * cos - b * sin)
        return Misreading(np.tensordot(self.strength, by[:2], 1), slope, by)

    def natural(self, chain: Chain, frequency: float) -> dict[str, float]:  # noqa: ARG002
        """Return the waves, and after which difference the error repeats."""
        labels = self.labels(chain)
        cycle = 2 * np.pi / abs(self.per_reading)
        return dict(zip((*labels, f"cycle{labels[0].removeprefix('sin')}"), (*self.strength, cycle), strict=True))

    def sentences(self, chain: Chain) -> list[str]:
        """Return how large the error is, and after which difference it repeats."""
        alike = 1 < len(self.sites) == chain.sites
        which = "all sensors" if alike else f"the sensor of u{self.sites[0] + 1}"
        size, cycle = abs(complex(*self.strength)), 2 * np.pi / abs(self.per_reading)
        return [f"{which}: an error of {size:.{DIGITS}g} to either side that repeats after {cycle:.{DIGITS}g}"]
