"""A sensor whose gain changes at one time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.acting.jump import BETWEEN, SHARP
from latticebench.diagnosis.acting.placed import DIGITS, Force, Misreading, OfSensors, Placed
from latticebench.diagnosis.acting.pulse import MOST_MIDDLES
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.diagnosis.acting.sudden import Rise, Sudden
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class GainJump(Sudden, OfSensors, acts="gain jump"):
    """The reading is (1 + c (1 + tanh((t - at) / width)) / 2) u: an amplifier that changes its range.

    Attributes:
        both: whether velocities are read so, too.
    """

    both: bool

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return every site that has an equation, at times all over the recording."""
        chain, apart = scene.chain, scene.span / MOST_MIDDLES
        least = max(SHARP / scene.top, BETWEEN * scene.step)
        if not effect.texts(chain.order, chain.is_complex):
            return
        for both in (False, True)[: chain.levels]:
            for site in chain.moving:
                for at in scene.begin + apart * np.arange(1, MOST_MIDDLES):
                    yield cls(
                        effect=effect, sites=(site,), at=float(at), width=apart / 2, least=least, seen=scene.seen,
                        both=both, strength=(0.0,),
                    )  # fmt: skip

    @property
    def place(self) -> tuple[object, ...]:
        """The effect, the site, and whether velocities are concerned."""
        return (*super().place, self.both)

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return the columns whose gain changes."""
        site = self.sites[0] + 1
        column = f"re{site} and im{site}" if chain.is_complex else f"u{site}" + (f" and v{site}" if self.both else "")
        return (f"change of the gain of {column}",)

    @property
    def possible(self) -> bool:
        """Whether it happens between the first and the last time, and the gain keeps its sign."""
        return super().possible and self.strength[0] > -1

    def share(self, chain: Chain) -> Float[ndarray, " sites"]:
        """Return 1 at the sensor, 0 elsewhere."""
        return np.asarray(np.eye(chain.sites)[self.sites[0]])

    def courses(self, chain: Chain) -> list[Force]:
        """Return what is read more from the change on and, for time and width, its derivatives by them."""
        (more,), wide, share = self.strength, self.wide, self.share(chain)
        found = [Force("u[n]", more, {0: 1.0}, share, Rise(self.at, wide))]
        if more:
            found.append(Force("u[n]", 0.0, {1: more / wide}, share, Rise(self.at, wide, 0)))
            found.append(Force("u[n]", 0.0, {2: more * self.width / wide**2}, share, Rise(self.at, wide, 1)))
        return found

    def misread(self, t: ndarray, field: ndarray) -> Misreading:
        """Return what the gain adds."""
        (more,), wide = self.strength, self.wide
        rise, by_time, by_width = (Rise(self.at, wide, power)(t)[0, :, 0] for power in (None, 0, 1))
        courses = np.stack([rise, more / wide * by_time, more * self.width / wide**2 * by_width])
        by, slope = np.zeros((3, *field.shape)), np.zeros_like(field)
        here = (slice(None), slice(None if self.both else 1), slice(None), self.sites[0])
        by[(slice(None), *here)] = courses[:, :, None, None] * field[here]
        slope[here] = more * rise[:, None, None]
        return Misreading(more * by[0], slope, by)

    def sentences(self, chain: Chain) -> list[str]:
        """Return by how much the gain changes, and when."""
        return [f"{self.labels(chain)[0]}: {self.strength[0]:.{DIGITS}g} at t = {self.at:.{DIGITS}g}"]
