"""A term at one site."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

from latticebench.diagnosis.acting.placed import AtOneSite, Force, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term


@dataclass(frozen=True, eq=False, kw_only=True)
class OneSite(AtOneSite, acts="one site"):
    """A term at one site: strength * text there, nothing elsewhere.

    Attributes:
        texts: T, or T and i*T for a complex coefficient.
    """

    texts: tuple[str, ...]

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site that has an equation, on a chain of at least two, with the formula and its like."""
        texts = scene.terms(effect)
        for site in scene.chain.moving if texts and scene.chain.sites > 1 else ():
            yield cls(effect=effect, texts=texts, here=site, strength=(0.0,) * len(texts))
            for text in alike(texts, scene):
                yield OtherCoefficient(effect=effect, texts=(text,), here=site, strength=(0.0,))

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the terms."""
        return self.texts

    def forces(self, chain: Chain) -> list[Force]:
        """Return the terms, with a weight of 1 at the site."""
        pairs = zip(self.texts, self.strength, strict=True)
        return [Force(text, value, {k: 1.0}, self.share(chain)) for k, (text, value) in enumerate(pairs)]


@dataclass(frozen=True, eq=False, kw_only=True)
class OtherCoefficient(OneSite):
    """A declared term that has another coefficient at one site."""

    general: ClassVar[bool] = True

    @property
    def place(self) -> tuple[object, ...]:
        """The effect, its site and its term."""
        return (*super().place, *self.texts)


def alike(texts: Sequence[str], scene: Scene) -> list[str]:
    """Return the declared terms of a site's own u, or v, where that is what the given terms are."""
    own = [{text[0]} for text in texts if text in ("u[n]", "v[n]")]
    declared = ((text, Term(text)) for text in scene.texts if text not in texts)
    return [text for text, term in declared if term.reach == (0, 0) and term.names & {"u", "v"} in own]
