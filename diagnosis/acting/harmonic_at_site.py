"""A term that swings at a frequency of its own, at one site: an end that is shaken, a site beside a loudspeaker."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from latticebench.diagnosis.acting.harmonic import Harmonic
from latticebench.diagnosis.acting.lasting import Lasting, windows
from latticebench.diagnosis.acting.placed import AtOneSite, Placed
from latticebench.diagnosis.acting.scene import Scene
from latticebench.diagnosis.acting.step import SHARP
from latticebench.systems.effects import Effect


@dataclass(frozen=True, eq=False, kw_only=True)
class HarmonicAtSite(AtOneSite, Harmonic, acts="harmonic at one site"):
    """A term times a cos(omega s) + b sin(omega s) with s = t - middle at one site, nothing elsewhere."""

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every frequency of the scene at every site that has an equation, on a chain of at least two."""
        texts = scene.terms(effect)
        still = (0.0,) * (2 * len(texts))
        for here in scene.chain.moving if texts and scene.chain.sites > 1 else ():
            for omega in scene.frequencies:
                yield cls(
                    effect=effect, texts=texts, omega=float(omega), middle=scene.middle, strength=still, here=here
                )  # fmt: skip
            for begin, end, middle in windows(scene) if len(scene.frequencies) else ():
                yield BurstAtSite(
                    effect=effect, texts=texts, omega=float(scene.frequencies[0]), middle=middle, strength=still,
                    begin=begin, end=end, edge=SHARP / scene.top, seen=scene.seen, here=here,
                )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class BurstAtSite(Lasting, HarmonicAtSite):
    """A force that swings for a while, at one site."""
