"""A sensor whose reading hums: mains in its cable, a camera that shakes, a target that swings besides."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Force, Misreading, OfSensors, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.diagnosis.acting.swinging import Swinging
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Hum(OfSensors, Swinging, acts="hum"):
    """The reading is u + a cos(omega s) + b sin(omega s) with s = t - middle, at one sensor or at all alike."""

    separated_by: ClassVar[str] = "a recording of the chain held fast: a sensor hums there, too"

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every frequency of the scene, fast ones too, at every sensor and at all alike, on two sites or more.

        A single site that is driven swings as if its sensor hummed. Beside a site without an equation, a sensor would
        have what the curve of that site does not follow.
        """
        chain, texts = scene.chain, scene.terms(effect)
        every, still = tuple(range(chain.sites)), (0.0,) * (2 * len(texts))
        beside = {site + k for site in {*every} - {*chain.moving} for k in range(-chain.reach, chain.reach + 1)}
        where = [(site,) for site in every if site not in beside]
        for sites in [*where, *([] if beside else [every])] if texts and chain.sites > 1 else ():
            for omega in (*scene.frequencies, *scene.fast):
                yield cls(
                    effect=effect, sites=sites, texts=texts, omega=float(omega), middle=scene.middle, strength=still
                )  # fmt: skip

    def share(self, chain: Chain) -> Float[ndarray, " sites"] | None:
        """Return 1 at the sensors that hum, 0 elsewhere; None where all do."""
        if len(self.sites) == chain.sites:
            return None
        found = np.zeros(chain.sites)
        found[list(self.sites)] = 1.0
        return found

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return cosine and sine of each column that hums."""
        return tuple(f"{self._called(chain)}, {wave}" for wave in super().labels(chain))

    def courses(self, chain: Chain) -> list[Force]:
        """Return the waves and, for the frequency, their derivatives by it."""
        return self.waves(chain)

    def misread(self, t: ndarray, field: ndarray) -> Misreading:
        """Return the hum, and what each number adds."""
        by, s = np.zeros((self.count, *field.shape)), (t - self.middle)[:, None]
        cos, sin, half = np.cos(self.omega * s), np.sin(self.omega * s), len(self.texts)
        for part in range(half):
            a, b = self.strength[part], self.strength[half + part]
            by[part, :, 0, part, self.sites] = cos.T
            by[half + part, :, 0, part, self.sites] = sin.T
            by[-1, :, 0, part, self.sites] = (s * (b * cos - a * sin)).T
        return Misreading(np.tensordot(self.strength, by[:-1], 1), np.zeros_like(field), by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return how far the reading goes to either side, and how fast it swings."""
        return [
            f"{self._called(chain)}: {self.size:.{DIGITS}g} to either side of u, at the angular frequency "
            f"{self.omega:.{DIGITS}g}"
        ]

    @property
    def size(self) -> float:
        """How far the reading goes to either side of u, at most."""
        return float(np.linalg.norm(np.reshape(self.strength, (2, -1)), 2))

    def _called(self, chain: Chain) -> str:
        return "hum of u" + ("" if len(self.sites) == chain.sites else str(self.sites[0] + 1))
