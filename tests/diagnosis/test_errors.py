"""What is said about a model beside its effects: forecasts, modes, and what is left without a name."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from latticebench.diagnosis import modes
from latticebench.diagnosis.fitting import fit
from latticebench.diagnosis.forecast import Prediction, by_noise, pooled, predict
from latticebench.diagnosis.horizon import Layout
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Structure
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

NOISE, DAMPING = 0.01, 0.06
LINEAR = library("linear", "u[n+1]+u[n-1]-2*u[n]; u[n]; v[n]")


def chain(count=400, span=40.0, sites=3, extra=lambda t, u, v: 0.0, seed=0):
    """A damped linear chain with free ends, read with noise."""
    t = np.linspace(0, span, count)

    def rate(t, y):
        u, v = np.split(y, 2)
        beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])
        return np.concatenate([v, 0.5 * (beside - 2 * u) - u - DAMPING * v + extra(t, u, v)])

    start = np.concatenate([np.cos(1.5 * np.arange(sites)), np.zeros(sites)])
    u = solve_ivp(rate, t[[0, -1]], start, t_eval=t, rtol=1e-10, atol=1e-11).y.T[:, :sites]
    return Samples(t, u + NOISE * np.random.default_rng(seed).normal(size=u.shape), source="chain", ends="free")


@functools.cache
def fitted(coefficients=(0.5, -1.0, -DAMPING), steps=10):
    problem = Problem.of(LINEAR, 2, [chain()], ())
    layout = Layout.of(problem, 400, None, 1e-3)
    states = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    return problem, fit(Model(LINEAR, 2, coefficients), layout, states, structure=Structure(), steps=steps)


def test_the_modes_of_a_linear_chain_are_those_of_its_matrix():
    problem, found = fitted()
    squares = 1.0 + 0.5 * np.array([0.0, 1.0, 3.0])
    exact = np.sqrt(squares - DAMPING**2 / 4)
    told = modes.of_model(found)
    np.testing.assert_allclose([one.frequency for one in told], exact, rtol=5e-3)
    np.testing.assert_allclose([one.decay for one in told], DAMPING / 2, atol=5e-3)
    peaks = modes.of_recording(problem)
    assert min(abs(peaks[0].frequency - exact)) < 0.1
    assert all(np.isnan(one.decay) for one in peaks)


def test_the_modes_of_a_nonlinear_model_are_those_of_its_swing():
    pendulum, drag, swing = library("pendulum", "sin(u[n]); u[n]**2*v[n]"), 0.05, 1.2
    t = np.linspace(0, 30, 600)
    run = solve_ivp(lambda t, y: [y[1], -np.sin(y[0]) - drag * y[0] ** 2 * y[1]], t[[0, -1]], [swing, 0.0], t_eval=t,
                    rtol=1e-10, atol=1e-11)  # fmt: skip
    u = run.y[:1].T + 1e-4 * np.random.default_rng(1).normal(size=(600, 1))
    problem = Problem.of(pendulum, 2, [Samples(t, u, source="pendulum", ends="free")], ())
    layout = Layout.of(problem, 600, None, 1e-5)
    states = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    (mode,) = modes.of_model(fit(Model(pendulum, 2, (-1.0, -drag)), layout, states, structure=Structure()))
    mean_square = 2 * np.mean(run.y[0] ** 2)
    # A pendulum of amplitude A has the period 4 K(sin(A/2)); u^2 v takes the share A^2/8 of its amplitude per time.
    assert mode.frequency == pytest.approx(np.pi / 2 / ellipk(np.sin(np.sqrt(mean_square) / 2) ** 2), rel=0.005)
    assert mode.decay == pytest.approx(drag * mean_square / 8, rel=0.1)


def test_the_rest_of_a_recording_is_forecast_to_the_noise():
    problem, found = fitted()
    (forecast,) = predict(found, problem)
    assert len(forecast.t) == pytest.approx(0.3 * 400, abs=2)
    left = forecast.seen - forecast.predicted
    assert np.sqrt(np.mean(left**2)) == pytest.approx(NOISE, rel=0.2)
    assert forecast.error == pytest.approx(np.sqrt(np.mean(left**2) / np.mean(forecast.seen**2)))


def test_another_recording_is_forecast_from_its_own_beginning():
    problem, found = fitted()
    other = chain(count=300, span=30.0, seed=5)
    (forecast,) = predict(found, problem, [other])
    assert forecast.t[-1] == other.t[-1]
    assert np.sqrt(np.mean((forecast.seen - forecast.predicted) ** 2)) < 2 * NOISE


def test_forecasts_are_pooled_by_their_squares_and_one_that_runs_away_is_infinitely_wrong():
    t, seen = np.arange(4.0), np.ones((4, 1, 2))
    good, bad = Prediction(t, seen, seen + 0.1, 0.1), Prediction(t, seen, np.full_like(seen, np.inf), np.inf)
    assert pooled([good, good]) == pytest.approx(0.1)
    assert pooled([good, bad]) == np.inf
    half = seen.copy()
    half[2:] = np.nan
    assert pooled([Prediction(t, half, seen + 0.1, 0.1)]) == pytest.approx(0.1)
    assert np.isnan(pooled([]))


def test_a_right_forecast_is_as_wrong_as_the_noise_alone_makes_it():
    generator, noise = np.random.default_rng(3), np.array([0.1, 0.4])
    right = np.cos(np.linspace(0, 60, 2000))[:, None, None] * np.array([1.0, 2.0])
    seen = right + noise * generator.normal(size=right.shape)
    seen[generator.random(seen.shape) < 0.2] = np.nan
    forecast = [Prediction(np.arange(2000.0), seen, right, 0.0)]
    assert pooled(forecast) == pytest.approx(by_noise(forecast, noise), rel=0.05)
    assert np.isnan(by_noise([], noise))


CATALOGUE = tuple(find(name) for name in ("quadratic-drag", "defect", "sensor-offset", "constant-force"))


def test_what_no_effect_of_the_catalogue_explains_is_left_with_a_term_that_would():
    ageing = chain(extra=lambda t, u, v: -0.01 * t * u)
    found = diagnose(LINEAR, 2, [ageing], CATALOGUE)
    assert found.verdict in ("unexplained", "partly explained")
    assert "t*u[n]" in [one.name for one in found.left]
    assert all(one.gain > one.price for one in found.left)


def test_a_push_on_one_site_that_has_no_name_is_said_to_be_there():
    pushed = chain(extra=lambda t, u, v: 0.03 * np.eye(len(u))[1] * np.cos(2.9 * t + 0.4 * np.sin(0.5 * t)))
    found = diagnose(LINEAR, 2, [pushed], CATALOGUE)
    assert found.verdict in ("unexplained", "partly explained")
    assert (found.left[0].name, found.left[0].site) == ("a force of its own course in time", 1)
