"""A sensor that follows late."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.late import Late
from latticebench.diagnosis.acting.placed import DIGITS, OfSensors, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Lag(OfSensors, Late, acts="lag"):
    """The reading is u a time tau ago (`late.misread_late`).

    Filters, converters that scan their channels and cameras that are not in step do this. A filter of first order
    also reads less, by the root of 1 + omega^2 tau^2 at an angular frequency omega: a gain, where the motion has about
    one frequency. What all sensors lag by is no more than another zero of the time.

    Attributes:
        in_turn: whether each sensor lags behind the one before by the strength; else each site has its own.
    """

    in_turn: bool = False
    separated_by: ClassVar[str] = "a motion of other frequencies: a lag turns into another phase at each of them"

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return each sensor of several; of more than two also all but the first, and all in turn.

        Sensors of sites without an equation are taken to be on time.
        """
        chain = scene.chain
        if chain.sites < 2 or not effect.texts(chain.order, chain.is_complex):
            return
        others = chain.moving[1:]
        for sites in [*((site,) for site in chain.moving), *([others] if len(others) > 1 else [])]:
            yield cls(effect=effect, sites=sites, strength=(0.0,) * len(sites), omega=scene.main)
        if len(others) > 1:
            yield cls(effect=effect, sites=chain.moving, strength=(0.0,), omega=scene.main, in_turn=True)

    @property
    def place(self) -> tuple[object, ...]:
        """The effect, the sites, and whether they lag in turn."""
        return (self.effect.name, self.sites, self.in_turn)

    @property
    def possible(self) -> bool:
        """Whether no single sensor is ahead of all others: these then lag."""
        return self.site is None or self.strength[0] >= 0

    @property
    def latest(self) -> float:
        """The longest lag."""
        lags = np.arange(len(self.sites)) * self.strength[0] if self.in_turn else np.array(self.strength)
        return float(np.max(np.abs(lags)))

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return the columns that lag."""
        if self.in_turn:
            return ("lag from one sensor to the next",)
        return tuple(f"lag of u{site + 1}" for site in self.sites)

    def lateness(self, t: ndarray, sites: int) -> tuple[ndarray, ndarray]:  # noqa: ARG002
        """Return the lag of each sensor, and its derivatives by the numbers."""
        lags = np.eye(sites)[list(self.sites)]
        if self.in_turn:
            lags = np.arange(len(self.sites))[None] @ lags
        return (self.strength @ lags)[None, None], lags[:, None, None]

    def sentences(self, chain: Chain) -> list[str]:
        """Return the lags."""
        pairs = zip(self.labels(chain), self.strength, strict=True)
        return [f"{label}: {value:.{DIGITS}g}" for label, value in pairs]
