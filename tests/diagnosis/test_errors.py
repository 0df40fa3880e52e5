"""What is said about a model beside its effects: forecasts, modes, and what is left without a name."""

from __future__ import annotations

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from latticebench.diagnosis import modes, repair
from latticebench.diagnosis.fitting import fit
from latticebench.diagnosis.forecast import Prediction, ahead, by_noise, pooled, predict
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


def modes_of(terms, coefficients, recordings):
    """The modes of a model that is fitted to exact motions, read with hardly any noise."""
    own = library("own", terms)
    noisy = [
        replace(one, u=one.u + 1e-4 * np.random.default_rng(k).normal(size=one.u.shape))
        for k, one in enumerate(recordings)
    ]
    problem = Problem.of(own, 1 if noisy[0].is_complex else 2, noisy, ())
    layout = Layout.of(problem, max(len(one.t) for one in noisy), None, 1e-5)
    states = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    return modes.of_model(fit(Model(own, problem.order, coefficients), layout, states, structure=Structure()))


def swung(rate, start, span, count, sites, ends="free"):
    """A motion of some sites as a recording of positions, or of a complex field."""
    t = np.linspace(0, span, count)
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-12).y.T
    return Samples(t, y[:, :sites], source="swing", ends=ends)


def pendulum(swing, span, count, drag=0.0):
    return swung(lambda t, y: [y[1], -np.sin(y[0]) - drag * y[0] ** 2 * y[1]], [swing, 0.0], span, count, 1)


def test_the_modes_of_a_nonlinear_model_are_those_of_its_swing():
    drag, swing = 0.05, pendulum(1.2, 30, 600, drag=0.05)
    (mode,) = modes_of("sin(u[n]); u[n]**2*v[n]", (-1.0, -drag), [swing])
    mean_square = 2 * np.mean(swing.u**2)
    # A pendulum of amplitude A has the period 4 K(sin(A/2)); u^2 v takes the share A^2/8 of its amplitude per time.
    assert mode.frequency == pytest.approx(np.pi / 2 / ellipk(np.sin(np.sqrt(mean_square) / 2) ** 2), rel=0.005)
    assert mode.decay == pytest.approx(drag * mean_square / 8, rel=0.1)


@pytest.mark.parametrize("damping", [0.0, 0.02])
def test_forces_that_keep_the_energy_damp_nothing_however_short_the_recording_is(damping):
    def rate(t, y):
        u, v = np.split(y, 2)
        beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])
        return np.concatenate([v, 0.3 * (beside - 2 * u) - np.sin(u) - damping * v])

    chain = swung(rate, [1.2, -0.4, 0.7, 0.2, 0, 0, 0, 0], 20, 400, 4)
    terms, values = "u[n+1]+u[n-1]-2*u[n]; sin(u[n])", (0.3, -1.0)
    terms, values = (terms + "; v[n]", (*values, -damping)) if damping else (terms, values)
    found = modes_of(terms, values, [chain])
    assert len(found) == 4
    np.testing.assert_allclose([one.decay for one in found], damping / 2, rtol=0.05, atol=1e-9)

    def turning(t, y):
        beside = np.concatenate([y[1:], y[-1:]]) + np.concatenate([y[:1], y[:-1]])
        return 1j * (0.5 * (beside - 2 * y) + np.abs(y) ** 2 * y)

    light = swung(turning, np.array([1.0, 0.4j, -0.6]), 12, 300, 3)
    kept = modes_of("i*(u[n+1]+u[n-1]-2*u[n]); i*abs(u[n])**2*u[n]", (0.5, 1.0), [light])
    assert kept
    assert [one.decay for one in kept] == [0.0] * len(kept)


def test_the_modes_of_a_model_are_those_of_the_longest_of_several_recordings():
    short, long = pendulum(0.2, 20, 200), pendulum(1.8, 40, 400)
    (one,), (other,) = (modes_of("sin(u[n])", (-1.0,), both) for both in ([short, long], [long, short]))
    assert one.frequency == pytest.approx(np.pi / 2 / ellipk(np.sin(0.9) ** 2), rel=0.01)
    assert other.frequency == pytest.approx(one.frequency, rel=1e-3)


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


def test_a_forecast_is_ahead_of_another_by_the_logarithm_of_the_likelihood_ratio():
    generator, noise = np.random.default_rng(4), np.array([0.1, 0.4, 9.0, 9.0])
    seen = generator.normal(size=(50, 1, 2))
    near, far = (seen + size * generator.normal(size=seen.shape) for size in (0.1, 0.3))
    seen[3, 0, 1] = np.nan
    near_log, far_log = (
        np.nansum(scipy.stats.norm.logpdf(one[:, 0] - seen[:, 0], scale=noise[:2])) for one in (near, far)
    )
    one, other, lost = ([Prediction(np.arange(50.0), seen, one, 0.0)] for one in (near, far, np.full_like(far, np.inf)))
    assert ahead(one, other, noise) == pytest.approx(near_log - far_log)
    assert ahead(other, one, noise) == pytest.approx(far_log - near_log)
    assert ahead(one, lost, noise) == np.inf
    # What cannot be fitted to the early readings has all later ones; a forecast has some.
    long = [Prediction(np.arange(80.0), np.ones((80, 1, 2)), np.full((80, 1, 2), np.nan), np.inf)]
    assert ahead(one, long, noise) == np.inf
    assert ahead(lost, one, noise) == ahead(lost, lost, noise) == -np.inf


@pytest.mark.parametrize(
    ("behind", "wrong", "other", "named"),
    [
        (10.0, 1.0, 1.5, True), (40.0, 1.0, 1.5, False), (10.0, 1.0, 1.05, False), (10.0, 2.5, 9.0, False),
        (10.0, 1.0, np.inf, True), (10.0, np.inf, np.inf, False),
    ],
)  # fmt: skip
def test_a_model_without_a_force_is_named_if_it_forecasts_better_by_more_than_it_is_behind(
    behind, wrong, other, named, monkeypatch
):
    """Of 50 readings with noise 1, the forecasts are wrong by so much each."""
    plain, driven = (
        SimpleNamespace(model=SimpleNamespace(may_stand_in=it), rms=np.ones(1), dispersion=1.0) for it in (False, True)
    )
    seen = 10 * np.ones((50, 1, 1))
    forecasts = {
        id(one): [Prediction(np.arange(50.0), seen, seen + size, size)]
        for one, size in ((plain, wrong), (driven, other))
    }
    monkeypatch.setattr(repair, "Worth", lambda *_: SimpleNamespace(value=lambda one: behind if one is plain else 0.0))
    monkeypatch.setattr(repair, "compared", lambda _, fitted: SimpleNamespace(fitted=fitted))
    search = SimpleNamespace(problem=SimpleNamespace(finest=0.0), say=lambda _: None)

    def foreseen(one, _):
        return forecasts[id(one)]

    found = repair._plainer(search, driven, [driven, plain], foreseen)
    assert (found is not None and found.fitted is plain) == named
    assert repair._plainer(search, plain, [driven, plain], foreseen) is None
    assert repair._plainer(search, driven, [driven], foreseen) is None


def test_a_right_forecast_is_as_wrong_as_the_noise_alone_makes_it():
    generator, noise = np.random.default_rng(3), np.array([0.1, 0.4])
    right = np.cos(np.linspace(0, 60, 2000))[:, None, None] * np.array([1.0, 2.0])
    seen = right + noise * generator.normal(size=right.shape)
    seen[generator.random(seen.shape) < 0.2] = np.nan
    forecast = [Prediction(np.arange(2000.0), seen, right, 0.0)]
    assert pooled(forecast) == pytest.approx(by_noise(forecast, noise), rel=0.05)
    assert np.isnan(by_noise([], noise))
    # A sensor without a known noise is left out.
    (alone,) = (replace(one, seen=one.seen[..., :1], predicted=one.predicted[..., :1]) for one in forecast)
    assert by_noise(forecast, np.array([0.1, np.nan])) == pytest.approx(by_noise([alone], noise))


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
