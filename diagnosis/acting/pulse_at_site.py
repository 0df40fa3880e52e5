"""A term that acts for a while, at one site: a site that is tapped."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from latticebench.diagnosis.acting.placed import AtOneSite, Placed
from latticebench.diagnosis.acting.pulse import Pulse, bells
from latticebench.diagnosis.acting.scene import Scene
from latticebench.systems.effects import Effect


@dataclass(frozen=True, eq=False, kw_only=True)
class PulseAtSite(AtOneSite, Pulse, acts="pulse at one site"):
    """A term times exp(-((t - at) / width)^2 / 2) at one site, nothing elsewhere."""

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return pulses as they may be at all sites, at every site that has an equation, on a chain of at least two."""
        texts = scene.terms(effect)
        still = (0.0,) * len(texts)
        for here in scene.chain.moving if texts and scene.chain.sites > 1 else ():
            for at, width in bells(scene):
                yield cls(
                    effect=effect, texts=texts, at=at, width=width, seen=scene.seen, strength=still, here=here
                )  # fmt: skip
