"""Sensors that lag behind the motion, where positions alone are read."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

import latticebench as lb
from latticebench.diagnosis.acting import WAYS
from latticebench.diagnosis.cure import corrected
from latticebench.diagnosis.fitting import fit
from latticebench.diagnosis.glance import _looked, _Pull
from latticebench.diagnosis.horizon import Layout, follow, linearised
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Structure
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.score import Tangent
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

NOISE, T = 0.003, np.linspace(0, 40, 1001)
DECLARED, TRUTH = library("pendula", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])"), (1.2, -9.0)


@functools.cache
def exact(sites):
    """The motion of coupled pendula as a function of time: positions (sites, T)."""

    def rate(_, y):
        u, v = np.split(y, 2)
        beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])
        return np.concatenate([v, TRUTH[0] * (beside - 2 * u) + TRUTH[1] * np.sin(u)])

    start = np.concatenate([0.5 * np.cos(1.3 * np.arange(sites)), np.zeros(sites)])
    # From before the first reading, where late sensors look.
    dense = solve_ivp(rate, (-2.0, T[-1]), start, rtol=1e-11, atol=1e-12, dense_output=True).sol
    return lambda t: dense(t)[:sites]


def read(lags):
    """Readings of sensors each of which shows where its site was a while ago, with noise."""
    u = np.stack([exact(len(lags))(T - lag)[k] for k, lag in enumerate(lags)], axis=1)
    return Samples(T, u + NOISE * np.random.default_rng(1).normal(size=u.shape), source="pendula", ends="free")


def named(samples, effects=CATALOGUE):
    found = diagnose(DECLARED, 2, [samples], effects)
    return found, {one.name: one for one in found.findings}


def test_a_sensor_behind_a_short_delay_lags_by_it():
    found, effects = named(read((0.0, 0.02, 0.0)))
    assert (found.verdict, set(effects)) == ("explained", {"sensor-lag"})
    value, error = effects["sensor-lag"].values["lag of u2"]
    assert effects["sensor-lag"].site == 1
    assert value == pytest.approx(0.02, abs=4 * error)
    assert found.residual[1] == pytest.approx(1.0, abs=0.02)


def test_channels_that_are_read_one_after_the_other_lag_in_turn():
    for lag in (0.004, -0.004):
        found, effects = named(read(tuple(lag * np.arange(4))))
        assert (found.verdict, set(effects)) == ("explained", {"sensor-lag"})
        value, error = effects["sensor-lag"].values["lag from one sensor to the next"]
        assert value == pytest.approx(lag, abs=4 * error)


@pytest.mark.parametrize(("late", "is_named"), [(0.03, True), (-0.02, True), (0.0, False)])
def test_beside_a_measured_input_all_sensors_may_lag_behind_that(late, is_named):
    def force(t):
        return np.cos(1.3 * t) + np.cos(2.9 * t + 1) + np.cos(5.3 * t + 2) + np.cos(7.7 * t + 3)

    def rate(t, y):
        return [y[1], -20 * y[0] - 0.3 * y[1] + 2 * force(t)]

    t = T[::2]
    motion = solve_ivp(rate, (-1.0, T[-1] + 1), [0.3, 0.0], rtol=1e-10, atol=1e-12, t_eval=t - late).y[0]
    u = motion[:, None] + NOISE * np.random.default_rng(2).normal(size=(len(t), 1))
    samples = Samples(t, u, source="driven", ends="free", f=force(t)[:, None])
    found = diagnose(library("driven", "u[n]; v[n]; f[n]"), 2, [samples], CATALOGUE)
    assert found.verdict == ("explained" if is_named else "nothing missing")
    assert [one.name for one in found.findings] == ["sensor-lag"] * is_named
    for one in found.findings:
        value, error = one.values["lag behind the input"]
        assert value == pytest.approx(late, abs=4 * error)
        assert one.site is None


@pytest.mark.slow
def test_behind_a_filter_of_first_order_a_sensor_lags_and_reads_less():
    constant, t = 0.05, np.linspace(-2, T[-1], 168_001)
    first, kept = exact(3)(t)[0], np.exp(-(t[1] - t[0]) / constant)
    slow = np.interp(T, t, lfilter([1 - kept], [1.0, -kept], first))
    samples = read((0.0, 0.0, 0.0))
    found, effects = named(replace(samples, u=samples.u + np.outer(slow - exact(3)(T)[0], [1.0, 0.0, 0.0])))
    assert (found.verdict, set(effects)) == ("explained", {"sensor-lag", "sensor-gain"})
    # In the middle of the band of the three modes.
    omega = np.sqrt(9.0 + 1.2)
    lag, gain = np.arctan(omega * constant) / omega, 1 / np.hypot(1, omega * constant)
    assert effects["sensor-lag"].values["lag of u1"][0] == pytest.approx(lag, rel=0.02)
    assert 1 + effects["sensor-gain"].values["gain of u1"][0] == pytest.approx(gain, rel=0.003)


def test_of_two_sensors_the_one_that_is_late_is_named():
    for lags, late in (((0.03, 0.0), 0), ((0.0, 0.03), 1)):
        problem = Problem.of(DECLARED, 2, [read(lags)], [find("sensor-lag")])
        found = diagnose(DECLARED, 2, [read(lags)], [find("sensor-lag")])
        assert [(one.name, one.site) for one in found.findings] == [("sensor-lag", late)]
        assert all(not one.moved([-0.01]).possible for one in problem.candidates)


def test_a_single_sensor_cannot_lag_nor_all_alike():
    for sites in (1, 4):
        problem = Problem.of(DECLARED, 2, [read((0.0,) * sites)], [find("sensor-lag")])
        places = {one.sites for one in problem.candidates}
        assert places == (set() if sites == 1 else {(0,), (1,), (2,), (3,), (1, 2, 3), (0, 1, 2, 3)})


@functools.cache
def late(lag=0.02):
    """A fit of a model in which the second of three sensors lags."""
    problem = Problem.of(DECLARED, 2, [read((0.0, 0.02, 0.0))], CATALOGUE)
    layout = Layout.of(problem, 40, None, 1e-4)
    states = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    model = Model(DECLARED, 2, TRUTH, (WAYS["lag"](effect=find("sensor-lag"), sites=(1,), strength=(lag,)),))
    return problem, layout, states, model


def test_derivatives_of_late_readings_are_finite_differences():
    _, layout, states, model = late()
    path = follow(model, layout, states)
    slope, step = linearised(path, layout).slope, 1e-6
    for number in range(3):
        moved = model.moved(model.numbers + step * np.eye(3)[number])
        numerical = (follow(moved, layout, path.nodes).level - path.level) / step
        np.testing.assert_allclose(slope[..., slope.shape[-1] - 3 + number], numerical, atol=1e-4)
    for number in range(6):
        # Of the initial states of all pieces at once.
        ahead = [one.copy() for one in path.nodes]
        ahead[0][:, 0, number] += step
        numerical = (follow(model, layout, ahead).level - path.level) / step
        np.testing.assert_allclose(slope[..., number], numerical, atol=1e-4)


def test_forces_are_glanced_at_through_late_readings_as_they_are_scored():
    problem, layout, states, model = late()
    tangent = Tangent(fit(model, layout, states, structure=Structure(), steps=5))
    looked = _looked(tangent)[0]
    pull = _Pull(tangent, 0, looked)
    for name in ("damping", "local-damping", "drive", "disorder"):
        placed = next(one for one in problem.candidates if one.effect.name == name)
        columns = tangent._columns(0, [placed])
        long = columns.reshape(-1, columns.shape[2]).T @ looked.reshape(columns[..., 0].size, -1)
        short = np.zeros_like(long)
        pull.add([placed], np.array([0, len(long)]), short)
        np.testing.assert_allclose(short, long, rtol=1e-9, atol=1e-9 * np.max(np.abs(long)))


def test_without_velocities_a_lag_is_not_corrected_and_said_to_be_left_out():
    samples = read((0.0, 0.02, 0.0))
    frame = pd.DataFrame(np.column_stack([T, samples.u]), columns=["t", "u1", "u2", "u3"])
    cause = lb.diagnose(lb.read(frame), lb.Model("; ".join(DECLARED.texts), order=2, ends="free"))
    assert cause.left_out == ("sensor-lag",)
    np.testing.assert_array_equal(cause.corrected.samples[0].u, samples.u)
    assert any(line.startswith("lag of u2: 0.0") for line in cause.elsewhere)


def test_a_missing_velocity_is_taken_from_those_around_it_where_a_sensor_lags():
    late = WAYS["lag"](effect=find("sensor-lag"), sites=(1,), strength=(0.1,))
    v = np.ones((4, 3))
    v[2] = np.nan
    found = corrected(Model(DECLARED, 2, TRUTH, (late,)), Samples(T[:4], np.zeros((4, 3)), v, ends="free"), 0)
    np.testing.assert_allclose(found.u, [[0, 0.1, 0], [0, 0.1, 0], [0, 0.1, 0], [0, 0.1, 0]], atol=1e-12)
    np.testing.assert_array_equal(np.isnan(found.v), np.isnan(v))
