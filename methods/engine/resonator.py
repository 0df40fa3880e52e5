"""A mass on a spring and a dashpot at one site of a lattice, of which nothing is read.

It is at y, the site at u, and both push each other; drag is the air's:

    y'' = -omega^2 (y - u) - gamma (y' - v) - drag y',   u'' = ... + mass (omega^2 (y - u) + gamma (y' - v))

(the absorber of Den Hartog, Mechanical Vibrations (1956), section 3.2, with its mass in units of the site's).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@dataclass(frozen=True)
class Resonator:
    """A mass that swings beside a site; its state is y and y'.

    Attributes:
        site: among those that have an equation, from 0.
        mass: in units of the site's.
        omega: angular frequency on a site that is held, one over the unit of time.
        gamma: of the dashpot between mass and site, one over the unit of time.
        drag: of the mass on its own, likewise.
    """

    site: int
    mass: float
    omega: float
    gamma: float
    drag: float
    numbers: ClassVar[int] = 4
    size: ClassVar[int] = 2

    @property
    def slopes(self) -> Float[ndarray, "2 4"]:
        """Derivatives of y'' and of u'' by y, y', u and v."""
        joint = np.array([-(self.omega**2), -self.gamma, self.omega**2, self.gamma])
        return np.stack([joint - np.array([0.0, self.drag, 0.0, 0.0]), -self.mass * joint])

    def rates(self, state: Float[ndarray, "4 batch"]) -> Float[ndarray, "2 batch"]:
        """Return y'' and its part of u'' from y, y', u and v."""
        return np.asarray(self.slopes @ state)

    def by_numbers(self, state: Float[ndarray, "4 batch"]) -> Float[ndarray, "4 2 batch"]:
        """Return the derivatives of y'' and u'' by mass, omega, gamma and drag."""
        stretch, speed = state[0] - state[2], state[1] - state[3]
        pull, by_omega = self.omega**2 * stretch + self.gamma * speed, 2 * self.omega * stretch
        still = np.zeros_like(pull)
        joint = [[still, pull], [-by_omega, self.mass * by_omega], [-speed, self.mass * speed]]
        return np.stack([*joint, [-state[1], still]])
