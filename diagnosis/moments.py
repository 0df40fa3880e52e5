"""Times at which something happens, as small steps do not find them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from latticebench.diagnosis.acting.sudden import Sudden

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

    from latticebench.diagnosis.fitting import Fitted
    from latticebench.diagnosis.model import Model

# Times beside that of something sharp, in widths: about half a reading and one away where frames are missing.
BESIDE = (-5.0, -2.5, 2.5, 5.0)


def beside(fitted: Fitted) -> Iterator[tuple[Model, list[Float[ndarray, "pieces m state"]]]]:
    """Yield a model with what happens sharply a little earlier or later, with states to start from.

    Of what happens to readings between two of them, it hardly matters when: a fit that came there does not leave.
    """
    for number, placed in enumerate(fitted.model.effects):
        if isinstance(placed, Sudden) and placed.instrument and placed.moot:
            for widths in BESIDE:
                moved = replace(placed, at=placed.at + widths * placed.wide)
                if moved.possible:
                    yield fitted.model.without(number).with_effect(moved), list(fitted.followed.nodes)
