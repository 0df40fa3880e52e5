"""What swings beside the sites of a lattice, and of which nothing is read.

A mass on a spring and a dashpot at one site is at y, the site at u, and both push each other; drag is the air's
(`Absorber`: the absorber of Den Hartog, Mechanical Vibrations (1956), section 3.2, with its mass in units of the
site's):

    y'' = -omega^2 (y - u) - gamma (y' - v) - drag y',   u'' = F + mass (omega^2 (y - u) + gamma (y' - v))

A support that sways is at y; all sites hang on it and are read as it sees them, and all forces of terms, F, come from
it (`Support`: Huygens' clocks, see Bennett et al., Proc. R. Soc. A 458, 563 (2002), section 3):

    y'' = -omega^2 y - gamma y' - mass sum_j F_j,   u_n'' = F_n - y''
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray


@dataclass(frozen=True)
class Resonator(ABC):
    """What swings beside sites; its state is y and y'. It feels y, y', and the sums of u, v and F over its sites.

    Attributes:
        sites: among those that have an equation, from 0.
        mass: in units of a site's; of a support, that of a site in units of the support's.
        omega: angular frequency of an absorber on a site that is held, of a support without its sites; one over the
            unit of time.
        gamma: of the dashpot that it hangs on, one over the unit of time.
    """

    sites: tuple[int, ...]
    mass: float
    omega: float
    gamma: float
    numbers: ClassVar[int] = 3
    size: ClassVar[int] = 2

    @property
    @abstractmethod
    def slopes(self) -> Float[ndarray, "2 5"]:
        """Derivatives of y'', and of what is added to u'' of each of its sites, by what it feels."""

    @abstractmethod
    def by_numbers(self, felt: Float[ndarray, "5 batch"]) -> Float[ndarray, "numbers 2 batch"]:
        """Return the derivatives of both by its numbers."""

    def rates(self, felt: Float[ndarray, "5 batch"]) -> Float[ndarray, "2 batch"]:
        """Return y'' and what is added to u''."""
        return np.asarray(self.slopes @ felt)


@dataclass(frozen=True)
class Absorber(Resonator):
    """A mass on a spring and a dashpot at one site.

    Attributes:
        drag: of the mass on its own, one over the unit of time.
    """

    drag: float
    numbers: ClassVar[int] = 4

    @property
    def slopes(self) -> Float[ndarray, "2 5"]:
        """Derivatives of y'' and of what is added to u''."""
        joint = np.array([-(self.omega**2), -self.gamma, self.omega**2, self.gamma, 0.0])
        return np.stack([joint - np.array([0.0, self.drag, 0.0, 0.0, 0.0]), -self.mass * joint])

    def by_numbers(self, felt: Float[ndarray, "5 batch"]) -> Float[ndarray, "4 2 batch"]:
        """Return the derivatives by mass, omega, gamma and drag."""
        y, rate, u, v, _ = felt
        stretch, speed = y - u, rate - v
        pull, by_omega = self.omega**2 * stretch + self.gamma * speed, 2 * self.omega * stretch
        still = np.zeros_like(pull)
        joint = [[still, pull], [-by_omega, self.mass * by_omega], [-speed, self.mass * speed]]
        return np.stack([*joint, [-rate, still]])


@dataclass(frozen=True)
class Support(Resonator):
    """A support that sways with all that hangs on it."""

    @property
    def slopes(self) -> Float[ndarray, "2 5"]:
        """Derivatives of y'' and of what is added to u''."""
        own = np.array([-(self.omega**2), -self.gamma, 0.0, 0.0, -self.mass])
        return np.stack([own, -own])

    def by_numbers(self, felt: Float[ndarray, "5 batch"]) -> Float[ndarray, "3 2 batch"]:
        """Return the derivatives by mass, omega and gamma."""
        y, rate, _, _, force = felt
        own = np.stack([-force, -2 * self.omega * y, -rate])
        return np.stack([own, -own], axis=1)


def shaken(
    u: Float[ndarray, " grid"], step: float, omega: float, gamma: float, drag: float = 0.0
) -> tuple[Float[ndarray, " grid"], Float[ndarray, " grid"]]:
    """Return y and y' of an absorber whose site moves along straight lines between readings, from rest.

    With lambda = -(gamma + drag) / 2 + i sqrt(omega^2 - (gamma + drag)^2 / 4) and z' = lambda z + u, of which the
    solution is known where u is a straight line, y is the real part of a multiple of z.

    Args:
        u: of the site, in steps of time.
        step: in the unit of time.
        omega: see `Absorber`.
        gamma: see `Absorber`.
        drag: see `Absorber`.
    """
    from scipy.signal import lfilter

    losses = gamma + drag
    rate = complex(-losses / 2, np.sqrt(omega**2 - losses**2 / 4))
    power = rate * step
    before, after = np.expm1(power) / power, (np.expm1(power) - power) / power**2
    pushed = step * (before * u[:-1] + after * np.diff(u))
    first = -u[:1] / rate
    z = np.concatenate([first, lfilter([1.0], [1.0, -np.exp(power)], pushed, zi=np.exp(power) * first)[0]])
    share = (gamma * rate + omega**2) / (1j * rate.imag)
    return np.real(share * z), np.real(share * (rate * z + u))
