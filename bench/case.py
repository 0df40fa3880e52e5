"""Running one case: a pure function of its settings, so that any executor can call it.

    case -> samples -> method -> scores -> one result (a dictionary that JSON can hold)

Samples depend on the seed and on what is observed, never on the method, so that all methods see the same ones; the method draws
from a stream of its own.
"""

from __future__ import annotations

import functools
import hashlib
import math
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from latticebench import methods
from latticebench.bench.limit import Limit, bound_of
from latticebench.bench.score import Forecast, forecast, score
from latticebench.bench.suite import Case
from latticebench.methods.engine.regression import Regression, assemble
from latticebench.methods.method import Fit, Skipped, make, solve
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library, System
from latticebench.systems.motion import motion
from latticebench.systems.samples import Samples, SimulatedSamples
from latticebench.systems.simulate import observe, sample_times, simulate

# Points kept of a method's history: enough for a figure, small enough for a store.
MAX_RECORDS = 200
MAX_REASON = 300
# Sites x samples x trajectories up to which the bound takes some seconds at most.
MOST_BOUNDED = 30_000


def run_case(case: Case, base: Path) -> dict[str, Any]:
    """Run a case and give its result; whatever goes wrong becomes its status and reason.

    The runner adds `made`: commit, machine and versions.

    Args:
        case: what to do.
        base: the folder that paths in the case start from.

    Returns:
        `status` is ok, skipped (the method cannot take such data), failed or memory; the keys of `blank` hold the rest.
    """
    result = blank(case)
    try:
        # What a method prints is for people, not for a program that reads the result.
        with _memory_limit(case.memory_limit), redirect_stdout(sys.stderr):
            _fill(result, case, base)
    except Skipped as skipped:
        result.update(status="skipped", reason=str(skipped))
    except MemoryError:
        result.update(status="memory", reason=f"more than {case.memory_limit} MiB of memory were needed")
    except Exception as error:
        memory = "allocate memory" in str(error) or "Unable to allocate" in str(error)
        text = f"{type(error).__name__}: {error}" if not isinstance(error, InputError) else str(error)
        reason = f"more than {case.memory_limit} MiB of memory were needed" if memory else text
        result.update(status="memory" if memory else "failed", reason=reason)
    result["reason"] = " ".join(result["reason"].split())[:MAX_REASON]
    return result


def blank(case: Case, status: str = "ok", reason: str = "") -> dict[str, Any]:
    """Give a result without figures; numbers that are not known are None, infinite errors the text "inf"."""
    return {
        "case": case.model_dump(mode="json"), "status": status, "reason": reason,
        "coefficients": None, "truth": None, "stderr": None, "note": "", "order": None,
        "e2": None, "einf": None, "spurious": None, "tpr": None,
        "forecast_error": None, "forecast_horizon": None, "residual": None, "conditioning": None,
        "bound": None, "bounds": None, "verdicts": None,
        "seconds": None, "cpu_seconds": None, "peak_mib": None, "history": None, "found": {},
    }  # fmt: skip


def _fill(result: dict[str, Any], case: Case, base: Path) -> None:
    system, candidates = case.resolve(base)
    method = make(methods.find(case.method, base), case.settings)
    data = samples(case, base)
    truth = data[0].truth(candidates)
    exact = exact_regression(data, candidates)
    texts = candidates.texts
    result["truth"] = None if truth is None else dict(zip(texts, truth.tolist(), strict=True))
    result["conditioning"] = _plain(conditioning(exact))
    result["order"] = system.order
    _reset_peak()
    fit = solve(method, data, candidates, system.order, seed_of(case.seed, "method"))
    if method.abilities.truth:
        result["note"] = "it was shown the truth"
    result["peak_mib"] = round(_peak_mib(), 1)
    result.update(
        coefficients=dict(zip(texts, fit.coefficients.tolist(), strict=True)),
        stderr=None if fit.stderr is None else dict(zip(texts, map(_plain, fit.stderr), strict=True)),
        note=result["note"] if fit.status == "ok" else fit.status,
        residual=_plain(fit.residual), seconds=round(fit.seconds, 6), cpu_seconds=round(fit.cpu_seconds, 6),
        found={name: value if isinstance(value, str) else _plain(value) for name, value in fit.found.items()},
        history=_history(fit),
    )  # fmt: skip
    if truth is not None:
        found = score(fit.coefficients, truth, exact.scales)
        result.update(e2=_plain(found.e2), einf=_plain(found.einf), spurious=_plain(found.spurious), tpr=found.tpr)
        result.update(_floor(case, base))
    told = _foretell(case, system, candidates, fit)
    result.update(forecast_error=_plain(told.error), forecast_horizon=round(told.horizon, 6))


def _floor(case: Case, base: Path) -> dict[str, Any]:
    """Give E2 at the Cramer-Rao bound, the smallest standard error of each coefficient, and a verdict on it.

    Empty without noise, and where it would take too long.
    """
    system, _ = case.resolve(base)
    # Unknown ends cost as much again: their motion is unknown too.
    work = (case.sites or system.sites) * case.samples * case.trajectories * (1 if case.known_ends else 2)
    if not case.noise or work > MOST_BOUNDED:
        return {}
    try:
        limit = bound(case, base)
    except (InputError, MemoryError, np.linalg.LinAlgError):
        return {}
    texts = limit.library.texts
    return {
        "bound": _plain(limit.relative),
        "bounds": dict(zip(texts, map(_plain, limit.stderr), strict=True)),
        "verdicts": dict(zip(texts, limit.verdicts, strict=True)),
    }


def bound(case: Case, base: Path) -> Limit:
    """Give the Cramer-Rao bound for a case's samples and library.

    Raises:
        InputError: there is no noise, the equation is outside the library, or something is unsound.
    """
    # The noise scales the bound, and its seed matters only where it chooses what is seen.
    seed = case.seed if case.uneven or case.missing > 0 or case.trajectories > 1 else 0
    alike = case.model_copy(
        update={
            "noise": 1.0, "seed": seed, "mirror": False, "label": "", "method": "", "settings": {}, "part": "",
            "time_limit": 1.0, "memory_limit": 1,
        }
    )  # fmt: skip
    return _bound(alike.model_dump_json(), _stamp(case.system, base), base).at(case.noise)


@functools.lru_cache(maxsize=32)
def _bound(text: str, stamp: int, base: Path) -> Limit:  # noqa: ARG001
    case = Case.model_validate_json(text)
    system, candidates = case.resolve(base)
    return bound_of(samples(case, base), candidates, system.order, noise=case.noise)


def seed_of(base: int, *parts: str) -> int:
    """Derive the seed of a stream from the case's seed and what the stream is for."""
    text = "\n".join([str(base), *parts])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


def samples(case: Case, base: Path) -> list[SimulatedSamples]:
    """Make a case's samples; they do not depend on its library or method."""
    clean = _simulated(
        case.system, _stamp(case.system, base), tuple(case.parameters.items()), case.initial, case.sites, case.ends,
        case.integrator, case.samples, case.span, case.uneven, case.trajectories,
        case.seed if case.uneven or case.trajectories > 1 else 0, base,
    )  # fmt: skip
    draw = np.random.default_rng(seed_of(case.seed, "noise"))
    noisy = [observe(one, draw, noise=case.noise, missing=case.missing, velocities=case.velocities) for one in clean]
    if case.known_ends:
        system, _ = case.resolve(base)
        noisy = [replace(one, ends=case.ends or system.ends) for one in noisy]
    return [face for one in noisy for face in ((one, one.mirrored()) if case.mirror else (one,))]


def _stamp(system: str, base: Path) -> int:
    """Renew the memory of simulations when a user's file changes."""
    return (base / system).stat().st_mtime_ns if system.endswith((".py", ".toml")) else 0


@functools.lru_cache(maxsize=16)
def _simulated(
    name: str,
    stamp: int,  # noqa: ARG001
    parameters: tuple[tuple[str, float], ...],
    initial: str | None,
    sites: int | None,
    ends: Any,
    integrator: Any,
    count: int,
    span: float,
    uneven: bool,
    trajectories: int,
    seed: int,
    base: Path,
) -> list[SimulatedSamples]:
    from latticebench import systems

    system = systems.find(name, base)
    made = []
    for trajectory in range(trajectories):
        draw = np.random.default_rng(seed_of(seed, "times", str(trajectory)))
        vary = np.random.default_rng(seed_of(seed, "initial", str(trajectory))) if trajectory else None
        times = sample_times(count, span, draw if uneven else None)
        made.append(
            simulate(
                system,
                parameters=dict(parameters),
                sites=sites,
                times=times,
                ends=ends,
                initial=initial,
                variation=vary,
                integrator=integrator,
            )
        )
    return made


def exact_regression(data: list[SimulatedSamples], candidates: Library) -> Regression:
    """Make the rows of the regression without noise and with the exact derivative."""
    parts = []
    for one in data:
        assert one.exact is not None
        assert one.rate is not None
        whole = Samples(one.t, one.exact.u, one.exact.v, one.f, source=one.source, ends=one.ends)
        parts.append(assemble(whole, candidates, whole.u, whole.v, one.rate))
    return Regression(np.concatenate([p.design for p in parts]), np.concatenate([p.target for p in parts]))


def conditioning(regression: Regression) -> float:
    """Give the ratio of the largest to the smallest singular value of the columns, each scaled to length 1."""
    values = np.linalg.svd(regression.design / regression.scales, compute_uv=False)
    return float(values[0] / values[-1]) if values[-1] > 0 else math.inf


def _foretell(case: Case, system: System, candidates: Library, fit: Fit) -> Forecast:
    start, exact = _unseen(case, system)
    sites = case.sites or system.sites
    return forecast(fit.coefficients, candidates, motion(system, case.parameters, sites, case.ends), start, exact)


def _unseen(case: Case, system: System) -> tuple[np.ndarray, Samples]:
    """Simulate from the state that forecasts start from: near the samples' own, and the same for every method."""
    parameters = tuple(case.parameters.items())
    return _unseen_from(_Hashable(system), parameters, case.initial, case.sites, case.ends, case.span)


class _Hashable:
    """A system as a key of a memory: by its text."""

    def __init__(self, system: System) -> None:
        self.system, self.text = system, repr(system)

    def __hash__(self) -> int:
        return hash(self.text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Hashable) and other.text == self.text


@functools.lru_cache(maxsize=16)
def _unseen_from(
    wrapped: _Hashable,
    parameters: tuple[tuple[str, float], ...],
    initial: str | None,
    sites: int | None,
    ends: Any,
    span: float,
) -> tuple[np.ndarray, Samples]:
    system = wrapped.system
    clean = simulate(
        system, parameters=dict(parameters), sites=sites, ends=ends, initial=initial, integrator="dop853",
        variation=np.random.default_rng(seed_of(0, "forecast")), times=sample_times(100, span),
    )  # fmt: skip
    assert clean.exact is not None
    chain = motion(system, dict(parameters), clean.sites, ends)
    v = None if clean.exact.v is None else clean.exact.v[0]
    return chain.pack(clean.exact.u[0], v), clean.exact


def _history(fit: Fit) -> dict[str, Any] | None:
    if fit.history is None:
        return None
    records = len(fit.history.step)
    kept = np.unique(np.linspace(0, records - 1, min(records, MAX_RECORDS)).round().astype(int))
    return {
        "step": fit.history.step[kept].astype(float).tolist(),
        "seconds": np.round(fit.history.seconds[kept], 4).tolist(),
        "loss": [_plain(value) for value in fit.history.loss[kept]],
        "coefficients": [[float(f"{value:.6g}") for value in row] for row in fit.history.coefficients[kept]],
    }


def _plain(value: float) -> float | str | None:
    """Write a number so that JSON can hold it: NaN as None, infinity as text."""
    value = float(value)
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else ("inf" if value > 0 else "-inf")


@contextmanager
def _memory_limit(mebibytes: int) -> Iterator[None]:
    """Let allocations beyond the limit fail with MemoryError, where the system can (Linux)."""
    if not sys.platform.startswith("linux"):
        yield
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = mebibytes * 2**20
    resource.setrlimit(resource.RLIMIT_DATA, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _reset_peak() -> None:
    """Start the count of the peak memory anew, where the system can (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def _peak_mib() -> float:
    """Give the process's peak memory since the last reset (on Linux) or its start."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    if platform.system() == "Windows":
        import psutil

        return float(getattr(psutil.Process(os.getpid()).memory_info(), "peak_wset", 0)) / 2**20
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 1024)
