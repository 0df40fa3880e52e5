"""The diagnosis names what is missing, adds it and nothing else, and says so when it does not know."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from latticebench import systems
from latticebench.bench.trials.specimen import Conditions, make
from latticebench.diagnosis.model import Model, first_fit
from latticebench.diagnosis.offsets import FORCES
from latticebench.diagnosis.polish import polish
from latticebench.diagnosis.reconsider import pruned
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.residual import residual_rms
from latticebench.diagnosis.search import search
from latticebench.diagnosis.tangent import linearise
from latticebench.diagnosis.trace import screen
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.readers import read_all
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import simulate

GLIDERS = Path(__file__).parents[4] / "shared" / "data" / "measured" / "gliders.csv"


@functools.cache
def looped(name, effect, z=30, seed=1, sites=9):
    """A specimen, the course of the search on it, and the true noise on u and v, each real part."""
    system = systems.find(name)
    draw = np.random.default_rng(seed)
    specimen = make(system, effect, z, draw, Conditions(sites=sites, samples=40, span=8.0, variation=True))
    data = [replace(specimen.samples.observed(), ends=system.ends)]
    declared = system.library("equation")
    course = search(Model(declared, system.order), data, CATALOGUE, np.random.default_rng(0), surrogates=100)
    sigma = [np.std(specimen.samples.u - specimen.clean.u) / np.sqrt(1 + system.is_complex)]
    if system.order == 2:
        sigma.append(np.std(specimen.samples.v - specimen.clean.v))
    return specimen, course, np.array(sigma)


def names(course):
    return [placed.effect.name for placed in course.after.model.effects]


def errors(name, course):
    """Relative error of the declared coefficients, before and after."""
    system = systems.find(name)
    truth = system.truth(system.library("equation"), {})
    return [
        np.linalg.norm(one.solution.state.coefficients[: len(truth)] - truth) / np.linalg.norm(truth)
        for one in (course.before, course.after)
    ]


# Effects whose lack shifts the declared coefficients, on lattices of both orders.
PAIRS = [
    ("phi4", "damping"), ("phi4", "drive"), ("phi4", "defect"), ("sine-gordon", "unequal-masses"),
    ("dnls", "sensor-gain"), ("ginzburg-landau", "gain-loss"),
]  # fmt: skip
FURTHER = [("phi4", "trap"), ("sine-gordon", "sensor-offset"), ("phi4", "next-neighbour"), ("dnls", "trap")]
EACH = [*PAIRS, *(pytest.param(*pair, marks=pytest.mark.slow) for pair in FURTHER)]


@pytest.mark.parametrize(("name", "effect"), EACH)
def test_the_effect_that_is_missing_is_the_one_that_is_added(name, effect):
    specimen, course, _ = looped(name, effect)
    assert names(course) == [effect]
    assert course.verdict == "explained"
    assert course.rounds[0].added == effect
    assert next(one.name for one in course.rounds[0].ranking if one.screened.named) == effect
    assert len(course.equal) == 1
    assert len(course.equal[0]) <= 1
    if effect in ("defect", "sensor-offset", "unequal-masses", "sensor-gain"):
        assert course.after.model.effects[0].site == specimen.about["site"]


@pytest.mark.parametrize(("name", "effect"), EACH)
def test_after_the_cure_only_noise_is_left(name, effect):
    _, course, sigma = looped(name, effect)
    assert residual_rms(course.before, sigma) > 1.1
    assert residual_rms(course.after, sigma) == pytest.approx(1, abs=0.1)
    assert course.left == ()


@pytest.mark.slow
def test_after_the_cure_the_declared_coefficients_are_nearer_to_the_truth():
    """On the whole: of one recording the noise may have hidden the shift."""
    before, after = np.transpose([errors(name, looped(name, effect)[1]) for name, effect in [*PAIRS, *FURTHER]])
    assert np.exp(np.mean(np.log(after / before))) < 0.6
    assert np.mean(after < before) >= 0.8


@pytest.mark.parametrize(
    ("name", "effect", "sign"),
    [
        ("phi4", "damping", -1), ("phi4", "defect", 1), pytest.param("phi4", "trap", 1, marks=pytest.mark.slow),
        pytest.param("phi4", "next-neighbour", 1, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_its_coefficient_is_the_one_that_is_in_the_data(name, effect, sign):
    specimen, course, _ = looped(name, effect)
    count = len(course.before.model.declared.terms)
    found = course.after.solution.state.coefficients[count]
    error = np.sqrt(np.diag(course.after.solution.covariance))[count]
    assert found == pytest.approx(sign * np.real(specimen.amount), abs=4 * error)
    assert error < abs(found) / 10


def test_the_parameter_that_was_searched_is_within_its_error():
    specimen, course, _ = looped("phi4", "drive")
    placed = course.after.model.effects[0]
    assert abs(placed.psi["omega"] - specimen.about["omega"]) < 4 * course.after.psi_errors[0]["omega"]
    specimen, course, _ = looped("sine-gordon", "unequal-masses")
    placed = course.after.model.effects[0]
    assert abs(placed.psi["scale"] - np.real(specimen.amount)) < 4 * course.after.psi_errors[0]["scale"]
    assert course.after.psi_errors[0]["scale"] < abs(placed.psi["scale"]) / 10


@pytest.mark.parametrize("name", ["phi4", "sine-gordon", "dnls", "ginzburg-landau"])
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_where_nothing_is_missing_nothing_is_added(name, seed):
    _, course, sigma = looped(name, "none", 0, seed)
    assert course.verdict == "nothing missing"
    assert names(course) == []
    assert course.after is course.before
    assert course.equal == ()
    assert residual_rms(course.after, sigma) == pytest.approx(1, abs=0.1)


OUTSIDE = [
    ("phi4", "other: weak-bond"), ("sine-gordon", "other: friction-between"),
    pytest.param("phi4", "other: friction-between", marks=pytest.mark.slow),
    pytest.param("dnls", "other: weak-bond", marks=pytest.mark.slow),
]  # fmt: skip


@pytest.mark.parametrize(("name", "effect"), OUTSIDE)
def test_what_is_outside_the_catalogue_gets_no_wrong_name(name, effect):
    _, course, sigma = looped(name, effect)
    assert course.verdict in ("unexplained", "partly explained")
    assert course.left
    assert residual_rms(course.after, sigma) > 1.1


@pytest.mark.slow
def test_forces_that_no_offset_of_a_sensor_makes_are_not_the_sensors():
    """Where the chain is not linear, a push at each site is another thing than a reading that is lifted."""
    _, pushed, _ = looped("sine-gordon", "other: uneven-floor", sites=15)
    assert pushed.verdict == "partly explained"
    assert pushed.rival is not None
    assert pushed.rival[0] == FORCES
    _, lifted, _ = looped("sine-gordon", "sensor-offset", sites=15)
    assert names(lifted) == ["sensor-offset"]
    assert (lifted.verdict, lifted.rival) == ("explained", None)


@pytest.mark.slow
def test_dry_friction_is_named_and_fitted_to_the_end_though_its_sign_jumps():
    specimen, course, _ = looped("sine-gordon", "dry-friction")
    assert names(course)[:1] == ["dry-friction"]
    assert course.after.solution.converged
    found = course.after.solution.state.coefficients[2]
    error = np.sqrt(np.diag(course.after.solution.covariance))[2]
    assert found == pytest.approx(-np.real(specimen.amount), abs=4 * error)
    assert course.verdict == "explained"


# Two at once ----------------------------------------------------------------------------------------------------------


def two_at_once():
    """A damped and driven chain whose third sensor has an offset, written out and integrated by SciPy."""
    t = np.linspace(0, 12, 80)

    def rate(t, y):
        u, v = np.split(y, 2)
        beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])
        return np.concatenate([v, 0.9 * (beside - 2 * u) - u - 0.4 * u**3 - 0.03 * v])

    n = np.arange(9)
    start = np.concatenate([np.sin(1 + 0.7 * n), 0.5 * np.cos(n)])
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-10, atol=1e-11).y.T
    draw = np.random.default_rng(3)
    u, v = (part + 0.005 * draw.normal(size=part.shape) for part in (y[:, :9], y[:, 9:]))
    u[:, 2] += 0.03
    return Samples(t, u, v, ends="free")


def driven_chain(force):
    """Twelve masses between walls, each pushed by the same force of the time: noisy u and v at 90 times."""
    t, sites = np.linspace(0, 18, 90), 12

    def rate(time, y):
        u, v = np.split(y, 2)
        padded = np.concatenate([[0.0], u, [0.0]])
        return np.concatenate([v, padded[2:] + padded[:-2] - 2 * u - 0.4 * u + force(time)])

    draw = np.random.default_rng(5)
    start = np.concatenate([draw.normal(size=sites), draw.normal(size=sites)])
    y = solve_ivp(rate, (0, 18), start, t_eval=t, rtol=1e-9, atol=1e-9).y.T
    noisy = y + 0.01 * np.std(y, axis=0) * draw.normal(size=y.shape)
    data = Samples(t, noisy[:, :sites], noisy[:, sites:], source="chain.csv", ends="fixed")
    return diagnose(library("own", "u[n+1]+u[n-1]-2*u[n]; u[n]"), 2, [data], CATALOGUE)


@pytest.mark.parametrize(
    "size", [0.2, pytest.param(0.02, marks=pytest.mark.slow), pytest.param(2.0, marks=pytest.mark.slow)]
)
def test_a_drive_is_found_however_strong_it_is(size):
    found = driven_chain(lambda t: size * np.cos(2.2 * t - 1))
    assert found.course.verdict == "explained"
    (placed,) = found.course.after.model.effects
    assert placed.effect.name == "drive"
    assert placed.psi["omega"] == pytest.approx(2.2, abs=0.05 if size < 0.1 else 0.005)
    assert found.residual[1] < 1.1


@pytest.mark.slow
def test_harmonics_that_stand_for_another_course_are_no_explanation():
    """A motion that is pushed by three waves of no common frequency has no drive, however well a few of them do."""
    found = driven_chain(lambda t: 0.05 * (np.cos(0.9 * t) + np.cos(1.7 * t + 1) + np.cos(2.9 * t + 2)))
    assert found.course.verdict in ("unexplained", "partly explained")


@pytest.mark.slow
def test_names_that_leave_the_readings_lost_are_not_given():
    """Forces as strong as the motion that look like noise: whatever comes nearest explains next to nothing of them."""
    draw = np.random.default_rng(8)
    t, sites = np.linspace(0, 12, 60), 8
    pushes = CubicSpline(np.linspace(0, 12, 60), 0.8 * draw.normal(size=(60, sites)))

    def rate(time, y):
        u, v = np.split(y, 2)
        padded = np.concatenate([[0.0], u, [0.0]])
        return np.concatenate([v, padded[2:] + padded[:-2] - 2 * u - 0.4 * u + pushes(time)])

    y = solve_ivp(rate, (0, 12), draw.normal(size=2 * sites), t_eval=t, rtol=1e-8, atol=1e-8).y.T
    noisy = y + 0.01 * np.std(y, axis=0) * draw.normal(size=y.shape)
    data = Samples(t, noisy[:, :sites], noisy[:, sites:], source="pushed.csv", ends="fixed")
    found = diagnose(library("own", "u[n+1]+u[n-1]-2*u[n]; u[n]"), 2, [data], CATALOGUE)
    assert found.course.verdict == "unexplained"
    assert found.course.after is found.course.before
    assert all(turn.added is None for turn in found.course.rounds)
    assert found.course.left


@pytest.mark.slow
def test_disorder_has_a_mean_of_its_own_where_the_equation_has_no_such_term():
    """Sine-Gordon declares sin u and no u: the sites' coefficients are those that were put in, not their deviations."""
    t, sites = np.linspace(0, 8, 60), 9
    draw = np.random.default_rng(2)
    each = 0.25 * draw.normal(size=sites)

    def rate(_, y):
        u, v = np.split(y, 2)
        beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])
        return np.concatenate([v, 0.5 * (beside - 2 * u) - np.sin(u) + each * u])

    y = solve_ivp(rate, (0, 8), 1.5 * draw.normal(size=2 * sites), t_eval=t, rtol=1e-9, atol=1e-9).y.T
    noisy = y + 0.005 * np.std(y, axis=0) * draw.normal(size=y.shape)
    system = systems.find("sine-gordon")
    data = Samples(t, noisy[:, :sites], noisy[:, sites:], source="uneven.csv", ends="free")
    found = diagnose(system.library("equation"), 2, [data], CATALOGUE)
    (placed,) = found.course.after.model.effects
    assert placed.effect.name == "disorder"
    solution = found.course.after.solution
    fitted, error = solution.state.coefficients[2:], np.sqrt(np.diag(solution.covariance))[2:]
    assert len(fitted) == sites
    assert np.max(np.abs(fitted - each) / error) < 4


def test_of_two_effects_at_once_both_are_found_with_their_sizes():
    declared = library("duffing", ["u[n+1]+u[n-1]-2*u[n]", "u[n]", "u[n]**3"])
    truth = np.array([0.9, -1.0, -0.4])
    watched = []
    found = diagnose(declared, 2, [two_at_once()], CATALOGUE, watcher=watched.append).against(truth)
    course = found.course
    assert sorted(names(course)) == ["damping", "sensor-offset"]
    assert course.verdict == "explained"
    assert [one.added for one in course.rounds] == [*names(course), None]
    assert course.after.solution.state.coefficients[3] == pytest.approx(-0.03, abs=0.003)
    offset = next(one for one in course.after.model.effects if one.effect.name == "sensor-offset")
    assert offset.psi["real_3"] == pytest.approx(0.03, abs=0.003)
    assert found.noise == pytest.approx(0.005, rel=0.1)
    assert found.residual[0] > 1.5
    assert found.residual[1] == pytest.approx(1, abs=0.1)
    assert found.coefficients[1] < found.coefficients[0] < 0.2
    assert found.forecast[1] < found.forecast[0]
    assert found.criterion[1] < found.criterion[0] - 100
    assert len(watched) > 4


def test_late_rows_stay_when_another_effect_is_added():
    """However many rows there are, that they are late is one thing: the variance of how late."""
    system = systems.find("phi4")
    one = make(
        system, "damping+clock", 13, np.random.default_rng(4), Conditions(sites=9, samples=40, span=8.0, variation=True)
    )
    data = [replace(one.samples.observed(), ends=system.ends)]
    fitted = first_fit(Model(system.library("equation"), system.order), data)
    for name in ("clock", "damping"):
        found = screen(linearise(fitted), [find(name)], np.random.default_rng(0), 20)
        placed = next(screened.placed for screened in found if screened.name == name)
        with_it = polish(fitted.model.with_effect(placed), fitted)
        assert with_it is not None
        fitted = with_it
    smaller, _ = pruned(fitted, ((), ()), all_of_them=True)
    assert [placed.effect.name for placed in smaller.model.effects] == ["clock", "damping"]


def test_the_truth_of_simulated_samples_is_not_looked_at_and_the_same_seed_gives_the_same_course():
    specimen, _, _ = looped("phi4", "damping")
    system = systems.find("phi4")
    lie = replace(
        specimen.samples, exact=replace(specimen.clean, u=1e3 * specimen.clean.u), sigma=99.0, ends=system.ends
    )
    plain = replace(specimen.samples, ends=system.ends)
    one, other = (diagnose(system.library("equation"), 2, [data], CATALOGUE) for data in (lie, plain))
    assert one.residual == other.residual
    assert names(one.course) == names(other.course) == ["damping"]
    assert one.coefficients is None


# Measured data --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(not GLIDERS.exists(), reason=f"{GLIDERS} is not there: `latticebench data` says where to get it")
def test_of_the_measured_gliders_the_offsets_and_the_unequal_masses_are_named():
    declared = library("uniform", ["u[n+1]+u[n-1]-2*u[n]", "u[n]"])
    found = diagnose(declared, 2, read_all([GLIDERS], "fixed"), CATALOGUE)
    present = names(found.course)
    equal = {name for group in found.course.equal for name in group}
    assert "unequal-masses" in present
    assert present[0] == "sensor-offset"
    assert {"damping", "quadratic-drag"} & {*present, *equal}
    placed = next(one for one in found.course.after.model.effects if one.effect.name == "unequal-masses")
    scale = 1 + placed.psi["scale"]
    assert max(scale, 1 / scale) == pytest.approx(2.48, rel=0.03)
    assert found.residual[0] > 5
    assert found.residual[1] < 2
    assert found.forecast[1] < 0.2 * found.forecast[0]


# Small and ragged recordings ------------------------------------------------------------------------------------------


def waves(rows, sites, velocities, seed=0):
    draw = np.random.default_rng(seed)
    t = 0.2 * np.arange(rows)
    phase = t[:, None] + np.arange(sites)
    noise = 0.01 * draw.normal(size=(2, rows, sites))
    return Samples(t, np.cos(phase) + noise[0], -np.sin(phase) + noise[1] if velocities else None, ends="free")


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize(("rows", "sites"), [(2, 9), (3, 9), (4, 9), (3, 1), (5, 1), (12, 1), (12, 2)])
def test_a_recording_of_a_few_rows_or_sites_has_a_verdict_or_a_reason(rows, sites, velocities):
    declared = library("x", ["u[n]", "u[n]**3"])
    try:
        verdict = diagnose(declared, 2, [waves(rows, sites, velocities)], CATALOGUE).course.verdict
    except InputError as error:
        verdict = str(error).splitlines()[0]
    assert verdict


@pytest.mark.parametrize(("rows", "sites", "velocities"), [(24, 1, False), (20, 1, True)])
def test_a_handful_of_readings_is_no_reason_for_a_claim(rows, sites, velocities):
    declared = library("x", ["u[n]", "u[n]**3"])
    data = [waves(rows, sites, velocities, seed) for seed in range(8)]
    verdicts = [diagnose(declared, 2, [one], CATALOGUE).course.verdict for one in data]
    assert verdicts.count("nothing missing") >= 7


def test_fewer_readings_than_a_test_needs_are_refused_with_their_number():
    with pytest.raises(InputError, match="12 readings are too few for 4 unknowns"):
        diagnose(library("x", ["u[n]", "u[n]**3"]), 2, [waves(12, 1, False)], CATALOGUE)


def test_a_motion_without_noise_is_no_reason_for_a_claim():
    phi4 = systems.find("phi4")
    found = diagnose(phi4.library("equation"), 2, [replace(simulate(phi4, sites=9), ends="free")], CATALOGUE)
    assert found.course.verdict == "nothing missing"


def test_what_does_not_move_is_refused():
    still = Samples(np.arange(50.0), np.zeros((50, 3)), ends="free")
    with pytest.raises(InputError, match="nothing moves"):
        diagnose(library("x", ["u[n]"]), 2, [still], CATALOGUE)


@pytest.mark.parametrize(
    ("terms", "missing"),
    [
        ("u[n+1]+u[n-1]-2*u[n]", {"damping", "onsite-linear"}),
        ("u[n+1]+u[n-1]-2*u[n]; u[n]", set()),
        ("u[n]", None),
    ],
)  # fmt: skip
def test_a_real_chain_of_first_order_is_looked_at_as_any_other(terms, missing):
    """A ladder of resistors and capacitors with a leak, solved in closed form by its modes.

    u' = u_{n+1} + u_{n-1} - 2 u_n - 0.3 u_n
    """
    sites, t = 8, np.linspace(0, 4, 40)
    draw = np.random.default_rng(2)
    exchange = np.eye(sites, k=1) + np.eye(sites, k=-1) - 2 * np.eye(sites)
    rates, modes = np.linalg.eigh(exchange - 0.3 * np.eye(sites))
    u = (np.exp(t[:, None] * rates) * (modes.T @ draw.normal(size=sites))) @ modes.T
    data = Samples(t, u + 0.002 * draw.normal(size=u.shape), None, source="ladder.csv", ends="fixed")
    course = diagnose(library("own", terms), 1, [data], CATALOGUE).course
    if missing is None:
        assert course.verdict != "nothing missing"
    else:
        assert {*names(course), *(name for alike in course.equal for name in alike)} == missing


def test_trajectories_of_different_lengths_are_looked_at_together():
    data = [waves(30, 3, True), waves(10, 3, True, 1), waves(11, 3, True, 2)]
    found = diagnose(library("x", ["u[n]", "u[n]**3"]), 2, data, CATALOGUE)
    assert found.course.verdict == "nothing missing"


@pytest.mark.slow
def test_a_friction_that_drives_is_none():
    """u'' = -u + 0.02 sign(v), or - 0.02 sign(v), solved piece by piece between the turns: circles about +-0.02."""
    t = np.linspace(0, 20, 200)
    draw = np.random.default_rng(8)
    found = {}
    for sign in (1, -1):
        u, v, now, rows = 1.0, 0.0, 0.0, []
        for turn in np.arange(np.pi, 30, np.pi):
            centre = sign * 0.02 * (-1 if u > 0 else 1)
            inside = t[(t >= now) & (t < turn)] - now
            rows += [(centre + (u - centre) * np.cos(s), -(u - centre) * np.sin(s)) for s in inside]
            u, now = centre - (u - centre), turn
        u, v = (np.array(part)[:, None] + 0.002 * draw.normal(size=(len(t), 1)) for part in zip(*rows, strict=True))
        course = diagnose(library("own", ["u[n]"]), 2, [Samples(t, u, v, ends="free", source="x")], CATALOGUE).course
        found[sign] = names(course)
    assert found[-1] == ["dry-friction"]
    assert "dry-friction" not in found[1]
    assert "quadratic-drag" not in found[1]
