"""Laboratory recordings as cases: what is right, what is invented, and what is published of it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from latticebench.bench.case import Folders
from latticebench.bench.compare import compare, of_laboratory
from latticebench.bench.suite import load
from latticebench.bench.trials.laboratory import tables
from latticebench.bench.trials.laboratory.case import Batch, Laboratory
from latticebench.bench.trials.laboratory.judging import Finding, called, judge, residual
from latticebench.systems.errors import InputError


def there(name: str, site: int | None = None, alike: tuple[str, ...] = (), **parameters: float) -> dict[str, Any]:
    """Return what is in a recording."""
    return {
        "name": name, "site": site, "parameters": parameters, "z": 20.0, "apart": 0.5, "alike": list(alike),
        "sites": [] if site is None else [site],
    }  # fmt: skip


def said(name: str, site: int | None = None, others: tuple[str, ...] = (), **values: tuple[float, float]) -> Finding:
    """Return what is named."""
    return Finding(name, site, values, others)


def test_the_waves_of_a_hum_are_called_as_those_of_a_drive() -> None:
    found = called(
        {"hum of u2, cos(6.86*(t-5))": (1.0, 0.1), "hum of u2, sin(6.86*(t-5))": (2.0, 0.1), "omega": (7, 1)}
    )
    assert found == {"cos": (1.0, 0.1), "sin": (2.0, 0.1), "middle": (5.0, 0.0), "omega": (7, 1)}
    # Half a turn of phase from t = 0 to t = 5.
    truth = [there("sensor-hum", 1, cos=-1.0, sin=-2.0, omega=np.pi / 5)]
    values = {**found, "omega": (np.pi / 5, 0.01)}
    assert judge(truth, [Finding("sensor-hum", 1, values)]).covered == (3, 3)


def test_an_effect_is_named_alone_or_in_its_group() -> None:
    truth = [there("damping"), there("sensor-gain", 1)]
    assert judge(truth, [said("sensor-gain", 1), said("damping")]).right
    assert judge(truth, [said("unequal-masses", 0, ("sensor-gain",)), said("damping")]).right
    missed = judge(truth, [said("damping")])
    assert not missed.right
    assert missed.missed == ("sensor-gain",)
    assert missed.invented == ()


def test_what_is_found_beyond_what_is_there_is_invented() -> None:
    found = judge([there("damping")], [said("damping"), said("drive")])
    assert not found.right
    assert found.invented == ("drive",)
    assert judge([], [said("drive")]).invented == ("drive",)
    assert judge([], []).right


def test_each_effect_needs_a_finding_of_its_own() -> None:
    truth = [there("damping"), there("dry-friction")]
    one = said("quadratic-drag", None, ("damping", "dry-friction"))
    assert judge(truth, [one]).named == ("damping",)
    assert judge(truth, [one, said("dry-friction")]).right
    # The order does not matter: a wide group leaves the narrow one what it needs.
    assert judge(truth, [said("dry-friction", None, ("damping",)), said("dry-friction")]).right


def test_what_an_instrument_does_by_itself_is_neither_missed_nor_invented() -> None:
    assert judge([], [said("sensor-drift", 0)], "drifting-zero").right
    assert judge([], [said("sensor-wander", 0)], "drifting-zero").right
    assert judge([], [], "drifting-zero").right
    assert judge([], [said("sensor-drift", 0)], "white").invented == ("sensor-drift",)
    assert judge([], [said("sensor-offset", 0)], "drifting-zero").invented == ("sensor-offset",)


def test_offsets_of_several_sensors_are_one_effect_with_all_their_sizes() -> None:
    truth = [there("sensor-offset", None, offset_1=1.0, offset_2=-2.0)]
    found = [said("sensor-offset", 0, offset_1=(1.1, 0.1)), said("sensor-offset", 1, offset_2=(-2.3, 0.1))]
    judged = judge(truth, found)
    assert judged.right
    assert judged.covered == (1, 2)


def test_offsets_beside_unknown_ends_count_from_the_zeros_that_are_taken_as_right() -> None:
    true = there("sensor-offset", None, offset_1=1.0, offset_2=-2.0, offset_3=3.0)
    inner = [said("sensor-offset", 1, offset_2=(-4.0, 0.1))]
    assert judge([true], inner).covered == (0, 1)
    assert judge([{**true, "beside": {"offset_2": -4.0}}], inner).covered == (1, 1)
    every = [*inner, said("sensor-offset", 0, offset_1=(1.0, 0.1))]
    assert judge([{**true, "beside": {"offset_2": -4.0}}], every).covered == (1, 2)


def test_an_effect_that_does_the_same_counts_where_alike_is_counted() -> None:
    judged = judge([there("defect", 1, ("unequal-masses",))], [said("unequal-masses", 1)])
    assert not judged.right
    assert judged.right_alike


def test_intervals_are_counted_where_the_effect_is_found_at_its_place() -> None:
    truth = [there("defect", 1, coefficient=2.0)]
    assert judge(truth, [said("defect", 1, coefficient=(2.3, 0.2))]).covered == (1, 1)
    assert judge(truth, [said("defect", 1, coefficient=(2.5, 0.2))]).covered == (0, 1)
    elsewhere = judge(truth, [said("defect", 0, coefficient=(2.0, 0.2))])
    assert elsewhere.right
    assert elsewhere.placed == (0, 1)
    assert judge([{**truth[0], "sites": [0, 1]}], [said("defect", 0)]).placed == (1, 1)
    assert elsewhere.covered == (0, 0)
    assert judge(truth, [said("defect", 1, coefficient=(2.0, float("nan")))]).covered == (0, 0)


def test_gains_and_coefficients_are_compared_in_the_unit_of_the_sensor_that_is_taken_as_right() -> None:
    truth = [there("sensor-gain", None, gain_1=0.5, gain_2=0.8), there("onsite-cubic", None, coefficient=3.0)]
    truth.append(there("drive", None, cos=2.0, sin=0.0, omega=7.0))
    # With w = u / 2: the first sensor reads w, the second 1.6 w, the third 2 w; w'' = 12 w^3 + cos(7 t).
    said_so = [
        said("sensor-gain", None, gain_2=(1.6, 0.01), gain_3=(2.0, 0.01)),
        said("onsite-cubic", coefficient=(12.0, 0.1)),
        said("drive", cos=(1.0, 0.01), sin=(0.0, 0.01), omega=(7.0, 0.01)),
    ]
    assert judge(truth, said_so).covered == (6, 6)
    # The same drive, its phase counted from t = 0.3 on.
    cos, sin = np.cos(2.1), -np.sin(2.1)
    said_so[2] = said("drive", cos=(cos, 0.01), sin=(sin, 0.01), omega=(7.0, 0.01), middle=(0.3, 0.0))
    assert judge(truth, said_so).covered == (6, 6)
    said_so[2] = said("drive", cos=(cos, 0.01), sin=(sin, 0.01), omega=(7.0, 0.01), middle=(0.0, 0.0))
    assert judge(truth, said_so).covered == (4, 6)
    of_two = {**there("sensor-gain", 1, gain_2=0.5), "sites": [0, 1]}
    assert judge([of_two], [said("sensor-gain", 0, gain_1=(2.0, 0.01))]).covered == (1, 1)
    # A sensor that does not do the same has no such unit.
    assert judge([there("sensor-gain", 1, gain_2=0.5)], [said("sensor-gain", 0, gain_1=(2.0, 0.01))]).covered == (0, 0)


def test_where_a_force_does_the_work_of_another_the_sizes_of_forces_are_not_compared() -> None:
    truth = [there("onsite-cubic", coefficient=1.0), there("onsite-quintic", coefficient=2.0)]
    truth.append(there("sensor-offset", 0, offset_1=3.0))
    found = [
        said("onsite-cubic", coefficient=(4.0, 0.1)), said("onsite-linear", None, ("onsite-quintic",), u=(1.0, 0.1)),
        said("sensor-offset", 0, offset_1=(3.0, 0.1)),
    ]  # fmt: skip
    judged = judge(truth, found)
    assert judged.right
    assert judged.covered == (1, 1)
    # What is missed or invented takes nothing away.
    assert judge(truth, found[:1]).covered == (0, 1)
    assert judge(truth, [*found[:1], said("drive")]).covered == (0, 1)


@pytest.mark.parametrize(
    ("curves", "covered", "invented"),
    [
        ([("curve_2", 0.11)], (2, 2), ()),
        # Of another sensor, of all, and of both: these numbers cannot be compared, nor those of other sensors.
        ([("curve_1", 0.1)], (0, 0), ()),
        ([("curve", 0.1)], (0, 0), ()),
        ([("curve_1", 0.1), ("curve_2", 0.1)], (0, 0), ()),
        ([("curve", 0.1), ("curve_2", 0.1)], (0, 0), ("sensor-curve",)),
    ],
)
def test_a_curve_of_one_sensor_is_compared_with_a_curve_of_that_sensor_alone(
    curves: list[tuple[str, float]], covered: tuple[int, int], invented: tuple[str, ...]
) -> None:
    truth: list[dict[str, Any]] = [
        {"name": "sensor-curve", "site": 1, "sites": [1], "alike": [], "parameters": {"curve_2": 0.1}},
        {"name": "sensor-gain", "site": 1, "sites": [1], "alike": [], "parameters": {"gain_2": 1.5}},
    ]
    found = [said("sensor-gain", 1, gain_2=(1.51, 0.01))]
    found += [said("sensor-curve", None, **{name: (value, 0.01)}) for name, value in curves]
    judged = judge(truth, found)
    assert judged.missed == ()
    assert judged.covered == covered
    assert judged.invented == invented


def test_values_have_the_names_that_recordings_have_for_them() -> None:
    labels = {
        "offset of u1": 1.0, "gain of u12": 0.5, "curve of u": 2.0, "curve of u3": 8.0, "scale": 3.0,
        "cos(3.14159*t)": 4.0, "sin(3.14159*t)": 5.0, "omega": 6.0, "-v[n]": 7.0,
    }  # fmt: skip
    found = called({label: (value, 0.1) for label, value in labels.items()})
    assert {name: value for name, (value, _) in found.items()} == {
        "offset_1": 1.0, "gain_12": 1.5, "curve": 2.0, "curve_3": 8.0, "scale": 3.0, "cos": 4.0, "sin": 5.0,
        "omega": 6.0, "coefficient": 7.0, "middle": 0.0,
    }  # fmt: skip
    later = called({"cos(3.1*(t-12.5))": (4.0, 0.1), "sin(3.1*(t+1e+06))*u[n]": (5.0, 0.1)})
    assert later == {"cos": (4.0, 0.1), "sin": (5.0, 0.1), "middle": (-1e6, 0.0)}
    assert called({"cos(3.1*(t-12.5))": (4.0, 0.1)})["middle"] == (12.5, 0.0)
    assert called({"cos(u[n])": (1.0, 0.1)}) == {"coefficient": (1.0, 0.1)}
    assert called({"cos of u2": (1.0, 0.1), "per_reading": (2.0, 0.1)}) == {
        "cosine_2": (1.0, 0.1), "per_reading": (2.0, 0.1),
    }  # fmt: skip
    assert called({"change of the gain of u3": (1.0, 0.1), "gamma": (2.0, 0.1)}) == {
        "change_3": (1.0, 0.1), "gamma": (2.0, 0.1),
    }  # fmt: skip


def test_a_residual_counts_readings_alone_each_over_the_noise_of_its_sensor() -> None:
    seen = np.array([[1.0, 10.0], [np.nan, -10.0], [-1.0, np.nan]])[:, None, None]
    fitted = SimpleNamespace(curves=lambda: [SimpleNamespace(seen=seen, level=np.zeros_like(seen))])
    assert residual(fitted, np.array([0.5, 5.0])) == pytest.approx(2.0)  # type: ignore[arg-type]
    nothing = SimpleNamespace(curves=lambda: [SimpleNamespace(seen=seen * np.nan, level=np.zeros_like(seen))])
    assert np.isnan(residual(nothing, np.ones(2)))  # type: ignore[arg-type]


def result(case: Laboratory, truth: list[dict[str, Any]], findings: list[Finding], **more: Any) -> dict[str, Any]:
    """Return a stored result."""
    plain = [
        {"name": one.name, "site": one.site, "values": {}, "alternatives": list(one.alternatives)} for one in findings
    ]
    made = {
        "instrument": "white", "declared": "u[n]", "sites": 1, "ends": "free", "readings": 500, "periods": 20.0,
        "unit": "cm",
    }  # fmt: skip
    content = {**case.blank(), "recording": made, "truth": truth, "findings": plain, "verdict": "explained"}
    numbers = {"residual_after": 1.0, "forecast_before": 0.5, "forecast_after": 0.1, "cpu_seconds": 2.0}
    return {"case": case.model_dump(mode="json"), "status": "ok", "reason": "", **content, **numbers, **more}


def some_results() -> list[dict[str, Any]]:
    """Return one right result, one wrong, one without an answer, and two where nothing is missing."""
    drag = there("quadratic-drag")
    lost = {**result(Laboratory(seed=3), [drag], []), "status": "timeout", "findings": None}
    return [
        result(Laboratory(seed=1), [there("damping")], [said("damping")]),
        result(Laboratory(seed=2), [drag], [said("damping")], residual_after=2.0, forecast_after=0.6),
        lost,
        result(Laboratory(seed=4, effects="none"), [], [], verdict="nothing missing"),
        result(Laboratory(seed=5, effects="none"), [], [said("drive")]),
    ]


def test_the_summary_counts_no_answer_as_wrong() -> None:
    frame = tables.table(some_results())
    every = tables.summary(frame).iloc[0]
    assert every["right"].startswith("33.3 ")
    assert every["right"].endswith("of 3")
    assert every["residual at most 1.3"].startswith("50.0 ")
    assert every["forecast worse"].startswith("50.0 ")
    assert every["no answer"] == 1
    nothing = tables.nothing_missing(frame)
    assert nothing.iloc[0]["false alarms"].startswith("50.0 ")


def test_a_case_that_was_stopped_is_counted_with_what_its_recording_has() -> None:
    case = Laboratory(instrument="white", effects="damping", sites=1, seed=3)
    lost = {"case": case.model_dump(mode="json"), "status": "timeout", "reason": "too long", **case.blank()}
    row = tables.table([lost]).iloc[0]
    assert row["truth"].startswith("damping z=")
    assert row["count"] == 1
    assert not row["right"]
    assert tables.by_effect([lost]).iloc[0]["named"].startswith("0.0 ")


def test_shares_have_wilsons_intervals() -> None:
    assert tables.share([True] * 9 + [False]) == "90.0 (59.6-98.2) of 10"
    assert tables.share([]) == ""


def test_the_confusion_has_what_was_missed_and_what_was_invented() -> None:
    counts = tables.counts(some_results())
    assert counts.loc["damping", "damping"] == 1
    assert counts.loc["quadratic-drag", "missed"] == 1
    assert counts.loc["not there", "drive"] == 1
    assert counts.loc["not there", "damping"] == 1


def test_tables_and_the_picture_are_published(tmp_path: Path) -> None:
    written = tables.publish(some_results(), {"command": "made up"}, tmp_path)
    names = {path.name for path in written}
    assert names == {"laboratory.csv", "summary.csv", "effects.csv", "summary.md", "confusion.png"}
    assert "quadratic-drag" in (tmp_path / "summary.md").read_text()


def test_two_runs_are_compared_by_what_was_right() -> None:
    old = some_results()
    new = [result(Laboratory(seed=1), [there("damping")], []), *old[1:]]
    found = compare(of_laboratory(tables.table(old)), of_laboratory(tables.table(new)))
    assert len(found.worse) == 1
    assert found.same == 4


def test_the_suite_has_a_thousand_recordings_and_what_is_held_out_in_blocks_of_its_own() -> None:
    cases = [case for case in load("laboratory").cases if isinstance(case, Laboratory)]
    parts: dict[str, list[Laboratory]] = {}
    for case in cases:
        parts.setdefault(case.part, []).append(case)
    assert len(parts["all kinds"]) == 1000
    assert len(parts["nothing missing"]) == 8 * 250
    assert {case.instrument for case in parts["held-out instruments"]} == {"drifting-zero", "jittered-gaps"}
    assert len({case.effects for case in parts["held-out combinations"]}) == 2
    assert len(parts["at one site or bond"]) == 5 * 50
    assert all(case.seed >= 20_000 for case in cases)


@pytest.mark.parametrize(
    ("block", "part"),
    [({"instruments": ["whit"]}, "white"), ({"effects": ["dampign"]}, "damping"), ({"effects": ["memory"]}, "memory")],
)
def test_an_unknown_instrument_or_effect_is_told(block: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part):
        list(Batch.model_validate(block).cases("here"))


@pytest.mark.slow
def test_a_recording_is_made_diagnosed_and_judged() -> None:
    case = Laboratory(instrument="white", effects="quadratic-drag", sites=1, seed=1)
    found = case.blank()
    case.run(Folders(), found)
    row = tables.table([{"case": case.model_dump(mode="json"), "status": "ok", "reason": "", **found}]).iloc[0]
    assert row["right"]
    assert row["residual_after"] == pytest.approx(1, abs=0.2)
