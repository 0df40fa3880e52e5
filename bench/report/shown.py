"""What `latticebench plot` draws of a fit or a diagnosis, as a part of its JSON document."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.overlay import Overlay
from latticebench.bench.report.document import Content, Number

if TYPE_CHECKING:
    from numpy import ndarray

# Significant digits, more than can be seen.
DIGITS = 6
Values = tuple[tuple[tuple[Number, ...], ...], ...]


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
    """

    source: str
    rows: int
    t: tuple[Number, ...]
    seen: Values
    noise: tuple[Number, ...] | None
    curves: dict[str, Values]
    unit: str = ""
    time_unit: str = ""

    @classmethod
    def of(cls, overlay: Overlay) -> Shown:
        """Return an overlay as a part of a document."""
        return cls(
            source=overlay.source, rows=overlay.rows, t=tuple(overlay.t.tolist()), seen=_written(overlay.seen),
            noise=None if overlay.noise is None else tuple(overlay.noise.tolist()),
            curves={name: _written(values) for name, values in overlay.curves.items()},
            unit=overlay.unit, time_unit=overlay.time_unit,
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
        return Overlay(self.source, self.rows, t, seen, None, noise, curves, self.unit, self.time_unit)


def _written(values: ndarray) -> Values:
    """Return numbers with as many digits as can be seen."""
    short = [float(f"{value:.{DIGITS}g}") for value in values.ravel()]
    return tuple(tuple(tuple(part) for part in row) for row in np.reshape(short, values.shape).tolist())
