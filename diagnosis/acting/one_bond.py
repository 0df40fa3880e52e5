"""A term at one bond: a spring between two neighbours that is not like the others."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from latticebench.diagnosis.acting.placed import AtOneSite, Force, Placed, joined, times
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect


@dataclass(frozen=True, eq=False, kw_only=True)
class OneBond(AtOneSite, acts="one bond"):
    """A term at the site `here`, and its mirror image, n+1 and n-1 exchanged, at the next site.

    Attributes:
        texts: T, or T and i*T for a complex coefficient.
    """

    texts: tuple[str, ...]

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every bond of which a site has an equation, on a chain of at least three sites: one of two has one."""
        texts, chain = scene.terms(effect), scene.chain
        if texts and chain.sites > 2:
            for site in range(chain.sites if chain.ends == "periodic" else chain.sites - 1):
                if {site, (site + 1) % chain.sites} & set(chain.moving):
                    yield cls(effect=effect, texts=texts, here=site, strength=(0.0,) * len(texts))

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the terms."""
        return self.texts

    def forces(self, chain: Chain) -> list[Force]:
        """Return the terms at the two sites."""
        each, following = np.eye(chain.sites), (self.here + 1) % chain.sites
        found = []
        for k, (text, value) in enumerate(zip(self.texts, self.strength, strict=True)):
            found.append(Force(text, value, {k: 1.0}, each[self.here]))
            found.append(Force(mirrored(text), value, {k: 1.0}, each[following]))
        return found

    def sentences(self, chain: Chain) -> list[str]:
        """Return what the bond has."""
        sum_ = joined(times(value, f"({text})") for text, value in zip(self.texts, self.strength, strict=True))
        following = (self.here + 1) % chain.sites + 1
        return [f"the bond between sites {self.here + 1} and {following} alone has {sum_} besides"]


def mirrored(text: str) -> str:
    """Return a term with right and left exchanged.

    >>> mirrored("u[n+1]-u[n]")
    'u[n-1]-u[n]'
    """
    return re.sub(r"(?<=\[n)[+-]", lambda sign: "-" if sign[0] == "+" else "+", text)
