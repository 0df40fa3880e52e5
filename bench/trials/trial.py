"""Trials as cases: a recording made with a known effect is diagnosed, and the diagnosis judged by what was put in."""

from __future__ import annotations

import itertools
import time
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from latticebench import systems
from latticebench.bench.axes import Listed, Seeds
from latticebench.bench.case import Case, Folders, Roots, Seed, Settings, code_file, plain
from latticebench.bench.trials import faults, specimen
from latticebench.bench.trials.specimen import Conditions, Specimen
from latticebench.diagnosis.repair import Diagnosis, diagnose, shortfalls
from latticebench.methods.method import Skipped
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.files import check_regular
from latticebench.systems.lattice import System

# A recording whose effect could not be given its size (it is as good as invisible) is no trial.
OFF_SIZE = 0.2
OWN_SIZE = tuple(name for name, fault in faults.FAULTS.items() if not fault.sized)
KNOWN = tuple(effect.name for effect in CATALOGUE)
GROUPS = {
    "catalogue": KNOWN, "outside": tuple(faults.OTHERS), "blind": tuple(faults.BLIND),
    "second-blind": tuple(faults.SECOND_BLIND), "third-blind": tuple(faults.THIRD_BLIND),
    "fourth-blind": tuple(faults.FOURTH_BLIND), "fifth-blind": tuple(faults.FIFTH_BLIND),
}  # fmt: skip
TIME_LIMIT = 1800.0


class Trial(Case):
    """The diagnosis of a recording with one effect, or with two that have a + between them, of one size.

    Attributes:
        system: its equation is declared.
        effect: what the recording has and the equation lacks; "none" for nothing.
        z: the size of the effect over the smallest standard error that it could be known with.
        noise: its standard deviation over the RMS of the field about its mean.
        sites, samples: how many.
        velocities: whether they are observed.
        seed: chooses the place of the effect, its times and frequencies, the initial state and the noise.
    """

    kind: Literal["trial"] = "trial"
    system: str
    effect: str
    z: Annotated[float, pydantic.Field(ge=0, allow_inf_nan=False)] = 0.0
    noise: Annotated[float, pydantic.Field(ge=0, allow_inf_nan=False)] = 0.01
    seed: Seed = 1
    sites: pydantic.PositiveInt = 25
    samples: Annotated[int, pydantic.Field(ge=2)] = 50
    velocities: bool = True
    time_limit: Annotated[float, pydantic.Field(gt=0, allow_inf_nan=False)] = TIME_LIMIT

    @property
    def title(self) -> str:
        """The system, effect, size, noise and seed in one line."""
        only = "" if self.velocities else " only u"
        return f"{self.system} noise={self.noise:g}{only} | {self.effect} z={self.z:g} | seed {self.seed}"

    @property
    def roots(self) -> Roots:
        """The diagnosis and the system."""
        return Roots(__name__, system=self.system)

    def blank(self) -> dict[str, Any]:
        """Return the names of a result's content; see `run`."""
        return {
            "size": None, "apart": None, "about": None, "verdict": None, "partly": None, "named": None, "alike": None,
            "right": None, "extra": None, "noise_found": None, "noise_true": None, "residual_before": None,
            "residual_after": None, "forecast_before": None, "forecast_after": None, "coefficients_before": None,
            "coefficients_after": None, "seconds": None, "cpu_seconds": None,
        }  # fmt: skip

    def run(self, folders: Folders, found: dict[str, Any]) -> None:
        """Make the recording, diagnose it, and judge whether the diagnosis is right; see `Case.run`."""
        system = systems.find(self.system, folders.suite)
        declared = system.library("equation")
        one = self.recording(system)
        wall, cpu = time.perf_counter(), time.process_time()
        data = [replace(one.samples, ends=system.ends)]
        diagnosis = diagnose(declared, system.order, data, CATALOGUE).against(system.truth(declared, {}))
        found.update(seconds=time.perf_counter() - wall, cpu_seconds=time.process_time() - cpu)
        found.update(size=one.z, apart=one.apart, about=dict(one.about), **_errors(diagnosis, one.samples.sigma))
        named = [one.name for one in diagnosis.findings]
        alike = [list(one.alternatives) for one in diagnosis.findings]
        wanted = wanted_names(self.effect)
        found.update(
            verdict=diagnosis.verdict, partly=list(shortfalls(diagnosis)), named=named, alike=alike,
            right=is_right(self.effect, named, alike, diagnosis.verdict),
            extra=max(len(named) - max(len(wanted), 1), 0) if wanted else len(named),
        )  # fmt: skip

    def recording(self, system: System) -> Specimen:
        """Make the recording.

        Raises:
            Skipped: there is no such effect in this system, or it could not be given the size.
        """
        draw = np.random.default_rng([self.seed, zlib.crc32(self.effect.encode())])
        try:
            conditions = Conditions(
                sites=self.sites, samples=self.samples, noise=self.noise, velocities=self.velocities, variation=True
            )
            one = specimen.make(system, self.effect, self.z, draw, conditions)
        except InputError as error:
            raise Skipped(str(error)) from None
        if self.effect != faults.NONE and self.effect not in OWN_SIZE and abs(one.z / self.z - 1) > OFF_SIZE:
            raise Skipped(f"{self.effect} could not be given the size {self.z:g}: it came out as {one.z:.3g}")
        return one


class Made(Settings):
    """A block of trials in a suite: every combination of the lists is one.

    Attributes:
        effects: names; "a+b" for two at once, "none" for none, "catalogue" for all of the catalogue that make sense in
            the system, "outside", "blind", "second-blind", ... for faults outside it.
    """

    part: str = ""
    effects: Listed[str]
    systems: Listed[str]
    noise: Listed[float] = [0.01]
    z: Listed[float] = [0.0]
    seeds: Seeds = [1]
    sites: int = 25
    samples: int = 50
    velocities: bool = True
    time_limit: float = TIME_LIMIT
    memory_limit: int = 4096

    def cases(self, where: str, base: Path = Path()) -> Iterator[Trial]:
        """Return every combination.

        Args:
            where: the place of the block, for errors.
            base: the folder that relative paths start from.

        Raises:
            InputError: a system or an effect is unknown.
        """
        for system in self.systems:
            effects = _effects(self.effects, _known(system, base, where), where)
            for noise, z, effect, seed in itertools.product(self.noise, self.z, effects, self.seeds):
                yield Trial(
                    system=system, effect=effect, z=z, noise=noise, seed=seed, sites=self.sites, samples=self.samples,
                    velocities=self.velocities, part=self.part, time_limit=self.time_limit,
                    memory_limit=self.memory_limit,
                )  # fmt: skip


def _known(name: str, base: Path, where: str) -> System | None:
    """Return a system, or None for a Python file of the user's, whose code runs in the workers alone."""
    try:
        path = code_file(name)
        if path is None:
            found = systems.find(name, base)
            found.library("equation")
            return found
        check_regular(base / path)
    except InputError as error:
        raise InputError(f"{where}: systems: {error}") from None
    return None


def _effects(names: list[str], found: System | None, where: str) -> list[str]:
    """Return names of effects with each group written out as those that make sense in a system."""
    known = [faults.NONE, *KNOWN, *faults.OTHERS]
    effects: list[str] = []
    for name in names:
        if name in GROUPS:
            if found is None:
                raise InputError(f"{where}: effects: {name!r}: write out those that make sense in a system of your own")
            effects += [one for one in GROUPS[name] if faults.sensible(one, found)]
            continue
        for part in name.split("+"):
            if part not in known:
                raise unknown("effect", part, known, where)
        effects.append(name)
    return effects


def wanted_names(effect: str) -> list[str]:
    """Return the effects that a right diagnosis names: none where nothing is missing, or nothing that has a name."""
    return [] if effect == faults.NONE or effect in faults.OTHERS else effect.split("+")


def is_right(effect: str, named: list[str], alike: list[list[str]], verdict: str) -> bool:
    """Return whether the effect was named first or in the first group, of at most two; two effects in either order.

    Without an effect nothing may be named; one from outside the catalogue must be seen, and not be explained.
    """
    if effect in faults.OTHERS:
        return verdict in ("unexplained", "partly explained")
    wanted = wanted_names(effect)
    if not wanted:
        return not named
    groups = [{name, *others} if len(others) <= 1 else {name} for name, others in zip(named, alike, strict=True)]
    if len(groups) < len(wanted):
        return False
    return any(
        all(want in group for want, group in zip(order, groups, strict=False))
        for order in itertools.permutations(wanted)
    )


def _errors(found: Diagnosis, sigma: float | None) -> dict[str, Any]:
    """Return the errors before and after; the noise is that of u, of a complex field that of both parts together.

    A forecast that runs away is infinite.
    """
    first = found.data[0]
    parts = np.sqrt(2) if first.is_complex else 1.0
    errors = {
        "noise_found": float(parts * np.sqrt(np.nanmean(found.noise[: first.sites] ** 2))), "noise_true": sigma,
        "residual_before": found.residual[0], "residual_after": found.residual[1],
        "forecast_before": found.forecast[0], "forecast_after": found.forecast[1],
        "coefficients_before": None if found.coefficients is None else found.coefficients[0],
        "coefficients_after": None if found.coefficients is None else found.coefficients[1],
    }  # fmt: skip
    return {name: None if value is None else plain(float(value)) for name, value in errors.items()}
