"""The bound is the spread of the best fit, scales with the noise, and its verdicts tell known from unknown."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

import systems
from bench.limit import Limit, bound, design
from methods.trajectory import Trajectory
from systems.errors import InputError
from systems.lattice import library
from systems.simulate import observe, sample_times, simulate


def spread(name, candidates, noise, seeds, velocities):
    system = systems.find(name)
    one = system.library(candidates)
    clean = simulate(system)
    truth = system.truth(one, {})
    errors = []
    for seed in range(seeds):
        samples = observe(clean, np.random.default_rng(seed), noise=noise).observed()
        samples = replace(samples, v=samples.v if velocities else None, ends=system.ends)
        errors.append(Trajectory().fit([samples], one, system.order, 0).coefficients - truth)
    limit = bound(system, one, noise=noise, velocities=velocities)
    return np.array(errors), limit


@pytest.mark.parametrize(("name", "candidates", "velocities"), [("phi4", "lib2", False), ("sine-gordon", "lib2", True)])
def test_the_bound_is_the_spread_of_the_maximum_likelihood_fit(name, candidates, velocities):
    errors, limit = spread(name, candidates, 0.01, 8, velocities)
    # e^T C^-1 e has the expectation of the number of terms; over 8 seeds its mean scatters by 25 %.
    whitened = np.mean(np.einsum("sj,jk,sk->s", errors, np.linalg.inv(limit.covariance), errors)) / errors.shape[1]
    assert 0.3 < whitened < 2


@pytest.mark.slow
@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize(
    ("name", "candidates"), [("phi4", "lib2"), ("sine-gordon", "lib2"), ("dnls", "four"), ("ginzburg-landau", "four")]
)
def test_the_bound_is_the_spread_over_200_seeds(name, candidates, velocities):
    errors, limit = spread(name, candidates, 0.01, 200, velocities)
    np.testing.assert_allclose(np.sqrt(np.mean(errors**2, axis=0)), limit.stderr, rtol=0.2)


def test_the_bound_scales_with_the_noise():
    system = systems.find("phi4")
    one = system.library("lib2")
    low, high = bound(system, one, noise=0.001), bound(system, one, noise=0.1)
    np.testing.assert_allclose(high.stderr, 100 * low.stderr, rtol=1e-6)
    np.testing.assert_allclose(low.at(0.1).stderr, high.stderr, rtol=1e-6)


def test_more_data_never_hurt():
    system = systems.find("phi4")
    one = system.library("lib2")
    usual = bound(system, one)
    assert np.all(bound(system, one, velocities=False).stderr > usual.stderr)
    assert np.all(bound(system, one, known_ends=False).stderr > 0.999 * usual.stderr)
    assert np.all(bound(system, one, times=sample_times(25)).stderr > usual.stderr)
    assert np.all(bound(system, one, variations=[None, np.random.default_rng(0)]).stderr < usual.stderr)


def test_thirty_one_sites_take_less_than_a_second():
    system = systems.find("phi4")
    one = system.library("lib2")
    bound(system, one)
    began = time.process_time()
    bound(system, one)
    assert time.process_time() - began < 1.0


def test_a_thousand_sites():
    system = systems.find("dnls")
    one = system.library("equation")
    few = bound(system, one, sites=31, times=sample_times(5, 1.0))
    many = bound(system, one, sites=1000, times=sample_times(5, 1.0))
    assert np.all(np.isfinite(many.stderr))
    assert many.relative < few.relative


def test_sparse_and_dense_algebra_agree(monkeypatch):
    import systems.sensitivity as sensitivity

    system = systems.find("phi4")
    one = system.library("lib2")
    usual = bound(system, one)
    unknown = bound(system, one, known_ends=False)
    monkeypatch.setattr(sensitivity, "MAX_QR_WORK", 0)
    np.testing.assert_allclose(bound(system, one).covariance, usual.covariance, rtol=1e-5)
    np.testing.assert_allclose(bound(system, one, known_ends=False).covariance, unknown.covariance, rtol=1e-4)


def test_verdicts_tell_known_coefficients_from_sums():
    terms = library("two", "u[n]; sin(u[n]); u[n]**3")
    covariance = np.array([[1.0, -0.99999, 0.0], [-0.99999, 1.0, 0.0], [0.0, 0.0, 1e-6]])
    limit = Limit(terms, np.array([1.0, 1.0, 1.0]), covariance, np.ones(3), 1e3, 0.01, 50, 10.0)
    assert limit.groups == ((0, 1),)
    assert limit.verdicts[0] == "only the sum of coefficients [u[n]] + [sin(u[n])] is known, to 0.22 %"
    assert limit.verdicts[2] == "known to 0.1 %"
    alone = replace(limit, covariance=np.diag([1.0, 1e-6, 1e-6]))
    assert alone.verdicts[0] == "cannot be known from these samples"


def test_design_scales_the_noise_and_finds_the_record():
    system = systems.find("phi4")
    one = system.library("equation")
    found = design(system, one, target=0.001, velocities=False, times=sample_times(20, 4.0), sites=15, doublings=2)
    assert bound(
        system, one, velocities=False, times=sample_times(20, 4.0), sites=15, noise=found.noise
    ).relative == pytest.approx(0.001)
    assert found.span is None or found.span > 3.8


def test_what_cannot_be_bounded_is_refused():
    system = systems.find("phi4")
    with pytest.raises(InputError, match="outside the library"):
        bound(system, library("poor", "u[n]"))
    with pytest.raises(InputError, match="noise"):
        bound(system, system.library("lib2"), noise=0.0)
