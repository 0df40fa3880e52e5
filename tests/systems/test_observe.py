"""Observing a motion: noise of the stated size, missing values, and no truth for those who fit."""

import numpy as np
import pytest

from latticebench import systems
from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import noise_size, observe, sample_times, simulate


@pytest.fixture(scope="module")
def clean():
    return {
        name: simulate(systems.find(name), sites=40, times=sample_times(200, 5.0), integrator="dop853")
        for name in ("sine-gordon", "dnls")
    }


@pytest.mark.parametrize("level", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("name", ["sine-gordon", "dnls"])
def test_the_noise_has_the_stated_size(clean, name, level):
    exact = clean[name]
    noisy = observe(exact, np.random.default_rng(0), noise=level)
    values = exact.u.ravel()
    mean = sum(values) / len(values)
    sigma = level * np.sqrt(sum(abs(value - mean) ** 2 for value in values) / len(values))
    assert noisy.sigma == pytest.approx(sigma, rel=1e-10)
    assert noisy.noise == level
    error = (noisy.u - exact.u).ravel()
    # The mean square of K squares of variance sigma^2 scatters by sqrt(2/K); five of them are allowed.
    allowed = 5 * np.sqrt(2 / len(error))
    assert np.mean(np.abs(error) ** 2) == pytest.approx(sigma**2, rel=allowed)
    assert abs(np.mean(error)) < 5 * sigma / np.sqrt(len(error))
    if np.iscomplexobj(error):
        for part in (error.real, error.imag):
            assert np.mean(part**2) == pytest.approx(sigma**2 / 2, rel=allowed)
        assert abs(np.mean(error.real * error.imag)) < 5 * sigma**2 / 2 / np.sqrt(len(error))


def test_the_noise_on_the_velocity_has_a_size_of_its_own(clean):
    exact = clean["sine-gordon"]
    noisy = observe(exact, np.random.default_rng(0), noise=0.05)
    assert np.std(noisy.v - exact.v) == pytest.approx(0.05 * np.std(exact.v), rel=0.05)
    assert noise_size(exact.v, 0.05) != pytest.approx(noise_size(exact.u, 0.05), rel=0.1)


def test_the_noise_is_about_the_mean_so_that_an_offset_does_not_change_it():
    field = np.random.default_rng(1).normal(size=(30, 4))
    assert noise_size(field + 100, 0.1) == pytest.approx(noise_size(field, 0.1), rel=1e-10)
    assert noise_size(np.full((3, 3), 7.0), 0.1) == 0


def test_the_same_seed_gives_the_same_noise_and_another_seed_another(clean):
    exact = clean["dnls"]
    first, again, other = (observe(exact, np.random.default_rng(seed), noise=0.1, missing=0.1).u for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other, equal_nan=True)


@pytest.mark.parametrize("share", [0.1, 0.6])
def test_the_stated_share_of_values_is_missing(clean, share):
    exact = clean["sine-gordon"]
    holed = observe(exact, np.random.default_rng(2), missing=share)
    for field in (holed.u, holed.v):
        found = np.mean(np.isnan(field))
        assert found == pytest.approx(share, abs=5 * np.sqrt(share * (1 - share) / field.size))
    assert holed.has_missing
    seen = ~np.isnan(holed.u)
    np.testing.assert_array_equal(holed.u[seen], exact.u[seen])


def test_observing_without_noise_changes_nothing_and_keeps_the_truth(clean):
    exact = clean["sine-gordon"]
    same = observe(exact, np.random.default_rng(0))
    np.testing.assert_array_equal(same.u, exact.u)
    noisy = observe(exact, np.random.default_rng(0), noise=0.3)
    assert noisy.exact is exact.exact
    assert noisy.equation == exact.equation
    np.testing.assert_array_equal(noisy.exact.u, exact.u)


@pytest.mark.parametrize("settings", [{"noise": -1}, {"noise": float("nan")}, {"missing": 1.0}, {"missing": -0.1}])
def test_unsound_noise_is_refused(clean, settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        observe(clean["dnls"], np.random.default_rng(0), **settings)


def test_what_an_experiment_would_have_carries_no_truth(clean):
    noisy = observe(clean["sine-gordon"], np.random.default_rng(0), noise=0.1)
    seen = noisy.observed()
    assert type(seen) is Samples
    assert set(vars(seen)) == {"t", "u", "v", "f", "sigma", "source", "ends", "origin"}
    assert seen.sigma is None
    for name in ("equation", "exact", "rate", "noise", "truth"):
        assert not hasattr(seen, name)
