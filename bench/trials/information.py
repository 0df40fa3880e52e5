"""How much of a change of readings nothing else can do: Cramer and Rao's bound, from Fisher's information.

The rows J_p of a sensitivity are what a unit of each parameter changes in the readings, in units of their noise; the
information is J J^T. A change that is as large as its smallest standard error leaves a length of 1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

# Directions that readings tell less of than this share of the best told one count as not told at all.
TOLD = 1e-11


def explained(
    information: Float[ndarray, "parameters parameters"],
    change: Float[ndarray, " parameters"],
    others: Int[ndarray, " others"],
) -> tuple[float, Float[ndarray, " others"]]:
    """Return what of a change nothing else can do, and how much of each other parameter does the rest.

    Args:
        information: of all parameters.
        change: of the parameters.
        others: parameters that are free beside it.

    Returns:
        the length of what is left, in units of the noise; the others' amounts.
    """
    inverse, scale = _inverse(information, others)
    shadow = (information[others] @ change) / scale
    left = np.sqrt(max(change @ information @ change - shadow @ inverse @ shadow, 0.0))
    return float(left), inverse @ shadow / scale


def beside(
    information: Float[ndarray, "parameters parameters"], others: Int[ndarray, " others"]
) -> Float[ndarray, "rest rest"]:
    """Return the information of the parameters that are not among `others`, where those are free."""
    rest = np.setdiff1d(np.arange(len(information)), others)
    inverse, scale = _inverse(information, others)
    shadow = information[np.ix_(others, rest)] / scale[:, None]
    return np.asarray(information[np.ix_(rest, rest)] - shadow.T @ inverse @ shadow)


def _inverse(information: ndarray, others: ndarray) -> tuple[ndarray, ndarray]:
    """Return the inverse of some parameters' information in units in which each one's is 1, and these units."""
    inner = information[np.ix_(others, others)]
    scale = np.sqrt(np.maximum(np.diag(inner), 1e-300))
    return np.linalg.pinv(inner / np.outer(scale, scale), rcond=TOLD, hermitian=True), scale
