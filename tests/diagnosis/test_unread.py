"""What is not read: a mass that hangs beside a site, and a support that carries all sites."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.acting.scene import Course
from latticebench.diagnosis.acting.side_mass import SideMass
from latticebench.diagnosis.cure import cure
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

SITES, NOISE, T = 3, 3e-3, np.linspace(0, 20, 601)
DECLARED, COUPLING, GRAVITY, DAMPING = library("pendula", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])"), 3.0, -20.0, 0.04
SOME = tuple(
    find(name)
    for name in ("damping", "defect", "unequal-masses", "local-damping", "local-drive", "memory", "side-mass")
)
# What stands in for a support on short pieces.
ALIKE = tuple(find(name) for name in ("next-neighbour", "sensor-crosstalk", "drive", "swaying-support"))


def recording(mass=0.3, omega=4.6, gamma=0.05, drag=0.0, start=(0.1, 0.3), seed=5):
    """Three pendula, at the first of which hangs a mass that moves as a recording begins; its place, too."""

    def rate(_, y):
        u, v, (place, speed) = y[:SITES], y[SITES:-2], y[-2:]
        force = COUPLING * np.diff(np.r_[u[0], u, u[-1]], 2) + GRAVITY * np.sin(u) - DAMPING * v
        pull = omega**2 * (place - u[0]) + gamma * (speed - v[0])
        force[0] += mass * pull
        return np.r_[v, force, speed, -pull - drag * speed]

    begin = [0.4, 0.0, -0.2, *np.zeros(SITES), *start]
    y = solve_ivp(rate, T[[0, -1]], begin, t_eval=T, rtol=1e-10, atol=1e-11).y.T
    u = y[:, :SITES] + NOISE * np.random.default_rng(seed).normal(size=(len(T), SITES))
    return Samples(T, u, source="pendula", ends="free"), y[:, -2]


def checked(found, mass=0.3, omega=4.6):
    """The placed mass of a diagnosis that has found it with the damping and nothing else."""
    assert {one.name for one in found.findings} == {"damping", "side-mass"}
    # Of some noise a little looks like more, in one of two hundred recordings.
    assert found.verdict in ("explained", "partly explained")
    assert found.residual[1] < 1.1
    (one,) = (one for one in found.findings if one.name == "side-mass")
    placed = one.placed
    block = found.after.model.blocks[found.after.model.effects.index(placed)]
    errors = found.after.stderr[block]
    assert placed.here == 0
    assert placed.strength[0] == pytest.approx(mass, abs=4 * errors[0])
    assert placed.omega == pytest.approx(omega, abs=4 * errors[1])
    assert errors[0] < 0.01 * mass
    return placed


@pytest.mark.slow
def test_a_mass_that_hangs_beside_a_site_is_named_with_its_size_and_frequency_and_where_it_is_is_known():
    samples, place = recording()
    found = diagnose(DECLARED, 2, [samples], SOME)
    placed = checked(found)
    states = found.after.followed.nodes[0][found.after.layout.valid[0]]
    assert np.std(states[:, -2] - place) < 0.02 * np.std(place)
    # The forecast knows where the mass is, too.
    assert found.forecast[1] < 1.5 * found.forecast_by_noise < 0.2 * found.forecast[0]
    assert cure(found.after.model, found.after.chain).left_out == ("side-mass",)
    # It makes one mode more.
    assert [len(some) for some in found.modes[1:]] == [SITES, SITES + 1]
    assert "not read" in placed.sentences(found.after.chain)[0]


def test_a_candidate_knows_where_what_is_not_read_would_be():
    samples, place = recording(drag=0.2, start=(0.4, 0.0))
    past = Course.of(T, samples.u[:, None])
    one = SideMass(
        effect=find("side-mass"), here=0, omega=4.6, gamma=0.05, drag=0.2, past=(past,), step=T[1], strength=(0.3,)
    )
    where = one.unread(past, T[None])[0]
    # It is noise that the smooth curve goes through: most of it is too fast for the mass.
    assert np.std(where[:, 0] - place) < 0.1 * np.std(place)


@pytest.mark.slow
def test_a_mass_that_hardly_weighs_anything_does_not_swing_in_the_place_of_what_dies_out():
    """On one pendulum, a mass of nothing that swings a hundred times as far does what a damping and a cube do."""
    t = np.linspace(0, 60, 401)
    y = solve_ivp(lambda _, y: [y[1], -3.6 * y[0] - 0.5 * y[0] ** 3 - 0.02 * y[1]], t[[0, -1]], [0.6, 0], t_eval=t).y[0]
    samples = Samples(t, (y + 0.03 * np.random.default_rng(3).normal(size=t.size))[:, None], ends="free")
    found = diagnose(library("spring", "u[n]"), 2, [samples], (*SOME, find("onsite-cubic")))
    assert {one.name for one in found.findings} == {"damping", "onsite-cubic"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [6, 7])
def test_a_mass_that_is_not_read_is_found_among_all_effects(seed):
    checked(diagnose(DECLARED, 2, [recording(seed=seed)[0]], CATALOGUE))


@pytest.mark.slow
def test_a_mass_that_swings_in_air_is_found_and_a_recording_without_any_mass_has_none():
    found = diagnose(DECLARED, 2, [recording(0.06, 5.0, 0.0, 0.15)[0]], CATALOGUE)
    checked(found, 0.06, 5.0)
    without = diagnose(DECLARED, 2, [recording(0.0)[0]], CATALOGUE)
    assert [one.name for one in without.findings] == ["damping"]


@pytest.mark.slow
def test_of_two_recordings_each_has_a_mass_that_begins_elsewhere():
    every = [recording()[0], replace(recording(start=(-0.2, 0.5), seed=8)[0], source="again")]
    checked(diagnose(DECLARED, 2, every, SOME))


def carried(mass, omega, gamma):
    """Three pendula beside one another, which nothing couples but a bar that all hang on, and where the bar is."""

    def rate(_, y):
        u, v, (place, speed) = y[:SITES], y[SITES:-2], y[-2:]
        force = GRAVITY * np.sin(u)
        sway = -(omega**2) * place - gamma * speed - mass * np.sum(force)
        return np.r_[v, force - sway, speed, sway]

    y = solve_ivp(rate, T[[0, -1]], [0.4, 0.05, -0.2, *np.zeros(5)], t_eval=T, rtol=1e-10, atol=1e-11).y.T
    u = y[:, :SITES] + NOISE * np.random.default_rng(5).normal(size=(len(T), SITES))
    return Samples(T, u, source="clocks", ends="free"), y[:, -2]


@pytest.mark.slow
@pytest.mark.parametrize(("mass", "omega", "gamma"), [(0.05, 1.34, 0.1), (0.3, 17.9, 1.0)])
def test_a_support_that_sways_is_named_be_it_softer_or_stiffer_than_what_hangs_on_it(mass, omega, gamma):
    samples, place = carried(mass, omega, gamma)
    found = diagnose(library("clocks", "sin(u[n])"), 2, [samples], (*SOME, *ALIKE))
    assert (found.verdict, [one.name for one in found.findings]) == ("explained", ["swaying-support"])
    placed, errors = found.findings[0].placed, found.after.stderr[found.after.model.blocks[0]]
    assert placed.numbers == pytest.approx([mass, omega, gamma], abs=4 * np.max(errors))
    assert errors[0] < 0.05 * mass
    states = found.after.followed.nodes[0][found.after.layout.valid[0]]
    assert np.std(states[:, -2] - place) < 0.2 * np.std(place)
    assert [len(some) for some in found.modes[1:]] == [SITES, SITES + 1]
    assert "not read" in placed.sentences(found.after.chain)[0]


def test_supports_are_looked_for_where_all_sites_have_an_equation():
    samples, _ = carried(0.05, 1.34, 0.1)
    for ends, there in (("free", True), ("unknown", False)):
        problem = Problem.of(DECLARED, 2, [replace(samples, ends=ends)], CATALOGUE)
        assert any(one.effect.name == "swaying-support" for one in problem.candidates) == there
