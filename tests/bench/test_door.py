"""A recording as it comes from a laboratory goes through the commands unedited."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.bench.cli import main
from latticebench.bench.inspection import inspect
from latticebench.bench.report.notes import resting
from latticebench.systems.samples import Samples

READING = ["--time", "time_s", "--columns", "theta_*_deg", "--scale", "deg"]
MODEL = ["--terms", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])", "--order", "2", "--ends", "free"]
OFFSETS = np.array([1.9, 1.8, -0.2, -1.2, -1.3, -1.5, -0.3])


class Typed:
    """Commands that are typed in a folder, within this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.monkeypatch, self.capsys = monkeypatch, capsys

    def __call__(self, *words: str, code: int = 0) -> tuple[str, str]:
        self.monkeypatch.setattr(sys, "argv", ["latticebench", *words])
        with pytest.raises(SystemExit) as end:
            main()
        told = self.capsys.readouterr()
        assert (end.value.code or 0) == code, told.err
        return told.out, told.err


@pytest.fixture
def typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Typed:
    monkeypatch.chdir(tmp_path)
    write_pendula(tmp_path / "pendula.csv")
    return Typed(monkeypatch, capsys)


def write_pendula(path: Path, step: float = 0.025) -> None:
    """Seven damped pendula whose fifth is longer, all sensors off, in a file as an instrument's program writes it."""
    draw = np.random.default_rng(7)
    squares = np.where(np.arange(7) == 4, 22.0, 25.0)

    def rate(_: float, y: np.ndarray) -> list[float]:
        forces = []
        for n in range(7):
            pulls = sum(y[m] - y[n] for m in (n - 1, n + 1) if 0 <= m < 7)
            forces.append(4.0 * pulls - squares[n] * np.sin(y[n]) - 0.06 * y[7 + n])
        return [*y[7:], *forces]

    start = np.concatenate([np.deg2rad(draw.uniform(-35, 35, 7)), np.zeros(7)])
    t = np.arange(0, 20, step)
    angles = np.rad2deg(solve_ivp(rate, (0, 20), start, t_eval=t, rtol=1e-9, atol=1e-11).y[:7].T)
    angles += OFFSETS + 0.1 * draw.standard_normal(angles.shape)
    head = ["Torsion chain, lab 3;;", "", "time_s;" + ";".join(f"theta_{k}_deg" for k in range(1, 8)) + ";temperature"]
    rows = [
        ";".join([f"{one:.3f}", *(f"{angle:.2f}" for angle in row), "21.04"]).replace(".", ",")
        for one, row in zip(t, angles, strict=True)
    ]
    path.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8-sig")


@pytest.mark.parametrize("command", ["inspect", "diagnose", "fit", "limit", "plot"])
def test_every_command_reads_the_stretch_that_it_is_told(typed, command):
    more = {"diagnose": MODEL, "fit": [*MODEL, "--method", "stlsq"], "limit": MODEL, "plot": ["--out", "x.png"]}
    _, told = typed(command, "pendula.csv", *READING, *more.get(command, []), "--between", "30", "60", code=2)
    assert "--between 30 60: 0 row(s) are there" in told
    assert "times go from 0 to 19.975" in told


def test_the_beginning_of_a_recording_can_be_left_out(typed, tmp_path):
    shown, told = typed("inspect", "pendula.csv", *READING, "--between", "5", "inf")
    assert "600 rows; t = 5 to 19.975" in shown
    assert "rows before 5 are not read: 200 of 800" in told + shown


def test_the_refusal_names_the_options_that_read_the_file(typed: Typed) -> None:
    _, told = typed("inspect", "pendula.csv", code=2)
    assert 'read it with --time time_s --columns "theta_*_deg" --scale deg' in told


def test_inspect_shows_columns_units_noise_and_frequencies_and_draws_them(typed: Typed, tmp_path: Path) -> None:
    shown, _ = typed("inspect", "pendula.csv", *READING, "--out", "p.png", "--json", "p.json")
    for word in ("theta_5_deg", "Nothing suspicious", "every 0.025 s", "(deg)", "not read: temperature", "1 row(s)"):
        assert word in shown, shown
    (found,) = json.loads((tmp_path / "p.json").read_text())["trajectories"]
    np.testing.assert_allclose([one["noise"] for one in found["sensors"]], 0.1, rtol=0.35)
    # Free pendula of this length swing with sqrt(25) / 2 pi.
    assert any(abs(one - 0.8) < 0.05 for one in found["frequencies"])
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    # Options of a fit, typed once more.
    again, _ = typed("inspect", "pendula.csv", *READING, "--terms", "sin(u[n])", "--order", "2")
    assert "theta_5_deg" in again


def test_inspect_points_at_degrees_clipped_and_resting_sensors(typed: Typed, tmp_path: Path) -> None:
    t = np.arange(0, 20, 0.05)
    wave = 40 * np.sin(3 * t) * np.exp(-0.01 * t) + 0.1 * np.random.default_rng(1).standard_normal(len(t))
    table = np.column_stack([t, wave, np.clip(wave, -30, 30), np.full(len(t), 1.5), wave])
    head = "t,u1,u2,u3,u4"
    np.savetxt(tmp_path / "odd.csv", np.delete(table, slice(100, 110), axis=0), "%.4f", ",", header=head, comments="")
    shown, _ = typed("inspect", "odd.csv", "--terms", "sin(u[n])")
    for word in (
        "u2: ", "of just 30 and none above", "of just -30 and none below", "u3: always 1.5", "--scale deg",
        "u4: the same readings as u1", "gap from t = 4.95 to 5.5",
    ):  # fmt: skip
        assert word in shown, shown
    assert "u1: " not in shown


def test_a_fit_of_degrees_warns_in_its_first_line_and_in_json(typed: Typed) -> None:
    words = ["fit", "pendula.csv", *READING[:4], *MODEL, "--method", "least-squares"]
    shown, _ = typed(*words)
    assert shown.startswith("Warning: the equation does not fit")
    assert "least-squares: ok" not in shown
    found = json.loads(typed(*words, "--json", "-")[0])
    assert found["quality"]["fits"] is False
    assert any("--scale deg" in line for line in found["warnings"])
    assert found["units"] == {"time": "s", "reading": "deg", "equation": "deg", "scale": 1}


def test_a_bound_warns_of_a_misfit_first_and_says_the_noise_in_degrees(typed: Typed) -> None:
    shown, _ = typed("limit", "pendula.csv", *READING, *MODEL)
    assert shown.startswith("Warning: the equation leaves")
    sizes = re.findall(r"noise of sensor \d: (\S+) deg", shown)
    assert len(sizes) == 7
    # What the defect and the offsets leave; in radians it would be a sixtieth of that.
    assert all(0.3 < float(size) < 20 for size in sizes)
    assert "units: t in s; u in rad; readings in deg" in shown


@pytest.mark.slow
def test_offsets_and_damping_are_named_in_degrees_from_the_unedited_file(typed: Typed, tmp_path: Path) -> None:
    shown, _ = typed("diagnose", "pendula.csv", *READING, *MODEL, "--json", "d.json")
    found = json.loads((tmp_path / "d.json").read_text())
    effects = {one["effect"]: one for one in found["effects"]}
    assert found["verdict"] == "explained"
    assert {"sensor-offset", "damping"} < set(effects)
    for site, true in enumerate(OFFSETS, 1):
        size = effects["sensor-offset"]["natural"][f"offset of u{site}"]
        assert size["unit"] == "deg"
        assert size["value"] == pytest.approx(true, abs=0.05)
    decay = effects["damping"]["natural"]["decay time"]
    assert (decay["value"], decay["unit"]) == (pytest.approx(2 / 0.06, rel=0.05), "s")
    np.testing.assert_allclose(list(found["noise"].values()), 0.1, rtol=0.1)
    assert "deg" in shown.split("Equation")[0]


@pytest.mark.slow
def test_the_defect_is_named_at_its_site_from_the_unedited_file(typed: Typed, tmp_path: Path) -> None:
    typed("diagnose", "pendula.csv", *READING, *MODEL, "--json", "d.json")
    found = json.loads((tmp_path / "d.json").read_text())["effects"]
    assert [one["parameters"]["site"] for one in found if one["effect"] == "defect"] == [5]


@pytest.mark.slow
def test_the_demo_finds_what_it_put_in(typed: Typed, tmp_path: Path) -> None:
    shown, _ = typed("demo", "--out", "tried")
    assert "With them, nothing significant is left." in shown
    for size, true in ((r"site 5 alone has (\S+)\*u\[n\]", -3.0), (r"offset of u3: (\S+) deg", 2.0)):
        (found,) = re.findall(size, shown)
        assert float(found) == pytest.approx(true, rel=0.02)
    assert "damping: amplitudes fall" in shown
    assert "tried/diagnosis.html" in shown
    assert "<svg" in (tmp_path / "tried" / "diagnosis.html").read_text(encoding="utf-8")


def test_a_diagnosis_points_at_clipped_readings_and_holds_to_the_noise_once_they_are_left_out(
    typed: Typed, tmp_path: Path
) -> None:
    t = np.arange(0, 40, 0.1)
    swing = np.exp(-0.025 * t) * np.cos(2 * t) + 0.005 * np.random.default_rng(3).standard_normal(len(t))
    words = ["--terms", "u[n]", "--order", "2", "--ends", "free", "--json", "-"]
    found = {}
    for name, beyond in (("clipped", 0.8), ("empty", np.nan)):
        u = np.where(swing > 0.8, beyond, swing)
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack([t, u]), "%.6f", ",", header="t,u1", comments="")
        found[name] = json.loads(typed("diagnose", f"{name}.csv", *words)[0])
    told = [any("are just 0.8 and none is above" in line for line in one["notes"]) for one in found.values()]
    assert told == [True, False]
    assert found["empty"]["error"]["rms"]["after"] == pytest.approx(0.005, rel=0.1)
    assert [one["effect"] for one in found["empty"]["effects"]] == ["damping"]


@pytest.mark.parametrize(("unit", "turn"), [("rad", 2 * np.pi), ("deg", 360.0)])
def test_an_angle_that_starts_anew_after_a_full_turn_is_pointed_at_and_one_that_does_not_is_not(
    typed: Typed, tmp_path: Path, unit: str, turn: float
) -> None:
    t = np.arange(0, 10, 0.05)
    angle = turn * (0.6 * t - 0.02 * t**2 + 0.02 * np.sin(5 * t)) + 1e-3 * np.random.default_rng(1).normal(size=len(t))
    for name, u in (("whole", angle), ("anew", angle % turn)):
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack([t, u]), "%.5f", ",", header=f"t,u1 ({unit})", comments="")
    read = ["--columns", f"u1 ({unit})", "--scale", unit]
    shown = {name: typed("inspect", f"{name}.csv", *read)[0] for name in ("whole", "anew")}
    assert f"u1 jumps by about {turn:.4g} at 3 places" in " ".join(shown["anew"].split())
    assert "starts anew" not in shown["whole"]
    (remedy,) = re.findall(r"--turn (\S+)", shown["anew"])
    went_on, told = typed("inspect", "anew.csv", *read, "--turn", remedy)
    assert "starts anew" not in went_on
    assert f"angles are unwrapped (a full turn is {turn:g} {unit})" in " ".join(went_on.split()) + told


@pytest.mark.slow
@pytest.mark.parametrize(("omega", "told"), [(14.0, True), (2.9, False)])
def test_a_force_far_above_the_chains_own_frequencies_may_be_hum_and_the_report_says_so(
    typed: Typed, tmp_path: Path, omega: float, told: bool
) -> None:
    t = np.arange(0, 60, 0.05)
    swing = 0.5 * np.exp(-0.025 * t) * np.cos(2 * t) + 0.03 * np.cos(omega * t + 1)
    table = np.column_stack([t, swing + 0.005 * np.random.default_rng(2).standard_normal(len(t))])
    np.savetxt(tmp_path / "hum.csv", table, "%.5f", ",", header="t,u1", comments="")
    words = ["--terms", "u[n]", "--order", "2", "--ends", "free", "--json", "-"]
    found = json.loads(typed("diagnose", "hum.csv", *words)[0])
    assert {one["effect"] for one in found["effects"]} == {"drive", "damping"}
    assert any("hum that a sensor picks up" in line for line in found["notes"]) == told


def test_a_sensor_that_stops_is_pointed_at_and_one_that_still_waits_or_came_to_rest_with_all_is_not() -> None:
    t = np.arange(0, 40, 0.1)
    u = np.column_stack([np.cos(t), np.sin(1.3 * t), np.cos(0.7 * t)])
    stopped = u.copy()
    stopped[200:, 1] = 0.25
    (line,) = resting(Samples(t, stopped))
    assert line == "u2: 0.25 from t = 20 to 39.9, while others move; if it had stopped, leave these cells empty"
    waits, rests, dead = (u.copy() for _ in range(3))
    waits[:200, 1] = 0.0
    rests[200:] = u[200]
    dead[:, 2] = 12.5
    assert resting(Samples(t, u)) == resting(Samples(t, waits)) == resting(Samples(t, rests)) == []
    assert resting(Samples(t, dead)) == ["u3: always 12.5; does this sensor work?"]
    many = np.column_stack([u, np.zeros((len(t), 6))])
    assert resting(Samples(t, many)) == ["u4, u5, u6, u7 and 2 more: always 0; do these sensors work?"]


@pytest.mark.slow
def test_a_diagnosis_points_at_degrees_in_a_sine_and_at_a_sensor_that_stopped(typed: Typed, tmp_path: Path) -> None:
    t = np.arange(0, 20, 0.05)
    u = np.column_stack([20 * np.cos(2 * t), 15 * np.sin(2 * t)])
    u += 0.05 * np.random.default_rng(2).normal(size=u.shape)
    u[200:, 1] = 12.5
    np.savetxt(tmp_path / "d.csv", np.column_stack([t, u]), "%.3f", ",", header="t,u1,u2", comments="")
    words = ["--terms", "sin(u[n])", "--order", "2", "--ends", "free", "--json", "d.json"]
    shown, _ = typed("diagnose", "d.csv", *words)
    assert shown.startswith("Warning: u reaches 20")
    assert "Warning: u2: 12.5 from t = 10 to 19.95, while others move" in shown
    notes = " ".join(json.loads((tmp_path / "d.json").read_text())["notes"])
    assert "in sin(...), which takes radians; if these are degrees: --scale deg." in notes
    assert "u2: 12.5 from t = 10 to 19.95, while others move" in notes


def test_when_a_sensor_was_silent_for_long_is_told_and_a_few_missing_readings_are_not() -> None:
    t = np.arange(0, 40, 0.1)
    u = np.column_stack([np.cos(t), np.sin(1.3 * t)]) + 0.01 * np.random.default_rng(1).normal(size=(len(t), 2))
    silent, single, both = (u.copy() for _ in range(3))
    silent[100:180, 1] = np.nan
    single[100:180:3, 1] = np.nan
    both[100:180] = np.nan
    told = "u2: nothing was read from t = 9.9 to 18, while others were"
    assert told in inspect(Samples(t, silent)).suspicious
    for other in (u, single, both):
        assert not any("nothing was read" in line for line in inspect(Samples(t, other)).suspicious)


def test_a_bound_for_an_equation_that_misfits_makes_no_promise(typed: Typed, tmp_path: Path) -> None:
    t = np.arange(0, 40, 0.1)
    noise = 0.001 * np.random.default_rng(1).normal(size=len(t))
    for damping, promised in ((0.0, True), (0.05, False)):
        swing = np.exp(-damping * t) * np.cos(2 * t) + noise
        np.savetxt(tmp_path / "swing.csv", np.column_stack([t, swing]), "%.6f", ",", header="t,u1", comments="")
        out = typed("limit", "swing.csv", "--terms", "u[n]", "--order", "2", "--ends", "free")[0]
        assert ("can be known to" in out) == promised
        assert ("verdict, if it fitted" in out) != promised
