"""Fits as cases: simulated samples, a library and a method; the fit is scored against the truth.

    case -> samples -> method -> scores

Samples depend on the seed and on what is observed, never on the method, so that all methods see the same ones; the
method draws from a stream of its own.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from latticebench import methods, systems
from latticebench.bench.case import Case, Folders, Number, Roots, Seed, plain
from latticebench.bench.limit import Limit, bound_of
from latticebench.bench.memory import peak_mib, reset_peak
from latticebench.bench.score import Forecast, forecast, score
from latticebench.methods.engine.regression import Regression, assemble
from latticebench.methods.method import Fit, make, solve
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library, System, library
from latticebench.systems.motion import motion
from latticebench.systems.samples import Samples, SimulatedSamples
from latticebench.systems.simulate import observe, sample_times, simulate

# Points kept of a method's history: enough for a figure, small enough for a store.
MAX_RECORDS = 200
# Sites x samples x trajectories up to which the bound takes some seconds at most.
MOST_BOUNDED = 30_000

Known = Literal["free", "fixed", "periodic", "antiperiodic"]


class FitCase(Case):
    """One method's fit of one library to one set of simulated samples.

    Attributes:
        system, parameters, initial, sites, ends, integrator: what moves; None stands for the system's own.
        samples, span, uneven, velocities, trajectories, noise, missing: how it is observed.
        known_ends: whether the method is told how the chain ends.
        mirror: show the samples of -u, too, as a further trajectory.
        seed: chooses noise, gaps and uneven times (the same for every method) and, apart from that, the method's draws.
        library: its name.
        terms: the library's terms, where they are not one of the system's.
        label, method, settings: who fits it.
    """

    kind: Literal["fit"] = "fit"
    system: str
    parameters: dict[str, Number] = {}
    initial: str | None = None
    sites: pydantic.PositiveInt | None = None
    ends: Known | None = None
    integrator: Literal["rk4", "bdf", "dop853"] | None = None
    samples: Annotated[int, pydantic.Field(ge=2)] = 50
    span: Annotated[float, pydantic.Field(gt=0, allow_inf_nan=False)] = 10.0
    uneven: bool = False
    velocities: bool = True
    known_ends: bool = False
    trajectories: pydantic.PositiveInt = 1
    noise: Annotated[float, pydantic.Field(ge=0, allow_inf_nan=False)] = 0.0
    missing: Annotated[float, pydantic.Field(ge=0, lt=1)] = 0.0
    mirror: bool = False
    seed: Seed = 1
    library: str
    terms: tuple[str, ...] = ()
    label: str
    method: str
    settings: dict[str, Any] = {}

    @property
    def data(self) -> str:
        """The data that the case is about in a few words, without its library and method."""
        return described(self.model_dump())

    @property
    def title(self) -> str:
        """The data, library, method and seed in one line."""
        return f"{self.data} | {self.library} | {self.label} | seed {self.seed}"

    @property
    def roots(self) -> Roots:
        """The method and the system, and how a fit is made and scored."""
        return Roots(__name__, method=self.method, system=self.system)

    def resolve(self, base: Path) -> tuple[System, Library]:
        """Look the system and the library up.

        Raises:
            InputError: one of them does not exist.
        """
        system = systems.find(self.system, base)
        return system, (library(self.library, self.terms) if self.terms else system.library(self.library))

    def blank(self) -> dict[str, Any]:
        """Return the names of a result's content; of its numbers, unknown ones are None, infinite ones texts."""
        return {
            "coefficients": None, "truth": None, "stderr": None, "note": "", "order": None,
            "e2": None, "einf": None, "spurious": None, "tpr": None,
            "forecast_error": None, "forecast_horizon": None, "residual": None, "conditioning": None,
            "bound": None, "bounds": None, "verdicts": None,
            "seconds": None, "cpu_seconds": None, "peak_mib": None, "history": None, "found": {},
        }  # fmt: skip

    def run(self, folders: Folders, found: dict[str, Any]) -> None:
        """Fit, and score the fit against the truth; see `Case.run`."""
        base = folders.suite
        system, candidates = self.resolve(base)
        method = make(methods.find(self.method, folders.methods), self.settings)
        data = samples(self, base)
        truth = data[0].truth(candidates)
        exact = exact_regression(data, candidates)
        texts = candidates.texts
        found["truth"] = None if truth is None else dict(zip(texts, truth.tolist(), strict=True))
        found["conditioning"] = plain(conditioning(exact))
        found["order"] = system.order
        reset_peak()
        fit = solve(method, data, candidates, system.order, seed_of(self.seed, "method"))
        if method.abilities.truth:
            found["note"] = "it was shown the truth"
        found["peak_mib"] = round(peak_mib(), 1)
        found.update(
            coefficients=dict(zip(texts, fit.coefficients.tolist(), strict=True)),
            stderr=None if fit.stderr is None else dict(zip(texts, map(plain, fit.stderr), strict=True)),
            note=found["note"] if fit.status == "ok" else fit.status,
            residual=plain(fit.residual), seconds=round(fit.seconds, 6), cpu_seconds=round(fit.cpu_seconds, 6),
            found={name: value if isinstance(value, str) else plain(value) for name, value in fit.found.items()},
            history=_history(fit),
        )  # fmt: skip
        if truth is not None:
            scored = score(fit.coefficients, truth, exact.scales)
            found.update(e2=plain(scored.e2), einf=plain(scored.einf), spurious=plain(scored.spurious), tpr=scored.tpr)
            found.update(_floor(self, base))
        told = _foretell(self, system, candidates, fit)
        found.update(forecast_error=plain(told.error), forecast_horizon=round(told.horizon, 6))


# What `described` names where it is not the default, and what it says of settings that are not the usual ones.
TOLD = {
    name: FitCase.model_fields[name].default
    for name in ("initial", "sites", "ends", "integrator", "samples", "span", "noise", "missing", "trajectories")
}
UNUSUAL = {
    "uneven": (True, "uneven"),
    "velocities": (False, "only u"),
    "known_ends": (True, "known ends"),
    "mirror": (True, "with -u"),
}


def described(case: Mapping[str, Any]) -> str:
    """Return in a few words which data a case is about, without its library and method.

    Args:
        case: a `FitCase` as a dictionary.
    """
    parts = [case["system"], *(f"{name}={value:g}" for name, value in case["parameters"].items())]
    for name, default in TOLD.items():
        value = case[name]
        if value != default:
            shown = f"{value:g}" if isinstance(value, float) else str(value)
            parts.append(shown if name == "initial" else f"{name}={shown}")
    return " ".join([*parts, *(word for name, (value, word) in UNUSUAL.items() if case[name] is value)])


def _floor(case: FitCase, base: Path) -> dict[str, Any]:
    """Return E2 at the Cramer-Rao bound, the smallest standard error of each coefficient, and a verdict on it.

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
        "bound": plain(limit.relative),
        "bounds": dict(zip(texts, map(plain, limit.stderr), strict=True)),
        "verdicts": dict(zip(texts, limit.verdicts, strict=True)),
    }


def bound(case: FitCase, base: Path) -> Limit:
    """Return the Cramer-Rao bound for a case's samples and library.

    Raises:
        InputError: there is no noise, the equation is outside the library, or something is unsound.
    """
    # The noise scales the bound, and its seed matters only where it chooses what is seen.
    seed = case.seed if case.uneven or case.missing > 0 or case.trajectories > 1 else 0
    counts = {name: getattr(case, name) for name in ("library", "terms", "missing", "velocities", "known_ends")}
    alike = case.model_copy(update={**UNSEEN, **counts, "noise": 1.0, "seed": seed})
    return _bound(alike.model_dump_json(), _stamp(case.system, base), base).at(case.noise)


@functools.lru_cache(maxsize=32)
def _bound(text: str, stamp: int, base: Path) -> Limit:  # noqa: ARG001
    case = FitCase.model_validate_json(text)
    system, candidates = case.resolve(base)
    return bound_of(samples(case, base), candidates, system.order, noise=case.noise)


def seed_of(base: int, *parts: str) -> int:
    """Derive the seed of a stream from the case's seed and what the stream is for."""
    text = "\n".join([str(base), *parts])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")


# Settings without a part in a simulation, with the values that stand for all others.
UNSEEN: dict[str, Any] = {
    "part": "", "library": "", "terms": (), "label": "", "method": "", "settings": {}, "time_limit": 1.0,
    "memory_limit": 1, "noise": 0.0, "missing": 0.0, "velocities": True, "mirror": False, "known_ends": False,
}  # fmt: skip


def samples(case: FitCase, base: Path) -> list[SimulatedSamples]:
    """Make a case's samples; they do not depend on its library or method."""
    # The seed of the noise is no part of a simulation.
    seed = case.seed if case.uneven or case.trajectories > 1 else 0
    alike = case.model_copy(update={**UNSEEN, "seed": seed})
    clean = _simulated(alike.model_dump_json(), _stamp(case.system, base), base)
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
def _simulated(text: str, stamp: int, base: Path) -> list[SimulatedSamples]:  # noqa: ARG001
    case = FitCase.model_validate_json(text)
    system = systems.find(case.system, base)
    made = []
    for trajectory in range(case.trajectories):
        draw = np.random.default_rng(seed_of(case.seed, "times", str(trajectory)))
        vary = np.random.default_rng(seed_of(case.seed, "initial", str(trajectory))) if trajectory else None
        one = simulate(
            system, parameters=case.parameters, sites=case.sites,
            times=sample_times(case.samples, case.span, draw if case.uneven else None),
            ends=case.ends, initial=case.initial, variation=vary, integrator=case.integrator,
        )  # fmt: skip
        made.append(one)
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
    """Return the ratio of the largest to the smallest singular value of the columns, each scaled to length 1."""
    values = np.linalg.svd(regression.design / regression.scales, compute_uv=False)
    return float(values[0] / values[-1]) if values[-1] > 0 else math.inf


def _foretell(case: FitCase, system: System, candidates: Library, fit: Fit) -> Forecast:
    start, exact = _unseen(case, system)
    sites = case.sites or system.sites
    return forecast(fit.coefficients, candidates, motion(system, case.parameters, sites, case.ends), start, exact)


def _unseen(case: FitCase, system: System) -> tuple[np.ndarray, Samples]:
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
    kept = fit.history.thinned(MAX_RECORDS)
    return {
        "step": kept.step.astype(float).tolist(),
        "seconds": np.round(kept.seconds, 4).tolist(),
        "loss": [plain(value) for value in kept.loss],
        "coefficients": [[float(f"{value:.6g}") for value in row] for row in kept.coefficients],
    }
