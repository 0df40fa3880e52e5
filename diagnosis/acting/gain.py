"""A sensor that reads too much or too little."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Misreading, OfSensors, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class OfGain(OfSensors):
    """What scales the readings of some sensors.

    Attributes:
        both: whether velocities are read so, too.
    """

    both: bool

    @property
    def place(self) -> tuple[object, ...]:
        """The effect, the sites, the recording, and whether velocities are concerned."""
        return (*super().place, self.both)

    def column(self, site: int, chain: Chain) -> str:
        """Return the columns that a site's sensor writes and that are concerned."""
        if chain.is_complex:
            return f"re{site + 1} and im{site + 1}"
        return f"u{site + 1}" + (f" and v{site + 1}" if self.both else "")


@dataclass(frozen=True, eq=False, kw_only=True)
class Gain(OfGain, acts="gain"):
    """The reading is (1 + strength) u, with a strength for each of some sites.

    Attributes:
        alike: whether all of them have the same.
    """

    alike: bool = False

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site, and all that have an equation but the first, whose reading is the unit, at once.

        Besides, all sensors alike in each recording: a camera that stands elsewhere.
        """
        chain = scene.chain
        if not effect.texts(chain.order, chain.is_complex):
            return
        others = chain.moving[1:]
        for both in (False, True)[: chain.levels]:
            # Where all sensors of a single level share a factor, that is a unit.
            single = [(site,) for site in range(chain.sites)] if chain.sites > 1 or chain.levels > 1 else []
            for sites in [*single, *([others] if len(others) > 1 else [])]:
                yield cls(effect=effect, sites=sites, both=both, strength=(0.0,) * len(sites))
        for recording, read in enumerate(scene.recordings):
            if read:
                yield cls(
                    effect=effect, sites=read, recording=recording, both=chain.levels > 1, alike=True, strength=(0.0,)
                )

    def turned(self) -> Placed | None:
        """Return the sensor with the other sign."""
        return None if self.site is None or self.alike else self.moved([-2.0 - self.strength[0]])

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return the columns that are read wrongly."""
        if self.alike:
            return (f"gain of all sensors{self.then}",)
        return tuple(f"gain of {self.column(site, chain)}" for site in self.sites)

    def misread(self, t: ndarray, field: ndarray) -> Misreading:  # noqa: ARG002
        """Return what the factors add."""
        by, slope = np.zeros((len(self.strength), *field.shape)), np.zeros_like(field)
        levels = slice(None) if self.both else slice(0, 1)
        for k, site in enumerate(self.sites):
            number = 0 if self.alike else k
            by[number, :, levels, :, site] = field[:, levels, :, site]
            slope[:, levels, :, site] = self.strength[number]
        return Misreading(np.tensordot(self.strength, by, 1), slope, by)

    def natural(self, chain: Chain, frequency: float) -> dict[str, float]:  # noqa: ARG002
        """Return the factors."""
        if self.alike:
            return {f"factor of all sensors{self.then}": 1 + self.strength[0]}
        pairs = zip(self.sites, self.strength, strict=True)
        return {f"factor of {self.column(site, chain)}": 1 + value for site, value in pairs}

    def sentences(self, chain: Chain) -> list[str]:
        """Return the factors."""
        if self.alike:
            return [f"all sensors read {1 + self.strength[0]:.{DIGITS}g} times as much{self.then} as in others"]
        found = []
        for site, value in zip(self.sites, self.strength, strict=True):
            factor, column = 1 + value, self.column(site, chain)
            turned = "; it looks from the other side" if factor < 0 else ""
            found.append(f"the sensor of {column} reads {factor:.{DIGITS}g} times what the others' unit says{turned}")
        return found
