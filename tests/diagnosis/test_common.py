"""Noise that sensors have in common: its likelihood, its estimate, and what a shaking camera is not taken for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import approx_fprime
from scipy.signal import lfilter

from latticebench.bench.trials.laboratory.instruments import Instrument
from latticebench.bench.trials.laboratory.making import make_recording
from latticebench.diagnosis.common import Common
from latticebench.diagnosis.instrument import describe
from latticebench.diagnosis.noise import Noise, Structure
from latticebench.diagnosis.noise_estimate import estimate, preferred
from latticebench.diagnosis.noise_likelihood import Residuals
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.rows import Rows
from latticebench.systems.effects import CATALOGUE

SHARED = Structure(own_sizes=True, common=True)


def rows_of(count, sensor, *, pieces=(), uneven=None):
    times = 0.1 * np.arange(count) if uneven is None else np.cumsum(uneven.uniform(0.03, 0.17, count))
    return Rows(times, np.isin(np.arange(count), [0, *pieces]), np.array(sensor))


def noise_of(share, memory=0.0, *, size=None, own=0.0):
    count = len(share)
    sizes = np.ones(count) if size is None else np.array(size)
    structure = replace(SHARED, memory=own > 0)
    return Noise(sizes, 0.0, np.inf, np.full(count, own), structure, common=Common(np.array(share), memory))


def covariance_of(noise, rows, seen):
    """The whole covariance of the readings that were seen, in the order of rows and channels."""
    apart, same = np.abs(rows.times[:, None] - rows.times), np.cumsum(rows.first)[:, None] == np.cumsum(rows.first)
    c = noise.common.share[rows.sensor]
    part = np.array([np.sum(rows.sensor[:k] == one) for k, one in enumerate(rows.sensor)])
    total = 0.0
    for time, share in (
        (noise.memory[0], np.diag(1 - c**2)),
        (noise.common.memory, np.outer(c, c) * (part[:, None] == part)),
    ):
        near = np.exp(-apart / time) if time > 0 else np.eye(len(apart))
        total = total + np.kron(near * same, share)
    size = np.tile(noise.size[rows.sensor], len(rows.times))
    return (size[:, None] * total * size)[np.ix_(seen.ravel(), seen.ravel())]


def shaken(seed, count, share, memory, *, sizes=1.0):
    draw = np.random.default_rng(seed)
    c = np.array(share)
    driven = np.sqrt(1 - memory**2) * draw.normal(size=(count, 1))
    common = lfilter([1.0], [1.0, -memory], driven, axis=0)
    return (np.sqrt(1 - c**2) * draw.normal(size=(count, len(c))) + c * common) * sizes


# The likelihood and the whitening -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("own", "memory", "gone", "sensor"),
    [
        (0.0, 0.0, 0.3, (0, 1, 2)),
        (0.0, 0.4, 0.3, (0, 1, 2)),
        (0.0, 0.4, 0.3, (0, 1, 2, 0, 1, 2)),
        (0.25, 0.25, 0.0, (0, 1, 2)),
        (0.25, 0.0, 0.0, (0, 1, 2)),
        (0.05, 2.0, 0.0, (0, 1, 2)),
        (0.5, 0.1, 0.0, (0, 1, 2, 0, 1, 2)),
    ],
)
def test_the_likelihood_is_that_of_a_normal_distribution_with_the_whole_covariance(own, memory, gone, sensor):
    """With white noise of the sensors' own at uneven times and with gaps; with one correlation time at even times."""
    draw = np.random.default_rng(1)
    rows = rows_of(30, sensor, pieces=(12,), uneven=draw if own == 0 else None)
    noise = noise_of((0.9, 0.6, -0.4), memory, size=(1.0, 0.3, 2.0), own=own)
    left = draw.normal(size=(30, len(sensor)))
    left[draw.random(left.shape) < gone] = np.nan
    if gone:
        left[7] = np.nan
    seen = np.isfinite(left)
    expected = stats.multivariate_normal(cov=covariance_of(noise, rows, seen)).logpdf(left[seen])
    assert noise.log_likelihood(left, np.ones_like(left), rows) == pytest.approx(expected, rel=1e-10)


def test_correlations_in_time_of_both_parts_are_whitened_nearly():
    rows = rows_of(20_000, range(4))
    noise = noise_of((0.8, 0.7, 0.8, 0.6), 0.5, own=0.1)
    draw = np.random.default_rng(2)
    c, (near, far) = noise.common.share, np.exp(-0.1 / np.array([0.1, 0.5]))
    own = lfilter([np.sqrt(1 - near**2)], [1.0, -near], draw.normal(size=(20_000, 4)), axis=0)
    common = lfilter([np.sqrt(1 - far**2)], [1.0, -far], draw.normal(size=(20_000, 1)), axis=0)
    left = np.sqrt(1 - c**2) * own + c * common
    z = noise.whitener(left, rows, np.ones(left.shape, bool)).apply(left)
    together = np.corrcoef(np.hstack([z[2:], z[1:-1], z[:-2]]).T)
    assert np.max(np.abs(together - np.eye(12))) < 5 / np.sqrt(20_000)
    assert np.std(z, axis=0) == pytest.approx(1, abs=0.02)


def test_the_transposed_whitener_is_the_transposed_matrix_and_derivatives_are_whitened_as_residuals_are():
    draw = np.random.default_rng(3)
    rows = rows_of(40, (0, 1, 2, 0, 1, 2), pieces=(15,))
    noise = noise_of((0.9, 0.6, -0.4), 0.3, size=(1.0, 0.3, 2.0), own=0.2)
    whitener = noise.whitener(np.ones((40, 6)), rows, draw.random((40, 6)) > 0.3)
    x, z = draw.normal(size=(2, 40, 6))
    assert np.sum(z * whitener.apply(x)) == pytest.approx(np.sum(whitener.transposed(z) * x))
    many = draw.normal(size=(40, 6, 3, 2))
    np.testing.assert_allclose(whitener.apply(many)[..., 2, 1], whitener.apply(many[..., 2, 1]), rtol=1e-12)


def test_what_is_new_after_a_step_is_that_of_both_parts():
    noise = noise_of((0.8, 0.0), 0.3, size=(2.0, 1.0), own=0.2)
    new = [-np.expm1(-2 * 0.1 / time) for time in (0.2, 0.3)]
    expected = [2 * np.sqrt(0.36 * new[0] + 0.64 * new[1]), np.sqrt(new[0])]
    np.testing.assert_allclose(noise.fresh(0.1), expected)


# The estimate ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sensor", [(0, 1), (0, 1, 2, 3), (0, 1, 2, 0, 1, 2)])
@pytest.mark.parametrize("own", [False, True])
def test_the_gradient_of_the_likelihood_is_its_finite_difference(sensor, own):
    draw = np.random.default_rng(4)
    rows = rows_of(150, sensor, pieces=(40,), uneven=draw)
    left = draw.normal(size=(150, len(sensor))) + draw.normal(size=(150, 1))
    left[draw.random(left.shape) < 0.1] = np.nan
    left[90] = np.nan
    level = np.cos(rows.times[:, None] + np.arange(len(sensor)))
    every = Structure(own, True, True, True, True)
    task = Residuals.of(left, level, rows)
    start = task.packed(task.plain(every), every)
    numbers = start + 0.03 * draw.normal(size=len(start))
    cost, gradient = task.cost(numbers, every)
    np.testing.assert_allclose(gradient, approx_fprime(numbers, lambda x: task.cost(x, every)[0], 1e-7), atol=1e-5)
    whole = -len(task.value) * (cost + np.log(task.unit))
    assert task.unpacked(numbers, every).log_likelihood(left, level, rows) == pytest.approx(whole)


def test_shares_sizes_and_the_correlation_time_are_found_again():
    share, sizes = (0.9, 0.8, 0.5, -0.4, 0.7), np.array([1.0, 0.5, 2.0, 1.0, 1.0])
    rows = rows_of(4000, range(5))
    found = [estimate(left := shaken(seed, 4000, share, 0.9, sizes=sizes), 0 * left, rows) for seed in range(4)]
    for one in found:
        assert one.structure == SHARED
        np.testing.assert_allclose(one.size, sizes, rtol=0.12)
        np.testing.assert_allclose(one.common.share, share, atol=0.08)
        assert one.common.memory == pytest.approx(-0.1 / np.log(0.9), rel=0.25)


def test_two_sensors_show_their_correlation_with_its_sign_and_no_more():
    rows = rows_of(2000, range(2))
    for sign in (1, -1):
        left = shaken(5, 2000, (0.9, 0.6 * sign), 0.0)
        found = estimate(left, 0 * left, rows, structure=SHARED)
        assert np.prod(found.common.share) == pytest.approx(sign * 0.54, abs=0.05)
        assert abs(found.common.share[0]) == pytest.approx(abs(found.common.share[1]))
    assert SHARED.parameters(2) == 4
    assert SHARED.parameters(3) == 7


def test_sensors_with_nothing_in_common_keep_the_simplest_form():
    draw = np.random.default_rng(6)
    for sensors in (2, 3, 7):
        rows = rows_of(400, range(sensors))
        found = [estimate(left := draw.normal(size=(400, sensors)), np.cos(left), rows).structure for _ in range(60)]
        assert sum(one.common for one in found) <= 1, sensors


def test_a_sensor_that_was_never_read_has_nothing_in_common():
    left = shaken(7, 500, (0.8, 0.8, 0.8, 0.8), 0.0)
    left[:, 2] = np.nan
    found = estimate(left, 0 * left, rows_of(500, range(4)), structure=SHARED)
    assert found.common.share[2] == 0
    assert np.all(found.common.share[[0, 1, 3]] > 0.6)
    assert np.isfinite(found.log_likelihood(left, 0 * left, rows_of(500, range(4))))


def test_a_sensor_whose_noise_a_curve_follows_has_the_mean_share_of_the_others():
    left = shaken(8, 1500, (0.8,) * 4, 0.5)
    left[:, 2] = np.nan
    rows = replace(rows_of(1500, range(4)), curved=frozenset([0]))
    for structure in (SHARED, Structure(common=True)):
        found = estimate(left, 0 * left, rows, structure=structure)
        assert found.common.share[0] == pytest.approx(np.mean(found.common.share[[1, 3]]))
        assert found.common.share[0] > 0.7


def test_the_likelihood_of_an_estimate_is_that_of_the_search_for_it_at_its_bounds_too():
    for seed in range(3):
        draw = np.random.default_rng(seed)
        own = lfilter([0.6], [1.0, -0.8], draw.normal(size=(400, 3)), axis=0)
        left = np.sqrt(0.4) * own + np.sqrt(0.6) * draw.normal(size=(400, 1))
        rows = rows_of(400, range(3))
        task = Residuals.of(left, np.ones_like(left), rows)
        found, height = preferred(task, replace(SHARED, memory=True), None)
        assert found.log_likelihood(left, np.ones_like(left), rows) == pytest.approx(height, abs=0.5)


def test_sensors_that_are_read_in_turn_have_no_memory_of_their_own_beside_what_is_common():
    left = shaken(9, 600, (0.8, 0.8, 0.8), 0.7)
    left[np.random.default_rng(10).random(left.shape) < 0.2] = np.nan
    rows = rows_of(600, range(3))
    found = estimate(left, 0 * left, rows, structure=replace(SHARED, memory=True))
    assert not found.structure.memory
    assert np.all(found.memory == 0)
    np.testing.assert_allclose(found.common.share, 0.8, atol=0.1)


# The diagnosis --------------------------------------------------------------------------------------------------------


def test_the_report_says_what_sensors_have_in_common():
    lines = describe(noise_of((0.9, -0.6), 0.5), [0.0, 0.0], "mm", interval=0.1, time="s")
    assert "81 % of its variance in common with the other sensors, correlated over 0.5 s" in lines[0]
    assert "36 % of its variance in common with the other sensors, turned round" in lines[1]


def test_information_in_noise_with_a_common_part_is_that_of_its_covariance():
    one = Instrument("shaken", 0.01, np.ones(3), common=0.6, sway=0.7, turn=0.5)
    columns = one.whitened(np.eye(60).reshape(20, 3, 60), np.zeros((20, 3)), 1.0)
    apart = np.abs(np.arange(20)[:, None] - np.arange(20))
    lever = np.array([0.75, 1.0, 1.25])
    covariance = 1e-4 * (0.4 * np.eye(60) + 0.6 * np.kron(0.7**apart, np.outer(lever, lever)))
    np.testing.assert_allclose(columns.T @ columns @ covariance, np.eye(60), atol=1e-10)


@pytest.mark.parametrize("seed", [50100, 50101])
def test_a_camera_that_shakes_is_not_taken_for_a_force(seed):
    one = make_recording(seed, "shaken", effects=[], sites=3)
    found = diagnose(one.declared, one.order, [one.samples], CATALOGUE)
    assert found.verdict == "nothing missing"
    assert found.after.noise.common is not None
