"""A term whose sign changes from site to site."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting.everywhere import Everywhere
from latticebench.diagnosis.acting.placed import Placed, Summand
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Alternating(Everywhere, acts="alternating"):
    """A term with the sign (-1)^k at site k."""

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return the one place, on a chain of at least two sites."""
        texts = scene.terms(effect)
        if texts and scene.chain.sites > 1:
            yield cls(effect=effect, texts=texts, strength=(0.0,) * len(texts))

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the terms with their sign."""
        return tuple(f"(-1)^k*{text}" for text in self.texts)

    def weights(self, chain: Chain) -> Float[ndarray, " sites"]:
        """Return the signs."""
        return np.where(np.arange(chain.sites) % 2 == 0, 1.0, -1.0)

    def summands(self, chain: Chain) -> list[Summand]:
        """Return the terms with their sign."""
        import sympy

        sign = sympy.Integer(-1) ** sympy.Symbol("k", integer=True)
        return [
            Summand(label, value, sign * Term(text).in_decimals)
            for label, text, value in zip(self.labels(chain), self.texts, self.strength, strict=True)
        ]
