"""Sensors whose scale is bent, to one side or to both."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import CATALOGUE, Effect, find
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

NOISE, T, SITES = 0.003, np.linspace(0, 20, 401), 3
DECLARED = library("pendula", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])")
CURVES = [
    find(name) for name in ("sensor-curve", "sensor-saturation", "sensor-gain", "onsite-cubic", "onsite-quadratic")
]


def pendula():
    def rate(_, y):
        u, v = np.split(y, 2)
        beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])
        return np.concatenate([v, 1.2 * (beside - 2 * u) - 9 * np.sin(u)])

    start = np.concatenate([[0.6, 0.1, -0.3], np.zeros(SITES)])
    return solve_ivp(rate, T[[0, -1]], start, t_eval=T, rtol=1e-10, atol=1e-11).y[:SITES].T


def read(u):
    return Samples(T, u + NOISE * np.random.default_rng(5).normal(size=u.shape), source="pendula", ends="free")


@pytest.mark.parametrize(
    ("name", "label", "power", "bend"),
    [
        pytest.param("sensor-curve", "curve of u", 2, 0.1, marks=pytest.mark.slow),
        ("sensor-saturation", "cubic curve of u", 3, -0.15),
    ],
)
def test_a_lens_in_front_of_all_sites_is_named_with_its_bend(name, label, power, bend):
    u = pendula()
    found = diagnose(DECLARED, 2, [read(u + bend * u**power)], CURVES)
    assert (found.verdict, [one.name for one in found.findings]) == ("explained", [name])
    value, error = found.findings[0].values[label]
    assert found.findings[0].site is None
    assert value == pytest.approx(bend, abs=4 * error)


def test_one_amplifier_that_saturates_is_found_at_its_site():
    u = pendula()
    u[:, 1] -= 0.6 * u[:, 1] ** 3
    found = diagnose(DECLARED, 2, [read(u)], CURVES)
    assert [(one.name, one.site) for one in found.findings] == [("sensor-saturation", 1)]


def test_what_is_no_power_of_the_reading_is_refused_as_a_curve():
    wrong = Effect("bent", "sin(u[n])", acts="curve")
    with pytest.raises(InputError, match="effect 'bent': what acts as a curve adds a power of the reading"):
        Problem.of(DECLARED, 2, [read(pendula())], (*CATALOGUE, wrong))
