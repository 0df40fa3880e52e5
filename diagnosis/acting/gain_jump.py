"""A sensor whose gain changes at one time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting.gain import OfGain
from latticebench.diagnosis.acting.jump import BETWEEN, SHARP
from latticebench.diagnosis.acting.placed import DIGITS, Force, Misreading, Placed
from latticebench.diagnosis.acting.pulse import MOST_MIDDLES
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.diagnosis.acting.sudden import Sudden
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class GainJump(Sudden, OfGain, acts="gain jump"):
    """The reading is (1 + c (1 + tanh((t - at) / width)) / 2) u: an amplifier that changes its range."""

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site that has an equation, at times all over the recording."""
        chain, apart = scene.chain, scene.span / MOST_MIDDLES
        least = max(SHARP / scene.top, BETWEEN * scene.step)
        if not effect.texts(chain.order, chain.is_complex):
            return
        for both in (False, True)[: chain.levels]:
            for site in chain.moving:
                for at in scene.begin + apart * np.arange(1, MOST_MIDDLES):
                    yield cls(
                        effect=effect, sites=(site,), at=float(at), width=apart / 2, least=least, seen=scene.seen,
                        both=both, strength=(0.0,),
                    )  # fmt: skip

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return the columns whose gain changes."""
        return (f"change of the gain of {self.column(self.sites[0], chain)}",)

    @property
    def possible(self) -> bool:
        """Whether it happens between the first and the last time, and the gain keeps its sign."""
        return super().possible and self.strength[0] > -1

    def share(self, chain: Chain) -> Float[ndarray, " sites"]:
        """Return 1 at the sensor, 0 elsewhere."""
        return np.asarray(np.eye(chain.sites)[self.sites[0]])

    def courses(self, chain: Chain) -> list[Force]:
        """Return what is read more from the change on and, for time and width, its derivatives by them."""
        return self.rising("u[n]", weights=self.share(chain))

    def misread(self, t: ndarray, field: ndarray) -> Misreading:
        """Return what the gain adds."""
        (more,), courses = self.strength, self.risen(t)
        by, slope = np.zeros((3, *field.shape)), np.zeros_like(field)
        here = (slice(None), slice(None if self.both else 1), slice(None), self.sites[0])
        by[(slice(None), *here)] = courses[:, :, None, None] * field[here]
        slope[here] = more * courses[0][:, None, None]
        return Misreading(more * by[0], slope, by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return by how much the gain changes, and when."""
        return [f"{self.labels(chain)[0]}: {self.strength[0]:.{DIGITS}g} at t = {self.at:.{DIGITS}g}"]
