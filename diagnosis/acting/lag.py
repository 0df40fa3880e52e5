"""A sensor that follows late."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from latticebench.diagnosis.acting.late import Late
from latticebench.diagnosis.acting.placed import DIGITS, OfSensors, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Lag(OfSensors, Late, acts="lag"):
    """The reading is u a time tau ago (`late.misread_late`).

    Filters, converters that scan their channels and cameras that are not in step do this. A filter of first order
    also reads less, by the root of 1 + omega^2 tau^2 at an angular frequency omega: a gain, where the motion has about
    one frequency. A lag of all sensors is only another zero of the time, unless an input was measured: then they lag
    behind that, or are ahead of it.

    Attributes:
        pattern: whether each site has a lag of its own, each lags behind the one before by the same, or all lag alike.
    """

    pattern: Literal["own", "in turn", "alike"] = "own"
    separated_by: ClassVar[str] = "a motion of other frequencies: a lag turns into another phase at each of them"

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return each sensor of several; of more than two also all but the first, and all in turn.

        Where an input is declared, also all alike. Sensors of sites without an equation are taken to be on time.
        """
        chain = scene.chain
        if not effect.texts(chain.order, chain.is_complex):
            return
        if scene.inputs and chain.sites == len(chain.moving) and any("f" in Term(text).names for text in scene.texts):
            yield cls(effect=effect, sites=chain.moving, strength=(0.0,), omega=scene.main, pattern="alike")
        if chain.sites < 2:
            return
        others = chain.moving[1:]
        for sites in [*((site,) for site in chain.moving), *([others] if len(others) > 1 else [])]:
            yield cls(effect=effect, sites=sites, strength=(0.0,) * len(sites), omega=scene.main)
        if len(others) > 1:
            yield cls(effect=effect, sites=chain.moving, strength=(0.0,), omega=scene.main, pattern="in turn")

    @property
    def place(self) -> tuple[object, ...]:
        """The effect, the sites, and how they lag."""
        return (self.effect.name, self.sites, self.pattern)

    @property
    def site(self) -> int | None:
        """The site, where it is one among others."""
        return None if self.pattern == "alike" else super().site

    @property
    def possible(self) -> bool:
        """Whether no single sensor is ahead of all others: these then lag."""
        return self.site is None or self.strength[0] >= 0

    @property
    def latest(self) -> float:
        """The longest lag."""
        return float(np.max(np.abs(self.strength @ self._lags(len(self.sites), range(len(self.sites))))))

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the columns that lag."""
        if self.pattern == "in turn":
            return ("lag from one sensor to the next",)
        if self.pattern == "alike":
            return ("lag behind the input",)
        return tuple(f"lag of u{site + 1}" for site in self.sites)

    def lateness(self, t: ndarray, sites: int) -> tuple[ndarray, ndarray]:  # noqa: ARG002
        """Return the lag of each sensor, and its derivatives by the numbers."""
        lags = self._lags(sites, self.sites)
        return (self.strength @ lags)[None, None], lags[:, None, None]

    def _lags(self, sites: int, lagging: Sequence[int]) -> Float[ndarray, "numbers sites"]:
        """Return the lag of each site for a unit of each number."""
        own = np.eye(sites)[list(lagging)]
        if self.pattern == "in turn":
            return np.arange(len(lagging))[None] @ own
        return own.sum(axis=0, keepdims=True) if self.pattern == "alike" else own

    def sentences(self, chain: Chain) -> list[str]:
        """Return the lags."""
        pairs = zip(self.labels(chain), self.strength, strict=True)
        return [f"{label}: {value:.{DIGITS}g}" for label, value in pairs]
