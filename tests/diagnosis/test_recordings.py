"""Several recordings, each with zeros or a scale of its own."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import latticebench as lb
from latticebench.diagnosis.acting import WAYS
from latticebench.diagnosis.cure import corrected
from latticebench.diagnosis.horizon import Layout, follow, linearised
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

NOISE, T = 0.003, np.linspace(0, 20, 501)
TRUTH = (1.2, -9.0)
DECLARED = library("pendula", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])")
STARTS = ((0.4, -0.1), (-0.2, 0.35))
ZEROS = np.array([0.02, -0.03])
INSTRUMENT = tuple(find(f"sensor-{name}") for name in ("offset", "gain", "drift", "jump", "curve"))


@functools.cache
def exact(start):
    """The motion of two coupled pendula with a little friction: (T, 2)."""

    def rate(_, y):
        u, v = np.split(y, 2)
        return np.concatenate([v, TRUTH[0] * (u[::-1] - u) + TRUTH[1] * np.sin(u) - 0.04 * v])

    return solve_ivp(rate, T[[0, -1]], [*start, 0, 0], t_eval=T, rtol=1e-10, atol=1e-11).y[:2].T


def recordings(zeros=0.0, scale=1.0):
    """Two recordings, of which the second has zeros and a scale of its own."""
    draw, found = np.random.default_rng(5), []
    for number, start in enumerate(STARTS):
        u = exact(start) + (scale - 1) * number * exact(start) + number * zeros
        found.append(Samples(T, u + NOISE * draw.normal(size=u.shape), source=f"release {number + 1}", ends="free"))
    return found


def test_zeros_that_were_set_anew_are_named_with_their_recording():
    found = diagnose(DECLARED, 2, recordings(ZEROS), (*INSTRUMENT, find("damping")))
    offsets = [one for one in found.findings if one.name == "sensor-offset"]
    assert (found.verdict, {one.name for one in found.findings}) == ("explained", {"sensor-offset", "damping"})
    assert [one.placed.settings().get("recording") for one in offsets].count(None) < len(offsets)
    model = replace(found.after.model, effects=tuple(one.placed for one in offsets))
    still = Samples(T, np.zeros((len(T), 2)), source="still", ends="free")
    # Whichever recording is said to differ from the other.
    zeros = [-corrected(model, still, number).u[0] for number in (0, 1)]
    np.testing.assert_allclose(zeros, [[0, 0], ZEROS], atol=0.001)


def test_readings_are_corrected_by_what_their_own_recording_has():
    made = recordings(ZEROS)
    rows = [pd.DataFrame({"trajectory": k, "t": T, "u1": one.u[:, 0], "u2": one.u[:, 1]}) for k, one in enumerate(made)]
    cause = lb.diagnose(lb.read(pd.concat(rows)), lb.Model("; ".join(DECLARED.texts), order=2, ends="free"))
    for number, (one, right) in enumerate(zip(cause.corrected.samples, made, strict=True)):
        np.testing.assert_allclose(one.u, right.u - number * ZEROS, atol=0.001)


def test_a_sensor_that_read_nothing_then_has_no_zero_of_its_own_in_a_recording():
    one, other = recordings(ZEROS)
    dead = replace(other, u=np.where([True, False], np.nan, other.u))
    problem = Problem.of(DECLARED, 2, [one, dead], CATALOGUE)
    own = {each.recording: each.sites for each in problem.candidates if each.effect.name == "sensor-offset"}
    assert (own[0], own[1]) == ((0, 1), (1,))


def test_a_camera_that_stands_elsewhere_has_a_scale_of_its_own():
    found = diagnose(DECLARED, 2, recordings(scale=1.08), (*INSTRUMENT, find("damping")))
    effects = {one.name: one for one in found.findings}
    assert (found.verdict, set(effects)) == ("explained", {"sensor-gain", "damping"})
    ((label, (value, error)),) = effects["sensor-gain"].values.items()
    true = {"gain of all sensors in recording 1": 1 / 1.08, "gain of all sensors in recording 2": 1.08}[label]
    assert 1 + value == pytest.approx(true, abs=4 * error)
    assert error < 0.01


@pytest.mark.slow
def test_recordings_that_are_read_alike_lack_no_zeros():
    found = diagnose(DECLARED, 2, recordings(), CATALOGUE)
    assert (found.verdict, [one.name for one in found.findings]) == ("explained", ["damping"])


def test_windows_of_one_recording_and_single_recordings_have_no_zeros_of_their_own():
    (single, _) = recordings()
    rows = np.linspace(0, 1, 40_000)
    dense = Samples(20 * rows, np.cos(60_000 * rows)[:, None] * [1.0, 0.7], source="long", ends="free")
    for data, there in ((recordings(), {None, 0, 1}), ([single], {None}), ([dense], {None}), ([dense, single], {None})):
        problem = Problem.of(DECLARED, 2, data, CATALOGUE)
        assert {one.recording for one in problem.candidates if one.effect.name == "sensor-offset"} == there
    assert len(problem.data) > 2


def test_derivatives_of_readings_by_what_one_recording_has_alone_are_finite_differences():
    problem = Problem.of(DECLARED, 2, recordings(ZEROS), CATALOGUE)
    layout = Layout.of(problem, 100, None, 1e-4)
    states = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    own = [one for one in problem.candidates if getattr(one, "recording", None) == 1 and not one.timed]
    assert {type(one) for one in own} == {WAYS["offset"], WAYS["gain"]}
    model = Model(DECLARED, 2, TRUTH, tuple(one.moved(0.01 + 0 * one.numbers) for one in own))
    path = follow(model, layout, states)
    slope, step, count = linearised(path, layout).slope, 1e-6, len(model.numbers)
    for number in range(2, count):
        moved = model.moved(model.numbers + step * np.eye(count)[number])
        numerical = (follow(moved, layout, path.nodes).level - path.level) / step
        np.testing.assert_allclose(slope[..., slope.shape[-1] - count + number], numerical, atol=1e-4)
        first = layout.rows[0].size
        np.testing.assert_allclose(numerical[:first], 0, atol=1e-8)
        assert np.max(np.abs(numerical[first:])) > 0.1


def test_of_other_recordings_nothing_is_said_that_single_ones_have():
    problem = Problem.of(DECLARED, 2, recordings(ZEROS), CATALOGUE)
    single = next(one for one in problem.candidates if getattr(one, "recording", None) == 1)
    every = next(one for one in problem.candidates if one.effect.name == "sensor-offset" and one.recording is None)
    model = Model(DECLARED, 2, TRUTH, (single, every))
    assert model.of_others(2).effects == (every,)
    assert [len(model.instruments(number)) for number in (0, 1)] == [1, 2]
