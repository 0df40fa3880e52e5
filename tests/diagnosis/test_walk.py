"""Zeros that wander: their likelihood, what they hide, and how far they go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from latticebench.diagnosis.noise import Noise, Structure
from latticebench.diagnosis.noise_estimate import estimate
from latticebench.diagnosis.rows import Rows
from latticebench.diagnosis.walk_estimate import won_by_walking

OWN = Structure(own_sizes=True)
SIZES, WALKS = (0.5, 0.2), (0.3, 0.0)


def rows_of(count, *, pieces=(), seed=0, span=40.0):
    """Uneven times, none much closer than others, of two sensors, of which the first may wander."""
    apart = np.random.default_rng(seed).uniform(0.5, 1.5, count - 1)
    times = np.concatenate([[0.0], np.cumsum(apart)]) * span / np.sum(apart)
    return Rows(times, np.isin(np.arange(count), [0, *pieces]), np.arange(2), walking=frozenset([0]))


def noise_of(*, sizes=SIZES, walks=WALKS, tail=np.inf):
    return Noise(np.array(sizes), 0.0, tail, np.zeros(2), OWN, np.array(walks))


def drawn(rows, seed, *, sizes=SIZES, walks=WALKS):
    """White noise, and the walks besides."""
    draw = np.random.default_rng(seed)
    steps = np.sqrt(np.diff(rows.times, prepend=0.0))[:, None]
    walk = np.cumsum(draw.normal(size=(len(steps), 2)) * steps * walks, axis=0)
    return np.array(sizes) * draw.normal(size=walk.shape), walk


def covariance(rows, seen, sensor):
    """Of the readings of a sensor that were seen: those of other pieces are taken as independent."""
    t, piece = rows.times[seen], np.cumsum(rows.first)[seen]
    wandering = WALKS[sensor] ** 2 * np.minimum.outer(t, t)
    return np.where(np.equal.outer(piece, piece), wandering + np.eye(len(t)) * SIZES[sensor] ** 2, 0.0)


def with_gaps(values, seed):
    return np.where(np.random.default_rng(seed).uniform(size=values.shape) < 0.1, np.nan, values)


@pytest.mark.parametrize("pieces", [(), (30, 55)])
def test_the_likelihood_is_that_of_a_normal_distribution_with_the_covariance_of_a_walk_and_white_noise(pieces):
    rows = rows_of(90, pieces=pieces)
    left = with_gaps(sum(drawn(rows, 1)), 2)
    expected = 0.0
    for sensor in (0, 1):
        seen = np.isfinite(left[:, sensor])
        matrix = covariance(rows, seen, sensor)
        expected += stats.multivariate_normal(np.zeros(len(matrix)), matrix).logpdf(left[seen, sensor])
    assert noise_of().log_likelihood(left, np.zeros_like(left), rows) == pytest.approx(expected, rel=1e-10)


def test_the_transposed_map_is_the_transpose():
    rows = rows_of(80, pieces=(40,))
    left = with_gaps(sum(drawn(rows, 1)), 2)
    whitener = noise_of().whitener(np.zeros_like(left), rows, np.isfinite(left))
    draw = np.random.default_rng(3)
    x, z = (np.where(np.isfinite(left), draw.normal(size=left.shape), 0.0) for _ in range(2))
    assert np.sum(z * whitener.apply(x)) == pytest.approx(np.sum(whitener.transposed(z) * x), rel=1e-10)
    several = np.stack([x, z], axis=-1)
    np.testing.assert_allclose(whitener.apply(several)[..., 1], whitener.apply(z), rtol=1e-12)


def test_what_is_left_without_the_walk_is_the_white_part_as_it_is_expected_from_the_readings():
    rows = rows_of(70)
    left = with_gaps(sum(drawn(rows, 4)), 5)
    still = noise_of().still(left, np.zeros_like(left), rows)
    seen = np.isfinite(left[:, 0])
    expected = SIZES[0] ** 2 * np.linalg.solve(covariance(rows, seen, 0), left[seen, 0])
    np.testing.assert_allclose(still[seen, 0], expected, rtol=1e-9)
    np.testing.assert_array_equal(still[:, 1], left[:, 1])
    assert np.all(np.isnan(still[~seen, 0]))


def test_estimates_of_size_and_walk_scatter_about_the_true_ones():
    rows, found = rows_of(600), []
    for seed in range(24):
        left = sum(drawn(rows, 100 + seed))
        noise = estimate(left, np.zeros_like(left), rows, structure=OWN)
        found.append((*noise.size, *noise.walk))
    centre, spread = np.mean(found, axis=0), np.std(found, axis=0) / np.sqrt(len(found))
    assert np.all(np.abs(centre - [*SIZES, *WALKS]) <= 4 * spread)
    np.testing.assert_allclose(centre, [*SIZES, *WALKS], rtol=0.1)


def test_a_zero_that_stands_still_wins_nothing_by_walking_and_one_that_wanders_wins_much():
    rows = replace(rows_of(600), walking=frozenset())
    white, walk = drawn(rows, 7)
    noise = estimate(white, np.zeros_like(white), rows, structure=OWN)
    assert np.all(won_by_walking(noise, white, np.zeros_like(white), rows, [0, 1]) < 4)
    noise = estimate(white + walk, np.zeros_like(white), rows, structure=OWN)
    won = won_by_walking(noise, white + walk, np.zeros_like(white), rows, [0, 1])
    assert won[0] > 50 > 4 > won[1]


def test_the_noise_of_all_other_sensors_is_what_it_is_without_the_one_that_wanders():
    rows = rows_of(600)
    left = sum(drawn(rows, 8))
    without = np.stack([np.full(len(left), np.nan), left[:, 1]], axis=1)
    alone = estimate(without, np.zeros_like(left), replace(rows, walking=frozenset()), structure=OWN)
    both = estimate(left, np.zeros_like(left), rows, structure=OWN)
    assert both.size[1] == pytest.approx(alone.size[1], rel=1e-9)


def test_a_zero_goes_no_faster_than_it_may_so_that_it_cannot_follow_what_swings():
    rows = replace(rows_of(600), fastest=0.05)
    swing = np.stack([np.sin(rows.times), np.zeros(600)], axis=1)
    left = sum(drawn(rows, 9)) + 5 * swing
    noise = estimate(left, np.zeros_like(left), rows, structure=OWN)
    assert noise.walk[0] <= 0.05 * noise.size[0] * (1 + 1e-6)
    assert np.std(noise.still(left, np.zeros_like(left), rows)[:, 0]) > 3
    free = estimate(left, np.zeros_like(left), replace(rows, fastest=np.inf), structure=OWN)
    assert free.walk[0] > 1
