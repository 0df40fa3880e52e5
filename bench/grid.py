"""Blocks of fits in a suite: every combination of their lists is a case."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any

from latticebench.bench.axes import Listed, Seeds
from latticebench.bench.case import Number, Settings
from latticebench.bench.fitting import FitCase
from latticebench.systems.errors import InputError, unknown

AXES = (
    "initial", "sites", "ends", "integrator", "samples", "span", "uneven", "velocities", "known_ends", "trajectories",
    "noise", "missing", "mirror",
)  # fmt: skip


class Contestant(Settings):
    """A method with its settings, as a suite file names it."""

    method: str
    settings: dict[str, Any] = {}


class Grid(Settings):
    """A block of a suite: every list is an axis. The keys are those of `FitCase`, some of them in the plural.

    `seeds_of` has the seeds of single methods, by their labels, in place of `seeds`.
    """

    part: str = ""
    system: str
    parameters: dict[str, Listed[Number]] = {}
    libraries: list[str] = []
    terms: dict[str, Listed[str]] = {}
    initial: Listed[str | None] = [None]
    sites: Listed[int | None] = [None]
    ends: Listed[str | None] = [None]
    integrator: Listed[str | None] = [None]
    samples: Listed[int] = [50]
    span: Listed[float] = [10.0]
    uneven: Listed[bool] = [False]
    velocities: Listed[bool] = [True]
    known_ends: Listed[bool] = [False]
    trajectories: Listed[int] = [1]
    noise: Listed[float] = [0.0]
    missing: Listed[float] = [0.0]
    mirror: Listed[bool] = [False]
    seeds: Seeds = [1]
    seeds_of: dict[str, Seeds] = {}
    methods: list[str] | None = None
    time_limit: float = 120.0
    memory_limit: int = 4096

    def count(self, contestants: Mapping[str, Contestant]) -> int:
        """Return the number of combinations; the arguments are those of `cases`."""
        axes = [*self.parameters.values(), *(getattr(self, axis) for axis in AXES)]
        labels = list(contestants) if self.methods is None else self.methods
        fits = sum(len(self.seeds_of.get(label, self.seeds)) for label in labels)
        return math.prod([len(axis) for axis in axes]) * fits * (len(self.libraries) + len(self.terms))

    def cases(self, contestants: Mapping[str, Contestant], where: str) -> Iterator[FitCase]:
        """Return every combination.

        Args:
            contestants: the methods of the suite, by their labels.
            where: the place of the block, for errors.

        Raises:
            InputError: a label is unknown, or a list is empty.
        """
        if not contestants:
            raise InputError(f"{where}: the suite names no methods; write at least one [methods.LABEL]")
        labels = list(contestants) if self.methods is None else self.methods
        for label in labels:
            if label not in contestants:
                raise unknown("method", label, contestants, where)
        for label in self.seeds_of:
            if label not in contestants:
                raise unknown("method", label, contestants, f"{where}: seeds_of")
        if not labels:
            raise InputError(f"{where}: methods: an empty list makes no cases; leave the key out")
        if not self.libraries and not self.terms:
            raise InputError(f"{where}: libraries: give at least one")
        libraries = [(name, ()) for name in self.libraries] + [
            (name, tuple(terms)) for name, terms in self.terms.items()
        ]
        parameter_names = list(self.parameters)
        lists = {label: self.seeds_of.get(label, self.seeds) for label in labels}
        seeds = list(dict.fromkeys(itertools.chain(*lists.values())))
        drawn = {label: frozenset(of_one) for label, of_one in lists.items()}
        # Data outermost, methods innermost: a worker that has simulated a trajectory uses it for every method.
        for parameters in itertools.product(*self.parameters.values()):
            for axes in itertools.product(*(getattr(self, axis) for axis in AXES)):
                first = [
                    FitCase(
                        system=self.system, parameters=dict(zip(parameter_names, parameters, strict=True)),
                        **dict(zip(AXES, axes, strict=True)), library=name, terms=terms, label=label,
                        method=contestants[label].method, settings=contestants[label].settings, part=self.part,
                        time_limit=self.time_limit, memory_limit=self.memory_limit,
                    )
                    for (name, terms), label in itertools.product(libraries, labels)
                ]  # fmt: skip
                # The seeds have been checked.
                for seed, case in itertools.product(seeds, first):
                    if seed in drawn[case.label]:
                        yield case.model_copy(update={"seed": seed})
