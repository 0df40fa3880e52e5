"""An effect in its place: the terms that it adds to the equation, what it makes of the readings, and how it is said.

Each way of acting is one class in one file of this folder, a subclass of `Placed`; it is known by the text that an
effect of the catalogue has in its field `acts`.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from latticebench.diagnosis.acting.scene import Chain, Course, Scene
from latticebench.methods.engine.dynamics import Factor
from latticebench.methods.engine.resonator import Resonator
from latticebench.systems.effects import HOW, Effect
from latticebench.systems.stencil import Ends

if TYPE_CHECKING:
    from typing import Self

    import sympy
    from jaxtyping import Float
    from numpy import ndarray

WAYS: dict[str, type[Placed]] = {}
"""The ways of acting by name."""

DIGITS = 4
# What tells instrument from motion, and one site from all.
OTHER_SENSORS = (
    "the same motion read by other sensors, or by these at other sites: a fault goes with the sensor, physics stays "
    "with the site"
)
ELSEWHERE = "a motion that is large elsewhere in the chain: what sits at one site is felt only there"


@dataclass(frozen=True, eq=False)
class Force:
    """One term of the right-hand side: coefficient * weights[n] * factor(t) * text.

    Attributes:
        text: in the term language.
        coefficient: its value.
        by: derivatives of the coefficient by the numbers of the effect, as far as they are not zero.
        weights: of each site (N,); None for 1.
        factor: of time, see `methods.engine.dynamics.Dynamics`: one for all recordings or one for each; None for 1.
    """

    text: str
    coefficient: float
    by: Mapping[int, float]
    weights: Float[ndarray, " sites"] | None = None
    factor: Factor | tuple[Factor, ...] | None = None

    def factor_of(self, recording: int) -> Factor | None:
        """Return the factor of one recording."""
        if isinstance(self.factor, tuple):
            return self.factor[min(recording, len(self.factor) - 1)]
        return self.factor


class InStep(ABC):
    """A factor of time that is the same at all sites; two with the same numbers are equal.

    As a text it is in the term language.
    """

    @abstractmethod
    def __call__(self, t: ndarray) -> ndarray:
        """Return its values (1, B, 1)."""


@dataclass(frozen=True, eq=False)
class Misreading:
    """What an instrument adds to the readings of a motion.

    Attributes:
        added: (rows, levels, parts, N), in units of the readings; `read` cuts it to the levels that were read.
        slope: its derivative by the reading's own field, likewise; dimensionless.
        by: its derivatives by the numbers of the effect (numbers, rows, levels, parts, N).
        by_rates: those by v and its rate (rows, levels, 2, parts, N), but for the reading's own field; None for 0.
        by_others: those by the same field at other sites, or of the other part, as far as that is heard, a row for each
            reading (levels, parts * N, parts * N); None for 0.
    """

    added: Float[ndarray, "rows levels parts sites"]
    slope: Float[ndarray, "rows levels parts sites"]
    by: Float[ndarray, "numbers rows levels parts sites"]
    by_rates: Float[ndarray, "rows levels 2 parts sites"] | None = None
    by_others: Float[ndarray, "levels channels channels"] | None = None

    def read(self, levels: int) -> Misreading:
        """Return what concerns the levels that were read."""
        by_rates = None if self.by_rates is None else self.by_rates[:, :levels]
        by_others = None if self.by_others is None else self.by_others[:levels]
        return Misreading(self.added[:, :levels], self.slope[:, :levels], self.by[:, :, :levels], by_rates, by_others)


@dataclass(frozen=True, eq=False)
class Summand:
    """A term that acts at every site: its text, its coefficient, and what it is multiplied with in mathematics."""

    text: str
    coefficient: float
    body: sympy.Expr


@dataclass(frozen=True, eq=False, kw_only=True)
class Placed(ABC):
    """An effect of the catalogue in its place, with its numbers.

    The numbers are the strengths, in which what it does is linear, and the fields that `shape` names.

    Attributes:
        effect: of the catalogue.
        strength: coefficients, one per label.
        shape: names of the fields that a fit changes besides.
        instrument: whether it acts on readings, not on the motion.
        timed: whether it has a frequency or a time of its own; it can then stand in for much on short horizons.
        slow: whether it is looked for on long horizons alone, whatever is seen on short ones.
        local: whether it acts at single sites, or at each differently.
        fed: whether it depends on the field at earlier times.
        general: whether it is looked for only in the place of another effect: as what that one is a special case of, or
            at declared terms. With a number for each bond it would take whatever is missing where there is hardly any
            noise.
        positive: whether its first strength can only be positive.
        separated_by: the measurement that tells this way of acting from others; nothing where none is known.
    """

    effect: Effect
    strength: tuple[float, ...]
    shape: ClassVar[tuple[str, ...]] = ()
    instrument: ClassVar[bool] = False
    timed: ClassVar[bool] = False
    slow: ClassVar[bool] = False
    local: ClassVar[bool] = False
    fed: ClassVar[bool] = False
    general: ClassVar[bool] = False
    positive: ClassVar[bool] = False
    separated_by: ClassVar[str] = ""

    def __init_subclass__(cls, acts: str = "", how: str = "") -> None:
        """Make a way of acting known by its name; `how` explains it where `systems.effects.HOW` does not."""
        super().__init_subclass__()
        if acts:
            WAYS[acts] = cls
            HOW.setdefault(acts, how)

    @classmethod
    @abstractmethod
    def places(cls, effect: Effect, scene: Scene) -> Iterator[Placed]:
        """Return the effect at every place where it may be, of strength zero."""

    @abstractmethod
    def labels(self, chain: Chain) -> tuple[str, ...]:
        """Return what each strength is the coefficient of."""

    @property
    def site(self) -> int | None:
        """The single site where it acts, from 0; None where there is no such site."""
        return None

    @property
    def numbers(self) -> Float[ndarray, " numbers"]:
        """All numbers that a fit changes."""
        return np.array([*self.strength, *(getattr(self, name) for name in self.shape)], dtype=float)

    @property
    def count(self) -> int:
        """How many numbers a fit changes."""
        return len(self.strength) + len(self.shape)

    def moved(self, numbers: Sequence[float] | Float[ndarray, " numbers"]) -> Self:
        """Return the same effect with other numbers."""
        count = len(self.strength)
        fields: dict[str, Any] = dict(zip(self.shape, map(float, numbers[count:]), strict=True))
        return replace(self, strength=tuple(map(float, numbers[:count])), **fields)

    @property
    def place(self) -> tuple[object, ...]:
        """What distinguishes it from the same effect elsewhere, numbers apart."""
        return (self.effect.name,)

    @property
    def near(self) -> tuple[object, ...]:
        """The place, with the numbers of `shape` roughly."""
        return self.place

    @property
    def frequency(self) -> float | None:
        """The angular frequency at which it swings; None where it has none of its own."""
        return None

    def tuned(self, frequency: float) -> Self:  # noqa: ARG002
        """Return it at another angular frequency, where it has one."""
        return self

    @property
    def moment(self) -> tuple[float, float] | None:
        """The middle and the width of the time in which it acts; None where it acts all the time."""
        return None

    def at_moment(self, moment: tuple[float, float]) -> Self:  # noqa: ARG002
        """Return it at another time, where it has one."""
        return self

    def lasting(self, begin: float, end: float) -> Self | None:  # noqa: ARG002
        """Return it from one time up to another; None where it acts all the time, or at one time."""
        return None

    def beside(self, others: Sequence[Placed]) -> Sequence[Placed]:  # noqa: ARG002
        """Return those of its kind that act nearly, but plainly not as it does; none where no such order is known."""
        return ()

    @property
    def moot(self) -> tuple[str, ...]:
        """Names of numbers that make no difference as they are, so that nothing is known of them."""
        return ()

    @property
    def begins(self) -> float:
        """The time from which readings show it."""
        return -np.inf

    @property
    def possible(self) -> bool:
        """Whether its numbers are such as it may have."""
        return True

    def acts_in(self, recording: int) -> bool:  # noqa: ARG002
        """Return whether it is there in a recording, of which this is the number."""
        return True

    def with_past(self, past: tuple[Factor, ...]) -> Self:  # noqa: ARG002
        """Return it with another field at earlier times of each recording, where that matters to it."""
        return self

    def share(self, chain: Chain) -> Float[ndarray, " sites"] | None:  # noqa: ARG002
        """Return how much of it each site has (N,); None where all have the whole."""
        return None

    def forces(self, chain: Chain) -> list[Force]:  # noqa: ARG002
        """Return the terms that it adds to the right-hand side."""
        return []

    def resonator(self, chain: Chain) -> Resonator | None:  # noqa: ARG002
        """Return what swings beside a site and is not read; its numbers are those of the effect.

        A model has this in the place of forces, which then say what the effect would do to first order.
        """
        return None

    def sharper(self) -> Iterator[Self]:
        """Yield it with other numbers that are tried where its place is known."""
        yield from ()

    def unread(self, past: Course, t: Float[ndarray, "pieces m"]) -> Float[ndarray, "pieces m numbers"]:
        """Return about where what is not read would be, if it was at rest as the recording began, and its rate."""
        raise NotImplementedError(f"all of {self.effect.name} is read")

    def courses(self, chain: Chain) -> list[Force]:  # noqa: ARG002
        """Return what it adds to readings of u in time: terms "1", "i*1", "u[n]", "v[n]" with their factors."""
        return []

    def scaled(self) -> int | None:
        """Return the site whose whole right-hand side is multiplied by 1 + the strength; None where there is none."""
        return None

    def quickened(self) -> float | None:
        """Return the excess over 1 of how fast all goes by the recording's clock; None where that is right."""
        return None

    def stays(self, *, velocities: bool) -> bool:  # noqa: ARG002
        """Return whether corrected readings still have it; `velocities` says whether those were read."""
        return False

    def told(self, t: Float[ndarray, " rows"]) -> Float[ndarray, " rows"]:
        """Return the times that a right clock would have shown."""
        return t

    def other_ends(self) -> Ends | None:
        """Return how the chain ends instead of as declared; None where that does not change."""
        return None

    def wandering(self) -> int | None:
        """Return the site whose sensor has a zero that wanders; None where there is none."""
        return None

    def with_walks(self, walk: Float[ndarray, " sensors"]) -> Self:  # noqa: ARG002
        """Return it with how far zeros wander, by the root of the time, where that is what it says."""
        return self

    def misread(self, t: ndarray, field: ndarray) -> Misreading:
        """Return what the instrument makes of u and, where there are, v and its rate (rows, levels, parts, N)."""
        raise NotImplementedError(f"{self.effect.name} acts on the motion, not on readings")

    @property
    def from_the_start(self) -> bool:
        """Whether it is tried before anything is known: without it, the numbers of the equation may lead astray."""
        return False

    @property
    def turns(self) -> bool:
        """Whether it says that a sensor looks from the other side."""
        return self.turned() is not None and self.strength[0] < -1

    def turned(self) -> Placed | None:
        """Return the same with a sensor that looks from the other side; None for what is no single sensor."""
        return None

    def settings(self) -> dict[str, float | int | str]:
        """Return where and how it acts, for people: the site (from 1), a frequency, a delay, ..."""
        found: dict[str, float | int | str] = {} if self.site is None else {"site": self.site + 1}
        return found | {name: float(getattr(self, name)) for name in self.shape if name not in self.moot}

    def natural(self, chain: Chain, frequency: float) -> dict[str, float]:  # noqa: ARG002
        """Return its numbers in the form in which people know them, by what they are: factors, mass ratios, times.

        Args:
            chain: the lattice.
            frequency: the lowest angular frequency of the recording; NaN where none is known.
        """
        return dict(zip([*self.labels(chain), *self.shape], map(float, self.numbers), strict=True))

    @classmethod
    def separated_from(cls, other: type[Placed]) -> str:
        """Return which measurement would tell this way of acting from another; nothing where both act alike."""
        if cls.instrument != other.instrument:
            return (cls if cls.instrument else other).separated_by or OTHER_SENSORS
        # The same for either order of the two.
        known = "" if cls is other else max(cls.separated_by, other.separated_by)
        if cls.local != other.local:
            return (cls.instrument and known) or ELSEWHERE
        return known

    def summands(self, chain: Chain) -> list[Summand]:  # noqa: ARG002
        """Return the terms that it brings to every site's equation."""
        return []

    def sentences(self, chain: Chain) -> list[str]:  # noqa: ARG002
        """Return in words what it does that is no term of every site."""
        return []


@dataclass(frozen=True, eq=False, kw_only=True)
class AtOneSite(Placed):
    """What acts at a single site.

    Attributes:
        here: the site, from 0.
    """

    here: int
    local: ClassVar[bool] = True

    @property
    def site(self) -> int:
        """The site, from 0."""
        return self.here

    @property
    def place(self) -> tuple[object, ...]:
        """The effect and its site."""
        return (self.effect.name, self.here)

    def share(self, chain: Chain) -> Float[ndarray, " sites"]:
        """Return 1 at the site, 0 elsewhere."""
        return np.asarray(np.eye(chain.sites)[self.here])

    def summands(self, chain: Chain) -> list[Summand]:  # noqa: ARG002
        """Return nothing: it is no term of every site."""
        return []

    def sentences(self, chain: Chain) -> list[str]:
        """Return what the site has."""
        sum_ = joined(times(value, text) for text, value in zip(self.labels(chain), self.strength, strict=True))
        return [f"site {self.here + 1} alone has {sum_} besides"]


@dataclass(frozen=True, eq=False, kw_only=True)
class OfSensors(Placed):
    """What some sensors do to their readings.

    Attributes:
        sites: those of the sensors, from 0.
        recording: the number of the only recording, from 0, in which they do so; None for all.
    """

    sites: tuple[int, ...]
    recording: int | None = None
    instrument: ClassVar[bool] = True
    local: ClassVar[bool] = True

    def acts_in(self, recording: int) -> bool:
        """Return whether it is there in a recording."""
        return self.recording in (None, recording)

    @property
    def then(self) -> str:
        """In which recording, in words; "" for all."""
        return "" if self.recording is None else f" in recording {self.recording + 1}"

    @property
    def site(self) -> int | None:
        """The site, where it is one."""
        return self.sites[0] if len(self.sites) == 1 else None

    @property
    def place(self) -> tuple[object, ...]:
        """The effect, the sites, and the recording."""
        return (self.effect.name, self.sites, self.recording)

    def settings(self) -> dict[str, float | int | str]:
        """Return the site and the recording, where it is one, both from 1."""
        return super().settings() | ({} if self.recording is None else {"recording": self.recording + 1})


def times(value: float, text: str) -> str:
    """Return a coefficient times a term as text."""
    return f"{value:.{DIGITS}g}" if text == "1" else f"{value:.{DIGITS}g}*{text}"


def joined(summands: Iterable[str]) -> str:
    """Return a sum of what `times` returns, as text."""
    return " + ".join(summands).replace("+ -", "- ")


def since(middle: float) -> str:
    """Return the time since another one, in the term language.

    >>> since(0.0), since(12.5), since(-3.0)
    ('t', '(t-12.5)', '(t+3)')
    """
    return f"(t{-middle:+.15g})" if middle else "t"


def decimal(value: float) -> sympy.Expr:
    """Return a number as SymPy has it, with the digits that people are shown."""
    import sympy

    text = f"{value:.15g}"
    return sympy.Integer(text) if re.fullmatch(r"-?\d+", text) else sympy.Float(text)


def way_of(effect: Effect) -> type[Placed]:
    """Return the way of acting of an effect of the catalogue."""
    return WAYS[effect.acts]
