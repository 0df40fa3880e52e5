"""The spectrum of a recording has the lines of the motion, whatever is missing."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.diagnosis.spectrum import Spectrum, alias, hidden, lines
from latticebench.systems.samples import Samples

# Cycles per unit of time, and times at which both sensors are read: 50 and 38 cycles, 20 readings in the shorter.
LINES = (1.0, 0.76)
TIMES = np.arange(1000) * 0.05


def recording(missing: np.ndarray) -> Samples:
    """Two sensors that swing with both frequencies, without the readings that are missing (T, 2)."""
    first, second = (np.cos(2 * np.pi * line * TIMES) for line in LINES)
    noise = 0.01 * np.random.default_rng(5).normal(size=(len(TIMES), 2))
    u = np.stack([first + 0.5 * second, 0.5 * first - second], axis=1) + noise
    u[missing] = np.nan
    return Samples(TIMES, u)


def cycles(missing: np.ndarray) -> list[float]:
    return sorted(Spectrum.of(recording(missing)).peaks / (2 * np.pi))


def gaps(*places: tuple[int, int], sensors: tuple[int, ...] = (1,)) -> np.ndarray:
    missing = np.zeros((len(TIMES), 2), dtype=bool)
    for first, length in places:
        for sensor in sensors:
            missing[first : first + length, sensor] = True
    return missing


@pytest.mark.parametrize("sensors", [(1,), (0, 1)])
@pytest.mark.parametrize("places", [[(300, 150)], [(150, 60), (700, 120)], [(0, 90), (880, 120)]])
def test_a_gap_of_several_periods_adds_no_line(places: list[tuple[int, int]], sensors: tuple[int, ...]) -> None:
    assert cycles(gaps(*places, sensors=sensors)) == pytest.approx(sorted(LINES), abs=0.02)


def test_gaps_shorter_than_half_a_period_do_not_blur_the_lines() -> None:
    many = [(200, 9), (410, 9), (730, 9)]
    whole, broken = (Spectrum.of(recording(gaps(*places))) for places in ((), many))
    assert np.array_equal(whole.omega, broken.omega)
    assert cycles(gaps(*many)) == pytest.approx(cycles(gaps()), abs=1e-3)


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_readings_missing_here_and_there_leave_the_lines_where_they_are(share: float) -> None:
    missing = np.random.default_rng(2).random((len(TIMES), 2)) < share
    assert cycles(missing) == pytest.approx(cycles(gaps()), abs=2e-3)


def test_a_sensor_without_readings_does_not_count() -> None:
    silent = gaps((0, len(TIMES)))
    assert cycles(silent) == pytest.approx(sorted(LINES), abs=0.02)


def many(*hums: tuple[int, float]) -> Samples:
    """Eighteen sensors of one motion of one cycle per unit of time, of which some hum with these cycles."""
    rng, times = np.random.default_rng(6), np.arange(3000) * 0.02
    u = np.cos(2 * np.pi * times)[:, None] * rng.normal(size=18) + 0.01 * rng.standard_t(4, size=(3000, 18))
    for sensor, line in hums:
        u[:, sensor] += 0.01 * np.sin(2 * np.pi * line * times)
    return Samples(times, u)


def test_a_line_of_the_size_of_the_noise_is_found_where_one_of_many_sensors_hums() -> None:
    found = lines(many((3, 16.67), (11, 21.3)), 12 * np.pi) / (2 * np.pi)
    assert found == pytest.approx([16.67, 21.3], abs=0.01)


def test_noise_and_the_slope_of_a_strong_motion_are_no_lines() -> None:
    assert len(lines(many(), 12 * np.pi)) == 0
    times = np.arange(3000) * 0.02
    # Without noise there is nothing but what a finite record makes of the motion.
    assert len(lines(Samples(times, np.exp(-0.05 * times)[:, None] * np.cos(6.1 * times)[:, None]), 12 * np.pi)) == 0


def test_beyond_half_the_rate_of_reading_nothing_is_looked_for() -> None:
    assert len(lines(many((3, 16.67)), 51 * np.pi)) == 0


@pytest.mark.parametrize("omega", [0.3, 3.1, 3.2, 9.0, 40.0])
def test_a_wave_that_is_read_too_seldom_looks_like_its_alias(omega: float) -> None:
    times = np.arange(50) * 1.0
    (seen,) = alias(np.array([omega]), 1.0)
    assert 0 <= seen <= np.pi
    np.testing.assert_allclose(np.cos(seen * times), np.cos(omega * times), atol=1e-9)


def test_what_rounded_times_make_of_the_motion_is_no_line_and_a_hum_beside_it_is() -> None:
    def read(rate: float, digits: int, hum: float = 0.0) -> Samples:
        times = np.arange(round(30 * rate)) / rate
        u = np.cos(2 * np.pi * times) + 0.02 * np.cos(2 * np.pi * hum * times) * (hum > 0)
        noise = 1e-4 * np.random.default_rng(3).normal(size=len(times))
        return Samples(np.round(times, digits), (u + noise)[:, None])

    for rate, digits in ((120.0, 3), (30.0, 2), (960.0, 3)):
        assert len(lines(read(rate, digits), 12 * np.pi)) == 0
    (found,) = lines(read(120.0, 3, hum=33.3), 12 * np.pi) / (2 * np.pi)
    assert found == pytest.approx(33.3, abs=0.02)


def test_the_wings_of_a_strong_line_are_no_lines() -> None:
    times = np.arange(3000) * 0.02
    strong = np.cos(2 * np.pi * times) + 0.5 * np.cos(2 * np.pi * 16.67 * times)
    samples = Samples(times, (strong + 1e-4 * np.random.default_rng(3).normal(size=3000))[:, None])
    assert lines(samples, 12 * np.pi) / (2 * np.pi) == pytest.approx([16.67], abs=0.01)


@pytest.mark.parametrize(
    ("cycles", "step", "count"),
    [
        ([50.0], 0.005, 0), ([50.0], 0.01, 1),  # at half the rate of reading
        ([50.0], 0.019, 1),  # like a slow one, of 2.6 cycles
        ([50.0, 150.0], 0.015, 1), ([50.0, 150.0], 0.0025, 0),  # like one another, at 16.7 cycles
    ],
)  # fmt: skip
def test_lines_are_hidden_where_they_look_like_slow_ones_like_one_another_or_like_noise(
    cycles: list[float], step: float, count: int
) -> None:
    assert hidden(2 * np.pi * np.array(cycles), step, above=2 * np.pi * 7.5, near=0.5) == count


@pytest.mark.parametrize("digits", [12, 3])
def test_a_hum_is_a_line_where_times_are_uneven_in_truth(digits: int) -> None:
    rng = np.random.default_rng(8)
    times = np.round(0.02 * (np.arange(3000) + rng.uniform(0, 0.9, 3000)), digits)
    u = np.cos(2 * np.pi * times) + 0.01 * np.cos(2 * np.pi * 16.67 * times) + 0.01 * rng.normal(size=3000)
    assert lines(Samples(times, u[:, None]), 12 * np.pi) / (2 * np.pi) == pytest.approx([16.67], abs=0.01)
