"""The maximum-likelihood fit reaches the bound, knows its own error, and takes every kind of samples."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from commandline import SOON, no_longer_than
from latticebench import systems
from latticebench.bench.limit import bound_of
from latticebench.methods.method import solve
from latticebench.methods.trajectory import Trajectory
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, sample_times, simulate

FOUR = [("phi4", "lib2"), ("sine-gordon", "lib2"), ("dnls", "four"), ("ginzburg-landau", "four")]
EXACT = [
    ("phi4", "lib3", {}),
    ("dnls", "four", {"C": 0.5}),
    ("ginzburg-landau", "four", {"C": 0.5}),
    ("sine-gordon", "sines", {}),
]


@functools.cache
def motion(name, sites=None):
    return simulate(systems.find(name), sites=sites)


def seen(name, noise, seed, *, velocities=True, missing=0.0, ends=None, **options):
    system = systems.find(name)
    clean = simulate(system, **options) if options.keys() - {"sites"} else motion(name, **options)
    found = observe(clean, np.random.default_rng(seed), noise=noise, missing=missing).observed()
    return replace(found, v=found.v if velocities else None, ends=ends or system.ends)


def limit(system, candidates, noise, **options):
    return bound_of([replace(simulate(system, **options), ends=system.ends)], candidates, system.order, noise=noise)


def error(fit, truth):
    return np.linalg.norm(fit.coefficients - truth) / np.linalg.norm(truth)


@pytest.mark.parametrize(("name", "candidates", "parameters"), EXACT)
def test_without_noise_the_coefficients_are_found(name, candidates, parameters):
    system = systems.find(name)
    one = system.library(candidates)
    fit = solve(Trajectory(), [seen(name, 0.0, 0, parameters=parameters)], one, system.order, 0)
    assert fit.status == "ok"
    assert error(fit, system.truth(one, parameters)) < 1e-6


@pytest.mark.parametrize(("name", "candidates"), [FOUR[0], FOUR[3]])
def test_with_noise_the_error_is_that_of_the_bound(name, candidates):
    noise = 0.05
    system = systems.find(name)
    one = system.library(candidates)
    truth = system.truth(one, {})
    fits = [solve(Trajectory(), [seen(name, noise, seed)], one, system.order, 0) for seed in range(2)]
    scores = np.array([(fit.coefficients - truth) / fit.stderr for fit in fits])
    # 8 correlated standard scores: their mean square is 1, and far from 4.
    assert np.sqrt(np.mean(scores**2)) < 2
    least = limit(system, one, noise).stderr
    assert np.median([fit.stderr / least for fit in fits]) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(
    "options",
    [
        {"velocities": False},
        {"missing": 0.1},
        {"times": sample_times(50, 10.0, np.random.default_rng(3))},
        {"ends": "unknown"},
        {"ends": "unknown", "missing": 0.1, "velocities": False},
    ],
)
def test_takes_gaps_uneven_times_positions_alone_and_unknown_ends(options):
    system = systems.find("phi4")
    one = system.library("lib2")
    truth = system.truth(one, {})
    fit = solve(Trajectory(), [seen("phi4", 0.01, 1, **options)], one, 2, 0)
    assert fit.status == "ok"
    assert np.max(np.abs(fit.coefficients - truth) / fit.stderr) < 4
    assert error(fit, truth) < 0.03


def test_missing_complex_values():
    system = systems.find("dnls")
    one = system.library("four")
    fit = solve(Trajectory(), [seen("dnls", 0.01, 0, missing=0.1)], one, 1, 0)
    assert error(fit, system.truth(one, {})) < 0.003


def test_several_trajectories_of_different_lengths_know_more_than_one():
    system = systems.find("phi4")
    one = system.library("lib2")
    draw = np.random.default_rng(0)
    first, second = (
        replace(one, u=one.u + 0.01 * draw.normal(size=one.u.shape), v=one.v + 0.002 * draw.normal(size=one.u.shape))
        for one in (
            seen("phi4", 0.0, 0),
            seen("phi4", 0.0, 0, variation=np.random.default_rng(5), times=sample_times(30, 6.0)),
        )
    )
    alone = solve(Trajectory(), [first], one, 2, 0)
    both = solve(Trajectory(), [first, second], one, 2, 0)
    assert np.all(both.stderr < alone.stderr)
    assert np.max(np.abs(both.coefficients - system.truth(one, {})) / both.stderr) < 4


def test_a_measured_input_drives_an_oscillator():
    t = np.linspace(0, 20, 201)

    def force(at):
        return np.sin(1.3 * at) + 0.5 * np.cos(0.4 * at)

    moved = solve_ivp(
        lambda at, y: [y[1], -2.0 * y[0] - 0.3 * y[1] + 0.7 * force(at)], (0, 20), [1.0, 0.0],
        t_eval=t, rtol=1e-10, atol=1e-12,
    ).y  # fmt: skip
    noisy = moved[0] + 0.01 * np.random.default_rng(0).normal(size=len(t))
    samples = Samples(t, noisy[:, None], f=force(t)[:, None], ends="free")
    fit = solve(Trajectory(), [samples], library("oscillator", "u[n]; v[n]; f[n]"), 2, 0)
    np.testing.assert_allclose(fit.coefficients, [-2.0, -0.3, 0.7], atol=0.02)
    assert fit.found["noise_u"] == pytest.approx(0.01, rel=0.2)


def test_selection_drops_what_is_not_there():
    system = systems.find("phi4")
    one = system.library("lib3")
    fit = solve(Trajectory(select=True), [seen("phi4", 0.01, 0)], one, 2, 0)
    np.testing.assert_array_equal(fit.coefficients != 0, system.truth(one, {}) != 0)


def test_at_unknown_ends_dropping_the_widest_term_leaves_the_same_sites_an_equation():
    wide = library("wide", "u[n+1]+u[n-1]-2*u[n]; u[n]; u[n]**3; u[n+2]+u[n-2]-2*u[n]")
    samples = seen("phi4", 0.01, 0, sites=15, times=sample_times(40, 8.0), ends="unknown")
    fit = solve(Trajectory(select=True), [samples], wide, 2, 0)
    np.testing.assert_array_equal(fit.coefficients != 0, [True, True, True, False])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "candidates"), FOUR)
def test_intervals_cover_and_the_bound_is_reached_over_120_seeds(name, candidates):
    system = systems.find(name)
    one = system.library(candidates)
    truth = system.truth(one, {})
    scores, squares = [], []
    # Each noise with seeds of its own: the same numbers on another scale say nearly the same again.
    for noise, seeds in ((0.01, range(60)), (0.05, range(60, 120))):
        fits = [solve(Trajectory(), [seen(name, noise, seed, sites=15)], one, system.order, 0) for seed in seeds]
        scores += [(fit.coefficients - truth) / fit.stderr for fit in fits]
        known = limit(system, one, noise, sites=15).relative
        squares += [(error(fit, truth) / known) ** 2 for fit in fits]
    # The coefficients of a fit go together: as a share of 120 fits, 95 % has a standard error of 2 % at most.
    assert 0.89 <= np.mean(np.abs(scores) < 1.96) <= 0.99
    assert np.mean(squares) ** -0.5 > 0.85


def test_the_start_from_the_weak_form_finds_what_pieces_lose():
    one = systems.find("phi4").library("lib2")
    fit = solve(Trajectory(), [seen("phi4", 0.1, 6)], one, 2, 0)
    assert fit.status == "ok"
    assert error(fit, [2.0, 2.0, -2.0, -2.0]) < 0.02


@pytest.mark.parametrize("seed", [20, 21, 26])
def test_states_that_follow_the_motion_first_lead_to_where_noisy_ones_do_not(seed):
    """With u alone at 5 % noise, the first step from the smoothed states halves the coefficients."""
    fit = solve(Trajectory(), [seen("phi4", 0.05, seed, velocities=False)], systems.find("phi4").library("lib2"), 2, 0)
    assert fit.status == "ok"
    assert error(fit, [2.0, 2.0, -2.0, -2.0]) < 0.1


def test_where_the_weak_form_gives_no_start_pieces_lead_to_the_same_fit(monkeypatch):
    one = systems.find("phi4").library("lib2")
    samples = seen("phi4", 0.01, 0)
    usual = solve(Trajectory(), [samples], one, 2, 0)
    monkeypatch.setattr("latticebench.methods.trajectory.from_weak_form", lambda *_: None)
    other = solve(Trajectory(), [samples], one, 2, 0)
    assert np.max(np.abs(other.coefficients - usual.coefficients) / usual.stderr) < 0.01
    # Too few samples for a weak form.
    few = seen("phi4", 0.001, 0, times=sample_times(5, 1.0))
    assert error(solve(Trajectory(), [few], one, 2, 0), [2.0, 2.0, -2.0, -2.0]) < 0.1


def test_a_time_in_which_no_site_that_moves_was_seen_adds_nothing_and_takes_nothing():
    """u_1' = -i u_1 + 0.3 i u_2, where u_2 turns as it likes: a solution written by hand."""
    t = 0.25 * np.arange(16)
    u = np.column_stack([0.6 * np.exp(-1j * t) + 0.05 * np.exp(2j * t), 0.5 * np.exp(2j * t)])
    u[-8:, 0] = np.nan
    fit = solve(Trajectory(), [Samples(t, u)], library("own", "i*u[n]; i*u[n+1]"), 1, 0)
    np.testing.assert_allclose(fit.coefficients, [-1.0, 0.3], atol=1e-3)


def test_selection_goes_down_to_a_single_term():
    t = np.linspace(0, 8, 161)
    u = np.cos(1.5 * t) + 0.01 * np.random.default_rng(2).normal(size=len(t))
    samples = Samples(t, u[:, None], ends="free")
    fit = solve(Trajectory(select=True), [samples], library("two", "u[n]; v[n]"), 2, 0)
    np.testing.assert_array_equal(fit.coefficients != 0, [True, False])
    assert fit.coefficients[0] == pytest.approx(-2.25, abs=0.02)


def test_a_reading_that_dwarfs_all_others_leads_to_no_endless_fit():
    # Its weight makes wrong coefficients so large that no number of steps follows the motion from sample to sample.
    samples = seen("dnls", 0.01, 0, sites=3, times=sample_times(30, 29 / 3), ends="unknown")
    dwarfed = samples.u * 1e-150
    dwarfed[11, 0] = dwarfed[11, 0].real + 1e-101j
    candidates = library("", "u[n]; u[n+1]; i*u[n]; i*u[n+1]")
    with no_longer_than(SOON):
        fit = solve(Trajectory(), [replace(samples, u=dwarfed)], candidates, 1, 0)
    assert fit.status != "ok"
