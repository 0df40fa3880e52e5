"""Effects that push the sites: a force beside the chain's own, which follows from its state and the time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.trials.faults.setting import Drawn, Push, Setting
from latticebench.systems.motion import Motion
from latticebench.systems.stencil import ghosts

if TYPE_CHECKING:
    from numpy import ndarray


@dataclass(frozen=True, eq=False)
class Moment:
    """A chain at one time.

    Attributes:
        t: the time.
        u, v: field and velocity (N,); v is u for order 1.
        chain: the chain.
        drawn: places, times and frequencies.
    """

    t: float
    u: ndarray
    v: ndarray
    chain: Motion
    drawn: Drawn

    def neighbour(self, k: int) -> ndarray:
        """Return the field k sites to the right, with what the ends repeat."""
        u = self.u
        index, factor = ghosts(len(u), max(-k, 0), max(k, 0), self.chain.ends)
        begin = max(k, 0)
        return np.asarray((u[index] * factor)[begin : begin + len(u)])

    def stretch(self, k: int) -> ndarray:
        """Return the difference to the field k sites to the right."""
        return np.asarray(self.neighbour(k) - self.u)

    def wave(self) -> float:
        """Return the drive's harmonic."""
        about = self.drawn.about
        return float(np.cos(about["omega"] * self.t + about["phase"]))

    def sweep(self) -> float:
        """Return the drive whose frequency rises all the time."""
        about = self.drawn.about
        return float(np.cos((about["omega"] + about["sweep"] * self.t / 2) * self.t + about["phase"]))

    def waves(self, x: ndarray) -> ndarray:
        """Return a drawn smooth function of a number at each site: three waves."""
        return np.asarray(np.sum(np.cos(self.drawn.shape[0] * x[:, None] + self.drawn.shape[1]), axis=1))

    def pulse(self) -> float:
        """Return the bell-shaped pulse."""
        about = self.drawn.about
        return float(np.exp(-(((self.t - about["at"]) / about["width"]) ** 2) / 2))

    def spot(self) -> ndarray:
        """Return the bell that moves along the chain, at each site."""
        about = self.drawn.about
        place = about["spot"] + about["speed"] * (self.t - about["middle"])
        return np.asarray(np.exp(-(((self.drawn.n - place) / about["breadth"]) ** 2) / 2))

    def travelling(self) -> ndarray:
        """Return the travelling wave at each site."""
        about = self.drawn.about
        angle = about["wave_number"] * self.drawn.n - about["omega"] * self.t + about["phase"]
        return np.asarray(np.exp(1j * angle) if self.chain.is_complex else np.cos(angle))

    def wire(self) -> ndarray:
        """Return, at both ends of the wire, the difference to the field at its other end; 0 elsewhere."""
        ends = [int(self.drawn.about["wire_from"]), int(self.drawn.about["wire_to"])]
        pull = np.zeros_like(self.u)
        pull[ends] = self.u[ends[::-1]] - self.u[ends]
        return pull

    def supply(self) -> float:
        """Return how far the unsteady supply is from its mean."""
        omegas, phases = self.drawn.supply
        return float(np.sum(np.cos(omegas * self.t + phases)))

    def ticks(self) -> float:
        """Return bells half as wide as the pulse, one of them where it is, that come again and again at equal times."""
        about = self.drawn.about
        late = (self.t - about["at"]) / about["ticking"]
        # The nearest one and those beside it: others are too far away to be felt.
        away = (late - np.round(late) + np.arange(-2, 3)) * about["ticking"]
        return float(np.sum(np.exp(-((2 * away / about["width"]) ** 2) / 2)))

    def two_level(self) -> float:
        """Return +1 or -1, the state of something that switches to and fro at drawn times."""
        return float((-1.0) ** np.sum(self.drawn.switches < self.t))

    def sponge(self) -> ndarray:
        """Return how much of an absorber is at each site: 1 at both ends, less by exp(-distance / breadth) within."""
        n = np.abs(self.drawn.n)
        return np.asarray(np.exp((n - np.max(n)) / self.drawn.about["breadth"]))


def between(m: Moment) -> ndarray:
    """Return the velocities' second difference."""
    velocities = replace(m, u=m.v)
    return np.asarray(velocities.stretch(1) + velocities.stretch(-1))


def steepening(m: Moment) -> ndarray:
    """Return the slope of the field's cube, which moves high parts of a wave faster than low ones."""
    cubes = replace(m, u=np.abs(m.u) ** 2 * m.u)
    return np.asarray((cubes.neighbour(1) - cubes.neighbour(-1)) / 2)


def loose(m: Moment) -> ndarray:
    """Return what one bond does to the sites at its ends."""
    k, each = int(m.drawn.about["bond"]), np.eye(len(m.u))
    return np.asarray((m.u[k + 1] - m.u[k]) * (each[k] - each[k + 1]))


def gyroscopic(m: Moment) -> ndarray:
    """Return half the difference of the neighbours' velocities.

    Spinning tops in the bonds, or servos that act to one side, make such a force.
    """
    velocities = replace(m, u=m.v)
    return np.asarray((velocities.neighbour(1) - velocities.neighbour(-1)) / 2)


# By the catalogue's names.
CATALOGUED: dict[str, Callable[[Moment], ndarray]] = {
    "damping": lambda m: -m.v,
    "quadratic-drag": lambda m: -np.abs(m.v) * m.v,
    "dry-friction": lambda m: -np.sign(m.v),
    "nonlinear-damping": lambda m: -(np.abs(m.u) ** 2) * m.v,
    "onsite-linear": lambda m: m.u,
    "onsite-quadratic": lambda m: (np.abs(m.u) if m.chain.is_complex else m.u) * m.u,
    "onsite-cubic": lambda m: np.abs(m.u) ** 2 * m.u,
    "onsite-quintic": lambda m: np.abs(m.u) ** 4 * m.u,
    "onsite-bilinear": lambda m: np.abs(m.u),
    "constant-force": lambda m: np.ones(len(m.u)),
    "drive": lambda m: m.wave() * np.ones(len(m.u)),
    "parametric-drive": lambda m: m.wave() * m.u,
    "gradient": lambda m: m.drawn.n * (m.u if m.chain.order == 1 else 1),
    "trap": lambda m: m.drawn.n**2 * m.u,
    "kick": lambda m: m.pulse() * np.ones(len(m.u)),
    "coefficient-drift": lambda m: (m.t - m.drawn.about["middle"]) * (1j if m.chain.is_complex else 1) * m.u,
    "coefficient-jump": lambda m: (
        float(m.t > m.drawn.about["at"]) * (1j if m.chain.is_complex else 1) * (m.stretch(1) + m.stretch(-1))
    ),
    "next-neighbour": lambda m: m.stretch(2) + m.stretch(-2),
    "quadratic-coupling": lambda m: m.stretch(1) ** 2 - m.stretch(-1) ** 2,
    "bilinear-coupling": lambda m: np.abs(m.stretch(1)) - np.abs(m.stretch(-1)),
    "bond-damping": between,
    "nonlinear-coupling": lambda m: (
        np.abs(m.stretch(1)) ** 2 * m.stretch(1) + np.abs(m.stretch(-1)) ** 2 * m.stretch(-1)
    ),
    "asymmetric-coupling": lambda m: (m.neighbour(1) - m.neighbour(-1)) / 2,
    "intersite-nonlinearity": lambda m: np.abs(m.u) ** 2 * (m.neighbour(1) + m.neighbour(-1)),
    "long-range": lambda m: m.drawn.far @ m.u,
    "nonlinear-loss": lambda m: -(np.abs(m.u) ** 2) * m.u,
    "gain-loss": lambda m: (-1.0) ** np.arange(len(m.u)) * m.u,
    "defect": lambda m: np.eye(len(m.u))[m.drawn.site] * m.u,
    "bond-defect": loose,
    "local-damping": lambda m: -np.eye(len(m.u))[m.drawn.site] * m.v,
    "local-friction": lambda m: -np.eye(len(m.u))[m.drawn.site] * np.sign(m.v),
    "local-cubic": lambda m: np.eye(len(m.u))[m.drawn.site] * np.abs(m.u) ** 2 * m.u,
    "local-bilinear": lambda m: np.eye(len(m.u))[m.drawn.site] * np.abs(m.u),
    "local-drive": lambda m: m.wave() * np.eye(len(m.u))[m.drawn.site],
    "local-kick": lambda m: m.pulse() * np.eye(len(m.u))[m.drawn.site],
    "disorder": lambda m: m.drawn.each * m.u,
    "unequal-bonds": lambda m: m.drawn.bonds @ m.u,
}

# Outside the catalogue; those called wavy and uneven have a form that is drawn, so that no list of terms can hold it.
PLAIN: dict[str, Callable[[Moment], ndarray]] = {
    "other: cubic-drag": lambda m: -(m.v**3),
    "other: noise-force": lambda m: np.sum(np.cos(m.drawn.omegas * m.t + m.drawn.phases), axis=0),
    "other: saturation": lambda m: m.u / (1 + 4 * np.abs(m.u) ** 2) if m.chain.is_complex else np.cos(3 * m.u),
    "other: wavy-force": lambda m: m.waves(np.abs(m.u)) * (m.u if m.chain.is_complex else 1),
    "other: wavy-drag": lambda m: -m.waves(np.abs(m.v)) * m.v,
    "other: wavy-bonds": lambda m: sum(m.waves(np.abs(m.stretch(k))) * m.stretch(k) for k in (-1, 1)),
    "other: late-push": lambda m: float(m.t > m.drawn.about["at"]) * np.eye(len(m.u))[m.drawn.site],
}

FIRST_BLIND: dict[str, Callable[[Moment], ndarray]] = {
    "other: moving-spot": lambda m: m.spot() * m.u,
    "other: plane-wave": lambda m: m.travelling(),
    "other: phase-conjugation": lambda m: np.conj(m.u),
}

SECOND_BLIND: dict[str, Callable[[Moment], ndarray]] = {
    "other: stray-wire": lambda m: m.wire(),
    "other: nonlocal-response": lambda m: (m.drawn.near @ np.abs(m.u) ** 2) * m.u,
}

THIRD_BLIND: dict[str, Callable[[Moment], ndarray]] = {
    "other: pumped-coupling": lambda m: m.wave() * (m.stretch(1) + m.stretch(-1)),
    "other: three-body": lambda m: m.neighbour(1) * np.conj(m.u) * m.neighbour(-1),
    "other: unsteady-supply": lambda m: m.supply() * m.u,
}

FOURTH_BLIND: dict[str, Callable[[Moment], ndarray]] = {
    "other: uneven-floor": lambda m: m.drawn.each,
    "other: sweeping-drive": lambda m: m.sweep() * np.ones(len(m.u)),
    "other: one-way-bond": lambda m: np.eye(len(m.u))[m.drawn.site] * m.stretch(1),
    "other: self-steepening": steepening,
}

FIFTH_BLIND: dict[str, Callable[[Moment], ndarray]] = {
    # Foam, or a lossy taper, at both ends.
    "other: absorbing-ends": lambda m: -m.sponge() * m.v,
    # Steps and traffic that shake the table: many frequencies, all sites alike.
    "other: rumbling-floor": lambda m: m.supply() * np.ones(len(m.u)),
    # A pump or a stepping motor near by.
    "other: ticking-pump": lambda m: m.ticks() * np.ones(len(m.u)),
    "other: gyroscopic-bonds": gyroscopic,
    # Junctions or oscillators in series with one load: each feels the mean of all.
    "other: shared-load": lambda m: -np.mean(m.v) * np.ones(len(m.u)),
    # A charge trap, or a loose contact, beside one site: random telegraph noise of its stiffness.
    "other: two-level-defect": lambda m: m.two_level() * np.eye(len(m.u))[m.drawn.site] * m.u,
}

PUSHES = {**CATALOGUED, **PLAIN, **FIRST_BLIND, **SECOND_BLIND, **THIRD_BLIND, **FOURTH_BLIND, **FIFTH_BLIND}


def push(setting: Setting, amounts: dict[str, complex]) -> Push:
    """Return the push of several effects at once, each with its amount."""

    def together(t: float, u: ndarray, v: ndarray) -> ndarray:
        moment = Moment(t, u, v, setting.chain, setting.drawn)
        return np.asarray(sum(amount * PUSHES[name](moment) for name, amount in amounts.items()))

    return together
