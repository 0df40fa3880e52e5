"""What has no name: smooth functions hold what they should, and win where no name is right."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench import systems
from latticebench.bench.trials.faults import OTHERS
from latticebench.bench.trials.specimen import Conditions, make
from latticebench.diagnosis import courses, modulated, smooth
from latticebench.diagnosis.model import Model, first_fit
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.tangent import linearise
from latticebench.diagnosis.trace import screen
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

# What is left of a force of z = 40 is then as large as one standard error.
FAITHFUL = 0.03
SMALL = {"sites": 9, "samples": 30, "span": 6.0}


@functools.cache
def tangent_of(name, effect="none", z=0.0):
    system = systems.find(name)
    one = make(system, effect, z, np.random.default_rng(4), Conditions(**SMALL, variation=True))
    data = [replace(one.samples.observed(), ends=system.ends)]
    return linearise(first_fit(Model(system.library("equation"), system.order), data))


def left_by(columns, target):
    """The share of a force that a sum of others leaves, by least squares."""
    matrix = columns.reshape(len(columns), -1).T
    found = np.linalg.lstsq(matrix, target.ravel(), rcond=None)[0]
    return np.linalg.norm(matrix @ found - target.ravel()) / np.linalg.norm(target)


@pytest.mark.parametrize("force", [lambda u: np.cos(2 * u + 1), lambda u: u / (1 + u**2), np.tanh, lambda u: u**5])
def test_a_smooth_force_that_depends_on_the_field_is_a_sum_of_the_polynomials(force):
    path = tangent_of("sine-gordon").paths[0]
    u, v = path.fields()
    for make_them, x in ((smooth.of_field, u), (smooth.of_velocity, v)):
        assert left_by(make_them(path), force(x)[:, None]) < FAITHFUL


def test_a_complex_force_that_depends_on_the_size_of_the_field_is_one_too():
    path = tangent_of("dnls").paths[0]
    u = path.fields()[0]
    force = (0.3 - 1j) * u / (1 + np.abs(u) ** 2)
    assert left_by(smooth.of_field(path), np.stack([force.real, force.imag], axis=1)) < FAITHFUL


@pytest.mark.parametrize("name", ["phi4", "ginzburg-landau"])
def test_what_a_spring_does_to_one_end_it_does_to_the_other_the_other_way_round(name):
    pulls = smooth.of_stretch(tangent_of(name).paths[0])
    np.testing.assert_allclose(np.sum(pulls, axis=-1), 0, atol=1e-10 * np.max(np.abs(pulls)))


def test_springs_of_any_law_are_sums_of_the_polynomials():
    path = tangent_of("phi4").paths[0]
    u = path.fields()[0]
    right = np.concatenate([u[:, 1:], u[:, -1:]], axis=1) - u
    left = np.concatenate([u[:, :1], u[:, :-1]], axis=1) - u
    assert left_by(smooth.of_stretch(path), (np.tanh(2 * right) + np.tanh(2 * left))[:, None]) < FAITHFUL


def test_friction_in_springs_of_any_law_is_one_too():
    path = tangent_of("phi4").paths[0]
    v = path.fields()[1]
    right = np.concatenate([v[:, 1:], v[:, -1:]], axis=1) - v
    left = np.concatenate([v[:, :1], v[:, :-1]], axis=1) - v
    assert left_by(smooth.of_stretch(path, "v"), (np.tanh(2 * right) + np.tanh(2 * left))[:, None]) < FAITHFUL


def test_a_stiffness_that_changes_in_time_is_a_sum_of_half_waves():
    path = tangent_of("sine-gordon").paths[0]
    u = path.fields()[0]
    x = (path.times - path.times[0]) / (path.times[-1] - path.times[0])
    assert left_by(modulated.in_time(path), ((x - 0.5)[:, None] * u)[:, None]) < FAITHFUL


def test_a_coupling_that_changes_along_the_chain_is_a_sum_of_half_waves():
    path = tangent_of("phi4").paths[0]
    u = path.fields()[0]
    right = np.concatenate([u[:, 1:], u[:, -1:]], axis=1) - u
    left = np.concatenate([u[:, :1], u[:, :-1]], axis=1) - u
    n = np.linspace(-1, 1, u.shape[1])
    assert left_by(modulated.along_chain(path), (np.tanh(2 * n) * (right + left))[:, None]) < FAITHFUL


def test_complex_terms_change_with_any_phase_and_none_counts_twice():
    path = tangent_of("ginzburg-landau").paths[0]
    each = modulated.steady_terms(path)
    assert len(each) == np.linalg.matrix_rank(each.reshape(len(each), -1)) == 6


@pytest.mark.parametrize(
    ("effect", "name"),
    [
        ("other: sudden-coupling", "a term that changes at one moment"),
        ("other: late-push", "a force at one site, of any course"),
    ],
)
def test_what_begins_late_is_found_as_such(effect, name):
    found = screen(tangent_of("dnls", effect, 40.0), CATALOGUE, np.random.default_rng(0), 40)
    assert found[0].name == name


@pytest.mark.parametrize("name", ["sine-gordon", "dnls"])
def test_a_travelling_wave_is_found_as_such_before_any_name(name):
    found = screen(tangent_of(name, "other: plane-wave", 12.0), CATALOGUE, np.random.default_rng(0), 40)
    evidence = {one.name: one.evidence for one in found}
    named = max(one.evidence for one in found if one.named)
    assert evidence["a wave of force along the chain"] > named + 5


def test_a_term_that_changes_in_time_and_along_the_chain_is_a_sum_of_products():
    path = tangent_of("phi4").paths[0]
    u = path.fields()[0]
    x, n = np.linspace(0, 1, len(u))[:, None], np.linspace(-1, 1, u.shape[1])
    moving = np.exp(-((n - x) ** 2) / 2) * u
    kinds = [modulated.in_both(path), modulated.in_time(path), modulated.along_chain(path)]
    every = np.concatenate([*kinds, u[None, :, None]])
    assert left_by(every, moving[:, None]) < FAITHFUL


@pytest.mark.parametrize(
    ("system", "effect", "name"),
    [
        ("sine-gordon", "other: stray-wire", "a bond between two distant sites"),
        ("ginzburg-landau", "other: retarded-coupling", "a term that comes late"),
        ("dnls", "other: pumped-coupling", "a term that swings at one frequency"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in [
                ("dnls", "other: stray-wire", "a bond between two distant sites"),
                ("sine-gordon", "other: shared-inertia", "a term that acts on the neighbours"),
                ("phi4", "other: shaken-end", "a force at one site that swings at one frequency"),
                ("phi4", "other: unsteady-supply", "a term of any course in time"),
            ]
        ),
    ],
)
def test_a_bond_or_term_in_an_unusual_place_comes_before_every_name(system, effect, name):
    evidence = {
        one.name: one.evidence
        for one in screen(tangent_of(system, effect, 30.0), CATALOGUE, np.random.default_rng(0), 40)
    }
    assert evidence[name] > max(evidence[effect.name] for effect in CATALOGUE if effect.name in evidence)


@pytest.mark.parametrize(
    ("effect", "name"),
    [("other: wavy-drag", "a force that depends on v"), ("other: uneven-bonds", "uneven bonds")],
)
def test_what_has_no_form_is_found_by_what_it_depends_on(effect, name):
    found = screen(tangent_of("sine-gordon", effect, 40.0), CATALOGUE, np.random.default_rng(0), 40)
    smooth = [one.name for one in found if not one.named and one.random]
    assert smooth[0] == name


@pytest.mark.parametrize(
    ("name", "effect"),
    [("sine-gordon", "other: cubic-drag"), pytest.param("dnls", "other: drifting-stiffness", marks=pytest.mark.slow)],
)
def test_a_name_that_comes_near_is_not_given_where_a_term_without_one_does_better(name, effect):
    assert effect in OTHERS
    system = systems.find(name)
    one = make(
        system, effect, 40.0, np.random.default_rng(1), Conditions(sites=15, samples=40, span=8.0, variation=True)
    )
    found = diagnose(
        system.library("equation"), system.order, [replace(one.samples.observed(), ends=system.ends)], CATALOGUE
    )
    assert one.apart > 5
    assert found.course.verdict in ("unexplained", "partly explained")


def test_a_swing_is_a_sum_of_half_waves():
    x = np.linspace(0, 1, 333)
    halves = np.cos(np.pi * np.arange(16) * x[:, None])
    for k, beat in zip(range(2, 15), courses.swings(16), strict=True):
        wanted = np.stack([np.cos(np.pi * k * x), np.sin(np.pi * k * x)], axis=1)
        assert np.sqrt(np.mean((halves @ beat - wanted) ** 2)) < 0.2


def test_a_term_that_is_another_at_one_site_is_found_there():
    """Damping at one site only: the catalogue has it everywhere, and a defect of the field."""
    system = systems.find("phi4")
    xi = system.truth(system.library("equation"), {})
    t, sites = np.linspace(0, 10, 50), 9
    draw = np.random.default_rng(4)

    def rate(_, y):
        u, v = np.split(y, 2)
        beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])
        force = xi[0] * (beside - 2 * u) + xi[1] * u + xi[2] * u**3
        force[6] -= 0.2 * v[6]
        return np.concatenate([v, force])

    start = np.concatenate([1 + 0.3 * draw.normal(size=sites), 0.3 * draw.normal(size=sites)])
    y = solve_ivp(rate, (0, 10), start, t_eval=t, rtol=1e-9, atol=1e-9).y.T
    noisy = y + 0.005 * np.std(y, axis=0) * draw.normal(size=y.shape)
    data = [Samples(t, noisy[:, :sites], noisy[:, sites:], source="absorber.csv", ends="free")]
    found = diagnose(system.library("equation"), 2, data, CATALOGUE)
    assert found.course.verdict == "unexplained"
    first = found.course.left[0]
    assert (first.name, first.placed.site) == ("a term that is another at one site", 6)


def test_a_drive_has_at_least_one_wave_in_the_record():
    """A slow drift is no oscillation, however well a piece of a long wave fits it."""
    system = systems.find("phi4")
    one = make(system, "other: drifting-stiffness", 30.0, np.random.default_rng(3), Conditions(**SMALL, variation=True))
    found = diagnose(
        library("declared", [term.text for term in system.library("equation").terms]), 2,
        [replace(one.samples.observed(), ends=system.ends)], CATALOGUE,
    )  # fmt: skip
    span = one.samples.t[-1] - one.samples.t[0]
    for turn in found.course.rounds:
        for entry in turn.ranking:
            effects = entry.fitted.model.effects if entry.fitted is not None else ()
            assert all(abs(placed.psi.get("omega", np.inf)) > 0.999 * 2 * np.pi / span for placed in effects)
