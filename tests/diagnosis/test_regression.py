"""Regression over smoothed readings: which lines of a spectrum are the chain's own, and which a force sustains."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.regression import regressed, sustained
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import CATALOGUE, Effect
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

T = np.arange(0, 100, 0.1)
TONES = ((0.8, 2.9), (0.5, 1.1))
CHAIN = library("chain", "u[n+1]+u[n-1]-2*u[n]; u[n]")
SPRING = library("spring", "u[n]")


def swinging(tones, sites=1, at=None):
    """u'' = 3 (u[n+1] + u[n-1] - 2 u[n]) - 4 u - 0.1 u' and forces at all sites, or at one, with noise of 0.01."""
    share = np.ones(sites) if at is None else np.eye(sites)[at]

    def rate(t, y):
        u, v = np.split(y, 2)
        beside = np.diff(u, append=u[-1]) - np.diff(u, prepend=u[0])
        force = sum(size * np.cos(omega * t) for size, omega in tones)
        return np.concatenate([v, 3 * beside - 4 * u - 0.1 * v + share * force])

    start = np.concatenate([0.2 * np.cos(2 * np.arange(sites)), np.zeros(sites)])
    u = solve_ivp(rate, T[[0, -1]], start, t_eval=T, method="DOP853", rtol=1e-9, atol=1e-11).y[:sites].T
    return Samples(T, u + 0.01 * np.random.default_rng(7).normal(size=u.shape), source="driven", ends="free")


@pytest.mark.parametrize("tones", [TONES[:1], TONES])
def test_with_forces_at_the_strongest_lines_coefficients_are_the_chains_own(tones):
    problem = Problem.of(SPRING, 2, [swinging(tones)], CATALOGUE)
    model = sustained(problem)[len(tones) - 1]
    for found, (size, omega) in zip(model.effects, tones, strict=True):
        assert found.effect.name == "drive"
        assert found.frequency == pytest.approx(omega, abs=0.002)
        assert np.hypot(*found.strength) == pytest.approx(size, rel=0.05)
    # Without them, the spring is as stiff as would swing at their frequencies.
    assert model.coefficients[0] == pytest.approx(-4, abs=0.1)
    assert regressed(problem)[0][0] < -4.4


def test_a_force_at_one_site_is_told_from_one_at_all():
    problem = Problem.of(CHAIN, 2, [swinging(TONES[:1], sites=3, at=2)], CATALOGUE)
    (first, *_) = sustained(problem)[0].effects
    assert (first.effect.name, first.site) == ("local-drive", 2)


def test_of_a_chain_that_swings_by_itself_no_line_is_taken_for_a_forces():
    assert sustained(Problem.of(CHAIN, 2, [swinging((), sites=3)], CATALOGUE)) == []


def test_a_force_of_the_users_that_is_infinite_somewhere_is_none_that_sustains_a_line():
    driven = swinging(TONES[:1])
    infinite = Effect("logarithm", "log(u[n])", acts="harmonic")
    problem = Problem.of(SPRING, 2, [driven], (*CATALOGUE, infinite))
    assert [one.effect.name for one in sustained(problem)[0].effects] == ["drive"]


@pytest.mark.slow
def test_two_forces_that_outlast_the_motion_they_found_are_named_with_the_damping():
    found = diagnose(SPRING, 2, [swinging(TONES)], CATALOGUE)
    assert found.verdict == "explained"
    assert sorted(one.name for one in found.findings) == ["damping", "drive", "drive"]
