"""A sensor whose gain drifts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting.gain import OfGain
from latticebench.diagnosis.acting.placed import DIGITS, Misreading, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class GainDrift(OfGain, acts="gain drift"):
    """The reading is (1 + c (t - t_0) / T) u, T being the length of the longest recording.

    Attributes:
        begin, span: t_0 and T.
    """

    begin: float
    span: float

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site of several: what all gains have in common is damping, nearly."""
        chain = scene.chain
        if chain.sites < 2 or not effect.texts(chain.order, chain.is_complex):
            return
        for both in (False, True)[: chain.levels]:
            for site in range(chain.sites):
                yield cls(
                    effect=effect, sites=(site,), begin=scene.begin, span=scene.span, both=both, strength=(0.0,)
                )  # fmt: skip

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return the columns whose gain drifts."""
        return (f"growth of the gain of {self.column(self.sites[0], chain)}",)

    @property
    def possible(self) -> bool:
        """Whether the gain keeps its sign."""
        return self.strength[0] > -1

    def misread(self, t: ndarray, field: ndarray) -> Misreading:
        """Return what the gain adds."""
        by, slope = np.zeros((1, *field.shape)), np.zeros_like(field)
        levels, site = slice(None) if self.both else slice(0, 1), self.sites[0]
        grown = ((t - self.begin) / self.span)[:, None, None]
        by[0, :, levels, :, site] = grown * field[:, levels, :, site]
        slope[:, levels, :, site] = self.strength[0] * grown
        return Misreading(self.strength[0] * by[0], slope, by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return how much the gain changes."""
        pairs = zip(self.labels(chain), self.strength, strict=True)
        return [f"{label}: {value:.{DIGITS}g} over the recording" for label, value in pairs]
