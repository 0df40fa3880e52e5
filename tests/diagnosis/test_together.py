"""One effect in the place of two that swing at one frequency."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

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
