"""What has no name: families of forces and of misreadings, alone in a residual and in the place of named effects."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import Diagnosis, diagnose
from latticebench.diagnosis.unnamed import Unnamed
from latticebench.diagnosis.unnamed.forces import Pushed
from latticebench.diagnosis.unnamed.readings import Misread
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

NOISE = 0.005
PLAIN = library("plain", "u[n+1]+u[n-1]-2*u[n]; u[n]")
COMPLEX = library("complex", "i*(u[n+1]+u[n-1]-2*u[n]); i*abs(u[n])**2*u[n]")


def chain(extra=lambda t, u, v: 0.0, ends="free", sites=4, read=lambda u: u, seed=0, noise=NOISE):
    """A linear chain with something more, read with noise; beyond unknown ends there is another site."""
    wide = sites if ends == "free" else sites + 2
    t = np.linspace(0, 30, 301)

    def rate(t, y):
        u, v = np.split(y, 2)
        beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])
        return np.concatenate([v, 0.5 * (beside - 2 * u) - u + extra(t, u, v)])

    start = np.concatenate([np.cos(1.7 * np.arange(wide)), np.zeros(wide)])
    u = solve_ivp(rate, t[[0, -1]], start, t_eval=t, rtol=1e-10, atol=1e-11).y.T[:, :wide]
    u = read(u if ends == "free" else u[:, 1:-1])
    return Samples(t, u + noise * np.random.default_rng(seed).normal(size=u.shape), source="chain", ends=ends)


def waves():
    t, n = np.linspace(0, 10, 101), np.arange(5)
    return Samples(t, np.exp(1j * (t[:, None] + n)) * (1 + 0.1 * np.cos(n)), source="waves", ends="periodic")


@functools.cache
def families(is_complex: bool) -> tuple[Problem, Unnamed]:
    of = (COMPLEX, 1, [waves()]) if is_complex else (PLAIN, 2, [with_rates()])
    problem = Problem.of(*of, ())
    return problem, Unnamed.of(problem)


def with_rates():
    one = chain()
    return Samples(one.t, one.u, np.gradient(one.u, one.t, axis=0), source="chain", ends="free")


@pytest.mark.parametrize("is_complex", [False, True])
def test_every_force_without_a_name_is_linear_in_its_strengths(is_complex):
    problem, unnamed = families(is_complex)
    pushed = [one for one in (*unnamed.few, *(family[0] for family in unnamed.many)) if isinstance(one, Pushed)]
    assert len(pushed) > 30
    for one in pushed:
        strengths = np.random.default_rng(1).normal(size=len(one.strength))
        forces = one.moved(strengths).forces(problem.chain)
        assert len(one.labels(problem.chain)) == len(strengths)
        for force in forces:
            assert force.coefficient == pytest.approx(sum(strengths[k] * share for k, share in force.by.items()))
        assert set().union(*(force.by for force in forces)) == set(range(len(strengths)))


@pytest.mark.parametrize("is_complex", [False, True])
def test_every_misreading_without_a_name_has_the_slope_of_what_it_adds(is_complex):
    problem, unnamed = families(is_complex)
    chain, draw = problem.chain, np.random.default_rng(2)
    t = np.linspace(0, 9, 6)
    field = draw.normal(size=(len(t), chain.levels, chain.parts, chain.sites))
    step = 1e-6
    misread = [one for one in unnamed.few if isinstance(one, Misread)]
    assert len(misread) > 8
    for one in misread:
        placed = one.moved(draw.normal(size=len(one.strength)))
        found = placed.misread(t, field)
        np.testing.assert_allclose(found.added, np.tensordot(placed.strength, found.by, 1), atol=1e-12)
        # A motion may have the rate of its velocity with it.
        more = placed.misread(t, np.concatenate([field, draw.normal(size=field[:, :1].shape)], axis=1))
        np.testing.assert_array_equal(more.read(chain.levels).added, found.added, err_msg=one.said)
        k = int(draw.integers(chain.sites))
        for level in range(chain.levels):
            for part in range(chain.parts):
                moved = np.zeros_like(field)
                moved[:, level, part, k] = step
                ahead, back = (placed.misread(t, one).added for one in (field + moved, field - moved))
                numerical = (ahead - back)[:, level, part, k] / (2 * step)
                np.testing.assert_allclose(found.slope[:, level, part, k], numerical, atol=1e-4, err_msg=one.said)


def diagnosed(data: Samples, names: tuple[str, ...]) -> Diagnosis:
    return diagnose(PLAIN, 2, [data], [find(name) for name in names])


def test_an_effect_that_stands_in_for_what_has_no_name_is_doubted():
    ageing = chain(lambda t, u, v: -0.01 * (t - 15) * u, noise=0.002)
    found = diagnosed(ageing, ("parametric-drive", "damping", "onsite-cubic"))
    assert found.verdict == "partly explained"
    assert [(one.name, one.instead) for one in found.left] == [("t*u[n]", ("parametric-drive",))]


def test_a_bond_that_one_site_feels_alone_is_found_where_it_is():
    lopsided = chain(lambda t, u, v: 0.02 * np.array([0.0, u[1] - u[2], 0.0, 0.0]))
    found = diagnosed(lopsided, ("dry-friction",))
    assert found.verdict == "unexplained"
    assert (found.left[0].name, found.left[0].site) == ("the bond to site 3, felt by this site alone", 1)


def test_another_gain_of_one_half_of_the_sensors_is_found():
    def read(u):
        return u * np.where(np.arange(u.shape[1]) > (u.shape[1] - 1) / 2, 1.1, 1.0)

    found = diagnosed(chain(read=read), ("damping", "onsite-cubic"))
    assert "another gain of one half" in [one.name for one in found.left[:3]]


@pytest.mark.parametrize(
    ("name", "force"),
    [("damping", lambda t, u, v: -0.02 * v), ("onsite-cubic", lambda t, u, v: -0.03 * u**3),
     ("defect", lambda t, u, v: -0.05 * np.eye(len(u))[1] * u), ("drive", lambda t, u, v: 0.03 * np.cos(2.6 * t))],
)  # fmt: skip
def test_an_effect_that_is_there_is_not_doubted(name, force):
    found = diagnose(PLAIN, 2, [chain(force)], CATALOGUE)
    assert [one.name for one in found.findings] == [name]
    assert found.verdict == "explained"


@pytest.mark.parametrize(
    ("name", "force"),
    [
        ("local-drive", lambda t, u, v: 0.05 * np.cos(2.6 * t) * np.eye(len(u))[1]),
        pytest.param("local-damping", lambda t, u, v: -0.05 * np.eye(len(u))[1] * v, marks=pytest.mark.slow),
        pytest.param(
            "local-kick",
            lambda t, u, v: 0.3 * np.exp(-((t - 12) ** 2) / 2) * np.eye(len(u))[1],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "bond-defect",
            lambda t, u, v: 0.05 * np.array([0.0, u[2] - u[1], u[1] - u[2], 0.0]),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_what_acts_at_one_site_or_bond_is_named_where_it_is(name, force):
    found = diagnose(PLAIN, 2, [chain(force, seed=2)], CATALOGUE)
    assert [(one.name, one.site) for one in found.findings] == [(name, 1)]
    assert found.verdict == "explained"


@pytest.mark.slow
def test_what_misreads_in_time_beside_unknown_ends_is_fitted():
    # A damping of a course in time does nearly the same: of half as much either may be said first.
    def read(u):
        return u * (1 + 0.2 * np.sin(np.linspace(0, 9, len(u))))[:, None]

    found = diagnosed(chain(ends="unknown", sites=4, read=read), ("damping", "sensor-offset"))
    assert found.verdict in ("unexplained", "partly explained")
    assert found.left[0].name == "a gain of its own course in time, common to all sensors"
