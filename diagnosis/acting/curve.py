"""Sensors whose scale is bent."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Chain, Misreading, Placed, Scene
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Curve(Placed, acts="curve"):
    """The reading is u + c u^2, or u + c |u| u for a complex field, at every site.

    Attributes:
        both: whether the velocity is that of the bent reading, too.
    """

    both: bool
    instrument: ClassVar[bool] = True

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return all sensors, without and with velocities."""
        if effect.texts(scene.chain.order, scene.chain.is_complex):
            for both in (False, True)[: scene.chain.levels]:
                yield cls(effect=effect, both=both, strength=(0.0,))

    @property
    def place(self) -> tuple[object, ...]:
        """The effect, and whether velocities are concerned."""
        return (self.effect.name, self.both)

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the columns that are bent."""
        return ("curve of u" + (" and v" if self.both else ""),)

    def misread(self, t: ndarray, field: ndarray) -> Misreading:  # noqa: ARG002
        """Return what the bend adds."""
        by, slope = np.zeros((1, *field.shape)), np.zeros_like(field)
        u = field[:, 0]
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
        return Misreading(np.tensordot(self.strength, by, 1), slope, by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return the bend."""
        return [f"{self.labels(chain)[0]}: the reading is u + {self.strength[0]:.{DIGITS}g}*u**2"]
