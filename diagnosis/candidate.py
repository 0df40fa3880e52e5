"""What a candidate is: an effect with its place or frequency, and the columns that it could add to the readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.diagnosis.placed import PlacedEffect
from latticebench.diagnosis.tangent import Tangent, orthonormal
from latticebench.systems.effects import Effect
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Candidates of which all columns together would be more numbers than this are left out.
MOST_NUMBERS = 20_000_000
# The effect of a candidate that is no term and stands for no effect of the catalogue.
UNNAMED = PlacedEffect(Effect("unnamed", "0"))


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect with its place or frequency, while it is being tried.

    Attributes:
        placed: the effect with its place and parameters.
        basis: orthonormal columns of what it could add to the readings (rows, q).
        spread: for a random effect, the variance of each column per unit variance of its coefficients (q,); else None.
    """

    placed: PlacedEffect
    basis: Float[ndarray, "rows q"]
    spread: Float[ndarray, " q"] | None = None


def as_candidate(tangent: Tangent, placed: PlacedEffect, columns: ndarray, random: bool = False) -> Candidate | None:
    """Return a candidate that could add these columns, as far as the model cannot do the same.

    None where nothing is left of them, or where they could explain nearly any residual.

    Args:
        tangent: of the fitted model.
        placed: the effect.
        columns: what it could add to the readings (rows, columns).
        random: whether its coefficients are random numbers of unknown variance.
    """
    left = tangent.new(columns)
    if random:
        basis, values, _ = np.linalg.svd(left, full_matrices=False)
        kept = values > 1e-6 * max(values[0], 1e-300) if len(values) else np.zeros(0, dtype=bool)
        return (
            Candidate(placed, basis[:, kept], values[kept] ** 2)
            if 1 < np.sum(kept) <= tangent.spare / 2 and values[0] > 0
            else None
        )
    basis = orthonormal(left)
    return Candidate(placed, basis) if 0 < basis.shape[1] <= tangent.spare / 4 else None


Group = tuple[str, list[Candidate]]


def group(name: str, candidates: Sequence[Candidate | None]) -> list[Group]:
    """Return the candidates of one name as a group, or nothing where there are none."""
    found = [one for one in candidates if one is not None]
    return [(name, found)] if found else []


def too_wide(term: Term, dynamics: Any) -> bool:
    """Return whether a term reaches beyond what the chain shows."""
    left, right = term.reach
    if dynamics.ends == "unknown":
        return bool(left > dynamics.reach[0] or right > dynamics.reach[1])
    return bool(max(left, right) >= dynamics.sites) and dynamics.ends != "fixed"


def places(tangent: Tangent) -> list[int]:
    """Return the sites that have an equation."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    return list(range(*dynamics.moving.indices(dynamics.sites)))
