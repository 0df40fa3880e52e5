"""Suites of diagnoses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from latticebench import systems
from latticebench.bench.trials import scores
from latticebench.bench.trials.faults import SECOND_BLIND
from latticebench.bench.trials.specimen import make
from latticebench.bench.trials.trial import Made, Measured, _made, is_suite, load, names, run
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError


@pytest.mark.parametrize("name", names())
def test_every_suite_of_diagnoses_loads_and_has_a_title(name: str) -> None:
    title, trials = load(name)
    assert title
    assert trials


def test_the_suite_loop_has_every_effect_of_the_catalogue() -> None:
    _, trials = load("loop")
    there = {trial.effect for trial in trials if isinstance(trial, Made)}
    missing = {effect.name for effect in CATALOGUE} - there
    # Other names for a term that the declared equations of the paper's lattices have already.
    assert missing <= {"nonlinear-loss"}
    assert {"none", "other: weak-bond", "damping+drive"} <= there


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ('[[made]]\neffects = ["dampign"]\nsystems = ["phi4"]\n', "dampign"),
        ('[[made]]\neffects = ["damping"]\nsystems = ["phi5"]\n', "phi5"),
        ('[[made]]\neffects = ["damping"]\nsystems = ["phi4"]\nnoize = [1]\n', "noize"),
        ('[[measured]]\nname = "x"\nabout = ""\nfile = "x.csv"\nterms = "u[n]"\norder = 3\n', "order"),
    ],
)
def test_an_unsound_suite_is_told_by_its_key(tmp_path: Path, text: str, part: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=part):
        load(str(path))


def test_a_suite_of_cases_is_none_of_diagnoses() -> None:
    assert is_suite("loop")
    assert not is_suite("tiny")


def test_a_run_continues_where_it_was_stopped_and_is_published(tmp_path: Path) -> None:
    trials = [
        Made(system="phi4", effect="defect", z=30.0, sites=9, samples=30),
        Made(system="phi4", effect="none", sites=9, samples=30),
        Measured(name="gone", about="nothing", file="gone.csv", terms="u[n]", order=2),
    ]
    done: list[int] = []
    rows = run(trials, tmp_path / "runs", watcher=lambda: done.append(1))
    assert [row["status"] for row in rows] == ["ok", "ok", "skipped"]
    assert rows[0]["named"] == ["defect"]
    assert rows[1]["verdict"] == "nothing missing"
    assert "gone.csv" in rows[2]["message"]
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").iterdir()}
    assert run(trials, tmp_path / "runs") == rows
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").iterdir()}
    assert scores.is_run(tmp_path / "runs")
    written = scores.publish(rows, scores.about(rows, tmp_path / "runs"), tmp_path / "out")
    assert {path.name for path in written} >= {"trials.csv", "summary.md", "confusion.png", "measured.md"}
    assert json.loads(json.dumps(rows)) == rows


def test_the_picture_shows_what_was_named_first_or_of_pairs_alone_all() -> None:
    frame = pd.DataFrame(
        [("damping+drive", "drive + damping", "explained"), ("damping+drive", "", "unexplained"), ("drive", "drive + kick", "explained")],
        columns=["effect", "named", "verdict"],
    ).assign(status="ok", z=20.0)  # fmt: skip

    def shown(rows: pd.DataFrame) -> tuple[list[str], list[str]]:
        axes = scores.confusion(rows).axes[0]
        return [one.get_text() for one in axes.get_yticklabels()], [one.get_text() for one in axes.get_xticklabels()]

    assert shown(frame) == (["drive"], ["drive"])
    assert shown(frame[:2]) == (["damping+drive"], ["drive + damping", "unexplained"])


def test_a_name_in_a_group_of_three_is_not_right() -> None:
    from latticebench.bench.trials.trial import is_right

    assert is_right(["damping"], ["damping"], [[]], "explained", "damping")
    assert is_right(["damping"], ["quadratic-drag"], [["damping"]], "explained", "damping")
    assert not is_right(["damping"], ["quadratic-drag"], [["damping", "memory"]], "explained", "damping")
    assert not is_right([], ["damping"], [[]], "explained", "none")
    assert not is_right([], ["damping"], [[]], "explained", "other: weak-bond")
    assert is_right([], ["damping"], [[]], "partly explained", "other: weak-bond")
    assert is_right(["damping", "drive"], ["drive", "damping"], [[], []], "explained", "damping+drive")
    assert not is_right([], [], [], "nothing missing", "other: weak-bond")


def test_what_an_effect_of_the_catalogue_could_do_as_well_is_counted_apart() -> None:
    assert scores.kind("other: cubic-drag", 1.0) != scores.kind("other: cubic-drag", 9.0)
    assert scores.kind("damping", 0.0) == "one effect"


def test_the_blind_sets_are_counted_apart() -> None:
    kinds = [scores.kind(f"other: {name}", 9.0) for name in ("cubic-drag", "plane-wave", "mains-hum")]
    assert [kind.split(", ")[1:-1] for kind in kinds] == [[], ["blind set"], ["second blind set"]]


def test_a_suite_may_ask_for_one_blind_set(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('title = "x"\n[[made]]\neffects = ["second-blind"]\nsystems = ["phi4", "dnls"]\nz = [30]\n')
    _, trials = load(str(path))
    asked = {trial.effect for trial in trials if isinstance(trial, Made)}
    assert asked == set(SECOND_BLIND)


@pytest.mark.parametrize("effect", ["drive", "sensor-gain", "ends", "unequal-masses"])
def test_where_the_right_effect_is_named_forecasts_are_those_of_the_true_model(effect: str) -> None:
    row = _made(Made(system="phi4", effect=effect, z=30.0, sites=9, samples=30))
    assert row["named"] == [effect]
    assert row["forecast_after"] == pytest.approx(row["forecast_true"], rel=0.02)


def test_the_true_model_of_a_long_range_coupling_reaches_as_far_as_the_way_it_was_found_in():
    """What is drawn for other faults must not change an effect's own parameters."""
    drawn = make(
        systems.find("phi4"), "long-range", 10.0, np.random.default_rng(1), sites=9, samples=30, span=6.0
    ).about
    own = {"reach", "open", "scale", "step", "width", "at", "omega", "delay", "s"}
    assert own & set(drawn) == {"at", "width", "omega", "delay", "s"}
