"""The limit of a recording knows the noise of each sensor, and says where the equation leaves more than noise."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.bench.limit import bound_along, bound_of_fit, denser
from latticebench.bench.noise import left_by
from latticebench.diagnosis.noise import Noise, Structure
from latticebench.methods.engine import condensing
from latticebench.methods.method import solve
from latticebench.methods.trajectory import Trajectory
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

TERMS = library("pair", "u[n]; u[n+1]+u[n-1]-2*u[n]")
TRUE = np.array([-1.2, 0.3, 1.0, -0.4, 0.0, 0.3])
SPAN, COUNT = 20.0, 200
SIZES, MEMORY = np.array([0.01, 0.04]), 0.15
TIMES = np.linspace(0, SPAN, COUNT)


def motion(p, drag=0.0, t=TIMES):
    """Two coupled oscillators: u and v (T, 2) for coefficients and start p."""

    def rate(_, y):
        u, v = y[:2], y[2:]
        return np.concatenate([v, p[0] * u + p[1] * (u[::-1] - u) - drag * v * np.abs(v)])

    y = solve_ivp(rate, (0, SPAN), p[2:], t_eval=t, rtol=1e-11, atol=1e-13).y.T
    return y[:, :2], y[:, 2:]


def shape(kind, draw, t=TIMES):
    """Noise of variance 1: white, or of correlation time MEMORY (0.51 from one reading to the next)."""
    z = draw.normal(size=(len(t), 2))
    if kind == "correlated":
        for k in range(1, len(t)):
            near = np.exp(-(t[k] - t[k - 1]) / MEMORY)
            z[k] = near * z[k - 1] + np.sqrt(1 - near**2) * z[k]
    return z


def recording(kind, seed, drag=0.0):
    return Samples(TIMES, motion(TRUE, drag)[0] + SIZES * shape(kind, np.random.default_rng(seed)), ends="free")


def fitted(samples):
    return solve(Trajectory(), [samples], TERMS, 2, 0)


@functools.cache
def slopes():
    """Derivatives of u by the coefficients and the start (T, 2, 6), by finite differences."""
    return np.stack([(motion(TRUE + h)[0] - motion(TRUE - h)[0]) / 2e-5 for h in 1e-5 * np.eye(6)], axis=-1)


def dense(memory, seen):
    """The inverse of D^T C^-1 D with D by finite differences, C written out, and the start eliminated."""
    total = np.zeros((6, 6))
    for sensor in range(2):
        there = seen[:, sensor]
        apart = np.abs(TIMES[there, None] - TIMES[there])
        near = np.exp(-apart / memory[sensor]) if memory[sensor] else (apart == 0).astype(float)
        d = slopes()[there, sensor]
        total += d.T @ np.linalg.solve(SIZES[sensor] ** 2 * near, d)
    return np.linalg.inv(total)[:2, :2]


@pytest.mark.parametrize("memory", [(0.0, 0.0), (0.3, 0.3), (0.0, 2.0)])
@pytest.mark.parametrize("orthogonal", [True, False])
@pytest.mark.parametrize("gaps", [0.0, 0.4])
def test_the_bound_under_unequal_correlated_noise_is_that_of_the_dense_covariance(
    memory, orthogonal, gaps, monkeypatch
):
    if not orthogonal:
        monkeypatch.setattr(condensing, "MAX_QR_WORK", 0)
    seen = np.random.default_rng(5).uniform(size=(COUNT, 2)) >= gaps
    u, v = motion(TRUE)
    samples = Samples(TIMES, np.where(seen, u, np.nan), ends="free")
    noise = Noise(SIZES, 0.0, np.inf, np.array(memory), Structure(own_sizes=True, memory=True))
    found = bound_along([samples], [replace(samples, u=u, v=v)], TERMS, 2, TRUE[:2], noise=noise)
    np.testing.assert_allclose(found.covariance, dense(memory, seen), rtol=1e-4)
    # The same noise on velocities that were read besides counts by itself.
    both = replace(noise, size=np.tile(SIZES, 2), memory=np.tile(memory, 2))
    more = bound_along([replace(samples, v=v)], [replace(samples, u=u, v=v)], TERMS, 2, TRUE[:2], noise=both)
    assert np.all(more.stderr < found.stderr)


def test_the_bound_at_unknown_ends_under_correlated_noise_does_not_depend_on_the_algebra(monkeypatch):
    draw = np.random.default_rng(2)
    t = np.linspace(0, 10, 60)
    u = np.cos(t[:, None] * (1 + 0.1 * np.arange(5))) + 0.2 * draw.normal(size=5)
    exact = Samples(t, u, np.gradient(u, t, axis=0))
    seen = replace(exact, u=np.where(draw.uniform(size=u.shape) < 0.1, np.nan, u))
    noise = Noise(0.01 * (1 + np.arange(10)), 0.0, np.inf, np.full(10, 0.4), Structure(own_sizes=True, memory=True))
    usual = bound_along([seen], [exact], TERMS, 2, TRUE[:2], noise=noise)
    monkeypatch.setattr(condensing, "MAX_QR_WORK", 0)
    other = bound_along([seen], [exact], TERMS, 2, TRUE[:2], noise=noise)
    np.testing.assert_allclose(other.covariance, usual.covariance, rtol=1e-4)


def test_heavy_tails_tell_more_than_a_gaussian_of_their_variance_and_less_than_one_of_their_scale():
    u, v = motion(TRUE)
    samples, exact = Samples(TIMES, u, ends="free"), Samples(TIMES, u, v, ends="free")
    plain = Noise(SIZES, 0.0, np.inf, np.zeros(2), Structure(own_sizes=True))
    heavy = replace(plain, tail=4.0)

    def error(noise):
        return bound_along([samples], [exact], TERMS, 2, TRUE[:2], noise=noise).stderr

    # Fisher's information of Student's t about its centre, by quadrature of the squared score.
    z = np.linspace(-400, 400, 4_000_001)
    density = (1 + z**2 / 4) ** -2.5
    told = np.sum((5 * z / (4 + z**2)) ** 2 * density) / np.sum(density)
    np.testing.assert_allclose(error(heavy), error(plain) / np.sqrt(told), rtol=1e-4)
    assert np.all(error(heavy) < error(replace(plain, size=heavy.deviation())))


def test_the_noise_of_each_sensor_is_estimated_and_said_in_the_units_of_the_readings():
    samples = recording("white", 0)
    left = left_by([samples], fitted(samples))
    np.testing.assert_allclose(left.noise.deviation(), SIZES, rtol=0.2)
    assert [line.split(":")[0] for line in left.lines] == ["sensor 1", "sensor 2"]
    coarse = replace(samples, u=np.round(samples.u / 0.05) * 0.05)
    assert all("steps of 0.05" in line for line in left_by([coarse], fitted(coarse)).lines)


@pytest.mark.parametrize("kind", ["white", "correlated"])
def test_the_bound_of_a_recording_is_the_one_of_its_noise(kind):
    memory = (MEMORY, MEMORY) if kind == "correlated" else (0.0, 0.0)
    expected = np.sqrt(np.diag(dense(memory, np.ones((COUNT, 2), dtype=bool))))
    data = [recording(kind, seed) for seed in range(1, 5)]
    fits = [fitted(one) for one in data]
    found = [bound_of_fit([one], fit).stderr for one, fit in zip(data, fits, strict=True)]
    # Sizes and memory are estimated from 400 readings.
    np.testing.assert_allclose(np.mean(found, axis=0), expected, rtol=0.25)
    # Reading more often helps against white noise, and not at all against noise that is still the same.
    gain = found[0] / denser(data[:1], fits[0], 4).stderr
    np.testing.assert_allclose(gain, 2.0 if kind == "white" else 1.03, rtol=0.06)


def test_a_sensor_that_never_read_anything_is_no_obstacle():
    samples = recording("white", 0)
    blind = replace(samples, u=np.where(np.arange(2) == 1, np.nan, samples.u))
    fit = fitted(blind)
    assert np.all(np.isfinite(bound_of_fit([blind], fit).stderr))
    assert not left_by([blind], fit).misfit


def test_velocities_have_a_noise_of_their_own_and_equal_sensors_are_one_line_each():
    u, v = motion(TRUE)
    draw = np.random.default_rng(7)
    read = [field + size * draw.normal(size=u.shape) for field, size in ((u, 0.01), (v, 0.07))]
    samples = Samples(TIMES, read[0], read[1], ends="free")
    left = left_by([samples], fitted(samples))
    np.testing.assert_allclose(left.noise.deviation(), [0.01, 0.01, 0.07, 0.07], rtol=0.15)
    assert [line.split(":")[0] for line in left.lines] == ["all sensors", "velocity, all sensors"]


@pytest.mark.parametrize("kind", ["white", "correlated"])
@pytest.mark.parametrize("seed", range(2))
def test_an_equation_that_fits_is_not_said_to_misfit(kind, seed):
    samples = recording(kind, seed)
    assert not left_by([samples], fitted(samples)).misfit


@pytest.mark.parametrize("drag", [0.03, 0.1])
def test_an_equation_that_lacks_something_is_said_to_leave_more_than_the_noise(drag):
    samples = recording("white", 3, drag)
    fit = fitted(samples)
    left = left_by([samples], fit)
    assert left.misfit
    sizes = np.sqrt(np.mean((samples.u - fit.motion[0].u) ** 2, axis=0)) / SIZES
    assert left.times == pytest.approx(np.sqrt(np.mean(sizes**2)), rel=0.15)
    assert f"the equation leaves {left.times:.2g} times the noise: these bounds do not hold" in left.warning[0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["white", "correlated"])
def test_the_bound_of_a_recording_is_the_spread_of_the_best_fit_over_200_seeds(kind):
    """The best linear unbiased estimate, by the dense covariance, from the truth."""
    apart = np.abs(TIMES[:, None] - TIMES)
    near = np.exp(-apart / MEMORY) if kind == "correlated" else np.eye(COUNT)
    inverse = [np.linalg.inv(size**2 * near) for size in SIZES]
    d = [slopes()[:, sensor] for sensor in range(2)]
    matrix = sum(one.T @ c @ one for one, c in zip(d, inverse, strict=True))
    errors = []
    for seed in range(200):
        noise = SIZES * shape(kind, np.random.default_rng(seed))
        errors.append(np.linalg.solve(matrix, sum(d[k].T @ inverse[k] @ noise[:, k] for k in range(2)))[:2])
    data = [recording(kind, seed) for seed in range(8)]
    found = np.mean([bound_of_fit([one], fitted(one)).stderr for one in data], axis=0)
    np.testing.assert_allclose(np.std(errors, axis=0), found, rtol=0.3)
