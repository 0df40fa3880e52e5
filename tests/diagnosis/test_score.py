"""The score: what candidates would win, against fits, against one another, and where a fit with one of them begins."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.fitting import fit
from latticebench.diagnosis.glance import PROMISING, _looked, _Pull, most_promising
from latticebench.diagnosis.horizon import Layout, follow
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Structure
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.score import Tangent
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

SITES, NOISE, DAMPING, PUSH, OMEGA = 3, 0.003, 0.02, 0.02, 5.0
DECLARED = library("chain", "u[n+1]+u[n-1]-2*u[n]; u[n]")
T = np.linspace(0, 20, 400)


def rate(t, y):
    """A chain of three with damping and a push from outside, of which the equation knows nothing."""
    u, v = np.split(y, 2)
    beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])
    return np.concatenate([v, 2 * (beside - 2 * u) - 3 * u - DAMPING * v + PUSH * np.cos(OMEGA * t)])


@pytest.fixture(scope="module")
def problem():
    start = np.array([1.0, -0.5, 0.2, 0, 0.3, 0])
    u = solve_ivp(rate, T[[0, -1]], start, t_eval=T, method="DOP853", rtol=1e-11, atol=1e-12).y.T[:, :SITES]
    u = u + NOISE * np.random.default_rng(1).normal(size=u.shape)
    return Problem.of(DECLARED, 2, [Samples(T, u, source="chain", ends="free")], CATALOGUE)


def fitted(problem, length, model=None, near=None):
    layout = Layout.of(problem, length, None, NOISE / 30)
    model = model or Model(DECLARED, 2, (2.0, -3.0))
    near = near or [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    found = fit(model, layout.with_substeps(model, near, problem.top), near, structure=Structure(own_sizes=True))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def plain(problem):
    return fitted(problem, 100)


def candidate(problem, name, **settings):
    return next(
        one
        for one in problem.candidates
        if one.effect.name == name and all(getattr(one, key) == value for key, value in settings.items())
    )


def nearest_drive(problem):
    drives = [one for one in problem.candidates if one.effect.name == "drive"]
    return min(drives, key=lambda one: abs(one.frequency - OMEGA))


def test_a_candidate_wins_in_a_fit_about_what_its_score_says(problem, plain):
    for one in (candidate(problem, "damping"), nearest_drive(problem)):
        (scored,) = Tangent(plain).scored([one])
        with_it = fitted(problem, 100, plain.model.with_effect(scored.placed), list(plain.followed.nodes))
        assert 0.5 < (plain.cost - with_it.cost) / scored.gain < 2


def test_the_likeliest_of_many_are_those_of_the_highest_score(problem, plain):
    tangent = Tangent(plain)
    drives = [one for one in problem.candidates if one.effect.name == "drive"]
    kept = most_promising(tangent, drives, lambda _: 0.0, lambda one: one.effect.name)
    assert len(kept) == PROMISING < len(drives)
    best = max(tangent.scored(drives), key=lambda one: one.gain)
    assert best.placed.frequency in {one.frequency for one in kept}


def test_a_force_at_one_site_is_glanced_at_as_one_at_every_site_is(problem, plain):
    """The short way, by what a force's course in time does, agrees with the long one, by the force itself."""
    tangent = Tangent(plain)
    one = nearest_drive(problem)
    pull = _Pull(tangent, 0, _looked(tangent)[0])
    for placed in (one, next(one for one in problem.candidates if one.effect.name == "local-drive")):
        long = tangent.push(0, placed).reshape(len(placed.numbers), -1) @ pull.dual
        short = np.zeros_like(long)
        pull.add([placed], np.array([0, len(long)]), short)
        np.testing.assert_allclose(short, long, rtol=1e-9, atol=1e-9 * np.max(np.abs(long)))


def test_a_hum_is_glanced_at_by_what_it_adds_to_the_readings(problem, plain):
    tangent = Tangent(plain)
    looked = _looked(tangent)[0]
    hums = [one for one in problem.candidates if one.effect.name == "sensor-hum"]
    for placed in (hums[3], hums[-4]):
        placed = placed.moved([0.3, -0.2, placed.frequency])
        by = placed.misread(tangent.along[0].t, tangent.along[0].field).read(problem.chain.levels).by
        long = by.reshape(len(by), -1) @ looked.reshape(by[0].size, -1)
        short = np.zeros_like(long)
        _Pull(tangent, 0, looked).add([placed], np.array([0, len(long)]), short)
        np.testing.assert_allclose(short, long, rtol=1e-9, atol=1e-9 * np.max(np.abs(long)))


def test_other_ends_have_a_score_as_they_stand(problem, plain):
    ends = [one for one in problem.candidates if one.effect.name == "ends"]
    found = Tangent(plain).scored(ends)
    assert len(found) == 3
    # The chain is free, as declared.
    assert all(one.gain == 0 for one in found)


def test_a_fit_begins_near_the_motion_that_its_effect_makes(problem, plain):
    model, near = Tangent(plain).start(candidate(problem, "onsite-cubic").moved([-0.1]))
    assert model.effects[0].strength == (-0.1,)
    path = follow(model, plain.layout, near)
    assert path is not None
    off = [float(np.max(np.abs(path.nodes[0] - nodes))) for nodes in (near[0], plain.followed.nodes[0])]
    assert off[0] < 0.1 * off[1]


def test_an_effect_that_does_the_work_of_another_takes_its_place(problem, plain):
    (scored,) = Tangent(plain).scored([candidate(problem, "damping")])
    damped = fitted(problem, 100, plain.model.with_effect(scored.placed), list(plain.followed.nodes))
    tangent = Tangent(damped)
    others = [candidate(problem, name) for name in ("quadratic-drag", "dry-friction", "onsite-cubic")]
    without = tangent.in_place_of([0])
    found = {one.placed.effect.name: one for one in without.scored(others)}
    share = {name: one.won / without.taken for name, one in found.items()}
    assert share["quadratic-drag"] > 0.8 > 0.3 > share["onsite-cubic"]
    model, near = tangent.start(found["quadratic-drag"].placed, [0])
    assert [one.effect.name for one in model.effects] == ["quadratic-drag"]
    begun = follow(model, damped.layout, near)
    assert begun is not None
    # Far nearer to the readings than the declared equation alone.
    left = np.nanmean(begun.left**2), np.nanmean(plain.followed.left**2), np.nanmean(damped.followed.left**2)
    assert left[0] - left[2] < 0.3 * (left[1] - left[2])
