"""Sensors that hear one another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Misreading, Placed
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from numpy import ndarray

# The largest share of others in a reading.
MOST = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Crosstalk(Placed, acts="crosstalk"):
    """The reading is u + c * (u of the sensors beside it, or the mean of all), with one c for all readings.

    Cables side by side do this from either side; converters that keep some of the channel before, or after in the order
    of the columns, from one; a ground that is lifted by the current of all sensors from all. Sensors at the ends have
    one neighbour, in a ring of sites, too.

    Attributes:
        heard: places of what is heard less that of the reading's own sensor, in the order of the columns; none for all.
        both: whether velocities are mixed so, too.
    """

    heard: tuple[int, ...]
    both: bool
    instrument: ClassVar[bool] = True
    separated_by: ClassVar[str] = (
        "a recording with one site held fast: its sensor shows what it hears; or the same motion read by other sensors"
    )

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return what is heard: both sides, either one, and of more than two all; without and with velocities."""
        chain = scene.chain
        if chain.sites < 2 or not effect.texts(chain.order, chain.is_complex):
            return
        for both in (False, True)[: chain.levels]:
            for heard in ((-1, 1), (-1,), (1,), *([()] if chain.sites > 2 else [])):
                yield cls(effect=effect, heard=heard, both=both, strength=(0.0,))

    @property
    def place(self) -> tuple[object, ...]:
        """The effect, from where, and whether velocities are concerned."""
        return (self.effect.name, self.heard, self.both)

    @property
    def possible(self) -> bool:
        """Whether each sensor hears its own site more than twice as much as others."""
        return abs(self.strength[0]) * max(len(self.heard), 1) < MOST

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return what is heard."""
        return (f"share of {self._which} in each reading" + (", velocities too" if self.both else ""),)

    @property
    def _which(self) -> str:
        return {(): "the mean of all", (-1,): "the sensor before", (1,): "the sensor after"}.get(
            self.heard, "both neighbours"
        )

    def misread(self, t: ndarray, field: ndarray) -> Misreading:  # noqa: ARG002
        """Return what is heard."""
        _, levels, parts, sites = field.shape
        concerned, by = slice(levels if self.both else 1), np.zeros_like(field)
        mixed = np.zeros((levels, parts * sites, parts * sites))
        for place in self.heard:
            here, there = slice(max(-place, 0), sites - max(place, 0)), slice(max(place, 0), sites - max(-place, 0))
            by[:, concerned, :, here] += field[:, concerned, :, there]
            mixed[concerned] += np.kron(np.eye(parts), np.eye(sites, k=place))
        if not self.heard:
            by[:, concerned] = np.mean(field[:, concerned], axis=3, keepdims=True)
            mixed[concerned] = np.kron(np.eye(parts), np.full((sites, sites), 1 / sites))
        (share,) = self.strength
        return Misreading(share * by, np.zeros_like(field), by[None], by_others=share * mixed)

    def sentences(self, chain: Chain) -> list[str]:  # noqa: ARG002
        """Return how much is heard."""
        return [f"each sensor also reads {self.strength[0]:.{DIGITS}g} times what {self._which} should"]
