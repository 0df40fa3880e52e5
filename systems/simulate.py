"""Samples of a system: integrators, sample times, noise and gaps."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Integrator, System
from latticebench.systems.motion import Motion, motion
from latticebench.systems.samples import Samples, SimulatedSamples
from latticebench.systems.stencil import Ends

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

PAPER_STEP = 1e-3
MAX_VALUES = 50_000_000
# Evaluations that nobody would wait for, and after how many one looks whether it will come to them.
HOPELESS, TRIED = 10**9, 10**5


def sample_times(
    count: int = 50, span: float = 10.0, uneven: np.random.Generator | None = None
) -> Float[ndarray, " time"]:
    """Return `count` times in [0, span): by default the paper's 0, 0.2, ..., 9.8.

    Args:
        count: how many.
        span: the end of the interval, itself left out.
        uneven: draws all times but the first uniformly; evenly spaced if None.

    Raises:
        InputError: fewer than two times, or a span that is not positive and finite.
    """
    if count < 2:
        raise InputError(f"samples: {count} is too few; at least 2 are needed")
    if not (np.isfinite(span) and span > 0):
        raise InputError(f"span: {span!r} must be a positive time")
    if uneven is None:
        return span * np.arange(count) / count
    return np.concatenate([[0.0], np.sort(uneven.uniform(0, span, count - 1))])


def integrate(
    chain: Motion,
    start: Float[ndarray, " state"],
    times: Float[ndarray, " time"],
    method: Integrator = "dop853",
) -> Float[ndarray, "state time"]:
    """Return the states of a chain at `times`, integrated from `start` at times[0].

    `rk4`: the paper's classical Runge-Kutta method of order 4 with steps of about 1e-3 (see `runge_kutta`).
    `bdf`: the paper's implicit backward differentiation formulas of variable order and step (SciPy's BDF) with relative
    and absolute tolerances 1e-9 and 1e-11 and the exact Jacobian.
    `dop853`: the reference, a Runge-Kutta method of order 8 with tolerances 1e-13 (SciPy's DOP853).

    Raises:
        InputError: the state grows without bound, or the integrator gives up.
    """
    if method == "rk4":
        return runge_kutta(chain.right_hand_side, start, times, PAPER_STEP)
    options: dict[str, Any] = (
        {"method": "BDF", "rtol": 1e-9, "atol": 1e-11, "jac": chain.jacobian}
        if method == "bdf"
        else {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13}
    )
    states, reached = _adaptive(chain, start, times, options)
    if reached != len(times):
        raise _unbounded(float(times[reached - 1]))
    return states


def follow(
    chain: Motion,
    start: Float[ndarray, " state"],
    times: Float[ndarray, " time"],
    tolerance: float,
    most_evaluations: int,
) -> tuple[Float[ndarray, "state time"], int]:
    """Return the states of a chain as far as it can be integrated.

    Args:
        chain: what moves.
        start: the state at times[0].
        times: when to return the state.
        tolerance: relative and absolute, of the Runge-Kutta method of order 8.
        most_evaluations: of the right-hand side; a chain that needs more counts as broken off at the start.

    Returns:
        the states at the first of the times, and the number of these.
    """
    options = {"method": "DOP853", "rtol": tolerance, "atol": tolerance}
    return _adaptive(chain, start, times, options, most_evaluations)


class _Exhausted(Exception):
    """Raised when the right-hand side has been evaluated too often."""


def _adaptive(
    chain: Motion, start: ndarray, times: ndarray, options: dict[str, Any], most_evaluations: int | None = None
) -> tuple[ndarray, int]:
    """Return the finite and bounded states that `solve_ivp` finds, at least the first, and their number.

    Raises:
        InputError: without `most_evaluations`, the motion is so fast that it would take hopelessly many.
    """
    from scipy.integrate import solve_ivp

    limit = 1e6 * (1 + float(np.max(np.abs(start))))
    rate = chain.right_hand_side
    count = 0

    def escaped(_: float, y: ndarray) -> float:
        return limit - float(np.max(np.abs(y)))

    def counted(t: float, y: ndarray) -> ndarray:
        nonlocal count
        count += 1
        if most_evaluations is not None:
            exhausted = count > most_evaluations
        else:
            exhausted = count % TRIED == 0 and count * (times[-1] - times[0]) > HOPELESS * (t - times[0])
        if exhausted:
            raise _Exhausted
        return rate(t, y)

    escaped.terminal = True  # type: ignore[attr-defined]
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = solve_ivp(counted, (times[0], times[-1]), start, t_eval=times, events=escaped, **options)
        except _Exhausted:
            if most_evaluations is None:
                raise InputError(
                    f"the motion is too fast: to t = {times[-1]:g} it would take more than {HOPELESS:g} evaluations; "
                    "take a shorter span, or slower terms"
                ) from None
            return np.asarray(start)[:, None], 1
        except (FloatingPointError, RuntimeError, ValueError, np.linalg.LinAlgError):
            return np.asarray(start)[:, None], 1
    finite = np.all(np.isfinite(found.y), axis=0) if len(found.t) else np.zeros(1, dtype=bool)
    reached = len(finite) if np.all(finite) else int(np.argmin(finite))
    if reached == 0:
        return np.asarray(start)[:, None], 1
    return np.asarray(found.y[:, :reached]), reached


def runge_kutta(
    rate: Callable[[float, ndarray], ndarray],
    start: Float[ndarray, " state"],
    times: Float[ndarray, " time"],
    step: float,
) -> Float[ndarray, "state time"]:
    """Return the states of dy/dt = rate(t, y) at `times` by the classical Runge-Kutta method of order 4.

    Each interval between two times is divided evenly, into steps as close to `step` as possible.

    Raises:
        InputError: the state grows without bound.
    """
    y = np.array(start, dtype=float)
    states = [y]
    with np.errstate(all="ignore"):
        for begin, end in itertools.pairwise(times):
            count = max(1, round((end - begin) / step))
            h = (end - begin) / count
            for k in range(count):
                t = begin + k * h
                k1 = rate(t, y)
                k2 = rate(t + h / 2, y + h / 2 * k1)
                k3 = rate(t + h / 2, y + h / 2 * k2)
                k4 = rate(t + h, y + h * k3)
                y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            if not np.all(np.isfinite(y)):
                raise _unbounded(float(end))
            states.append(y)
    return np.stack(states, axis=1)


def _unbounded(t: float) -> InputError:
    return InputError(
        f"the simulation fails near t = {t:g}: the state grows without bound; check parameters and initial state, "
        "or whether the integrator's step is too large (--integrator dop853)"
    )


def simulate(
    system: System,
    *,
    parameters: Mapping[str, float] | None = None,
    sites: int | None = None,
    times: Float[ndarray, " time"] | None = None,
    ends: Ends | None = None,
    initial: str | None = None,
    variation: np.random.Generator | None = None,
    integrator: Integrator | None = None,
) -> SimulatedSamples:
    """Return one trajectory without noise, with velocities for a second-order system.

    Args:
        system: what moves.
        parameters: values that differ from the system's defaults.
        sites: N; the system's own number if None.
        times: sample times; the paper's 50 if None.
        ends: how the chain ends; as the system's if None.
        initial: the name of an initial state; the system's first if None.
        variation: draws an initial state close to that one (see `System.initial_state`).
        integrator: the system's own (the paper's) if None.

    Raises:
        InputError: a name or value is invalid, or the motion is unbounded.
    """
    parameters = parameters or {}
    sites = system.sites if sites is None else sites
    times = sample_times() if times is None else times
    if sites < 1:
        raise InputError(f"sites: {sites} is too few; at least 1 is needed")
    if len(times) < 2 or not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
        raise InputError("times: give at least two finite ones that increase")
    if sites * len(times) > MAX_VALUES:
        raise InputError(f"sites x samples is {sites * len(times)}, more than {MAX_VALUES}; take fewer")
    if ends == "unknown":
        raise InputError("ends: a simulation must know its ends: free, fixed, periodic or antiperiodic")
    chain = motion(system, parameters, sites, ends)
    u0, v0 = system.initial_state(parameters, sites, initial, variation)
    states = integrate(chain, chain.pack(u0, v0), times, integrator or system.integrator)
    u, v = chain.unpack(states)
    rates = np.stack([chain.right_hand_side(float(t), y) for t, y in zip(times, states.T, strict=True)], axis=1)
    du, dv = chain.unpack(rates)
    listed = ", ".join(f"{name}={value:g}" for name, value in system.with_parameters(parameters).items())
    source = f"{system.name}({listed}), {sites} sites, {len(times)} samples"
    exact = Samples(times, u, v, source=source)
    return SimulatedSamples(
        exact.t, exact.u, exact.v, source=source, sigma=0.0,
        equation=chain.term.text, exact=exact, rate=dv if system.order == 2 else du,
    )  # fmt: skip


def noise_size(field: ndarray, level: float) -> float:
    """Return the standard deviation of a noise level: level x RMS of the field about its mean."""
    return float(level * np.sqrt(np.mean(np.abs(field - np.mean(field)) ** 2)))


def observe(
    clean: SimulatedSamples,
    draw: np.random.Generator,
    *,
    noise: float = 0.0,
    missing: float = 0.0,
    velocities: bool = True,
) -> SimulatedSamples:
    """Return what a measurement makes of a simulation: Gaussian noise is added and values are lost.

    Args:
        clean: the simulation.
        draw: draws the noise and the gaps.
        noise: sigma over the RMS of the field about its mean, for u and v alike; complex noise has the variance sigma^2
            in total, half of it in each part.
        missing: the probability that a value is lost.
        velocities: whether v is observed, for a second-order system.

    Raises:
        InputError: a level is negative or not finite, or everything would be missing.
    """
    if not (np.isfinite(noise) and noise >= 0):
        raise InputError(f"noise: {noise!r} must be a number >= 0 (0.01 for one per cent)")
    if not 0 <= missing < 1:
        raise InputError(f"missing: {missing!r} must be at least 0 and below 1")

    if not noise * float(np.max(np.abs(clean.u))) < 1e300:
        raise InputError(f"noise: {noise!r} is more than a number can hold; take less")

    def disturbed(field: ndarray) -> ndarray:
        sigma = noise_size(field, noise)
        if np.iscomplexobj(field):
            parts = draw.normal(size=(2, *field.shape)) / np.sqrt(2)
            noisy = field + sigma * (parts[0] + 1j * parts[1])
        else:
            noisy = field + sigma * draw.normal(size=field.shape)
        if missing:
            noisy = np.where(draw.uniform(size=field.shape) < missing, np.nan, noisy)
        return np.asarray(noisy)

    return replace(
        clean, u=disturbed(clean.u), v=disturbed(clean.v) if velocities and clean.v is not None else None,
        sigma=noise_size(clean.u, noise), noise=noise,
    )  # fmt: skip
