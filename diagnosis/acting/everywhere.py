"""A term at every site and time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Force, Placed, Summand
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Everywhere(Placed, acts="everywhere"):
    """A term at every site and time: strength * text.

    Attributes:
        texts: T, or T and i*T for a complex coefficient.
    """

    texts: tuple[str, ...]

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return the one place, unless the term is declared."""
        texts = scene.terms(effect)
        if texts and not set(texts) <= set(scene.texts):
            yield cls(effect=effect, texts=texts, strength=(0.0,) * len(texts))

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the terms."""
        return self.texts

    def weights(self, chain: Chain) -> Float[ndarray, " sites"] | None:  # noqa: ARG002
        """Return the factor of each site, None for 1."""
        return None

    def forces(self, chain: Chain) -> list[Force]:
        """Return the terms with their weights."""
        weights = self.weights(chain)
        pairs = zip(self.texts, self.strength, strict=True)
        return [Force(text, value, {k: 1.0}, weights) for k, (text, value) in enumerate(pairs)]

    def summands(self, chain: Chain) -> list[Summand]:
        """Return the terms."""
        labels = self.labels(chain)
        return [
            Summand(label, value, Term(text).in_decimals)
            for label, text, value in zip(labels, self.texts, self.strength, strict=True)
        ]

    def natural(self, chain: Chain, frequency: float) -> dict[str, float]:
        """Return a damping as a decay time, too, and a linear force as a change of the frequency."""
        found, time = super().natural(chain, frequency), self._decay_time(chain)
        if time is not None:
            found["decay time"] = time
        if (chain.order, self.texts) == (2, ("u[n]",)) and frequency**2 + self.strength[0] > 0:
            # The frequency is that with the force: without it, its square is larger by the strength.
            share = frequency / np.sqrt(frequency**2 + self.strength[0]) - 1
            found[f"change of the angular frequency {frequency:.{DIGITS}g}, in per cent"] = 100 * float(share)
        return found

    def _decay_time(self, chain: Chain) -> float | None:
        """Return the time in which amplitudes fall to 1/e; None where they do not fall exponentially."""
        decays = {(2, "v[n]"): 2.0, (1, "u[n]"): 1.0}.get((chain.order, self.texts[0]))
        return None if decays is None or len(self.texts) > 1 or self.strength[0] >= 0 else decays / -self.strength[0]

    def sentences(self, chain: Chain) -> list[str]:
        """Return a damping as a decay time, too."""
        time = self._decay_time(chain)
        return [] if time is None else [f"{self.effect.name}: amplitudes fall to 1/e within {time:.{DIGITS}g}"]
