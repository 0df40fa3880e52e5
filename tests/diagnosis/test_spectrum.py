"""The spectrum of a recording has the lines of the motion, whatever is missing."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.diagnosis.problem import Spectrum
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
