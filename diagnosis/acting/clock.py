"""A clock that runs wrongly."""

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
class Clock(Placed, acts="clock"):
    """Readings are taken at t + strength (t - begin), to first order: u + strength (t - begin) du/dt.

    Without velocities another unit of time does the same, so that it is tried only with them.

    Attributes:
        begin: the first time.
    """

    begin: float
    instrument: ClassVar[bool] = True
    separated_by: ClassVar[str] = (
        "a recording by a second clock: it shows the same motion, but not the same faults of time"
    )

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return the one place, where velocities were read."""
        if effect.texts(scene.chain.order, scene.chain.is_complex) and scene.chain.levels == 2:
            yield cls(effect=effect, begin=scene.begin, strength=(0.0,))

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return what the number is."""
        return ("slowness of the clock",)

    def misread(self, t: ndarray, field: ndarray, rate: ndarray) -> Misreading:
        """Return what the error of the time adds."""
        by = ((t - self.begin)[:, None, None, None] * rate)[None]
        return Misreading(np.tensordot(self.strength, by, 1), np.zeros_like(field), by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return the error."""
        return [f"{self.labels(chain)[0]}: {self.strength[0]:.{DIGITS}g}"]
