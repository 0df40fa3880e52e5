"""What swings at a frequency of its own, but for a while only."""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.acting.placed import Force, InStep, Placed, since
from latticebench.diagnosis.acting.scene import Chain, Scene
from latticebench.diagnosis.acting.swinging import Swinging, Wave

if TYPE_CHECKING:
    from numpy import ndarray
    from typing_extensions import Self

Switch = Literal["begin", "end"]

# The recording is cut into so many parts, at the ends of which something may be switched on or off.
PARTS = 6
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

    @property
    def near(self) -> tuple[object, ...]:
        """The place and the frequency, with the times in radians of it."""
        return (*super().near, *(f"{self.omega * time:.0f}" for time in self.times().values()))

    def beside(self, others: Sequence[Placed]) -> Sequence[Placed]:
        """Return it at the next frequencies to both sides, of those that outside influences may have."""
        alike = [one for one in others if isinstance(one, Swinging) and one.effect is self.effect]
        every = sorted({one.omega for one in alike if not one.general})
        here = bisect.bisect(every, self.omega)
        near, far, still = rules.LINE, rules.AROUND, replace(self, strength=(0.0,) * len(self.strength))
        chosen = [*every[max(here - far, 0) : max(here - near, 0)], *every[here + near : here + far]]
        return [still.tuned(omega) for omega in chosen]

    def times(self) -> dict[Switch, float]:
        """Return when it is switched on and off within the recordings, with as many digits as that has a meaning."""
        digits = 1 - int(np.floor(np.log10(self.edge)))
        return {name: round(float(getattr(self, name)), digits) for name in SWITCHES if name not in self.moot}

    def sharper(self) -> Iterator[Self]:
        """Yield it switched on and off at times about its own, an eighth of it and a quarter away."""
        quarter = (min(self.end, self.seen[1]) - max(self.begin, self.seen[0])) / 8
        shifts = [(0.0,) if name in self.moot else quarter * np.arange(-2, 3.0) for name in SWITCHES]
        still = replace(self, strength=(0.0,) * len(self.strength))
        for early, late in itertools.product(*shifts):
            yield still.lasting(self.begin + float(early), self.end + float(late))

    @property
    def switched(self) -> Iterator[Self]:
        """The same, switched on or off a quarter of a wave earlier or later, or as long beyond a zero as before it.

        Between, the wave pushes as much to one side as to the other: small steps do not find the way.
        """
        half, (a, b) = np.pi / abs(self.omega), self.strength[:: len(self.texts)]
        zero = self.middle + float(np.arctan2(-a, b)) / self.omega
        for name, time in self.times().items():
            before = zero + half * float(np.floor((time - zero) / half))
            for other in (time - half / 2, time + half / 2, 2 * before - time, 2 * (before + half) - time):
                yield self.moved(
                    [*self.numbers[:-2], *(other if each == name else getattr(self, each) for each in SWITCHES)]
                )

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
        """Return cosine and sine of each term, with the times when they act in Iverson's bracket, [t > 5]."""
        times = {name: f"{time:.15g}" for name, time in self.times().items()}
        during = "t"
        if "begin" in times:
            during = f"{times['begin']} < t" if "end" in times else f"t > {times['begin']}"
        if "end" in times:
            during = f"{during} < {times['end']}"
        return tuple(f"{label}*[{during}]" if times else label for label in super().labels(chain))

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
            begin = scene.begin + apart * first if first else scene.seen[0] - apart
            end = scene.begin + apart * last if last < PARTS else scene.seen[1] + apart
            yield begin, end, _round((begin + end) / 2, end - begin)


def _round(middle: float, span: float) -> float:
    """Return a time near the middle that is as round as this span lets it be."""
    unit = 10.0 ** np.floor(np.log10(span / 10))
    return float(unit * np.round(middle / unit))
