"""Suites: named lists of cases, written in TOML.

    title = "what it is for"
    timing = true                   # run times are compared: workers of one kind of processor; false if not given

    [methods.stlsq]                 # a label; any number of variants of one method
    method = "stlsq"                # a name, or FILE.py of a user's own
    settings = { threshold = 0.05 }

    [defaults]                      # any key of a grid
    noise = [0.0, 0.01]
    seeds = [1, 2, 3]               # or "1-100"

    [[grid]]                        # fits: every combination of the lists is a case
    system = "phi4"                 # a name, or FILE.py / FILE.toml
    parameters = { C = [0.5, 2.0] }
    libraries = ["lib1", "lib2"]
    seeds_of = { pinn = "1-5" }     # of single methods, in place of seeds

    [[made]]                        # diagnoses of recordings made with a known effect: every combination of the lists
    effects = ["catalogue", "none"] # see `bench.trials.trial.Made`
    systems = ["phi4"]
    z = [5, 10, 30]

    [[laboratory]]                  # diagnoses of recordings as laboratories make them: every combination of the lists
    instruments = ["each"]          # see `bench.trials.laboratory.case.Batch`
    effects = ["any", "none"]
    seeds = "1-100"

    [[measured]]                    # the diagnosis of one measured recording, see `bench.trials.measured.Measured`
    name = "gliders"
    file = "gliders.csv"
    terms = "u[n+1]+u[n-1]-2*u[n]; u[n]"
    order = 2

A suite may have blocks of all kinds. Paths are relative to the suite file, those of recordings to the folder of
recordings.
"""

from __future__ import annotations

import hashlib
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import pydantic

from latticebench import methods, systems
from latticebench.bench.case import DATA, Case, Folders, Settings, code_file
from latticebench.bench.choice import Choice
from latticebench.bench.effort import check_cases, check_size
from latticebench.bench.fitting import FitCase
from latticebench.bench.grid import Contestant, Grid
from latticebench.methods.method import check_fit, make, settings
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.files import check_regular, read_bytes
from latticebench.systems.lattice import System, library
from latticebench.systems.samples import Samples
from latticebench.systems.toml import read_toml

HERE = Path(__file__).parent / "suites"
ALL = Choice()
# Of the hash of a file.
DIGITS = 12
# Parts of a suite that are named where nothing was chosen.
LISTED = 12


Label = Annotated[str, pydantic.StringConstraints(pattern=r"\S", max_length=200)]


class _File(Settings):
    title: str = ""
    timing: bool = False
    methods: dict[Label, Contestant] = {}
    defaults: dict[str, Any] = {}
    grid: list[dict[str, Any]] = []
    made: list[dict[str, Any]] = []
    laboratory: list[dict[str, Any]] = []
    measured: list[dict[str, Any]] = []


@dataclass(frozen=True)
class Suite:
    """A named list of cases.

    Attributes:
        name: the file's name without its ending.
        title: what it is for.
        by_identity: the cases by their identities, in the order in which they run.
        folders: where relative paths in cases start from.
        contestants: methods and their settings by their labels.
        timing: whether their run times are compared.
    """

    name: str
    title: str
    by_identity: Mapping[str, Case]
    folders: Folders
    contestants: Mapping[str, Contestant]
    timing: bool = False

    @property
    def cases(self) -> tuple[Case, ...]:
        """The cases in the order in which they run; no two are the same."""
        return tuple(self.by_identity.values())

    @property
    def about(self) -> dict[str, Any]:
        """What is told of it with its results: its name, and what each label stands for with all its settings.

        Of others' code, which is imported by workers alone, these are the settings that are given; of a user's file,
        the hash of its content, too.

        Raises:
            InputError: a user's file cannot be read.
        """
        written = {}
        for label, one in self.contestants.items():
            values: dict[str, Any] = dict(one.settings)
            if (own := code_file(one.method)) is not None:
                values["sha256"] = hashlib.sha256(read_bytes(self.folders.methods / own)).hexdigest()[:DIGITS]
            elif one.method not in methods.brought():
                kind = methods.find(one.method)
                chosen = make(kind, one.settings)
                values = {name: getattr(chosen, name) for name in settings(kind)}
            written[label] = ", ".join([one.method, *(f"{n}={v}" for n, v in values.items() if v is not None)])
        return {"suite": self.name, **({"settings": written} if written else {})}


def names() -> list[str]:
    """Return the names of the suites that come with the package."""
    return sorted(path.stem for path in HERE.glob("*.toml"))


def file_of(name: str) -> Path:
    """Return the file of a suite: the path itself where the name is one.

    Raises:
        InputError: there is no suite of that name.
    """
    if name.endswith(".toml"):
        return Path(name)
    if name not in names():
        raise InputError(f"{unknown('suite', name, names())} (or the path of a .toml file)")
    return HERE / f"{name}.toml"


def load(name: str, data: Path = DATA, *, large: bool = False, choice: Choice = ALL) -> Suite:
    """Load a suite by its name, or from a TOML file, and check every name in it.

    Args:
        name: of the suite, or its file.
        data: the folder of measured recordings.
        large: take it even if it asks for absurdly much, see `bench.effort`.
        choice: which part of it.

    Raises:
        InputError: the suite is unknown or unsound; the text names the file and the key. Or there is nothing in it of
            what was chosen.
    """
    path = file_of(name)
    shown = name if name.endswith(".toml") else f"suite {name}"
    if not re.fullmatch(r"\w[\w .+=-]*", path.stem):
        raise InputError(f"{shown}: results are kept under the suite's name; begin it with a letter or a digit")
    file = _checked(_File, read_toml(path), shown)
    # A suite that comes with the package lies where nobody keeps methods of his own.
    ours = not name.endswith(".toml")
    folders = Folders(path.resolve().parent, data, Path.cwd() if ours and choice.methods else None)
    if not (file.grid or file.made or file.laboratory or file.measured):
        raise InputError(f"{shown}: no cases; write at least one [[grid]], [[made]], [[laboratory]] or [[measured]]")
    _check_choice(choice, file, shown)
    contestants = choice.contestants(file.methods, None if ours else folders.suite)
    cases: dict[str, Case] = {}
    blocks = (
        _fits(file, shown, large, choice, contestants), _trials(file, shown, folders.suite, choice),
        _laboratory(file, shown, choice), _recordings(file, shown),
    )  # fmt: skip
    parts: dict[str, None] = {}
    for case in itertools.chain(*blocks):
        parts.setdefault(case.part or str(getattr(case, "data", case.title)))
        # What two parts share belongs to the first.
        if choice.takes(case):
            cases.setdefault(case.identity, case)
        if not large:
            check_cases(len(cases), shown)
    if not cases:
        there = [repr(one) for one in parts]
        more = f" and {len(there) - LISTED} more" if len(there) > LISTED else ""
        raise InputError(
            f"{shown}: there is no case of this choice: {choice}; there are {', '.join(there[:LISTED])}{more}"
        )
    _check_methods(contestants, folders.methods, shown)
    try:
        _look_up((case for case in cases.values() if isinstance(case, FitCase)), folders.suite, large)
        if not large:
            for case in cases.values():
                if not isinstance(case, FitCase):
                    check_size(case, getattr(case, "sites", 1), case.title)
    except InputError as error:
        raise InputError(f"{shown}: {error}") from None
    return Suite(path.stem, file.title, cases, folders, contestants, file.timing)


def _check_choice(choice: Choice, file: _File, shown: str) -> None:
    if choice.methods and not file.grid:
        raise InputError(f"{shown}: --methods: there are no fits in it, and so no methods to choose")
    if choice.seeds and not (file.grid or file.made or file.laboratory):
        raise InputError(f"{shown}: --seeds: its cases are measured recordings, which have none")


def _fits(
    file: _File, shown: str, large: bool, choice: Choice, contestants: Mapping[str, Contestant]
) -> Iterator[Case]:
    for number, content in enumerate(file.grid, start=1):
        where = f"{shown}: grid {number}"
        block = choice.block({**file.defaults, **content}, file.methods, contestants)
        if block is None:
            continue
        grid = _checked(Grid, block, where)
        if not large:
            check_cases(grid.count(contestants), where)
        with _told(where, FitCase):
            yield from grid.cases(contestants, where)


def _trials(file: _File, shown: str, base: Path, choice: Choice) -> Iterator[Case]:
    if file.made:
        from latticebench.bench.trials.trial import Made, Trial

        for number, block in enumerate(file.made, start=1):
            where = f"{shown}: made {number}"
            made = _checked(Made, choice.with_seeds(block), where)
            with _told(where, Trial):
                yield from made.cases(where, base)


def _laboratory(file: _File, shown: str, choice: Choice) -> Iterator[Case]:
    if file.laboratory:
        from latticebench.bench.trials.laboratory.case import Batch, Laboratory

        for number, block in enumerate(file.laboratory, start=1):
            where = f"{shown}: laboratory {number}"
            batch = _checked(Batch, choice.with_seeds(block), where)
            with _told(where, Laboratory):
                yield from batch.cases(where)


def _recordings(file: _File, shown: str) -> Iterator[Case]:
    if file.measured:
        from latticebench.bench.trials.measured import Measured

        known: set[str] = set()
        for number, block in enumerate(file.measured, start=1):
            where = f"{shown}: measured {number}"
            one = _checked(Measured, block, where)
            if one.name.casefold() in known:
                raise InputError(f"{where}: name: there are two recordings called {one.name!r}; their reports need two")
            known.add(one.name.casefold())
            try:
                library("declared", one.terms)
            except InputError as error:
                raise InputError(f"{where}: terms: {error}") from None
            yield one


def _check_methods(contestants: Mapping[str, Contestant], base: Path, shown: str) -> None:
    """Make sure that methods exist, and that they have such settings where their code is of this package.

    A file of the user's is looked at and not imported: its code runs in the workers alone, within the limits of a case,
    and so does that of other packages.
    """
    for label, contestant in contestants.items():
        path = code_file(contestant.method)
        try:
            if contestant.method in methods.brought():
                continue
            if path is None:
                make(methods.find(contestant.method), contestant.settings)
            else:
                check_regular(base / path)
        except InputError as error:
            raise InputError(f"{shown}: methods.{label}: {error}") from None


def _look_up(cases: Iterable[FitCase], base: Path, large: bool) -> None:
    """Make sure that the systems, parameters, initial states and libraries of cases exist, and go with one another.

    Raises:
        InputError: one of them does not.
    """
    known = set()
    for case in cases:
        size = (case.sites, case.ends, case.known_ends, case.samples, case.trajectories, case.span, case.memory_limit)
        about = (case.system, case.library, case.terms, case.initial, tuple(case.parameters.items()), size)
        if about in known:
            continue
        known.add(about)
        path = code_file(case.system)
        if path is not None:
            check_regular(base / path)
        apart = path is not None or case.system in systems.brought()
        if not large:
            check_size(case, case.sites or (1 if apart else systems.find(case.system, base).sites), case.data)
        if apart:
            continue
        system, candidates = case.resolve(base)
        system.with_parameters(case.parameters)
        check_fit([_blank(case, system)], candidates, system.order)
        if case.initial is not None and case.initial not in system.initials:
            raise unknown("initial state", case.initial, system.initials, f"system {system.name!r}")
        if case.parameters:
            system.initial_state(case.parameters, case.sites or system.sites, case.initial)


def _blank(case: FitCase, system: System) -> Samples:
    """Return two samples of a chain at rest, of the size and kind that a case's samples have."""
    u = np.zeros((2, case.sites or system.sites), dtype=complex if system.is_complex else float)
    ends = (case.ends or system.ends) if case.known_ends else "unknown"
    return Samples(np.arange(2.0), u, source=case.data, ends=ends)


Model = TypeVar("Model", bound=Settings)


def _checked(model: type[Model], content: Mapping[str, Any], where: str) -> Model:
    with _told(where, model):
        return model.of(content)


@contextmanager
def _told(where: str, model: type[Settings]) -> Iterator[None]:
    try:
        yield
    except pydantic.ValidationError as error:
        raise _unsound(where, error, model) from None


def _unsound(where: str, error: pydantic.ValidationError, model: type[Settings]) -> InputError:
    # A key that is misspelt is also missing; the misspelling is the better news.
    first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
    path = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        key, nested = str(first["loc"][-1]), len(first["loc"]) > 1
        if not nested:
            return unknown("key", key, model.model_fields, where)
        wrong = unknown("key", key, Contestant.model_fields, f"{where}: {path}")
        return InputError(f"{wrong}; a setting of the method is written as settings = {{ {key} = ... }}")
    given = "" if first["type"] == "missing" else f", it is {first['input']!r}"
    told = first["msg"].removeprefix("Value error, ")
    return InputError(f"{where}: {path}: {told[0].lower()}{told[1:]}{given}")
