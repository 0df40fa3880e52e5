"""What an effect is put into: a chain, its start and its times, and what is drawn for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.systems.errors import InputError
from latticebench.systems.motion import Motion
from latticebench.systems.stencil import Ends

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

Fields = tuple["ndarray", "ndarray | None"]
Push = Callable[[float, "ndarray", "ndarray"], "ndarray"]

# Steps between two samples in which a slow or a slack sensor follows.
FINE = 40


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is drawn for a recording, whether its effect needs it or not.

    Single numbers, all dimensionless:
        site: (0, ..., N-1); bond: the site to the left of one; middle: of the record.
        omega, phase: frequency and phase of a drive; sweep: by how much its frequency rises per unit of time.
        at, width: middle and width of a pulse; ticking: time between two ticks.
        delay: of a memory.
        s: power of a long-range coupling; fading: length of a nonlocal response.
        wave_number: of a travelling force; spot, speed, breadth: place, speed and breadth of a moving one.
        own: frequency of a resonator; sway: of a mount.
        warming: time in which a sensor warms up; cooling: time in which heat goes.
        wire_from, wire_to: sites at the ends of a wire.
        grip: the most that a slipping spring is bent; play: how far a site goes before it meets a stop.
        hum, hum_phase: frequency and phase of the mains.
        relaxing: time in which a stretched bond gives way.
        cycle: distance after which a sensor's error repeats itself.
        aside: number of sites by which something is moved along the chain.

    Attributes:
        about: those numbers by their names.
        n: place of each site, counted from the chain's middle (N,).
        far: long-range coupling of the sites (N, N).
        bonds: the forces of bonds that are all different (N, N).
        shape: wave numbers and phases of a drawn function (2, 3).
        each: a number for each site (N,).
        omegas, phases: of five waves at each site (5, N).
        late: how late each row is read, in units of the jitter (T,).
        force: a measured input (T, N), or None.
        near: how much each site feels of each (N, N).
        pickup: how much hum each sensor's wires catch (N,).
        supply: frequencies and phases of an unsteady supply (2, 5).
        flicker: how much brighter than usual each row is lit (T,).
        spikes: by how much each reading is off, 0 for nearly all of them (T, N).
        switches: the times at which something with two states changes from one to the other, in order (6,).
        wander: how far a reference has gone from where it was at the first row (T,).
    """

    about: Mapping[str, float]
    n: Float[ndarray, " sites"]
    far: Float[ndarray, "sites sites"]
    bonds: Float[ndarray, "sites sites"]
    shape: Float[ndarray, "two waves"]
    each: Float[ndarray, " sites"]
    omegas: Float[ndarray, "waves sites"]
    phases: Float[ndarray, "waves sites"]
    late: Float[ndarray, " time"]
    force: Float[ndarray, "time sites"] | None
    near: Float[ndarray, "sites sites"]
    pickup: Float[ndarray, " sites"]
    supply: Float[ndarray, "two waves"]
    flicker: Float[ndarray, " time"]
    spikes: Float[ndarray, "time sites"]
    switches: Float[ndarray, " switches"]
    wander: Float[ndarray, " time"]

    @property
    def site(self) -> int:
        """The site that something sits at."""
        return int(self.about["site"])


@dataclass(frozen=True, eq=False)
class Setting:
    """A chain that is about to move.

    Attributes:
        chain: its own motion.
        start: its state at the first time.
        times: of the samples (T,).
        drawn: what was drawn for the effect.
        standing: what pushes the chain besides the effect, if anything does.
    """

    chain: Motion
    start: ndarray
    times: Float[ndarray, " time"]
    drawn: Drawn
    standing: Push | None = None

    @property
    def one(self) -> Float[ndarray, " sites"]:
        """1 at the drawn site, 0 elsewhere."""
        return np.asarray(np.eye(self.chain.sites)[self.drawn.site])

    def run(self, push: Push | None = None) -> Fields:
        """Return u and v of the chain with a push, a function of t, u and v (u for order 1).

        Raises:
            InputError: the motion is unbounded.
        """
        chain, rate = self.chain, self.chain.right_hand_side
        size = chain.parts * chain.sites
        pushes = [one for one in (self.standing, push) if one is not None]

        def forced(t: float, y: ndarray) -> ndarray:
            change = rate(t, y)
            if pushes:
                u, v = chain.unpack(y)
                change[-size:] += sum(self.parts(one(t, u, u if v is None else v)) for one in pushes)
            return change

        return chain.unpack(integrated(forced, self.start, self.times))

    def parts(self, force: ndarray) -> ndarray:
        """Return a force as a state's rates have it: the real parts, then the imaginary ones."""
        return np.concatenate([force.real, force.imag]) if self.chain.is_complex else force

    def at(self, times: ndarray) -> Setting:
        """Return the same with other times."""
        return replace(self, times=times)

    def fine(self) -> Setting:
        """Return the same with FINE - 1 more times between each two."""
        rows = np.arange(len(self.times))
        return self.at(np.interp(np.arange(FINE * (len(rows) - 1) + 1) / FINE, rows, self.times))

    def other_ends(self) -> Setting:
        """Return the same with the ends that the chain does not have."""
        return replace(self, chain=replace(self.chain, ends=other(self.chain.ends)))

    def own_rate(self, t: float, u: ndarray, v: ndarray) -> ndarray:
        """Return the chain's own right-hand side (N,)."""
        chain = self.chain
        own = chain.right_hand_side(t, chain.pack(u, v))[-chain.parts * chain.sites :]
        return np.asarray(own[: chain.sites] + 1j * own[chain.sites :] if chain.is_complex else own)


def other(ends: Ends) -> Ends:
    """Return the ends that a chain has instead of its own."""
    return "fixed" if ends == "free" else "free"


def integrated(rate: Callable[[float, ndarray], ndarray], start: ndarray, times: ndarray) -> ndarray:
    """Return the solution of real equations (states, T).

    Raises:
        InputError: the motion is unbounded.
    """
    from scipy.integrate import solve_ivp

    found = solve_ivp(
        rate, (times[0], times[-1]), start, t_eval=times, method="DOP853", rtol=1e-9, atol=1e-10,
        max_step=0.1 * float(times[-1] - times[0]),
    )  # fmt: skip
    if found.status != 0 or not np.all(np.isfinite(found.y)):
        raise InputError("the motion is unbounded")
    return np.asarray(found.y)


def draw_circumstances(name: str, sites: int, times: ndarray, draw: np.random.Generator) -> Drawn:
    """Draw the places, times, frequencies and random numbers of a recording.

    Args:
        name: of its effect, or of several with a + between them.
        sites: N.
        times: of the samples (T,).
        draw: for all of them.
    """
    about, first = _first_numbers(name, sites, times, draw)
    # From a generator of their own, so that they change nothing of what is drawn after them.
    more = np.random.default_rng(first["shape"].view(np.uint64).ravel().tolist())
    return Drawn(about, **first, **_more_numbers(about, sites, times, more))


def _first_numbers(
    name: str, sites: int, times: ndarray, draw: np.random.Generator
) -> tuple[dict[str, float], dict[str, Any]]:
    """Return the single numbers and the arrays, by their names, that are drawn first."""
    span = float(times[-1] - times[0])
    n = np.arange(sites) - (sites - 1) / 2
    power = draw.uniform(1.5, 3.0)
    distance = np.abs(n[:, None] - n)
    far = np.where(distance >= 2, np.maximum(distance, 1.0) ** -power, 0.0)
    k = int(draw.integers(sites // 3, 2 * sites // 3))
    omegas = draw.uniform(2 * np.pi / span, 6.0, size=(5, sites))
    phases = draw.uniform(0, 2 * np.pi, size=(5, sites))
    about = {
        "site": int(draw.integers(sites // 4, 3 * sites // 4)),
        "omega": draw.uniform(1.0, 4.0),
        "phase": draw.uniform(0, 2 * np.pi),
        "at": float(times[0]) + span * draw.uniform(0.2, 0.7),
        "width": span * draw.uniform(0.02, 0.06),
        "s": power,
        "middle": float(np.mean(times)),
        "bond": k,
    }
    each = draw.normal(size=sites)
    about["delay"] = span * draw.uniform(0.08, 0.2)
    force = None
    if name == "known-input":
        force = np.cumsum(draw.normal(size=(len(times), sites)), axis=0)
        force -= force.mean(axis=0)
        force /= np.std(force)
    strengths = draw.normal(size=sites - 1)
    bonds = np.diag(strengths, 1) + np.diag(strengths, -1)
    bonds -= np.diag(bonds.sum(axis=1))
    shape = np.stack([draw.uniform(1.0, 5.0, size=3), draw.uniform(0, 2 * np.pi, size=3)])
    return about, {
        "n": n, "far": far - np.diag(far.sum(axis=1)), "bonds": bonds, "shape": shape, "each": each,
        "omegas": omegas, "phases": phases, "force": force,
    }  # fmt: skip


def _more_numbers(about: dict[str, float], sites: int, times: ndarray, more: np.random.Generator) -> dict[str, Any]:
    """Add further single numbers to `about`, and return further arrays; what a new effect needs is drawn last."""
    span = float(times[-1] - times[0])
    about |= {
        "wave_number": more.choice([-1.0, 1.0]) * more.uniform(0.6, 2.4),
        "spot": sites * more.uniform(-0.15, 0.15),
        "speed": more.choice([-1.0, 1.0]) * more.uniform(0.3, 1.0) * sites / span,
        "breadth": more.uniform(1.0, 2.5),
        "own": more.uniform(1.0, 4.0),
        "warming": span * more.uniform(0.1, 0.4),
        "wire_from": int(sites * more.uniform(0.2, 0.4)),
        "wire_to": int(sites * more.uniform(0.6, 0.8)),
        "grip": more.uniform(0.2, 0.8),
        "cooling": span * more.uniform(0.1, 0.5),
        "fading": more.uniform(1.0, 3.0),
        "hum": more.uniform(3.0, 9.0),
        "hum_phase": more.uniform(0, 2 * np.pi),
    }
    distance = np.abs(np.subtract.outer(np.arange(sites), np.arange(sites)))
    near = np.exp(-distance / about["fading"])
    pickup = more.uniform(0.5, 1.5, size=sites)
    about |= {"play": more.uniform(0.3, 0.7), "sway": more.uniform(1.0, 4.0)}
    supply = np.stack([more.uniform(2 * np.pi / span, 6.0, size=5), more.uniform(0, 2 * np.pi, size=5)])
    flicker = more.normal(size=len(times))
    about["sweep"] = more.uniform(2.0, 5.0) / span
    # One reading in a hundred, but a few in the shortest record, too.
    hits = more.choice(len(times) * sites, size=max(len(times) * sites // 100, 3), replace=False)
    spikes = np.zeros((len(times), sites))
    spikes.flat[hits] = more.choice([-1.0, 1.0], size=len(hits)) * more.uniform(0.5, 1.5, size=len(hits))
    about |= {
        "ticking": span * more.uniform(0.15, 0.3),
        "relaxing": span * more.uniform(0.1, 0.4),
        "cycle": more.uniform(0.3, 0.8),
        "aside": int(more.choice([-1, 1]) * more.integers(2, 5)),
    }
    switches = float(times[0]) + span * np.sort(more.uniform(0.05, 0.95, size=6))
    wander = np.append(0.0, np.cumsum(more.normal(size=len(times) - 1))) / np.sqrt(len(times))
    return {
        "near": near, "pickup": pickup, "supply": supply, "flicker": flicker, "spikes": spikes, "switches": switches,
        "wander": wander, "late": more.normal(size=len(times)),
    }  # fmt: skip
