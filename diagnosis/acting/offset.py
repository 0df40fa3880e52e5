"""A sensor whose zero is off."""

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
class Offset(OfSensors, acts="offset"):
    """The reading is u + b, with a b for each of some sites.

    Attributes:
        parts: 1, or 2 for a complex field.
        every: whether these are all sites that have an equation.
    """

    parts: int
    every: bool

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site, and all that have an equation at once; these in each recording, too."""
        chain = scene.chain
        if not effect.texts(chain.order, chain.is_complex):
            return
        for sites in [*((site,) for site in range(chain.sites)), *([chain.moving] if len(chain.moving) > 1 else [])]:
            every = sites == chain.moving
            yield cls(
                effect=effect, sites=sites, parts=chain.parts, every=every, strength=(0.0,) * (len(sites) * chain.parts)
            )
        for recording, read in enumerate(scene.recordings):
            sites = tuple(site for site in chain.moving if site in read)
            if sites:
                yield cls(
                    effect=effect, sites=sites, recording=recording, parts=chain.parts, every=sites == chain.moving,
                    strength=(0.0,) * (len(sites) * chain.parts),
                )  # fmt: skip

    @property
    def from_the_start(self) -> bool:
        """Whether it is of all sites: about a wrong zero a coupling looks like another one."""
        return self.every and self.recording is None

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the columns that are off."""
        columns = ("re", "im") if self.parts == 2 else ("u",)
        then = f"{self.then} beyond others" if self.then else ""
        return tuple(f"offset of {name}{site + 1}{then}" for site in self.sites for name in columns)

    def misread(self, t: ndarray, field: ndarray) -> Misreading:  # noqa: ARG002
        """Return the offsets, and what each adds."""
        by = np.zeros((len(self.strength), *field.shape))
        for k, site in enumerate(self.sites):
            for part in range(self.parts):
                by[k * self.parts + part, :, 0, part, site] = 1.0
        return Misreading(np.tensordot(self.strength, by, 1), np.zeros_like(field), by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return how far each sensor is off, and from what that is counted."""
        pairs = zip(self.labels(chain), self.strength, strict=True)
        lines = [f"{label}: {value:.{DIGITS}g}" for label, value in pairs]
        outer = sorted({*range(chain.sites)} - {*chain.moving} - {*self.sites})
        if self.every and outer:
            names = " and ".join(f"u{site + 1}" for site in outer)
            lines.append(f"these offsets are relative to the zeros of {names}, which are taken as right")
        return lines
