"""Samples of a system: integrators, sample times, noise and gaps."""

from __future__ import annotations

import contextlib
import itertools
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from latticebench.systems.arrays import empty, pieces, rows_of
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Integrator, System
from latticebench.systems.motion import Motion, motion
from latticebench.systems.samples import Samples, SimulatedSamples
from latticebench.systems.stencil import Ends, evaluate
from latticebench.systems.terms import Term, substitute

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

PAPER_STEP = 1e-3
MAX_VALUES = 10**9
# Sites up to which a system is integrated as its source does it; the reference is as exact and takes fewer steps.
MOST_AS_SOURCE = 1000
# Evaluations that nobody would wait for, and after how many one looks whether it will come to them.
HOPELESS, TRIED = 10**9, 10**5
# Sample times within one step of an integrator that are interpolated at once.
TOGETHER = 64


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


def states(
    chain: Motion,
    start: Float[ndarray, " state"],
    times: Float[ndarray, " time"],
    method: Integrator = "dop853",
) -> Iterator[Float[ndarray, " state"]]:
    """Yield the states of a chain at `times`, integrated from `start` at times[0].

    `rk4`: the paper's classical Runge-Kutta method of order 4 with steps of about 1e-3 (see `runge_kutta`).
    `bdf`: the paper's implicit backward differentiation formulas of variable order and step (SciPy's BDF) with relative
    and absolute tolerances 1e-9 and 1e-11 and the exact Jacobian.
    `dop853`: the reference, a Runge-Kutta method of order 8 with tolerances 1e-13 (SciPy's DOP853).

    Tolerances are of the root mean square over all sites.

    Raises:
        InputError: the state grows without bound, the integrator gives up, or the motion is hopelessly fast.
    """
    rate = chain.right_hand_side
    if method == "rk4":
        yield from _runge_kutta(rate, start, times, PAPER_STEP)
        return
    options: dict[str, Any] = (
        {"rtol": 1e-9, "atol": 1e-11, "jac": chain.jacobian} if method == "bdf" else {"rtol": 1e-13, "atol": 1e-13}
    )
    reached = 0
    try:
        for state in _adaptive(rate, start, times, method, options):
            reached += 1
            yield state
    except _Exhausted:
        raise InputError(
            f"the motion is too fast: to t = {times[-1]:g} it would take more than {HOPELESS:g} evaluations; "
            "take a shorter span, or slower terms"
        ) from None
    except BREAKS:
        reached = 0
    if reached != len(times):
        raise _unbounded(float(times[max(reached - 1, 0)]))


def integrate(
    chain: Motion,
    start: Float[ndarray, " state"],
    times: Float[ndarray, " time"],
    method: Integrator = "dop853",
) -> Float[ndarray, "state time"]:
    """Return all that `states` yields, a state in each column."""
    return np.stack(list(states(chain, start, times, method)), axis=1)


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
    rate, count = chain.right_hand_side, 0

    def counted(t: float, y: ndarray) -> ndarray:
        nonlocal count
        count += 1
        if count > most_evaluations:
            raise _Exhausted
        return rate(t, y)

    try:
        found = list(_adaptive(counted, start, times, "dop853", {"rtol": tolerance, "atol": tolerance}))
    except BREAKS:
        found = []
    found = found or [np.asarray(start)]
    return np.stack(found, axis=1), len(found)


class _Exhausted(Exception):
    """Raised when the right-hand side has been evaluated too often."""


# What an integrator and a right-hand side fail with where the state becomes too large.
BREAKS = (_Exhausted, FloatingPointError, RuntimeError, ValueError, np.linalg.LinAlgError)


def _adaptive(
    rate: Callable[[float, ndarray], ndarray],
    start: ndarray,
    times: ndarray,
    method: Literal["bdf", "dop853"],
    options: dict[str, Any],
) -> Iterator[ndarray]:
    """Yield the states at `times` that SciPy's integrator finds, as long as they are finite and bounded.

    Raises:
        Exception: one of BREAKS.
    """
    from scipy.integrate import BDF, DOP853

    limit = 1e6 * (1 + float(np.max(np.abs(start))))
    with _quiet():
        solver = (BDF if method == "bdf" else DOP853)(rate, times[0], start, times[-1], **options)
    first = 0
    while first < len(times):
        with _quiet():
            solver.step()
            if solver.status == "failed":
                return
            if solver.nfev > TRIED and solver.nfev * (times[-1] - times[0]) > HOPELESS * (solver.t - times[0]):
                raise _Exhausted
            last = int(np.searchsorted(times, solver.t, side="right"))
            curve: Any = solver.dense_output() if last > first else None
        for some in pieces(last - first, 1, TOGETHER):
            found = curve(times[first + some.start : first + some.stop])
            for state in found.T:
                if not np.all(np.abs(state) < limit):
                    return
                yield state
        if not np.all(np.abs(solver.y) < limit):
            return
        first = last


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Let numbers overflow without a warning."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


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
    return np.stack(list(_runge_kutta(rate, start, times, step)), axis=1)


def _runge_kutta(
    rate: Callable[[float, ndarray], ndarray], start: ndarray, times: ndarray, step: float
) -> Iterator[ndarray]:
    y = np.array(start, dtype=float)
    yield y
    for begin, end in itertools.pairwise(times):
        count = max(1, round((end - begin) / step))
        h = (end - begin) / count
        with np.errstate(all="ignore"):
            for k in range(count):
                t = begin + k * h
                k1 = rate(t, y)
                k2 = rate(t + h / 2, y + h / 2 * k1)
                k3 = rate(t + h / 2, y + h / 2 * k2)
                k4 = rate(t + h, y + h * k3)
                y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if not np.all(np.isfinite(y)):
            raise _unbounded(float(end))
        yield y


def _unbounded(t: float) -> InputError:
    return InputError(
        f"the simulation fails near t = {t:g}: the state grows without bound; check parameters and initial state, "
        "or whether the integrator's step is too large: dop853 chooses its own"
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
        integrator: if None the system's own (the paper's), of more than MOST_AS_SOURCE sites dop853.

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
    if integrator is None:
        integrator = system.integrator if sites <= MOST_AS_SOURCE else "dop853"
    shape, kind = (len(times), sites), complex if system.is_complex else float
    u, highest = empty(shape, kind), empty(shape, kind)
    v = empty(shape, kind) if system.order == 2 else None
    for row, (t, state) in enumerate(zip(times, states(chain, chain.pack(u0, v0), times, integrator), strict=True)):
        du, dv = chain.unpack(chain.right_hand_side(float(t), state))
        u[row], velocity = chain.unpack(state)
        highest[row] = du if dv is None else dv
        if v is not None:
            v[row] = velocity
    listed = ", ".join(f"{name}={value:g}" for name, value in system.with_parameters(parameters).items())
    source = f"{system.name}({listed}), {sites} sites, {len(times)} samples"
    exact = Samples(times, u, v, source=source)
    return SimulatedSamples(
        exact.t, exact.u, exact.v, source=source, sigma=0.0,
        equation=chain.term.text, exact=exact, rate=highest,
    )  # fmt: skip


def drift(system: System, parameters: Mapping[str, float], exact: Samples, ends: Ends | None = None) -> float | None:
    """Return how much of what a system conserves an integrator loses or adds; None if the system conserves nothing.

    It is the largest change of the sum of `System.conserved` over all sites since the first sample, relative to the sum
    of its absolute values there.

    Args:
        system: what moved.
        parameters: values that differ from the system's defaults.
        exact: its motion without noise, with velocities for a second-order system.
        ends: how the chain ended; as the system's if None.
    """
    if not system.conserved:
        return None
    ends = ends or system.ends
    density = Term(substitute(system.conserved, system.with_parameters(parameters)))

    def total(some: slice) -> tuple[ndarray, float]:
        v = None if exact.v is None else exact.v[some]
        values = evaluate([density], exact.u[some], v, None, exact.t[some], ends=ends)[0, 0]
        return np.sum(values, axis=1), float(np.sum(np.abs(values[0])))

    (start,), size = total(slice(0, 1))
    changes = [float(np.max(np.abs(total(some)[0] - start))) for some in rows_of(exact.u)]
    return max(changes) / (size or 1.0)


def noise_size(field: ndarray, level: float) -> float:
    """Return the standard deviation of a noise level: level x RMS of the field about its mean."""
    mean = sum(np.sum(field[some]) for some in rows_of(field)) / field.size
    return float(level * np.sqrt(sum(np.sum(np.abs(field[some] - mean) ** 2) for some in rows_of(field)) / field.size))


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

    if not noise * max(float(np.max(np.abs(clean.u[some]))) for some in rows_of(clean.u)) < 1e300:
        raise InputError(f"noise: {noise!r} is more than a number can hold; take less")

    def disturbed(field: ndarray) -> ndarray:
        if not noise and not missing:
            return field
        sigma, noisy = noise_size(field, noise), empty(field.shape, field.dtype)
        is_complex = np.iscomplexobj(field)
        parts = [(noisy.real, field.real), (noisy.imag, field.imag)] if is_complex else [(noisy, field)]
        for result, exact in parts:
            for some in rows_of(field):
                error = draw.normal(size=exact[some].shape) / (np.sqrt(2) if is_complex else 1.0)
                result[some] = exact[some] + sigma * error
        for some in rows_of(field) if missing else ():
            noisy[some][draw.uniform(size=field[some].shape) < missing] = np.nan
        return noisy

    return replace(
        clean, u=disturbed(clean.u), v=disturbed(clean.v) if velocities and clean.v is not None else None,
        sigma=noise_size(clean.u, noise), noise=noise,
    )  # fmt: skip
