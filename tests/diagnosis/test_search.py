"""The search: what is looked for on which horizon."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench import systems
from latticebench.bench.trials.laboratory.making import make_recording
from latticebench.bench.trials.trial import Trial
from latticebench.diagnosis import pool, rules, worth
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.search import Search
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples


@pytest.fixture(scope="module")
def driven():
    """Forty periods of u'' = -u - 0.02 u' + 0.3 cos(0.6 t) + noise, declared without friction and without the force."""
    t = np.linspace(0, 80 * np.pi, 800)

    def rate(t, y):
        return [y[1], -y[0] - 0.02 * y[1] + 0.3 * np.cos(0.6 * t)]

    u = solve_ivp(rate, t[[0, -1]], [1.0, 0.0], t_eval=t, rtol=1e-10, atol=1e-12).y[:1].T
    return Samples(t, u + 0.05 * np.random.default_rng(5).normal(size=u.shape), source="spring", ends="free")


SPRING = library("spring", "u[n]")


def test_where_no_model_can_be_followed_further_what_acts_at_times_of_its_own_is_looked_for(driven, monkeypatch):
    monkeypatch.setattr(Search, "_carried", lambda *_: [])
    first, second = Search(Problem.of(SPRING, 2, [driven], CATALOGUE), lambda _: None).horizons()
    assert second.horizons[0].periods == second.horizons[1].periods < rules.PERIODS
    assert "drive" not in [one.effect.name for one in first.models[0].model.effects]
    assert "drive" in [one.effect.name for one in second.models[0].model.effects]


def test_a_weak_mode_of_a_long_recording_does_not_lead_the_coefficients_astray():
    """Three sites for 35 periods: a wave as weak as the noise tells coupling from spring, on long pieces only."""
    t, modes = np.linspace(0, 150, 550), [(1, 1, 1), (1, 0, -1), (1, -2, 1)]
    swings = zip((0.01, 0.18, 0.012), np.sqrt([1.0, 2.25, 4.75]), modes, strict=True)
    u = sum(size * np.outer(np.cos(omega * t + k), mode) for k, (size, omega, mode) in enumerate(swings))
    read = u + 0.008 * np.random.default_rng(3).standard_t(4, size=u.shape) / np.sqrt(2)
    names = ("ends", "damping", "onsite-cubic", "asymmetric-coupling")
    chain = library("chain", "u[n+1]+u[n-1]-2*u[n]; u[n]")
    data = Samples(t, read, source="chain", ends="free")
    found = diagnose(chain, 2, [data], [one for one in CATALOGUE if one.name in names])
    assert found.verdict == "nothing missing"
    np.testing.assert_allclose(found.declared[0], [1.25, -1.0], atol=0.003)


@pytest.mark.parametrize("seed", [503, 505, 522])
def test_the_declared_equation_is_not_lost_beside_its_best_fit_a_wave_of_a_weak_mode_away(seed):
    """Begun at once, or carried there from short pieces, one or the other is hundreds of nats behind."""
    recording = make_recording(seed, "proportional", (), sites=2)
    names = ("damping", "sensor-offset")
    catalogue = [one for one in CATALOGUE if one.name in names]
    problem = Problem.of(recording.declared, 2, [recording.samples], catalogue)
    search = Search(problem, lambda _: None)
    (found,) = search.horizons()
    assert found.whole
    true = replace(found.before.model, coefficients=tuple(recording.coefficients))
    best = search.refit(true, found.before.layout, found.before.followed.nodes, found.before, 25)
    assert found.before.cost < best.cost + 0.5
    assert found.models[0].model.names == ()


def test_two_effects_that_undo_one_another_do_not_lead_the_declared_equation_alone():
    """Springs at both outer sites of a chain with fixed ends make it a chain with free ones."""
    t, modes = np.linspace(0, 60, 300), [(1, 1, 1), (1, 0, -1), (1, -2, 1)]
    swings = zip((0.3, 0.2, 0.1), np.sqrt([1.0, 2.25, 4.75]), modes, strict=True)
    u = sum(size * np.outer(np.cos(omega * t + k), mode) for k, (size, omega, mode) in enumerate(swings))
    data = Samples(t, u + 0.01 * np.random.default_rng(3).normal(size=u.shape), source="chain", ends="free")
    catalogue = [one for one in CATALOGUE if one.name in ("ends", "disorder")]
    problem = Problem.of(library("chain", "u[n+1]+u[n-1]-2*u[n]; u[n]"), 2, [data], catalogue)
    search = Search(problem, lambda _: None)
    (found,) = search.horizons()
    other = next(one for one in problem.candidates if one.other_ends() == "fixed")
    springs = next(one for one in problem.candidates if one.effect.name == "disorder").moved([5 / 12, -10 / 12])
    plain = found.before
    # What a number of each site's own adds to is their mean.
    bound = replace(plain.model, coefficients=(1.25, -2 / 12))
    both = bound.with_effect(other).with_effect(springs)
    undone = search.refit(both, plain.layout, plain.followed.nodes, plain, 25)
    assert undone.cost < plain.cost + 1
    assert search._level([undone], plain)[0].model.names == ()


def test_readings_in_bursts_have_pieces_shorter_than_what_is_asked_for_and_an_end():
    """Bursts of twelve readings with gaps of thirty steps between them."""
    t = np.concatenate([0.2 * np.arange(12) + 8.2 * k for k in range(6)])
    u = np.outer(np.cos(t), [1.0, 0.9, 1.1]) + 0.02 * np.random.default_rng(1).normal(size=(len(t), 3))
    data = Samples(t, u, source="bursts", ends="free")
    catalogue = [one for one in CATALOGUE if one.name in ("damping", "sensor-offset")]
    found = diagnose(library("chain", "u[n+1]+u[n-1]-2*u[n]; u[n]"), 2, [data], catalogue)
    assert found.verdict == "nothing missing"


@pytest.mark.slow
def test_a_strong_force_below_the_motions_own_frequency_is_named(driven):
    found = diagnose(SPRING, 2, [driven], CATALOGUE)
    force, friction = found.findings
    assert found.verdict == "explained"
    assert force.name == "drive"
    assert force.placed.frequency == pytest.approx(0.6, abs=0.001)
    assert "damping" in (friction.name, *friction.alternatives)
    # The same by a clock that counts from 1970 on: the phase is known about the middle of the recording.
    later = diagnose(SPRING, 2, [replace(driven, t=driven.t + 1.7e9)], CATALOGUE)
    assert [one.name for one in later.findings] == [one.name for one in found.findings]
    sizes, same = (np.array(list(one.findings[0].values.values())) for one in (found, later))
    np.testing.assert_allclose(sizes[:, 0], same[:, 0], atol=0.02 * np.min(sizes[:, 1]))
    np.testing.assert_allclose(sizes[:, 1], same[:, 1], rtol=0.02)
    cosine, sine, _ = sizes
    assert np.hypot(cosine[0], sine[0]) == pytest.approx(0.3, abs=5 * cosine[1])
    assert np.max(sizes[:2, 1]) < 0.02


@pytest.mark.slow
def test_the_own_swing_of_a_driven_pendulum_is_not_taken_for_a_forces():
    """Fifteen swings of u'' = -440 sin u + 87 cos(9.1 t + 4), of 0.6 rad, read with an offset."""
    t = np.linspace(0, 4.4, 500)
    u = solve_ivp(
        lambda t, y: [y[1], -440 * np.sin(y[0]) + 87 * np.cos(9.1 * t + 4)], t[[0, -1]], [0.5, -3.0], t_eval=t,
        rtol=1e-10, atol=1e-12,
    ).y[:1].T  # fmt: skip
    read = u + 0.44 + 0.02 * np.random.default_rng(2).normal(size=u.shape)
    found = diagnose(library("pendulum", "sin(u[n])"), 2, [Samples(t, read, source="pendulum", ends="free")], CATALOGUE)
    assert found.verdict == "explained"
    assert sorted(one.name for one in found.findings) == ["drive", "sensor-offset"]
    (drive,) = [one for one in found.findings if one.name == "drive"]
    assert drive.placed.frequency == pytest.approx(9.1, abs=0.02)
    assert found.declared[1][0] == pytest.approx(-440, rel=0.01)


@pytest.mark.parametrize(("behind", "goes_along"), [(1e9, True), (0.0, False)])
def test_the_best_model_without_a_force_goes_along_if_it_is_not_too_far_behind(behind, goes_along, driven, monkeypatch):
    monkeypatch.setattr(rules, "PLAINER", behind)
    horizons = Search(Problem.of(SPRING, 2, [driven], CATALOGUE), lambda _: None).horizons()
    found = next(one for one in horizons if one.models[0].model.may_stand_in)
    assert [one.model.may_stand_in for one in found.models] == [True] * rules.RIVALS + [False] * goes_along
    assert np.all(np.diff([behind for _, behind in found.horizons[-1].models]) >= 0)


@pytest.mark.parametrize(("behind", "goes_along"), [(29.0, True), (31.0, False)])
def test_the_best_model_with_two_effects_less_goes_along_if_it_is_not_too_far_behind(behind, goes_along, monkeypatch):
    def model(value, count):
        return SimpleNamespace(worth=value, model=SimpleNamespace(effects=range(count), may_stand_in=False))

    leading = [model(0.0, 5), model(1.0, 4), model(2.0, 4)]
    lean = [model(behind, 2), model(behind + 0.5, 1), model(3.0, 3)]
    monkeypatch.setattr(pool, "same", lambda one, other: False)
    models = pool.Pool(None, [])
    models.worth = SimpleNamespace(value=lambda one: one.worth)
    models._kept = dict(enumerate([*lean, *leading]))
    assert models.leading() == [*leading, *lean[:1]][: 3 + goes_along]


@pytest.mark.parametrize("omega", [0.7, 3.0])
def test_the_fastest_motion_of_a_spring_is_its_own_and_of_what_relaxes_its_rate(omega, driven):
    t = np.linspace(0, 40, 400)
    noise = 1e-4 * np.random.default_rng(6).normal(size=(400, 1))
    swing, decay = (replace(driven, t=t, u=u[:, None] + noise) for u in (np.cos(omega * t), np.exp(-omega * t)))
    problem = Problem.of(SPRING, 2, [swing], CATALOGUE)
    assert problem.fastest == pytest.approx(problem.top) == pytest.approx(omega, rel=0.05)
    problem = Problem.of(SPRING, 1, [decay], CATALOGUE)
    # The root mean square of the slope is sqrt(omega / 2 span), the deviation nearly sqrt(1 / 2 omega span).
    assert problem.fastest == pytest.approx(omega, rel=0.2)
    assert problem.top < 0.7 * omega


@pytest.mark.slow
def test_other_ends_than_those_declared_are_found_in_a_chain_that_relaxes():
    system, trial = systems.find("ginzburg-landau"), Trial(system="ginzburg-landau", effect="ends", z=5, seed=80)
    samples = replace(trial.recording(system).samples, ends=system.ends)
    found = diagnose(system.library("equation"), 1, [samples], CATALOGUE)
    assert [one.name for one in found.findings] == ["ends"]
    assert found.verdict == "explained"


@pytest.mark.slow
def test_a_force_that_does_as_well_as_a_modulation_is_named_beside_it():
    """By its score alone the force comes to a third of what the modulation brings when it is fitted."""
    recording = make_recording(90035, effects=("drive", "sensor-offset"), sites=1)
    found = diagnose(recording.declared, recording.order, [recording.samples], CATALOGUE)
    assert [one for one in found.findings if "drive" in (one.name, *one.alternatives)]


def test_a_heater_that_is_on_for_a_while_is_named_though_temperatures_relax():
    t, at, width = np.arange(0, 400, 1.0), 120.0, 25.0

    def rate(t, u):
        beyond = np.concatenate([u[:1], u, u[-1:]])
        heat = 0.5 * np.exp(-(((t - at) / width) ** 2) / 2) * np.eye(5)[1]
        return 0.02 * np.diff(beyond, 2) - 0.002 * u + heat

    u = solve_ivp(rate, t[[0, -1]], [30.0, 10.0, 0.0, 5.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-9).y.T
    read = u + [0.5, -0.2, 0.3, -0.1, 0.2] + 0.05 * np.random.default_rng(5).normal(size=u.shape)
    data = Samples(t, read, source="rod", ends="free")
    found = diagnose(library("rod", "u[n+1]+u[n-1]-2*u[n]"), 1, [data], CATALOGUE)
    effects = {one.name: one for one in found.findings}
    assert (found.verdict, set(effects)) == ("explained", {"sensor-offset", "damping", "local-kick"})
    assert effects["local-kick"].site == 1
    for name, true in (("at", at), ("width", width)):
        value, error = effects["local-kick"].values[name]
        assert value == pytest.approx(true, abs=4 * error)


@pytest.mark.slow
def test_taps_by_hand_are_each_named_though_one_effect_follows_all_pieces_between_them():
    """Three pendula, of which the first is tapped three times: pieces must not grow past the taps at once."""
    t, taps, width = np.arange(0, 40, 0.03), {6.0: 6.4, 17.3: -4.8, 29.0: 5.6}, 0.05

    def rate(t, y):
        u, v = np.split(y, 2)
        beyond = np.concatenate([u[:1], u, u[-1:]])
        force = sum(size * np.exp(-(((t - at) / width) ** 2) / 2) for at, size in taps.items())
        return np.concatenate([v, 2 * np.diff(beyond, 2) - 15 * np.sin(u) - 0.1 * v + force * np.eye(3)[0]])

    u = solve_ivp(rate, t[[0, -1]], [0.3, 0, 0.1, 0, 0, 0], t_eval=t, rtol=1e-9, atol=1e-11, max_step=0.03).y[:3].T
    data = Samples(t, u + 0.002 * np.random.default_rng(77).normal(size=u.shape), source="pendula", ends="free")
    some = [one for one in CATALOGUE if one.name.endswith(("damping", "drag", "-kick", "-drive", "-hum"))]
    found = diagnose(library("pendula", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])"), 2, [data], some)
    names = sorted(one.name for one in found.findings)
    assert (found.verdict, names) == ("explained", ["damping", *["local-kick"] * 3])
    times = sorted(one.values["at"][0] for one in found.findings if one.name == "local-kick")
    np.testing.assert_allclose(times, sorted(taps), atol=0.005)


@pytest.mark.parametrize(("over", "lengths"), [(1.2, [200]), (5.0, [200, 100]), (None, [200, 100])])
def test_a_model_that_does_not_follow_what_it_has_not_seen_is_shown_it_on_the_same_horizon(
    over, lengths, driven, monkeypatch
):
    """It leaves `over` times the noise of all readings on longer pieces, or cannot be followed there."""

    def fit(key, over, readings):
        return SimpleNamespace(
            over=over, model=SimpleNamespace(key=key), layout=SimpleNamespace(readings=lambda: readings)
        )

    def carried(_, last, length):
        asked.append(length)
        plain = fit((), 9.0, 800)
        return [plain, *([] if over is None else [fit(("damping",), over, 800)]), plain]

    monkeypatch.setattr(worth, "beyond", lambda _, one: one.over)
    monkeypatch.setattr(Search, "_carried", carried)
    search, asked = Search(Problem.of(SPRING, 2, [driven], CATALOGUE), lambda _: None), []
    last = SimpleNamespace(models=(fit(("damping",), 1.1, 400),))
    found, length = search._ahead(last, [200], 100)
    assert (asked, length, bool(found)) == (lengths, lengths[-1], True)
    # Once all has been seen, pieces grow.
    assert search._ahead(last, [400], 200)[1] == 400
