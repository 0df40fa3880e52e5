"""Recordings with a measured input: how it goes on between its samples, and what is named beside it."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import make_interp_spline

from latticebench.diagnosis.fitting import fit
from latticebench.diagnosis.forecast import predict
from latticebench.diagnosis.glance import crowding
from latticebench.diagnosis.horizon import Layout
from latticebench.diagnosis.inputs import interpolations, likeliest
from latticebench.diagnosis.instrument import quietest
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Structure
from latticebench.diagnosis.past import past_of, settled
from latticebench.diagnosis.problem import DEGREES, Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.score import Tangent
from latticebench.methods.engine.dynamics import Dynamics
from latticebench.methods.engine.sensitivity import Stretches
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

DECLARED, TRUTH = library("driven", "f[n]; v[n]; u[n]"), (0.8, -0.1, -1.0)
STEP, COUNT, NOISE = 0.5, 600, 3e-5
T = STEP * np.arange(COUNT)
# Half of the frequencies that such samples can show.
OMEGA = np.random.default_rng(5).uniform(0.1, np.pi / 2 / STEP, 60)
PHASE = np.random.default_rng(6).uniform(0, 2 * np.pi, 60)


def smooth(t):
    return 0.15 * np.cos(np.multiply.outer(np.asarray(t), OMEGA) + PHASE).sum(-1)


WAYS = {"held": 0, "straight": 1, "smooth": 7}


def between(way):
    """The input at any time, as a converter, straight lines or nature go on from its samples."""
    return smooth if way == "smooth" else make_interp_spline(T, smooth(T), k=WAYS[way])


@functools.cache
def recording(way, cube=0.15, noise=NOISE):
    """An oscillator with a cubic spring, driven by an input that changes nearly as fast as it is read."""
    force = between(way)

    def rate(t, y):
        return [y[1], 0.8 * force(t) - 0.1 * y[1] - y[0] - cube * y[0] ** 3]

    y, found = np.zeros(2), [0.0]
    for begin in T[:-1]:
        # Each interval for itself: the input may jump between them.
        y = solve_ivp(rate, (begin + 1e-9, begin + STEP - 1e-9), y, rtol=1e-9, atol=1e-10).y[:, -1]
        found.append(y[0])
    u = np.array(found) + noise * np.random.default_rng(1).normal(size=COUNT)
    return Samples(T, u[:, None], f=smooth(T)[:, None], source="driven", ends="free")


def fitted(problem, length=COUNT, effects=(), small=NOISE / 10):
    layout = Layout.of(problem, length, None, small)
    near = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    model = Model(DECLARED, 2, TRUTH, effects)
    return fit(model, layout.with_substeps(model, near, problem.top), near, structure=Structure())


@pytest.mark.parametrize("way", WAYS)
def test_the_readings_tell_how_an_input_goes_on_between_its_samples(way):
    problem = Problem.of(DECLARED, 2, [recording(way, cube=0.0)], ())
    every = interpolations(problem, early=True)
    assert [one.degree for one in every] == [3, *(degree for degree in DEGREES if degree != 3)]
    best, found = likeliest(every, fitted)
    assert best.degree == WAYS[way]
    np.testing.assert_allclose(found.model.coefficients, TRUTH, rtol=1e-3)
    # Later only those next to the present one are tried.
    assert len(interpolations(best, early=False)) <= 3


@pytest.mark.parametrize("way", WAYS)
def test_an_effect_beside_an_input_is_named_and_nothing_that_would_stand_in_for_its_interpolation(way):
    names = ("onsite-cubic", "onsite-quadratic", "quadratic-drag", "drive", "kick", "memory", "constant-force")
    found = diagnose(DECLARED, 2, [recording(way)], [find(name) for name in names])
    assert [one.name for one in found.findings] == ["onsite-cubic"]
    assert found.verdict == "explained"
    assert found.residual[1] < 1.1
    assert found.forecast[1] < 1e-3 < found.forecast[0]
    value, error = found.findings[0].values["u[n]**3"]
    assert abs(value + 0.15) < 5 * error
    assert found.inputs == {
        "held": "held until the next one", "straight": "straight lines", "smooth": "splines of degree 7"
    }[way]  # fmt: skip


def test_an_equation_without_an_input_has_no_interpolation():
    samples = replace(recording("smooth"), f=None)
    problem = Problem.of(library("free", "v[n]; u[n]"), 2, [samples], ())
    assert interpolations(problem, early=True) == [problem]


@pytest.mark.parametrize("integrator", ["dop853", "rk45"])
def test_a_held_input_jumps_where_its_samples_are(integrator):
    samples = recording("held")
    dynamics = Dynamics(library("pushed", "f[n]").terms, 2, False, 1, "free")
    stretches = Stretches(dynamics, T[:-1], T[1:], samples.forcing(0), integrator=integrator)
    end = stretches.run(np.ones(1), np.zeros((COUNT - 1, 2)), np.ones(COUNT - 1, dtype=int))
    f = samples.f[:-1, 0]
    np.testing.assert_allclose(end, np.stack([f * STEP**2 / 2, f * STEP], axis=1), rtol=1e-12, atol=1e-14)


def test_readings_that_are_thinned_leave_the_input_as_it_was():
    t = np.linspace(0, 400, 40_001)
    fast = np.cos(40 * t) + np.cos(0.9 * t)
    u = np.cos(0.9 * t) + 0.001 * np.random.default_rng(0).normal(size=len(t))
    problem = Problem.of(DECLARED, 2, [Samples(t, u[:, None], f=fast[:, None], source="dense", ends="free")], ())
    used = problem.data[0].t
    stride = round(float(np.median(np.diff(used))) / 0.01)
    assert stride >= 8
    assert stride & (stride - 1) == 0
    times = np.linspace(used[0], used[-1], 5000)
    inputs = problem.records[0].stretches.inputs(times)[:, 0]
    np.testing.assert_allclose(inputs, np.cos(40 * times) + np.cos(0.9 * times), atol=2e-3)
    # What an input does between two readings is the integral of all of it.
    whole = quad(lambda s: float(problem.records[0].stretches.inputs(np.array([s]))[0, 0]), used[10], used[11])[0]
    assert whole == pytest.approx(np.sin(40 * used[11]) / 40 - np.sin(40 * used[10]) / 40
                                  + (np.sin(0.9 * used[11]) - np.sin(0.9 * used[10])) / 0.9, abs=1e-5)  # fmt: skip


def test_noise_is_seen_at_the_frequencies_that_an_input_leaves_alone():
    draw = np.random.default_rng(2)
    signal = smooth(T)[:, None, None] * [1.0, 3.0]
    found = quietest(T, signal + [0.01, 0.05] * draw.normal(size=(COUNT, 1, 2)))
    np.testing.assert_allclose(found, [0.01, 0.05], rtol=0.5)
    assert np.all(np.isnan(quietest(T[:50], signal[:50])))


def test_a_line_stands_out_from_its_surroundings_and_the_spectrum_of_a_misfit_does_not():
    samples = recording("smooth", cube=0.0)
    draw = np.random.default_rng(3)
    narrow = np.convolve(draw.normal(size=COUNT), np.exp(-np.arange(80) / 15) * np.cos(np.arange(80)), "same")
    line = np.cos(2 * T)
    for added, crowded in ((narrow, True), (line, False), (0 * T, False)):
        push = 300 * NOISE * added / max(float(np.std(added)), 1.0)
        own = replace(samples, u=samples.u + push[:, None])
        problem = Problem.of(DECLARED, 2, [own], [find("drive")]).interpolated(7)
        fit_ = fitted(problem)
        here = min(problem.candidates, key=lambda one: abs(one.frequency - 2.0))
        best = Tangent(fit_).scored([here])[0].placed
        model = fit_.model.with_effect(best)
        near = fit_.followed.nodes
        with_it = fit(model, fit_.layout, near, structure=Structure())
        crowded_by = crowding(Tangent(with_it), with_it.model.effects[0], problem.candidates)
        assert (crowded_by > 3) == crowded


def test_what_is_fed_with_its_past_is_fed_by_its_own_motion():
    problem = Problem.of(DECLARED, 2, [recording("smooth", cube=0.01)], [find("memory")]).interpolated(7)
    layout = Layout.of(problem, COUNT // 4, None, NOISE)
    near = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    model = Model(DECLARED, 2, TRUTH, (problem.candidates[0].moved([0.05, 0.2]),))
    ready = layout.with_substeps(model, near, problem.top)
    # Fed with readings, a term guides the motion to them; that the spring is not linear is hidden.
    guided = fit(model, ready, near, structure=Structure())
    own = settled(problem, model, ready, near, structure=Structure())
    assert own.rms[0] > 1.1 * guided.rms[0]
    past = past_of(problem, own.layout, own.model, own.followed.nodes)[0]
    np.testing.assert_allclose(own.model.effects[0].past[0](T), past(T), atol=5 * own.rms[0])


def test_a_motion_with_a_past_is_forecast_where_the_last_piece_is_shorter_than_others():
    problem = Problem.of(DECLARED, 2, [recording("smooth", cube=0.01)], [find("memory")]).interpolated(7).first(0.98)
    length = 120
    early = Layout.of(problem.first(0.7), length, None, NOISE).valid[0]
    assert np.sum(early[-1]) < early.shape[1]
    layout = Layout.of(problem, length, None, NOISE)
    near = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    model = Model(DECLARED, 2, TRUTH, (problem.candidates[0].moved([0.05, 0.2]),))
    found = fit(model, layout.with_substeps(model, near, problem.top), near, structure=Structure())
    (forecast,) = predict(found, problem)
    assert np.isfinite(forecast.error)


def test_no_past_comes_after_the_present():
    problem = Problem.of(DECLARED, 2, [recording("smooth")], [find("memory")])
    one = problem.candidates[0]
    later = one.moved([0.01, -one.delay])
    assert one.possible
    assert not later.possible
    assert fitted(problem, effects=(later,)) is None


def test_pulses_beside_a_pulse_are_of_its_width_and_hardly_overlap_with_it():
    problem = Problem.of(DECLARED, 2, [recording("smooth")], [find("kick"), find("drive")])
    kicks = [one for one in problem.candidates if one.effect.name == "kick"]
    here = kicks[len(kicks) // 3]
    others = here.beside(problem.candidates)
    assert len(others) > 8
    assert all(one.width == here.width and abs(one.at - here.at) > 3 * here.width for one in others)
    damping = next(one for one in Problem.of(DECLARED, 2, [recording("smooth")], CATALOGUE).candidates if not one.timed)
    assert list(damping.beside(problem.candidates)) == []
