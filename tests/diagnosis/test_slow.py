"""Noise of which a part is white and a part is slow: its likelihood, its estimate, and what it is not taken for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import approx_fprime
from scipy.signal import lfilter

from latticebench.bench.trials.laboratory.instruments import Instrument
from latticebench.bench.trials.laboratory.making import make_recording
from latticebench.diagnosis import rules
from latticebench.diagnosis.averages import Averages
from latticebench.diagnosis.instrument import describe
from latticebench.diagnosis.noise import Noise, Structure
from latticebench.diagnosis.noise_estimate import estimate, preferred
from latticebench.diagnosis.noise_likelihood import Residuals
from latticebench.diagnosis.noise_parts import white
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.rows import Rows
from latticebench.systems.effects import CATALOGUE

BOTH = Structure(own_sizes=True, memory=True, white=True)


def rows_of(count, sensor, *, pieces=(), uneven=None, least=0.0):
    times = 0.1 * np.arange(count) if uneven is None else np.cumsum(uneven.uniform(0.03, 0.17, count))
    return Rows(times, np.isin(np.arange(count), [0, *pieces]), np.array(sensor), least=least)


def noise_of(share, memory, *, size=None, growth=0.0):
    size = np.ones(len(share)) if size is None else np.array(size)
    return Noise(size, growth, np.inf, np.array(memory), BOTH, white=np.array(share))


def drawn(seed, count, share, near, sizes=1.0):
    """White noise and slow noise of sensors that have nothing in common."""
    draw, v = np.random.default_rng(seed), np.array(share)
    driven = np.sqrt(1 - near**2) * draw.normal(size=(count, len(v)))
    slow = lfilter([1.0], [1.0, -near], driven, axis=0)
    return (np.sqrt(v) * draw.normal(size=slow.shape) + np.sqrt(1 - v) * slow) * sizes


# Moving averages ------------------------------------------------------------------------------------------------------


def banded(variance, beside):
    return np.diag(variance) + np.diag(beside[1:], 1) + np.diag(beside[1:], -1)


def test_moving_averages_are_made_independent():
    draw = np.random.default_rng(1)
    variance, beside = draw.uniform(1, 2, 12), draw.uniform(-0.4, 0.4, 12)
    averages, matrix = Averages.of(variance, beside), banded(variance, beside)
    inverse = averages.apply(np.eye(12))
    np.testing.assert_allclose(inverse @ matrix @ inverse.T, np.eye(12), atol=1e-12)
    np.testing.assert_allclose(averages.transposed(np.eye(12)), inverse.T, atol=1e-12)
    assert 2 * averages.log_scale == pytest.approx(np.linalg.slogdet(matrix)[1])


def test_the_slopes_of_a_likelihood_of_moving_averages_are_finite_differences():
    draw = np.random.default_rng(2)
    variance, beside = draw.uniform(1, 2, 9), draw.uniform(-0.4, 0.4, 9)
    beside[0], numbers = 0.0, draw.normal(size=9)

    def cost(of):
        averages = Averages.of(of[:9], np.concatenate([[0.0], of[9:]]))
        return averages.log_scale + np.sum(averages.apply(numbers) ** 2) / 2

    averages = Averages.of(variance, beside)
    fresh = averages.apply(numbers)
    by_variance, by_beside = averages.slopes(fresh, averages.transposed(fresh))
    expected = approx_fprime(np.concatenate([variance, beside[1:]]), cost, 1e-7)
    np.testing.assert_allclose(np.concatenate([by_variance, by_beside[1:]]), expected, atol=1e-5)


def test_there_may_be_no_numbers_at_all():
    nothing = Averages.of(np.zeros(0), np.zeros(0))
    assert (nothing.log_scale, nothing.apply(np.zeros(0)).size, nothing.transposed(np.zeros(0)).size) == (0.0, 0, 0)


# The likelihood and the whitening -------------------------------------------------------------------------------------


@pytest.mark.parametrize("sensor", [(0, 1), (0, 1, 0, 1)])
def test_the_likelihood_is_that_of_a_normal_distribution_with_the_covariance_of_white_and_slow_noise(sensor):
    """At uneven times, with gaps and pieces, and noise that grows with the signal; one sensor has no white part."""
    draw = np.random.default_rng(3)
    rows = rows_of(40, sensor, pieces=(15,), uneven=draw)
    noise = noise_of((0.4, 0.0), (0.5, 0.2), size=(1.0, 0.3), growth=0.4)
    left, level = draw.normal(size=(2, 40, len(sensor)))
    left[draw.random(left.shape) < 0.2] = np.nan
    piece, expected = np.cumsum(rows.first), 0.0
    for channel, one in enumerate(sensor):
        seen = np.isfinite(left[:, channel])
        apart = np.abs(rows.times[seen, None] - rows.times[seen])
        slow = np.exp(-apart / noise.memory[one]) * (piece[seen, None] == piece[seen])
        size = np.hypot(noise.size[one], 0.4 * level[seen, channel])
        covariance = noise.white[one] * np.eye(len(slow)) + (1 - noise.white[one]) * slow
        expected += stats.multivariate_normal(cov=size[:, None] * covariance * size).logpdf(left[seen, channel])
    assert noise.log_likelihood(left, level, rows) == pytest.approx(expected, rel=1e-10)


def test_beside_a_zero_that_wanders_each_sensor_has_the_likelihood_that_it_has_alone():
    draw = np.random.default_rng(15)
    rows, noise = rows_of(50, (0, 1), pieces=(15,)), noise_of((0.4, 0.0), (0.5, 0.0), size=(1.0, 2.0))
    noise = replace(noise, walk=np.array([0.0, 0.5]))
    left, level = draw.normal(size=(2, 50, 2))
    each = [np.where(np.arange(2) == one, left, np.nan) for one in range(2)]
    alone = sum(noise.log_likelihood(one, level, rows) for one in each)
    assert noise.log_likelihood(left, level, rows) == pytest.approx(alone, rel=1e-12)


def test_the_transposed_whitener_is_the_transposed_matrix_beside_a_zero_that_wanders():
    draw = np.random.default_rng(4)
    rows = rows_of(50, (0, 1, 2), pieces=(15,))
    noise = noise_of((0.4, 0.7, 0.0), (0.5, 0.2, 0.0), size=(1.0, 0.3, 2.0))
    whitener = replace(noise, walk=np.array([0.0, 0.0, 0.5])).whitener(
        np.ones((50, 3)), rows, draw.random((50, 3)) > 0.3
    )
    x, z = draw.normal(size=(2, 50, 3))
    assert np.sum(z * whitener.apply(x)) == pytest.approx(np.sum(whitener.transposed(z) * x))


def test_without_a_white_part_it_is_correlated_noise():
    rows, left = rows_of(200, (0, 1)), drawn(5, 200, (0.0, 0.0), 0.8)
    plain = noise_of((0.0, 0.0), (0.5, 0.2))
    nearly = noise_of((1e-9, 1e-9), (0.5, 0.2))
    whitened = [one.whitener(left, rows, np.ones(left.shape, bool)).apply(left) for one in (plain, nearly)]
    np.testing.assert_allclose(*whitened, rtol=1e-6, atol=1e-6)


def test_what_is_new_after_a_step_is_the_white_part_and_the_new_of_the_slow_one():
    slow = -np.expm1(-2 * 0.1 / 0.3)
    assert noise_of((0.4,), (0.3,), size=(2.0,)).fresh(0.1) == pytest.approx(2 * np.sqrt(0.4 + 0.6 * slow))


# The estimate ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("own", [False, True])
def test_the_gradient_of_the_likelihood_is_its_finite_difference(own):
    draw = np.random.default_rng(6)
    rows = rows_of(150, (0, 1, 2), pieces=(40,), uneven=draw)
    left, level = drawn(7, 150, (0.4,) * 3, 0.9, sizes=(1.0, 0.2, 3.0)), draw.normal(size=(150, 3))
    left[draw.random(left.shape) < 0.1] = np.nan
    task = Residuals.of(left, level, rows)
    structure = Structure(own_sizes=own, growth=True, tails=True, memory=True, white=True)
    numbers = task.packed(task.plain(structure), structure)
    expected = approx_fprime(numbers, lambda of: task.cost(of, structure)[0], 1e-7)
    np.testing.assert_allclose(task.cost(numbers, structure)[1], expected, atol=2e-6)


def test_shares_sizes_and_correlation_times_are_found_again():
    left = drawn(8, 20_000, (0.3, 0.6), 0.9, sizes=(1.0, 5.0))
    found = estimate(left, np.zeros_like(left), rows_of(20_000, (0, 1)))
    assert found.structure == BOTH
    np.testing.assert_allclose(found.white, [0.3, 0.6], atol=0.04)
    np.testing.assert_allclose(found.memory, -0.1 / np.log(0.9), rtol=0.15)
    np.testing.assert_allclose(found.size, [1.0, 5.0], rtol=0.05)


@pytest.mark.parametrize("near", [0.0, 0.7])
def test_noise_that_is_all_white_or_all_correlated_keeps_no_other_part(near):
    kept = 0
    for seed in range(40):
        left = drawn(seed, 600, (0.0, 0.0), near)
        rows = rows_of(600, (0, 1))
        free = estimate(left, np.zeros_like(left), rows).structure.white
        kept += free or estimate(left, np.zeros_like(left), rows, structure=BOTH).structure.white
    assert kept <= 2


@pytest.mark.parametrize(
    ("count", "share", "near", "piece"),
    [(300, 0.3, 0.9, 300), (1000, 0.3, 0.8, 1000), (300, 0.3, 0.98, 300), (2000, 0.4, 0.9, 10)],
)
def test_a_slow_part_that_is_worth_its_price_is_found_in_short_records_and_in_short_pieces(count, share, near, piece):
    kept = 0
    for seed in range(20):
        left = drawn(seed, count, (share,), near)
        rows = rows_of(count, (0,), pieces=range(piece, count, piece))
        task = Residuals.of(left, np.zeros_like(left), rows)
        plain, likelihood = task.likeliest(replace(BOTH, white=False), None)
        higher = task.likeliest(BOTH, plain)[1]
        found = preferred(task, BOTH, None)[0]
        worth = higher - likelihood > task.each + rules.BESIDE_WHITE
        assert not found.structure.white or worth
        kept += found.structure.white == worth
    assert kept >= 18


def test_the_price_of_a_white_part_counts_the_sensors_that_may_have_one():
    """What else is asked for and cannot be there costs nothing, nor do zeros that wander."""
    left = np.hstack([drawn(12, 400, (0.4,), 0.9), np.cumsum(np.random.default_rng(13).normal(size=(400, 3)), axis=0)])
    alone = estimate(left[:, :1], np.zeros((400, 1)), rows_of(400, (0,)), structure=BOTH)
    assert alone.price == pytest.approx(np.log(400) / 2 + rules.BESIDE_WHITE)
    assert alone.parameters == replace(alone, structure=replace(BOTH, white=False)).parameters
    asked = replace(BOTH, growth=True, common=True)
    other = estimate(left[:, :1], np.zeros((400, 1)), rows_of(400, (0,)), structure=asked)
    np.testing.assert_allclose((other.price, other.white[0]), (alone.price, alone.white[0]))
    rows = replace(rows_of(400, range(4)), walking=frozenset([1, 2, 3]))
    beside = estimate(left, np.zeros_like(left), rows, structure=BOTH)
    np.testing.assert_allclose((beside.price, beside.white[0]), (alone.price, alone.white[0]))


def test_where_all_zeros_wander_no_part_is_white_besides():
    left = np.cumsum(np.random.default_rng(14).normal(size=(400, 2)), axis=0)
    rows = replace(rows_of(400, (0, 1)), walking=frozenset([0, 1]))
    for structure in (None, BOTH):
        found = estimate(left, np.zeros_like(left), rows, structure=structure)
        assert (found.structure.white, len(found.white), found.price) == (False, 0, 0.0)


def test_what_is_new_from_one_reading_to_the_next_is_no_less_than_what_a_converter_lets_through():
    """A constant that is left looks slow; beside it, the size of the noise must not fall below its floor."""
    rows = rows_of(2000, (0,), least=1.0)
    left = 0.7 * np.random.default_rng(9).normal(size=(2000, 1)) + 0.7
    found = estimate(left, np.zeros_like(left), rows, structure=BOTH)
    assert found.structure.white
    assert found.fresh(0.1) >= 1 - 1e-6


def test_a_sensor_whose_noise_a_curve_follows_has_the_white_share_and_the_memory_of_the_others():
    left = drawn(10, 4000, (0.4, 0.4, 0.4), 0.9, sizes=(1.0, 1.0, 0.2))
    rows = replace(rows_of(4000, (0, 1, 2)), curved=frozenset([2]))
    found = estimate(left, np.zeros_like(left), rows, structure=BOTH)
    assert found.white[2] == pytest.approx(np.mean(found.white[:2]))
    assert found.memory[2] == pytest.approx(np.mean(found.memory[:2]))
    assert found.size[2] == pytest.approx(0.2, rel=0.1)


def test_a_zero_that_wanders_is_not_slow_noise_besides():
    left = drawn(11, 1000, (0.4, 0.4), 0.9)
    rows = replace(rows_of(1000, (0, 1)), walking=frozenset([1]))
    found = estimate(left, np.zeros_like(left), rows, structure=BOTH)
    assert 0.2 < found.white[0] < 0.6
    assert (found.white[1], found.memory[1]) == (0.0, 0.0)


def test_noise_without_what_may_hide_an_effect_is_white():
    plain = white(noise_of((0.4,), (0.3,)))
    assert plain.fresh(0.1) == pytest.approx(plain.size)


def test_the_report_says_how_much_of_the_noise_is_correlated():
    noise = noise_of((0.25, 0.25), (0.5, 0.5), size=(0.3, 0.3))
    assert describe(noise, (0.0, 0.0), "deg", interval=0.05, time="s") == [
        "all sensors: 0.3 deg, 75 % of its variance correlated over 0.5 s (0.68 from one reading to the next)"
    ]
    assert describe(noise_of((0.001,), (0.5,)), [0.0], time="s") == ["sensor 1: 1, correlated over 0.5 s"]
    assert describe(noise_of((0.999,), (0.5,)), [0.0], time="s") == ["sensor 1: 1"]


# Recordings -----------------------------------------------------------------------------------------------------------


def test_information_in_noise_with_a_slow_part_is_that_of_its_covariance():
    instrument = Instrument("slow", 0.5, np.array([1.0, 2.0]), slow=0.6, memory=0.9)
    columns = np.random.default_rng(12).normal(size=(25, 2, 3))
    apart = np.abs(np.arange(25)[:, None] - np.arange(25))
    information = np.zeros((3, 3))
    for site, size in enumerate((0.5, 1.0)):
        covariance = size**2 * (0.4 * np.eye(25) + 0.6 * 0.9**apart)
        information += columns[:, site].T @ np.linalg.solve(covariance, columns[:, site])
    whitened = instrument.whitened(columns.copy(), np.zeros((25, 2)), 1.0)
    np.testing.assert_allclose(whitened.T @ whitened, information, rtol=1e-10)


@pytest.mark.parametrize(("seed", "sites"), [(45200, 1), (45204, 2)])
def test_slow_noise_of_each_sensor_is_not_taken_for_zeros_that_wander(seed, sites):
    recording = make_recording(seed, "slow", [], sites=sites)
    found = diagnose(recording.declared, recording.order, [recording.samples], CATALOGUE)
    assert found.verdict == "nothing missing"
