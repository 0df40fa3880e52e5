"""What swings at a frequency of its own, but for a while only."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from latticebench.diagnosis.acting.placed import DIGITS, Force, InStep, since
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.diagnosis.acting.swinging import Swinging, Wave

if TYPE_CHECKING:
    from numpy import ndarray
    from typing_extensions import Self

Switch = Literal["begin", "end"]

# The recording is cut into so many parts, at the ends of which something may be switched on or off.
PARTS = 6
# Switching takes this share of the shortest time in which the motion changes by a radian: see `step.SHARP`.
SHARP = 0.1
SWITCHES: tuple[Switch, ...] = ("begin", "end")


@dataclass(frozen=True)
class Lasted(InStep):
    """A wave times (tanh((t - begin) / edge) - tanh((t - end) / edge)) / 2, or times the derivative of that.

    Attributes:
        wave: the factor that lasts for a while.
        begin, end, edge: in the unit of time.
        by: what the window is derived by; None for itself.
    """

    wave: Wave
    begin: float
    end: float
    edge: float
    by: Switch | None = None

    def __call__(self, t: ndarray) -> ndarray:
        """Return its values (1, B, 1)."""
        on, off = (np.tanh((t - time) / self.edge) for time in (self.begin, self.end))
        slopes = {"begin": on**2 - 1, "end": 1 - off**2}
        window = (on - off) / 2 if self.by is None else slopes[self.by] / (2 * self.edge)
        return np.asarray(self.wave(t) * window[None, :, None])

    def __str__(self) -> str:
        """Return it in the term language."""
        on, off = (f"tanh({since(time)}/{self.edge!r})" for time in (self.begin, self.end))
        slopes = {"begin": f"({on}**2-1)", "end": f"(1-{off}**2)"}
        window = f"({on}-{off})/2" if self.by is None else f"{slopes[self.by]}/{2 * self.edge!r}"
        return f"{self.wave}*{window}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Lasting(Swinging):
    """A term that swings from one time on up to another: a motor that is switched on, a burst of waves.

    Attributes:
        begin, end: in the unit of time; one of them may be outside of the recording.
        edge: how long switching takes, likewise.
        seen: the first and the last time of all recordings.
    """

    begin: float
    end: float
    edge: float
    seen: tuple[float, float]
    shape: ClassVar[tuple[str, ...]] = ("omega", "begin", "end")
    general: ClassVar[bool] = True

    @property
    def place(self) -> tuple[object, ...]:
        """The place of what swings all the time, and that this does not."""
        return (*super().place, "for a while")

    def lasting(self, begin: float, end: float) -> Self:
        """Return it from one time up to another, its phase counted from the middle between."""
        return replace(self, begin=begin, end=end, middle=_round((begin + end) / 2, end - begin))

    @property
    def possible(self) -> bool:
        """Whether it is switched on or off within the recordings, in this order."""
        return self.seen[0] < self.end and self.begin < min(self.end, self.seen[1]) and len(self.moot) < 2

    @property
    def moot(self) -> tuple[str, ...]:
        """The times that are outside of the recordings."""
        early, late = self.begin <= self.seen[0], self.end >= self.seen[1]
        return ("begin",) * early + ("end",) * late

    @property
    def begins(self) -> float:
        """When it is switched on."""
        return -np.inf if "begin" in self.moot else self.begin

    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return cosine and sine of each term, and when."""
        begin = "" if "begin" in self.moot else f" from t = {self.begin:.{DIGITS}g}"
        end = "" if "end" in self.moot else f" up to t = {self.end:.{DIGITS}g}"
        return tuple(f"{label}{begin}{end}" for label in super().labels(chain))

    def waves(self, chain: Chain) -> list[Force]:
        """Return the waves and, for frequency and times, their derivatives by them."""
        forces = [(one, one.factor) for one in super().waves(chain)]
        swings = [(one, factor) for one, factor in forces if isinstance(factor, Wave)]
        found = [replace(one, factor=self._during(factor)) for one, factor in swings]
        last = len(self.strength)
        for one, factor in swings:
            # Those by the frequency have no strength.
            if one.coefficient:
                found += [
                    replace(one, coefficient=0.0, by={last + k: one.coefficient}, factor=self._during(factor, by))
                    for k, by in enumerate(SWITCHES, 1)
                ]
        return found

    def _during(self, wave: Wave, by: Switch | None = None) -> Lasted:
        return Lasted(wave, self.begin, self.end, self.edge, by)


def windows(scene: Scene) -> Iterator[tuple[float, float, float]]:
    """Return begin, end and the round time between them of some parts of the recording."""
    apart = scene.span / PARTS
    for first, last in itertools.combinations(range(PARTS + 1), 2):
        if last - first < PARTS:
            begin, end = (scene.begin + apart * k for k in (first - (first == 0), last + (last == PARTS)))
            yield begin, end, _round((begin + end) / 2, end - begin)


def _round(middle: float, span: float) -> float:
    """Return a time near the middle that is as round as this span lets it be."""
    unit = 10.0 ** np.floor(np.log10(span / 10))
    return float(unit * np.round(middle / unit))
