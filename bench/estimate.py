"""How long a run will take, by what the same cases took before."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from latticebench.bench import source
from latticebench.bench.beside import content_of
from latticebench.bench.case import Case
from latticebench.bench.published import folder_of
from latticebench.bench.run import counts
from latticebench.bench.store import Store, store_in
from latticebench.bench.suite import Suite
from latticebench.bench.tables import read_cases
from latticebench.systems.errors import InputError

# Nothing that ran took longer: thirty years.
LONGEST = 1e9


class Time(NamedTuple):
    """What a case took: seconds of wall time and of processor time, for the fit or the diagnosis alone."""

    seconds: float
    cpu: float

    @classmethod
    def read(cls, seconds: float | str | None, cpu: float | str | None) -> Time:
        """Return times that were written down.

        Raises:
            ValueError, TypeError: these are none.
        """
        found = cls(float(seconds or 0), float(cpu or 0))
        if not all(0 <= one <= LONGEST for one in found):
            raise ValueError(f"a time of {max(found):g} seconds")
        return found


@dataclass(frozen=True)
class Estimate:
    """What is to be done, and how long it will take.

    Attributes:
        methods: one row per method (of trials and recordings: per kind) with `cases`, `there` (finished and not run
            again), `known` (of the others, those with a recorded time), `seconds` and `cpu_seconds` (of the known).
        sources: where times were recorded.
    """

    methods: pd.DataFrame
    sources: tuple[str, ...]

    @property
    def cases(self) -> int:
        """How many cases there are."""
        return int(self.methods["cases"].sum())

    @property
    def there(self) -> int:
        """How many are finished."""
        return int(self.methods["there"].sum())

    @property
    def known(self) -> int:
        """Of how many others there is a recorded time."""
        return int(self.methods["known"].sum())

    def seconds(self, jobs: int) -> float:
        """Return the wall time of the known cases on so many workers."""
        return float(self.methods["seconds"].sum()) / jobs

    @property
    def core_hours(self) -> float:
        """The processor time of the known cases, in hours."""
        return float(self.methods["cpu_seconds"].sum()) / 3600


def estimate(suite: Suite, cases: Iterable[Case], folder: Path, *, retry: bool = False) -> Estimate:
    """Estimate a run; nothing is run or written.

    The time of a case is what it took before, in the results folder or in what was published of the suite, with
    whatever code; for a case with another seed, the median over the seeds. A case that ran out of time took its limit.

    Args:
        suite: what is to be run.
        cases: of the suite, those that are to be run.
        folder: where results are kept.
        retry: failed cases are run again.
    """
    store = store_in(folder)
    finished = {} if store is None else _finished(store)
    wanted = {case.identity: case for case in cases}
    keys = source.keys(wanted, suite.folders)
    times, sources = _recorded(suite.name, store)
    rows = []
    for identity, case in wanted.items():
        there = keys[identity] in finished and counts(case, *finished[keys[identity]], retry)
        took = times.get(_seedless(identity)) if not there else None
        nothing = Time(np.nan, np.nan)
        rows.append((getattr(case, "label", case.kind), there, took is not None, *(took or nothing)))
    table = pd.DataFrame(rows, columns=["method", "there", "known", "seconds", "cpu_seconds"])
    grouped = table.groupby("method", sort=False)
    methods = grouped[["there", "known", "seconds", "cpu_seconds"]].sum()
    methods.insert(0, "cases", grouped.size())
    return Estimate(methods.reset_index(), sources)


def seconds_of(suite: Suite, folder: Path) -> dict[str, float]:
    """Return what cases of a suite took before, by their identities, as far as it is known; see `estimate`."""
    times, _ = _recorded(suite.name, store_in(folder))
    found = {identity: times.get(_seedless(identity)) for identity in suite.by_identity}
    return {identity: took.seconds for identity, took in found.items() if took is not None}


def _finished(store: Store) -> dict[str, tuple[str, str]]:
    return {key: (status, case) for key, status, case in store.read('SELECT key, status, "case" FROM results')}


def _recorded(name: str, store: Store | None) -> tuple[dict[str, Time], tuple[str, ...]]:
    """Return the times of cases by their identities without the seed, and where they come from."""
    found: dict[str, list[Time]] = {}
    sources = []
    published = folder_of(name)
    readings = [] if store is None else [(str(store.path.parent), _of_store(store))]
    if os.path.isfile(published / "cases.csv"):
        readings.append((f"results/{name}", _of_table(published)))
    for place, times in readings:
        fresh: dict[str, list[Time]] = {}
        for identity, took in times:
            fresh.setdefault(identity, []).append(took)
        if fresh:
            sources.append(place)
        # This machine knows better than a published table.
        found = {**fresh, **found}
    medians = {key: Time(*np.median(np.array(took), axis=0).tolist()) for key, took in found.items()}
    return medians, tuple(sources)


def _of_store(store: Store) -> Iterator[tuple[str, Time]]:
    with store.sound():
        for identity, status, case, content in store.read('SELECT identity, status, "case", content FROM results'):
            if status == "timeout":
                limit = json.loads(case)["time_limit"]
                yield _seedless(identity), Time.read(limit, limit)
                continue
            took: Mapping[str, float | None] = json.loads(content)
            if took.get("seconds") is not None and took.get("cpu_seconds") is not None:
                yield _seedless(identity), Time.read(took["seconds"], took["cpu_seconds"])


def _of_table(folder: Path) -> Iterator[tuple[str, Time]]:
    try:
        table = read_cases(folder)
        times = table[["identity", "seconds", "cpu_seconds"]].dropna()
        yield from [(_seedless(identity), Time.read(*took)) for identity, *took in times.itertuples(index=False)]
    except (InputError, KeyError, ValueError):
        # What was published there is no table of this kind; there is nothing to be told from it.
        return


def _seedless(identity: str) -> str:
    """Return an identity without its seed."""
    content = content_of(identity)
    return json.dumps({name: content[name] for name in content if name != "seed"}, sort_keys=True)
