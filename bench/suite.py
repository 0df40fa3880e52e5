"""Suites: named matrices of cases, written in TOML.

    title = "what it is for"

    [methods.stlsq]                 # a label; any number of variants of one method
    method = "stlsq"                # a name, or FILE.py of a user's own
    settings = { threshold = 0.05 }

    [defaults]                      # any key of a grid
    noise = [0.0, 0.01]
    seeds = [1, 2, 3]               # or "1-100"

    [[grid]]                        # every combination of the lists is a case
    system = "phi4"                 # a name, or FILE.py / FILE.toml
    parameters = { C = [0.5, 2.0] }
    libraries = ["lib1", "lib2"]

Paths are relative to the suite file.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from latticebench import methods, systems
from latticebench.bench.source import fingerprint
from latticebench.methods.method import make
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.lattice import Library, System, library
from latticebench.systems.toml import read_toml

HERE = Path(__file__).parent / "suites"
MOST_SEEDS = 10_000

Number = Annotated[float, pydantic.Field(allow_inf_nan=False)]
Known = Literal["free", "fixed", "periodic", "antiperiodic"]


class _Model(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class Case(_Model):
    """One cell of the matrix: everything that decides its result, and nothing else.

    Attributes:
        system, parameters, initial, sites, ends, integrator: what moves; None stands for the system's own.
        samples, span, uneven, velocities, trajectories, noise, missing: how it is observed.
        seed: chooses noise, gaps and uneven times (the same for every method) and, apart from that, the method's draws.
        library: its name.
        terms: the library's terms, where they are not one of the system's.
        mirror: show the samples of -u, too, as a further trajectory.
        label, method, settings: who fits it.
        part: the part of the suite that it belongs to, such as a panel of a figure.
        time_limit: seconds; memory_limit: MiB.
    """

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
    seed: pydantic.NonNegativeInt = 1
    library: str
    terms: tuple[str, ...] = ()
    label: str
    method: str
    settings: dict[str, Any] = {}
    part: str = ""
    time_limit: pydantic.PositiveFloat = 120.0
    memory_limit: pydantic.PositiveInt = 4096

    @property
    def identity(self) -> str:
        """The settings that decide the result, as text in a fixed order: what two runs of one case have in common."""
        content = self.model_dump(
            mode="json", exclude={"label", "part", "time_limit", "memory_limit"}, exclude_defaults=True
        )
        return json.dumps(content, sort_keys=True)

    @property
    def data(self) -> str:
        """Say in a few words which data the case is about, without its library and method."""
        parts = [f"{name}={value:g}" for name, value in self.parameters.items()]
        plain = self.__class__.model_construct()
        for name in ("initial", "sites", "ends", "integrator", "samples", "span", "noise", "missing", "trajectories"):
            value = getattr(self, name)
            if value != getattr(plain, name):
                parts.append(
                    str(value)
                    if name == "initial"
                    else f"{name}={value:g}"
                    if isinstance(value, float)
                    else f"{name}={value}"
                )
        parts += [
            word
            for word, said in (
                ("uneven", self.uneven),
                ("only u", not self.velocities),
                ("known ends", self.known_ends),
                ("with -u", self.mirror),
            )
            if said
        ]
        return " ".join([self.system, *parts])

    @property
    def title(self) -> str:
        """Say in a line which case it is."""
        return f"{self.data} | {self.library} | {self.label} | seed {self.seed}"

    def key(self, base: Path) -> str:
        """Give the name under which the result is stored: a hash of the settings and of the source that computes it."""
        source = fingerprint([methods.find(self.method, base)], self.system, base)
        return hashlib.sha256(f"{self.identity}\n{source}".encode()).hexdigest()[:32]

    def resolve(self, base: Path) -> tuple[System, Library]:
        """Look the system and the library up.

        Raises:
            InputError: one of them does not exist.
        """
        system = systems.find(self.system, base)
        return system, (library(self.library, self.terms) if self.terms else system.library(self.library))


def _listed(value: Any) -> Any:
    return value if isinstance(value, list) else [value]


def _seeds(value: Any) -> Any:
    """Read "1-100" as the seeds from 1 to 100."""
    if not isinstance(value, str):
        return _listed(value)
    found = re.fullmatch(r"\s*(\d{1,9})\s*-\s*(\d{1,9})\s*", value)
    if found is None or not 0 <= int(found[2]) - int(found[1]) < MOST_SEEDS:
        raise ValueError(f'write a range of at most {MOST_SEEDS} seeds as "1-100", the smaller one first')
    return list(range(int(found[1]), int(found[2]) + 1))


class _Contestant(_Model):
    method: str
    settings: dict[str, Any] = {}


class _Grid(_Model):
    """A block of a suite: every list is an axis. The keys are those of `Case`, in the plural where a list is usual."""

    part: str = ""
    system: str
    parameters: dict[str, Annotated[list[Number], pydantic.BeforeValidator(_listed)]] = {}
    libraries: list[str] = []
    terms: dict[str, list[str]] = {}
    initial: Annotated[list[str | None], pydantic.BeforeValidator(_listed)] = [None]
    sites: Annotated[list[int | None], pydantic.BeforeValidator(_listed)] = [None]
    ends: Annotated[list[str | None], pydantic.BeforeValidator(_listed)] = [None]
    integrator: Annotated[list[str | None], pydantic.BeforeValidator(_listed)] = [None]
    samples: Annotated[list[int], pydantic.BeforeValidator(_listed)] = [50]
    span: Annotated[list[float], pydantic.BeforeValidator(_listed)] = [10.0]
    uneven: Annotated[list[bool], pydantic.BeforeValidator(_listed)] = [False]
    velocities: Annotated[list[bool], pydantic.BeforeValidator(_listed)] = [True]
    known_ends: Annotated[list[bool], pydantic.BeforeValidator(_listed)] = [False]
    trajectories: Annotated[list[int], pydantic.BeforeValidator(_listed)] = [1]
    noise: Annotated[list[float], pydantic.BeforeValidator(_listed)] = [0.0]
    missing: Annotated[list[float], pydantic.BeforeValidator(_listed)] = [0.0]
    mirror: Annotated[list[bool], pydantic.BeforeValidator(_listed)] = [False]
    seeds: Annotated[list[int], pydantic.BeforeValidator(_seeds)] = [1]
    methods: list[str] | None = None
    time_limit: float = 120.0
    memory_limit: int = 4096


class _File(_Model):
    title: str = ""
    methods: dict[str, _Contestant]
    defaults: dict[str, Any] = {}
    grid: list[dict[str, Any]]


AXES = (
    "initial", "sites", "ends", "integrator", "samples", "span", "uneven", "velocities", "known_ends", "trajectories",
    "noise", "missing", "mirror",
)  # fmt: skip


@dataclass(frozen=True)
class Suite:
    """A named list of cases.

    Attributes:
        name: the file's name without its ending.
        title: what it is for.
        cases: in the order in which they run.
        base: the folder that paths in cases start from.
    """

    name: str
    title: str
    cases: tuple[Case, ...]
    base: Path


def names() -> list[str]:
    """Name the suites that come with the package."""
    return sorted(path.stem for path in HERE.glob("*.toml"))


def load(name: str) -> Suite:
    """Load a suite by its name, or from a TOML file, and check every name in it.

    Raises:
        InputError: the suite is unknown or unsound; the text names the file and the key.
    """
    path = Path(name) if name.endswith(".toml") else HERE / f"{name}.toml"
    if not name.endswith(".toml") and name not in names():
        raise InputError(f"{unknown('suite', name, names())} (or the path of a .toml file)")
    shown = name if name.endswith(".toml") else f"suite {name}"
    content = read_toml(path)
    try:
        file = _File.model_validate(content)
    except pydantic.ValidationError as error:
        raise _unsound(shown, "", error, _File) from None
    cases: list[Case] = []
    for number, block in enumerate(file.grid, start=1):
        where = f"{shown}: grid {number}"
        try:
            grid = _Grid.model_validate({**file.defaults, **block})
        except pydantic.ValidationError as error:
            raise _unsound(shown, f"grid {number}", error, _Grid) from None
        try:
            cases += _expand(grid, file.methods, where)
        except pydantic.ValidationError as error:
            raise _unsound(shown, f"grid {number}", error, Case) from None
    base = path.resolve().parent
    for label, contestant in file.methods.items():
        try:
            make(methods.find(contestant.method, base), contestant.settings)
        except InputError as error:
            raise InputError(f"{shown}: methods.{label}: {error}") from None
    for case in cases:
        try:
            system, _ = case.resolve(base)
            system.with_parameters(case.parameters)
            if case.initial is not None and case.initial not in system.initials:
                raise unknown("initial state", case.initial, system.initials, f"system {system.name!r}")
        except InputError as error:
            raise InputError(f"{shown}: {error}") from None
    unique = {case.identity: case for case in cases}
    return Suite(path.stem, file.title, tuple(unique.values()), base)


def _unsound(shown: str, place: str, error: pydantic.ValidationError, model: type[_Model]) -> InputError:
    # A key that is misspelt is also missing; the misspelling is the better news.
    first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
    path = ".".join(str(part) for part in first["loc"])
    where = ": ".join(part for part in (shown, place) if part)
    if first["type"] == "extra_forbidden":
        known = model.model_fields
        if len(first["loc"]) > 1:
            known = _Contestant.model_fields
        return unknown("key", str(first["loc"][-1]), known, f"{where}: {path}" if len(first["loc"]) > 1 else where)
    given = "" if first["type"] == "missing" else f", it is {first['input']!r}"
    return InputError(f"{where}: {path}: {first['msg'][0].lower()}{first['msg'][1:]}{given}")


def _expand(grid: _Grid, contestants: dict[str, _Contestant], where: str) -> Iterator[Case]:
    labels = list(contestants) if grid.methods is None else grid.methods
    for label in labels:
        if label not in contestants:
            raise unknown("method", label, contestants, where)
    for name, value in grid:
        if value == [] and name != "libraries":
            raise InputError(f"{where}: {name}: an empty list makes no cases; leave the key out")
    for name, values in grid.parameters.items():
        if not values:
            raise InputError(f"{where}: parameters.{name}: an empty list makes no cases; leave the key out")
    if not grid.libraries and not grid.terms:
        raise InputError(f"{where}: libraries: give at least one")
    libraries = [(name, ()) for name in grid.libraries] + [(name, tuple(terms)) for name, terms in grid.terms.items()]
    parameter_names = list(grid.parameters)
    # Data outermost, methods innermost: a worker that has simulated a trajectory uses it for every method.
    for parameters in itertools.product(*grid.parameters.values()):
        for axes in itertools.product(*(getattr(grid, axis) for axis in AXES)):
            for seed, (name, terms), label in itertools.product(grid.seeds, libraries, labels):
                yield Case(
                    system=grid.system, parameters=dict(zip(parameter_names, parameters, strict=True)),
                    **dict(zip(AXES, axes, strict=True)), seed=seed, library=name, terms=terms, label=label,
                    method=contestants[label].method, settings=contestants[label].settings, part=grid.part,
                    time_limit=grid.time_limit, memory_limit=grid.memory_limit,
                )  # fmt: skip
