"""Readings of another time than they say."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from latticebench.diagnosis.acting.placed import Misreading, Placed

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# The angle of the main frequency up to which a lag is undone by velocities.
MOST_TURNED = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Late(Placed):
    """What makes readings late.

    Attributes:
        omega: the main angular frequency of the motion; 0 where it has none.
        velocities: whether those are late, too; else they are on time.
    """

    omega: float = 0.0
    instrument: ClassVar[bool] = True
    velocities: ClassVar[bool] = False

    @property
    @abstractmethod
    def latest(self) -> float:
        """By how much a reading is late at most that corrected times do not put right."""

    def stays(self, *, velocities: bool) -> bool:
        """Return whether there are no velocities to undo it with, or it turns a swing too far for that."""
        return not velocities or self.omega * self.latest > MOST_TURNED

    @abstractmethod
    def lateness(self, t: Float[ndarray, " rows"], sites: int) -> tuple[ndarray, ndarray]:
        """Return how late readings are (rows or 1, 1, sites or 1), and its derivatives by the effect's numbers."""

    def misread(self, t: ndarray, field: ndarray) -> Misreading:
        """Return what is late, and what each number adds; nothing where the motion has no velocity."""
        return misread_late([self], t, field)


def misread_late(effects: Sequence[Late], t: ndarray, field: Float[ndarray, "rows levels parts sites"]) -> Misreading:
    """Return what is read of a motion where readings are late by all that effects make them late.

    A time tau ago, u was u - v sin(omega tau) / omega + a (1 - cos(omega tau)) / omega^2, a being the rate of v: for
    swings of the angular frequency omega, and to second order in tau for all others. Likewise its rate was
    v cos(omega tau) - a sin(omega tau) / omega, and the rate of that a cos(omega tau) + v omega sin(omega tau).

    Args:
        effects: one or more.
        t: times of the rows.
        field: the motion. Where it has no velocity, nothing is late; where it has no rate of that, it is taken to swing
            with omega about its mean.
    """
    shape, omega = (len(t), 1, field.shape[-1]), effects[0].omega
    added, slope = np.zeros_like(field), np.zeros_like(field)
    by_rates = np.zeros((*field.shape[:2], 2, *field.shape[2:]))
    every = [one.lateness(t, field.shape[-1]) for one in effects]
    by = np.zeros((sum(len(by_number) for _, by_number in every), *field.shape))
    if field.shape[1] == 1:
        return Misreading(added, slope, by, by_rates)
    u, v = field[:, 0], field[:, 1]
    a = field[:, 2] if field.shape[1] > 2 else -(omega**2) * (u - _middle(u))
    for level in range(field.shape[1]):
        taus = [tau * (level == 0 or one.velocities) for one, (tau, _) in zip(effects, every, strict=True)]
        tau, begin = np.broadcast_to(sum(taus), shape), 0
        # numpy's sinc(x) is sin(pi x) / (pi x).
        by_v, by_a = -tau * np.sinc(omega * tau / np.pi), tau**2 / 2 * np.sinc(omega * tau / 2 / np.pi) ** 2
        cos = np.cos(omega * tau)
        rate = (cos * v + by_v * a, cos * a - omega**2 * by_v * v, -(omega**2) * (cos * v + by_v * a))[level]
        changed = (by_v * v + by_a * a, (cos - 1) * v + by_v * a, (cos - 1) * a - omega**2 * by_v * v)[level]
        # Missing velocities concern what is late, and nothing else.
        added[:, level] = np.where(tau != 0, changed, 0.0)
        for one, (_, by_number) in zip(effects, every, strict=True):
            if level == 0 or one.velocities:
                by[begin : begin + len(by_number), :, level] = np.where(by_number != 0, -by_number * rate, 0.0)
            begin += len(by_number)
        if level == 0:
            by_rates[:, 0, 0] += by_v
        if level == 0 and field.shape[1] > 2:
            by_rates[:, 0, 1] += by_a
        elif level == 0:
            slope[:, 0] -= omega**2 * by_a
        elif level == 1:
            slope[:, 1] += cos - 1
            by_rates[:, 1, 1] += by_v
    return Misreading(added, slope, by, by_rates)


def _middle(u: Float[ndarray, "rows parts sites"]) -> ndarray:
    """Return the mean of each site over all rows that were read; 0 where none was."""
    read = np.isfinite(u)
    return np.asarray(np.sum(np.where(read, u, 0.0), axis=0) / np.maximum(np.sum(read, axis=0), 1))
