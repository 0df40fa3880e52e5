"""Times that a file rounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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


@pytest.mark.parametrize(
    "t",
    [
        np.arange(200) / 20,
        np.arange(200) / RATE,
        np.round(np.arange(200) / RATE + np.random.default_rng(1).uniform(-0.01, 0.01, 200), 2),
        np.round(np.cumsum(np.random.default_rng(1).uniform(0.03, 0.05, 200)), 3),
        np.array([0.0, 0.03, 0.07, 0.1]),
        np.where(np.arange(200) == 7, np.nan, np.arange(200) / RATE),
    ],
    ids=["even", "not rounded", "a jittery clock", "no clock", "few", "a time that is none"],
)
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
