"""Accelerations along a motion, from its states alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Of two neighbours in time, one that is so many times as far away as the other is not used.
APART = 2.5


@dataclass(frozen=True, eq=False)
class Acceleration:
    """What makes accelerations of positions and velocities at a row and its two neighbours in the same piece.

    It is the second derivative of the polynomial of degree 5 through them; at the ends of a piece, and beside gaps, of
    degree 3 through two rows.

    Attributes:
        by_u, by_v: weights of the row before, of the row itself and of the one after (3, pieces, m).
    """

    by_u: Float[ndarray, "3 pieces m"]
    by_v: Float[ndarray, "3 pieces m"]

    @classmethod
    def along(cls, t: Float[ndarray, "pieces m"]) -> Acceleration:
        """Return it for rows at these times; rows that are there again and again have no acceleration."""
        none = np.full((len(t), 1), np.inf)
        step = np.where(np.diff(t, axis=1) > 0, np.diff(t, axis=1), np.inf)
        before, after = np.concatenate([none, step], axis=1), np.concatenate([step, none], axis=1)
        nearest = APART * np.minimum(before, after)
        before, after = (np.where(one <= nearest, one, np.inf) for one in (before, after))
        both = np.isfinite(before) & np.isfinite(after)
        by_u, by_v = np.zeros((3, *t.shape)), np.zeros((3, *t.shape))
        with np.errstate(invalid="ignore"):
            for side, near, far in ((0, before, after), (2, after, before)):
                share = np.where(both, far / (near + far), np.isfinite(near))
                # Two thirds of the cubic's and a third of the slope of v: what is left is of fourth order in the step.
                cubic, sign = np.where(both, 2 / 3, 1.0) * share, 1 if side else -1
                by_u[side] += 6 * cubic / near**2
                by_u[1] -= 6 * cubic / near**2
                by_v[side] -= sign * (2 * cubic - (share - cubic)) / near
                by_v[1] -= sign * (4 * cubic + (share - cubic)) / near
        return cls(by_u, by_v)

    def of(self, u: Float[ndarray, "pieces m ..."], v: Float[ndarray, "pieces m ..."]) -> ndarray:
        """Return accelerations, in the shape of u."""
        found = np.zeros_like(u)
        for values, weights in ((u, self.by_u), (v, self.by_v)):
            some = weights.reshape(*weights.shape, *(1,) * (u.ndim - 2))
            found += some[1] * values
            found[:, 1:] += some[0, :, 1:] * values[:, :-1]
            found[:, :-1] += some[2, :, :-1] * values[:, 1:]
        return found

    def back(self, by: Float[ndarray, "pieces m ..."]) -> tuple[ndarray, ndarray]:
        """Return derivatives by positions and by velocities from those by accelerations."""
        found = []
        for weights in (self.by_u, self.by_v):
            some = weights.reshape(*weights.shape, *(1,) * (by.ndim - 2)) * by
            one = some[1].copy()
            one[:, :-1] += some[0, :, 1:]
            one[:, 1:] += some[2, :, :-1]
            found.append(one)
        return found[0], found[1]


def with_rates(
    t: Float[ndarray, "pieces m"], field: Float[ndarray, "rows ... levels parts sites"]
) -> Float[ndarray, "rows ... levels parts sites"]:
    """Return a field, or derivatives of it, with the rate of change of v as one level more; as it is without v.

    Args:
        t: times of the rows.
        field: of the rows of all pieces one after another.
    """
    if field.shape[-3] < 2:
        return field
    u, v = (field[..., level, :, :].reshape(*t.shape, -1) for level in (0, 1))
    rate = Acceleration.along(t).of(u, v)
    return np.concatenate([field, rate.reshape(field[..., :1, :, :].shape)], axis=-3)
