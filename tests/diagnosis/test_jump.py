"""A sensor whose zero moves at one time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.acting import WAYS
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
@pytest.mark.parametrize("zero", [0 * T, 0.02 + 0 * T, 0.04 * T / T[-1]], ids=["right", "off", "drifting"])
def test_a_zero_that_does_not_jump_is_not_said_to(zero):
    found = diagnose(DECLARED, 2, [read(2, zero)], (*INSTRUMENT, find("damping")))
    assert "sensor-jump" not in {one.name for one in found.findings}


def test_a_jump_can_be_no_sharper_than_readings_tell():
    problem = Problem.of(DECLARED, 2, [read(2, 0)], CATALOGUE)
    one = next(one for one in problem.candidates if isinstance(one, WAYS["jump"]))
    sharp = one.moved([JUMP, WHEN, 0.0])
    added = sharp.misread(T, np.zeros((len(T), 1, 1, 2))).added[:, 0, 0, one.site]
    np.testing.assert_allclose(added, JUMP * (T > WHEN), atol=0.003 * JUMP)
    assert one.moved([JUMP, T[0] - 1, 0.0]).possible is False
