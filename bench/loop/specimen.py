"""Recordings with something in them that the declared equation lacks, to see whether the loop finds it.

They are made apart from the loop: plain NumPy forces beside the system's own right-hand side, SciPy's integrators, and the
instrument's faults put on afterwards. Sizes are asked for as z, the effect's size over the smallest standard error that it could be
known with (the Cramer-Rao bound, everything in the declared equation being unknown too): z = 5 is barely visible, 30 plainly.
Beyond first order this is what the declared equation leaves of the clean readings when it is fitted to them, in units of the noise.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from bench.loop.model import Fitted, Model, refit, rounding_error
from bench.loop.tangent import Tangent, linearise
from bench.loop.ways import ways
from methods.trajectory import Solution, State
from systems.effects import CATALOGUE, find
from systems.errors import InputError, unknown
from systems.lattice import Ends, Motion, System, ghosts, motion
from systems.samples import Samples, SimulatedSamples
from systems.simulate import noise_size, sample_times
from systems.terms import Term, express

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

NONE = "none"


@dataclass(frozen=True, eq=False)
class Specimen:
    """A recording and what is in it.

    Attributes:
        samples: with the noise.
        clean: the same without noise.
        effect: what the declared equation lacks; "none" for nothing.
        amount: its coefficient (one complex number where there are two).
        about: site, frequency and the like.
        z: its size over the smallest standard error.
        ends: the other ends that the chain has, where they are what is wrong.
        apart: for an effect from outside the catalogue, how much of z the nearest one of the catalogue leaves; else 0.
    """

    samples: SimulatedSamples
    clean: Samples
    effect: str
    amount: complex
    about: Mapping[str, float]
    z: float
    apart: float = 0.0
    ends: Ends | None = None


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is drawn for a specimen, whether its effect needs it or not.

    Attributes:
        about: single numbers: the `site` (0, ..., N-1), frequency `omega` and `phase` of a drive, middle `at` and `width` of a pulse,
            `delay`, power `s` of a long-range coupling, the `middle` of the record; for `BLIND`: `wave_number` of a travelling
            force, `spot`, `speed` and `breadth` of a moving one, frequency `own` of a resonator, and `warming`, a sensor's time; for
            `SECOND_BLIND`: `wire_from` and `wire_to`, the sites at the ends of a wire, `grip`, the most that a slipping spring is bent,
            `cooling`, the time in which heat goes, `fading` length of a response, and `hum` and `hum_phase`, frequency and phase of the
            mains; for `THIRD_BLIND`: `play`, how far a site goes before it meets a stop, and `sway`, frequency of a mount.
        n: place of each site, counted from the chain's middle (N,).
        far: long-range coupling of the sites (N, N).
        bond: one bond's force (N, N).
        bonds: the forces of bonds that are all different (N, N).
        shape: wave numbers and phases of a drawn function (2, 3).
        each: a number for each site (N,).
        omegas, phases: of five waves at each site (5, N).
        late: how late each row is read, in units of the jitter (T,), or None.
        force: a measured input (T, N), or None.
        near: how much each site feels of each (N, N).
        pickup: how much hum each sensor's wires catch (N,).
        supply: frequencies and phases of an unsteady supply (2, 5).
        flicker: how much brighter than usual each row is lit (T,).
    """

    about: Mapping[str, float]
    n: Float[ndarray, " sites"]
    far: Float[ndarray, "sites sites"]
    bond: Float[ndarray, "sites sites"]
    bonds: Float[ndarray, "sites sites"]
    shape: Float[ndarray, "two waves"]
    each: Float[ndarray, " sites"]
    omegas: Float[ndarray, "waves sites"]
    phases: Float[ndarray, "waves sites"]
    late: Float[ndarray, " time"] | None
    force: Float[ndarray, "time sites"] | None
    near: Float[ndarray, "sites sites"]
    pickup: Float[ndarray, " sites"]
    supply: Float[ndarray, "two waves"]
    flicker: Float[ndarray, " time"]

    @property
    def site(self) -> int:
        """The site that something sits at."""
        return int(self.about["site"])


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
        """Give the field k sites to the right, with what the ends repeat."""
        u = self.u
        index, factor = ghosts(len(u), max(-k, 0), max(k, 0), self.chain.ends)
        begin = max(k, 0)
        return np.asarray((u[index] * factor)[begin : begin + len(u)])

    def stretch(self, k: int) -> ndarray:
        """Give the difference to the field k sites to the right."""
        return np.asarray(self.neighbour(k) - self.u)

    def wave(self) -> float:
        """Give the drive's harmonic."""
        about = self.drawn.about
        return float(np.cos(about["omega"] * self.t + about["phase"]))

    def waves(self, x: ndarray) -> ndarray:
        """Give a drawn smooth function of a number at each site: three waves."""
        return np.asarray(np.sum(np.cos(self.drawn.shape[0] * x[:, None] + self.drawn.shape[1]), axis=1))

    def pulse(self) -> float:
        """Give the bell-shaped pulse."""
        about = self.drawn.about
        return float(np.exp(-(((self.t - about["at"]) / about["width"]) ** 2) / 2))

    def spot(self) -> ndarray:
        """Give the bell that moves along the chain, at each site."""
        about = self.drawn.about
        place = about["spot"] + about["speed"] * (self.t - about["middle"])
        return np.asarray(np.exp(-(((self.drawn.n - place) / about["breadth"]) ** 2) / 2))

    def travelling(self) -> ndarray:
        """Give the travelling wave at each site."""
        about = self.drawn.about
        angle = about["wave_number"] * self.drawn.n - about["omega"] * self.t + about["phase"]
        return np.asarray(np.exp(1j * angle) if self.chain.is_complex else np.cos(angle))

    def wire(self) -> ndarray:
        """Give, at both ends of the wire, the difference to the field at its other end; 0 elsewhere."""
        ends = [int(self.drawn.about["wire_from"]), int(self.drawn.about["wire_to"])]
        pull = np.zeros_like(self.u)
        pull[ends] = self.u[ends[::-1]] - self.u[ends]
        return pull

    def supply(self) -> float:
        """Give how far the unsteady supply is from its mean."""
        omegas, phases = self.drawn.supply
        return float(np.sum(np.cos(omegas * self.t + phases)))


Fields = tuple["ndarray", "ndarray | None"]


def _between(m: Moment) -> ndarray:
    """Give the velocities' second difference."""
    velocities = replace(m, u=m.v)
    return np.asarray(velocities.stretch(1) + velocities.stretch(-1))


# What pushes the sites, by the catalogue's names.
PUSHES: dict[str, Callable[[Moment], ndarray]] = {
    "damping": lambda m: -m.v,
    "quadratic-drag": lambda m: -np.abs(m.v) * m.v,
    "dry-friction": lambda m: -np.sign(m.v),
    "onsite-linear": lambda m: m.u,
    "onsite-quadratic": lambda m: (np.abs(m.u) if m.chain.is_complex else m.u) * m.u,
    "onsite-cubic": lambda m: np.abs(m.u) ** 2 * m.u,
    "onsite-quintic": lambda m: np.abs(m.u) ** 4 * m.u,
    "constant-force": lambda m: np.ones(len(m.u)),
    "drive": lambda m: m.wave() * np.ones(len(m.u)),
    "parametric-drive": lambda m: m.wave() * m.u,
    "gradient": lambda m: m.drawn.n * (m.u if m.chain.order == 1 else 1),
    "trap": lambda m: m.drawn.n**2 * m.u,
    "kick": lambda m: m.pulse() * np.ones(len(m.u)),
    "next-neighbour": lambda m: m.stretch(2) + m.stretch(-2),
    "nonlinear-coupling": lambda m: (
        np.abs(m.stretch(1)) ** 2 * m.stretch(1) + np.abs(m.stretch(-1)) ** 2 * m.stretch(-1)
    ),
    "asymmetric-coupling": lambda m: (m.neighbour(1) - m.neighbour(-1)) / 2,
    "intersite-nonlinearity": lambda m: np.abs(m.u) ** 2 * (m.neighbour(1) + m.neighbour(-1)),
    "long-range": lambda m: m.drawn.far @ m.u,
    "nonlinear-loss": lambda m: -(np.abs(m.u) ** 2) * m.u,
    "gain-loss": lambda m: (-1.0) ** np.arange(len(m.u)) * m.u,
    "defect": lambda m: np.eye(len(m.u))[m.drawn.site] * m.u,
    "disorder": lambda m: m.drawn.each * m.u,
    # Nothing of the catalogue.
    "other: cubic-drag": lambda m: -(m.v**3),
    "other: friction-between": _between,
    "other: drifting-stiffness": lambda m: (m.t - m.drawn.about["middle"]) * m.u,
    "other: weak-bond": lambda m: m.drawn.bond @ m.u,
    "other: noise-force": lambda m: np.sum(np.cos(m.drawn.omegas * m.t + m.drawn.phases), axis=0),
    "other: saturation": lambda m: m.u / (1 + 4 * np.abs(m.u) ** 2) if m.chain.is_complex else np.cos(3 * m.u),
    # Nothing of the catalogue, and of a form that is drawn, so that no list of terms can hold it.
    "other: wavy-force": lambda m: m.waves(np.abs(m.u)) * (m.u if m.chain.is_complex else 1),
    "other: wavy-drag": lambda m: -m.waves(np.abs(m.v)) * m.v,
    "other: wavy-bonds": lambda m: sum(m.waves(np.abs(m.stretch(k))) * m.stretch(k) for k in (-1, 1)),
    "other: uneven-bonds": lambda m: m.drawn.bonds @ m.u,
    "other: sudden-coupling": lambda m: float(m.t > m.drawn.about["at"]) * (m.stretch(1) + m.stretch(-1)),
    "other: late-push": lambda m: float(m.t > m.drawn.about["at"]) * np.eye(len(m.u))[m.drawn.site],
    # Nothing of the catalogue, of the blind set.
    "other: lopsided-bonds": lambda m: m.stretch(1) ** 2 - m.stretch(-1) ** 2,
    "other: moving-spot": lambda m: m.spot() * m.u,
    "other: plane-wave": lambda m: m.travelling(),
    "other: phase-conjugation": lambda m: np.conj(m.u),
    # Nothing of the catalogue, of the second blind set.
    "other: stray-wire": lambda m: m.wire(),
    "other: nonlocal-response": lambda m: (m.drawn.near @ np.abs(m.u) ** 2) * m.u,
    # Nothing of the catalogue, of the third blind set.
    "other: pumped-coupling": lambda m: m.wave() * (m.stretch(1) + m.stretch(-1)),
    "other: shaken-end": lambda m: m.wave() * np.eye(len(m.u))[0],
    "other: three-body": lambda m: m.neighbour(1) * np.conj(m.u) * m.neighbour(-1),
    "other: unsteady-supply": lambda m: m.supply() * m.u,
    "other: bent-damper": lambda m: -(np.abs(m.u) ** 2) * m.v,
}

# The second set from outside the catalogue, made by somebody who had not looked at the diagnosis: those that push or act through what
# is not seen, then those of the instrument.
BLIND_MOTIONS = (
    "other: lopsided-bonds", "other: moving-spot", "other: plane-wave", "other: phase-conjugation", "other: side-resonator",
    "other: retarded-coupling",
)  # fmt: skip
BLIND_READINGS = (
    "other: drifting-sensor", "other: neighbour-crosstalk", "other: slow-sensor", "other: clipped-reading",
)  # fmt: skip
BLIND = (*BLIND_MOTIONS, *BLIND_READINGS)
# The third set, made in the same way by somebody else after the second had been used up.
SECOND_MOTIONS = (
    "other: stray-wire", "other: nonlocal-response", "other: slow-heating", "other: slipping-spring", "other: shared-inertia",
)  # fmt: skip
SECOND_READINGS = ("other: scanned-channels", "other: mains-hum", "other: slack-needle")
SECOND_BLIND = (*SECOND_MOTIONS, *SECOND_READINGS)
# The fourth set, likewise by somebody who knew of the diagnosis only what it is for.
THIRD_MOTIONS = (
    "other: pumped-coupling", "other: shaken-end", "other: three-body", "other: unsteady-supply", "other: bent-damper",
    "other: end-stops", "other: swaying-mount",
)  # fmt: skip
THIRD_READINGS = ("other: flickering-lamp", "other: averaging-readout", "other: floating-ground")
THIRD_BLIND = (*THIRD_MOTIONS, *THIRD_READINGS)

ONLY_SECOND = (
    "other: cubic-drag", "other: friction-between", "other: wavy-drag", "other: lopsided-bonds", "other: slipping-spring",
    "other: bent-damper",
)  # fmt: skip
ONLY_COMPLEX = ("other: phase-conjugation", "other: nonlocal-response")
READINGS = ("sensor-offset", "sensor-gain", "sensor-curve", "clock", "quantisation")
OTHERS = (
    *(name for name in PUSHES if name.startswith("other: ") and name not in (*BLIND, *SECOND_BLIND, *THIRD_BLIND)),
    *BLIND,
    *SECOND_BLIND,
    *THIRD_BLIND,
)
# Effects of complex fields whose size is a real number all the same.
REAL = (
    "damping", "nonlinear-loss", "gain-loss", "disorder", "unequal-masses", "ends", *READINGS, *BLIND_READINGS,
    "other: shared-inertia", *SECOND_READINGS, *THIRD_READINGS,
)  # fmt: skip
# Without a size of their own.
FIXED = ("ends", "quantisation")
# Steps to the amount of an effect that has the size: to first order, then with the declared equation fitted, to within CLOSE.
FIRST_ORDER, REFITS, CLOSE = 6, 6, 0.1
# Steps between two samples in which a slow or a slack sensor follows.
FINE = 40
# Points that a mean over a time is taken from.
AVERAGED = 8
MADE = tuple(
    dict.fromkeys((
        NONE, *PUSHES, *READINGS, "ends", "unequal-masses", "known-input", "memory", *BLIND, *SECOND_BLIND, *THIRD_BLIND,
    ))
)  # fmt: skip


def sensible(name: str, system: System) -> bool:
    """Say whether an effect is one that this system's declared equation lacks and that makes sense for it."""
    if name in OTHERS:
        return (system.order == 2 or name not in ONLY_SECOND) and (system.is_complex or name not in ONLY_COMPLEX)
    effect = find(name)
    texts = effect.texts(system.order, system.is_complex)
    if not texts or (name == "known-input" and system.is_complex):
        return False
    if effect.acts != "everywhere":
        return True
    declared = system.library("equation").terms
    return any(express(Term(text), declared, system.is_complex) is None for text in texts)


def make(
    system: System,
    name: str,
    z: float,
    draw: np.random.Generator,
    *,
    sites: int = 25,
    samples: int = 50,
    span: float = 10.0,
    noise: float = 0.01,
    velocities: bool = True,
    variation: bool = False,
) -> Specimen:
    """Make a recording with one effect of a size.

    Args:
        system: its equation is the declared one.
        name: of the effect: of the catalogue, one of `OTHERS`, or "none"; "a+b" for two that push, each of the size z.
        z: its size over the smallest standard error.
        draw: for the places, times and frequencies, the initial state and the noise.
        sites: N.
        samples: how many times.
        span: the time that they are taken in.
        noise: of u and of v, over the RMS of the field about its mean.
        velocities: v is observed, too (order 2).
        variation: the initial state is drawn.

    Raises:
        InputError: there is no such effect, or no size of it is visible.
    """
    for one in name.split("+"):
        if one in MADE and ("+" not in name or one in PUSHES):
            continue
        raise unknown("effect", one, [NONE, *(one.name for one in CATALOGUE), *OTHERS])
    times = sample_times(samples, span)
    chain = motion(system, {}, sites)
    u0, v0 = system.initial_state({}, sites, None, draw if variation else None)
    start = chain.pack(u0, v0)
    drawn = _drawn(name, sites, times, draw)
    plain = _run(chain, start, times, None)
    sizes = [noise_size(plain[0], noise) / np.sqrt(chain.parts)]
    if plain[1] is not None and velocities:
        sizes.append(noise_size(plain[1], noise))

    names = [] if name == NONE else name.split("+")
    amounts: list[complex] = []
    (u, v), size, apart = plain, 0.0, 0.0
    if names:
        sight = _sight(system, plain, times, sizes, chain)
        for one in names:
            direction: complex = 1.0
            if system.is_complex and one not in REAL:
                direction = complex(np.exp(2j * np.pi * draw.uniform()))

            def readings(amount: complex, one: str = one) -> Fields:
                return _disturbed(one, amount, chain, start, times, drawn)

            if one == "quantisation":
                amounts.append(_step(plain[0], sizes[0], z))
            elif one in FIXED:
                amounts.append(1.0)
            else:
                amounts.append(_sized(readings, sight, z, direction, float(np.sqrt(np.mean(np.abs(plain[0]) ** 2)))))
            u, v = readings(amounts[-1])
            size = z if one == "quantisation" else sight.fitted_size((u, v))
            apart = sight.apart((u, v)) if one in OTHERS else 0.0
        if len(names) > 1:
            u, v = _run(chain, start, times, _all(names, amounts, chain, drawn))
    amount = amounts[0] if amounts else 0.0
    noisy = u + _noise(u, sizes[0], draw)
    if name == "quantisation":
        # What is rounded is the noisy reading.
        noisy = _rounded(noisy, float(np.real(amount)))
    noisy_v = v + _noise(v, sizes[1], draw) if v is not None and velocities else None
    clean = Samples(times, u, v, drawn.force, source="exact")
    observed = SimulatedSamples(
        times, noisy, noisy_v, drawn.force, sigma=sizes[0] * np.sqrt(chain.parts), source=f"{system.name} with {name}",
        equation=chain.term.text, exact=clean, noise=noise,
    )  # fmt: skip
    return Specimen(
        observed, clean, name, amount, drawn.about, size, apart, _other(chain.ends) if name == "ends" else None
    )


def _sized(readings: Callable[[complex], Fields], sight: _Sight, z: float, direction: complex, scale: float) -> complex:
    """Find the amount that is visible with the size z.

    Raises:
        InputError: no amount is visible.
    """
    amount = 1e-6 * scale
    # To first order, from an amount so small that it is one.
    for _ in range(FIRST_ORDER):
        size = sight.size(readings(amount * direction))
        if not size > 0:
            raise InputError("an effect of no size is visible here")
        if abs(size / z - 1) < 1e-6:
            break
        amount *= float(np.clip(z / size, 0.2, 1e5))
    # A large effect may be absorbed by the declared equation's own coefficients, or by a motion of another kind.
    for _ in range(REFITS):
        size = sight.fitted_size(readings(amount * direction))
        if abs(size / z - 1) < CLOSE:
            break
        amount *= float(np.clip((z / max(size, 1e-12)) ** 0.8, 0.3, 3.0))
    return amount * direction


def _all(
    names: Sequence[str], amounts: Sequence[complex], chain: Motion, drawn: Drawn
) -> Callable[[float, ndarray, ndarray], ndarray]:
    """Let several effects push at once."""

    def push(t: float, u: ndarray, v: ndarray) -> ndarray:
        moment = Moment(t, u, v, chain, drawn)
        return np.asarray(sum(amount * PUSHES[name](moment) for name, amount in zip(names, amounts, strict=True)))

    return push


def _rounded(field: ndarray, step: float) -> ndarray:
    """Round each part to multiples of a step."""
    if np.iscomplexobj(field):
        return np.asarray(_rounded(field.real, step) + 1j * _rounded(field.imag, step))
    return np.asarray(np.round(field / step) * step)


def _step(u: ndarray, sigma: float, z: float) -> float:
    """Give the step whose mean rounding error has the size z beside noise and rounding together.

    Raises:
        InputError: there is none; n readings tell less than the root of n.
    """
    parts = np.stack([u.real, u.imag]) if np.iscomplexobj(u) else u[None]

    def size(step: float) -> float:
        wrong = rounding_error(parts, step, sigma, 0.0)
        return float(np.sqrt(np.sum(wrong**2) / (sigma**2 + step**2 / 12)))

    steps = sigma * np.geomspace(1, 300, 200)
    for step in steps:
        if size(float(step)) >= z:
            return float(step)
    raise InputError(f"no rounding of so few readings has the size {z:g}")


def _noise(field: ndarray, sigma: float, draw: np.random.Generator) -> ndarray:
    """Draw Gaussian noise of this size in each real part."""
    if np.iscomplexobj(field):
        return np.asarray(sigma * (draw.normal(size=field.shape) + 1j * draw.normal(size=field.shape)))
    return np.asarray(sigma * draw.normal(size=field.shape))


def _drawn(name: str, sites: int, times: ndarray, draw: np.random.Generator) -> Drawn:
    """Draw places, times and frequencies."""
    span = float(times[-1] - times[0])
    n = np.arange(sites) - (sites - 1) / 2
    power = draw.uniform(1.5, 3.0)
    distance = np.abs(n[:, None] - n)
    far = np.where(distance >= 2, np.maximum(distance, 1.0) ** -power, 0.0)
    k = int(draw.integers(sites // 3, 2 * sites // 3))
    bond = np.zeros((sites, sites))
    bond[k : k + 2, k : k + 2] = [[-1, 1], [1, -1]]
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
    }
    each = draw.normal(size=sites)
    about["delay"] = span * draw.uniform(0.08, 0.2)
    late = draw.normal(size=len(times)) if name == "clock" else None
    force = None
    if name == "known-input":
        force = np.cumsum(draw.normal(size=(len(times), sites)), axis=0)
        force -= force.mean(axis=0)
        force /= np.std(force)
    strengths = draw.normal(size=sites - 1)
    bonds = np.diag(strengths, 1) + np.diag(strengths, -1)
    bonds -= np.diag(bonds.sum(axis=1))
    shape = np.stack([draw.uniform(1.0, 5.0, size=3), draw.uniform(0, 2 * np.pi, size=3)])
    # From a generator of their own, so that nothing else changes what it draws.
    more = np.random.default_rng(shape.view(np.uint64).ravel().tolist())
    about |= {
        "wave_number": more.choice([-1.0, 1.0]) * more.uniform(0.6, 2.4),
        "spot": sites * more.uniform(-0.15, 0.15),
        "speed": more.choice([-1.0, 1.0]) * more.uniform(0.3, 1.0) * sites / span,
        "breadth": more.uniform(1.0, 2.5),
        "own": more.uniform(1.0, 4.0),
        "warming": span * more.uniform(0.1, 0.4),
    }
    about |= {
        "wire_from": int(sites * more.uniform(0.2, 0.4)),
        "wire_to": int(sites * more.uniform(0.6, 0.8)),
        "grip": more.uniform(0.2, 0.8),
        "cooling": span * more.uniform(0.1, 0.5),
        "fading": more.uniform(1.0, 3.0),
        "hum": more.uniform(3.0, 9.0),
        "hum_phase": more.uniform(0, 2 * np.pi),
    }
    near = np.exp(-distance / about["fading"])
    pickup = more.uniform(0.5, 1.5, size=sites)
    about |= {"play": more.uniform(0.3, 0.7), "sway": more.uniform(1.0, 4.0)}
    supply = np.stack([more.uniform(2 * np.pi / span, 6.0, size=5), more.uniform(0, 2 * np.pi, size=5)])
    flicker = more.normal(size=len(times))
    return Drawn(
        about, n, far - np.diag(far.sum(axis=1)), bond, bonds, shape, each, omegas, phases, late, force, near, pickup,
        supply, flicker,
    )  # fmt: skip


def _run(
    chain: Motion, start: ndarray, times: ndarray, push: Callable[[float, ndarray, ndarray], ndarray] | None
) -> Fields:
    """Integrate the chain with a push, which is given t, u and v (u for order 1)."""
    rate = chain.right_hand_side
    size = chain.parts * chain.sites

    def forced(t: float, y: ndarray) -> ndarray:
        change = rate(t, y)
        if push is not None:
            u, v = chain.unpack(y)
            extra = push(t, u, u if v is None else v)
            change[-size:] += np.concatenate([extra.real, extra.imag]) if chain.is_complex else extra
        return change

    return chain.unpack(_integrated(forced, start, times))


def _integrated(rate: Callable[[float, ndarray], ndarray], start: ndarray, times: ndarray) -> ndarray:
    """Integrate real equations (states, T)."""
    from scipy.integrate import solve_ivp

    found = solve_ivp(
        rate, (times[0], times[-1]), start, t_eval=times, method="DOP853", rtol=1e-9, atol=1e-10,
        max_step=0.1 * float(times[-1] - times[0]),
    )  # fmt: skip
    if found.status != 0 or not np.all(np.isfinite(found.y)):
        raise InputError("the motion is unbounded")
    return np.asarray(found.y)


def _disturbed(name: str, amount: complex, chain: Motion, start: ndarray, times: ndarray, drawn: Drawn) -> Fields:
    """Give the clean readings with an effect of this amount."""
    if name in PUSHES:
        function = PUSHES[name]
        return _run(chain, start, times, lambda t, u, v: amount * function(Moment(t, u, v, chain, drawn)))
    if name == "unequal-masses":
        return _run(chain, start, times, _scaled(chain, drawn.site, float(np.real(amount))))
    if name == "known-input":
        from scipy.interpolate import CubicSpline

        force = CubicSpline(times, drawn.force)
        return _run(chain, start, times, lambda t, _u, _v: amount * force(t))
    if name == "memory":
        return _with_memory(lambda past, _: amount * past, chain, start, times, float(drawn.about["delay"]))
    if name == "other: retarded-coupling":

        def late(past: ndarray, u: ndarray) -> ndarray:
            before = Moment(0.0, past, past, chain, drawn)
            return np.asarray(amount * (before.neighbour(1) + before.neighbour(-1) - 2 * u))

        return _with_memory(late, chain, start, times, float(drawn.about["delay"]))
    if name == "other: side-resonator":
        return _with_resonator(amount, chain, start, times, np.eye(chain.sites)[drawn.site], float(drawn.about["own"]))
    if name == "other: slow-heating":
        # What moves warms its site, which gives the heat off again; the force of a warm site is another.
        cooling = float(drawn.about["cooling"])
        return _with_hidden(
            lambda heat, u: amount * heat * u, lambda heat, v: (np.abs(v) ** 2 - heat) / cooling, chain, start, times
        )
    if name == "other: slipping-spring":
        # Each site drags a spring whose foot slips: its bend follows the site when small, and never passes the grip.
        grip = float(drawn.about["grip"])
        return _with_hidden(
            lambda bend, _: -amount * bend, lambda bend, v: v - np.abs(v) * bend / grip, chain, start, times
        )
    if name == "other: end-stops":
        # Padded stops were put round each site where it stood at the start.
        begin, play = chain.unpack(start)[0], float(drawn.about["play"])

        def stopped(_t: float, u: ndarray, _v: ndarray) -> ndarray:
            moved = u - begin
            return np.asarray(-amount * moved * (1 - play / np.maximum(np.abs(moved), play)))

        return _run(chain, start, times, stopped)
    if name == "other: swaying-mount":
        return _with_resonator(amount, chain, start, times, np.ones(chain.sites), float(drawn.about["sway"]))
    if name == "other: shared-inertia":
        return _run(chain, start, times, _heavy_bonds(chain, drawn, float(np.real(amount))))
    if name == "ends":
        return _run(replace(chain, ends=_other(chain.ends)), start, times, None)
    if name == "clock":
        assert drawn.late is not None
        return _read_late(chain, start, times, float(np.real(amount)) * drawn.late)
    if name == "other: slow-sensor":
        return _read_slowly(chain, start, times, float(np.real(amount)), drawn.site)
    if name == "other: scanned-channels":
        return _read_in_turn(chain, start, times, float(np.real(amount)))
    if name == "other: slack-needle":
        return _read_with_slack(chain, start, times, float(np.real(amount)))
    if name == "other: averaging-readout":
        # The root, as a mean over a time is off by its square but for a shift, which is as good as another start.
        return _read_averaged(chain, start, times, float(np.sqrt(np.real(amount))))
    return _misread(name, float(np.real(amount)), drawn, times, *_run(chain, start, times, None))


def _other(ends: Ends) -> Ends:
    """Give the ends that a chain has instead of its own."""
    return "fixed" if ends == "free" else "free"


def _scaled(chain: Motion, site: int, amount: float) -> Callable[[float, ndarray, ndarray], ndarray]:
    """Make the push that scales one site's whole right-hand side by 1 + amount."""
    return lambda t, u, v: np.asarray(amount * np.eye(chain.sites)[site] * _whole(chain, t, u, v))


def _whole(chain: Motion, t: float, u: ndarray, v: ndarray) -> ndarray:
    """Give the chain's own right-hand side."""
    own = chain.right_hand_side(t, chain.pack(u, v))[-chain.parts * chain.sites :]
    return np.asarray(own[: chain.sites] + 1j * own[chain.sites :] if chain.is_complex else own)


def _heavy_bonds(chain: Motion, drawn: Drawn, amount: float) -> Callable[[float, ndarray, ndarray], ndarray]:
    """Make the push by which u'' = F becomes u'' - amount (u''_{n+1} + u''_{n-1} - 2 u''_n) = F; with u' for order 1."""
    between = np.stack([_between(Moment(0.0, one, one, chain, drawn)) for one in np.eye(chain.sites)], axis=1)
    shared = np.linalg.inv(np.eye(chain.sites) - amount * between) - np.eye(chain.sites)
    return lambda t, u, v: np.asarray(shared @ _whole(chain, t, u, v))


def _misread(name: str, size: float, drawn: Drawn, times: ndarray, u: ndarray, v: ndarray | None) -> Fields:
    """Give what a sensor that lies shows of a field; rounding comes after the noise."""
    one = np.eye(u.shape[1])[drawn.site]
    if name == "sensor-offset":
        return u + size * one, v
    if name == "sensor-gain":
        return u * (1 + size * one), None if v is None else v * (1 + size * one)
    if name == "sensor-curve":
        bent = u + size * (np.abs(u) if np.iscomplexobj(u) else u) * u
        return bent, None if v is None else v * (1 + 2 * size * u)
    if name == "other: drifting-sensor":
        # It warms up. Velocities have a sensor of their own, which is sound.
        drift = 1 - np.exp(-(times - times[0]) / drawn.about["warming"])
        return u + size * drift[:, None] * one, v
    if name == "other: neighbour-crosstalk":
        # Of sensors side by side, of which those at the ends have one neighbour. Velocities come through the same wires.
        beside = np.eye(u.shape[1], k=1) + np.eye(u.shape[1], k=-1)
        return u + size * u @ beside, None if v is None else v + size * v @ beside
    if name == "other: clipped-reading":
        # All have one range, and each part of a complex field has it. Velocities have sensors of their own, whose range suffices.
        # The root, as what is lost grows faster than the range shrinks.
        limit = max(np.max(np.abs(u.real)), np.max(np.abs(u.imag))) / (1 + np.sqrt(size))
        if np.iscomplexobj(u):
            return np.clip(u.real, -limit, limit) + 1j * np.clip(u.imag, -limit, limit), v
        return np.clip(u, -limit, limit), v
    if name == "other: mains-hum":
        # In step in all wires, of which some catch more. Velocities have wires of their own, which are screened.
        hum = np.cos(drawn.about["hum"] * times + drawn.about["hum_phase"])
        return u + size * hum[:, None] * drawn.pickup, v
    if name == "other: flickering-lamp":
        # One lamp lights all sites. Velocities are found from the same light.
        bright = (1 + size * drawn.flicker)[:, None]
        return u * bright, None if v is None else v * bright
    if name == "other: floating-ground":
        # What all sensors are measured against is itself lifted by their mean. Velocities have the same ground.
        return _grounded(u, size), None if v is None else _grounded(v, size)
    return u, v


def _grounded(field: ndarray, size: float) -> ndarray:
    """Give a field as it is measured against a ground that its mean lifts."""
    return np.asarray(field - size * np.mean(field, axis=1, keepdims=True))


def _read_late(chain: Motion, start: ndarray, times: ndarray, late: ndarray) -> Fields:
    """Give the field as it is when each row is read a little late or early, within the record."""
    at = np.clip(times + late, times[0], times[-1])
    grid, place = np.unique(np.concatenate([times[[0, -1]], at]), return_inverse=True)
    u, v = _run(chain, start, grid, None)
    rows = place[2:]
    return u[rows], None if v is None else v[rows]


def _read_slowly(chain: Motion, start: ndarray, times: ndarray, lag: float, site: int) -> Fields:
    """Give the field as it is when one sensor follows it with y' = (u - y) / lag; velocities have a sensor of their own, which is sound.

    Between the steps of a fine grid the field is taken as straight, for which this is exact.
    """
    grid = _fine(times)
    u, v = _run(chain, start, grid, None)
    seen, shown = u[:, site], u[:, site].copy()
    for k, step in enumerate(np.diff(grid)):
        behind = lag * (seen[k + 1] - seen[k]) / step
        shown[k + 1] = seen[k + 1] - behind + (shown[k] - seen[k] + behind) * np.exp(-step / lag)
    u[:, site] = shown
    return u[::FINE], None if v is None else v[::FINE]


def _fine(times: ndarray) -> ndarray:
    """Give the samples' times and FINE - 1 between each two."""
    return np.asarray(np.interp(np.arange(FINE * (len(times) - 1) + 1) / FINE, np.arange(len(times)), times))


def _read_in_turn(chain: Motion, start: ndarray, times: ndarray, sweep: float) -> Fields:
    """Give the field as it is when one instrument reads the sites in turn, the last one `sweep` after the first; velocities likewise."""
    sites = np.arange(chain.sites)
    at = times[:, None] + sweep * sites / max(chain.sites - 1, 1)
    grid, place = np.unique(at, return_inverse=True)
    u, v = _run(chain, start, grid, None)
    rows = place.reshape(at.shape)
    return u[rows, sites], None if v is None else v[rows, sites]


def _read_with_slack(chain: Motion, start: ndarray, times: ndarray, slack: float) -> Fields:
    """Give the field as needles show it that stay where they are until it is `slack` away, and are then dragged along.

    They start where the field is; each part of a complex field has its own. Velocities have sensors of their own, which are sound.
    """
    u, v = _run(chain, start, _fine(times), None)
    parts = np.stack([u.real, u.imag]) if chain.is_complex else u[None]
    shown = parts.copy()
    for k in range(1, len(u)):
        shown[:, k] = np.clip(shown[:, k - 1], parts[:, k] - slack, parts[:, k] + slack)
    read = shown[0] + 1j * shown[1] if chain.is_complex else shown[0]
    return read[::FINE], None if v is None else v[::FINE]


def _read_averaged(chain: Motion, start: ndarray, times: ndarray, over: float) -> Fields:
    """Give the field's mean over a time that begins with each sample's; the velocity's likewise. Gauss's rule, good for smooth fields."""
    nodes, weights = np.polynomial.legendre.leggauss(AVERAGED)
    at = times[:, None] + over * (1 + nodes) / 2
    grid, place = np.unique(np.concatenate([times[:1], at.ravel()]), return_inverse=True)
    u, v = _run(chain, start, grid, None)
    rows = place[1:].reshape(at.shape)
    share = weights[:, None] / 2
    return np.sum(share * u[rows], axis=1), None if v is None else np.sum(share * v[rows], axis=1)


def _with_resonator(
    amount: complex, chain: Motion, start: ndarray, times: ndarray, hung: ndarray, own: float
) -> Fields:
    """Integrate with something unseen hung on some sites (N,), 1 for each of them, which pulls all these by amount (w - m).

    m is their mean. Its own motion is w'' = own^2 (m - w), or w' = own (m - w), times i for a complex field; it starts as they do.
    """
    rate, size = chain.right_hand_side, chain.parts * chain.sites
    turn = 1j if chain.is_complex else 1.0
    share = hung / np.sum(hung)

    def coupled(t: float, y: ndarray) -> ndarray:
        change, mean = rate(t, y[:-4]), share @ chain.unpack(y[:-4])[0]
        w, speed = y[-4:].view(complex)
        pull = amount * (w - mean) * hung
        change[-size:] += np.concatenate([pull.real, pull.imag]) if chain.is_complex else pull.real
        hidden = [speed, own**2 * (mean - w)] if chain.order == 2 else [turn * own * (mean - w), 0.0]
        return np.concatenate([change, np.array(hidden, complex).view(float)])

    u, v = chain.unpack(start)
    hidden = np.array([share @ u, 0.0 if v is None else share @ v], complex).view(float)
    return chain.unpack(_integrated(coupled, np.concatenate([start, hidden]), times)[:-4])


def _with_hidden(
    push: Callable[[ndarray, ndarray], ndarray],
    change: Callable[[ndarray, ndarray], ndarray],
    chain: Motion,
    start: ndarray,
    times: ndarray,
) -> Fields:
    """Integrate with something unseen at each site, a number h that starts at 0.

    The push is given h and u; the rate at which h changes follows from h and v (u for order 1).
    """
    rate, size, sites = chain.right_hand_side, chain.parts * chain.sites, chain.sites

    def coupled(t: float, y: ndarray) -> ndarray:
        rates, hidden = rate(t, y[:-sites]), y[-sites:]
        u, v = chain.unpack(y[:-sites])
        extra = push(hidden, u)
        rates[-size:] += np.concatenate([extra.real, extra.imag]) if chain.is_complex else extra
        return np.concatenate([rates, change(hidden, u if v is None else v)])

    return chain.unpack(_integrated(coupled, np.concatenate([start, np.zeros(sites)]), times)[:-sites])


def _always(field: ndarray, _: float) -> ndarray:
    return field


def _with_memory(
    late: Callable[[ndarray, ndarray], ndarray], chain: Motion, start: ndarray, times: ndarray, delay: float
) -> Fields:
    """Integrate in steps of one delay: within one, the past is known. Before the start the field was what it was then.

    The push is given the field as it was and as it is.
    """
    from scipy.interpolate import CubicSpline

    rows: dict[float, ndarray] = {}
    past: Callable[[float], ndarray] = functools.partial(_always, chain.unpack(start)[0])
    y = start
    for begin, end in itertools.pairwise(np.append(np.arange(times[0], times[-1], delay), times[-1])):
        grid = np.unique(np.concatenate([np.linspace(begin, end, 60), times[(times >= begin) & (times <= end)]]))

        def push(t: float, u: ndarray, _v: ndarray, past: Callable[[float], ndarray] = past) -> ndarray:
            return np.asarray(late(past(t - delay), u))

        u, v = _run(chain, y, grid, push)
        for k, t in enumerate(grid):
            rows[float(t)] = chain.pack(u[k], None if v is None else v[k])
        y = rows[float(grid[-1])]
        past = CubicSpline(grid, u)
    return chain.unpack(np.stack([rows[float(t)] for t in times], axis=1))


@dataclass(frozen=True, eq=False)
class _Sight:
    """What can be seen of a change of the readings beside the declared equation's unknowns, to first order.

    Attributes:
        plain: the clean readings without it.
        tangent: of the declared equation at its true coefficients.
        chain: the chain.
        levels: 1 where only u is read, else 2.
    """

    plain: Fields
    tangent: Tangent
    chain: Motion
    levels: int

    def left(self, found: Fields) -> Float[ndarray, " rows"]:
        """Give the change in units of the noise, without what the declared equation's unknowns can do."""
        changes = [
            one - exact for one, exact in zip(found, self.plain, strict=True) if one is not None and exact is not None
        ]
        parts = [np.stack([f.real, f.imag] if self.chain.is_complex else [f], axis=1) for f in changes[: self.levels]]
        path = self.tangent.paths[0]
        return self.tangent.new(path.free(path.rows(np.stack(parts, axis=1)[None])))[:, 0]

    def size(self, found: Fields) -> float:
        """Give the length of that: the size of a small change over the smallest standard error that it could be known with."""
        return float(np.linalg.norm(self.left(found)))

    def refitted(self, found: Fields) -> Fitted:
        """Fit the declared equation to clean readings."""
        u, v = found
        fitted = self.tangent.fitted
        clean = replace(fitted.data[0], u=u, v=v if self.levels > 1 else None)
        again = refit(fitted.model, [clean], fitted.solution.state)
        return replace(again, solution=replace(again.solution, sigma=fitted.sigma))

    def fitted_size(self, found: Fields) -> float:
        """Give the size of a change that need not be small: what the declared equation leaves when it is fitted to the clean readings."""
        fitted = self.refitted(found)
        return float(np.linalg.norm(fitted.residuals()[0] / fitted.sigma[:, None, None]))

    def apart(self, found: Fields) -> float:
        """Give what the nearest single effect of the catalogue, of any amount, leaves of that.

        Effects with a coefficient for every site or time, that come near anything, are not counted.
        """
        tangent = linearise(self.refitted(found))
        left, near = tangent.residual, 0.0
        for effect in CATALOGUE:
            for one in ways(tangent, effect):
                if one.spread is None:
                    near = max(near, float(np.sum((one.basis.T @ left) ** 2)))
        return float(np.sqrt(max(left @ left - near, 0.0)))


def _sight(system: System, plain: Fields, times: ndarray, sizes: list[float], chain: Motion) -> _Sight:
    """Linearise the declared equation about the motion without an effect."""
    declared = system.library("equation")
    truth = system.truth(declared, {})
    assert truth is not None
    u, v = plain
    samples = Samples(times, u, v if len(sizes) > 1 else None, ends=system.ends)
    model = Model(declared, system.order)
    records = model.records([samples])
    nodes = records[0].stretches.dynamics.pack(u, v)
    sigma = np.array(sizes)
    covariance, counts = np.eye(len(truth)), np.ones(len(sizes))
    solution = Solution(State(truth, (nodes,), (None,)), sigma, covariance, sigma**2, counts, 1, True, ())
    return _Sight(plain, linearise(Fitted(model, (samples,), tuple(records), solution)), chain, len(sizes))
