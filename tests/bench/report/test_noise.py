"""The noise of sensors in words and in numbers."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.bench.report.noise import noise_in_numbers, noise_in_words
from latticebench.bench.report.units import Units
from latticebench.diagnosis.common import Common
from latticebench.diagnosis.noise import Noise, Structure

# A sensor that counts backwards, in millimetres.
MIRRORED = Units(time="s", reading="mm", equation="m", scale=-0.001)
OWN = Structure(own_sizes=True)


def test_it_says_how_far_a_zero_wanders_over_the_recording_in_the_unit_of_the_readings() -> None:
    noise = Noise(np.array([0.001, 0.002]), 0.0, np.inf, np.zeros(2), OWN, np.array([0.0, 0.01]))
    lines = noise_in_words(noise, [0.0, 0.0], 0.1, 2, MIRRORED, span=25.0)
    assert lines == ["sensor 1: 1 mm", "sensor 2: 2 mm, a zero that wanders by 50 mm"]
    numbers = noise_in_numbers(noise, MIRRORED, 25.0, 0.1)
    assert [one.wander for one in numbers] == pytest.approx([0.0, 50.0])


def test_shares_of_the_variance_are_those_of_a_long_draw() -> None:
    draw, count, near = np.random.default_rng(1), 200_000, 0.9
    slow = np.zeros((count, 2))
    fresh = np.sqrt(1 - near**2) * draw.normal(size=slow.shape)
    for row in range(1, count):
        slow[row] = near * slow[row - 1] + fresh[row]
    white = np.array([0.3, 0.8])
    x = np.sqrt(white) * draw.normal(size=slow.shape) + np.sqrt(1 - white) * slow
    noise = Noise(np.ones(2), 0.0, np.inf, np.full(2, -1 / np.log(near)), OWN, white=white)
    numbers = noise_in_numbers(noise, MIRRORED, 1.0, 1.0)
    # What is correlated keeps a share `near` of itself over one reading, what is white nothing.
    seen = np.array([np.mean(x[1:, k] * x[:-1, k]) / np.mean(x[:, k] ** 2) for k in range(2)])
    assert [one.next for one in numbers] == pytest.approx(seen, abs=0.02)
    assert [one.slow for one in numbers] == pytest.approx(seen / near, abs=0.02)
    assert [one.slow_over for one in numbers] == pytest.approx(np.full(2, -1 / np.log(near)))
    assert [one.deviation for one in numbers] == pytest.approx([1000.0, 1000.0])


def test_the_share_in_common_is_negative_for_the_sensor_that_is_turned_round() -> None:
    for turn in (1.0, -1.0):
        common = Common(turn * np.array([-0.6, 0.8, 0.9]), 2.0)
        noise = Noise(np.ones(3), 0.1, 5.0, np.array([1.0, 0.0, 1.0]), OWN, common=common)
        numbers = noise_in_numbers(noise, MIRRORED, 1.0, 1.0)
        assert [one.common for one in numbers] == pytest.approx([-0.36, 0.64, 0.81])
        assert [one.slow for one in numbers] == pytest.approx([0.64, 0.0, 0.19])
        assert {(one.common_over, one.tail) for one in numbers} == {(2.0, 5.0)}
        # Student's t has tails, which make more of the deviation of what grows, too.
        assert [one.growth for one in numbers] == pytest.approx([0.1 * np.sqrt(5 / 3)] * 3)


def test_white_gaussian_noise_has_nothing_else_to_say() -> None:
    (one,) = noise_in_numbers(Noise(np.ones(1), 0.0, np.inf, np.zeros(1), Structure()), MIRRORED, 1.0, 1.0)
    assert one.model_dump(exclude={"deviation"}) == {
        "slow": 0.0, "slow_over": None, "next": 0.0, "common": 0.0, "common_over": None, "wander": 0.0, "growth": 0.0,
        "tail": None,
    }  # fmt: skip
