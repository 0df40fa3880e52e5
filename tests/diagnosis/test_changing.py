"""Coefficients that change while a recording is made: steadily, or at one time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.acting import WAYS
from latticebench.diagnosis.acting.sudden import Rise
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

NOISE, T = 0.003, np.linspace(0, 40, 801)
COUPLING = "u[n+1]+u[n-1]-2*u[n]"
DUFFING, PENDULA = library("duffing", "u[n]; u[n]**3"), library("pendula", f"{COUPLING}; sin(u[n])")
WHEN = 21.3


def read(force, start, ends="fixed"):
    """Readings of what a force of time, positions and velocities moves."""

    def rate(t, y):
        u, v = np.split(y, 2)
        return np.concatenate([v, force(t, u, v)])

    found = solve_ivp(rate, T[[0, -1]], start, t_eval=T, rtol=1e-10, atol=1e-11, max_step=0.05).y[: len(start) // 2].T
    return Samples(T, found + NOISE * np.random.default_rng(3).normal(size=found.shape), source="made", ends=ends)


def duffing(t, u, v, ageing=0.0, loss=0.04):
    """A spring that loses a share of its stiffness in the recording, with a little friction."""
    return -25 * (1 - ageing * t / T[-1]) * u - 8 * u**3 - loss * v


def pendula(t, u, v, slip=0.0):
    """Coupled pendula with a little friction; the springs between them are weaker from one time on."""
    beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]]) - 2 * u
    return (1.2 - slip * (t > WHEN)) * beside - 9 * np.sin(u) - 0.03 * v


SWINGS = np.array([0.3, -0.2, 0.0, 0.0])


def test_a_stiffness_that_drifts_is_named_with_how_much_it_changes():
    found = diagnose(DUFFING, 2, [read(lambda *y: duffing(*y, ageing=0.03), [0.9, 0.0])], CATALOGUE)
    effects = {one.name: one for one in found.findings}
    assert (found.verdict, set(effects)) == ("explained", {"damping", "coefficient-drift"})
    ((label, (value, error)),) = effects["coefficient-drift"].values.items()
    assert label == "(t-20)/40*u[n]"
    assert value == pytest.approx(25 * 0.03, abs=4 * error)
    assert error < 0.05


def test_a_spring_that_slips_is_named_with_its_time():
    found = diagnose(PENDULA, 2, [read(lambda *y: pendula(*y, slip=0.3), SWINGS, "free")], CATALOGUE)
    effects = {one.name: one for one in found.findings}
    assert (found.verdict, set(effects)) == ("explained", {"damping", "coefficient-jump"})
    value, error = effects["coefficient-jump"].values[f"step of {COUPLING}"]
    assert value == pytest.approx(-0.3, abs=4 * error)
    when, error = effects["coefficient-jump"].values["at"]
    assert when == pytest.approx(WHEN, abs=4 * error)
    assert found.after.chain.sites == 2


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.06])
def test_a_frequency_that_moves_with_the_size_of_the_swings_is_no_drift(loss):
    linear = library("linear", "u[n]")
    found = diagnose(linear, 2, [read(lambda *y: duffing(*y, loss=loss), [0.5, 0.0])], CATALOGUE)
    names = {one.name for one in found.findings}
    # Of swings that are all alike, a sensor that saturates may say the same.
    assert names == {"onsite-cubic", "damping"} if loss else names <= {"onsite-cubic", "sensor-saturation"}
    assert found.verdict == "explained"


def test_every_declared_coefficient_may_change_and_that_of_a_linear_force():
    problem = Problem.of(PENDULA, 2, [read(pendula, SWINGS, "free")], CATALOGUE)
    for way in ("ramp", "step"):
        found = [one for one in problem.candidates if isinstance(one, WAYS[way])]
        assert {one.text for one in found} == {COUPLING, "sin(u[n])", "u[n]"}
        assert all(one.possible for one in found)
    assert found[0].moved([1.0, T[0] - 1, 1.0]).possible is False


def test_a_step_is_sharp_for_what_moves_and_no_sharper():
    problem = Problem.of(PENDULA, 2, [read(pendula, SWINGS, "free")], CATALOGUE)
    one = next(one for one in problem.candidates if isinstance(one, WAYS["step"]))
    factor = one.moved([1.0, WHEN, 0.0]).forces(problem.chain)[0].factor
    assert isinstance(factor, Rise)
    np.testing.assert_allclose(factor(WHEN + np.array([-0.1, 0.0, 0.1]))[0, :, 0], [0.0, 0.5, 1.0], atol=0.02)
    assert factor.wide == pytest.approx(0.1 / problem.top, rel=1e-6)
