"""Sensors that hear one another, fade, keep a time of their own, or receive two quadratures unlike."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.acting import WAYS
from latticebench.diagnosis.cure import corrected, staying
from latticebench.diagnosis.fitting import Fitted, fit
from latticebench.diagnosis.glance import _looked, _Pull
from latticebench.diagnosis.horizon import Layout
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Structure
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import Diagnosis, diagnose
from latticebench.diagnosis.score import Tangent
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

SITES, NOISE, T = 4, 3e-3, np.linspace(0, 20, 601)
DECLARED, TRUTH = library("pendula", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])"), (2.0, -16.0)
TURNING = library("turning", "i*(u[n+1]+u[n-1]-2*u[n]); i*abs(u[n])**2*u[n]")
SOME = tuple(
    find(name)
    for name in (
        "damping",
        "sensor-gain",
        "sensor-lag",
        "sensor-cyclic",
        "sensor-gain-jump",
        "sensor-crosstalk",
        "sensor-clock",
    )
)


def beside(u):
    """The sum of both neighbours on a chain with free ends."""
    return np.concatenate([u[:1], u[:-1]]) + np.concatenate([u[1:], u[-1:]])


@functools.cache
def exact():
    """Four pendula whose swings fall, as a function of time: positions (sites, T)."""

    def rate(_t, y):
        u, v = np.split(y, 2)
        return np.concatenate([v, TRUTH[0] * (beside(u) - 2 * u) + TRUTH[1] * np.sin(u) - 0.04 * v])

    start = [0.5, 0.0, -0.2, 0.1, *np.zeros(SITES)]
    dense = solve_ivp(rate, (-1.0, T[-1] + 1), start, rtol=1e-10, atol=1e-11, dense_output=True).sol
    return lambda t: dense(t)[:SITES].T


def readings(u, seed=5):
    """Readings with noise."""
    return Samples(T, u + NOISE * np.random.default_rng(seed).normal(size=u.shape), source="pendula", ends="free")


def mixed(share, *places):
    """What sensors read that hear those so many columns further on."""
    u = exact()(T)
    return readings(u + share * u @ sum(np.eye(SITES, k=-place) for place in places))


def grounded(share):
    """What sensors read on a ground that is lifted by all of them."""
    u = exact()(T)
    return readings(u - share * np.mean(u, axis=1, keepdims=True))


def faded():
    """What is read where the gain of the second sensor falls by an eighth."""
    return readings(exact()(T) * (1 - np.outer(T / T[-1], [0.0, 0.125, 0.0, 0.0])))


def switched():
    """What is read where the gain of the third sensor rises by a twentieth between two readings."""
    return readings(exact()(T) * (1 + np.outer(T > 9.01, [0.0, 0.0, 0.05, 0.0])))


def out_of_centre():
    """What is read where the encoder of the first site turns about another centre than its axis: once in a radian."""
    u = exact()(T)
    error = 0.02 * np.sin(2 * np.pi * u) + 0.01 * (np.cos(2 * np.pi * u) - 1)
    return readings(u + error * np.array([1.0, 0.0, 0.0, 0.0]))


def slow_clock(*sites):
    """What is read where the clock of some sensors is slow by a thousandth."""
    late = exact()(T - 1e-3 * T)
    return readings(np.where(np.isin(np.arange(SITES), sites), late, exact()(T)))


@functools.cache
def turning():
    """A nonlinear chain of complex amplitudes that fade a little."""

    def rate(_, z):
        return 1j * (beside(z) - 2 * z) + 0.8j * np.abs(z) ** 2 * z - 0.02 * z

    start = np.array([1.0, 0.2 + 0.3j, 0.5, -0.2j])
    return solve_ivp(rate, (0, T[-1]), start, t_eval=T, rtol=1e-10, atol=1e-11).y.T


def received():
    """What a receiver makes of it whose imaginary part is larger by 6 % and 3 degrees from a right angle."""
    z, draw = turning(), np.random.default_rng(7)
    imaginary = 1.06 * (z.imag * np.cos(np.radians(3)) + z.real * np.sin(np.radians(3)))
    u = z.real + 1j * imaginary + 0.01 * (draw.normal(size=z.shape) + 1j * draw.normal(size=z.shape))
    return Samples(T, u, source="array", ends="free")


RECORDED = {
    "crosstalk of neighbours": (lambda: mixed(0.04, -1, 1), "sensor-crosstalk", 0.04),
    "crosstalk of the one before": (lambda: mixed(0.03, -1), "sensor-crosstalk", 0.03),
    "crosstalk of the one after": (lambda: mixed(0.03, 1), "sensor-crosstalk", 0.03),
    "a common ground": (lambda: grounded(0.3), "sensor-crosstalk", -0.3),
    "a gain that falls": (faded, "sensor-gain-drift", -0.125),
    "an encoder out of centre": (out_of_centre, "sensor-cyclic", 0.02),
    "a gain that is switched": (switched, "sensor-gain-jump", 0.05),
    "a slow clock": (lambda: slow_clock(2), "sensor-clock", 1e-3),
    "a slow clock of two": (lambda: slow_clock(2, 3), "sensor-clock", 1e-3),
}


def judge(found: Diagnosis, name: str, value: float) -> None:
    assert (found.verdict, {one.name for one in found.findings}) == ("explained", {"damping", name})
    (placed,) = (one.placed for one in found.findings if one.name == name)
    error = next(one for one in found.findings if one.name == name).values[placed.labels(found.after.chain)[0]][1]
    assert placed.strength[0] == pytest.approx(value, abs=4 * error)
    assert error < abs(value) / 5
    assert placed.sentences(found.after.chain)


@pytest.mark.parametrize(
    "what", ["crosstalk of neighbours", "an encoder out of centre", "a gain that is switched", "a slow clock"]
)
def test_what_a_sensor_does_to_its_readings_is_told_from_what_else_it_could_be(what):
    made, name, value = RECORDED[what]
    judge(diagnose(DECLARED, 2, [made()], SOME), name, value)


@pytest.mark.slow
@pytest.mark.parametrize("what", RECORDED)
def test_what_a_sensor_does_to_its_readings_is_named_among_all_there_is(what):
    made, name, value = RECORDED[what]
    judge(diagnose(DECLARED, 2, [made()], CATALOGUE), name, value)


@pytest.mark.slow
def test_unlike_quadratures_are_named_with_their_ratio_and_their_angle():
    found = diagnose(TURNING, 1, [received()], CATALOGUE)
    assert (found.verdict, {one.name for one in found.findings}) == ("explained", {"damping", "sensor-imbalance"})
    (one,) = (one for one in found.findings if one.name == "sensor-imbalance")
    ratio, angle = one.placed.natural(found.after.chain, np.nan).values()
    assert ratio == pytest.approx(1 / 1.06, abs=0.006)
    assert abs(angle) == pytest.approx(3.0, abs=0.5)
    again = corrected(found.after.model, received(), 0)
    # But for the unit, which is the mean of both, and the phase, which is between them.
    z = turning()
    unit = np.vdot(z, again.u) / np.vdot(z, z)
    assert np.max(np.abs(again.u - unit * z)) < 0.06


@pytest.mark.slow
def test_a_gain_that_drifts_beside_unknown_ends_is_named_with_what_it_is_at_first():
    t, sites = np.linspace(0, 30, 301), 6

    def rate(_t, y):
        u, v = np.split(y, 2)
        return np.concatenate([v, 0.5 * (beside(u) - 2 * u) - u])

    start = np.concatenate([np.cos(1.7 * np.arange(sites)), np.zeros(sites)])
    u = solve_ivp(rate, t[[0, -1]], start, t_eval=t, rtol=1e-10, atol=1e-11).y.T[:, 1:5]
    u = u * (1 + 0.2 * np.outer(np.linspace(-1, 1, len(t)), [0, 1, 0, 0]))
    samples = Samples(t, u + 0.005 * np.random.default_rng(0).normal(size=u.shape), source="chain", ends="unknown")
    names = ("damping", "sensor-offset", "sensor-gain", "sensor-gain-drift")
    declared = library("plain", "u[n+1]+u[n-1]-2*u[n]; u[n]")
    found = diagnose(declared, 2, [samples], [find(name) for name in names])
    values = {one.name: next(iter(one.values.values())) for one in found.findings}
    assert found.verdict == "explained"
    for name, true in (("sensor-gain", -0.2), ("sensor-gain-drift", 0.4)):
        assert values.pop(name)[0] == pytest.approx(true, abs=0.015)
    assert not values


def plain_fit(samples: Samples, placed) -> tuple[Problem, Fitted]:
    problem = Problem.of(DECLARED, 2, [samples], CATALOGUE)
    layout = replace(Layout.of(problem, 100, None, NOISE))
    near = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    return problem, fit(Model(DECLARED, 2, TRUTH, (placed,)), layout, near, structure=Structure(), steps=2)


def test_beside_crosstalk_forces_are_glanced_at_as_they_are_felt_by_all_sensors_that_hear_them():
    hears = WAYS["crosstalk"](effect=find("sensor-crosstalk"), heard=(-1, 1), both=False, strength=(0.2,))
    problem, plain = plain_fit(mixed(0.2, -1, 1), hears)
    tangent = Tangent(plain)
    looked = _looked(tangent)
    pull = _Pull(tangent, 0, looked[0])
    for name in ("local-damping", "onsite-cubic"):
        one = next(one for one in problem.candidates if one.effect.name == name)
        # The forward way, by what the force does to the readings, and the way back, from the readings to the force.
        forward = np.moveaxis(tangent._columns(0, [one]), -1, 0).reshape(one.count, -1)
        long = forward @ looked[0].reshape(forward.shape[1], -1)
        short = np.zeros_like(long)
        pull.add([one], np.array([0, one.count]), short)
        np.testing.assert_allclose(short, long, rtol=1e-7, atol=1e-7 * np.max(np.abs(long)))


def test_missing_readings_and_no_others_are_missing_when_readings_are_put_right():
    hears = WAYS["crosstalk"](effect=find("sensor-crosstalk"), heard=(-1,), both=False, strength=(0.1,))
    samples = mixed(0.1, -1)
    gone = (np.arange(len(T))[:, None] == 100) & (np.arange(SITES) == 1)
    for lost in (gone, np.arange(SITES) == 1):
        holed = replace(samples, u=np.where(lost, np.nan, samples.u))
        again = corrected(Model(DECLARED, 2, TRUTH, (hears,)), holed, 0)
        np.testing.assert_array_equal(np.isnan(again.u), np.isnan(holed.u))
        np.testing.assert_allclose(again.u[:, 0], samples.u[:, 0])
    # Where one reading is missing, what is heard of it is taken from those before and after.
    u = corrected(Model(DECLARED, 2, TRUTH, (hears,)), replace(samples, u=np.where(gone, np.nan, samples.u)), 0).u
    assert np.nanmax(np.abs(u - exact()(T))) < 6 * NOISE


def test_what_makes_readings_late_stays_where_together_it_turns_a_swing_too_far():
    samples = replace(readings(exact()(T)), v=np.gradient(exact()(T), T, axis=0))
    lag = WAYS["lag"](effect=find("sensor-lag"), sites=(1,), strength=(0.15,), omega=4.3)
    slow = WAYS["sensor clock"](
        effect=find("sensor-clock"), sites=(1,), begin=0.0, seen=(0.0, T[-1]), strength=(0.0075,), omega=4.3
    )
    for late, stays in (((lag,), []), ((slow,), []), ((lag, slow), [lag, slow])):
        assert staying(late, velocities=True) == stays
        assert staying(late, velocities=False) == list(late)
        again = corrected(Model(DECLARED, 2, TRUTH, late), samples, 0)
        assert np.max(np.abs(again.u - samples.u)) < 1
    later = replace(slow, seen=(0.0, 10 * T[-1]))
    assert staying([later], velocities=True) == [later]


def test_of_two_sensors_one_is_slow_or_the_other_one_fast_and_of_three_one_or_both_others():
    for sites, places in ((2, [(1,)]), (3, [(0,), (1,), (2,)]), (4, [(0,), (1,), (2,), (3,), (2, 3)])):
        u = np.cos(4 * T[:, None] + np.arange(sites))
        problem = Problem.of(DECLARED, 2, [Samples(T, u, ends="free")], [find("sensor-clock")])
        assert [one.sites for one in problem.candidates] == places
        # Velocities tell of the unit of time.
        problem = Problem.of(
            DECLARED, 2, [Samples(T, u, np.gradient(u, T, axis=0), ends="free")], [find("sensor-clock")]
        )
        assert (0,) in [one.sites for one in problem.candidates]
