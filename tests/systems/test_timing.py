"""Times that a file rounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from latticebench.systems.layout import Layout
from latticebench.systems.readers import read
from latticebench.systems.timing import evened

RATE = 29.97


@given(
    step=st.floats(0.012, 0.3), begin=st.floats(-5.0, 500.0), decimals=st.sampled_from([2, 3, 4]),
    lost=st.sets(st.integers(1, 197), max_size=40),
)  # fmt: skip
def test_rounded_times_of_an_even_clock_are_put_back_on_its_grid(step, begin, decimals, lost):
    true = begin + step * np.delete(np.arange(199), sorted(lost))
    rounded = np.round(true, decimals)
    if np.any(np.diff(rounded) <= 0) or 10.0**-decimals > 0.5 * np.median(np.diff(rounded)):
        return
    found, notes = evened(rounded)
    digit = 10.0**-decimals
    if notes:
        # But for the zero of time, which stays that of the first row.
        assert np.ptp(found - true) < digit
        assert found[0] == rounded[0]
    else:
        np.testing.assert_array_equal(found, rounded)


def test_a_film_with_lost_frames_keeps_their_gaps():
    frames = np.delete(np.arange(600), [50, 51, 400])
    found, (note,) = evened(np.round(frames / RATE, 2))
    np.testing.assert_allclose(np.diff(found), np.diff(frames) / RATE, rtol=1e-4)
    assert note.startswith("times are rounded to 0.01: they are taken from the even grid of 0.0333")


@pytest.mark.parametrize("rate", [60, 59.94, 55, 48])
@pytest.mark.parametrize("rows", [60, 300, 2000])
def test_steps_of_one_or_two_units_of_the_last_digit_are_enough(rate, rows):
    found, notes = evened(np.round(np.arange(rows) / rate, 2))
    assert len(notes) == 1
    assert np.ptp(found - np.arange(rows) / rate) < 0.01


@pytest.mark.parametrize(("rate", "decimals"), [(30, 2), (300, 3)])
def test_seconds_since_1970_are_put_back_too(rate, decimals):
    true = 1.7e9 + np.arange(400) / rate
    found, notes = evened(np.round(true, decimals))
    assert len(notes) == 1
    assert np.ptp(found - true) < 10.0**-decimals


@pytest.mark.parametrize(
    "t",
    [
        1.7e9 + np.round(np.arange(400) * 0.04 + np.random.default_rng(1).uniform(-1.5e-3, 1.5e-3, 400), 6),
        1.7e12 + np.arange(400) * 40.0 + np.random.default_rng(1).uniform(-0.4, 0.4, 400),
        np.arange(200) / 20,
        np.arange(200) / RATE,
        np.round(np.arange(200) / RATE, 3),
        np.round(np.arange(200) / RATE + np.random.default_rng(1).uniform(-0.01, 0.01, 200), 2),
        np.round(np.cumsum(np.random.default_rng(1).uniform(0.03, 0.05, 200)), 3),
        np.array([0.0, 0.03, 0.07, 0.1]),
        np.where(np.arange(200) == 7, np.nan, np.arange(200) / RATE),
    ],
    ids=[
        "jitter since 1970", "the same in milliseconds", "even", "not rounded", "hardly rounded", "a jittery clock",
        "no clock", "few", "a time that is none",
    ],
)  # fmt: skip
def test_other_times_are_left_as_they_are(t):
    found, notes = evened(t)
    np.testing.assert_array_equal(found, t)
    assert notes == []


def test_a_reading_of_a_file_says_so(tmp_path):
    frames = np.arange(90)
    lines = [f"{k / RATE:.2f},{np.cos(3 * k / RATE):.4f}" for k in frames]
    (tmp_path / "film.csv").write_text("t,u1\n" + "\n".join(lines) + "\n")
    (film,) = read(tmp_path / "film.csv", "fixed")
    assert film.is_even
    assert "times are rounded to 0.01: they are taken from the even grid of 0.0333" in film.origin.notes[-1]
    np.testing.assert_allclose(film.t, frames / RATE, atol=3e-3)


def test_rows_are_chosen_by_the_times_that_the_file_has(tmp_path):
    lines = [f"{k / 30:.2f},{np.cos(k / 10):.4f}" for k in range(200)]
    (tmp_path / "film.csv").write_text("t,u1\n" + "\n".join(lines) + "\n")
    (film,) = read(tmp_path / "film.csv", "fixed", Layout(between=(0.5, 3.53)))
    assert len(film.t) == 92
    np.testing.assert_allclose(np.diff(film.t), 1 / 30, rtol=1e-3)
