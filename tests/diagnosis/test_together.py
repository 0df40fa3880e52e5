"""One effect in the place of two that swing at one frequency."""

from __future__ import annotations

import numpy as np

from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.score import Tangent
from latticebench.diagnosis.together import in_place
from latticebench.systems.effects import find
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
    ((numbers, one),) = in_place(problem, Tangent(found.after))
    assert numbers == (0,)
    assert (one.effect.name, one.site) == ("sensor-hum", 1)
    assert abs(one.frequency - 16.0) < 0.01


def test_a_force_at_one_site_and_one_at_all_give_way_to_the_hum_of_a_sensor():
    data = humming(OMEGA)
    forces = [find("drive"), find("local-drive")]
    found = diagnose(DECLARED, 2, [data], forces)
    assert len(found.findings) == 2
    problem = Problem.of(DECLARED, 2, [data], [*forces, find("sensor-hum")])
    ((numbers, one),) = in_place(problem, Tangent(found.after))
    assert numbers == (0, 1)
    assert (one.effect.name, one.site) == ("sensor-hum", 1)
    assert abs(one.frequency - OMEGA) < 0.01
    assert np.linalg.norm(one.strength) < 0.1
    (alone,) = diagnose(DECLARED, 2, [data], [*forces, find("sensor-hum")]).findings
    assert (alone.name, alone.site) == ("sensor-hum", 1)
