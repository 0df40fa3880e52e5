"""A clock that runs wrongly."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Misreading, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Clock(Placed, acts="clock"):
    """The clock is slow: when it shows t, 1 + strength times as much time has gone by since the first row.

    By such a clock everything is quicker by that factor. Velocities are read as what they are, which is less than the
    change of the positions by the clock. Without velocities another unit of time does the same, so that it is tried
    only with them.
    """

    instrument: ClassVar[bool] = True
    separated_by: ClassVar[str] = (
        "a recording by a second clock: it shows the same motion, but not the same faults of time"
    )

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return the one place, where velocities were read."""
        if effect.texts(scene.chain.order, scene.chain.is_complex) and scene.chain.levels == 2:
            yield cls(effect=effect, strength=(0.0,))

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return what the number is."""
        return ("slowness of the clock",)

    def quickened(self) -> float:
        """Return the slowness of the clock."""
        return self.strength[0]

    def misread(self, t: ndarray, field: ndarray) -> Misreading:  # noqa: ARG002
        """Return what velocities lack."""
        share = 1 / (1 + self.strength[0])
        by, slope = np.zeros((1, *field.shape)), np.zeros_like(field)
        by[0, :, 1], slope[:, 1] = -(share**2) * field[:, 1], share - 1
        return Misreading(slope * field, slope, by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return the error."""
        return [f"{self.labels(chain)[0]}: {self.strength[0]:.{DIGITS}g}"]
