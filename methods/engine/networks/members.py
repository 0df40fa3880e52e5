"""Members: networks for the same data that differ in their random draws; the best is the fit, their spread is told."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.lattice import Library

if TYPE_CHECKING:
    from jaxtyping import Float


def member_draws(seed: int, members: int) -> list[np.random.Generator]:
    """Return each member's generator; the first is that of a network alone."""
    return [np.random.default_rng([seed, member] if member else seed) for member in range(members)]


def best_member(loss: Float[np.ndarray, " member"]) -> int:
    """Return the number of the member with the least loss; one that is not finite counts only where all are so."""
    return int(np.argmin(np.where(np.isfinite(loss), loss, np.inf)))


def spread(coefficients: Float[np.ndarray, "member terms"], library: Library) -> dict[str, float]:
    """Return what `Fit.found` says of several members; nothing for one.

    Args:
        coefficients: of each member (members, terms).
        library: the terms.

    Returns:
        the number of members, and per term the standard deviation of its coefficient over them, in its units.
    """
    if len(coefficients) == 1:
        return {}
    deviations = np.std(coefficients, axis=0, ddof=1)
    names = (f"spread of {text}" for text in library.texts)
    return {"members": float(len(coefficients)), **dict(zip(names, deviations.tolist(), strict=True))}
