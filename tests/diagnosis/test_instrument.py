"""What readings alone say: which sensors do not work, the step of a converter, the noise and how it is put in words."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from latticebench.diagnosis.instrument import DEAD, dead_sensors, describe, of_readings, step_of, without
from latticebench.diagnosis.noise import Noise, Structure
from latticebench.systems.samples import Samples

NOISE = 0.03


def gaussian(count=500, seed=0):
    return np.random.default_rng(seed).normal(size=count)


def waves(t, period, *, second=0.4):
    return np.sin(2 * np.pi * t / period + 0.3) + second * np.sin(2 * np.pi * t / (1.7 * period))


# Sensors that do not work ---------------------------------------------------------------------------------------------


def seen(*, still=(), at=0.3, count=40, seed=0, gone=(), **fields):
    u = np.random.default_rng(seed).normal(size=(count, 4))
    u[:, list(still)] = at
    for cells in gone:
        u[cells] = np.nan
    return Samples(np.arange(float(count)), u, **fields)


def test_a_sensor_that_always_reads_the_same_while_others_change_does_not_work():
    assert dead_sensors([seen(still=[1, 3])]) == (1, 3)
    assert dead_sensors([seen(still=[1, 3], gone=[slice(5), (7, 3)])]) == (1, 3)
    assert dead_sensors([seen(still=range(4))]) == dead_sensors([seen()]) == ()
    assert dead_sensors([seen(still=[1], count=DEAD - 1)]) == ()
    assert dead_sensors([seen(still=[1], v=seen(seed=1).u)]) == ()
    assert dead_sensors([seen(still=[1], v=seen(seed=1, still=[1]).u)]) == (1,)


def test_a_sensor_works_that_changes_in_one_recording_or_between_two():
    assert dead_sensors([seen(still=[1]), seen()]) == ()
    assert dead_sensors([seen(still=[1]), seen(still=[1], at=0.4)]) == ()
    assert dead_sensors([seen(still=[1]), seen(still=[1, 2])]) == (1,)


def test_readings_that_are_left_out_are_missing_and_others_as_before():
    one = seen(still=[1], v=seen(seed=1).u)
    left = without(one, [1])
    assert np.all(np.isnan(left.u[:, 1]) & np.isnan(left.v[:, 1]))
    assert np.array_equal(left.u[:, [0, 2, 3]], one.u[:, [0, 2, 3]])
    assert without(one, []) is one


# The step of a converter ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("step", "offset"), [(0.1, 0.0), (1.0, -143.0), (2 * np.pi / 4096, 0.3), (0.0488281, 1e3), (3.7e-9, 0.0)]
)
def test_the_step_of_readings_on_a_grid_is_found(step, offset):
    assert step_of(step * np.round(gaussian() * 30) + offset) == pytest.approx(step, rel=1e-4)


@pytest.mark.parametrize(("step", "decimals"), [(0.0678, 2), (0.026, 3), (1.35, 1), (0.31, 1), (2.7, 0)])
def test_a_step_that_was_printed_with_few_digits_is_that_of_the_converter(step, decimals):
    for seed in range(10):
        readings = np.round(step * np.round(20 * gaussian(seed=seed)), decimals)
        assert step_of(readings) == pytest.approx(step, rel=0.01)


def test_numbers_in_single_precision_keep_their_step():
    readings = np.float64(np.float32(0.01 * np.round(100 * gaussian())))
    assert step_of(readings) == pytest.approx(0.01, rel=1e-6)


def test_printing_is_a_step_where_it_is_coarse_beside_the_scatter_and_none_where_it_has_six_digits():
    smooth = 5 * np.sin(np.linspace(0, 7, 500))
    assert step_of(np.round(gaussian(), 2)) == pytest.approx(0.01)
    assert step_of(np.round(gaussian(), 6)) == 0.0
    assert step_of(np.round(smooth + 2e-6 * gaussian(), 6)) == pytest.approx(1e-6)
    assert step_of(np.array([float(f"{one:.6g}") for one in gaussian()])) == 0.0


def test_readings_on_no_grid_have_no_step():
    assert [step_of(gaussian(count, seed)) for count in (5, 30, 1000) for seed in range(20)] == [0.0] * 60
    assert step_of(np.full(50, np.nan)) == step_of(np.zeros(50)) == step_of(np.array([])) == 0.0


# The size of the noise ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [200, 5000])
@pytest.mark.parametrize("period", [6, 8, 20, 100])
@pytest.mark.parametrize("uneven", [0.0, 0.6])
def test_the_noise_of_any_number_of_waves_is_found_from_the_readings_alone(count, period, uneven):
    found = []
    for seed in range(10):
        draw = np.random.default_rng(seed)
        t = np.arange(count) + uneven * draw.uniform(-0.5, 0.5, count)
        found.append(of_readings(t, (waves(t, period) + NOISE * draw.normal(size=count))[:, None])[0])
    assert np.mean(found) == pytest.approx(NOISE, rel=0.25 if count < 1000 else 0.1)
    assert np.all(np.array(found) < 1.7 * NOISE)


def test_thirty_readings_are_enough_for_an_estimate():
    t = np.arange(30.0)
    found = [of_readings(t, (waves(t, 12) + NOISE * gaussian(30, seed))[:, None])[0] for seed in range(20)]
    assert np.mean(found) == pytest.approx(NOISE, rel=0.25)


def test_each_sensor_has_its_own_noise_and_missing_readings_do_no_harm():
    t = np.arange(2000.0)
    u = waves(t, 15)[:, None] + gaussian(6000).reshape(2000, 3) * [0.01, 0.1, 0.02]
    u[100:300, 0] = u[::7, 1] = u[:, 2] = np.nan
    found = of_readings(t, u)
    np.testing.assert_allclose(found[:2], [0.01, 0.1], rtol=0.15)
    assert np.isnan(found[2])


def test_spikes_and_heavy_tails_hardly_change_the_size():
    t = np.arange(2000.0)
    draw = np.random.default_rng(1)
    spikes = np.where(draw.random(2000) < 0.02, 15, 1) * draw.normal(size=2000)
    assert of_readings(t, (waves(t, 15) + NOISE * spikes)[:, None])[0] == pytest.approx(NOISE, rel=0.25)


def test_the_estimate_of_correlated_noise_is_a_lower_one():
    t = np.arange(2000.0)
    coloured = lfilter([0.8], [1, -0.6], gaussian(2000))
    found = of_readings(t, (waves(t, 15) + NOISE * coloured)[:, None])[0]
    assert NOISE * 0.4 < found < NOISE


def test_where_noise_cannot_be_told_from_the_signal_there_is_no_estimate():
    t = np.arange(1000.0)
    fast = waves(t, 2.9, second=0.0) + NOISE * gaussian(1000)
    exact = waves(t, 20)
    assert np.all(np.isnan(of_readings(t, np.stack([fast, exact], axis=1))))
    assert np.isnan(of_readings(t[:4], exact[:4, None])[0])


def test_rounding_is_noise_where_there_is_no_other():
    t = np.arange(1000.0)
    assert of_readings(t, 0.1 * np.round(waves(t, 60)[:, None] / 0.1))[0] == pytest.approx(0.1 / 12**0.5)


def test_complex_readings_have_a_size_per_part():
    t = np.arange(2000.0)
    u = waves(t, 20) * np.exp(0.01j * t) + NOISE * (gaussian(2000) + 1j * gaussian(2000, 1))
    assert of_readings(t, u[:, None])[0] == pytest.approx(NOISE, rel=0.1)


def test_the_units_of_readings_and_of_time_do_not_matter():
    t = np.arange(800.0)
    u = (waves(t, 9) + NOISE * gaussian(800))[:, None]
    assert of_readings(1e-3 * t, 57.3 * u)[0] == pytest.approx(57.3 * of_readings(t, u)[0], rel=1e-9)


def test_a_long_record_takes_no_time():
    t = np.arange(100_000.0)
    u = (waves(t, 9) + NOISE * gaussian(100_000))[:, None]
    begin = time.process_time()
    assert of_readings(t, u)[0] == pytest.approx(NOISE, rel=0.05)
    assert time.process_time() - begin < 2


# In words -------------------------------------------------------------------------------------------------------------


def test_the_noise_of_each_sensor_is_said_in_the_units_of_the_readings():
    structure = Structure(own_sizes=True, growth=True, tails=True, memory=True)
    noise = Noise(np.array([0.01, 0.031 / 2**0.5]), 0.03, 4.0, np.array([0.0, 0.12]), structure)
    first, second = describe(noise, [0.0, 0.026], "deg", interval=0.11, time="s")
    assert (
        first == "sensor 1: 0.014 deg, tails of Student's t with 4 degrees of freedom, grows with the signal by 4.2 %"
    )
    assert second == (
        "sensor 2: 0.031 deg, steps of 0.026, correlated over 0.12 s (0.4 from one reading to the next), "
        "tails of Student's t with 4 degrees of freedom, grows with the signal by 4.2 %"
    )


def test_sensors_that_are_alike_are_said_in_one_line():
    noise = Noise(np.full(3, 120.4), 0.0, np.inf, np.zeros(3), Structure())
    assert describe(noise, [0.0, 0.0, 0.01]) == ["all sensors: 120"]
    assert describe(noise, [0.0, 0.0, 200.0])[2] == "sensor 3: 120, steps of 200"
    noise = replace(noise, size=np.array([120.4, np.nan, 120.4]))
    assert describe(noise, [0.0, 9.0, 200.0]) == ["sensor 1: 120", "sensor 3: 120, steps of 200"]
    assert describe(noise, [0.0, 9.0, 0.0]) == ["all sensors: 120"]
