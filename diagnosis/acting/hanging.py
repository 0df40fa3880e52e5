"""What swings beside sites and is not read: it has a frequency, a loss and a state of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import Placed
from latticebench.diagnosis.acting.scene import Course
from latticebench.methods.engine.dynamics import Factor

if TYPE_CHECKING:
    from typing import Self

    from jaxtyping import Float
    from numpy import ndarray

# Frequencies that are tried are so many times the last, with a loss that makes the resonance as wide as they are apart.
APART = 1.12
# The loss of what rings, as a share of its frequency.
RINGING = 0.01
# A loss may seem to be a gain by this share of the frequency: a recording may not tell them apart.
UNTOLD = 0.1
# Steps between two readings on which a motion is taken for straight.
FINE = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class Hanging(Placed):
    """Something that swings and is not read; its first strength is a mass.

    Attributes:
        omega: angular frequency, one over the unit of time.
        gamma: of the dashpot that it hangs on, likewise.
        past: how the sites of each recording move without it: for the score.
        step: a typical time between readings.
    """

    omega: float
    gamma: float
    past: tuple[Course, ...]
    step: float
    timed: ClassVar[bool] = True
    positive: ClassVar[bool] = True

    @property
    def near(self) -> tuple[object, ...]:
        """The place, with the frequency to one digit."""
        return (*self.place, f"{self.omega:.1g}")

    def tuned(self, frequency: float) -> Self:
        """Return it swinging at another angular frequency, and for long."""
        return replace(self, omega=frequency, gamma=RINGING * frequency)

    def with_past(self, past: tuple[Factor, ...]) -> Self:
        """Return it beside sites that move in another way; what is still being forecast tells nothing."""
        courses = tuple(one for one in past if isinstance(one, Course))
        return replace(self, past=courses or self.past)


def frequencies(lowest: float, highest: float) -> Float[ndarray, " frequencies"]:
    """Return angular frequencies from the lowest to the highest that are tried."""
    return np.asarray(lowest * APART ** np.arange(1 + int(np.log(highest / lowest) / np.log(APART))))
