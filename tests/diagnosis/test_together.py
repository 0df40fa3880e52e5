"""One effect in the place of two that swing at one frequency."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp

from latticebench.diagnosis.acting.lasting import Lasted
from latticebench.diagnosis.acting.swinging import Wave
from latticebench.diagnosis.fitting import fit
from latticebench.diagnosis.moments import beside
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.score import Tangent
from latticebench.diagnosis.together import in_place
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

OMEGA = 2.6
DECLARED = library("chain", "u[n+1]+u[n-1]-2*u[n]; u[n]")


def humming(omega):
    """Two sites between walls, both modes in motion; the second sensor hums above them."""
    t = np.linspace(0, 40, 400)
    modes = [np.outer(np.cos(np.sqrt(1.5) * t), [1, 1]), np.outer(np.cos(np.sqrt(2.5) * t + 1), [0.6, -0.6])]
    read = sum(modes) + np.outer(0.08 * np.cos(omega * t), [0, 1])
    read = read + 0.01 * np.random.default_rng(4).normal(size=read.shape)
    return Samples(t, read, source="two", ends="fixed")


def test_a_force_that_pushes_harder_than_all_else_gives_way_to_the_hum_of_a_sensor():
    data = humming(16.0)
    found = diagnose(DECLARED, 2, [data], [find("local-drive")])
    assert [(one.name, one.site) for one in found.findings] == [("local-drive", 1)]
    problem = Problem.of(DECLARED, 2, [data], [find("local-drive"), find("sensor-hum")])
    ((numbers, one),) = in_place(problem, Tangent(found.after), problem.candidates)
    assert numbers == (0,)
    assert (one.effect.name, one.site) == ("sensor-hum", 1)
    assert abs(one.frequency - 16.0) < 0.01


def test_a_force_at_one_site_and_one_at_all_give_way_to_the_hum_of_a_sensor():
    data = humming(OMEGA)
    forces = [find("drive"), find("local-drive")]
    found = diagnose(DECLARED, 2, [data], forces)
    assert len(found.findings) == 2
    problem = Problem.of(DECLARED, 2, [data], [*forces, find("sensor-hum")])
    ((numbers, one),) = in_place(problem, Tangent(found.after), problem.candidates)
    assert numbers == (0, 1)
    assert (one.effect.name, one.site) == ("sensor-hum", 1)
    assert abs(one.frequency - OMEGA) < 0.01
    assert np.linalg.norm(one.strength) < 0.1
    (alone,) = diagnose(DECLARED, 2, [data], [*forces, find("sensor-hum")]).findings
    assert (alone.name, alone.site) == ("sensor-hum", 1)


def test_where_the_length_of_a_pendulum_swings_the_sine_is_what_swings():
    pump = 6.7
    t = np.arange(0, 40, 1 / 25)

    def rate(t, y):
        return [y[1], -(12 + np.cos(pump * t + 0.3)) * np.sin(y[0]) - 0.03 * y[1]]

    u = solve_ivp(rate, t[[0, -1]], [0.9, 0.0], t_eval=t, rtol=1e-10, atol=1e-11).y[:1].T
    data = Samples(t, u + 0.003 * np.random.default_rng(6).normal(size=u.shape), source="swing", ends="fixed")
    found = diagnose(library("pendulum", "sin(u[n])"), 2, [data], CATALOGUE)
    effects = {one.name: one for one in found.findings}
    assert (found.verdict, set(effects)) == ("explained", {"parametric-drive", "damping"})
    values = effects["parametric-drive"].values
    waves = {label: value for label, value in values.items() if label.endswith("*sin(u[n])")}
    assert len(waves) == 2
    size = np.hypot(*(value for value, _ in waves.values()))
    assert abs(size - 1) < 4 * max(error for _, error in waves.values())
    assert abs(values["omega"][0] - pump) < 4 * values["omega"][1]


def tapped(at):
    """Two sites between walls, of which the first is tapped."""
    t = np.linspace(0, 40, 500)

    def rate(t, y):
        pull = 0.5 * (y[1] - 2 * y[0]) - y[0], 0.5 * (y[0] - 2 * y[1]) - y[1]
        return [y[2], y[3], pull[0] + np.exp(-(((t - at) / 0.1) ** 2) / 2), pull[1]]

    u = solve_ivp(rate, t[[0, -1]], [0.2, -0.4, 0, 0], t_eval=t, max_step=0.05, rtol=1e-9, atol=1e-10).y[:2].T
    return Samples(t, u + 0.01 * np.random.default_rng(8).normal(size=u.shape), source="tapped", ends="fixed")


def test_a_kick_of_all_sites_gives_way_to_one_of_a_site_at_another_time():
    data, kicks = tapped(17.3), [find("kick"), find("local-kick")]
    wrong = diagnose(DECLARED, 2, [data], kicks[:1]).after
    problem = Problem.of(DECLARED, 2, [data], kicks)
    singles = [(k, one) for (k, *others), one in in_place(problem, Tangent(wrong), problem.candidates) if not others]
    assert wrong.model.effects
    assert any(one.place == ("local-kick", 0) for _, one in singles)
    (alone,) = diagnose(DECLARED, 2, [data], kicks).findings
    assert (alone.name, alone.site) == ("local-kick", 0)
    value, error = alone.values["at"]
    assert abs(value - 17.3) < 4 * error


def test_a_kick_half_a_wave_off_is_tried_where_something_is_left_about_it():
    data = tapped(17.3)
    problem = Problem.of(DECLARED, 2, [data], [find("local-kick")])
    right = diagnose(DECLARED, 2, [data], [find("local-kick")]).after
    (kick,), half = right.model.effects, np.pi / problem.main
    assert not list(beside(problem, right))
    other = kick.moved([-kick.strength[0], kick.at + half, kick.width])
    wrong = fit(right.model.without(0).with_effect(other), right.layout, right.followed.nodes, structure=None)
    assert wrong.cost > right.cost + 100
    moved = [model.effects[0] for model, _ in beside(problem, wrong)]
    assert min(abs(one.at - 17.3) for one in moved) < 0.25 * half
    assert all(one.strength[0] * wrong.model.effects[0].strength[0] < 0 for one in moved)


def read(rate, start, seed, sites=1, noise=0.005, t=None):
    """Return what is read of the first sites of a motion."""
    t = np.linspace(0, 40, 600) if t is None else t
    found = solve_ivp(rate, t[[0, -1]], start, t_eval=t, max_step=0.05, rtol=1e-9, atol=1e-10).y
    noisy = found[:sites].T + noise * np.random.default_rng(seed).normal(size=(len(t), sites))
    return Samples(t, noisy, source="read", ends="free")


def test_kicks_in_a_row_give_way_to_a_force_that_swings_for_a_while():
    def rate(t, y):
        return [y[1], -4 * y[0] - 0.05 * y[1] + (0.4 * np.sin(3.1 * t) if 13 < t < 24 else 0.0)]

    effects = [find(name) for name in ("kick", "drive", "damping", "onsite-cubic", "side-mass", "clock-jump")]
    found = diagnose(library("spring", "u[n]"), 2, [read(rate, [0.3, 0.0], 3)], effects)
    assert (found.verdict, {one.name for one in found.findings}) == ("explained", {"drive", "damping"})
    (drive,) = (one for one in found.findings if one.name == "drive")
    for name, true in (("omega", 3.1), ("begin", 13.0), ("end", 24.0)):
        value, error = drive.values[name]
        assert abs(value - true) < 4 * error < 0.2
    during = next(label for label in drive.values if label.startswith("cos")).partition("*[")[2]
    assert during.startswith(("12.9", "13.0"))
    assert " < t < 2" in during
    assert found.forecast[1] < 0.5 * found.forecast[0]


def test_a_force_that_dies_away_gives_way_to_a_heavy_support_that_rings():
    def rate(_, y):
        force = -9 * np.sin(y[:2]) + 2 * (y[1::-1] - y[:2]) - 0.02 * y[3:5]
        push = -(4.6**2) * y[2] - 0.1 * y[5]
        return [*y[3:], *(force - push), push]

    effects = [find(name) for name in ("drive", "swaying-support", "damping", "sensor-hum")]
    data = read(rate, [0.3, -0.2, 0.05, 0, 0, 0], 5, sites=2)
    found = diagnose(library("pendula", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])"), 2, [data], effects)
    assert (found.verdict, {one.name for one in found.findings}) == ("explained", {"swaying-support", "damping"})
    (support,) = (one for one in found.findings if one.name == "swaying-support")
    value, error = support.values["omega"]
    assert abs(value - 4.6) < 4 * error
    assert found.forecast[1] < 2 * found.forecast_by_noise


def test_a_wave_that_lasts_for_a_while_is_read_in_the_term_language_as_it_acts():
    wave = Lasted(Wave("cos", 2.5, 3.0), 1.0, 4.0, 0.3)
    t = np.linspace(0, 6, 50)
    for by, step in (("begin", (1e-6, 0)), ("end", (0, 1e-6))):
        up, down = (replace(wave, begin=1 + s * step[0], end=4 + s * step[1])(t) for s in (1, -1))
        np.testing.assert_allclose(replace(wave, by=by)(t), (up - down) / 2e-6, atol=1e-8)
    for one in (wave, replace(wave, by="begin"), replace(wave, by="end")):
        values = eval(str(one), {"t": t, "cos": np.cos, "tanh": np.tanh})
        np.testing.assert_allclose(values, one(t)[0, :, 0], rtol=1e-12)
    beyond = (wave(np.array([-3.0, 9.0])), wave(np.array([2.5])))
    np.testing.assert_allclose(beyond[0], 0, atol=1e-8)
    np.testing.assert_allclose(beyond[1][0, 0, 0], np.cos(2.5 * -0.5), rtol=1e-3)
