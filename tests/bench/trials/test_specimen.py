"""Specimens: of the size that was asked for, the same from the same draws, and made by nothing that the loop uses."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from latticebench import systems
from latticebench.bench.trials.faults import (
    BLIND,
    FAULTS,
    FIFTH_BLIND,
    FOURTH_BLIND,
    NONE,
    OTHERS,
    SECOND_BLIND,
    THIRD_BLIND,
    sensible,
)
from latticebench.bench.trials.specimen import make
from latticebench.diagnosis.model import Model, first_fit
from latticebench.methods.engine.dynamics import Dynamics
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library

SMALL = {"sites": 7, "samples": 20, "span": 4.0}
NAMES = ["phi4", "sine-gordon", "dnls", "ginzburg-landau"]
EVERY = [
    (name, effect)
    for name in ("phi4", "dnls")
    for effect in FAULTS
    if effect != NONE and sensible(effect, systems.find(name))
]


SOME = [
    ("phi4", "drive"), ("phi4", "long-range"), ("phi4", "ends"), ("phi4", "known-input"), ("phi4", "clock"),
    ("phi4", "sensor-curve"), ("phi4", "other: noise-force"), ("dnls", "disorder"), ("dnls", "unequal-masses"),
    ("dnls", "memory"), ("dnls", "quantisation"), ("dnls", "sensor-offset"), ("phi4", "other: moving-spot"),
    ("phi4", "other: slow-sensor"), ("dnls", "other: side-resonator"), ("dnls", "other: retarded-coupling"),
    ("phi4", "other: slipping-spring"), ("dnls", "other: slow-heating"), ("dnls", "other: scanned-channels"),
    ("phi4", "other: mains-hum"), ("dnls", "other: inner-resonators"), ("phi4", "other: stray-spikes"),
    ("phi4", "other: two-level-defect"), ("dnls", "other: parallel-chain"), ("phi4", "other: wandering-reference"),
    ("dnls", "other: resampled-rows"),
]  # fmt: skip


def made(name, effect, z, seed=2, **options):
    return make(systems.find(name), effect, z, np.random.default_rng(seed), **{**SMALL, "variation": True, **options})


@functools.cache
def drawn(name, effect, z=15, **options):
    return made(name, effect, z, **options)


@pytest.mark.parametrize(("name", "effect"), EVERY)
def test_an_effect_is_as_visible_as_was_asked_for(name, effect):
    one = drawn(name, effect)
    if not FAULTS[effect].sized:
        assert one.z > 0
    else:
        assert one.z == pytest.approx(15, rel=0.1)
        assert one.amount != 0
    assert one.effect == effect


def test_other_ends_and_rounding_are_as_large_as_they_are():
    assert drawn("phi4", "ends").amount == 1
    step = drawn("phi4", "quantisation").amount
    shown = drawn("phi4", "quantisation").samples.u / step
    np.testing.assert_allclose(shown, np.round(shown), atol=1e-9)
    # What is rounded is u, and v not.
    other = drawn("phi4", "quantisation").samples.v / step
    assert np.max(np.abs(other - np.round(other))) > 0.1


@pytest.mark.parametrize(
    ("name", "effect", "terms"),
    [
        ("phi4", "damping", ["u[n+1]+u[n-1]-2*u[n]", "u[n]", "u[n]**3", "-v[n]"]),
        ("phi4", "gradient", ["u[n+1]+u[n-1]-2*u[n]", "u[n]", "u[n]**3", "n"]),
        ("sine-gordon", "trap", ["u[n+1]+u[n-1]-2*u[n]", "sin(u[n])", "n**2*u[n]"]),
    ],
)
def test_its_size_is_the_coefficient_over_the_standard_error_of_a_fit(name, effect, terms):
    one = drawn(name, effect, z=12, noise=0.002)
    found = first_fit(Model(library("true", terms), 2), [replace(one.samples.observed(), ends="free")])
    error = np.sqrt(np.diag(found.solution.covariance))[-1]
    assert np.real(one.amount) / error == pytest.approx(12, rel=0.25)


@pytest.mark.parametrize(("name", "effect"), SOME)
def test_the_same_generator_gives_the_same_specimen(name, effect):
    one, other, third = drawn(name, effect), made(name, effect, 15), made(name, effect, 15, seed=3)
    assert np.array_equal(one.samples.u, other.samples.u)
    assert one.samples.v is None or np.array_equal(one.samples.v, other.samples.v)
    assert one.about == other.about
    assert one.amount == other.amount
    assert not np.array_equal(one.samples.u, third.samples.u)


def test_nothing_in_it_is_the_systems_own_motion_with_noise():
    system = systems.find("phi4")
    one = drawn("phi4", NONE, noise=0.02)
    rms = np.sqrt(np.mean((one.clean.u - np.mean(one.clean.u)) ** 2))
    left = (one.samples.u - one.clean.u) / (0.02 * rms)
    assert np.std(left) == pytest.approx(1, abs=0.2)
    assert one.amount == one.z == 0
    assert one.samples.sigma == pytest.approx(0.02 * rms)
    assert one.samples.u.shape == one.samples.v.shape == (20, 7)
    assert drawn("phi4", NONE, velocities=False).samples.v is None
    assert system.is_complex is False


# Not by the loop's own dynamics -----------------------------------------------------------------------------------------------


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
        "damping", "drive", "defect", "next-neighbour", "unequal-masses", "gradient", "other: lopsided-bonds", "other: moving-spot",
        "other: plane-wave", "other: stray-wire", "other: pumped-coupling", "other: shaken-end", "other: three-body",
        "other: bent-damper", "other: end-stops", "other: sweeping-drive", "other: braked-site", "other: tapped-site",
        "other: one-way-bond", "other: self-steepening", "other: absorbing-ends", "other: gyroscopic-bonds", "other: shared-load",
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
        "other: lopsided-bonds": lambda _t, u, _v: np.diff(u, append=u[-1]) ** 2 - np.diff(u, prepend=u[0]) ** 2,
        "other: moving-spot": lambda t, u, _v: (
            np.exp(-0.5 * ((n - about["spot"] - about["speed"] * (t - np.mean(one.clean.t))) / about["breadth"]) ** 2)
            * u
        ),
        "other: plane-wave": lambda t, _u, _v: np.cos(about["wave_number"] * n - about["omega"] * t + about["phase"]),
        "other: stray-wire": lambda _t, u, _v: (u[right] - u[left]) * (np.eye(7)[left] - np.eye(7)[right]),
        "other: pumped-coupling": lambda t, u, _v: wave(t) * (neighbours(u) - 2 * u),
        "other: shaken-end": lambda t, _u, _v: wave(t) * (n == -3),
        "other: three-body": lambda _t, u, _v: np.append(u[1:], u[-1]) * u * np.append(u[0], u[:-1]),
        "other: bent-damper": lambda _t, u, v: -(u**2) * v,
        "other: end-stops": lambda _t, u, _v: -(u - np.clip(u, begin - about["play"], begin + about["play"])),
        "other: sweeping-drive": lambda t, u, _v: rising(about, t) + 0 * u,
        "other: braked-site": lambda _t, _u, v: -at * v,
        "other: tapped-site": lambda t, _u, _v: at * np.exp(-0.5 * ((t - about["at"]) / about["width"]) ** 2),
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


@pytest.mark.parametrize(
    ("effect", "turn"),
    [
        ("nonlinear-loss", -1), ("asymmetric-coupling", 1), ("other: phase-conjugation", 1), ("other: plane-wave", 1),
        ("other: stray-wire", 1), ("other: nonlocal-response", 1), ("other: pumped-coupling", 1), ("other: three-body", 1),
        ("other: end-stops", -1), ("other: sweeping-drive", 1), ("other: tapped-site", 1), ("other: one-way-bond", 1),
        ("other: self-steepening", 1), ("other: shared-load", -1), ("other: ticking-pump", 1),
    ],
)  # fmt: skip
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
        "other: tapped-site": lambda t, _: at * np.exp(-0.5 * ((t - about["at"]) / about["width"]) ** 2),
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


@pytest.mark.parametrize("name", ["phi4", "dnls"])
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


@pytest.mark.parametrize("name", ["phi4", "dnls"])
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


def missing(name, effect):
    """A dense recording, and what its sites are pushed by beside the declared equation's forces, at each of its times."""
    one = drawn(name, effect, z=40, noise=0.05, samples=150)
    t, u = one.clean.t, one.clean.u
    xi = truth_of(name)
    beside = np.array([neighbours(row) - 2 * row for row in u])
    if name == "dnls":
        return one, CubicSpline(t, u)(t, 1) - 1j * xi[0] * beside - 1j * xi[1] * np.abs(u) ** 2 * u
    return one, CubicSpline(t, one.clean.v)(t, 1) - xi[0] * beside - xi[1] * u - xi[2] * u**3


# Splines are least sure at the ends of a recording.
INSIDE = slice(10, -10)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_floor_that_rumbles_shakes_all_sites_alike_at_five_frequencies(name):
    one, force = missing(name, "other: rumbling-floor")
    shaken = np.mean(force, axis=1)[INSIDE] / one.amount
    assert np.max(np.abs(force[INSIDE] / one.amount - shaken[:, None])) < 0.01 * np.max(np.abs(shaken))
    assert np.max(np.abs(np.imag(shaken))) < 0.01 * np.max(np.abs(shaken))
    assert 1 < np.max(np.abs(shaken)) < 5
    # Five waves obey a recurrence over ten equal steps, the same forwards and backwards: five numbers, found here from twice as many rows.
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


@pytest.mark.parametrize("name", ["phi4", "dnls"])
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


@pytest.mark.parametrize("name", ["phi4", "dnls"])
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


@pytest.mark.parametrize("name", ["phi4", "dnls"])
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


# Instruments that lie ------------------------------------------------------------------------------------------------------------


LIE_ABOUT_BOTH = (
    "other: neighbour-crosstalk",
    "other: flickering-lamp",
    "other: averaging-readout",
    "other: floating-ground",
    "other: tilted-camera",
    "other: converter-residue",
    "other: two-cards",
    "other: resampled-rows",
)


def lied(name, effect, **options):
    """What is read, what there was, and what is said of it; velocities are read as they are but for what lies about them, too."""
    one, plain = drawn(name, effect, z=40, **options), drawn(name, NONE, **options)
    if plain.clean.v is not None and effect not in LIE_ABOUT_BOTH:
        assert np.array_equal(one.clean.v, plain.clean.v)
    assert np.imag(one.amount) == 0
    return one.clean.u, plain.clean.u, one


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_drifting_sensor_warms_up(name):
    shown, true, one = lied(name, "other: drifting-sensor")
    site, t = int(one.about["site"]), one.clean.t
    drift = shown - true
    assert np.max(np.abs(np.delete(drift, site, axis=1))) == 0
    # What is still missing of the whole falls by the same factor in the same time.
    missing = 1 - drift[:, site].real / np.real(one.amount)
    np.testing.assert_allclose(np.log(missing), -(t - t[0]) / one.about["warming"], atol=1e-6)
    assert np.max(np.abs(drift.imag)) == 0


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_crosstalk_is_of_sensors_side_by_side(name):
    shown, true, one = lied(name, "other: neighbour-crosstalk")
    amount = np.real(one.amount)
    pairs = [(shown, true)] if name == "dnls" else [(shown, true), (one.clean.v, drawn(name, NONE).clean.v)]
    for mixed, own in pairs:
        np.testing.assert_allclose(mixed[:, 3] - own[:, 3], amount * (own[:, 2] + own[:, 4]), atol=1e-12)
        np.testing.assert_allclose(mixed[:, 0] - own[:, 0], amount * own[:, 1], atol=1e-12)
        np.testing.assert_allclose(mixed[:, 6] - own[:, 6], amount * own[:, 5], atol=1e-12)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_slow_sensor_follows_the_field_as_an_rc_filter(name):
    shown, true, one = lied(name, "other: slow-sensor", samples=100)
    site, lag, t = int(one.about["site"]), np.real(one.amount), one.clean.t
    assert np.max(np.abs(np.delete(shown - true, site, axis=1))) < 1e-7
    # The convolution with exp(-t / lag) / lag, of the field between the samples as a spline has it.
    field = CubicSpline(t, true[:, site])
    for k in (25, 60, 99):
        back = np.linspace(0, t[k] - t[0], 20001)
        weight = np.exp(-back / lag) / lag
        filtered = np.trapezoid(weight * field(t[k] - back), back) + true[0, site] * np.exp(-back[-1] / lag)
        assert abs(shown[k, site] - filtered) < 0.01 * np.max(np.abs(shown - true))


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_clipped_reading_stays_within_its_range(name):
    shown, true, _ = lied(name, "other: clipped-reading")
    parts = [(shown.real, true.real)] if name == "phi4" else [(shown.real, true.real), (shown.imag, true.imag)]
    limit = max(np.max(np.abs(part)) for part, _ in parts)
    assert limit < 0.99 * max(np.max(np.abs(part)) for _, part in parts)
    for part, own in parts:
        inside = np.abs(own) <= limit
        assert np.array_equal(part[inside], own[inside])
        np.testing.assert_allclose(part[~inside], np.sign(own[~inside]) * limit, rtol=1e-12)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_channels_are_read_one_after_the_other(name):
    one, plain = drawn(name, "other: scanned-channels", z=40), drawn(name, NONE, samples=400)
    sweep, t = np.real(one.amount), one.clean.t
    assert sweep > 0
    pairs = [(one.clean.u, plain.clean.u)] if name == "dnls" else [
        (one.clean.u, plain.clean.u), (one.clean.v, plain.clean.v)
    ]  # fmt: skip
    for shown, true in pairs:
        whole = CubicSpline(plain.clean.t, true)
        for site in range(7):
            late = t + sweep * site / 6
            seen = late <= plain.clean.t[-1]
            np.testing.assert_allclose(shown[seen, site], whole(late[seen])[:, site], atol=1e-5)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_the_mains_hum_in_step_in_all_wires(name):
    shown, true, one = lied(name, "other: mains-hum", samples=100)
    hum, t = shown - true, one.clean.t
    assert np.max(np.abs(hum.imag)) == 0
    wave = np.cos(one.about["hum"] * t + one.about["hum_phase"])
    strengths = np.real(hum[0]) / wave[0] / np.real(one.amount)
    assert np.all((strengths > 0.5) & (strengths < 1.5))
    assert np.ptp(strengths) > 0.1
    np.testing.assert_allclose(hum.real, np.real(one.amount) * np.outer(wave, strengths), atol=1e-12)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_slack_needle_stays_until_it_is_dragged(name):
    shown, true, one = lied(name, "other: slack-needle", samples=400)
    slack = np.real(one.amount)
    pairs = [(shown, true)] if name == "phi4" else [(shown.real, true.real), (shown.imag, true.imag)]
    for needle, field in pairs:
        assert np.array_equal(needle[0], field[0])
        assert np.max(np.abs(needle - field)) == pytest.approx(slack, rel=1e-4)
        steps = np.diff(needle, axis=0)
        moves = np.where(np.abs(steps) > 1e-6, np.sign(steps), 0)
        assert 0.02 < np.mean(moves == 0) < 0.98
        # In the midst of being dragged it is the full slack away, from behind.
        dragged = (moves[1:] == moves[:-1]) & (moves[1:] != 0)
        np.testing.assert_allclose((field - needle)[1:-1][dragged], slack * moves[1:][dragged], atol=1e-6)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_flickering_lamp_lights_all_sites_alike(name):
    shown, true, one = lied(name, "other: flickering-lamp")
    bright = np.sum(shown * np.conj(true), axis=1) / np.sum(np.abs(true) ** 2, axis=1)
    np.testing.assert_allclose(shown, bright[:, None] * true, atol=1e-12)
    assert np.max(np.abs(np.imag(bright))) < 1e-12
    assert np.std(np.real(bright)) == pytest.approx(np.real(one.amount), rel=0.5)
    if name == "phi4":
        np.testing.assert_allclose(one.clean.v, np.real(bright)[:, None] * drawn(name, NONE).clean.v, atol=1e-12)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_an_averaging_readout_gives_means_over_the_time_after_each_sample(name):
    shown, _, one = lied(name, "other: averaging-readout")
    plain = drawn(name, NONE, samples=800)
    field, over = CubicSpline(plain.clean.t, plain.clean.u), np.sqrt(np.real(one.amount))
    for k in (0, 7, 14):
        t = one.clean.t[k]
        assert t + over < plain.clean.t[-1]
        mean = np.asarray(field.integrate(t, t + over)) / over
        np.testing.assert_allclose(shown[k], mean, atol=1e-5)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_floating_ground_is_lifted_by_the_mean_of_all_sites(name):
    shown, true, one = lied(name, "other: floating-ground")
    lifted = np.repeat(np.sum(true, axis=1)[:, None] / 7, 7, axis=1)
    np.testing.assert_allclose(true - shown, np.real(one.amount) * lifted, atol=1e-12)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_tilted_camera_shows_one_end_too_large_and_the_other_too_small(name):
    shown, true, one = lied(name, "other: tilted-camera")
    scale = 1 + np.real(one.amount) * np.linspace(-1, 1, 7)
    np.testing.assert_allclose(shown, scale * true, atol=1e-12)
    if name == "phi4":
        np.testing.assert_allclose(one.clean.v, scale * drawn(name, NONE).clean.v, atol=1e-12)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_stray_spikes_are_few_and_leave_the_other_readings_alone(name):
    shown, true, one = lied(name, "other: stray-spikes", samples=100)
    size, off = np.real(one.amount), (shown - true)[shown != true]
    assert len(off) == 7
    assert np.max(np.abs(off.imag)) == 0
    assert np.all((np.abs(off) > 0.499 * size) & (np.abs(off) < 1.501 * size))
    # In the shortest record, too.
    few, sound, _ = lied(name, "other: stray-spikes")
    assert np.sum(few != sound) == 3


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_behind_a_capacitor_what_is_constant_fades(name):
    shown, true, one = lied(name, "other: ac-coupling", samples=200)
    leak, t = np.real(one.amount), one.clean.t
    assert leak > 0
    np.testing.assert_allclose(shown[0], true[0], atol=1e-12)
    # What is not shown is on the capacitor, which the shown voltage charges.
    charged = CubicSpline(t, shown).antiderivative()(t)
    np.testing.assert_allclose(true - shown, leak * charged, atol=1e-3 * np.max(np.abs(true - shown)))


def pairs_of(name, one, **options):
    """What is read and what there was, of u, and of v where there is one."""
    plain = drawn(name, NONE, **options)
    return [(one.clean.u, plain.clean.u), *([] if name == "dnls" else [(one.clean.v, plain.clean.v)])]


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_converter_keeps_a_share_of_what_it_read_before(name):
    _, _, one = lied(name, "other: converter-residue")
    share = np.real(one.amount)
    assert 0 < share < 1
    for shown, true in pairs_of(name, one):
        one_after_another = true.reshape(-1)
        read, _ = lfilter([1 - share], [1, -share], one_after_another, zi=share * one_after_another[:1])
        np.testing.assert_allclose(shown.reshape(-1), read, atol=1e-12)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_an_error_of_fringes_is_that_of_a_phase_with_a_small_ghost(name):
    shown, true, one = lied(name, "other: cyclic-error")
    size, cycle = np.real(one.amount), one.about["cycle"]
    for read, field in [(shown.real, true.real), *([] if name == "phi4" else [(shown.imag, true.imag)])]:
        fringe = np.exp(1j * np.pi * field / cycle)
        np.testing.assert_allclose(read - field, size * 2 * fringe.real * fringe.imag, atol=1e-12)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_camera_dims_what_was_bright_a_row_ago(name):
    shown, true, one = lied(name, "other: auto-exposure")
    seen = np.real(np.sum(shown * true.conj(), axis=1) / np.sum(np.abs(true) ** 2, axis=1))
    np.testing.assert_allclose(shown, seen[:, None] * true, atol=1e-12)
    assert np.array_equal(shown[0], true[0])
    assert seen[1] == pytest.approx(1, abs=1e-12)
    light = [sum(abs(number) for number in row) for row in true]
    for k in range(2, 20):
        assert (1 - seen[k]) / np.real(one.amount) == pytest.approx((light[k - 1] - light[0]) / light[0], abs=1e-9)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_reference_wanders_by_small_steps_for_all_sensors_alike(name):
    shown, true, one = lied(name, "other: wandering-reference", samples=100)
    off = (shown - true) / np.real(one.amount)
    assert np.max(np.abs(off[0])) == 0
    np.testing.assert_allclose(off, np.repeat(off[:, :1], 7, axis=1), atol=1e-9)
    if name == "dnls":
        np.testing.assert_allclose(off.real, off.imag, atol=1e-9)
    # A random walk: steps that know nothing of each other, by which it gets about one away in the whole time.
    steps = np.diff(off[:, 0].real) * 10
    assert np.std(steps) == pytest.approx(1, abs=0.25)
    assert abs(np.corrcoef(steps[1:], steps[:-1])[0, 1]) < 0.3


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_a_second_card_falls_behind_the_first(name):
    _, _, one = lied(name, "other: two-cards")
    size, t = np.real(one.amount), one.clean.t
    dense = drawn(name, NONE, samples=400)
    assert size > 0
    late = t + size * (t - t[0])
    seen = late <= dense.clean.t[-1]
    assert np.sum(seen) > 10
    for k, (shown, true) in enumerate(pairs_of(name, one)):
        whole = CubicSpline(dense.clean.t, dense.clean.u if k == 0 else dense.clean.v)
        np.testing.assert_allclose(shown[:, :3], true[:, :3], atol=1e-7)
        np.testing.assert_allclose(shown[seen, 3:], whole(late[seen])[:, 3:], atol=1e-5)


def test_mixers_that_are_not_alike_show_one_part_larger_than_the_other():
    shown, true, one = lied("dnls", "other: mixer-imbalance")
    size = np.real(one.amount)
    np.testing.assert_allclose(shown.real, (1 + size) * true.real, atol=1e-12)
    np.testing.assert_allclose(shown.imag, (1 - size) * true.imag, atol=1e-12)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_resampled_rows_lie_on_straight_lines_between_the_recorders_own(name):
    _, _, one = lied(name, "other: resampled-rows")
    dense, step, t = drawn(name, NONE, samples=400), np.sqrt(np.real(one.amount)), one.clean.t
    own = np.arange(t[0], dense.clean.t[-1], step)
    seen = t <= own[-1]
    assert np.sum(seen) > 10
    for k, (shown, true) in enumerate(pairs_of(name, one)):
        field = CubicSpline(dense.clean.t, dense.clean.u if k == 0 else dense.clean.v)(own)
        read = np.stack([np.interp(t[seen], own, column) for column in field.T], axis=1)
        np.testing.assert_allclose(shown[seen], read, atol=1e-5)
        assert np.max(np.abs(shown - true)) > 1e-3


def test_making_one_does_not_call_the_dynamics_that_fits_use(monkeypatch):
    """But for the size, which is measured on the plain motion, everything is made without it."""
    from latticebench.bench.trials import specimen

    def forbidden(*_, **__):
        raise AssertionError("the loop's dynamics was used")

    class Guess:
        """Any change has the size 15."""

        def size(self, found):
            return 15 * float(np.max(np.abs(found[0])) > 0)

        fitted_size = size

        def apart(self, _):
            return 0.0

    monkeypatch.setattr(specimen, "_sight", lambda *_: Guess())
    monkeypatch.setattr(Dynamics, "linear", forbidden)
    for name, effect in SOME:
        made(name, effect, 15)


def test_jitter_moves_rows_by_times_that_differ():
    one = drawn("phi4", "clock", z=40)
    plain = drawn("phi4", NONE)
    moved = one.clean.u - plain.clean.u
    late = np.sum(moved * plain.clean.v, axis=1) / np.sum(plain.clean.v**2, axis=1)
    assert np.std(late) > 3 * abs(np.mean(late)) / np.sqrt(len(late))
    assert np.array_equal(one.samples.t, plain.samples.t)


# What makes sense ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_what_the_equation_has_already_is_no_effect_of_it(name):
    system = systems.find(name)
    lacking = {effect.name for effect in CATALOGUE if sensible(effect.name, system)}
    has = {"phi4": {"onsite-linear", "onsite-cubic"}, "sine-gordon": set(), "dnls": set()}
    assert not lacking & has.get(name, {"onsite-linear", "onsite-cubic", "damping", "nonlinear-loss"})
    assert {"drive", "defect", "ends", "sensor-offset", "clock", "disorder"} <= lacking
    if not system.is_complex:
        assert not lacking & {"nonlinear-loss", "gain-loss", "intersite-nonlinearity"}
    if system.order == 1:
        assert not lacking & {"dry-friction", "quadratic-drag"}
    assert {other for other in OTHERS if sensible(other, system)} >= {"other: weak-bond", "other: saturation"}


def test_the_blind_sets_are_outside_the_catalogue_and_beside_each_other():
    assert [len(BLIND), len(SECOND_BLIND), len(THIRD_BLIND), len(FOURTH_BLIND)] == [10, 8, 10, 10]
    assert len(FIFTH_BLIND) == 18
    assert len(OTHERS) == 12 + 10 + 8 + 10 + 10 + 18
    assert {*BLIND, *SECOND_BLIND, *THIRD_BLIND, *FOURTH_BLIND, *FIFTH_BLIND} < set(OTHERS)
    assert not set(OTHERS) & {one.name for one in CATALOGUE}


def test_a_fault_is_for_lattices_that_can_have_it():
    assert not sensible("other: phase-conjugation", systems.find("phi4"))
    assert not sensible("other: lopsided-bonds", systems.find("dnls"))
    assert not sensible("other: nonlocal-response", systems.find("sine-gordon"))
    assert not sensible("other: slipping-spring", systems.find("ginzburg-landau"))
    assert not sensible("other: braked-site", systems.find("dnls"))
    assert not sensible("other: bent-wire", systems.find("dnls"))
    assert not sensible("other: gyroscopic-bonds", systems.find("ginzburg-landau"))
    assert not sensible("other: mixer-imbalance", systems.find("phi4"))


def test_every_effect_of_the_catalogue_can_be_made():
    assert {one.name for one in CATALOGUE} <= set(FAULTS)


def test_an_unknown_effect_is_refused_by_name():
    with pytest.raises(InputError, match="dampng"):
        drawn("phi4", "dampng")
    with pytest.raises(InputError):
        sensible("dampng", systems.find("phi4"))


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


def test_of_two_effects_one_at_most_may_be_of_the_instrument():
    for pair in ("sensor-gain+clock", "damping+memory"):
        with pytest.raises(InputError, match="one at most may be of the instrument"):
            drawn("phi4", pair)


def test_an_effect_that_does_nothing_is_refused():
    with pytest.raises(InputError, match="of no size is visible"):
        drawn("phi4", "onsite-linear")


def test_a_record_so_dense_that_its_residual_has_no_line_can_be_sized():
    one = make(
        systems.find("phi4"), "other: cubic-drag", 10.0, np.random.default_rng(1), sites=7, samples=800, span=4.0
    )
    assert one.apart >= 0
