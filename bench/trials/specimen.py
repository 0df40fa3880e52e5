"""Simulated recordings with an effect that the declared equation lacks, to see whether the diagnosis finds it.

Sizes are asked for as z, the effect's size over the smallest standard error that it could be known with (the Cramer-Rao
bound, everything in the declared equation being unknown, too): z = 5 is barely visible, 30 plainly. Beyond first order
this is what the declared equation leaves of the clean readings when it is fitted to them, in units of the noise. How
each effect is simulated is in `bench.trials.faults`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.trials.faults import FAULTS, MISREADINGS, NONE, OTHERS, PUSHES, Fault, push
from latticebench.bench.trials.faults.setting import Fields, Setting, draw_circumstances, other
from latticebench.bench.trials.sight import Sight
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.lattice import System
from latticebench.systems.motion import motion
from latticebench.systems.samples import Samples, SimulatedSamples
from latticebench.systems.simulate import noise_size, sample_times
from latticebench.systems.stencil import Ends

if TYPE_CHECKING:
    from numpy import ndarray

# Steps to the amount of an effect that has the size: to first order, then with the declared equation fitted, to within
# CLOSE.
FIRST_ORDER, REFITS, CLOSE = 6, 6, 0.1


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


@dataclass(frozen=True)
class Conditions:
    """How a specimen is recorded.

    Attributes:
        sites: N.
        samples: number of sample times.
        span: time from the first to the last of them.
        noise: standard deviation of the noise on u and on v, over the RMS of the field about its mean.
        velocities: whether v is observed, too (order 2).
        variation: whether the initial state is drawn.
    """

    sites: int = 25
    samples: int = 50
    span: float = 10.0
    noise: float = 0.01
    velocities: bool = True
    variation: bool = False


USUAL = Conditions()


def make(system: System, name: str, z: float, draw: np.random.Generator, conditions: Conditions = USUAL) -> Specimen:
    """Make a recording with one effect, or several, of a given size.

    Args:
        system: its equation is the declared one.
        name: of the effect: of the catalogue, one of `OTHERS`, or "none"; "a+b" for two that push, or one that does
            and one of `MISREADINGS`, each of the size z.
        z: the effect's size over the smallest standard error that it could be known with.
        draw: for the places, times and frequencies, the initial state and the noise.
        conditions: how it is recorded.

    Raises:
        InputError: there is no such effect, or no size of it is visible.
    """
    names = _names(name)
    times = sample_times(conditions.samples, conditions.span)
    chain = motion(system, {}, conditions.sites)
    u0, v0 = system.initial_state({}, conditions.sites, None, draw if conditions.variation else None)
    drawn = draw_circumstances(name, conditions.sites, times, draw)
    setting = Setting(chain, chain.pack(u0, v0), times, drawn)
    plain = setting.run()
    sizes = [noise_size(plain[0], conditions.noise) / np.sqrt(chain.parts)]
    if plain[1] is not None and conditions.velocities:
        sizes.append(noise_size(plain[1], conditions.noise))
    added = _add(system, names, z, draw, setting, plain, sizes) if names else _Added(plain, 0.0, 0.0, 0.0)
    u, v = added.fields
    noisy = u + _noise(u, sizes[0], draw)
    noisy_v = v + _noise(v, sizes[1], draw) if v is not None and conditions.velocities else None
    clean = Samples(times, u, v, drawn.force, source="exact")
    observed = SimulatedSamples(
        times,
        noisy,
        noisy_v,
        drawn.force,
        sigma=sizes[0] * np.sqrt(chain.parts),
        source=f"{system.name} with {name}",
        equation=chain.term.text,
        exact=clean,
        noise=conditions.noise,
    )
    ends = other(chain.ends) if name == "ends" else None
    return Specimen(observed, clean, name, added.amount, drawn.about, added.size, added.apart, ends)


def _names(name: str) -> list[str]:
    """Return the effects that a name stands for.

    Raises:
        InputError: one of them is unknown, or they cannot be there together.
    """
    names = [] if name == NONE else name.split("+")
    for one in names:
        if one not in FAULTS:
            raise unknown("effect", one, [NONE, *(one.name for one in CATALOGUE), *OTHERS])
    misread = [one for one in names if one not in PUSHES]
    if len(names) > 1 and (len(misread) > 1 or not {*misread} <= {*MISREADINGS}):
        raise InputError(
            f"effect {name!r}: of several one at most may be of the instrument ({', '.join(MISREADINGS)}), "
            "and the others must push"
        )
    return names


@dataclass(frozen=True, eq=False)
class _Added:
    """Clean readings with effects in them: u and v, the first effect's amount, and `z` and `apart` of a specimen."""

    fields: Fields
    amount: complex
    size: float
    apart: float


def _add(
    system: System,
    names: Sequence[str],
    z: float,
    draw: np.random.Generator,
    setting: Setting,
    plain: Fields,
    sizes: list[float],
) -> _Added:
    """Return clean readings with effects, each of the size z by itself.

    Args:
        system: its equation is the declared one.
        names: of the effects.
        z: their size.
        draw: for the phase of a complex amount.
        setting: the chain that they are added to.
        plain: its clean readings without them.
        sizes: standard deviations of the noise on u and, where it is read, on v.
    """
    sight = Sight.of(system, plain, setting.times, sizes, setting.chain)
    scale = float(np.sqrt(np.mean(np.abs(plain[0]) ** 2)))
    amounts: dict[str, complex] = {}
    for one in names:
        fault = FAULTS[one]
        direction: complex = 1.0
        if system.is_complex and not fault.real:
            direction = complex(np.exp(2j * np.pi * draw.uniform()))

        def readings(amount: complex, fault: Fault = fault) -> Fields:
            return fault.fields(setting, amount)

        amounts[one] = _sized(readings, sight, z, direction, scale) if fault.sized else 1.0
        fields = readings(amounts[one])
        line = sight.fitted(fields)
        apart = sight.apart(line) if one in OTHERS else 0.0
    if len(names) > 1:
        fields = _together(setting, amounts)
    return _Added(fields, amounts[names[0]], line.size, apart)


def _together(setting: Setting, amounts: Mapping[str, complex]) -> Fields:
    """Return the clean readings with several effects at once."""
    pushing = {one: amount for one, amount in amounts.items() if one in PUSHES}
    misread = [one for one in amounts if one not in PUSHES]
    pushed = replace(setting, standing=push(setting, pushing))
    return FAULTS[misread[0]].fields(pushed, amounts[misread[0]]) if misread else pushed.run()


def _sized(readings: Callable[[complex], Fields], sight: Sight, z: float, direction: complex, scale: float) -> complex:
    """Return the amount that is visible with the size z.

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
        size = sight.fitted(readings(amount * direction)).size
        if abs(size / z - 1) < CLOSE:
            break
        amount *= float(np.clip((z / max(size, 1e-12)) ** 0.8, 0.3, 3.0))
    return amount * direction


def _noise(field: ndarray, sigma: float, draw: np.random.Generator) -> ndarray:
    """Return Gaussian noise of this size in each real part."""
    if np.iscomplexobj(field):
        return np.asarray(sigma * (draw.normal(size=field.shape) + 1j * draw.normal(size=field.shape)))
    return np.asarray(sigma * draw.normal(size=field.shape))
