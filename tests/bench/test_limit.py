"""The bound is the spread of the best fit, scales with the noise, and its verdicts tell known from unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from latticebench import systems
from latticebench.bench.limit import Limit, bound_along, bound_of, bound_of_fit, denser, design
from latticebench.diagnosis.noise import Noise, Structure
from latticebench.methods.method import solve
from latticebench.methods.trajectory import Trajectory
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, sample_times, simulate


def bound(system, terms, *, noise=0.01, velocities=True, known_ends=True, variations=(None,), **options):
    """The bound for samples of a system, one trajectory per generator that varies the initial state."""
    ends = system.ends if known_ends else "unknown"
    data = [simulate(system, variation=draw, **options) for draw in variations]
    seen = [replace(one, v=one.v if velocities else None, ends=ends) for one in data]
    return bound_of(seen, terms, system.order, noise=noise)


def spread(name, candidates, noise, seeds, velocities, **options):
    system = systems.find(name)
    one = system.library(candidates)
    clean = simulate(system, **options)
    truth = system.truth(one, {})
    errors = []
    for seed in range(seeds):
        samples = observe(clean, np.random.default_rng(seed), noise=noise).observed()
        samples = replace(samples, v=samples.v if velocities else None, ends=system.ends)
        errors.append(Trajectory().fit([samples], one, system.order, 0).coefficients - truth)
    limit = bound(system, one, noise=noise, velocities=velocities, **options)
    return np.array(errors), limit


@pytest.mark.parametrize(("name", "candidates", "velocities"), [("phi4", "lib2", False), ("sine-gordon", "lib2", True)])
def test_the_bound_is_the_spread_of_the_maximum_likelihood_fit(name, candidates, velocities):
    errors, limit = spread(name, candidates, 0.01, 8, velocities, sites=15)
    # e^T C^-1 e has the expectation of the number of terms; over 8 seeds its mean scatters by 25 %.
    whitened = np.mean(np.einsum("sj,jk,sk->s", errors, np.linalg.inv(limit.covariance), errors)) / errors.shape[1]
    assert 0.3 < whitened < 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "candidates", "velocities"),
    [
        ("phi4", "lib2", True), ("phi4", "lib2", False), ("sine-gordon", "lib2", True), ("sine-gordon", "lib2", False),
        ("dnls", "four", False), ("ginzburg-landau", "four", False),
    ],
)  # fmt: skip
def test_the_bound_is_the_spread_over_80_seeds(name, candidates, velocities):
    errors, limit = spread(name, candidates, 0.01, 80, velocities, sites=15)
    seeds, terms = errors.shape
    # Mean squares over their expectation, of each term and of all in their covariance: 1 in 5000 is outside.
    low, high = chi2.ppf([1e-4, 1 - 1e-4], seeds) / seeds
    each = np.mean(errors**2, axis=0) / limit.stderr**2
    assert np.all((low < each) & (each < high))
    low, high = chi2.ppf([1e-4, 1 - 1e-4], seeds * terms) / (seeds * terms)
    whitened = np.einsum("sj,jk,sk->s", errors, np.linalg.inv(limit.covariance), errors)
    assert low < np.mean(whitened) / terms < high


def test_the_bound_scales_with_the_noise():
    system = systems.find("phi4")
    one = system.library("lib2")
    low, high = bound(system, one, noise=0.001), bound(system, one, noise=0.1)
    np.testing.assert_allclose(high.stderr, 100 * low.stderr, rtol=1e-6)
    np.testing.assert_allclose(low.at(0.1).stderr, high.stderr, rtol=1e-6)


@pytest.mark.slow
def test_more_data_never_hurt():
    system = systems.find("phi4")
    one = system.library("lib2")
    usual = bound(system, one)
    assert np.all(bound(system, one, velocities=False).stderr > usual.stderr)
    assert np.all(bound(system, one, known_ends=False).stderr > 0.999 * usual.stderr)
    assert np.all(bound(system, one, times=sample_times(25)).stderr > usual.stderr)
    assert np.all(bound(system, one, variations=[None, np.random.default_rng(0)]).stderr < usual.stderr)


def test_a_thousand_sites():
    system = systems.find("dnls")
    one = system.library("equation")
    few = bound(system, one, sites=31, times=sample_times(5, 1.0))
    many = bound(system, one, sites=1000, times=sample_times(5, 1.0))
    assert np.all(np.isfinite(many.stderr))
    assert many.relative < few.relative


def test_sparse_and_dense_algebra_agree(monkeypatch):
    from latticebench.methods.engine import condensing

    system = systems.find("phi4")
    one = system.library("lib2")
    usual = bound(system, one)
    unknown = bound(system, one, known_ends=False)
    monkeypatch.setattr(condensing, "MAX_QR_WORK", 0)
    np.testing.assert_allclose(bound(system, one).covariance, usual.covariance, rtol=1e-5)
    np.testing.assert_allclose(bound(system, one, known_ends=False).covariance, unknown.covariance, rtol=1e-4)


def test_verdicts_tell_known_coefficients_from_sums():
    terms = library("two", "u[n]; sin(u[n]); u[n]**3")
    covariance = np.array([[1.0, -0.99999, 0.0], [-0.99999, 1.0, 0.0], [0.0, 0.0, 1e-6]])
    limit = Limit(terms, np.array([1.0, 1.0, 1.0]), covariance, np.ones(3), 1e3, 0.01, 50, 10.0)
    assert limit.groups == ((0, 1),)
    assert limit.verdicts[0] == "only the sum of coefficients [u[n]] + [sin(u[n])] is known, to 0.22 %"
    assert limit.verdicts[2] == "known to 0.1 %"
    # The standard error of a difference that is 0, in sizes of the derivative.
    opposed = replace(limit, covariance=np.abs(covariance))
    assert opposed.verdicts[0] == "only the sum of coefficients [u[n]] - [sin(u[n])] is known, to 0.45 %"
    alone = replace(limit, covariance=np.diag([1.0, 1e-6, 1e-6]))
    assert alone.verdicts[0] == "cannot be known from these samples"


def test_a_coefficient_that_cannot_be_told_from_0_is_known_as_a_share_of_the_derivative():
    terms = library("four", "u[n]; u[n]**3; u[n]**5; u[n]**7")
    covariance = np.diag([0.04, 0.04, 0.04, 4.0])
    limit = Limit(terms, np.array([1.0, 0.1, 0.0, 0.1]), covariance, np.full(4, 0.25), 10.0, 0.01, 50, 10.0)
    assert limit.verdicts == (
        "known only to 20 %",
        "known to 5 % of the derivative, and cannot be told from 0",
        "known to 5 % of the derivative (its coefficient is 0)",
        "known only to 50 % of the derivative, and cannot be told from 0",
    )


def test_values_that_are_missing_tell_nothing():
    system = systems.find("phi4")
    one = system.library("lib2")
    clean = replace(simulate(system), ends="free")
    every_other = np.where(np.arange(len(clean.t)) % 2, 0.0, np.nan)[:, None]
    half = replace(clean, u=clean.u + every_other, v=clean.v + every_other)
    thin = bound(system, one, times=clean.t[1::2])
    # The same values are seen; the start of the motion is unknown either way.
    np.testing.assert_allclose(bound_of([half], one, 2, noise=0.01).stderr, thin.stderr, rtol=0.02)
    gaps = observe(clean, np.random.default_rng(0), missing=0.5)
    assert np.all(bound_of([gaps], one, 2, noise=0.01).stderr > 1.2 * bound(system, one).stderr)


def white(*sizes):
    return Noise(np.array(sizes), 0.0, np.inf, np.zeros(len(sizes)), Structure())


def oscillator(noise, seed=0):
    """Samples of u of u'' = -2 u - 0.3 v + 0.7 f, and its motion for any coefficients and start."""
    t = np.linspace(0, 20, 201)

    def force(at):
        return np.sin(1.3 * at) + 0.5 * np.cos(0.4 * at)

    def motion(p):
        return solve_ivp(
            lambda at, y: [y[1], p[0] * y[0] + p[1] * y[1] + p[2] * force(at)], (0, 20), p[3:],
            t_eval=t, rtol=1e-11, atol=1e-13,
        ).y  # fmt: skip

    noisy = motion([-2.0, -0.3, 0.7, 1.0, 0.0])[0] + noise * np.random.default_rng(seed).normal(size=len(t))
    return Samples(t, noisy[:, None], f=force(t)[:, None], ends="free"), motion


def test_the_bound_with_a_measured_input_is_the_one_from_finite_differences():
    samples, motion = oscillator(0.01)
    true = np.array([-2.0, -0.3, 0.7, 1.0, 0.0])
    steps = 1e-5 * np.eye(5)
    slopes = np.stack([(motion(true + h)[0] - motion(true - h)[0]) / 2e-5 for h in steps], axis=1)
    expected = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))[:3] * 0.01
    u, v = motion(true)
    exact = replace(samples, u=u[:, None], v=v[:, None])
    terms = library("oscillator", "u[n]; v[n]; f[n]")
    found = bound_along([samples], [exact], terms, 2, true[:3], noise=white(0.01))
    np.testing.assert_allclose(found.stderr, expected, rtol=1e-3)
    assert found.noise == pytest.approx(0.01 / np.std(u))


def test_between_samples_that_are_far_apart_the_bound_follows_the_motion():
    t = np.arange(0, 40, 2.5)

    def motion(p):
        return solve_ivp(
            lambda at, y: [y[1], p[0] * y[0] + p[1] * y[0] ** 3], (0, t[-1]), p[2:], t_eval=t, rtol=1e-11, atol=1e-13
        ).y

    true = np.array([-2.0, -0.5, 1.0, 0.0])
    slopes = np.stack([(motion(true + h)[0] - motion(true - h)[0]) / 2e-5 for h in 1e-5 * np.eye(4)], axis=1)
    expected = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))[:2] * 0.01
    u, v = motion(true)
    exact = Samples(t, u[:, None], v[:, None], ends="free")
    found = bound_along(
        [replace(exact, v=None)], [exact], library("oscillator", "u[n]; u[n]**3"), 2, true[:2], noise=white(0.01)
    )
    np.testing.assert_allclose(found.stderr, expected, rtol=1e-4)


def test_the_bound_of_a_fit_stands_for_measured_samples():
    samples, _ = oscillator(0.01)
    terms = library("oscillator", "u[n]; v[n]; f[n]")
    fit = solve(Trajectory(), [samples], terms, 2, 0)
    found = bound_of_fit([samples], fit)
    np.testing.assert_allclose(found.stderr, fit.stderr, rtol=0.02)
    np.testing.assert_array_equal(found.coefficients, fit.coefficients)
    # Four times the samples at the same noise, and the same record four times over.
    np.testing.assert_allclose(denser([samples], fit, 4).stderr, found.stderr / 2, rtol=0.02)
    with pytest.raises(InputError, match="follows no motion"):
        bound_of_fit([samples], replace(fit, motion=None))


@pytest.mark.parametrize(("name", "candidates"), [("phi4", "lib2"), ("dnls", "four")])
def test_the_bound_of_a_fit_to_simulated_samples_is_near_the_bound_at_the_truth(name, candidates):
    system = systems.find(name)
    one = system.library(candidates)
    clean = simulate(system, sites=15)
    samples = replace(observe(clean, np.random.default_rng(1), noise=0.01).observed(), ends="unknown")
    fit = solve(Trajectory(), [samples], one, system.order, 0)
    at_truth = bound(system, one, known_ends=False, sites=15)
    assert bound_of_fit([samples], fit).relative == pytest.approx(at_truth.relative, rel=0.15)


def test_design_scales_the_noise_and_finds_samples_and_record():
    system = systems.find("phi4")
    one = system.library("equation")

    def at(more, longer, noise=0.01):
        times = 0.2 * np.arange(20 * more * longer) / more
        return bound(system, one, velocities=False, times=times, sites=15, noise=noise)

    found = design(at, target=0.001, doublings=3)
    assert at(1, 1, found.noise).relative == pytest.approx(0.001)
    assert found.relative == at(1, 1).relative > 0.001
    assert found.records == int(np.ceil((found.relative / 0.001) ** 2))
    assert found.span is not None
    assert found.span > 3.8
    assert at(1, 8).relative < 0.001
    easy = design(at, target=0.5)
    assert (easy.samples, easy.span, easy.records) == (20, pytest.approx(3.8), 1)

    def here_only(more, longer):
        if longer > 1:
            raise InputError("the record has ended")
        return at(more, longer)

    assert design(here_only, target=0.001, doublings=1).span is None
    with pytest.raises(InputError, match="target"):
        design(at, target=0.0)


def test_what_cannot_be_bounded_is_refused():
    system = systems.find("phi4")
    with pytest.raises(InputError, match="outside the library"):
        bound(system, library("poor", "u[n]"))
    with pytest.raises(InputError, match="noise"):
        bound(system, system.library("lib2"), noise=0.0)
