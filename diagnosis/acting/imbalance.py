"""A receiver whose two quadratures are not alike."""

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

# The largest share of the mirror image in a reading.
MOST = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Imbalance(Placed, acts="imbalance"):
    """The reading of a complex field is z + (a + i b) conj(z), with one a and b for all sites, velocities likewise.

    With a, one quadrature is larger than the other; with b, they are not a quarter of a period apart.
    """

    instrument: ClassVar[bool] = True

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return it, where the field is complex."""
        if scene.chain.is_complex and effect.texts(scene.chain.order, scene.chain.is_complex):
            yield cls(effect=effect, strength=(0.0, 0.0))

    @property
    def possible(self) -> bool:
        """Whether two quadratures are left that are not nearly one."""
        return abs(complex(*self.strength)) < MOST

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return what the numbers are the coefficients of."""
        return ("conj(u)", "i*conj(u)")

    def misread(self, t: ndarray, field: ndarray) -> Misreading:  # noqa: ARG002
        """Return what the mirror image adds."""
        _, levels, _, sites = field.shape
        x, y = field[:, :, 0], field[:, :, 1]
        by = np.stack([np.stack([x, -y], axis=2), np.stack([y, x], axis=2)])
        unlike, askew = self.strength
        slope = np.broadcast_to(np.array([unlike, -unlike])[:, None], field.shape)
        exchanged = np.kron([[0.0, 1.0], [1.0, 0.0]], np.eye(sites))
        by_others = np.broadcast_to(askew * exchanged, (levels, *exchanged.shape))
        return Misreading(np.tensordot(self.strength, by, 1), slope, by, by_others=by_others)

    def natural(self, chain: Chain, frequency: float) -> dict[str, float]:  # noqa: ARG002
        """Return the ratio of the quadratures' gains and, in degrees, how far they are from a right angle."""
        unlike, askew = self.strength
        real, imaginary = np.array([1 + unlike, askew]), np.array([askew, 1 - unlike])
        cosine = real @ imaginary / np.linalg.norm(real) / np.linalg.norm(imaginary)
        return {
            "gain of re over that of im": float(np.linalg.norm(real) / np.linalg.norm(imaginary)),
            "degrees of re and im from a right angle": float(np.degrees(np.arcsin(cosine))),
        }

    def sentences(self, chain: Chain) -> list[str]:
        """Return the ratio and the angle."""
        return [f"{label}: {value:.{DIGITS}g}" for label, value in self.natural(chain, np.nan).items()]
