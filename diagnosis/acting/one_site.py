"""A term at one site."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from latticebench.diagnosis.acting.placed import AtOneSite, Chain, Force, Placed, Scene
from latticebench.systems.effects import Effect


@dataclass(frozen=True, eq=False, kw_only=True)
class OneSite(AtOneSite, acts="one site"):
    """A term at one site: strength * text there, nothing elsewhere.

    Attributes:
        texts: T, or T and i*T for a complex coefficient.
    """

    texts: tuple[str, ...]

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site that has an equation, on a chain of at least two."""
        texts = scene.terms(effect)
        for site in scene.chain.moving if texts and scene.chain.sites > 1 else ():
            yield cls(effect=effect, texts=texts, here=site, strength=(0.0,) * len(texts))

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the terms."""
        return self.texts

    def forces(self, chain: Chain) -> list[Force]:
        """Return the terms, with a weight of 1 at the site."""
        pairs = zip(self.texts, self.strength, strict=True)
        return [Force(text, value, {k: 1.0}, self.share(chain)) for k, (text, value) in enumerate(pairs)]
