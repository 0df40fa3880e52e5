"""Positive matrices in which only near outputs meet, for several members at once: factor, then divide.

The outputs are taken together in groups, so large that a group meets only the next one. The matrix is block
tridiagonal then, and its Cholesky factor has two blocks for each group (Golub & Van Loan, Matrix Computations, section
4.5 (2013)).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from latticebench.methods.engine.networks.arrays import Array, Arrays


def factor_band(band: Array, arrays: Arrays, ridge: float) -> tuple[Callable[[Array], Array], Array]:
    """Factor matrices that are given by blocks.

    Args:
        band: the lower blocks (members, outputs, diagonals, r, r); band[:, o, d] is that of the outputs o + d and o.
            It is overwritten.
        arrays: of the device.
        ridge: added to the diagonal, which is scaled to 1 before.

    Returns:
        a function that divides right-hand sides (members, outputs * r, m) by the matrices, and for each member whether
        its matrix is positive (members,).
    """
    xp = arrays.xp
    members, outputs, diagonals, r, _ = band.shape
    diagonal = xp.diagonal(band[:, :, 0], 0, -2, -1)
    scale = 1 / xp.sqrt(xp.clip(diagonal, 1e-300, None))
    for d in range(diagonals):
        band[:, : outputs - d, d] *= scale[:, d:, :, None] * scale[:, : outputs - d, None, :]
    xp.diagonal(band[:, :, 0], 0, -2, -1)[:] += ridge
    size = max(diagonals - 1, 1)
    groups = [range(first, min(first + size, outputs)) for first in range(0, outputs, size)]
    lower: list[Array] = []
    below: list[Array] = []
    sound = xp.ones_like(scale[:, 0, 0]) > 0
    for number, group in enumerate(groups):
        own = _block(band, group, group, arrays)
        if number:
            meeting = _block(band, group, groups[number - 1], arrays)
            # L_(k+1, k) = B_k L_kk^(-T)
            below.append(xp.linalg.solve_triangular(lower[-1].mT, meeting, upper=True, left=False))
            own = own - below[-1] @ below[-1].mT
        factor, positive = arrays.cholesky(own)
        lower.append(factor)
        sound = sound & positive
    edges = [group.start * r for group in groups] + [outputs * r]
    flat = scale.reshape(members, -1, 1)

    def divide(right: Array) -> Array:
        parts = [(flat * right)[:, first:last] for first, last in itertools.pairwise(edges)]
        for k, one in enumerate(parts):
            rest = one - below[k - 1] @ parts[k - 1] if k else one
            parts[k] = xp.linalg.solve_triangular(lower[k], rest, upper=False)
        for k in reversed(range(len(parts))):
            rest = parts[k] - below[k].mT @ parts[k + 1] if k + 1 < len(parts) else parts[k]
            parts[k] = xp.linalg.solve_triangular(lower[k].mT, rest, upper=True)
        return flat * xp.concatenate(parts, axis=1)

    return divide, sound


def _block(band: Array, rows: range, columns: range, arrays: Arrays) -> Array:
    """Return the block of a group of outputs (rows) and one of outputs that are the same, or come before (columns)."""
    members, _, diagonals, r, _ = band.shape
    found = arrays.zeros(members, len(rows), r, len(columns), r)
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            if 0 <= row - column < diagonals:
                found[:, i, :, j] = band[:, column, row - column]
            elif 0 <= column - row < diagonals:
                found[:, i, :, j] = band[:, row, column - row].mT
    return found.reshape(members, len(rows) * r, len(columns) * r)
