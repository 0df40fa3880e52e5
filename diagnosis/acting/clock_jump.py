"""A clock that jumps: a camera that drops frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.late import Late
from latticebench.diagnosis.acting.placed import DIGITS, Force, Placed
from latticebench.diagnosis.acting.pulse import MOST_MIDDLES
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.diagnosis.acting.sudden import Rise, Sudden
from latticebench.systems.effects import Effect

if TYPE_CHECKING:
    from numpy import ndarray

# The width of a jump over the time between two readings: frames are missing between two of those that are left.
BETWEEN = 0.2
# A jump of so few readings from the first or the last one may be anything.
FEW = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class ClockJump(Sudden, Late, acts="clock jump"):
    """From one time on all readings are of a time later by the strength than they say (`late.misread_late`).

    Cameras drop frames where a computer does not keep up: the frames that are left are numbered through.

    Attributes:
        recording: the number of the only recording, from 0, in which it does so; None where there is one.
    """

    recording: int | None = None
    velocities: ClassVar[bool] = True
    separated_by: ClassVar[str] = "a second clock in the picture, or the times that the camera writes itself"

    @classmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return times all over the recordings, in each of several.

        Near unknown ends, what is read late drives the chain, too: none.
        """
        chain, apart = scene.chain, scene.span / MOST_MIDDLES
        if len(chain.moving) < chain.sites or not effect.texts(chain.order, chain.is_complex):
            return
        for recording in range(len(scene.recordings)) if len(scene.recordings) > 1 else (None,):
            for at in scene.begin + apart * np.arange(1, MOST_MIDDLES):
                yield cls(
                    effect=effect, strength=(0.0,), at=float(at), width=apart / 2, least=BETWEEN * scene.step,
                    seen=scene.seen, omega=scene.main, recording=recording,
                )  # fmt: skip

    @property
    def place(self) -> tuple[object, ...]:
        """The effect and the recording."""
        return (self.effect.name, self.recording)

    def acts_in(self, recording: int) -> bool:
        """Return whether it is there in a recording."""
        return self.recording in (None, recording)

    def settings(self) -> dict[str, float | int | str]:
        """Return when it happens, and the recording, from 1, where there are several."""
        return super().settings() | ({} if self.recording is None else {"recording": self.recording + 1})

    @property
    def possible(self) -> bool:
        """Whether it happens well within the recording, and no clock goes back by the time between readings."""
        step = self.least / BETWEEN
        within = self.seen[0] + FEW * step < self.at < self.seen[1] - FEW * step
        return within and self.strength[0] > -step

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return what the number is."""
        return (
            "time that the clock loses" + ("" if self.recording is None else f" in recording {self.recording + 1}"),
        )

    def courses(self, chain: Chain) -> list[Force]:  # noqa: ARG002
        """Return the velocity from the jump on and, for time and width, its derivatives by them; to first order."""
        return self.rising("v[n]")

    @property
    def latest(self) -> float:
        """Nothing: times are put right."""
        return 0.0

    def stays(self, *, velocities: bool) -> bool:  # noqa: ARG002
        """Return that times are put right, whatever was read."""
        return False

    def lateness(self, t: ndarray, sites: int) -> tuple[ndarray, ndarray]:  # noqa: ARG002
        """Return how late readings are, which is less than not at all, and its derivatives by the numbers."""
        by = -self.risen(t)[:, :, None, None]
        return self.strength[0] * by[0], by

    def told(self, t: ndarray) -> ndarray:
        """Return the times with what was lost."""
        return np.asarray(t + self.strength[0] * Rise(self.at, self.wide)(t)[0, :, 0])

    def sentences(self, chain: Chain) -> list[str]:
        """Return how much time is lost, and when."""
        return [f"{self.labels(chain)[0]}: {self.strength[0]:.{DIGITS}g} at t = {self.at:.{DIGITS}g}"]
