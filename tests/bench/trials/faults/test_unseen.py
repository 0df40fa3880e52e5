"""Effects of a past, of something hidden and of other inertia, held against their own equations."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from latticebench import systems
from latticebench.bench.trials.specimen import Conditions, make

# What is made of a real and of a complex field in the same way; the second is a long test.
BOTH = ["phi4", pytest.param("dnls", marks=pytest.mark.slow)]

SMALL = {"sites": 7, "samples": 20, "span": 4.0}


def made(name, effect, z, seed=2, **options):
    conditions = Conditions(**{**SMALL, "variation": True, **options})
    return make(systems.find(name), effect, z, np.random.default_rng(seed), conditions)


@functools.cache
def drawn(name, effect, z=15, **options):
    return made(name, effect, z, **options)


def neighbours(u):
    """Sum of the neighbours at free ends, where u_0 = u_1."""
    return np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])


def truth_of(name):
    """The declared equation's true coefficients."""
    system = systems.find(name)
    return system.truth(system.library("equation"), {})


def missing(name, effect):
    """A dense recording, and what pushes its sites beside the declared equation's forces, at each of its times."""
    one = drawn(name, effect, z=40, noise=0.05, samples=150)
    t, u = one.clean.t, one.clean.u
    xi = truth_of(name)
    beside = np.array([neighbours(row) - 2 * row for row in u])
    if name == "dnls":
        return one, CubicSpline(t, u)(t, 1) - 1j * xi[0] * beside - 1j * xi[1] * np.abs(u) ** 2 * u
    return one, CubicSpline(t, one.clean.v)(t, 1) - xi[0] * beside - xi[1] * u - xi[2] * u**3


# Splines are least sure at the ends of a recording.
INSIDE = slice(10, -10)


@pytest.mark.parametrize("effect", ["memory", "other: retarded-coupling"])
def test_the_field_remembers_what_it_was_a_delay_ago(effect):
    one = drawn("phi4", effect, z=60, noise=0.05, samples=400)
    t, delay, amount = one.clean.t, one.about["delay"], np.real(one.amount)
    xi = truth_of("phi4")
    u = one.clean.u
    # The acceleration by differences of the velocity, against the force of the field as it was.
    inside = slice(1, -1)
    acceleration = (one.clean.v[2:] - one.clean.v[:-2]) / (t[2:] - t[:-2])[:, None]
    own = np.array([xi[0] * (neighbours(row) - 2 * row) + xi[1] * row + xi[2] * row**3 for row in u])[inside]
    past = np.stack([np.interp(t[inside] - delay, t, column) for column in u.T], axis=1)
    if effect != "memory":
        past = np.array([neighbours(row) for row in past]) - 2 * u[inside]
    left = acceleration - own
    slope = np.sum(left * past) / np.sum(past**2)
    assert slope == pytest.approx(amount, rel=0.02)
    assert np.std(left - amount * past) < 0.05 * np.std(left)


def test_a_resonator_that_is_not_seen_pulls_its_site():
    one = drawn("phi4", "other: side-resonator", z=40, noise=0.05)
    amount, own, site = np.real(one.amount), one.about["own"], int(one.about["site"])
    xi = truth_of("phi4")

    def rate(_, y):
        u, v, (w, speed) = y[:7], y[7:14], y[14:]
        force = xi[0] * (neighbours(u) - 2 * u) + xi[1] * u + xi[2] * u**3
        force[site] += amount * (w - u[site])
        return np.concatenate([v, force, [speed, own**2 * (u[site] - w)]])

    t, u, v = one.clean.t, one.clean.u, one.clean.v
    start = np.concatenate([u[0], v[0], [u[0, site], v[0, site]]])
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    np.testing.assert_allclose(u, y[:, :7], atol=1e-6)
    np.testing.assert_allclose(v, y[:, 7:14], atol=1e-6)


def test_a_mount_that_sways_pulls_all_sites_alike():
    one = drawn("phi4", "other: swaying-mount", z=40, noise=0.05)
    amount, own = np.real(one.amount), one.about["sway"]
    xi = truth_of("phi4")

    def rate(_, y):
        u, v, (w, speed) = y[:7], y[7:14], y[14:]
        mean = np.mean(u)
        force = xi[0] * (neighbours(u) - 2 * u) + xi[1] * u + xi[2] * u**3 + amount * (w - mean)
        return np.concatenate([v, force, [speed, own**2 * (mean - w)]])

    t, u, v = one.clean.t, one.clean.u, one.clean.v
    start = np.concatenate([u[0], v[0], [np.mean(u[0]), np.mean(v[0])]])
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    np.testing.assert_allclose(u, y[:, :7], atol=1e-6)
    np.testing.assert_allclose(v, y[:, 7:14], atol=1e-6)


def test_each_site_has_a_resonator_inside():
    one = drawn("phi4", "other: inner-resonators", z=40, noise=0.05)
    amount, own = np.real(one.amount), one.about["own"]
    xi = truth_of("phi4")

    def rate(_, y):
        u, v, w, speed = np.split(y, 4)
        force = xi[0] * (neighbours(u) - 2 * u) + xi[1] * u + xi[2] * u**3 + amount * (w - u)
        return np.concatenate([v, force, speed, own**2 * (u - w)])

    t, u, v = one.clean.t, one.clean.u, one.clean.v
    start = np.concatenate([u[0], v[0], u[0], v[0]])
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    np.testing.assert_allclose(u, y[:, :7], atol=1e-6)
    np.testing.assert_allclose(v, y[:, 7:14], atol=1e-6)


def test_each_site_of_a_complex_field_has_a_resonator_inside():
    one = drawn("dnls", "other: inner-resonators", z=40, noise=0.05)
    own = one.about["own"]
    coupling, cubic = truth_of("dnls")

    def rate(_, y):
        u, w = np.split(y, 2)
        change = 1j * coupling * (neighbours(u) - 2 * u) + 1j * cubic * abs(u) ** 2 * u + one.amount * (w - u)
        return np.concatenate([change, 1j * own * (u - w)])

    t, start = one.clean.t, np.tile(one.clean.u[0], 2).astype(complex)
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    np.testing.assert_allclose(one.clean.u, y[:, :7], atol=1e-6)


def test_a_complex_resonator_turns_at_its_own_frequency():
    one = drawn("dnls", "other: side-resonator", z=40, noise=0.05)
    own, site = one.about["own"], int(one.about["site"])
    coupling, cubic = truth_of("dnls")

    def rate(_, y):
        u, w = y[:7], y[7]
        change = 1j * coupling * (neighbours(u) - 2 * u) + 1j * cubic * abs(u) ** 2 * u
        change[site] += one.amount * (w - u[site])
        return np.append(change, 1j * own * (u[site] - w))

    t, start = one.clean.t, np.append(one.clean.u[0], one.clean.u[0, site]).astype(complex)
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    np.testing.assert_allclose(one.clean.u, y[:, :7], atol=1e-6)


def test_what_moves_warms_its_site_and_a_warm_site_is_pulled():
    one = drawn("phi4", "other: slow-heating", z=40, noise=0.05)
    amount, cooling = np.real(one.amount), one.about["cooling"]
    xi = truth_of("phi4")

    def rate(_, y):
        u, v, heat = np.split(y, 3)
        force = xi[0] * (neighbours(u) - 2 * u) + xi[1] * u + xi[2] * u**3 + amount * heat * u
        return np.concatenate([v, force, (v**2 - heat) / cooling])

    t, u, v = one.clean.t, one.clean.u, one.clean.v
    start = np.concatenate([u[0], v[0], np.zeros(7)])
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    np.testing.assert_allclose(u, y[:, :7], atol=1e-6)
    np.testing.assert_allclose(v, y[:, 7:14], atol=1e-6)


def test_light_warms_the_site_of_a_complex_field():
    one = drawn("dnls", "other: slow-heating", z=40, noise=0.05)
    cooling = one.about["cooling"]
    coupling, cubic = truth_of("dnls")

    def rate(_, y):
        u, heat = np.split(y, 2)
        change = 1j * coupling * (neighbours(u) - 2 * u) + 1j * cubic * abs(u) ** 2 * u + one.amount * heat * u
        return np.concatenate([change, (abs(u) ** 2 - heat) / cooling])

    t, start = one.clean.t, np.concatenate([one.clean.u[0], np.zeros(7)]).astype(complex)
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    np.testing.assert_allclose(one.clean.u, y[:, :7], atol=1e-6)


def test_a_slipping_spring_forgets_by_the_way_gone_and_not_by_time():
    one = drawn("phi4", "other: slipping-spring", z=40, noise=0.05, samples=400)
    t, u, v = one.clean.t, one.clean.u, one.clean.v
    amount, grip = np.real(one.amount), one.about["grip"]
    xi = truth_of("phi4")
    acceleration = (v[2:] - v[:-2]) / (t[2:] - t[:-2])[:, None]
    own = np.array([xi[0] * (neighbours(row) - 2 * row) + xi[1] * row + xi[2] * row**3 for row in u])
    bend = (own[1:-1] - acceleration) / amount
    assert np.max(np.abs(bend)) < grip
    # Steps of the field, each of them forgotten as exp(-way / grip) on the way that was gone since.
    steps = np.diff(u, axis=0)
    way = np.cumsum(np.abs(steps), axis=0)
    for row in (100, 250, 390):
        left = np.sum(steps[:row] * np.exp(-(way[row - 1] - way[:row]) / grip), axis=0)
        np.testing.assert_allclose(bend[row - 1], left, atol=0.02 * np.max(np.abs(bend)))


@pytest.mark.parametrize("name", BOTH)
def test_bonds_that_share_inertia_feel_how_neighbours_accelerate(name):
    one = drawn(name, "other: shared-inertia", z=40, noise=0.05, samples=400)
    t, u = one.clean.t, one.clean.u
    assert np.imag(one.amount) == 0
    moved = u if name == "dnls" else one.clean.v
    rate = CubicSpline(t, moved)(t, 1)
    xi = truth_of(name)
    if name == "dnls":
        force = np.array([1j * xi[0] * (neighbours(row) - 2 * row) + 1j * xi[1] * abs(row) ** 2 * row for row in u])
    else:
        force = np.array([xi[0] * (neighbours(row) - 2 * row) + xi[1] * row + xi[2] * row**3 for row in u])
    between = np.array([neighbours(row) - 2 * row for row in rate])
    inside = slice(20, -20)
    missing = (rate - force)[inside]
    left = missing - np.real(one.amount) * between[inside]
    assert np.max(np.abs(left)) < 0.01 * np.max(np.abs(missing))


@pytest.mark.parametrize("name", BOTH)
def test_a_viscoelastic_bond_forgets_how_it_was_stretched(name):
    one, force = missing(name, "other: viscoelastic-bonds")
    t, u = one.clean.t, one.clean.u
    speed = CubicSpline(t, u)(t, 1)
    # The hereditary integral: what was stretched at s is left by exp(-(t - s) / relaxing).
    for k in (25, 75, 125):
        weight = np.exp(-(t[k] - t[: k + 1]) / one.about["relaxing"])
        strain = np.trapezoid(weight[:, None] * speed[: k + 1], t[: k + 1], axis=0)
        pull = one.amount * (neighbours(strain) - 2 * strain)
        np.testing.assert_allclose(force[k], pull, atol=1e-3 * np.max(np.abs(force)))


@pytest.mark.parametrize("name", BOTH)
def test_a_bond_is_tired_by_all_that_it_has_borne(name):
    one, force = missing(name, "other: fatiguing-bonds")
    t, u = one.clean.t, one.clean.u
    borne = CubicSpline(t, np.abs(np.diff(u, axis=1)) ** 2).antiderivative()(t)
    pull = np.zeros_like(force)
    for bond in range(6):
        lost = one.amount * borne[:, bond] * (u[:, bond + 1] - u[:, bond])
        pull[:, bond] -= lost
        pull[:, bond + 1] += lost
    np.testing.assert_allclose(force[INSIDE], pull[INSIDE], atol=1e-3 * np.max(np.abs(pull)))


@pytest.mark.parametrize("name", BOTH)
def test_a_servo_pushes_back_by_how_far_and_how_long_the_mean_was_away(name):
    one, force = missing(name, "other: holding-loop")
    t = one.clean.t
    mean = np.mean(one.clean.u, axis=1)
    summed = CubicSpline(t, mean - mean[0]).antiderivative()(t)
    pull = np.repeat(-one.amount * summed[:, None], 7, axis=1)
    np.testing.assert_allclose(force[INSIDE], pull[INSIDE], atol=1e-2 * np.max(np.abs(pull)))


def test_a_chain_out_of_sight_pulls_and_is_pulled():
    one = drawn("phi4", "other: parallel-chain", z=40, noise=0.05)
    amount, aside = np.real(one.amount), int(one.about["aside"])
    assert 2 <= abs(aside) <= 4
    xi = truth_of("phi4")

    def own(u):
        return xi[0] * (neighbours(u) - 2 * u) + xi[1] * u + xi[2] * u**3

    def rate(_, y):
        u, v, w, speed = np.split(y, 4)
        return np.concatenate([v, own(u) + amount * (w - u), speed, own(w) + amount * (u - w)])

    def along(field):
        padded = np.pad(field, 4, "edge")
        return padded[4 + aside : 11 + aside]

    t, u, v = one.clean.t, one.clean.u, one.clean.v
    start = np.concatenate([u[0], v[0], along(u[0]), along(v[0])])
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    np.testing.assert_allclose(u, y[:, :7], atol=1e-6)
    np.testing.assert_allclose(v, y[:, 7:14], atol=1e-6)


def test_light_leaks_into_a_row_of_waveguides_out_of_sight():
    one = drawn("dnls", "other: parallel-chain", z=40, noise=0.05)
    coupling, cubic = truth_of("dnls")

    def own(u):
        return 1j * coupling * (neighbours(u) - 2 * u) + 1j * cubic * abs(u) ** 2 * u

    def rate(_, y):
        u, w = np.split(y, 2)
        return np.concatenate([own(u) + one.amount * (w - u), own(w) + one.amount * (u - w)])

    t, u = one.clean.t, one.clean.u
    beside = np.pad(u[0], 4, "edge")[4 + int(one.about["aside"]) :][:7]
    start = np.concatenate([u[0], beside]).astype(complex)
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    np.testing.assert_allclose(u, y[:, :7], atol=1e-6)


@pytest.mark.parametrize("name", ["phi4", "sine-gordon"])
def test_beads_on_bent_wires_keep_an_energy_of_their_own(name):
    one = drawn(name, "other: bent-wire", z=40, noise=0.05)
    u, v, bent = one.clean.u, one.clean.v, np.real(one.amount)
    xi = truth_of(name)
    site = -xi[1] * u**2 / 2 - xi[2] * u**4 / 4 if name == "phi4" else xi[1] * np.cos(u)
    stored = np.sum(site, axis=1) + xi[0] / 2 * np.sum(np.diff(u, axis=1) ** 2, axis=1)
    light = stored + np.sum(v**2, axis=1) / 2
    energy = light + bent * np.sum((u * v) ** 2, axis=1) / 2
    assert bent > 0
    assert np.ptp(energy) < 1e-6 * np.ptp(stored)
    assert np.ptp(light) > 1e-3 * np.ptp(stored)
