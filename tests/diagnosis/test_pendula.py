"""What two coupled pendula of a laboratory course do: they rub, and each is read by a sensor of its own make."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.fitting import fit
from latticebench.diagnosis.horizon import Layout
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Structure
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.worth import displaced
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

DECLARED = library("pendula", "u[n+1]+u[n-1]-2*u[n]; u[n]")
COUPLING, SPRING, FRICTION, NOISE = 2.8, 15.2, 0.06, 0.028
OFFSETS, GAIN, CURVE = (-1.0, 1.7), 1.6, 0.008


def swings(t, friction=FRICTION):
    """Angles in degrees."""

    def rate(_, y):
        u, v = y[:2], y[2:]
        return np.concatenate([v, COUPLING * (u[::-1] - u) - SPRING * u - friction * np.tanh(v / 0.01)])

    return solve_ivp(rate, t[[0, -1]], [2.6, 0.4, 3.0, -2.0], t_eval=t, rtol=1e-9, atol=1e-10, max_step=0.01).y[:2].T


@pytest.mark.slow
def test_a_curve_of_one_sensor_is_named_where_it_is_beside_offsets_a_gain_and_friction():
    t = np.arange(0.0, 30.0, 0.1)
    u = swings(t)
    read = np.array(OFFSETS) + u * [1, GAIN] + CURVE * u**2 * [1, 0]
    read += NOISE * np.random.default_rng(5).normal(size=read.shape)
    found = diagnose(DECLARED, 2, [Samples(t, read, ends="free")], CATALOGUE)
    assert {one.name for one in found.findings} == {"sensor-offset", "sensor-gain", "sensor-curve", "dry-friction"}
    values = {label: value for one in found.findings for label, value in one.values.items()}
    # Either sensor may be the one that gives the unit.
    unit, gain = (1.0, {"gain of u2": GAIN - 1}) if "gain of u2" in values else (GAIN, {"gain of u1": 1 / GAIN - 1})
    for label, true in {**gain, "curve of u1": CURVE / unit**2, "sign(v[n])": -FRICTION * unit}.items():
        value, error = values[label]
        assert abs(value - true) < 4 * error, label
    assert found.residual[1] < 1.1


@pytest.mark.parametrize("away", [0.0, 4.0, -20.0])
def test_a_motion_far_from_its_zero_costs_nats_as_cauchys_prior_has_it(away):
    t = np.arange(0.0, 12.0, 0.05)
    u = swings(t, friction=0.0)
    problem = Problem.of(DECLARED, 2, [Samples(t, u, ends="free")], CATALOGUE)
    force = next(one for one in problem.candidates if one.effect.name == "constant-force")
    zeros = next(one for one in problem.candidates if one.effect.name == "sensor-offset" and one.site is None)
    moved = (force.moved([SPRING * away]), zeros.moved([-away, -away]))
    layout = Layout.of(problem, len(t), None, 1e-6)
    near = [nodes[rows].copy() for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    for one in near:
        one[..., :2] += away
    found = fit(Model(DECLARED, 2, (COUPLING, SPRING * -1), moved), layout, near, structure=Structure(), steps=0)
    assert found is not None
    swing = np.sqrt(np.mean(np.var(u, axis=0) + found.noise.deviation() ** 2))
    mean = np.mean(u, axis=0)
    distances = [np.sqrt(np.mean((mean + shift) ** 2)) / swing for shift in (away, 0.0)]
    assert displaced(found) == pytest.approx(np.log1p(max(distances[0] - distances[1], 0.0) ** 2), rel=1e-3, abs=1e-6)


def test_a_pendulum_of_another_length_has_another_sine_not_a_spring_beside_it():
    t, gravity = np.linspace(0, 30, 900), np.array([9.0, 9.0, 9.6])

    def rate(t, y):
        u, v = np.split(y, 2)
        beyond = np.concatenate([u[:1], u, u[-1:]])
        return np.concatenate([v, 1.1 * np.diff(beyond, 2) - gravity * np.sin(u)])

    u = solve_ivp(rate, t[[0, -1]], [0.9, 0.0, -0.5, 0, 0, 0], t_eval=t, rtol=1e-10, atol=1e-11).y[:3].T
    data = Samples(t, u + 0.003 * np.random.default_rng(8).normal(size=u.shape), source="three", ends="free")
    found = diagnose(library("pendula", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])"), 2, [data], CATALOGUE)
    ((defect),) = found.findings
    assert (found.verdict, defect.name, defect.site) == ("explained", "defect", 2)
    ((label, (value, error)),) = defect.values.items()
    assert label == "sin(u[n])"
    assert value == pytest.approx(-0.6, abs=4 * error)
