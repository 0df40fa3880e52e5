"""Tracing: chances far out in the tail, chances on noise alone, and the places and frequencies that are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from latticebench import systems
from latticebench.bench.trials.specimen import Conditions, make
from latticebench.diagnosis import trace
from latticebench.diagnosis.catalogued import candidates_of, frequencies, step_of
from latticebench.diagnosis.model import Model, cut, first_fit
from latticebench.diagnosis.placed import PlacedEffect
from latticebench.diagnosis.tangent import linearise
from latticebench.diagnosis.trace import Screened, rank, rarity, screen, tail
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

SMALL = {"sites": 9, "samples": 30, "span": 6.0}


def tangent_of(name, effect, z, seed, **options):
    """What the declared equation leaves of a specimen, and the specimen."""
    system = systems.find(name)
    specimen = make(system, effect, z, np.random.default_rng(seed), Conditions(**SMALL, **options))
    data = [replace(specimen.samples.observed(), ends=system.ends)]
    return linearise(first_fit(Model(system.library("equation"), system.order), data)), specimen


# Chances --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("columns", [1, 2, 3, 7, 20, 60])
def test_the_tail_is_that_of_chi_squared_wherever_scipy_can_tell(columns):
    gains = np.concatenate([np.linspace(0, 50, 40), np.linspace(51, 1400, 60)])
    exact = -chi2.logsf(gains, columns)
    told = np.isfinite(exact)
    assert np.max(gains[told]) > 1000
    np.testing.assert_allclose(tail(gains[told], columns), exact[told], rtol=2e-3, atol=1e-12)


@pytest.mark.parametrize("columns", [1, 2, 3, 7, 20, 60])
def test_the_tail_grows_without_a_jump_to_the_farthest(columns):
    switch = 2 * (300 + 2 * columns)
    below, above = tail(switch * (1 - 1e-12), columns), tail(switch * (1 + 1e-12), columns)
    assert above - below == pytest.approx(0, abs=0.1)
    gains = np.geomspace(1e-3, 1e8, 4000)
    assert np.all(np.isfinite(tail(gains, columns)))
    assert np.all(np.diff(tail(gains, columns)) >= 0)


def test_a_gain_below_zero_is_no_evidence():
    assert tail(-3.0, 2) == 0


def test_the_rarity_of_the_largest_of_many_is_that_of_many_tries():
    for tries in (2.0, 30.0, 1000.0):
        for single in (5.0, 12.0, 30.0):
            exact = -np.log(-np.expm1(tries * np.log1p(-np.exp(-single))))
            assert rarity(single, tries) == pytest.approx(exact, rel=0.02, abs=0.02)
    assert rarity(40.0, 1.0) == pytest.approx(40.0)
    assert rarity(1e6, 50.0) == pytest.approx(1e6 - np.log(50))
    assert 0 <= rarity(0.0, 1000.0) < 1e-6


def test_the_rarity_has_no_jump_and_never_falls():
    largest = np.linspace(0, 200, 2001)
    found = np.array([rarity(one, 30.0) for one in largest])
    assert np.all(np.diff(found) >= 0)
    assert np.max(np.diff(found)) < 0.11


def test_a_search_costs_its_evidence_the_log_of_its_tries():
    placed = PlacedEffect(find("defect"), ("u[n]",), site=2)
    one = Screened("defect", placed, 30.0, 1, 1.0, 0.0)
    many = Screened("defect", placed, 30.0, 1, 9.0, float(np.log(9)))
    assert one.evidence - many.evidence == pytest.approx(np.log(9))
    assert many.p == pytest.approx(9 * one.p, rel=1e-3)


# Noise alone ----------------------------------------------------------------------------------------------------------

PLAIN = {
    "phi4": ["damping", "quadratic-drag", "drive", "defect", "kick", "unequal-masses", "memory", "sensor-offset"],
    "dnls": ["damping", "drive", "defect", "gain-loss", "sensor-gain"],
}
DRAWS = 150


@pytest.mark.parametrize("name", PLAIN)
def test_on_noise_alone_an_effect_is_as_rare_as_its_p_says(name):
    tangent, _ = tangent_of(name, "none", 0, 0)
    groups = [(effect, True, candidates_of(tangent, find(effect))) for effect in (*PLAIN[name], "disorder")]
    assert all(tries for _, _, tries in groups)
    draw = np.random.default_rng(11)
    found = {effect: [] for effect, _, _ in groups}
    for _ in range(DRAWS):
        residual = trace.surrogate_residuals(tangent, draw, 1)[:, 0]
        for screened in rank(replace(tangent, residual=residual), groups, draw, 60):
            found[screened.name].append(screened.p)
    for effect, chances in found.items():
        for level in (0.05, 0.1, 0.2):
            share, spread = np.mean(np.array(chances) < level), np.sqrt(level * (1 - level) / DRAWS)
            assert share < level + 4 * spread, effect
            # A random effect's variance is tried in steps, which makes it somewhat rarer than it says.
            assert share > level / (4 if effect == "disorder" else 1) - 4 * spread, effect
    every = np.concatenate([chances for effect, chances in found.items() if effect != "disorder"])
    assert np.mean(every < 0.05) == pytest.approx(0.05, abs=0.025)
    assert np.mean(every < 0.2) == pytest.approx(0.2, abs=0.05)


def test_an_effect_that_the_equation_has_already_is_not_tried():
    tangent, _ = tangent_of("phi4", "none", 0, 0)
    for name in ("onsite-linear", "onsite-cubic"):
        assert candidates_of(tangent, find(name)) == []
    names = [one.name for one in screen(tangent, CATALOGUE, np.random.default_rng(0), 20)]
    assert not {"onsite-linear", "onsite-cubic", "known-input", "nonlinear-loss"} & set(names)
    assert {"damping", "drive", "defect", "ends", "sensor-offset"} <= set(names)


def test_noise_makes_no_effect_significant():
    from latticebench.diagnosis.significance import beyond_chance

    for seed in range(3):
        tangent, _ = tangent_of("phi4", "none", 0, seed, variation=True)
        assert beyond_chance(screen(tangent, CATALOGUE, np.random.default_rng(0), 60)) == ()


def test_pieces_of_a_record_are_searched_at_the_frequencies_of_the_whole():
    system = systems.find("phi4")
    one = make(system, "none", 0.0, np.random.default_rng(1), Conditions(sites=9, samples=60, span=12.0))
    whole = [replace(one.samples.observed(), ends=system.ends)]
    model = Model(system.library("equation"), system.order)
    found = [frequencies(linearise(first_fit(model, cut(whole, length)))) for length in (60, 12)]
    assert len(cut(whole, 12)) == 5
    np.testing.assert_allclose(found[1], found[0])
    assert found[0][0] == pytest.approx(2 * np.pi / (whole[0].t[-1] - whole[0].t[0]))


def test_a_strong_drive_is_among_the_frequencies_of_a_long_record_in_pieces():
    """One pendulum, pushed so that its equation without the push loses it within a few swings."""
    t = np.linspace(0, 60, 600)

    def rate(time, y):
        return [y[1], -np.sin(y[0]) + 0.2 * np.cos(0.7 * time)]

    y = solve_ivp(rate, (0, 60), [0.5, 0.0], t_eval=t, rtol=1e-9, atol=1e-9).y
    noisy = y + 0.005 * np.random.default_rng(1).normal(size=y.shape)
    whole = [Samples(t, noisy[:1].T, noisy[1:].T, source="pushed.csv")]
    found = frequencies(linearise(first_fit(Model(library("own", "sin(u[n])"), 2), cut(whole, 40))))
    assert len(found) < 60
    assert np.min(np.abs(found - 0.7)) < np.pi / 60


# Places and frequencies -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["phi4", "dnls"])
@pytest.mark.parametrize("effect", ["defect", "unequal-masses", "sensor-gain"])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_what_sits_at_one_site_is_found_at_that_site(name, effect, seed):
    tangent, specimen = tangent_of(name, effect, 25, seed, variation=True)
    found = screen(tangent, [find("damping"), find("drive"), find(effect)], np.random.default_rng(0), 20)
    best = next(one for one in found if one.named)
    assert best.name == effect
    assert best.placed.site == specimen.about["site"]
    assert best.p < 1e-6


@pytest.mark.parametrize("name", ["phi4", "dnls"])
@pytest.mark.parametrize("effect", ["drive", "parametric-drive"])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_frequency_of_a_drive_is_found_within_a_resolution_element(name, effect, seed):
    tangent, specimen = tangent_of(name, effect, 25, seed, variation=True)
    best = next(
        one for one in screen(tangent, [find("damping"), find(effect)], np.random.default_rng(0), 20) if one.named
    )
    assert best.name == effect
    assert abs(best.placed.psi["omega"] - specimen.about["omega"]) < 2 * np.pi / SMALL["span"]


def test_the_time_of_a_kick_is_found_within_its_width():
    tangent, specimen = tangent_of("phi4", "kick", 25, 1, variation=True)
    best = next(
        one for one in screen(tangent, [find("damping"), find("kick")], np.random.default_rng(0), 20) if one.named
    )
    assert best.name == "kick"
    assert abs(best.placed.psi["at"] - specimen.about["at"]) < max(specimen.about["width"], SMALL["span"] / 20)


# Rounding -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("step", "origin"), [(1.0, 0.0), (0.01, 0.0), (2 * np.pi / 40000, 0.3), (0.25, -7.1), (1e-6, 0.0)]
)
def test_the_step_of_readings_on_a_grid_is_found(step, origin):
    values = origin + step * np.random.default_rng(0).integers(-400, 400, size=900)
    assert step_of(values) == pytest.approx(step, rel=1e-6)
    assert step_of(np.append(values, np.nan)) == pytest.approx(step, rel=1e-6)


def test_readings_on_no_grid_have_no_step():
    draw = np.random.default_rng(0)
    for count in (10, 100, 3000):
        assert step_of(draw.normal(size=count)) == 0
    assert step_of(np.full(50, 3.0)) == 0
    assert step_of(np.array([1.0, 2.0])) == 0
    assert step_of(np.full(5, np.nan)) == 0


def test_rounded_readings_are_named_and_finely_rounded_ones_are_not():
    from latticebench.bench.trials.specimen import rounded

    tangent, _ = tangent_of("phi4", "quantisation", 20, 0)
    assert candidates_of(tangent, find("quantisation"))
    system = systems.find("phi4")
    specimen = make(system, "none", 0, np.random.default_rng(0), Conditions(**SMALL))
    samples = replace(
        specimen.samples.observed(), u=rounded(specimen.samples.u, 0.1 * specimen.samples.sigma), ends=system.ends
    )
    fine = linearise(first_fit(Model(system.library("equation"), 2), [samples]))
    assert candidates_of(fine, find("quantisation")) == []
