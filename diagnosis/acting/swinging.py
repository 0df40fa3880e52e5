"""What swings at a frequency of its own."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.acting.placed import Force, InStep, Placed, since
from latticebench.diagnosis.acting.scene import Chain

if TYPE_CHECKING:
    from numpy import ndarray
    from typing_extensions import Self


@dataclass(frozen=True)
class Wave(InStep):
    """The factor s**power * cos(omega s), or sin(omega s), with s = t - middle, the same at all sites.

    Attributes:
        name: "cos" or "sin".
        omega: angular frequency, one over the unit of time.
        middle: the time of phase zero.
        power: of s, for derivatives by omega.
    """

    name: Literal["cos", "sin"]
    omega: float
    middle: float = 0.0
    power: int = 0

    def __call__(self, t: ndarray) -> ndarray:
        """Return its values (1, B, 1)."""
        function = np.cos if self.name == "cos" else np.sin
        s = t - self.middle
        return np.asarray((s**self.power * function(self.omega * s))[None, :, None])

    def __str__(self) -> str:
        """Return it in the term language."""
        s = since(self.middle)
        return f"{f'{s}**{self.power}*' if self.power else ''}{self.name}({self.omega!r}*{s})"


@dataclass(frozen=True, eq=False, kw_only=True)
class Swinging(Placed):
    """A term times a cos(omega s) + b sin(omega s) with s = t - middle.

    Attributes:
        texts: T, or T and i*T for complex coefficients.
        omega: angular frequency, one over the unit of time.
        middle: the time of phase zero, near the middle of the recording, where phase and frequency are independent.
    """

    texts: tuple[str, ...]
    omega: float
    middle: float = 0.0
    shape: ClassVar[tuple[str, ...]] = ("omega",)
    timed: ClassVar[bool] = True

    def labels(self, chain: Chain) -> tuple[str, ...]:  # noqa: ARG002
        """Return cosine and sine of each term."""
        waves = (f"{name}({self.omega:.6g}*{since(self.middle)})" for name in ("cos", "sin"))
        return tuple(wave if text == "1" else f"{wave}*{_factor(text)}" for wave in waves for text in self.texts)

    @property
    def near(self) -> tuple[object, ...]:
        """The effect and its frequency, to two digits."""
        return (*self.place, f"{self.omega:.2g}")

    @property
    def frequency(self) -> float:
        """The angular frequency."""
        return self.omega

    def tuned(self, frequency: float) -> Self:
        """Return it at another angular frequency."""
        return replace(self, omega=frequency)

    def beside(self, others: Sequence[Placed]) -> Sequence[Placed]:
        """Return the waves at the next frequencies to both sides, without those in the line that this one makes."""
        alike = [
            one for one in others
            if one.effect is self.effect and isinstance(one, Swinging) and one.place == self.place
        ]  # fmt: skip
        alike.sort(key=lambda one: one.omega)
        here = bisect.bisect(alike, self.omega, key=lambda one: one.omega)
        near, far = rules.LINE, rules.AROUND
        return [*alike[max(here - far, 0) : max(here - near, 0)], *alike[here + near : here + far]]

    def waves(self, chain: Chain) -> list[Force]:
        """Return the waves and, for the frequency, their derivatives by it."""
        last, count, share, found = len(self.strength), len(self.texts), self.share(chain), []
        for k, text in enumerate(self.texts):
            a, b = self.strength[k], self.strength[count + k]
            found += [
                Force(text, a, {k: 1.0}, share, Wave("cos", self.omega, self.middle)),
                Force(text, b, {count + k: 1.0}, share, Wave("sin", self.omega, self.middle)),
            ]
            if a or b:
                found += [
                    Force(text, 0.0, {last: -a}, share, Wave("sin", self.omega, self.middle, 1)),
                    Force(text, 0.0, {last: b}, share, Wave("cos", self.omega, self.middle, 1)),
                ]
        return found


def _factor(text: str) -> str:
    """Return a term as one that is multiplied: a sum in brackets."""
    return f"({text})" if "+" in text or "-" in text else text
