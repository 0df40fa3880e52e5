"""A sensor whose clock is fast or slow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting.late import Late
from latticebench.diagnosis.acting.placed import OfSensors, Placed
from latticebench.diagnosis.acting.scene import Scene
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from numpy import ndarray

    from latticebench.diagnosis.acting.scene import Chain


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorClock(OfSensors, Late, acts="sensor clock"):
    """The reading is u at a time that is late by strength * (t - t_0) (`late.misread_late`).

    Loggers that were started together have clocks of their own. Where they were not, there is a lag, too.

    Attributes:
        begin: t_0, when the longest recording begins.
        seen: the first and the last time of all recordings.
    """

    begin: float
    seen: tuple[float, float]

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return each sensor of several, and all from one on; sites without an equation are taken to be on time.

        Where no velocities tell of the unit of time, one sensor that is slow is all others that are fast: of both, one
        is returned.
        """
        chain = scene.chain
        if chain.sites < 2 or not effect.texts(chain.order, chain.is_complex):
            return
        free = len(chain.moving) == chain.sites and chain.levels == 1
        single = [(site,) for site in chain.moving]
        later = [chain.moving[k:] for k in range(1 + free, len(chain.moving) - 1)]
        for sites in (*(single[1:] if free and len(single) == 2 else single), *later):
            yield cls(effect=effect, sites=sites, begin=scene.begin, seen=scene.seen, omega=scene.main, strength=(0.0,))

    @property
    def latest(self) -> float:
        """How late it is at the end, or early before the longest recording begins."""
        return abs(self.strength[0]) * max(abs(at - self.begin) for at in self.seen)

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return whose clock it is."""
        first, last = self.sites[0] + 1, self.sites[-1] + 1
        return (f"delay of u{first}" + (f" to u{last}" if last > first else "") + " per time",)

    def lateness(self, t: ndarray, sites: int) -> tuple[ndarray, ndarray]:
        """Return how late each sensor is, and the derivative by the number."""
        late = (t - self.begin)[:, None, None] * np.isin(np.arange(sites), self.sites)
        return self.strength[0] * late, late[None]

    def natural(self, chain: Chain, frequency: float) -> dict[str, float]:  # noqa: ARG002
        """Return how much slower the clock is, in per cent."""
        return {f"per cent by which {self._clock} slow": 100 * self.strength[0]}

    @property
    def _clock(self) -> str:
        names = f"u{self.sites[0] + 1}" + (f" to u{self.sites[-1] + 1}" if len(self.sites) > 1 else "")
        return f"the clock of {names} is"

    def sentences(self, chain: Chain) -> list[str]:  # noqa: ARG002
        """Return how fast or slow the clock is."""
        slow = self.strength[0]
        return [f"{self._clock} {abs(100 * slow):.4g} % {'slow' if slow > 0 else 'fast'}"]
