"""Scores on cases whose value is known."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench import systems
from latticebench.bench.score import LOST, forecast, score
from latticebench.systems.lattice import library
from latticebench.systems.motion import Motion, motion
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import sample_times, simulate
from latticebench.systems.terms import Term

ONES = np.ones(4)


@pytest.mark.parametrize(
    ("found", "truth", "e2", "einf", "spurious", "tpr"),
    [
        ([3, 4, 0, 0], [3, 4, 0, 0], 0.0, 0.0, 0.0, 1.0),
        ([0, 0, 0, 0], [3, 4, 0, 0], 1.0, 1.0, 0.0, 0.0),
        ([3, 4, 5, 0], [3, 4, 0, 0], 1.0, 0.0, 5.0, 2 / 3),
        ([6, 4, 0, -0.01], [3, 4, 0, 0], np.hypot(3, 0.01) / 5, 1.0, 0.01, 1.0),
        ([3, 0.04, 0, 0], [3, 4, 0, 0], 3.96 / 5, 0.99, 0.0, 0.5),
    ],
)
def test_scores_of_hand_made_cases(
    found: list[float], truth: list[float], e2: float, einf: float, spurious: float, tpr: float
) -> None:
    got = score(np.array(found, float), np.array(truth, float), ONES)
    assert (got.e2, got.einf, got.spurious, got.tpr) == pytest.approx((e2, einf, spurious, tpr))
    assert got.exact == (tpr == 1.0)


def test_the_support_does_not_depend_on_units() -> None:
    found, truth, shares = np.array([1.0, 0.2, 0.01]), np.array([1.0, 0.0, 0.0]), np.array([1.0, 0.1, 1.0])
    units = np.array([10.0, 1e-4, 1e3])
    assert score(found, truth, shares).tpr == score(found / units, truth / units, shares * units).tpr == 1.0


def test_the_true_coefficients_forecast_to_the_end() -> None:
    system = systems.find("phi4")
    exact = simulate(system, sites=15, integrator="dop853", times=sample_times(50, 10.0)).exact
    assert exact is not None
    chain = motion(system, {}, 15)
    candidates = system.library("lib2")
    truth = system.truth(candidates, {})
    told = forecast(truth, candidates, chain, chain.pack(exact.u[0], exact.v[0]), exact)
    assert told.error < 1e-6
    assert told.horizon == pytest.approx(exact.t[-1])


def test_a_wrong_equation_is_lost_early_and_one_that_explodes_has_an_infinite_error() -> None:
    system = systems.find("phi4")
    exact = simulate(system, sites=15, integrator="dop853", times=sample_times(50, 10.0)).exact
    assert exact is not None
    chain = motion(system, {}, 15)
    candidates = system.library("lib2")
    start = chain.pack(exact.u[0], exact.v[0])
    frozen = forecast(np.zeros(4), candidates, chain, start, exact)
    assert 0.1 < frozen.error < np.inf
    assert 0 <= frozen.horizon < 9
    exploding = forecast(np.array([0.0, 0.0, 50.0, 50.0]), candidates, chain, start, exact)
    assert exploding.error == np.inf
    assert exploding.horizon < 3


def test_the_error_and_the_horizon_of_a_forecast_are_those_of_two_cosines() -> None:
    candidates = library("one", "u[n]")
    chain = Motion(Term("-u[n]"), 2, False, 3, "fixed")
    t = np.linspace(0, 20, 101)
    amplitude = np.array([1.0, -2.0, 0.5])
    exact = Samples(t, np.cos(t)[:, None] * amplitude, -np.sin(t)[:, None] * amplitude)
    start = chain.pack(exact.u[0], np.zeros(3))
    told = forecast(np.array([-(1.02**2)]), candidates, chain, start, exact)
    off = np.cos(1.02 * t) - np.cos(t)
    assert told.error == pytest.approx(np.linalg.norm(off) / np.linalg.norm(np.cos(t)), rel=1e-4)
    first_lost = np.flatnonzero(np.abs(off) > LOST * np.sqrt(np.mean(np.cos(t) ** 2)))[0]
    assert told.horizon == pytest.approx(t[first_lost - 1])
