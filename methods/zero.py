"""The floor: every coefficient 0. What a method must beat to have found anything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from latticebench.methods.method import Abilities, Fit
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples


@dataclass(frozen=True)
class Zero:
    """Every coefficient 0."""

    name: ClassVar[str] = "zero"

    @property
    def abilities(self) -> Abilities:
        """Everything but the truth."""
        return Abilities(missing=True)

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:  # noqa: ARG002
        """Return zeros; the whole derivative is left."""
        return Fit(self.name, library, order, np.zeros(len(library.terms)), residual=1.0)


METHODS = (Zero,)
