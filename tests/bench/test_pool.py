"""Cases on workers: one may wait behind a quick one, and that loses, delays and mixes up nothing."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from latticebench.bench.case import Case, Folders
from latticebench.bench.pool import TRIES, Pool
from latticebench.systems.errors import InputError

KIND = '''
import os
import time

from latticebench.bench.case import Case, Roots


class Act(Case):
    """Sleeps, and then does what it is told."""

    kind: str = "act"
    number: int
    sleep: float = 0.0
    does: str = ""

    @property
    def title(self):
        return f"case {self.number}"

    @property
    def roots(self):
        return Roots(__name__)

    def blank(self):
        return {"number": None}

    def run(self, folders, found):
        time.sleep(self.sleep)
        found["number"] = self.number
        if self.does == "die":
            os._exit(3)
        if self.does == "fail":
            print(f"this is {self.number}")
            raise ValueError("as told")
'''

MakeAct = Callable[..., Case]


@pytest.fixture
def act(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> MakeAct:
    """A kind of case that workers import as well."""
    (tmp_path / "acts.py").write_text(KIND)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "acts", raising=False)
    made: MakeAct = importlib.import_module("acts").Act
    return made


def run(cases: list[Case], jobs: int, begin: Callable[[Case], Any] = lambda _: "run") -> list[tuple[Case, Any]]:
    kept: list[tuple[Case, Any]] = []
    with Pool(jobs) as pool:
        pool.run(cases, Folders(), begin=begin, keep=lambda case, result: kept.append((case, result)))
    return kept


def test_what_waits_behind_a_long_case_is_done_by_a_worker_that_has_nothing_to_do(act: MakeAct) -> None:
    quick = [act(number=number) for number in range(40)]
    long = act(number=100, sleep=4.0)
    # All workers are on quick cases as the long one comes, with another one to be handed behind it.
    kept = run([*quick[:30], long, *quick[30:]], jobs=2)
    assert kept[-1][0] is long
    assert sorted(result["number"] for _, result in kept) == [*range(40), 100]


def test_a_case_behind_one_that_kills_its_worker_is_run(act: MakeAct) -> None:
    cases = [act(number=number, does="die" if number == 5 else "") for number in range(10)]
    tried: list[Case] = []

    def begin(case: Case) -> str:
        tried.append(case)
        return "run"

    kept = run(cases, jobs=1, begin=begin)
    assert sorted(case.number for case, _ in kept) == list(range(10))  # type: ignore[attr-defined]
    assert [case.number for case, result in kept if result["status"] != "ok"] == [5]  # type: ignore[attr-defined]
    assert tried.count(cases[5]) == TRIES


def test_each_of_many_quick_failures_shows_what_it_has_printed_itself(act: MakeAct) -> None:
    kept = run([act(number=number, does="fail") for number in range(100, 130)], jobs=1)
    assert len(kept) == 30
    for case, result in kept:
        assert result["reason"] == f"ValueError: as told; printed: this is {case.number}"  # type: ignore[attr-defined]


def test_what_has_ended_is_kept_though_the_next_case_cannot_begin(act: MakeAct) -> None:
    cases = [act(number=number) for number in range(5)]
    kept: list[Case] = []

    def begin(case: Case) -> Any:
        if case is cases[1]:
            raise InputError("the disk is full")
        return "run"

    with pytest.raises(InputError, match="full"), Pool(1) as pool:
        pool.run(cases, Folders(), begin=begin, keep=lambda case, _: kept.append(case))
    assert kept == [cases[0]]


def test_workers_that_were_started_beforehand_are_those_that_run_the_cases(act: MakeAct) -> None:
    kept: list[int] = []
    cases = [act(number=number) for number in range(4)]
    with Pool(2) as pool:
        pool.start(cases)
        started = list(pool.workers)
        pool.run(cases, Folders(), begin=lambda _: "run", keep=lambda case, _: kept.append(case.number))  # type: ignore[attr-defined]
        assert None not in started
        assert pool.workers == started
    assert sorted(kept) == list(range(4))


def test_a_worker_that_was_started_beforehand_and_is_killed_costs_no_case(act: MakeAct) -> None:
    kept: list[str] = []
    with Pool(1) as pool:
        pool.start([act(number=1)])
        (worker,) = pool.workers
        assert worker is not None
        worker.process.kill()
        worker.process.wait()
        pool.run(
            [act(number=1)], Folders(), begin=lambda _: "run", keep=lambda _, result: kept.append(result["status"])
        )
    assert kept == ["ok"]
