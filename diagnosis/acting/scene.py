"""What an effect has to know of a lattice and of its recordings before it is placed in them."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.effects import Effect
from latticebench.systems.stencil import Ends
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray
    from scipy.interpolate import CubicSpline

# On fewer sites a dependence on the place cannot be told from what single sites have.
PLACES = 4
# A round time near the middle of a recording is a multiple of the power of ten below this share of its span.
OF_THE_SPAN = 0.05


@dataclass(frozen=True, eq=False)
class Course:
    """A field that is known as a curve, constant before and after it.

    Attributes:
        curve: u (T, parts, N).
        begin, end: its first and its last time.
    """

    curve: CubicSpline
    begin: float
    end: float

    @classmethod
    def of(cls, t: Float[ndarray, " time"], field: Float[ndarray, "time parts sites"]) -> Course:
        """Return the smooth curve through a field at some times."""
        from scipy.interpolate import CubicSpline

        return cls(CubicSpline(t, field), float(t[0]), float(t[-1]))

    def __call__(self, t: ndarray) -> Float[ndarray, "parts times sites"]:
        """Return u at times."""
        return np.moveaxis(np.asarray(self.curve(np.clip(t, self.begin, self.end))), 0, 1)

    def sampled(self, step: float) -> Float[ndarray, "parts grid sites"]:
        """Return u from the first time on in steps, to the last time or just beyond it.

        Hundreds of candidates ask for it with one step.
        """
        if step not in self._kept:
            self._kept.clear()
            self._kept[step] = self(self.begin + step * np.arange(int((self.end - self.begin) / step) + 2))
        return self._kept[step]

    @functools.cached_property
    def _kept(self) -> dict[float, ndarray]:
        return {}


@dataclass(frozen=True)
class Chain:
    """What an effect has to know of the lattice that it acts on.

    Attributes:
        sites: N.
        order: of the time derivative.
        is_complex: whether the field is complex.
        levels: 1 where u is read, 2 where its velocity is, too.
        ends: how the chain ends.
        moving: the sites that have an equation, from 0.
        reach: the widest stencil that terms may have, to either side.
    """

    sites: int
    order: int
    is_complex: bool
    levels: int
    ends: Ends
    moving: tuple[int, ...]
    reach: int

    @property
    def parts(self) -> int:
        """1 for a real field, 2 for a complex one."""
        return 1 + self.is_complex


@dataclass(frozen=True, eq=False)
class Scene:
    """What is known of the recordings before anything is fitted; effects are placed in it.

    Attributes:
        chain: the lattice.
        begin, span: the first time of the longest recording, and its length.
        seen: the first and the last time of all recordings.
        top: the highest angular frequency that the readings plainly show.
        frequencies: angular frequencies that an outside influence may have.
        fast: angular frequencies beyond these, about lines that sensors show: too fast for what moves a chain.
        past: the smoothed field of each recording.
        texts: the declared terms.
        inputs: whether an input was measured.
        recordings: the sites that were read in each recording, where each may have zeros and units of its own.
        step: a typical time between readings.
        main: the angular frequency of the strongest peak in the spectrum; 0 where there is none.
        largest: reading of u from zero.
    """

    chain: Chain
    begin: float
    span: float
    seen: tuple[float, float]
    top: float
    frequencies: Float[ndarray, " frequencies"]
    fast: Float[ndarray, " frequencies"]
    past: tuple[Course, ...]
    texts: tuple[str, ...]
    inputs: bool
    recordings: tuple[tuple[int, ...], ...] = ()
    step: float = 0.0
    main: float = 0.0
    largest: float = 0.0

    @property
    def middle(self) -> float:
        """A round time near the middle of the longest recording: about it, phases hardly depend on frequencies."""
        unit = 10.0 ** np.floor(np.log10(OF_THE_SPAN * self.span))
        return float(unit * np.round((self.begin + self.span / 2) / unit))

    def terms(self, effect: Effect) -> tuple[str, ...]:
        """Return the terms of an effect on this lattice; none where it has no meaning there."""
        texts = effect.texts(self.chain.order, self.chain.is_complex)
        for text in texts:
            term = Term(text)
            if ("f" in term.names and not self.inputs) or max(term.reach) > self.chain.reach:
                return ()
            if "n" in term.names and len(self.chain.moving) < PLACES:
                return ()
        return texts
