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

from latticebench.bench.trials.faults import FAULTS, MISREADINGS, NONE, OTHERS, PUSHES, ROUNDED, Fault, push
from latticebench.bench.trials.faults.setting import Fields, Setting, draw_circumstances, other
from latticebench.diagnosis.catalogued import candidates_of
from latticebench.diagnosis.model import Fitted, Model, refit
from latticebench.diagnosis.placed import rounding_error
from latticebench.diagnosis.tangent import Tangent, linearise
from latticebench.methods.engine.shooting import Solution, State
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.lattice import System
from latticebench.systems.motion import Motion, motion
from latticebench.systems.samples import Samples, SimulatedSamples
from latticebench.systems.simulate import noise_size, sample_times
from latticebench.systems.stencil import Ends

if TYPE_CHECKING:
    from jaxtyping import Float
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
    if name == ROUNDED:
        noisy = rounded(noisy, float(np.real(added.amount)))
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
    sight = _sight(system, plain, setting.times, sizes, setting.chain)
    scale = float(np.sqrt(np.mean(np.abs(plain[0]) ** 2)))
    amounts: dict[str, complex] = {}
    for one in names:
        fault = FAULTS[one]
        direction: complex = 1.0
        if system.is_complex and not fault.real:
            direction = complex(np.exp(2j * np.pi * draw.uniform()))

        def readings(amount: complex, fault: Fault = fault) -> Fields:
            return fault.fields(setting, amount)

        if one == ROUNDED:
            amounts[one] = _step_of_size(plain[0], sizes[0], z)
        else:
            amounts[one] = _sized(readings, sight, z, direction, scale) if fault.sized else 1.0
        fields = readings(amounts[one])
        size = z if one == ROUNDED else sight.fitted_size(fields)
        apart = sight.apart(fields) if one in OTHERS else 0.0
    if len(names) > 1:
        fields = _together(setting, amounts)
    return _Added(fields, amounts[names[0]], size, apart)


def _together(setting: Setting, amounts: Mapping[str, complex]) -> Fields:
    """Return the clean readings with several effects at once."""
    pushing = {one: amount for one, amount in amounts.items() if one in PUSHES}
    misread = [one for one in amounts if one not in PUSHES]
    pushed = replace(setting, standing=push(setting, pushing))
    return FAULTS[misread[0]].fields(pushed, amounts[misread[0]]) if misread else pushed.run()


def _sized(readings: Callable[[complex], Fields], sight: _Sight, z: float, direction: complex, scale: float) -> complex:
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
        size = sight.fitted_size(readings(amount * direction))
        if abs(size / z - 1) < CLOSE:
            break
        amount *= float(np.clip((z / max(size, 1e-12)) ** 0.8, 0.3, 3.0))
    return amount * direction


def rounded(field: ndarray, step: float) -> ndarray:
    """Return a field with each part rounded to multiples of a step."""
    if np.iscomplexobj(field):
        return np.asarray(rounded(field.real, step) + 1j * rounded(field.imag, step))
    return np.asarray(np.round(field / step) * step)


def _step_of_size(u: ndarray, sigma: float, z: float) -> float:
    """Return the step whose mean rounding error has the size z beside noise and rounding together.

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
    """Return Gaussian noise of this size in each real part."""
    if np.iscomplexobj(field):
        return np.asarray(sigma * (draw.normal(size=field.shape) + 1j * draw.normal(size=field.shape)))
    return np.asarray(sigma * draw.normal(size=field.shape))


@dataclass(frozen=True, eq=False)
class _Sight:
    """What can be seen of an effect on the readings beside the declared equation's unknowns, to first order.

    Attributes:
        plain: the clean readings without the effect.
        tangent: of the declared equation at its true coefficients.
        chain: the chain.
        levels: 1 where only u is read, else 2.
    """

    plain: Fields
    tangent: Tangent
    chain: Motion
    levels: int

    def left(self, found: Fields) -> Float[ndarray, " rows"]:
        """Return the effect on readings in units of the noise, less what the declared equation's unknowns can do."""
        differences = [
            one - exact for one, exact in zip(found, self.plain, strict=True) if one is not None and exact is not None
        ]
        parts = [
            np.stack([f.real, f.imag] if self.chain.is_complex else [f], axis=1) for f in differences[: self.levels]
        ]
        path = self.tangent.paths[0]
        return self.tangent.new(path.free(path.rows(np.stack(parts, axis=1)[None])))[:, 0]

    def size(self, found: Fields) -> float:
        """Return the length of that: a small effect's size over the smallest standard error it could be known with."""
        return float(np.linalg.norm(self.left(found)))

    def refitted(self, found: Fields) -> Fitted:
        """Return the fit of the declared equation to clean readings."""
        u, v = found
        fitted = self.tangent.fitted
        clean = replace(fitted.data[0], u=u, v=v if self.levels > 1 else None)
        again = refit(fitted.model, [clean], fitted.solution.state)
        return replace(again, solution=replace(again.solution, sigma=fitted.sigma))

    def fitted_size(self, found: Fields) -> float:
        """Return the size of an effect that need not be small: what the declared equation, fitted, leaves."""
        fitted = self.refitted(found)
        return float(np.linalg.norm(fitted.residuals()[0] / fitted.sigma[:, None, None]))

    def apart(self, found: Fields) -> float:
        """Return what the nearest single effect of the catalogue, of any amount, leaves of that.

        Effects with a coefficient for every site or time come near anything and are not counted.
        """
        tangent = linearise(self.refitted(found))
        left, near = tangent.residual, 0.0
        for effect in CATALOGUE:
            for one in candidates_of(tangent, effect):
                if one.spread is None:
                    near = max(near, float(np.sum((one.basis.T @ left) ** 2)))
        return float(np.sqrt(max(left @ left - near, 0.0)))


def _sight(system: System, plain: Fields, times: ndarray, sizes: list[float], chain: Motion) -> _Sight:
    """Return the declared equation linearised about the motion without an effect."""
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
