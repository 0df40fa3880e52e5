"""Springs of which no two are alike."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.acting.every_bond import EveryBond, bonds
from latticebench.diagnosis.acting.one_bond import OneBond
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

T, NOISE, SITES = np.linspace(0, 20, 401), 0.002, 4
SPRINGS = library("springs", "u[n+1]+u[n-1]-2*u[n]")
OWN = library("own", "u[n]")
EACH = np.array([2.7, 3.3, 2.9, 3.2, 3.1])


def motion(each, t=T):
    """Masses between walls on springs of their own: (T, sites)."""

    def rate(_, y):
        u, v = np.split(y, 2)
        return np.concatenate([v, np.diff(each * np.diff([0.0, *u, 0.0]))])

    start = np.concatenate([[0.5, 0.0, -0.2, 0.1], np.zeros(SITES)])
    return solve_ivp(rate, t[[0, -1]], start, t_eval=t, rtol=1e-10, atol=1e-11).y[:SITES].T


def read(u, ends="fixed"):
    draw = np.random.default_rng(2)
    return Samples(T, u + NOISE * draw.normal(size=u.shape), source="springs", ends=ends)


def candidates(declared, ends="fixed", way=EveryBond):
    problem = Problem.of(declared, 2, [read(motion(EACH), ends)], CATALOGUE)
    return problem, [one for one in problem.candidates if type(one) is way]


def right_hand_side(problem, effects, u):
    """The accelerations of a model with effects at the positions u."""
    assembled = Model(problem.declared, 2, (1.0,), effects).assembled(problem.plain, problem.chain, 0)
    y = np.concatenate([u, np.zeros(SITES)])[None]
    return assembled.dynamics.linear(assembled.coefficients, np.zeros(1), y, derivatives=False)[0][0, SITES:]


def test_a_chain_between_walls_has_a_bond_to_each():
    problem, (one,) = candidates(SPRINGS)
    assert bonds(problem.chain) == [(-1, 0), (0, 1), (1, 2), (2, 3), (3, 4)]
    assert one.labels(problem.chain) == tuple(f"u[n+1]-u[n] at bond {k}-{k + 1}" for k in range(4))
    deviations = EACH - np.mean(EACH)
    u = np.array([0.3, -0.7, 0.2, 0.5])
    added = right_hand_side(problem, (one.moved(deviations[:-1]),), u) - right_hand_side(problem, (), u)
    np.testing.assert_allclose(added, np.diff(deviations * np.diff([0.0, *u, 0.0])), rtol=1e-12)


@pytest.mark.parametrize(("ends", "count"), [("free", SITES - 1), ("periodic", SITES)])
def test_on_a_free_chain_or_a_ring_it_is_a_sum_of_single_bonds(ends, count):
    problem, (every,) = candidates(OWN, ends)
    _, single = candidates(OWN, ends, OneBond)
    assert len(single) == len(every.strength) == count
    each, u = np.linspace(0.2, 0.9, count), np.array([0.3, -0.7, 0.2, 0.5])
    together = right_hand_side(problem, (every.moved(each),), u)
    apart = right_hand_side(problem, tuple(one.moved([value]) for one, value in zip(single, each, strict=True)), u)
    np.testing.assert_allclose(together, apart, rtol=1e-12)


def test_springs_of_which_no_two_are_alike_are_found_each():
    effects = [find(name) for name in ("unequal-bonds", "bond-defect", "disorder", "defect", "damping", "sensor-gain")]
    found = diagnose(SPRINGS, 2, [read(motion(EACH))], effects)
    assert (found.verdict, [one.name for one in found.findings]) == ("explained", ["unequal-bonds"])
    deviations = EACH - np.mean(EACH)
    for k, (value, error) in enumerate(found.findings[0].values.values()):
        assert value == pytest.approx(deviations[k], abs=4 * error)
    assert found.declared[1][0] == pytest.approx(np.mean(EACH), abs=0.01)


@pytest.mark.slow
def test_one_spring_that_is_another_is_named_alone():
    each = np.array([3.0, 3.0, 3.4, 3.0, 3.0])
    effects = [find(name) for name in ("unequal-bonds", "bond-defect", "disorder", "damping")]
    found = diagnose(SPRINGS, 2, [read(motion(each))], effects)
    assert [(one.name, one.site) for one in found.findings] == [("bond-defect", 1)]
