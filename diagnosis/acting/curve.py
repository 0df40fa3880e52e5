"""Sensors whose scale is bent."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Misreading, OfSensors, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect
from latticebench.systems.errors import InputError
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Curve(OfSensors, acts="curve"):
    """The reading is u + c u^p, or u + c |u|^(p - 1) u of a complex field, with one c for all sensors or one.

    A square bends a scale to one side; a cube compresses or stretches both ends, as lenses and amplifiers do.

    Attributes:
        power: p, 2 or more.
        both: whether the velocity is that of the bent reading, too.
    """

    power: int
    both: bool

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return all sensors alike, and every one of several, without and with velocities.

        A sensor of a site without an equation would have what the curve of that site does not follow.

        Raises:
            InputError: the formula is no power of u[n] from 2 on.
        """
        chain = scene.chain
        if not effect.texts(chain.order, chain.is_complex):
            return
        power = re.fullmatch(r"u\[n\] \*\* (\d+)", Term(effect.formula).plain) if effect.formula else None
        if power is None or int(power[1]) < 2:
            raise InputError(
                f"effect {effect.name!r}: what acts as a curve adds a power of the reading, such as u[n]**3, to it; "
                f"{effect.formula!r} is none"
            )
        every = tuple(range(chain.sites))
        for both in (False, True)[: chain.levels]:
            for sites in [every, *((site,) for site in chain.moving if chain.sites > 1)]:
                yield cls(effect=effect, sites=sites, power=int(power[1]), both=both, strength=(0.0,))

    @property
    def place(self) -> tuple[object, ...]:
        """The effect, the sites, and whether velocities are concerned."""
        return (self.effect.name, self.sites, self.both)

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return the columns that are bent."""
        which = "" if len(self.sites) == chain.sites else str(self.sites[0] + 1)
        kind = {2: "", 3: "cubic "}.get(self.power, f"{self.power}th ")
        return (f"{kind}curve of u{which}" + (f" and v{which}" if self.both else ""),)

    def misread(self, t: ndarray, field: ndarray) -> Misreading:  # noqa: ARG002
        """Return what the bend adds."""
        by, slope = np.zeros((1, *field.shape)), np.zeros_like(field)
        u, here, p = field[:, 0], np.isin(np.arange(field.shape[-1]), self.sites), self.power
        if u.shape[1] == 1:
            steepness = p * u ** (p - 1)
            by[0, :, 0] = u**p
            slope[:, 0] = self.strength[0] * steepness
            if self.both and field.shape[1] > 1:
                by[0, :, 1] = steepness * field[:, 1]
                slope[:, 1] = self.strength[0] * steepness
        else:
            size = np.hypot(u[:, 0], u[:, 1])[:, None]
            by[0, :, 0] = size ** (p - 1) * u
            along = (p - 1) * u**2 * size ** (p - 2) / np.where(size > 0, size, 1.0)
            slope[:, 0] = self.strength[0] * (size ** (p - 1) + along)
        by, slope = np.where(here, by, 0.0), np.where(here, slope, 0.0)
        return Misreading(np.tensordot(self.strength, by, 1), slope, by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return the bend."""
        sign = "-" if self.strength[0] < 0 else "+"
        return [f"{self.labels(chain)[0]}: the reading is u {sign} {abs(self.strength[0]):.{DIGITS}g}*u**{self.power}"]
