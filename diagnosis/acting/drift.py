"""A sensor whose zero drifts."""

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
class Drift(OfSensors, acts="drift"):
    """The reading is u + d (t - t_0) / T, T being the length of the longest recording.

    Attributes:
        begin, span: t_0 and T.
        parts: 1, or 2 for a complex field.
    """

    begin: float
    span: float
    parts: int

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site."""
        chain = scene.chain
        if effect.texts(chain.order, chain.is_complex):
            for site in range(chain.sites):
                yield cls(
                    effect=effect, sites=(site,), begin=scene.begin, span=scene.span, parts=chain.parts,
                    strength=(0.0,) * chain.parts,
                )  # fmt: skip

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the columns whose zero drifts."""
        return tuple(f"drift of {name}{self.sites[0] + 1}" for name in (("re", "im") if self.parts == 2 else ("u",)))

    def misread(self, t: ndarray, field: ndarray) -> Misreading:
        """Return where the zero is, and what each number adds."""
        by = np.zeros((len(self.strength), *field.shape))
        for part in range(self.parts):
            by[part, :, 0, part, self.sites[0]] = (t - self.begin) / self.span
        return Misreading(np.tensordot(self.strength, by, 1), np.zeros_like(field), by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return how far each zero goes."""
        pairs = zip(self.labels(chain), self.strength, strict=True)
        return [f"{label}: {value:.{DIGITS}g} over the recording" for label, value in pairs]
