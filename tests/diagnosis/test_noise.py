"""The noise of instruments: its likelihood, its whitening, its estimate, and which of its parts are used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from latticebench.diagnosis.fitting import spread
from latticebench.diagnosis.noise import Noise, Structure
from latticebench.diagnosis.noise_estimate import estimate
from latticebench.diagnosis.rows import Rows

EVERY_PART = Structure(own_sizes=True, growth=True, tails=True, memory=True)


def rows_of(count, channels, *, interval=0.1, pieces=(), uneven=None):
    times = interval * np.arange(count)
    if uneven is not None:
        times = np.cumsum(interval * uneven.uniform(0.3, 1.7, count))
    first = np.isin(np.arange(count), [0, *pieces])
    return Rows(times, first, np.arange(channels))


def levels_of(rows):
    return np.stack([(1 + k / 2) * np.cos(1.3 * rows.times + k) for k in range(len(rows.sensor))], axis=1)


def draw_of(noise, level, rows, seed):
    """Noise of a model, drawn reading by reading."""
    draw = np.random.default_rng(seed)
    z = draw.standard_t(noise.tail, level.shape) if np.isfinite(noise.tail) else draw.normal(size=level.shape)
    y = z.copy()
    time = np.where(noise.memory > 0, noise.memory, 1e-9)[rows.sensor]
    for k in np.flatnonzero(~rows.first):
        rho = np.exp(-(rows.times[k] - rows.times[k - 1]) / time)
        y[k] = rho * y[k - 1] + np.sqrt(1 - rho**2) * z[k]
    return y * np.hypot(noise.size[rows.sensor], noise.growth * level)


def made_of(*, size=(1.0, 1.0), growth=0.0, tail=np.inf, memory=(0.0, 0.0)):
    return Noise(np.array(size), growth, tail, np.array(memory), EVERY_PART)


# The likelihood and the whitening -------------------------------------------------------------------------------------


def test_the_likelihood_of_correlated_noise_is_that_of_a_normal_distribution_with_its_whole_covariance():
    draw = np.random.default_rng(1)
    rows = rows_of(60, 2, pieces=(25,), uneven=draw)
    level, noise = levels_of(rows), made_of(size=(0.3, 0.5), growth=0.4, memory=(0.2, 0.05))
    left = draw.normal(size=level.shape)
    left[draw.random(left.shape) < 0.2] = np.nan
    total = 0.0
    for channel in range(2):
        seen = np.isfinite(left[:, channel])
        times, piece = rows.times[seen], np.cumsum(rows.first)[seen]
        size = np.hypot(noise.size[channel], noise.growth * level[seen, channel])
        near = np.exp(-abs(times[:, None] - times) / noise.memory[channel]) * (piece[:, None] == piece)
        total += stats.multivariate_normal(cov=size[:, None] * near * size).logpdf(left[seen, channel])
    assert noise.log_likelihood(left, level, rows) == pytest.approx(total, rel=1e-10)


def test_the_likelihood_of_white_noise_with_tails_is_that_of_students_t():
    rows = rows_of(100, 2)
    level, noise = levels_of(rows), made_of(size=(0.3, 0.5), growth=0.4, tail=3.5)
    left = draw_of(noise, level, rows, 2)
    expected = stats.t(3.5, scale=np.hypot(noise.size, noise.growth * level)).logpdf(left).sum()
    assert noise.log_likelihood(left, level, rows) == pytest.approx(expected, rel=1e-10)


def test_whitened_noise_is_white_and_of_size_one_and_zero_where_nothing_was_read():
    draw = np.random.default_rng(3)
    rows = rows_of(20_000, 2, uneven=draw, pieces=(7000,))
    level, noise = levels_of(rows), made_of(size=(0.3, 0.5), growth=0.4, memory=(0.2, 0.05))
    seen = draw.random(level.shape) > 0.1
    z = noise.whitener(level, rows, seen).apply(np.where(seen, draw_of(noise, level, rows, 4), np.nan))
    assert np.all(z[~seen] == 0)
    assert np.std(z[seen]) == pytest.approx(1, abs=0.015)
    for channel in range(2):
        one = z[seen[:, channel], channel]
        assert abs(np.corrcoef(one[1:], one[:-1])[0, 1]) < 4 / np.sqrt(len(one))


def test_derivatives_are_whitened_as_residuals_are():
    draw = np.random.default_rng(5)
    rows = rows_of(30, 3, pieces=(11,))
    noise = Noise(np.array([1.0, 2.0, 3.0]), 0.2, np.inf, np.array([0.1, 0.0, 0.3]), EVERY_PART)
    slopes = draw.normal(size=(30, 3, 4, 2))
    whitener = noise.whitener(levels_of(rows), rows, draw.random((30, 3)) > 0.3)
    together = whitener.apply(slopes)
    assert together.shape == slopes.shape
    np.testing.assert_allclose(together[:, :, 2, 1], whitener.apply(slopes[:, :, 2, 1]), rtol=1e-14)


def test_weighted_least_squares_of_innovations_have_the_slope_of_the_likelihood():
    rows = rows_of(40, 2)
    level, noise = levels_of(rows), made_of(tail=4.0, memory=(0.2, 0.1))
    left, way = draw_of(noise, level, rows, 6), np.random.default_rng(7).normal(size=level.shape)
    whitener = noise.whitener(level, rows, np.ones(level.shape, bool))
    z = whitener.apply(left)
    weighted = whitener.robust(z)
    slope = -np.sum(weighted**2 * z * whitener.apply(way))
    up, down = (noise.log_likelihood(left + step * way, level, rows) for step in (1e-5, -1e-5))
    assert slope == pytest.approx((up - down) / 2e-5, rel=1e-6)


# The estimate ---------------------------------------------------------------------------------------------------------


def test_sizes_growth_tails_and_memory_are_found_again():
    truth = made_of(size=(0.1, 0.3), growth=0.2, tail=4.0, memory=(0.15, 0.08))
    rows = rows_of(8000, 2, uneven=np.random.default_rng(8))
    level = levels_of(rows)
    found = [estimate(draw_of(truth, level, rows, seed), level, rows, structure=EVERY_PART) for seed in range(6)]
    for name, share in (("size", 0.05), ("growth", 0.03), ("tail", 0.08), ("memory", 0.06)):
        values = np.stack([getattr(one, name) for one in found])
        spread = np.std(values, axis=0, ddof=1)
        assert np.all(spread < share * getattr(truth, name)), name
        assert np.all(abs(np.mean(values, axis=0) - getattr(truth, name)) < 4 * spread / np.sqrt(6)), name


def test_the_estimate_is_where_the_likelihood_is_greatest():
    truth = made_of(size=(0.1, 0.3), growth=0.2, tail=4.0, memory=(0.15, 0.08))
    rows = rows_of(500, 2)
    level = levels_of(rows)
    left = draw_of(truth, level, rows, 9)
    best = estimate(left, level, rows, structure=EVERY_PART)
    height = best.log_likelihood(left, level, rows)
    for factor in (0.98, 1.02):
        for name in ("size", "growth", "tail", "memory"):
            other = replace(best, **{name: getattr(best, name) * factor})
            assert other.log_likelihood(left, level, rows) < height


def test_white_noise_has_no_memory_though_some_readings_nearly_coincide():
    draw = np.random.default_rng(12)
    times = np.sort(np.arange(600) + 0.9 * draw.uniform(-1, 1, 600))
    times[1::50] = times[::50] + 1e-5
    rows = Rows(times, np.arange(600) == 0, np.arange(1))
    left, level = draw.normal(size=(600, 1)), np.zeros((600, 1))
    structure = Structure(memory=True)
    far = Noise(np.array([12.0]), 0.0, np.inf, np.array([50.0]), structure)
    for start in (None, far):
        found = estimate(left, level, rows, structure=structure, start=start)
        assert found.size[0] == pytest.approx(np.std(left), rel=0.05)
        assert found.memory[0] < 0.6


@pytest.mark.parametrize("tail", [2.7, 4.0, 30.0])
def test_the_spread_of_a_fit_with_heavy_tails_is_that_of_fishers_information(tail):
    z = np.random.default_rng(13).standard_t(tail, (200_000, 1))
    robust = np.sqrt((tail + 1) / (tail + z**2))
    assert spread(z * robust, robust, tail) == pytest.approx((tail + 3) / (tail + 1), rel=0.03)
    assert spread(z, np.ones_like(z), np.inf) == 1.0


def test_numbers_that_a_fit_took_make_the_noise_larger():
    rows = rows_of(100, 1)
    left = draw_of(replace(made_of(), size=np.ones(1), memory=np.zeros(1)), levels_of(rows), rows, 10)
    one = estimate(left, levels_of(rows), rows, structure=Structure(False, False, False, False), free=36)
    assert one.size[0] == pytest.approx(np.sqrt(np.sum(left**2) / 64))
    assert one.parameters == 1


def test_the_standard_deviation_of_students_t_is_larger_than_its_scale():
    noise = made_of(size=(0.1, 0.2), tail=3.0)
    np.testing.assert_allclose(noise.deviation(), [0.1 * 3**0.5, 0.2 * 3**0.5])


@pytest.mark.parametrize("left", [0.0, 1e-16])
def test_residuals_of_nothing_but_rounding_have_a_size(left):
    rows = rows_of(50, 2)
    level = levels_of(rows)
    residuals = left * np.random.default_rng(11).normal(size=level.shape)
    found = [estimate(residuals, level, rows), estimate(residuals, level, rows, structure=EVERY_PART)]
    found.append(estimate(np.where([True, False], residuals, 0.01 * level**2), level, rows))
    for noise in found:
        assert np.all(noise.size > 0)
        assert np.isfinite(noise.log_likelihood(residuals, level, rows))


def test_a_sensor_without_readings_and_a_record_without_any_do_no_harm():
    rows = rows_of(50, 2)
    left = np.random.default_rng(12).normal(size=(50, 2))
    left[:, 1] = np.nan
    for structure in (None, EVERY_PART):
        found = estimate(left, levels_of(rows), rows, structure=structure)
        assert np.all(np.isfinite(found.size))
        nothing = estimate(np.full((50, 2), np.nan), levels_of(rows), rows, structure=structure)
        assert np.all(np.isfinite(nothing.size))


def test_another_unit_of_readings_and_of_time_is_the_same_noise():
    truth = made_of(size=(0.1, 0.3), growth=0.2, tail=4.0, memory=(0.15, 0.08))
    rows = rows_of(1500, 2, pieces=(700,))
    level = levels_of(rows)
    left = draw_of(truth, level, rows, 13)
    for structure in (None, EVERY_PART):
        here = estimate(left, level, rows, structure=structure)
        other = replace(rows, times=1000 * rows.times)
        there = estimate(57.3 * left, 57.3 * level, other, structure=structure)
        assert there.structure == here.structure
        np.testing.assert_allclose(there.size, 57.3 * here.size, rtol=1e-4)
        np.testing.assert_allclose(there.memory, 1000 * here.memory, rtol=1e-4)
        np.testing.assert_allclose([there.growth, there.tail], [here.growth, here.tail], rtol=1e-4)
        shift = np.log(57.3) * left.size
        assert there.log_likelihood(57.3 * left, 57.3 * level, other) == pytest.approx(
            here.log_likelihood(left, level, rows) - shift, abs=1e-2
        )


# Which parts are used -------------------------------------------------------------------------------------------------

KINDS = {
    "white": Structure(),
    "unequal": Structure(own_sizes=True),
    "tails": Structure(tails=True),
    "coloured": Structure(memory=True),
    "proportional": Structure(growth=True),
    "spikes": Structure(tails=True),
}


def recording_of(kind, seed):
    draw = np.random.default_rng(seed)
    rows = rows_of(300, 2)
    level, z = levels_of(rows), draw.normal(size=(300, 2))
    made = {
        "white": z,
        "unequal": z * [1.0, 1.5],
        "tails": draw.standard_t(3, z.shape),
        "coloured": lfilter([0.8], [1, -0.6], z, axis=0),
        "proportional": z * np.hypot(0.1, 0.3 * level),
        "spikes": np.where(draw.random(z.shape) < 0.02, 12 * z, z),
    }
    return made[kind], level, rows


@pytest.mark.parametrize("kind", KINDS)
def test_the_parts_that_the_noise_has_are_used_and_no_others(kind):
    found = [estimate(*recording_of(kind, seed)).structure for seed in range(60)]
    assert found.count(KINDS[kind]) >= 57


def test_white_noise_of_equal_sensors_keeps_the_simplest_form():
    found = [estimate(*recording_of("white", 1000 + seed)).structure for seed in range(300)]
    assert found.count(Structure()) >= 294


def test_what_one_part_did_for_another_is_taken_back():
    rows = rows_of(3000, 2)
    level = levels_of(rows)
    proportional = draw_of(made_of(size=(0.02, 0.02), growth=0.3), level, rows, 14)
    assert estimate(proportional, level, rows).structure == Structure(growth=True)


def test_a_long_record_has_the_structure_of_its_stretches_and_the_sizes_of_all_of_it():
    truth = made_of(size=(0.1, 0.2), tail=4.0, memory=(0.05, 0.05))
    rows = rows_of(30_000, 2)
    level = levels_of(rows)
    found = estimate(draw_of(truth, level, rows, 15), level, rows)
    assert found.structure == Structure(own_sizes=True, tails=True, memory=True)
    np.testing.assert_allclose(found.size, truth.size, rtol=0.02)
    np.testing.assert_allclose(found.memory, truth.memory, rtol=0.06)


def test_two_readings_at_one_time_are_independent_in_white_noise():
    rows = rows_of(200, 1)
    rows.times[1::2] = rows.times[::2]
    left = np.random.default_rng(16).normal(size=(200, 1))
    found = estimate(left, levels_of(rows), rows, structure=Structure(tails=True))
    assert found.size[0] == pytest.approx(1, rel=0.2)
    assert np.isfinite(estimate(left, levels_of(rows), rows, structure=EVERY_PART).log_likelihood(left, left, rows))


def test_parts_that_the_readings_cannot_show_are_left_out():
    rows = rows_of(100, 1, pieces=range(100))
    left = np.random.default_rng(17).normal(size=(100, 1))
    found = estimate(left, np.zeros((100, 1)), rows, structure=EVERY_PART)
    assert found.structure == Structure(tails=True)
    assert found.memory[0] == found.growth == 0


def test_the_transposed_whitener_is_the_transposed_matrix():
    draw = np.random.default_rng(6)
    rows = rows_of(30, 3, pieces=(11,))
    noise = Noise(np.array([1.0, 2.0, 3.0]), 0.2, np.inf, np.array([0.1, 0.0, 0.3]), EVERY_PART)
    whitener = noise.whitener(levels_of(rows), rows, draw.random((30, 3)) > 0.3)
    x, z = draw.normal(size=(2, 30, 3))
    assert np.sum(z * whitener.apply(x)) == pytest.approx(np.sum(whitener.transposed(z) * x))
    many = draw.normal(size=(30, 3, 2))
    np.testing.assert_allclose(whitener.transposed(many)[..., 1], whitener.transposed(many[..., 1]), rtol=1e-14)


def test_noise_that_grows_from_nothing_keeps_a_size_at_zero_signal():
    """Without one, a reading that happens to lie at zero is beyond all doubt, and the likelihood has no bound."""
    draw = np.random.default_rng(8)
    rows = rows_of(400, 2)
    level = 10 * np.sin(np.arange(400)[:, None] / 7 + np.array([0.0, 1.0]))
    left = 0.01 * level * draw.normal(size=level.shape)
    found = estimate(left, level, rows, structure=Structure(own_sizes=True, growth=True))
    assert np.all(found.size > 0.05 * np.median(np.abs(left), axis=0))
    assert found.growth == pytest.approx(0.01, rel=0.2)


def test_a_sensor_whose_noise_a_curve_follows_takes_its_memory_from_the_others():
    from scipy.interpolate import make_lsq_spline

    rows, true = rows_of(2000, 4), made_of(size=(0.5, 1.0, 1.0, 1.0), memory=(0.4,) * 4)
    left = draw_of(true, np.zeros((2000, 4)), rows, 5)
    knots = np.linspace(rows.times[0], rows.times[-1], 402)
    inner = np.concatenate([[knots[0]] * 3, knots, [knots[-1]] * 3])
    left[:, 0] -= make_lsq_spline(rows.times, left[:, 0], inner)(rows.times)
    free = np.array([404.0, 0, 0, 0])
    structure = Structure(own_sizes=True, memory=True)
    seen, told = (
        estimate(left, np.zeros_like(left), one, free=free, structure=structure)
        for one in (rows, replace(rows, curved=frozenset([0])))
    )
    np.testing.assert_allclose(told.size, true.size, rtol=0.1)
    np.testing.assert_allclose(told.memory, true.memory, rtol=0.2)
    # Its own residual shows next to nothing of it.
    assert seen.memory[0] < 0.1
    assert seen.size[0] < 0.3
