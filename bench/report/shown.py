"""What `latticebench plot` draws of a fit or a diagnosis, as a part of its JSON document."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.overlay import Learning, Overlay
from latticebench.bench.report.document import Content, Number
from latticebench.methods.method import History

if TYPE_CHECKING:
    from numpy import ndarray

# Significant digits, more than can be seen.
DIGITS = 6
Values = tuple[tuple[tuple[Number, ...], ...], ...]


class Learnt(Content):
    """The coefficients of a method on the way to its fit.

    Attributes:
        terms: whose coefficients.
        step, seconds, loss: numbers of the steps, wall time since the start, the method's objective.
        coefficients: by step and term.
    """

    terms: tuple[str, ...]
    step: tuple[Number, ...]
    seconds: tuple[Number, ...]
    loss: tuple[Number, ...]
    coefficients: tuple[tuple[Number, ...], ...]

    @classmethod
    def of(cls, learning: Learning) -> Learnt:
        """Return it as a part of a document."""
        way = learning.history
        columns = {name: _short(getattr(way, name)) for name in ("step", "seconds", "loss")}
        return cls(terms=learning.terms, coefficients=tuple(map(_short, way.coefficients)), **columns)

    def learning(self) -> Learning:
        """Return what was written.

        Raises:
            ValueError: its arrays do not match.
        """
        way = History(*(np.array(one, dtype=float) for one in (self.step, self.seconds, self.loss, self.coefficients)))
        if way.coefficients.shape != (len(way.step), len(self.terms)) or not len(way.step) == len(way.loss) > 0:
            raise ValueError("steps, losses and coefficients do not match")
        return Learning(self.terms, way)


class Shown(Content):
    """The first rows of the recording that the equation leaves most of.

    Attributes:
        source: where the readings come from.
        rows: how many rows the recording has.
        t: times.
        seen: readings of u by time, part (real, imaginary) and site.
        noise: standard deviation of the noise of each site in the units of u, or None.
        curves: what equations make of the readings, likewise, by name.
        unit, time_unit: of the readings and of the times; "" where they are not known.
        learning: how the coefficients were found, of a method that iterates.
    """

    source: str
    rows: int
    t: tuple[Number, ...]
    seen: Values
    noise: tuple[Number, ...] | None
    curves: dict[str, Values]
    unit: str = ""
    time_unit: str = ""
    learning: Learnt | None = None

    @classmethod
    def of(cls, overlay: Overlay) -> Shown:
        """Return an overlay as a part of a document."""
        return cls(
            source=overlay.source, rows=overlay.rows, t=tuple(overlay.t.tolist()), seen=_written(overlay.seen),
            noise=None if overlay.noise is None else tuple(overlay.noise.tolist()),
            curves={name: _written(values) for name, values in overlay.curves.items()},
            unit=overlay.unit, time_unit=overlay.time_unit,
            learning=None if overlay.learning is None else Learnt.of(overlay.learning),
        )  # fmt: skip

    def overlay(self) -> Overlay:
        """Return the overlay that was written.

        Raises:
            ValueError: its arrays do not match.
        """
        t, seen = np.array(self.t), np.array(self.seen)
        noise = None if self.noise is None else np.array(self.noise)
        curves = {name: np.array(values) for name, values in self.curves.items()}
        fits = seen.ndim == 3 and len(seen) == len(t) > 1 and seen.shape[1] in (1, 2) and np.all(np.diff(t) > 0)
        if not fits or any(one.shape != seen.shape for one in curves.values()):
            raise ValueError("times, readings and curves do not match")
        if noise is not None and noise.shape != seen.shape[2:]:
            raise ValueError("the noise is not that of the sites")
        learning = None if self.learning is None else self.learning.learning()
        return Overlay(self.source, self.rows, t, seen, None, noise, curves, self.unit, self.time_unit, learning)


def _written(values: ndarray) -> Values:
    return tuple(tuple(_short(part) for part in row) for row in values)


def _short(values: ndarray) -> tuple[float, ...]:
    """Return numbers with as many digits as can be seen."""
    return tuple(float(f"{value:.{DIGITS}g}") for value in values.tolist())
