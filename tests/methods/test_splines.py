"""Splines with the equation as a penalty: near the bound, exact without noise, and for every kind of samples."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from latticebench import systems
from latticebench.bench.limit import bound_of
from latticebench.methods.method import solve
from latticebench.methods.splines import Splines
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
    fit = solve(Splines(), [seen(name, 0.0, 0, parameters=parameters)], one, system.order, 0)
    assert error(fit, system.truth(one, parameters)) < 1e-6


@pytest.mark.parametrize(("name", "candidates"), [FOUR[0], FOUR[3]])
def test_with_noise_the_error_is_near_the_bound(name, candidates):
    noise = 0.05
    system = systems.find(name)
    one = system.library(candidates)
    truth = system.truth(one, {})
    fits = [solve(Splines(), [seen(name, noise, seed, sites=15)], one, system.order, 0) for seed in range(2)]
    least = limit(system, one, noise, sites=15)
    assert np.sqrt(np.mean([error(fit, truth) ** 2 for fit in fits])) < 2 * least.relative
    assert np.median([fit.stderr / least.stderr for fit in fits]) == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize(
    "options",
    [
        {"velocities": False},
        {"missing": 0.1},
        {"times": sample_times(50, 10.0, np.random.default_rng(3))},
        {"ends": "unknown"},
    ],
)
def test_takes_gaps_uneven_times_positions_alone_and_unknown_ends(options):
    system = systems.find("phi4")
    one = system.library("lib2")
    fit = solve(Splines(), [seen("phi4", 0.01, 1, **options)], one, 2, 0)
    assert error(fit, system.truth(one, {})) < 0.015


def test_several_trajectories():
    system = systems.find("phi4")
    one = system.library("lib2")
    data = [seen("phi4", 0.01, 0), seen("phi4", 0.01, 1, variation=np.random.default_rng(5))]
    fit = solve(Splines(), data, one, 2, 0)
    assert error(fit, system.truth(one, {})) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.001, 0.01, 0.05])
@pytest.mark.parametrize(("name", "candidates"), FOUR)
def test_the_efficiency_is_at_least_seven_tenths(name, candidates, noise):
    system = systems.find(name)
    one = system.library(candidates)
    truth = system.truth(one, {})
    fits = [solve(Splines(), [seen(name, noise, seed)], one, system.order, 0) for seed in range(50)]
    spread = np.sqrt(np.mean([error(fit, truth) ** 2 for fit in fits]))
    assert limit(system, one, noise).relative / spread > 0.7
    scores = np.array([(fit.coefficients - truth) / fit.stderr for fit in fits])
    assert np.mean(np.abs(scores) < 1.96) >= 0.9
