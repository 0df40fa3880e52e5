"""What carts on a bench do: they rub until they stand still, and their sensors face each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.mirrored import mirrored
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.regression import regressed
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.readers import read
from latticebench.systems.samples import Samples

CARTS = Path(__file__).parents[3] / "shared" / "data" / "measured" / "carts.csv"
OMEGA, FRICTION, SWING, NOISE = 3.0, 0.35, 1.0, 0.005
STIFF, SOFT = 9.0, 3.0
COUPLING = "u[n+1]+u[n-1]-2*u[n]"


def rubbing(t):
    """Return u of u'' = -omega^2 u - friction sign(v), let go at `SWING`, in closed form.

    From turn to turn it is a cosine about friction / omega^2 on the side that it comes from; where it turns within
    that distance of zero, it stays.
    """
    middle, turn = FRICTION / OMEGA**2, SWING
    found = np.empty_like(t)
    for half in range(len(t)):
        begin = half * np.pi / OMEGA
        later = t >= begin
        if abs(turn) <= middle:
            found[later] = turn
            return found
        about = middle * np.sign(turn)
        found[later] = about + (turn - about) * np.cos(OMEGA * (t[later] - begin))
        turn = 2 * about - turn
    raise AssertionError("it never stops")


def test_friction_is_named_though_it_brings_the_motion_to_a_stop_within_the_recording():
    t = np.linspace(0, 20, 500)
    u = rubbing(t)
    # A third of the recording is at rest, off the middle.
    assert np.all(u[-150:] == u[-1])
    assert abs(u[-1]) > 2 * NOISE
    readings = u + NOISE * np.random.default_rng(1).normal(size=len(t))
    found = diagnose(library("one", "u[n]"), 2, [Samples(t, readings[:, None], ends="fixed")], CATALOGUE)
    assert found.verdict == "explained"
    (friction,) = found.findings
    assert friction.name == "dry-friction"
    value, error = friction.values["sign(v[n])"]
    assert abs(value + FRICTION) < 4 * error
    assert found.residual[1] < 1.1


def test_one_of_three_carts_that_rubs_is_named():
    t = np.arange(0, 20, 0.04)

    def rate(_, y):
        u, v = np.split(y, 2)
        beyond = np.concatenate([u[:1], u, u[-1:]])
        # The friction's layer is far thinner than the swings of the velocity.
        own = 0.15 * np.tanh(v / 0.01)
        return np.concatenate([v, 3 * np.diff(beyond, 2) - 12 * u - 0.02 * v - own * np.eye(3)[1]])

    u = solve_ivp(rate, t[[0, -1]], [0.5, 0.1, 0.2, 0, 0, 0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.01).y[:3].T
    data = Samples(t, u + NOISE * np.random.default_rng(3).normal(size=u.shape), source="carts", ends="free")
    some = [one for one in CATALOGUE if one.name.endswith(("damping", "drag", "friction"))]
    found = diagnose(library("carts", f"{COUPLING}; u[n]"), 2, [data], some)
    effects = {one.name: one for one in found.findings}
    assert (found.verdict, set(effects)) == ("explained", {"damping", "local-friction"})
    value, error = effects["local-friction"].values["sign(v[n])"]
    assert effects["local-friction"].site == 1
    assert value == pytest.approx(-0.15, abs=4 * error + 0.002)


@pytest.mark.parametrize("terms", ["u[n+1]+u[n-1]-2*u[n]", "u[n+1]+u[n-1]-2*u[n]; u[n]"])
def test_sensors_that_face_each_other_are_told_from_a_repulsion_whether_or_not_a_spring_at_each_site_is_declared(terms):
    t = np.linspace(0, 40, 600)
    # Two carts between walls: modes of stiffness STIFF and STIFF + 2 SOFT, between walls and between carts.
    both, between = np.cos(np.sqrt(STIFF) * t), 0.8 * np.cos(np.sqrt(STIFF + 2 * SOFT) * t)
    first, second = (both + between) / 2, (both - between) / 2
    draw = np.random.default_rng(2)
    readings = np.stack([first, -second], axis=1) + NOISE * draw.normal(size=(len(t), 2))
    found = diagnose(library("two", terms), 2, [Samples(t, readings, ends="fixed")], CATALOGUE)
    assert found.verdict == "explained"
    names = [one.name for one in found.findings]
    assert sorted(names) == (["sensor-gain"] if "; u[n]" in terms else ["onsite-linear", "sensor-gain"])
    assert abs(found.declared[1][0] - SOFT) < 0.01


@pytest.mark.slow
@pytest.mark.skipif(not CARTS.exists(), reason="carts.csv is not here")
def test_carts_that_come_to_rest_are_damped_and_not_driven():
    (readings,) = read(CARTS)
    # Beside an error of the first sensor that repeats, the spring is no rival.
    effects = [one for one in CATALOGUE if one.name != "sensor-cyclic"]
    found = diagnose(library("two", "u[n+1]+u[n-1]-2*u[n]; u[n]"), 2, [replace(readings, ends="fixed")], effects)
    names = {one.name for one in found.findings}
    assert {"sensor-gain", "quadratic-drag", "bond-damping"} <= names
    assert not found.after.model.may_stand_in
    # A modulated spring stands in for the drag on all readings, and forecasts worse.
    assert found.forecast[1] < 0.51
    (_, none), (others, ahead) = found.horizons[-1].models
    assert none == 0
    assert "parametric-drive" in others
    assert ahead < 0
    assert any(one.name == "parametric-drive" for one in found.horizons[-1].tried)


def five_beads(turned=()):
    """Five beads on a string, with noise; some sensors look from the other side."""
    sites, t = 5, np.linspace(0, 12, 400)
    between = 2 * np.eye(sites) - np.eye(sites, k=1) - np.eye(sites, k=-1)
    squares, shapes = np.linalg.eigh(3 * between)
    begins = shapes.T @ np.array([0.5, 0.0, 0.2, 0.0, -0.1])
    u = (np.cos(np.sqrt(squares) * t[:, None]) * begins) @ shapes.T
    u[:, list(turned)] *= -1
    return Samples(t, u + 0.003 * np.random.default_rng(2).normal(size=u.shape), source="beads", ends="fixed")


@pytest.mark.parametrize("turned", [(0,), (2,), (1, 3), (3, 4), (0, 1)])
def test_on_a_longer_chain_sensors_that_look_from_the_other_side_are_found_before_the_search(turned):
    chain = library("chain", COUPLING)
    problem = Problem.of(chain, 2, [five_beads(turned)], CATALOGUE)
    ((model, seen),) = mirrored(problem, Model(chain, 2, regressed(problem)[0]))
    assert {one.site for one in model.effects} == set(turned)
    assert all(one.effect.name == "sensor-gain" and one.strength == (-2.0,) for one in model.effects)
    assert model.coefficients == pytest.approx([3], rel=0.02)
    straight = Problem.of(chain, 2, [five_beads()], CATALOGUE)
    np.testing.assert_allclose(seen.nodes[0][:, :5], straight.nodes[0][:, :5], atol=0.02)
    assert mirrored(straight, Model(chain, 2, regressed(straight)[0])) == []


def test_readings_that_a_term_cannot_take_from_the_other_side_do_no_harm():
    u = five_beads().u + 2.0
    data = Samples(np.linspace(0, 12, 400), u, source="above zero", ends="free")
    rooted = library("rooted", f"{COUPLING}; u[n]; sqrt(u[n])")
    problem = Problem.of(rooted, 2, [data], CATALOGUE)
    assert mirrored(problem, Model(rooted, 2, regressed(problem)[0])) == []


def test_a_sensor_in_the_middle_of_a_longer_chain_that_looks_from_the_other_side_is_all_that_is_named():
    found = diagnose(library("chain", COUPLING), 2, [five_beads((2,))], CATALOGUE)
    assert [(one.name, one.site) for one in found.findings] == [("sensor-gain", 2)]
    assert found.verdict == "explained"
