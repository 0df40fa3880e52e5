"""What is drawn and filmed in the same way: a fit or a diagnosis beside its readings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

from latticebench.pictures import Film, Picture

if TYPE_CHECKING:
    from latticebench.bench.overlay import Overlay


class Exhibit(ABC):
    """Readings with the motions of equations beside them."""

    @property
    @abstractmethod
    def overlay(self) -> Overlay:
        """Readings and motions, in the unit of the file (`latticebench.bench.overlay.Overlay`)."""

    def plot(self, *only: str) -> Picture:
        """Draw the readings, the motions of the equations that are nearest to them, and what they leave.

        Args:
            only: names of panels: map, sites, residual, spectrum, phase; all that tell something if there are none.

        Raises:
            InputError: there is no such panel.
        """
        return Picture(self.overlay, only)

    def animate(self) -> Film:
        """Return a film of the readings with these motions, which a notebook shows and `save` writes."""
        return Film(self.overlay)
