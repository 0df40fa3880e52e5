"""Trials and measured recordings as cases of a suite."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pandas as pd
import pytest

from latticebench.bench import kinds
from latticebench.bench.compare import compare, read_run
from latticebench.bench.report.schema import json_schema
from latticebench.bench.run import run
from latticebench.bench.store import create, open_store
from latticebench.bench.suite import Suite, load
from latticebench.bench.trials import scores
from latticebench.bench.trials.faults import SECOND_BLIND
from latticebench.bench.trials.trial import Trial, is_right
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError


def trials_of(suite: Suite) -> list[Trial]:
    return [case for case in suite.cases if isinstance(case, Trial)]


def test_the_suite_loop_has_every_effect_of_the_catalogue() -> None:
    there = {trial.effect for trial in trials_of(load("loop"))}
    missing = {effect.name for effect in CATALOGUE} - there
    # Another name for a term that the paper's lattices have already, and what real lattices of first order may have.
    assert missing <= {"nonlinear-loss", "own-rates"}
    assert {"none", "other: wavy-bonds", "damping+drive"} <= there


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ('[[made]]\neffects = ["dampign"]\nsystems = ["phi4"]\n', "dampign"),
        ('[[made]]\neffects = ["damping"]\nsystems = ["phi5"]\n', "phi5"),
        ('[[made]]\neffects = ["damping"]\nsystems = ["phi4"]\nnoize = [1]\n', "made 1.*noize"),
        ('[[made]]\neffects = ["damping"]\nsystems = ["phi4"]\nz = [-inf]\n', "made 1.*z"),
        ('[[measured]]\nname = "x"\nabout = ""\nfile = "x.csv"\nterms = "u[n]"\norder = 3\n', "measured 1: order"),
        ('[[grid]]\nsystem = "phi4"\nlibraries = ["lib1"]\n', "no methods"),
        ('title = "nothing"\n', "no cases"),
    ],
)
def test_an_unsound_suite_is_told_by_its_key(tmp_path: Path, text: str, part: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=part):
        load(str(path))


ALL_KINDS = """
title = "one of each"

[methods.floor]
method = "zero"

[[grid]]
system = "phi4"
sites = 5
samples = 8
span = 1.0
libraries = ["lib1"]

[[made]]
effects = ["defect", "none"]
systems = ["phi4"]
z = [30.0]
sites = 9
samples = 30

[[measured]]
name = "gone"
file = "gone.csv"
terms = "u[n]"
order = 2

[[measured]]
name = "swing"
about = "without its damping"
file = "swing.csv"
rows = [0, 60]
terms = "u[n]"
order = 2
ends = "free"
"""


def swing(folder: Path) -> None:
    """Write a recording of one damped oscillator."""
    folder.mkdir()
    draw = np.random.default_rng(1)
    t = 0.1 * np.arange(100)
    u = np.exp(-0.1 * t) * np.cos(2 * t) + 0.002 * draw.normal(size=len(t))
    (folder / "swing.csv").write_text("t,u1\n" + "".join(f"{a},{b}\n" for a, b in zip(t, u, strict=True)))


def test_one_suite_of_all_kinds_is_run_resumed_and_published(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(ALL_KINDS)
    swing(tmp_path / "data")
    suite, store = load(str(tmp_path / "mine.toml"), tmp_path / "data"), create(tmp_path / "store")
    results = list(run(suite, store, jobs=1)[0])
    assert [result["status"] for result in results] == ["ok", "ok", "ok", "skipped", "ok"]
    assert [result["case"]["kind"] for result in results] == ["fit", "trial", "trial", "measured", "measured"]
    assert results[1]["named"] == ["defect"]
    assert results[2]["verdict"] == "nothing missing"
    assert "gone.csv" in results[3]["reason"]
    assert results[4]["report"]["effects"][0]["effect"] == "damping"
    again, tally = run(suite, store, jobs=1)
    assert (list(again), tally.ran, tally.reused) == (results, 0, 5)
    written = {
        str(path.relative_to(tmp_path)) for path in kinds.publish(open_store(tmp_path / "store"), tmp_path / "out")
    }
    assert written >= {
        "out/fit/cases.csv", "out/fit/errors.tex", "out/trial/trials.csv", "out/trial/effects.csv",
        "out/trial/summary.md", "out/trial/confusion.png", "out/measured/measured.md", "out/measured/swing.json",
    }  # fmt: skip
    with_itself = compare(read_run(tmp_path / "out"), read_run(tmp_path / "store"))
    # The recording that was not there was not published as a report.
    assert (with_itself.same, with_itself.gone, with_itself.fresh) == (4, [], ["gone"])
    page = (tmp_path / "out" / "measured" / "measured.md").read_text()
    assert "`swing.csv`, rows 0 to 60. Declared: without its damping (`u[n]`, order 2, ends free)." in page
    report = json.loads((tmp_path / "out" / "measured" / "swing.json").read_text())
    jsonschema.validate(report, json.loads(json_schema("diagnosis")))
    assert {"command": "", **results[4]["made"], "seeds": []} == report.pop("provenance")
    assert report.pop("schema").startswith("latticebench/diagnosis/")
    assert report == {**results[4]["report"], "shown": None}


def test_a_recording_that_changed_is_diagnosed_again(tmp_path: Path) -> None:
    text = 'title = "x"\n' + ALL_KINDS[ALL_KINDS.index('[[measured]]\nname = "swing"') :].replace(
        "rows = [0, 60]", "rows = [0, 5]"
    )
    (tmp_path / "mine.toml").write_text(text)
    swing(tmp_path / "data")
    suite, store = load(str(tmp_path / "mine.toml"), tmp_path / "data"), create(tmp_path / "store")
    run(suite, store, jobs=1)
    assert run(suite, store, jobs=1)[1].ran == 0
    with (tmp_path / "data" / "swing.csv").open("a") as file:
        file.write("10.0,0.1\n")
    assert run(suite, store, jobs=1)[1].ran == 1
    assert next(store.read("SELECT COUNT(*) FROM results")) == (1,)


def test_the_picture_shows_what_was_named_first_or_of_pairs_alone_all() -> None:
    frame = pd.DataFrame(
        [
            ("damping+drive", "drive + damping", "explained"), ("damping+drive", "", "unexplained"),
            ("drive", "drive + kick", "explained"),
        ],
        columns=["effect", "named", "verdict"],
    ).assign(status="ok", z=20.0)  # fmt: skip

    def shown(rows: pd.DataFrame) -> tuple[list[str], list[str]]:
        axes = scores.confusion(rows).axes[0]
        return [one.get_text() for one in axes.get_yticklabels()], [one.get_text() for one in axes.get_xticklabels()]

    assert shown(frame) == (["drive"], ["drive"])
    assert shown(frame[:2]) == (["damping+drive"], ["drive + damping", "unexplained"])


def test_a_name_in_a_group_of_three_is_not_right() -> None:
    assert is_right("damping", ["damping"], [[]], "explained")
    assert is_right("damping", ["quadratic-drag"], [["damping"]], "explained")
    assert not is_right("damping", ["quadratic-drag"], [["damping", "memory"]], "explained")
    assert not is_right("none", ["damping"], [[]], "explained")
    assert not is_right("other: wavy-bonds", ["damping"], [[]], "explained")
    assert is_right("other: wavy-bonds", ["damping"], [[]], "partly explained")
    assert is_right("damping+drive", ["drive", "damping"], [[], []], "explained")
    assert not is_right("other: wavy-bonds", [], [], "nothing missing")


def test_what_an_effect_of_the_catalogue_could_do_as_well_is_counted_apart() -> None:
    assert scores.group_of("other: cubic-drag", 1.0) != scores.group_of("other: cubic-drag", 9.0)
    assert scores.group_of("damping", 0.0) == "one effect"


def test_the_blind_sets_are_counted_apart() -> None:
    kinds = [scores.group_of(f"other: {name}", 9.0) for name in ("cubic-drag", "plane-wave", "mains-hum")]
    assert [kind.split(", ")[1:-1] for kind in kinds] == [[], ["blind set"], ["second blind set"]]


def test_a_suite_may_ask_for_one_blind_set(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('title = "x"\n[[made]]\neffects = ["second-blind"]\nsystems = ["phi4", "dnls"]\nz = [30]\n')
    asked = {trial.effect for trial in trials_of(load(str(path)))}
    assert asked == set(SECOND_BLIND)
