"""A sensor whose zero wanders."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Misreading, OfSensors, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from typing import Self

    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Wander(OfSensors, acts="wander"):
    """The reading is u + w(t), w being a Brownian motion that is 0 as the recordings begin: a part of the noise.

    It has no numbers that a fit changes: how far it goes is estimated with the noise, see `diagnosis.walk`.

    Attributes:
        span: the length of the longest recording.
        walk: the standard deviation of w after it, in units of the readings; 0 before anything is fitted.
    """

    span: float
    walk: float = 0.0
    timed: ClassVar[bool] = True
    # Of a few swings it would take whatever a wrong equation leaves.
    slow: ClassVar[bool] = True

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site that has an equation: of others the motion is not known."""
        if effect.texts(scene.chain.order, scene.chain.is_complex):
            for site in scene.chain.moving:
                yield cls(effect=effect, sites=(site,), span=scene.span, strength=())

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return nothing: no number of the model belongs to it."""
        return ()

    def stays(self, *, velocities: bool) -> bool:  # noqa: ARG002
        """Return True: it is no number."""
        return True

    def wandering(self) -> int:
        """Return the site."""
        return self.sites[0]

    def with_walks(self, walk: ndarray) -> Self:
        """Return it with how far its zero goes."""
        return replace(self, walk=float(walk[self.sites[0]] * np.sqrt(self.span)))

    def misread(self, t: ndarray, field: ndarray) -> Misreading:  # noqa: ARG002
        """Return nothing that could be foreseen."""
        return Misreading(np.zeros_like(field), np.zeros_like(field), np.zeros((0, *field.shape)))

    def natural(self, chain: Chain, frequency: float) -> dict[str, float]:  # noqa: ARG002
        """Return how far the zero goes."""
        return {f"walk of u{self.sites[0] + 1}": self.walk}

    def sentences(self, chain: Chain) -> list[str]:  # noqa: ARG002
        """Return how far the zero goes."""
        size = f"{self.walk:.{DIGITS}g}"
        return [f"walk of u{self.sites[0] + 1}: {size} over the recording (standard deviation), a zero that wanders"]
