"""Numbers of a diagnosis in the units of the recording."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.bench.report.units import Units, in_sentence, noise_in_words, of_natural
from latticebench.diagnosis.noise import Noise, Structure

# A sensor that counts backwards, in millimetres.
MIRRORED = Units(time="s", reading="mm", equation="m", scale=-0.001)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("offset of u1: 0.02", "offset of u1: -20 mm"),
        ("drift of u3: -0.5 over the recording", "drift of u3: 500 mm over the recording"),
        # A standard deviation has no sign, whichever way the sensor counts.
        ("walk of u2: 0.5 over the recording, and so on", "walk of u2: 500 mm over the recording, and so on"),
        ("the ends are fixed", "the ends are fixed"),
    ],
)
def test_zeros_are_said_in_the_unit_of_the_readings(line: str, expected: str) -> None:
    assert in_sentence(line, MIRRORED) == expected


def test_the_natural_form_of_a_walk_is_positive_in_that_unit() -> None:
    assert of_natural("walk of u2", MIRRORED) == (1000.0, "mm")
    assert of_natural("offset of u2", MIRRORED) == (-1000.0, "mm")


def test_the_noise_says_how_far_a_zero_wanders_over_the_recording_in_that_unit() -> None:
    noise = Noise(np.array([0.001, 0.002]), 0.0, np.inf, np.zeros(2), Structure(own_sizes=True), np.array([0.0, 0.01]))
    lines = noise_in_words(noise, [0.0, 0.0], 0.1, 2, MIRRORED, span=25.0)
    assert lines == ["sensor 1: 1 mm", "sensor 2: 2 mm, a zero that wanders by 50 mm"]
