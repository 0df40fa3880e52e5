"""Following a model: gaps are closed to the true motion, readings are undone, and the noise of each sensor is found."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from latticebench.diagnosis import rules
from latticebench.diagnosis.fitting import fit
from latticebench.diagnosis.horizon import Layout, follow
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Structure
from latticebench.diagnosis.problem import FARTHER, LONG, WINDOWS, Problem, thinned, windows
from latticebench.diagnosis.readout import unread
from latticebench.diagnosis.regression import regressed
from latticebench.diagnosis.spectrum import hidden
from latticebench.diagnosis.worth import Worth, misfits
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

SITES = 4
DECLARED, TRUTH = library("chain", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])"), (2.0, -3.0)


def rate(_, y):
    u, v = np.split(y, 2)
    beside = np.concatenate([u[1:], u[-1:]]) + np.concatenate([u[:1], u[:-1]])
    return np.concatenate([v, 2.0 * (beside - 2 * u) - 3.0 * np.sin(u)])


def motion(t):
    start = np.concatenate([0.7 * np.cos(2 * np.arange(SITES)), np.zeros(SITES)])
    return solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-12, atol=1e-13).y.T


def recording(t, noise=0.01, seed=0, *, velocities=True):
    """Positions with noise, in which a size may be given for each sensor, and velocities."""
    y = motion(t)
    y = y + noise * np.random.default_rng(seed).normal(size=y.shape)
    return Samples(t, y[:, :SITES], y[:, SITES:] if velocities else None, source="chain", ends="free")


def followed(problem, layout, model, small=1e-9):
    """The motion from near the smoothed readings, and then more and more exactly."""
    states = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    for size in (1e-3, small):
        finer = replace(layout, small=size).with_substeps(model, states, problem.top)
        path = follow(model, finer, states)
        if path is None:
            return None
        states = path.nodes
    return path


EVEN = np.linspace(0, 20, 400)
UNEVEN = np.sort(np.random.default_rng(3).uniform(0, 20, 400))


@pytest.mark.parametrize("t", [EVEN, UNEVEN, EVEN[::4]], ids=["even", "uneven", "sparse"])
def test_closing_the_gaps_gives_the_motion_that_an_integrator_gives(t):
    problem = Problem.of(DECLARED, 2, [recording(t, 0.003)], CATALOGUE)
    layout = Layout.of(problem, len(t), None, 1e-5)
    path = followed(problem, layout, Model(DECLARED, 2, TRUTH))
    found = path.nodes[0][0]
    exact = solve_ivp(rate, t[[0, -1]], found[0], t_eval=t, method="DOP853", rtol=1e-12, atol=1e-13).y.T
    np.testing.assert_allclose(found, exact, atol=1e-6)


@pytest.mark.parametrize("length", [7, 50, 399])
def test_pieces_have_every_row_once_and_each_follows_from_its_own_start(length):
    problem = Problem.of(DECLARED, 2, [recording(EVEN)], CATALOGUE)
    layout = Layout.of(problem, length, None, 1e-5)
    rows, valid = layout.rows[0], layout.valid[0]
    assert sorted(rows[valid]) == list(range(len(EVEN)))
    path = followed(problem, layout, Model(DECLARED, 2, TRUTH))
    for piece, own, seen in zip(path.nodes[0][::20], rows[::20], valid[::20], strict=True):
        t = EVEN[own[seen]]
        exact = solve_ivp(rate, t[[0, -1]], piece[0], t_eval=t, rtol=1e-10, atol=1e-11).y.T
        np.testing.assert_allclose(piece[seen], exact, atol=1e-6)


def test_of_readings_far_apart_the_integrator_is_one_that_is_right_not_one_that_may_take_no_more_steps():
    t = EVEN[::24]
    problem = Problem.of(DECLARED, 2, [recording(t, 0)], CATALOGUE)
    layout = Layout.of(problem, len(t), None, 1e-8)
    path = followed(problem, layout, Model(DECLARED, 2, TRUTH), small=1e-8)
    found = path.nodes[0][0]
    exact = solve_ivp(rate, t[[0, -1]], found[0], t_eval=t, method="DOP853", rtol=1e-12, atol=1e-13).y.T
    np.testing.assert_allclose(found, exact, atol=1e-7)


def test_a_model_that_runs_away_is_not_followed():
    problem = Problem.of(DECLARED, 2, [recording(EVEN)], CATALOGUE)
    layout = Layout.of(problem, len(EVEN), None, 1e-4)
    assert followed(problem, layout, Model(DECLARED, 2, (-300.0, 200.0))) is None


@pytest.mark.parametrize("name", ["sensor-offset", "sensor-gain", "sensor-curve", "sensor-saturation"])
@pytest.mark.parametrize("velocities", [False, True])
def test_unread_undoes_what_instruments_do(name, velocities):
    problem = Problem.of(DECLARED, 2, [recording(EVEN, 0.0, velocities=velocities)], CATALOGUE)
    layout = Layout.of(problem, len(EVEN), None, 1e-4)
    for placed in (one for one in problem.candidates if one.effect.name == name):
        strong = placed.moved(np.full(len(placed.strength), 0.15))
        model = Model(DECLARED, 2, TRUTH, (strong,))
        field = motion(EVEN).reshape(len(EVEN), 2, 1, SITES)
        levels = field[:, : problem.chain.levels]
        reading = field.copy()
        reading[:, : problem.chain.levels] += strong.misread(EVEN, levels).added
        found = unread(model, layout, 0, reading.reshape(len(EVEN), -1))
        seen = found.reshape(field.shape)[:, : problem.chain.levels]
        np.testing.assert_allclose(seen, levels, atol=1e-3)


def test_without_instruments_there_is_nothing_to_undo():
    problem = Problem.of(DECLARED, 2, [recording(EVEN)], CATALOGUE)
    layout = Layout.of(problem, len(EVEN), None, 1e-4)
    assert unread(Model(DECLARED, 2, TRUTH), layout, 0, problem.nodes[0]) is problem.nodes[0]


def test_a_fit_finds_coefficients_and_the_noise_of_each_sensor():
    sizes = np.concatenate([[0.002, 0.02, 0.005, 0.01], [0.03, 0.03, 0.01, 0.01]])
    problem = Problem.of(DECLARED, 2, [recording(EVEN, sizes)], CATALOGUE)
    layout = Layout.of(problem, len(EVEN), None, 1e-4)
    states = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    found = fit(Model(DECLARED, 2, regressed(problem)[0]), layout, states, structure=Structure(own_sizes=True))
    assert found.converged
    np.testing.assert_allclose(found.noise.deviation(), sizes, rtol=0.15)
    np.testing.assert_allclose(found.rms, sizes, rtol=0.15)
    assert np.max(np.abs((found.model.numbers - TRUTH) / found.stderr)) < 4
    assert np.max(found.stderr) < 0.01
    assert found.dispersion == 1.0
    (curve,) = found.curves()
    np.testing.assert_allclose(curve.field[:, :, 0].reshape(len(EVEN), -1), motion(EVEN), atol=0.02)


@pytest.fixture(scope="module")
def right_and_wrong():
    """Fits of the declared equation, and of one for small swings, to the same pieces of nearly exact readings."""
    t = np.linspace(0, 60, 1200)
    found = []
    for one in (DECLARED, library("small swings", "u[n+1]+u[n-1]-2*u[n]; u[n]")):
        problem = Problem.of(one, 2, [recording(t, 2e-4, velocities=False)], CATALOGUE)
        layout = Layout.of(problem, 40, None, 2e-6)
        states = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
        found.append((problem, fit(Model(one, 2, regressed(problem)[0]), layout, states, structure=Structure())))
    return found


@pytest.mark.parametrize("kind", ["correlated", "outliers"])
def test_a_misfit_has_lines_in_its_spectrum_and_noise_of_any_kind_has_none(kind):
    data, draw = recording(EVEN, 0.0, velocities=False), np.random.default_rng(21)
    white = draw.normal(size=data.u.shape)
    kinds = {
        "correlated": 0.6 * lfilter([1.0], [1.0, -0.8], white, axis=0),
        "outliers": np.where(draw.uniform(size=white.shape) < 0.02, 40 * np.sign(white), white),
    }
    problem = Problem.of(DECLARED, 2, [replace(data, u=data.u + 0.01 * kinds[kind])], CATALOGUE)
    layout = Layout.of(problem, len(EVEN), None, 1e-4)
    states = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    structure = Structure(tails=True, memory=True)
    there = fit(Model(DECLARED, 2, TRUTH), layout, states, structure=structure)
    assert not there.has_lines()
    assert fit(Model(DECLARED, 2, (2.0, -2.8)), layout, there.followed.nodes, structure=structure, steps=0).has_lines()


def test_evidence_counts_as_much_less_as_the_numbers_differ_between_stretches_of_a_recording(right_and_wrong):
    (_, right), (_, wrong) = right_and_wrong
    assert right.dispersion == 1.0
    assert wrong.dispersion > 3
    pieces = np.array_split(np.arange(len(wrong.followed.nodes[0])), 6)
    layouts = [
        replace(wrong.layout, rows=(wrong.layout.rows[0][part],), valid=(wrong.layout.valid[0][part],))
        for part in pieces
    ]
    numbers = [
        fit(wrong.model, replace(one, substeps=(np.ones(part.size * (one.longest - 1), dtype=int),)),
            [wrong.followed.nodes[0][part]], structure=Structure()).model.numbers
        for one, part in zip(layouts, pieces, strict=True)
    ]  # fmt: skip
    scatter = np.std(numbers, axis=0, ddof=1) / np.sqrt(len(pieces))
    assert np.all(scatter < 3 * wrong.stderr)
    assert np.max(scatter / wrong.stderr * np.sqrt(wrong.dispersion)) > 2


def test_of_a_model_that_misfits_an_effect_must_take_a_share_of_what_is_left(right_and_wrong):
    (problem, right), (same, wrong) = right_and_wrong
    assert not misfits(problem, right)
    assert misfits(same, wrong)
    for one in (problem.candidates[0], next(one for one in problem.candidates if one.timed)):
        assert Worth(problem, right).price_of(one) == problem.price_of(one)
        share = rules.SHARE_TIMED if one.timed else rules.SHARE
        least = 1200 * SITES * -np.log(1 - share) / wrong.dispersion
        assert Worth(same, wrong).price_of(one) == pytest.approx(max(least, problem.price_of(one)))


def test_the_declared_coefficients_to_start_from_are_near_those_that_made_the_data_whatever_the_sensors_zero():
    data = recording(EVEN, 0.003)
    for offset in (0.0, 0.5):
        shifted = replace(data, u=data.u + offset * np.eye(SITES)[2])
        linear = library("linear", "u[n+1]+u[n-1]-2*u[n]; u[n]")
        found = regressed(Problem.of(linear, 2, [shifted], CATALOGUE))[0]
        np.testing.assert_allclose(found, [2.0, -2.8], rtol=0.1)


def test_a_long_recording_is_used_thinned_and_in_windows():
    t = np.linspace(0, 4000, 200_000)
    samples = Samples(t, np.sin(t)[:, None], source="long", ends="free")
    thin = thinned(samples, 1.0, np.empty(0))
    assert len(thin.t) < len(t)
    assert np.all(np.isin(thin.t, t))
    parts = windows(thin)
    assert len(parts) == WINDOWS
    assert sum(len(one.t) for one in parts) <= LONG
    assert all(one.t[-1] < other.t[0] for one, other in itertools.pairwise(parts))


@pytest.mark.parametrize("input", [False, True])
@pytest.mark.parametrize(("count", "cycles"), [(40_000, [2.0]), (4800, [12.5]), (40_000, [12.5]), (40_000, [5.0, 7.5])])
def test_no_fast_line_is_hidden_where_a_recording_is_thinned(count, cycles, input):
    t = np.arange(count) * 0.02
    u = np.sin(2 * np.pi * 0.2 * t)[:, None]
    samples = Samples(t, u, f=0 * u if input else None, source="long", ends="free")
    top, fast = 2 * np.pi * 0.2, 2 * np.pi * np.array(cycles)
    near = 24 * np.pi / t[-1]
    # With the usual step, some would be read as waves of the motion, as one another, or as noise.
    usual = thinned(samples, top, np.empty(0)).t[1]
    chosen = thinned(samples, top, fast).t[1]
    assert chosen <= usual
    assert hidden(fast, chosen, FARTHER * top, near) == 0
    larger = [k for k in range(1, round(usual / 0.02) + 1) if 0.02 * k > 1.01 * chosen and not (input and k & (k - 1))]
    assert all(hidden(fast, 0.02 * k, FARTHER * top, near) > 0 for k in larger)


@pytest.mark.parametrize("middle", [0.0, 0.3, 1.0])
def test_windows_of_a_long_recording_lie_where_its_signal_is(middle):
    t = np.linspace(0, 1, 10 * LONG)
    signal = np.exp(-(((t - middle) / 0.01) ** 2)) * np.sin(2e4 * t)
    parts = windows(Samples(t, signal[:, None], source="long", ends="free"))
    assert all(one.t[-1] < other.t[0] for one, other in itertools.pairwise(parts))
    assert sum(np.sum(one.u**2) for one in parts) > 0.9 * np.sum(signal**2)
    assert {len(one.t) for one in parts} == {LONG // WINDOWS}


def test_with_a_slow_clock_positions_go_faster_than_velocities_say():
    slow = 0.02
    from_clock = motion((1 + slow) * EVEN)
    u, v = from_clock[:, :SITES], from_clock[:, SITES:]
    problem = Problem.of(DECLARED, 2, [Samples(EVEN, u, v, ends="free")], CATALOGUE)
    clock = next(one for one in problem.candidates if one.effect.name == "clock")
    layout = Layout.of(problem, len(EVEN), None, 1e-4)
    near = [nodes[rows] for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    model = Model(DECLARED, 2, TRUTH, (clock,))
    found = fit(model, layout.with_substeps(model, near, problem.top), near, structure=Structure()).model
    # The coefficients are those by a right clock.
    np.testing.assert_allclose([*found.coefficients, *found.effects[0].strength], [*TRUTH, slow], rtol=1e-3)
