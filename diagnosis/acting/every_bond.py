"""A term at every bond, with a coefficient of its own at each: springs of which no two are alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from latticebench.diagnosis.acting.one_bond import mirrored
from latticebench.diagnosis.acting.placed import Force, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term, express

# Of fewer bonds one can be named.
BONDS = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class EveryBond(Placed, acts="every bond"):
    """A term at the left site of each bond, and its mirror image at the right one, with a coefficient for each bond.

    Attributes:
        texts: T, or T and i*T for complex coefficients.
        whole: whether the coefficients of each text are free; else only their deviations from a mean that the model has
            already, so that the last bond's is what makes their sum 0.
    """

    texts: tuple[str, ...]
    whole: tuple[bool, ...]
    local: ClassVar[bool] = True
    general: ClassVar[bool] = True

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return the one place, on a chain of at least three sites and bonds, of which each site has an equation."""
        texts, chain = scene.terms(effect), scene.chain
        count = len(bonds(chain))
        if texts and count >= BONDS and len(chain.moving) == chain.sites > 2:
            whole = tuple(not _declared(text, scene) for text in texts)
            numbers = count * len(texts) - whole.count(False)
            yield cls(effect=effect, texts=texts, whole=whole, strength=(0.0,) * numbers)

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return the terms with the bonds, by the sites at both ends: 0 and N + 1 are walls."""
        every = bonds(chain)
        return tuple(
            f"{text} at bond {left + 1}-{right + 1}"
            for text, whole in zip(self.texts, self.whole, strict=True)
            for left, right in (every if whole else every[:-1])
        )

    def forces(self, chain: Chain) -> list[Force]:
        """Return two terms for every bond, one at each of its ends that is a site."""
        count, found = len(bonds(chain)), []
        each = np.eye(count)
        lefts, rights = (np.zeros((count, chain.sites)) for _ in range(2))
        for number, (left, right) in enumerate(bonds(chain)):
            if left >= 0:
                lefts[number, left] = 1.0
            if right < chain.sites:
                rights[number, right % chain.sites] = 1.0
        rows = [each if whole else each[:-1] - each[-1] for whole in self.whole]
        places = [(text, row) for text, some in zip(self.texts, rows, strict=True) for row in some]
        for k, (text, row) in enumerate(places):
            for side, there in ((text, row @ lefts), (mirrored(text), row @ rights)):
                found.append(Force(side, self.strength[k], {k: 1.0}, there))
        return found

    def sentences(self, chain: Chain) -> list[str]:
        """Return how the coefficients scatter."""
        found, left = [], list(self.strength)
        for text, whole in zip(self.texts, self.whole, strict=True):
            count = len(bonds(chain)) - (not whole)
            each, left = left[:count], left[count:]
            each = each if whole else [*each, -sum(each)]
            about = f"mean {np.mean(each):.3g}" if whole else "deviations from their mean"
            scatter = f"{about}, standard deviation {np.std(each):.3g}"
            found.append(f"every bond has {text} besides, with a coefficient of its own: {scatter}")
        return found


def bonds(chain: Chain) -> list[tuple[int, int]]:
    """Return the sites at the left and the right of each bond, from 0; beyond the ends of a fixed chain are walls."""
    inner = [(site, site + 1) for site in range(chain.sites - 1)]
    if chain.ends == "fixed":
        return [(-1, 0), *inner, (chain.sites - 1, chain.sites)]
    return [*inner, (chain.sites - 1, 0)] if chain.ends in ("periodic", "antiperiodic") else inner


def _declared(text: str, scene: Scene) -> bool:
    """Return whether all bonds have the term already, with one coefficient."""
    both = Term(f"({text})+({mirrored(text)})")
    return express(both, [Term(one) for one in scene.texts], scene.chain.is_complex) is not None
