"""Sensors whose scale is bent."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Chain, Misreading, OfSensors, Placed, Scene
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Curve(OfSensors, acts="curve"):
    """The reading is u + c u^2, or u + c |u| u for a complex field, at all sites with one c, or at one of several.

    Attributes:
        both: whether the velocity is that of the bent reading, too.
    """

    both: bool

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return all sensors alike, and every one of several, without and with velocities."""
        chain = scene.chain
        if not effect.texts(chain.order, chain.is_complex):
            return
        every = tuple(range(chain.sites))
        for both in (False, True)[: chain.levels]:
            for sites in [every, *((site,) for site in every if chain.sites > 1)]:
                yield cls(effect=effect, sites=sites, both=both, strength=(0.0,))

    @property
    def place(self) -> tuple[object, ...]:
        """The effect, the sites, and whether velocities are concerned."""
        return (self.effect.name, self.sites, self.both)

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return the columns that are bent."""
        which = "" if len(self.sites) == chain.sites else str(self.sites[0] + 1)
        return (f"curve of u{which}" + (f" and v{which}" if self.both else ""),)

    def misread(self, t: ndarray, field: ndarray) -> Misreading:  # noqa: ARG002
        """Return what the bend adds."""
        by, slope = np.zeros((1, *field.shape)), np.zeros_like(field)
        u, here = field[:, 0], np.isin(np.arange(field.shape[-1]), self.sites)
        if u.shape[1] == 1:
            by[0, :, 0] = u**2
            slope[:, 0] = 2 * self.strength[0] * u
            if self.both and field.shape[1] > 1:
                by[0, :, 1] = 2 * u * field[:, 1]
                slope[:, 1] = 2 * self.strength[0] * u
        else:
            size = np.hypot(u[:, 0], u[:, 1])[:, None]
            by[0, :, 0] = size * u
            slope[:, 0] = self.strength[0] * (size + u**2 / np.where(size > 0, size, 1.0))
        by, slope = np.where(here, by, 0.0), np.where(here, slope, 0.0)
        return Misreading(np.tensordot(self.strength, by, 1), slope, by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return the bend."""
        return [f"{self.labels(chain)[0]}: the reading is u + {self.strength[0]:.{DIGITS}g}*u**2"]
