"""Suites of diagnoses: recordings made with a known fault, and measured ones.

A suite file (TOML) has a `title` and any number of tables

    [[made]]                       # every combination of the lists is a trial
    effects = ["catalogue"]        # names; "catalogue": all that make sense; "outside", "blind", "second-blind", "third-blind", "fourth-blind", "fifth-blind": faults that are none of it; "none"; "a+b": two at once
    systems = ["phi4"]
    noise = [0.01]
    z = [5, 10, 30]
    seeds = [1]

    [[measured]]                   # one recording
    name = "gliders"
    file = "gliders.csv"
    terms = "u[n+1]+u[n-1]-2*u[n]; u[n]"
    order = 2
    ends = "fixed"

Each trial's result is a JSON file in the folder of the run, named by a hash of its settings and of the source that computes it, so that
a run continues where it was stopped.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import pydantic
from threadpoolctl import threadpool_limits

from latticebench import systems
from latticebench.bench.provenance import origin
from latticebench.bench.trials import faults, specimen
from latticebench.bench.trials.specimen import Specimen
from latticebench.diagnosis.model import Change
from latticebench.diagnosis.repair import Diagnosis, diagnose, polish
from latticebench.diagnosis.residual import alike, forecast, pooled
from latticebench.diagnosis.tangent import linearise
from latticebench.diagnosis.ways import ways
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.files import write_text
from latticebench.systems.lattice import library
from latticebench.systems.readers import read
from latticebench.systems.stencil import Ends
from latticebench.systems.toml import read_toml

if TYPE_CHECKING:
    from collections.abc import Mapping

HERE = Path(__file__).parent / "suites"
# A recording whose effect could not be given its size (it is as good as invisible) is no trial.
OFF_SIZE = 0.2
OWN_SIZE = tuple(name for name, fault in faults.FAULTS.items() if not fault.sized)
KNOWN = tuple(effect.name for effect in CATALOGUE)
GROUPS = {
    "catalogue": KNOWN, "outside": tuple(faults.OTHERS), "blind": tuple(faults.BLIND), "second-blind": tuple(faults.SECOND_BLIND),
    "third-blind": tuple(faults.THIRD_BLIND), "fourth-blind": tuple(faults.FOURTH_BLIND),
    "fifth-blind": tuple(faults.FIFTH_BLIND),
}  # fmt: skip


class _Model(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class Made(_Model):
    """A recording to be made: one system, one effect (or two with a + between them) of one size."""

    system: str
    effect: str
    z: float = 0.0
    noise: float = 0.01
    seed: int = 1
    sites: int = 25
    samples: int = 50
    velocities: bool = True


class Measured(_Model):
    """A recording to be read, with the equation that is declared for it."""

    name: str
    about: str
    file: str
    rows: tuple[int, int] | None = None
    terms: str
    order: Literal[1, 2]
    ends: Ends = "unknown"


Trial = Made | Measured


class _Grid(_Model):
    effects: list[str]
    systems: list[str]
    noise: list[float] = [0.01]
    z: list[float] = [0.0]
    seeds: list[Annotated[int, pydantic.Field(ge=0)]] = [1]
    sites: int = 25
    samples: int = 50
    velocities: bool = True


class _File(_Model):
    title: str = ""
    made: list[_Grid] = []
    measured: list[Measured] = []


def names() -> list[str]:
    """Name the suites of diagnoses."""
    return sorted(path.stem for path in HERE.glob("*.toml"))


def is_suite(name: str) -> bool:
    """Say whether a name or a TOML file is a suite of diagnoses."""
    if not name.endswith(".toml"):
        return name in names()
    return bool({"made", "measured"} & set(read_toml(Path(name)))) if Path(name).is_file() else False


def load(name: str) -> tuple[str, list[Trial]]:
    """Load a suite by its name, or from a TOML file: its title and trials.

    Raises:
        InputError: it is unknown or unsound; the text names the file and the key.
    """
    path = Path(name) if name.endswith(".toml") else HERE / f"{name}.toml"
    if not name.endswith(".toml") and name not in names():
        raise unknown("suite", name, names())
    try:
        file = _File.model_validate(read_toml(path))
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{path}: {place}: {first['msg'][0].lower()}{first['msg'][1:]}") from None
    trials: list[Trial] = [trial for grid in file.made for trial in _expand(grid, str(path))]
    return file.title, [*trials, *file.measured]


def _expand(grid: _Grid, where: str) -> Iterator[Made]:
    known = [faults.NONE, *KNOWN, *faults.OTHERS]
    for system in grid.systems:
        found = systems.find(system)
        effects: list[str] = []
        for name in grid.effects:
            if name in GROUPS:
                pool = GROUPS[name]
                effects += [one for one in pool if faults.sensible(one, found)]
                continue
            for part in name.split("+"):
                if part not in known:
                    raise unknown("effect", part, known, where)
            effects.append(name)
        for noise, z, effect, seed in itertools.product(grid.noise, grid.z, effects, grid.seeds):
            yield Made(
                system=system, effect=effect, z=z, noise=noise, seed=seed, sites=grid.sites, samples=grid.samples,
                velocities=grid.velocities,
            )  # fmt: skip


def key(trial: Trial) -> str:
    """Give the name under which a trial's result is kept."""
    root = Path(__file__).resolve().parents[2]
    source = hashlib.sha256()
    for folder in ("systems", "methods", "diagnosis", "bench/trials"):
        for path in sorted((root / folder).rglob("*.py")):
            if path.name not in ("report.py", "trial.py"):
                source.update(path.read_bytes())
    return hashlib.sha256(f"{trial.model_dump_json()}\n{source.hexdigest()}".encode()).hexdigest()[:32]


def run(
    trials: Sequence[Trial],
    folder: Path,
    *,
    jobs: int = 1,
    data: Path | None = None,
    watcher: Callable[[], None] = lambda: None,
) -> list[dict[str, Any]]:
    """Run what is not there yet, in `jobs` processes; give all results in the order of the trials.

    Args:
        trials: of a suite.
        folder: where results are kept.
        jobs: processes.
        data: the folder of measured recordings.
        watcher: is called after each trial.
    """
    import joblib

    folder.mkdir(parents=True, exist_ok=True)
    made = origin()
    places = [folder / f"{key(trial)}.json" for trial in trials]
    missing = [(trial, place) for trial, place in zip(trials, places, strict=True) if not place.is_file()]
    for _ in range(len(trials) - len(missing)):
        watcher()
    work = (joblib.delayed(_keep)(trial, place, data, made) for trial, place in missing)
    for _ in joblib.Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1)(work):
        watcher()
    return [json.loads(place.read_text(encoding="utf-8")) for place in places]


def _keep(trial: Trial, place: Path, data: Path | None, made: Mapping[str, Any]) -> None:
    """Run one trial and write its result down, a failure too."""
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        row = _made(trial) if isinstance(trial, Made) else _measured(trial, data)
    except InputError as error:
        row = {"status": "skipped", "message": str(error)}
    except Exception as error:
        row = {"status": "failed", "message": f"{type(error).__name__}: {error}"}
    row.setdefault("status", "ok")
    row.setdefault("seconds", time.perf_counter() - wall)
    row.setdefault("cpu_seconds", time.process_time() - cpu)
    write_text(place, json.dumps({**trial.model_dump(), **row, "made": made}, indent=1) + "\n")


def _made(trial: Made) -> dict[str, Any]:
    """Make a recording, diagnose it, and say whether the diagnosis is right."""
    system = systems.find(trial.system)
    draw = np.random.default_rng([trial.seed, zlib.crc32(trial.effect.encode())])
    one = specimen.make(
        system, trial.effect, trial.z, draw, sites=trial.sites, samples=trial.samples, noise=trial.noise,
        velocities=trial.velocities, variation=True,
    )  # fmt: skip
    if trial.effect != faults.NONE and trial.effect not in OWN_SIZE and abs(one.z / trial.z - 1) > OFF_SIZE:
        raise InputError(f"{trial.effect} could not be given the size {trial.z:g}: it came out as {one.z:.3g}")
    declared = system.library("equation")
    wall, cpu = time.perf_counter(), time.process_time()
    found = diagnose(
        declared, system.order, [replace(one.samples, ends=system.ends)], CATALOGUE, trial.seed,
        truth=system.truth(declared, {}),
    )  # fmt: skip
    seconds, cpu = time.perf_counter() - wall, time.process_time() - cpu
    own = _forecast_of_truth(one, found) if trial.effect in KNOWN else None
    named = [change.effect.name for change in found.course.after.model.changes]
    wanted = [] if trial.effect == faults.NONE or trial.effect in faults.OTHERS else trial.effect.split("+")
    alike = [list(names) for names in found.course.equal]
    return {
        "size": one.z, "apart": one.apart, "about": dict(one.about), "verdict": found.course.verdict, "named": named, "alike": alike,
        "right": is_right(wanted, named, alike, found.course.verdict, trial.effect),
        "extra": max(len(named) - max(len(wanted), 1), 0) if wanted else len(named),
        **_errors(found, one.samples.sigma), "forecast_true": own, "seconds": seconds, "cpu_seconds": cpu,
    }  # fmt: skip


def _forecast_of_truth(one: Specimen, found: Diagnosis) -> float | None:
    """Give the error of forecasts by the true model, fitted to the same data; None where it cannot be set up.

    Its effect is put at the place and with the frequency, delay and so on that it was made with; these and its coefficients are then fitted.
    """
    course = found.course
    before = alike(course.before, course.after)
    near = [way.change for way in ways(linearise(before), find(one.effect)) if not way.change.as_force]
    if not near:
        return None

    def distance(change: Change) -> tuple[Any, ...]:
        away = sum(abs(value - one.about[name]) for name, value in change.psi.items() if name in one.about)
        place = change.site not in (None, int(one.about["site"]))
        # What was made has faults of u and v alike, jitter rather than a slow clock, and these other ends.
        return place, change.site is None, change.ends != one.ends, not change.both, away, -len(change.psi)

    chosen = min(near, key=distance)
    true = chosen.moved({name: float(one.about[name]) for name in chosen.psi if name in one.about})
    with threadpool_limits(1):
        fitted = polish(before.model.with_change(true), before)
        return None if fitted is None else pooled(forecast(fitted))


def is_right(wanted: list[str], named: list[str], alike: list[list[str]], verdict: str, effect: str) -> bool:
    """Whether the effect was named first or in the first group, of at most two; two effects in either order.

    Without an effect nothing may be named; one from outside the catalogue must be seen, and not be explained.
    """
    if effect in faults.OTHERS:
        return verdict in ("unexplained", "partly explained")
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
    parts = np.sqrt(2) if found.course.after.data[0].is_complex else 1.0
    return {
        "noise_found": float(found.noise[0] * parts), "noise_true": sigma,
        "residual_before": found.residual[0], "residual_after": found.residual[1],
        "forecast_before": found.forecast[0], "forecast_after": found.forecast[1],
        "coefficients_before": None if found.coefficients is None else found.coefficients[0],
        "coefficients_after": None if found.coefficients is None else found.coefficients[1],
    }  # fmt: skip


def _measured(trial: Measured, data: Path | None) -> dict[str, Any]:
    """Diagnose a measured recording."""
    from latticebench.bench.report.report import content

    path = (data or Path()) / trial.file
    samples = read(path, trial.ends)
    if trial.rows is not None:
        begin, end = trial.rows
        samples = [
            replace(
                one, t=one.t[begin:end], u=one.u[begin:end], v=None if one.v is None else one.v[begin:end],
                f=None if one.f is None else one.f[begin:end],
            )
            for one in samples
        ]  # fmt: skip
    found = diagnose(library("declared", trial.terms), trial.order, samples, CATALOGUE)
    return {"sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "report": content(found)}
