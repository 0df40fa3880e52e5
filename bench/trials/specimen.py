"""Recordings with something in them that the declared equation lacks, to see whether the loop finds it.

Sizes are asked for as z, the effect's size over the smallest standard error that it could be known with (the Cramer-Rao bound, everything in
the declared equation being unknown too): z = 5 is barely visible, 30 plainly. Beyond first order this is what the declared equation leaves
of the clean readings when it is fitted to them, in units of the noise. What can be wrong is in `bench.trials.faults`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.bench.trials.faults import FAULTS, MISREADINGS, NONE, OTHERS, PUSHES, ROUNDED, Fault, push
from latticebench.bench.trials.faults.setting import Fields, Setting, draw_all, other
from latticebench.diagnosis.model import Fitted, Model, refit, rounding_error
from latticebench.diagnosis.tangent import Tangent, linearise
from latticebench.diagnosis.ways import ways
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

# Steps to the amount of an effect that has the size: to first order, then with the declared equation fitted, to within CLOSE.
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
        name: of the effect: of the catalogue, one of `OTHERS`, or "none"; "a+b" for two that push, or one that does
            and one of `MISREADINGS`, each of the size z.
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
    names = [] if name == NONE else name.split("+")
    for one in names:
        if one not in FAULTS:
            raise unknown("effect", one, [NONE, *(one.name for one in CATALOGUE), *OTHERS])
    pushing = [one for one in names if one in PUSHES]
    misread = [one for one in names if one not in PUSHES]
    if len(names) > 1 and (len(misread) > 1 or not {*misread} <= {*MISREADINGS}):
        raise InputError(
            f"effect {name!r}: of several one at most may be of the instrument ({', '.join(MISREADINGS)}), and the others must push"
        )
    times = sample_times(samples, span)
    chain = motion(system, {}, sites)
    u0, v0 = system.initial_state({}, sites, None, draw if variation else None)
    setting = Setting(chain, chain.pack(u0, v0), times, draw_all(name, sites, times, draw))
    plain = setting.run()
    sizes = [noise_size(plain[0], noise) / np.sqrt(chain.parts)]
    if plain[1] is not None and velocities:
        sizes.append(noise_size(plain[1], noise))

    amounts: dict[str, complex] = {}
    (u, v), size, apart = plain, 0.0, 0.0
    if names:
        sight = _sight(system, plain, times, sizes, chain)
        scale = float(np.sqrt(np.mean(np.abs(plain[0]) ** 2)))
        for one in names:
            fault = FAULTS[one]
            direction: complex = 1.0
            if system.is_complex and not fault.real:
                direction = complex(np.exp(2j * np.pi * draw.uniform()))

            def readings(amount: complex, fault: Fault = fault) -> Fields:
                return fault.fields(setting, amount)

            if one == ROUNDED:
                amounts[one] = _step(plain[0], sizes[0], z)
            else:
                amounts[one] = _sized(readings, sight, z, direction, scale) if fault.sized else 1.0
            u, v = readings(amounts[one])
            size = z if one == ROUNDED else sight.fitted_size((u, v))
            apart = sight.apart((u, v)) if one in OTHERS else 0.0
        if len(names) > 1:
            together = replace(setting, standing=push(setting, {one: amounts[one] for one in pushing}))
            u, v = FAULTS[misread[0]].fields(together, amounts[misread[0]]) if misread else together.run()
    amount = amounts[names[0]] if names else 0.0
    noisy = u + _noise(u, sizes[0], draw)
    if name == ROUNDED:
        noisy = _rounded(noisy, float(np.real(amount)))
    noisy_v = v + _noise(v, sizes[1], draw) if v is not None and velocities else None
    force = setting.drawn.force
    clean = Samples(times, u, v, force, source="exact")
    observed = SimulatedSamples(
        times, noisy, noisy_v, force, sigma=sizes[0] * np.sqrt(chain.parts), source=f"{system.name} with {name}",
        equation=chain.term.text, exact=clean, noise=noise,
    )  # fmt: skip
    ends = other(chain.ends) if name == "ends" else None
    return Specimen(observed, clean, name, amount, setting.drawn.about, size, apart, ends)


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
