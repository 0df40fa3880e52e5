"""A sensor whose zero moves at one time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.acting import WAYS
from latticebench.diagnosis.forecast import Prediction, unforeseen, up_to
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

NOISE, T = 0.003, np.linspace(0, 40, 801)
DECLARED = library("pendula", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])")
WHEN, JUMP = 17.225, 0.04
INSTRUMENT = tuple(find(f"sensor-{name}") for name in ("offset", "drift", "jump", "wander", "hum", "gain"))


def pendula(sites):
    """The motion of coupled pendula with a little friction: (T, sites)."""

    def rate(_, y):
        u, v = np.split(y, 2)
        beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])
        return np.concatenate([v, 1.2 * (beside - 2 * u) - 9 * np.sin(u) - 0.05 * v])

    start = np.concatenate([0.5 * np.cos(1.3 * np.arange(sites)), np.zeros(sites)])
    return solve_ivp(rate, T[[0, -1]], start, t_eval=T, rtol=1e-10, atol=1e-11).y[:sites].T


def read(sites, zero):
    """Readings of pendula of which the last one's zero goes its own way."""
    u = pendula(sites) + NOISE * np.random.default_rng(3).normal(size=(len(T), sites))
    u[:, -1] += zero
    return Samples(T, u, source="pendula", ends="free")


@pytest.mark.parametrize("sites", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_sensor_that_is_knocked_is_named_with_the_time_and_by_how_much(sites):
    found = diagnose(DECLARED, 2, [read(sites, JUMP * (T > WHEN))], (*INSTRUMENT, find("damping")))
    effects = {one.name: one for one in found.findings}
    assert (found.verdict, set(effects)) == ("explained", {"damping", "sensor-jump"})
    assert effects["sensor-jump"].site == sites - 1
    value, error = effects["sensor-jump"].values[f"jump of u{sites}"]
    assert value == pytest.approx(JUMP, abs=4 * error)
    # Between two readings nobody knows when.
    assert effects["sensor-jump"].placed.at == pytest.approx(WHEN, abs=1.5 * (T[1] - T[0]))


@pytest.mark.slow
def test_a_zero_that_moves_within_a_while_has_its_middle_and_its_width():
    found = diagnose(DECLARED, 2, [read(2, JUMP * (1 + np.tanh((T - WHEN) / 0.8)) / 2)], (*INSTRUMENT, find("damping")))
    (jump,) = (one for one in found.findings if one.name == "sensor-jump")
    for name, true in (("at", WHEN), ("width", 0.8)):
        value, error = jump.values[name]
        assert abs(value) == pytest.approx(true, abs=4 * error)


@pytest.mark.slow
def test_what_happens_while_a_forecast_runs_does_not_speak_against_what_was_there_before():
    late = 33.02
    found = diagnose(DECLARED, 2, [read(2, -0.03 + JUMP * (late < T))], (*INSTRUMENT, find("damping")))
    assert (found.verdict, {one.name for one in found.findings}) == (
        "explained", {"damping", "sensor-offset", "sensor-jump"},
    )  # fmt: skip
    (after,) = found.forecasts[1]
    assert T[int(0.7 * len(T))] <= after.t[0] < after.t[-1] < late + 0.05


def test_forecasts_end_where_something_happens_that_early_readings_do_not_show():
    problem = Problem.of(DECLARED, 2, [read(2, 0)], CATALOGUE)
    jump = next(one for one in problem.candidates if isinstance(one, WAYS["jump"]))
    model = Model(DECLARED, 2, (1.2, -9.0), tuple(jump.moved([JUMP, at, 0.1]) for at in (10.0, 37.0, 33.0)))
    assert unforeseen(model, problem) == 33.0
    assert unforeseen(model.without(2).without(1), problem) == np.inf
    t = np.array([31.0, 32.0, 33.0, 34.0])
    seen = np.ones((4, 1, 2))
    (part,) = up_to([Prediction(t, seen, np.array([1.1, 1.1, 5, 5])[:, None, None] * seen, 3.0)], 33.0)
    assert (part.t.tolist(), part.error) == ([31.0, 32.0], pytest.approx(0.1))
    (whole,) = up_to([Prediction(t, seen, seen, 0.5)], 30.0)
    assert (len(whole.t), whole.error) == (4, 0.5)


def test_a_jump_between_two_readings_has_no_width_and_its_time_is_known_to_about_their_interval():
    found = diagnose(DECLARED, 2, [read(1, JUMP * (T > WHEN))], (find("sensor-jump"), find("damping")))
    (jump,) = (one for one in found.findings if one.name == "sensor-jump")
    assert set(jump.values) == {"jump of u1", "at"}
    assert set(jump.placed.settings()) == {"site", "at"}
    assert jump.values["at"][1] < 2 * (T[1] - T[0])


@pytest.mark.slow
@pytest.mark.parametrize("zero", [0 * T, 0.02 + 0 * T, 0.04 * T / T[-1]], ids=["right", "off", "drifting"])
def test_a_zero_that_does_not_jump_is_not_said_to(zero):
    found = diagnose(DECLARED, 2, [read(2, zero)], (*INSTRUMENT, find("damping")))
    assert "sensor-jump" not in {one.name for one in found.findings}


def test_a_jump_can_be_no_sharper_than_readings_tell():
    problem = Problem.of(DECLARED, 2, [read(2, 0)], CATALOGUE)
    one = next(one for one in problem.candidates if isinstance(one, WAYS["jump"]))
    sharp = one.moved([JUMP, WHEN, 0.0])
    added = sharp.misread(T, np.zeros((len(T), 1, 1, 2))).added[:, 0, 0, one.site]
    np.testing.assert_allclose(added, JUMP * (T > WHEN), atol=0.01 * JUMP)
    assert one.moved([JUMP, T[0] - 1, 0.0]).possible is False
