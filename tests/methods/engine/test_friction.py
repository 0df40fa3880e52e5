"""Dry friction over the steps of the integrator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.methods.engine.dynamics import Dynamics
from latticebench.methods.engine.friction import Course, Sliding
from latticebench.methods.engine.resonator import Support
from latticebench.methods.engine.sensitivity import Stretches
from latticebench.systems.terms import Term

OSCILLATOR = Dynamics((Term("u[n]"), Term("sign(v[n])")), 2, False, 1, "free")
# Two coupled sites, of which the second rubs more.
PAIR = Dynamics(
    tuple(map(Term, ("u[n]", "u[n+1]+u[n-1]-2*u[n]", "v[n]", "sign(v[n])", "sign(v[n])"))), 2, False, 2, "free",
    weights=np.array([[1.0, 1.0], [1.0, 1.0], [1.0, 1.0], [1.0, 1.0], [0.0, 1.0]]),
)  # fmt: skip
STRENGTHS = np.array([-20.0, 0.8, -0.05, -8.0, -9.0])
# Numbers of a state, and of its accuracy, that count alike.
SIZES = np.array([1.0, 1.0, 4.5, 4.5])


def sliding(u, time, stiffness=64.0, friction=0.15):
    """Position and velocity of an oscillator with dry friction, released at u, half swing by half swing."""
    omega = np.sqrt(stiffness)
    rest = friction / stiffness
    while time > np.pi / omega and abs(u) > rest:
        u = -(u - 2 * rest * np.sign(u))
        time -= np.pi / omega
    if abs(u) <= rest:
        return np.array([u, 0.0])
    middle = rest * np.sign(u)
    return np.array([middle + (u - middle) * np.cos(omega * time), -(u - middle) * omega * np.sin(omega * time)])


def followed(start, time, step, integrator="dop853"):
    y = np.array([start])
    for begin in np.arange(round(time / step)) * step:
        stretch = Stretches(OSCILLATOR, np.array([begin]), np.array([begin + step]), integrator=integrator)
        y = stretch.run(np.array([-64.0, -0.15]), y, np.array([1]))
    return y[0]


@pytest.mark.parametrize("integrator", ["dop853", "rk45"])
def test_an_oscillator_with_dry_friction_turns_round_where_the_exact_motion_does(integrator):
    for time in (0.32, 0.96, 1.92):
        left = followed([0.06, 0.0], time, 0.032, integrator) - sliding(0.06, time)
        np.testing.assert_allclose(left / [1, 8], 0, atol=2e-5)


def test_steps_half_as_long_bring_it_at_least_eight_times_nearer():
    coarse, fine = (
        np.linalg.norm((followed([0.06, 0.0], 1.92, step) - sliding(0.06, 1.92)) / [1, 8]) for step in (0.032, 0.016)
    )
    assert fine < coarse / 8


def test_it_comes_to_rest_where_the_exact_motion_does_and_does_not_creep():
    where, speed = followed([0.01, 0.0], 3.0, 0.03)
    assert sliding(0.01, 3.0)[1] == 0
    assert where == pytest.approx(sliding(0.01, 3.0)[0], rel=1e-2)
    assert abs(speed) < 1e-12
    assert followed([0.01, 0.0], 6.0, 0.03)[0] == pytest.approx(where, rel=1e-9)


def starts(count=60):
    draw = np.random.default_rng(1)
    y = np.hstack([150 * draw.normal(size=(count, 2)), 700 * draw.normal(size=(count, 2))])
    # A third of the sites is about to turn, or has turned just now.
    y[: count // 3, 2:] *= 0.05
    return y


def test_two_sites_turn_at_times_of_their_own_as_in_an_integration_that_stops_there():
    y = starts(12)
    step = 0.05
    stretch = Stretches(PAIR, np.zeros(len(y)), np.full(len(y), step))
    found = stretch.run(STRENGTHS, y, np.ones(len(y), dtype=int))

    def pushed(sign):
        k, coupling, drag, friction, more = STRENGTHS

        def rate(_, state):
            u, v = state[:2], state[2:]
            force = k * u + coupling * (u[::-1] - u) + drag * v + (friction + more * np.array([0, 1])) * sign
            return np.concatenate([v, force])

        return rate

    for start, end in zip(y, found, strict=True):
        state, time, sign = start, 0.0, np.sign(start[2:])
        while time < step:
            turns = [lambda _, now, site=site, sign=sign: now[2 + site] * sign[site] for site in range(2)]
            for one in turns:
                one.terminal, one.direction = True, -1
            part = solve_ivp(pushed(sign), (time, step), state, events=turns, rtol=1e-11, atol=1e-11)
            state, time = part.y[:, -1], part.t[-1]
            turned = [site for site in range(2) if len(part.t_events[site])]
            sign[turned] *= -1
            state[[2 + site for site in turned]] = 1e-12 * sign[turned]
        np.testing.assert_allclose((end - state) / SIZES, 0, atol=0.01)


@pytest.mark.parametrize("rest", [0.0, 70.0])
def test_derivatives_are_those_of_the_steps_themselves(rest):
    y = starts()
    # Where a finite difference would move a site across a turn at the beginning or the end, it is none.
    y = y[np.all(np.abs(y[:, 2:]) > 5, axis=1)]
    stretch = Stretches(replace(PAIR, rest=rest), np.zeros(len(y)), np.full(len(y), 0.05))
    steps = np.full(len(y), 2)
    varied = stretch.vary(STRENGTHS, y, steps, dense=True)
    size = 1e-5 * np.array([150, 150, 700, 700])
    for number, change in enumerate(np.diag(size)):
        ends = [stretch.run(STRENGTHS, y + sign * change, steps) for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / (2 * size[number])
        left = np.abs(numeric - np.asarray(varied.by_state)[:, number]) / SIZES * SIZES[number]
        assert np.quantile(left, 0.98) < 1e-5
    for number, change in enumerate(np.diag(1e-5 * np.abs(STRENGTHS))):
        ends = [stretch.run(STRENGTHS + sign * change, y, steps) for sign in (1, -1)]
        numeric = (ends[0] - ends[1]) / 2e-5
        left = np.abs(numeric - varied.by_coefficient[:, number] * np.abs(STRENGTHS[number])) / SIZES
        assert np.quantile(left, 0.98) < 1e-5 * np.max(np.abs(numeric))


def test_derivatives_of_the_line_are_right_where_a_site_comes_to_rest():
    draw = np.random.default_rng(5)
    v, early, middle = draw.normal(size=(3, 4000, 1)) * np.array([0.3, 1, 1])[:, None, None]
    early = -np.sign(v) * np.abs(early)
    middle = early + 0.3 * middle
    pull = -1.2 * np.abs(draw.normal(size=v.shape)) - 0.01
    numbers = np.stack([v, early, middle, pull])
    line = Sliding.abrupt(Course(v, early, middle), pull)
    found = []
    for number in range(4):
        change = np.zeros((4, 1, 1))
        change[number] = 1e-7
        ends = [Sliding.abrupt(Course(*moved[:3]), moved[3]) for moved in (numbers + change, numbers - change)]
        for row, name in enumerate(("mean", "trend")):
            numeric = (getattr(ends[0], name) - getattr(ends[1], name)) / 2e-7
            found.append(np.abs(numeric - line.by[row, number]) / (1 + np.abs(numeric)))
    # The pull matters where a site stays. A few are on the edge between that and sliding.
    assert np.mean(line.by[0, 3] != 0) > 0.2
    assert np.quantile(found, 0.999) < 1e-5


@pytest.mark.parametrize("speed", [0.0, 1e-6, -1e-4])
def test_a_site_that_comes_to_rest_forgets_how_fast_it_came_and_keeps_where_it_is(speed):
    stretch = Stretches(OSCILLATOR, np.array([0.0]), np.array([0.005]))
    by_state = stretch.vary(np.array([-64.0, -0.15]), np.array([[0.001, speed]]), np.array([1])).by_state[0]
    np.testing.assert_allclose(by_state, [[1, 0], [0, 0]], atol=2e-3)


@pytest.mark.parametrize("drag", [-0.5, -10.0])
def test_a_site_at_rest_does_not_creep_where_other_forces_depend_on_its_speed(drag):
    dynamics = Dynamics(tuple(map(Term, ("u[n]", "v[n]", "sign(v[n])"))), 2, False, 1, "free")
    y = np.array([[0.0015, 0.0]])
    for _ in range(100):
        y = Stretches(dynamics, np.array([0.0]), np.array([0.04])).run(np.array([-64.0, drag, -0.15]), y, np.array([1]))
    np.testing.assert_allclose(y, [[0.0015, 0.0]], atol=1e-9)


def test_a_site_on_a_support_that_gives_way_does_not_creep():
    dynamics = replace(OSCILLATOR, resonators=(Support((0,), mass=0.5, omega=30.0, gamma=1.0),))
    y = np.array([[0.001, 0.0, 0.0, 0.0]])
    for _ in range(100):
        y = Stretches(dynamics, np.array([0.0]), np.array([0.02])).run(np.array([-64.0, -0.15]), y, np.array([1]))
    np.testing.assert_allclose(y[0, :2], [0.001, 0.0], atol=1e-5)


def test_a_site_that_slides_off_from_rest_has_derivatives_of_the_size_of_a_step():
    dynamics = Dynamics((Term("f[n]"), Term("sign(v[n])")), 2, False, 1, "free")
    stretch = Stretches(dynamics, np.array([0.0]), np.array([0.05]), lambda t: 30 * t[:, None])
    by_state = stretch.vary(np.array([1.0, -0.3]), np.array([[0.0, 0.0]]), np.array([1])).by_state[0]
    assert np.max(np.abs(by_state)) < 3


@pytest.mark.parametrize("rest", [0.0, 0.1])
def test_derivatives_are_right_where_friction_changes_in_time(rest):
    factors = (None, lambda t: (1.2 + np.sin(8 * t))[None, :, None])
    dynamics = replace(OSCILLATOR, factors=factors, rest=rest)
    draw = np.random.default_rng(2)
    y = draw.normal(size=(40, 2)) * [0.1, 0.3]
    begin = draw.uniform(0, 2, len(y))
    stretch, one = Stretches(dynamics, begin, begin + 0.05), np.ones(len(y), dtype=int)
    strengths = np.array([-64.0, -0.3])
    varied = stretch.vary(strengths, y, one)
    for number in range(2):
        change = 1e-6 * np.eye(2)[number]
        numeric = (stretch.run(strengths, y + change, one) - stretch.run(strengths, y - change, one)) / 2e-6
        assert np.median(np.max(np.abs(numeric - varied.by_state[:, number]), axis=1)) < 1e-6
        # What friction does on each side of the turn is taken from the middle of the step.
        assert np.max(np.abs(numeric - varied.by_state[:, number])) < 0.1


def test_a_site_that_is_pushed_harder_than_it_rubs_does_not_stay_at_rest():
    end = Stretches(OSCILLATOR, np.array([0.0]), np.array([0.02])).run(
        np.array([-64.0, -0.15]), np.array([[0.01, 0.0]]), np.array([1])
    )[0]
    pushed = -64.0 * 0.01 + 0.15
    np.testing.assert_allclose(end, [0.01 + pushed * 0.02**2 / 2, pushed * 0.02], rtol=0.02)


def test_friction_that_pushes_on_leaves_no_site_at_rest():
    end = Stretches(OSCILLATOR, np.array([0.0]), np.array([0.02])).run(
        np.array([-64.0, 0.15]), np.array([[0.001, 0.0]]), np.array([1])
    )[0]
    assert end[1] < -0.15 * 0.02


def test_the_line_has_the_mean_and_the_first_moment_of_the_sign_of_the_speed():
    v, early, middle = (np.array([[one]]) for one in (1.0, -4.0, -3.0))
    course = Course(v, early, middle)
    x = (np.arange(100_000) + 0.5) / 100_000
    for line, value in (
        (Sliding.abrupt(course, np.array([[-0.5]])), np.sign(course.speed(x)[0])),
        (Sliding.soft(course, 0.2), np.tanh(course.speed(x)[0] / 0.2)),
    ):
        assert line.mean[0, 0] == pytest.approx(np.mean(value), abs=1e-3)
        drawn = line.mean[0, 0] + line.trend[0, 0] * (x - 0.5)
        assert np.mean(drawn * x) == pytest.approx(np.mean(value * x), abs=1e-3)
