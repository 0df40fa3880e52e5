"""Forces that push the sites: a motion is that of an equation written by hand."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from latticebench import systems
from latticebench.bench.trials.faults import NONE
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


def rising(about, t):
    """A drive whose angle is the integral of a frequency that rises."""
    s = np.linspace(0, t, 3)
    return np.cos(about["phase"] + np.trapezoid(about["omega"] + about["sweep"] * s, s))


def ticking(about, t):
    """Bells at all times that are whole numbers of ticks away from the first."""
    middles = about["at"] + about["ticking"] * np.arange(-20, 21)
    return np.sum(np.exp(-0.5 * ((t - middles) / (about["width"] / 2)) ** 2))


def truth_of(name):
    """The declared equation's true coefficients."""
    system = systems.find(name)
    return system.truth(system.library("equation"), {})


@pytest.mark.parametrize(
    "effect",
    [
        "damping", "drive", "defect", "bond-defect", "next-neighbour", "unequal-masses", "gradient",
        "quadratic-coupling", "other: moving-spot",
        "other: plane-wave", "other: stray-wire", "other: pumped-coupling", "local-drive", "other: three-body",
        "nonlinear-damping", "other: end-stops", "other: sweeping-drive", "local-damping", "local-kick",
        "other: one-way-bond", "other: self-steepening", "other: absorbing-ends", "other: gyroscopic-bonds",
        "other: shared-load",
        "other: ticking-pump",
    ],
)  # fmt: skip
def test_a_motion_is_that_of_an_equation_written_by_hand(effect):
    one = drawn("phi4", effect, z=40, noise=0.05)
    amount, about = np.real(one.amount), one.about
    xi = truth_of("phi4")
    n = np.arange(7) - 3.0
    at = np.eye(7)[int(about["site"])]
    left, right = int(about["wire_from"]), int(about["wire_to"])
    assert right - left > 1
    loose = int(about["bond"])

    def own(u):
        return xi[0] * (neighbours(u) - 2 * u) + xi[1] * u + xi[2] * u**3

    def far(u):
        right, left = np.concatenate([u[2:], u[-1:-3:-1]]), np.concatenate([u[1::-1], u[:-2]])
        return right + left - 2 * u

    extras = {
        "damping": lambda _t, _u, v: -v,
        "drive": lambda t, u, _v: np.cos(about["omega"] * t + about["phase"]) + 0 * u,
        "defect": lambda _t, u, _v: at * u,
        "next-neighbour": lambda _t, u, _v: far(u),
        "unequal-masses": lambda _t, u, _v: at * own(u),
        "gradient": lambda _t, u, _v: n + 0 * u,
        "quadratic-coupling": lambda _t, u, _v: np.diff(u, append=u[-1]) ** 2 - np.diff(u, prepend=u[0]) ** 2,
        "other: moving-spot": lambda t, u, _v: (
            np.exp(-0.5 * ((n - about["spot"] - about["speed"] * (t - np.mean(one.clean.t))) / about["breadth"]) ** 2)
            * u
        ),
        "other: plane-wave": lambda t, _u, _v: np.cos(about["wave_number"] * n - about["omega"] * t + about["phase"]),
        "other: stray-wire": lambda _t, u, _v: (u[right] - u[left]) * (np.eye(7)[left] - np.eye(7)[right]),
        "other: pumped-coupling": lambda t, u, _v: wave(t) * (neighbours(u) - 2 * u),
        "local-drive": lambda t, _u, _v: wave(t) * at,
        "other: three-body": lambda _t, u, _v: np.append(u[1:], u[-1]) * u * np.append(u[0], u[:-1]),
        "nonlinear-damping": lambda _t, u, v: -(u**2) * v,
        "other: end-stops": lambda _t, u, _v: -(u - np.clip(u, begin - about["play"], begin + about["play"])),
        "other: sweeping-drive": lambda t, u, _v: rising(about, t) + 0 * u,
        "local-damping": lambda _t, _u, v: -at * v,
        "bond-defect": lambda _t, u, _v: (u[loose + 1] - u[loose]) * (np.eye(7)[loose] - np.eye(7)[loose + 1]),
        "local-kick": lambda t, _u, _v: at * np.exp(-0.5 * ((t - about["at"]) / about["width"]) ** 2),
        "other: one-way-bond": lambda _t, u, _v: at * np.diff(u, append=u[-1]),
        "other: self-steepening": lambda _t, u, _v: (np.append(u[1:], u[-1]) ** 3 - np.append(u[0], u[:-1]) ** 3) / 2,
        "other: absorbing-ends": lambda _t, _u, v: -np.exp(-np.array([0, 1, 2, 3, 2, 1, 0]) / about["breadth"]) * v,
        "other: gyroscopic-bonds": lambda _t, _u, v: (np.append(v[1:], v[-1]) - np.append(v[0], v[:-1])) / 2,
        "other: shared-load": lambda _t, _u, v: -np.full(7, np.sum(v) / 7),
        "other: ticking-pump": lambda t, _u, _v: np.full(7, ticking(about, t)),
    }
    begin = one.clean.u[0]

    def wave(t):
        return np.cos(about["omega"] * t + about["phase"])

    def rate(t, y):
        u, v = np.split(y, 2)
        return np.concatenate([v, own(u) + amount * extras[effect](t, u, v)])

    t, start = one.clean.t, np.concatenate([one.clean.u[0], one.clean.v[0]])
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    np.testing.assert_allclose(one.clean.u, y[:, :7], atol=1e-6)
    np.testing.assert_allclose(one.clean.v, y[:, 7:], atol=1e-6)


# Those that a real field has, too, are long tests.
OF_COMPLEX_FIELDS = [
    ("nonlinear-loss", -1), ("asymmetric-coupling", 1), ("other: phase-conjugation", 1),
    ("other: nonlocal-response", 1),
    *(
        pytest.param(effect, turn, marks=pytest.mark.slow)
        for effect, turn in [
            ("other: plane-wave", 1), ("other: stray-wire", 1), ("other: pumped-coupling", 1),
            ("other: three-body", 1), ("other: end-stops", -1), ("other: sweeping-drive", 1),
            ("local-kick", 1), ("other: one-way-bond", 1), ("other: self-steepening", 1),
            ("other: shared-load", -1), ("other: ticking-pump", 1),
        ]
    ),
]  # fmt: skip


@pytest.mark.parametrize(("effect", "turn"), OF_COMPLEX_FIELDS)
def test_a_complex_motion_is_that_of_an_equation_written_by_hand(effect, turn):
    one = drawn("dnls", effect, z=40, noise=0.05)
    coupling, cubic = truth_of("dnls")
    about = one.about
    at = np.eye(7)[int(about["site"])]
    left, right = int(about["wire_from"]), int(about["wire_to"])
    extras = {
        "nonlinear-loss": lambda _, u: abs(u) ** 2 * u,
        "asymmetric-coupling": lambda _, u: (np.append(u[1:], u[-1]) - np.append(u[0], u[:-1])) / 2,
        "other: phase-conjugation": lambda _, u: u.real - 1j * u.imag,
        "other: plane-wave": lambda t, _: np.exp(
            1j * (about["wave_number"] * (np.arange(7) - 3.0) - about["omega"] * t + about["phase"])
        ),
        "other: stray-wire": lambda _, u: (u[right] - u[left]) * (np.eye(7)[left] - np.eye(7)[right]),
        "other: nonlocal-response": lambda _, u: (
            u
            * np.array(
                [sum(abs(u[m]) ** 2 * np.exp(-abs(m - n) / about["fading"]) for m in range(7)) for n in range(7)]
            )
        ),
        "other: pumped-coupling": lambda t, u: np.cos(about["omega"] * t + about["phase"]) * (neighbours(u) - 2 * u),
        "other: three-body": lambda _, u: np.append(u[1:], u[-1]) * np.conj(u) * np.append(u[0], u[:-1]),
        "other: end-stops": lambda _, u: (
            np.exp(1j * np.angle(u - begin)) * np.maximum(abs(u - begin) - about["play"], 0)
        ),
        "other: sweeping-drive": lambda t, _: rising(about, t),
        "local-kick": lambda t, _: at * np.exp(-0.5 * ((t - about["at"]) / about["width"]) ** 2),
        "other: one-way-bond": lambda _, u: at * np.diff(u, append=u[-1]),
        "other: self-steepening": lambda _, u: np.convolve(
            np.pad(u * u * u.conj(), 1, "edge"), [0.5, 0, -0.5], "valid"
        ),
        "other: shared-load": lambda _, u: np.full(7, np.sum(u) / 7),
        "other: ticking-pump": lambda t, _: np.full(7, ticking(about, t)),
    }
    begin = one.clean.u[0]

    def rate(t, u):
        beside = neighbours(u)
        extra = extras[effect](t, u)
        return 1j * coupling * (beside - 2 * u) + 1j * cubic * abs(u) ** 2 * u + turn * one.amount * extra

    t = one.clean.t
    u = solve_ivp(
        rate, t[[0, -1]], one.clean.u[0].astype(complex), t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11
    ).y.T
    np.testing.assert_allclose(one.clean.u, u, atol=1e-6)


def test_an_unsteady_supply_changes_the_linear_term_of_all_sites_alike():
    one = drawn("phi4", "other: unsteady-supply", z=40, noise=0.05, samples=400)
    t, u, v = one.clean.t, one.clean.u, one.clean.v
    xi = truth_of("phi4")
    own = np.array([xi[0] * (neighbours(row) - 2 * row) + xi[1] * row + xi[2] * row**3 for row in u])
    inside = slice(20, -20)
    missing = (CubicSpline(t, v)(t, 1) - own)[inside]
    supply = np.sum(missing * u[inside], axis=1) / np.sum(u[inside] ** 2, axis=1)
    assert np.max(np.abs(missing - supply[:, None] * u[inside])) < 0.01 * np.max(np.abs(missing))
    # Five waves around nothing.
    assert np.max(np.abs(supply)) < 5 * abs(np.real(one.amount))
    assert np.min(supply) < 0 < np.max(supply)


@pytest.mark.parametrize("name", BOTH)
def test_an_uneven_floor_pushes_each_site_always_the_same_way(name):
    one = drawn(name, "other: uneven-floor", z=40, noise=0.05, samples=400)
    t, u = one.clean.t, one.clean.u
    xi = truth_of(name)
    if name == "dnls":
        own = np.array([1j * xi[0] * (neighbours(row) - 2 * row) + 1j * xi[1] * abs(row) ** 2 * row for row in u])
    else:
        own = np.array([xi[0] * (neighbours(row) - 2 * row) + xi[1] * row + xi[2] * row**3 for row in u])
    missing = (CubicSpline(t, u if name == "dnls" else one.clean.v)(t, 1) - own)[20:-20]
    force = np.mean(missing, axis=0) / one.amount
    assert np.max(np.abs(missing / one.amount - force)) < 0.01 * np.max(np.abs(force))
    assert np.max(np.abs(np.imag(force))) < 1e-3
    # As uneven as normal numbers are, to either side.
    assert 0.3 < np.std(np.real(force)) < 2
    assert np.min(np.real(force)) < 0 < np.max(np.real(force))


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


@pytest.mark.parametrize("name", BOTH)
def test_a_floor_that_rumbles_shakes_all_sites_alike_at_five_frequencies(name):
    one, force = missing(name, "other: rumbling-floor")
    shaken = np.mean(force, axis=1)[INSIDE] / one.amount
    assert np.max(np.abs(force[INSIDE] / one.amount - shaken[:, None])) < 0.01 * np.max(np.abs(shaken))
    assert np.max(np.abs(np.imag(shaken))) < 0.01 * np.max(np.abs(shaken))
    assert 1 < np.max(np.abs(shaken)) < 5
    # Five waves obey a recurrence over ten equal steps, the same forwards and backwards: five numbers, found here from
    # twice as many rows.
    rows = np.lib.stride_tricks.sliding_window_view(np.real(shaken), 71)[:, ::7]
    beside = np.column_stack([rows[:, 1:5] + rows[:, 9:5:-1], rows[:, 5]])
    ends = rows[:, 0] + rows[:, 10]
    found = np.linalg.lstsq(beside, ends, rcond=None)[0]
    assert np.max(np.abs(ends - beside @ found)) < 0.02 * np.max(np.abs(ends))


def test_a_defect_with_two_levels_is_in_one_of_them_at_any_time():
    one, force = missing("phi4", "other: two-level-defect")
    site, u = int(one.about["site"]), one.clean.u
    level = (force[:, site] / (np.real(one.amount) * u[:, site]))[INSIDE]
    elsewhere = np.delete(force, site, axis=1)[INSIDE]
    # A spline swings where the level jumps, six times.
    settled = np.abs(np.abs(level) - 1) < 0.02
    assert np.mean(settled) > 0.6
    signs = np.sign(level[settled])
    assert 1 <= np.sum(np.diff(signs) != 0) <= 6
    assert np.median(np.abs(elsewhere)) < 1e-3 * np.median(np.abs(force[INSIDE, site]))


def test_a_chain_may_be_damped_and_misread_at_once():
    """The readings of one site over those of a damped chain are one number, all others' are 1."""
    one, plain = (drawn("phi4", effect, z=40, noise=0.05) for effect in ("damping+sensor-gain", NONE))
    xi, amount = truth_of("phi4"), np.real(one.amount)

    def rate(_t, y):
        u, v = np.split(y, 2)
        return np.concatenate([v, xi[0] * (neighbours(u) - 2 * u) + xi[1] * u + xi[2] * u**3 - amount * v])

    start = np.concatenate([plain.clean.u[0], plain.clean.v[0]])
    y = solve_ivp(rate, one.clean.t[[0, -1]], start, t_eval=one.clean.t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    scale = np.sum(one.clean.u * y[:, :7], axis=0) / np.sum(y[:, :7] ** 2, axis=0)
    np.testing.assert_allclose(one.clean.u, scale * y[:, :7], atol=1e-6)
    np.testing.assert_allclose(one.clean.v, scale * y[:, 7:], atol=1e-6)
    site = int(one.about["site"])
    np.testing.assert_allclose(np.delete(scale, site), 1, atol=1e-6)
    assert abs(scale[site] - 1) > 0.01
