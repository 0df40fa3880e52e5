"""What a diagnosis looks like to a program and at a terminal."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from latticebench.bench.report import rows
from latticebench.bench.report.content import content, diagnosis_document
from latticebench.bench.report.document import Provenance, to_json
from latticebench.bench.report.findings import added
from latticebench.bench.report.notes import notes, strays, turns
from latticebench.bench.report.separation import separation
from latticebench.bench.report.text import show
from latticebench.bench.report.whereabouts import scaled_residuals, whereabouts
from latticebench.diagnosis.acting import Chain, Placed
from latticebench.diagnosis.acting.everywhere import Everywhere
from latticebench.diagnosis.acting.harmonic import Harmonic
from latticebench.diagnosis.acting.pulse import Pulse
from latticebench.diagnosis.noise import Noise
from latticebench.diagnosis.repair import NAMELESS, NOT_FOLLOWED, NOT_REACHED, SMALL
from latticebench.systems.effects import CATALOGUE, Effect, find
from latticebench.systems.samples import Origin, Samples

Made = Callable[..., Any]


def test_a_diagnosis_that_was_interrupted_says_so_first(
    pendula: Made, about: Provenance, conforms: Callable[[str, str], Any], capsys: pytest.CaptureFixture[str]
) -> None:
    report = content(pendula(), interrupted=True)
    assert conforms("diagnosis", to_json(diagnosis_document(report, about)))["interrupted"]
    show(report)
    assert capsys.readouterr().out.startswith("Interrupted: ")
    show(content(pendula()))
    assert capsys.readouterr().out.startswith("What the equation lacks: ")


# Numbers as people know them ------------------------------------------------------------------------------------------


def test_a_gain_is_said_as_a_factor_and_a_damping_as_a_decay_time_with_their_errors(pendula: Made) -> None:
    damping, gain = added(pendula())
    assert gain.natural["factor of u2"].value == pytest.approx(1.677)
    assert gain.natural["factor of u2"].stderr == pytest.approx(gain.stderr["gain of u2"], rel=1e-3)
    assert any("the sensor of u2 reads 1.677 times" in line for line in gain.said)
    assert damping.natural["decay time"].value == pytest.approx(20)
    assert damping.natural["decay time"].stderr == pytest.approx(20 * damping.stderr["v[n]"] / 0.1, rel=1e-2)
    assert any("1/e within 20" in line for line in damping.said)


def test_a_kick_whose_time_is_hardly_known_has_all_its_standard_errors(pendula: Made) -> None:
    kick = Pulse(effect=find("kick"), texts=("1",), at=16.4, width=0.4, strength=(30.0,))
    (label,) = kick.labels(pendula().after.chain)
    known = {label: (30.0, 14.0), "at": (16.4, 0.4), "width": (0.4, 0.2)}
    one = SimpleNamespace(placed=kick, alternatives=(), evidence=20.0, values=known, name="kick")
    (effect,) = added(pendula(findings=(one,)))
    for name, (value, error) in known.items():
        assert effect.natural[name].value == pytest.approx(value)
        assert effect.natural[name].stderr == pytest.approx(error)


def test_a_kick_before_the_clock_began_is_said_without_two_signs(pendula: Made) -> None:
    chain = pendula().after.chain
    for at, label in ((-3.2, "exp(-((t+3.2)/0.5)**2/2)"), (0.0, "exp(-(t/0.5)**2/2)"), (1.7e9, "(t-1700000000)")):
        kick = Pulse(effect=find("kick"), texts=("1",), at=at, width=0.5, strength=(30.0,))
        assert label in kick.labels(chain)[0]


def test_a_linear_force_is_said_as_a_change_of_the_frequency_too(pendula: Made) -> None:
    force = Everywhere(effect=find("onsite-linear"), texts=("u[n]",), strength=(-0.09,))
    one = SimpleNamespace(
        placed=force, alternatives=(), evidence=9.0, values={"u[n]": (-0.09, 0.001)}, name="onsite-linear"
    )
    ((name, size),) = [pair for pair in added(pendula(findings=(one,)))[0].natural.items() if pair[0] != "u[n]"]
    assert name == "change of the angular frequency 3, in per cent"
    # From sqrt(9 - 0.09) to 3.
    assert size.value == pytest.approx(100 * (3 / np.sqrt(9 - 0.09) - 1))
    assert size.stderr == pytest.approx(size.value * 0.001 / 0.09, rel=0.02)
    unknown = pendula(findings=(one,), modes=([], [], []))
    assert list(added(unknown)[0].natural) == ["u[n]"]


@pytest.mark.parametrize(("order", "is_complex"), [(2, False), (1, True), (1, False)])
def test_every_number_of_every_effect_has_a_natural_form(
    order: int, is_complex: bool, forms: Callable[[Effect, Chain], list[Placed]], chain_of: Callable[..., Chain]
) -> None:
    chain = chain_of(5, order, is_complex=is_complex, levels=order)
    for effect in CATALOGUE:
        for placed in forms(effect, chain):
            found = placed.natural(chain, 2.0)
            assert len(found) >= len(placed.numbers)
            assert all(isinstance(value, float) and np.isfinite(value) for value in found.values())


# The noise ------------------------------------------------------------------------------------------------------------


def test_the_noise_is_said_for_each_sensor_in_the_units_of_its_readings(pendula: Made) -> None:
    found = content(pendula())
    assert found.noise == {"u1": 0.03, "u2": 0.02}
    assert found.noise_lines == ("sensor 1: 0.03", "sensor 2: 0.02")


def test_only_sensors_with_a_step_are_noted_to_have_one(pendula: Made) -> None:
    assert not any("multiples" in line for line in notes(pendula()))
    samples = pendula().data[0]
    u = samples.u.copy()
    u[:, 1] = 0.05 * np.round(u[:, 1] / 0.05)
    (note,) = [line for line in notes(pendula(data=(Samples(samples.t, u),))) if "multiples" in line]
    assert note.startswith("Readings of u2 are multiples of 0.05")


@pytest.mark.parametrize(("memory", "growth", "tail"), [(0.1, 0.0, np.inf), (0.0, 0.2, np.inf), (0.0, 0.0, 3.0)])
def test_noise_of_any_kind_lives_nowhere_in_particular(
    pendula: Made, noise_of: Callable[..., Noise], memory: float, growth: float, tail: float
) -> None:
    noise, draw = noise_of([0.03, 0.02], memory, growth, tail), np.random.default_rng(8)
    made = pendula()
    (curve,) = made.after.curves()
    near = np.exp(-np.diff(curve.t) / memory) if memory else np.zeros(len(curve.t) - 1)
    z = draw.standard_t(tail, size=(len(curve.t), 2)) if np.isfinite(tail) else draw.normal(size=(len(curve.t), 2))
    for k, rho in enumerate(near, start=1):
        z[k] = rho * z[k - 1] + np.sqrt(1 - rho**2) * z[k]
    left = z[:, None, None] * np.hypot([0.03, 0.02], growth * curve.level)
    noisy = SimpleNamespace(**{**vars(curve), "seen": curve.level + left})
    after = SimpleNamespace(**{**vars(made.after), "noise": noise, "curves": lambda: [noisy]})
    noisy_pendula = pendula(after=after, noise=noise.deviation())
    found = whereabouts(after, noisy_pendula)
    assert len(found.sites) + len(found.times) + len(found.frequencies) <= 1
    ((_, scaled),) = scaled_residuals(after, noisy_pendula)
    assert np.nanmean(scaled**2) == pytest.approx(1, abs=0.25)


# Where the residual lives, what is near, how the search went ----------------------------------------------------------


def test_modes_of_both_models_stand_beside_the_peaks_of_the_recording(pendula: Made) -> None:
    _, table = rows.modes(content(pendula()))
    assert table == [["3", "2.91", "3", "none", "20"], ["3.3", "3.24", "3.3", "none", "20"]]
    recording, before, _ = pendula().modes
    growing = pendula(modes=(recording, before, [SimpleNamespace(frequency=3.0, decay=-0.1)]))
    assert rows.modes(content(growing))[1][0][-1] == "grows, 10"


@pytest.mark.parametrize(("text", "shown"), [("1", ["3", "3.25, drive"]), ("u[n]", ["3", "3.35"])])
def test_a_peak_that_a_force_makes_has_its_name_and_one_beside_what_is_modulated_has_not(
    pendula: Made, text: str, shown: list[str]
) -> None:
    force = Harmonic(effect=find("drive"), texts=(text,), omega=3.25, strength=(0.1, 0.2))
    numbers = zip((*force.labels(pendula().after.chain), "omega"), force.numbers, strict=True)
    values = {name: (float(value), 0.01) for name, value in numbers}
    one = SimpleNamespace(placed=force, alternatives=(), evidence=9.0, values=values, name="drive")
    recording, before, after = pendula().modes
    far = [after[0], SimpleNamespace(frequency=3.35, decay=0.05)]
    found = pendula(findings=(one,), modes=([recording[0], SimpleNamespace(frequency=3.26, decay=0.0)], before, far))
    table = rows.modes(content(found))[1]
    assert [row[2] for row in table] == shown
    assert (table[1][4] == "none") == (text == "1")


def test_modes_are_listed_where_the_spectrum_has_no_peaks(pendula: Made) -> None:
    _, before, after = pendula().modes
    assert [row[2] for row in rows.modes(content(pendula(modes=([], before, after))))[1]] == ["3", "3.3"]


def test_each_horizon_has_its_leading_model_and_how_far_rivals_were_behind(pendula: Made) -> None:
    _, table = rows.horizons(content(pendula()))
    assert table == [["20", "0.5", "sensor-gain", "memory (3.2)"], ["800", "20", "damping + sensor-gain", ""]]


def test_what_is_left_without_a_name_is_told_with_its_site(pendula: Made, capsys: pytest.CaptureFixture[str]) -> None:
    left = SimpleNamespace(name="u[n]**4", gain=31.0, price=9.5, site=1, instead=())
    report = content(pendula(left=(left,), verdict="partly explained"))
    assert rows.left(report)[1] == [["u[n]**4", "2", "31.0", "9.5"]]
    assert "Something more is left" in report.sentence
    assert report.sentence.endswith("; it is small: in all, the model leaves 1 times the noise.")
    assert report.partly == (SMALL,)
    show(report)
    assert "u[n]**4" in capsys.readouterr().out
    many = tuple(SimpleNamespace(name=f"u[n]**{k}", gain=31.0, price=9.5, site=None, instead=()) for k in range(4, 24))
    table = rows.left(content(pendula(left=many, verdict="partly explained")))[1]
    assert len(table) == rows.SHOWN + 1
    assert table[-1][0] == "... and 12 more, in the JSON"


def test_what_does_better_than_an_effect_in_its_place_is_said_so(
    pendula: Made, capsys: pytest.CaptureFixture[str]
) -> None:
    rival = SimpleNamespace(name="t*u[n]", gain=9.4, price=3.0, site=None, instead=("damping", "sensor-gain"))
    report = content(pendula(left=(rival,), verdict="partly explained"))
    assert rows.left(report)[1] == []
    assert rows.instead(report)[1] == [["t*u[n]", "", "damping, sensor-gain", "9.4"]]
    assert "without a name, t*u[n], does better in the place of damping and sensor-gain" in report.sentence
    assert "more is left" not in report.sentence
    assert report.partly == (NAMELESS,)
    show(report)
    assert "better by" in capsys.readouterr().out


def test_what_is_left_is_not_called_small_where_the_readings_are_not_reached(pendula: Made) -> None:
    left = SimpleNamespace(name="u[n]**4", gain=31.0, price=9.5, site=1, instead=())
    rival = SimpleNamespace(name="t*u[n]", gain=9.4, price=3.0, site=None, instead=("damping",))
    report = content(pendula(left=(left, rival), verdict="partly explained", residual=(40.0, 7.0)))
    assert report.partly == (NAMELESS, NOT_REACHED)
    assert report.sentence.endswith("The model does not reach the readings: it leaves 7 times their noise.")
    assert content(pendula()).partly == ()
    assert content(pendula(findings=(), left=(left,), verdict="unexplained")).partly == ()


def test_a_model_that_loses_longer_pieces_puts_its_names_in_doubt(pendula: Made) -> None:
    report = content(pendula(whole=False, verdict="partly explained"))
    assert report.partly == (NOT_FOLLOWED,)
    assert "nothing significant is left" not in report.sentence
    assert re.search(r"over pieces of \d+ samples only: .*the names are in doubt\.$", report.sentence)


def test_the_terminal_shows_equation_search_errors_and_what_would_separate(
    pendula: Made, capsys: pytest.CaptureFixture[str]
) -> None:
    show(content(pendula()))
    out = capsys.readouterr().out
    for words in (
        "u'' = ", "*v[n]", "sensor 2: 0.02", "reads 1.677 times", "residual over the noise", "units of the readings",
        "cannot be told from unequal-masses, asymmetric-coupling", "truth", "decay time", "0.5", "memory (3.2)", "kick",
    ):  # fmt: skip
        assert words in out


# What would separate effects ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("order", "is_complex"), [(2, False), (1, True), (1, False)])
def test_every_pair_of_effects_has_a_measurement_that_would_separate_it(order: int, is_complex: bool) -> None:
    for one, other in itertools.combinations(CATALOGUE, 2):
        said = separation(one, other, order, is_complex)
        assert said == separation(other, one, order, is_complex)
        assert said[0].islower()
        assert not said.endswith(".")


@pytest.mark.parametrize(
    ("one", "other", "words"),
    [
        ("damping", "quadratic-drag", "swings of another size"),
        ("damping", "clock", "second clock"),
        ("defect", "sensor-gain", "other sensors"),
        ("unequal-masses", "sensor-gain", "other sensors"),
        ("unequal-masses", "defect", "waves of other lengths"),
        ("constant-force", "sensor-offset", "other sensors"),
        ("drive", "onsite-cubic", "begun at another time"),
        ("onsite-linear", "next-neighbour", "waves of other lengths"),
        ("damping", "onsite-linear", "another frequency"),
        ("onsite-linear", "trap", "middle of the chain"),
        ("defect", "onsite-linear", "elsewhere in the chain"),
    ],
)
def test_what_would_separate_two_effects_follows_from_how_they_act(one: str, other: str, words: str) -> None:
    assert words in separation(find(one), find(other), 2, False)


def test_an_alternative_of_the_users_own_is_told_as_well(pendula: Made) -> None:
    one = SimpleNamespace(**{**vars(pendula().findings[0]), "alternatives": ("cubic-drag",)})
    (found,) = content(pendula(findings=(one,))).separations
    assert (found.other, found.measurement) == (
        "cubic-drag",
        "a longer recording, less noise, or another initial state",
    )


# Notes ----------------------------------------------------------------------------------------------------------------


def test_it_is_noted_what_was_thinned_cut_into_pieces_or_not_followed_to_the_end(
    pendula: Made, chain_of: Callable[..., Chain]
) -> None:
    assert [note for note in notes(pendula()) if "declared equation is followed in 40 pieces of at most 20" in note]
    assert not [note for note in notes(pendula()) if "last model is followed" in note]
    after = pendula().after
    inner = Chain(**{**vars(after.chain), "ends": "unknown", "moving": (1,)})
    worse = SimpleNamespace(**{**vars(after), "pieces": 3, "longest": 300, "converged": False, "chain": inner})
    found = " ".join(notes(pendula(after=worse, used=(800, 4000), whole=False)))
    for words in (
        "last model is followed in 3 pieces of at most 300", "Of 4000 sample times 800", "steps did not end",
        "ends were not declared",
    ):  # fmt: skip
        assert words in found


def test_a_reading_far_beyond_all_others_is_pointed_at() -> None:
    t = np.linspace(0, 4, 30)
    u = np.stack([np.cos(t), np.sin(3 * t)], axis=1)
    assert strays(Samples(t, u, source="swing.csv")) == []
    u[7, 1] = 1e6
    v = np.zeros_like(u)
    (text,) = strays(Samples(t, u, v, source="swing.csv"))
    assert text.startswith(f"swing.csv: u2 at t = {t[7]:g} is 1e+06")
    assert "empty" in text


ANGLE = np.cumsum(np.full(400, 0.1)) + 0.02 * np.sin(np.arange(400))


@pytest.mark.parametrize(
    ("unit", "readings", "turn"),
    [
        ("", ANGLE % (2 * np.pi), "6.283185307179586"), ("", np.degrees(ANGLE) % 360, "360"),
        ("deg", np.degrees(ANGLE) % 360, "360"), ("arcmin", np.degrees(60 * ANGLE) % 21600, "21600"),
        # A square wave and a saw-tooth of about a turn, and what is said to be no angle.
        ("", 2.5 * np.sign(np.sin(0.2 * np.arange(400))) + 0.02 * np.sin(np.arange(400)), ""),
        ("", 0.05 * np.arange(400) % 5, ""), ("mm", np.degrees(ANGLE) % 360, ""), ("rad", np.degrees(ANGLE) % 360, ""),
    ],
)  # fmt: skip
def test_what_jumps_by_a_full_turn_and_goes_on_from_there_looks_like_an_angle(
    unit: str, readings: np.ndarray, turn: str
) -> None:
    samples = Samples(np.arange(400.0), readings[:, None], source="a.csv", origin=Origin(unit=unit))
    remedies = [found for line in turns(samples) for found in re.findall(r"--turn (\S+)", line)]
    assert remedies == ([turn] if turn else [])


def test_windows_of_one_recording_are_pointed_at_once(pendula: Made) -> None:
    t, u = np.arange(400.0), np.minimum(np.cos(0.1 * np.arange(400)), 0.8)[:, None]
    whole = Samples(t, u, source="long.csv")
    halves = tuple(replace(whole, t=t[rows], u=u[rows]) for rows in (slice(200), slice(200, None)))
    told = [[line for line in notes(pendula(data=data)) if "are just" in line] for data in ((whole,), halves)]
    assert len(told[0]) == 1
    assert told[0] == told[1]
