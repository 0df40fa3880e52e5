"""What swings beside a chain and is not read: masses on springs at its sites, and a support that all sites hang on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

SIDE, SUPPORT = "side", "support"
NUMBERS = ("mass", "omega", "gamma", "y", "rate")
"""Of each: its mass (a support's: that of a site in units of its own), angular frequency, damping, and its start."""


@dataclass(frozen=True, eq=False)
class Unread:
    """What is not read, in copies of a chain that differ in their parameters.

    A mass at y on the spring of a site at u has y'' = -a, and u'' grows by mass * a, with
    a = omega^2 (y - u) + gamma (y' - u'). On a support at y, sites with the forces F have u'' = F - y'', as readings
    are taken beside it, and y'' = -omega^2 y - gamma y' - mass * (sum of F).

    Attributes:
        sites: of each mass; None for the support.
        numbers: one of each of `NUMBERS` (copies, 1) for every mass.
    """

    sites: tuple[int | None, ...]
    numbers: tuple[tuple[ndarray, ...], ...]

    @classmethod
    def of(cls, parameters: Mapping[str, Float[ndarray, "copies one"]]) -> Unread:
        """Return what parameters called "side.mass@0", "support.mass" and so on describe."""
        found = [name.removeprefix(f"{SIDE}.mass@") for name in parameters if name.startswith(f"{SIDE}.mass@")]
        named: list[tuple[int | None, str, str]] = [(int(site), f"{SIDE}.", f"@{site}") for site in found]
        if f"{SUPPORT}.mass" in parameters:
            named.append((None, f"{SUPPORT}.", ""))
        numbers = tuple(tuple(parameters[f"{first}{name}{last}"] for name in NUMBERS) for _, first, last in named)
        return cls(tuple(site for site, _, _ in named), numbers)

    def start(self) -> Float[ndarray, "two copies masses"]:
        """Return places and velocities at the first time."""
        return np.stack([np.concatenate([one[level] for one in self.numbers], axis=1) for level in (3, 4)])

    def pushed(self, force: ndarray, u: ndarray, v: ndarray) -> Float[ndarray, "copies all"]:
        """Return the accelerations of the sites and of what is not read.

        Args:
            force: accelerations of the sites without it (copies, N).
            u: places of both (copies, N + masses).
            v: velocities, likewise.
        """
        sites = force.shape[1]
        found = np.concatenate([force, np.zeros((len(force), len(self.sites)))], axis=1)
        for k, (site, (mass, omega, gamma, *_)) in enumerate(zip(self.sites, self.numbers, strict=True)):
            own = slice(sites + k, sites + k + 1)
            if site is None:
                found[:, own] = -(omega**2) * u[:, own] - gamma * v[:, own] - mass * force.sum(axis=1, keepdims=True)
                found[:, :sites] -= found[:, own]
            else:
                here = slice(site, site + 1)
                pull = omega**2 * (u[:, own] - u[:, here]) + gamma * (v[:, own] - v[:, here])
                found[:, own] -= pull
                found[:, here] += mass * pull
        return found
