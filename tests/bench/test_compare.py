"""Comparing runs: what counts as a loss, whatever the kind of case."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from latticebench.bench.compare import compare, of_fits, read_run
from latticebench.bench.fitting import FitCase
from latticebench.bench.store import create
from latticebench.bench.tables import cases
from latticebench.bench.trials.measured import Measured
from latticebench.bench.trials.trial import Trial
from latticebench.bench.worker import outcome
from latticebench.systems.errors import InputError

MADE = {"commit": "abc", "date": "2026-01-01", "machine": "m", "versions": {"numpy": "2"}}


def fits(*given: tuple[str, int, float | None] | tuple[str, int, float | None, str]) -> pd.DataFrame:
    """A table of fits: method, seed, E2 and status."""
    rows = []
    for method, seed, e2, *status in given:
        case = FitCase(system="phi4", library="lib1", label=method, method=method, seed=seed)
        about = {"case": case.model_dump(mode="json"), "identity": case.identity}
        rows.append({**outcome(case, *status or ["ok"]), **about, "e2": e2, "residual": 0.25})
    return of_fits(cases(rows))


def test_failures_count_as_losses_and_round_off_as_nothing() -> None:
    old = fits(("a", 1, 1e-15), ("b", 1, 0.1), ("c", 1, 0.1), ("d", 1, None, "failed"))
    new = fits(("a", 1, 1e-12), ("b", 1, 0.25), ("c", 1, None, "timeout"), ("d", 1, 0.5))
    found = compare(old, new, factor=2.0)
    assert [row.split(" | ")[2] for row in found.worse["case"]] == ["b", "c"]
    assert list(found.worse["new"]) == ["E2 0.25", "timeout"]
    assert [row.split(" | ")[2] for row in found.better["case"]] == ["d"]
    assert found.same == 1
    lost = compare(fits(("a", 1, 0.1)), fits(("a", 1, None, "skipped")))
    assert len(lost.worse) == 1
    assert not len(compare(old, old).worse)


def test_cases_that_only_one_side_has_are_named() -> None:
    found = compare(fits(("a", 1, 0.1), ("a", 2, 0.1)), fits(("a", 2, 0.1), ("a", 3, 0.1)))
    assert [name.split("seed ")[1] for name in found.gone] == ["1"]
    assert [name.split("seed ")[1] for name in found.fresh] == ["3"]


def test_runs_without_a_common_case_cannot_be_compared() -> None:
    with pytest.raises(InputError, match="no case in common"):
        compare(fits(("a", 1, 0.1)), fits(("b", 1, 0.1)))


def test_a_method_is_better_only_where_enough_pairs_say_so() -> None:
    rng = np.random.default_rng(1)
    sizes = np.exp(rng.normal(size=(2, 12)))
    old = fits(*(("a", seed, float(sizes[0, seed])) for seed in range(12)), *(("b", s, 0.1 + s) for s in range(4)))
    better = fits(
        *(("a", seed, float(sizes[0, seed]) * 0.9) for seed in range(12)), *(("b", s, 0.01 + s / 10) for s in range(4))
    )
    other = fits(
        *(("a", seed, float(sizes[1, seed])) for seed in range(12)), *(("b", s, None, "failed") for s in range(4))
    )
    told = compare(old, better).methods.set_index("method")
    # A tenth less in all of twelve pairs is sure, ten times less in four is not: 2 / 2^4 is more than 0.05.
    assert list(told["verdict"]) == ["better", "not told apart"]
    assert list(told["pairs"]) == [12, 4]
    assert told.loc["a", "ratio"] == pytest.approx(0.9)
    assert told.loc["a", "p"] == pytest.approx(2 * 2 / 2**12)
    assert list(compare(better, old).methods["verdict"]) == ["worse", "not told apart"]
    assert list(compare(old, other).methods["verdict"]) == ["not told apart", "not told apart"]
    assert list(compare(old, old).methods["p"]) == [1.0, 1.0]


@pytest.mark.parametrize("status", ["failed", "memory", "timeout", "died"])
def test_a_method_that_no_longer_comes_to_an_end_is_worse_whatever_ended_it(status: str) -> None:
    old = fits(*(("a", seed, 0.1 + seed / 100) for seed in range(12)))
    new = fits(*(("a", seed, None, status) for seed in range(12)))
    told = compare(old, new).methods.iloc[0]
    assert (told["verdict"], told["pairs"]) == ("worse", 12)


HEAD = "# command: latticebench run loop\nsystem,effect,z,noise,velocities,seed,status,right,residual_after\n"


def trials(folder: Path, *rows: str) -> pd.DataFrame:
    folder.mkdir()
    (folder / "trials.csv").write_text(HEAD + "".join(f"{row}\n" for row in rows))
    return read_run(folder)


def test_a_trial_is_worse_when_it_was_right_and_is_wrong_or_leaves_more(tmp_path: Path) -> None:
    same = "phi4,clock,10.0,0.01,False,7,ok,True,1.0"
    old = trials(
        tmp_path / "old", same, "phi4,drive,10.0,0.01,True,7,ok,True,1.0", "phi4,kick,5.0,0.01,True,7,ok,False,1.5",
        "dnls,none,0.0,0.01,True,7,ok,True,1.0", "dnls,trap,5.0,0.01,True,7,ok,True,1.0",
    )  # fmt: skip
    new = trials(
        tmp_path / "new", same, "phi4,drive,10.0,0.01,True,7,ok,False,1.0", "phi4,kick,5.0,0.01,True,7,ok,True,1.0",
        "dnls,none,0.0,0.01,True,7,ok,True,9.0", "dnls,trap,5.0,0.01,True,8,ok,True,1.0",
    )  # fmt: skip
    found = compare(old, new)
    assert list(found.worse["case"]) == ["phi4 noise=0.01 | drive z=10 | seed 7", "dnls noise=0.01 | none z=0 | seed 7"]
    assert list(found.worse["old"]) == ["right, residual 1", "right, residual 1"]
    assert list(found.worse["new"]) == ["wrong, residual 1", "right, residual 9"]
    assert list(found.better["case"]) == ["phi4 noise=0.01 | kick z=5 | seed 7"]
    assert (found.same, len(found.gone), len(found.fresh)) == (1, 1, 1)


def report(residual: float) -> dict[str, Any]:
    errors = {"residual": {"before": 9.0, "after": residual}, "forecast": {"before": 1.0, "after": 0.1}}
    return {"verdict": "explained", "effects": [{"effect": "damping"}], "error": errors}


def test_a_store_of_any_kinds_is_compared_with_what_was_published_of_them(tmp_path: Path) -> None:
    fit = FitCase(system="phi4", library="lib1", label="a", method="a")
    trial = Trial(system="phi4", effect="drive", z=10.0, seed=7)
    measured = Measured(name="x", file="x.csv", terms="u[n]", order=2)
    store = create(tmp_path / "store")
    store.plan({case.identity: f"key {k}" for k, case in enumerate((fit, trial, measured))}, {})
    store.put("key 0", fit, {**outcome(fit, "ok"), "e2": 0.1}, MADE)
    found = {"right": True, "named": ["drive"], "alike": [[]], "verdict": "explained", "residual_after": 1.0}
    store.put("key 1", trial, {**outcome(trial, "ok"), **found}, MADE)
    store.put("key 2", measured, {**outcome(measured, "ok"), "report": report(1.0)}, MADE)
    (tmp_path / "old").mkdir()
    cases([next(iter(store.results(kind="fit")))]).to_csv(tmp_path / "old" / "cases.csv")
    (tmp_path / "old" / "trials.csv").write_text(HEAD + "phi4,drive,10.0,0.01,True,7,ok,False,1.0\n")
    (tmp_path / "old" / "measured.md").write_text("")
    (tmp_path / "old" / "x.json").write_text(json.dumps(report(0.3)))
    found = compare(read_run(tmp_path / "old"), read_run(tmp_path / "store"))
    assert (list(found.better["case"]), list(found.worse["case"]), found.same) == ([trial.title], ["x"], 1)


@pytest.mark.parametrize("text", ["a,b\n1,2\n", "effect\n1\n", "\x00\x01", ""])
def test_what_is_no_published_table_is_one_clear_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "some.csv").write_text(text)
    with pytest.raises(InputError, match=r"some\.csv"):
        read_run(tmp_path / "some.csv")
    with pytest.raises(InputError, match="no results"):
        read_run(tmp_path / "none")


def test_of_a_table_that_lacks_columns_the_first_one_is_named(tmp_path: Path) -> None:
    (tmp_path / "some.csv").write_text("effect,z\n1,2\n")
    with pytest.raises(InputError, match="the column 'system' is missing"):
        read_run(tmp_path / "some.csv")


LABORATORY = "# command: latticebench run laboratory\nasked,seed,status,right,residual_after\n"


def test_a_laboratory_recording_is_worse_when_it_was_right_and_is_wrong(tmp_path: Path) -> None:
    for name, rights in (("old", ("True", "False", "True")), ("new", ("False", "True", "True"))):
        (tmp_path / name).mkdir()
        rows = "".join(f"all kinds,{seed},ok,{right},1.0\n" for seed, right in enumerate(rights))
        (tmp_path / name / "laboratory.csv").write_text(LABORATORY + rows)
    found = compare(read_run(tmp_path / "old"), read_run(tmp_path / "new"))
    assert list(found.worse["case"]) == ["laboratory all kinds | seed 0"]
    assert list(found.better["case"]) == ["laboratory all kinds | seed 1"]
    assert found.same == 1
