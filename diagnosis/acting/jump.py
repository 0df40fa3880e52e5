"""A sensor whose zero moves at one time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Force, Misreading, OfSensors, Placed
from latticebench.diagnosis.acting.pulse import MOST_MIDDLES
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.diagnosis.acting.sudden import Sudden
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# The width of a jump over the shortest time in which the motion changes by a radian, or over the time between two
# readings, whichever is more: a smaller one hardly does anything else, and of its time less is known.
SHARP, BETWEEN = 0.02, 0.2


@dataclass(frozen=True, eq=False, kw_only=True)
class Jump(Sudden, OfSensors, acts="jump"):
    """The reading is u + b (1 + tanh((t - at) / width)) / 2: a sensor that was knocked.

    Attributes:
        parts: 1, or 2 for a complex field.
    """

    parts: int

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site that has an equation, at times all over the recording."""
        chain, apart = scene.chain, scene.span / MOST_MIDDLES
        least = max(SHARP / scene.top, BETWEEN * scene.step)
        if not effect.texts(chain.order, chain.is_complex):
            return
        for site in chain.moving:
            for at in scene.begin + apart * np.arange(1, MOST_MIDDLES):
                yield cls(
                    effect=effect, sites=(site,), at=float(at), width=apart / 2, least=least,
                    seen=scene.seen, parts=chain.parts, strength=(0.0,) * chain.parts,
                )  # fmt: skip

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the columns whose zero moves."""
        return tuple(f"jump of {name}{self.sites[0] + 1}" for name in (("re", "im") if self.parts == 2 else ("u",)))

    def share(self, chain: Chain) -> Float[ndarray, " sites"]:
        """Return 1 at the sensor, 0 elsewhere."""
        return np.asarray(np.eye(chain.sites)[self.sites[0]])

    def courses(self, chain: Chain) -> list[Force]:
        """Return the jump and, for time and width, its derivatives by them."""
        share = self.share(chain)
        return [one for part in range(self.parts) for one in self.rising(("1", "i*1")[part], part, share)]

    def misread(self, t: ndarray, field: ndarray) -> Misreading:
        """Return where the zero is, and what each number adds."""
        by = np.zeros((self.count, *field.shape))
        for part in range(self.parts):
            by[[part, self.parts, self.parts + 1], :, 0, part, self.sites[0]] = self.risen(t, part)
        return Misreading(np.tensordot(self.strength, by[: self.parts], 1), np.zeros_like(field), by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return by how much the zero moves, and when."""
        pairs = zip(self.labels(chain), self.strength, strict=True)
        return [f"{label}: {value:.{DIGITS}g} at t = {self.at:.{DIGITS}g}" for label, value in pairs]
