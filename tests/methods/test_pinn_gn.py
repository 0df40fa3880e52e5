"""The network trained as a likelihood: exact without noise, near the bound with it, and for every kind of samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from latticebench import systems
from latticebench.bench.limit import bound_of
from latticebench.methods.engine.networks import side_by_side
from latticebench.methods.method import Skipped, make, solve
from latticebench.methods.pinn_gn import PINNGaussNewton
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Initial, library
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import observe, sample_times, simulate

FOUR = [("phi4", "lib2"), ("sine-gordon", "lib2"), ("dnls", "four"), ("ginzburg-landau", "four")]
# A profile, and a little motion of every site that is not that of its neighbours.
MOTIONS = [f"sin({k}*n**2+{m}*n)/5" for k, m in ((41, 17), (29, 23))]
PROFILES = {"phi4": "tanh(x)", "sine-gordon": "4*atan(exp(x))", "dnls": "exp(-x**2)", "ginzburg-landau": "tanh(x)"}


def shaken(name):
    """The lattice with an initial state in which every site moves by itself."""
    system = systems.find(name)
    first, second = MOTIONS
    u = f"{PROFILES[name]}+{first}+i*{second}" if system.is_complex else f"{PROFILES[name]}+{first}"
    return replace(system, initials={"shaken": Initial(u=u, v="0" if system.is_complex else second)})


def seen(system, noise, seed, *, velocities=True, missing=0.0, ends=None, **options):
    clean = simulate(system, integrator="dop853", **options)
    found = observe(clean, np.random.default_rng(seed), noise=noise, missing=missing).observed()
    return replace(found, v=found.v if velocities else None, ends=ends or system.ends)


def error(fit, truth):
    return np.linalg.norm(fit.coefficients - truth) / np.linalg.norm(truth)


@pytest.mark.parametrize(("name", "candidates"), FOUR)
def test_without_noise_the_coefficients_are_found(name, candidates):
    system = shaken(name)
    one = system.library(candidates)
    fit = solve(PINNGaussNewton(), [seen(system, 0.0, 0, sites=9, parameters={"C": 0.8})], one, system.order, 0)
    assert error(fit, system.truth(one, {"C": 0.8})) < 1e-6
    assert fit.residual < 1e-3


@pytest.mark.parametrize(("name", "candidates"), [FOUR[0], FOUR[3]])
def test_with_noise_the_error_is_near_the_bound_from_a_state_in_which_every_site_moves(name, candidates):
    system, noise = shaken(name), 0.05
    one = system.library(candidates)
    options = {"sites": 10, "times": sample_times(51), "parameters": {"C": 0.8}}
    truth = system.truth(one, {"C": 0.8})
    fits = [solve(PINNGaussNewton(), [seen(system, noise, seed, **options)], one, system.order, 0) for seed in (1, 2)]
    least = bound_of([replace(simulate(system, **options), ends=system.ends)], one, system.order, noise=noise)
    assert np.sqrt(np.mean([error(fit, truth) ** 2 for fit in fits])) < 2.5 * least.relative
    assert np.median([fit.stderr / least.stderr for fit in fits]) == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize(
    "options",
    [
        {"velocities": False},
        {"missing": 0.1},
        {"times": sample_times(50, 10.0, np.random.default_rng(3))},
        {"ends": "unknown"},
    ],
)
def test_takes_gaps_uneven_times_positions_alone_and_unknown_ends(options):
    system = systems.find("phi4")
    one = system.library("lib2")
    fit = solve(PINNGaussNewton(), [seen(system, 0.01, 1, **options)], one, 2, 0)
    assert error(fit, system.truth(one, {})) < 0.015


def test_a_record_of_many_periods_is_cut_into_pieces_with_common_coefficients():
    t = np.linspace(0, 30, 200)
    # u'' = -9 u at sites that do not see each other.
    u = np.sin(3 * t[:, None] + [0.3, 1.2, 2.0])
    samples = Samples(t, u + np.random.default_rng(1).normal(size=u.shape) / 100, ends="fixed")
    fit = solve(PINNGaussNewton(), [samples], library("one", "u[n]"), 2, 0)
    np.testing.assert_allclose(fit.coefficients, [-9], atol=5 * np.max(fit.stderr))
    assert np.max(fit.stderr) < 0.05
    (curve,) = fit.smooth
    assert np.all(np.diff(curve.times) > 0)
    assert np.sum(curve.share) == pytest.approx(1)


def test_a_library_that_does_not_hold_the_equation_leaves_a_residual():
    system = systems.find("sine-gordon")
    fit = solve(PINNGaussNewton(), [seen(system, 0.0, 0)], system.library("powers"), 2, 0)
    assert fit.residual > 0.05
    # The curve still follows the samples.
    assert fit.found["noise_u"] < 0.05


@pytest.mark.parametrize("activation", ["sine", "tanh"])
def test_a_trained_layer_of_few_units_finds_more_than_a_drawn_one(activation):
    system = shaken("phi4")
    one = system.library("lib2")
    samples, truth = seen(system, 0.0, 0, sites=12, parameters={"C": 0.8}), system.truth(one, {"C": 0.8})
    drawn, trained = (
        error(solve(PINNGaussNewton(activation, width=24, train=train), [samples], one, 2, 1), truth)
        for train in (False, True)
    )
    assert trained < drawn / 3


def test_members_tell_how_far_the_noise_may_have_moved_a_coefficient():
    system = systems.find("phi4")
    one = system.library("equation")
    samples = [seen(system, 0.02, 4, sites=9)]
    alone = solve(PINNGaussNewton(width=120), samples, one, 2, 0)
    fit = solve(PINNGaussNewton(width=120, members=6), samples, one, 2, 0)
    assert np.array_equal(fit.coefficients, alone.coefficients)
    spreads = np.array([fit.found[f"spread of {text}"] for text in one.texts])
    np.testing.assert_allclose(np.log(spreads / fit.stderr), 0, atol=np.log(4))
    assert fit.found["interval of u[n]"] == pytest.approx(2.571 * fit.found["spread of u[n]"], rel=1e-3)


@pytest.mark.parametrize(("name", "candidates"), [FOUR[0], FOUR[3]])
def test_a_device_finds_what_the_processor_finds_and_so_do_the_members(name, candidates, monkeypatch):
    torch = pytest.importorskip("torch")
    device = "cuda" if torch.cuda.is_available() else "cpu:0"
    system = shaken(name)
    one = system.library(candidates)
    samples = [seen(system, 0.02, seed, sites=5, times=sample_times(12)) for seed in (1, 2)]
    alone = solve(PINNGaussNewton(width=16, members=3), samples, one, system.order, 0)
    # Two batches, of two members and of one.
    monkeypatch.setattr(side_by_side, "_bytes", lambda *_: side_by_side.MEMORY / 2)
    fit = solve(PINNGaussNewton(width=16, members=3, device=device), samples, one, system.order, 0)
    assert np.max(np.abs(fit.coefficients - alone.coefficients) / alone.stderr) < 0.01
    np.testing.assert_allclose(fit.stderr, alone.stderr, rtol=0.01)
    names = [f"spread of {text}" for text in one.texts]
    spreads = [[found[name] for name in names] for found in (fit.found, alone.found)]
    np.testing.assert_allclose(*spreads, rtol=0.05)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"members": 1}, "one has no spread"),
        ({"steps": 0}, "at least 1"),
        ({"bandwidth": -1.0}, "above 0"),
        ({"activation": "relu"}, "activation = 'relu'"),
    ],
)
def test_an_unsound_setting_is_refused(given, told):
    with pytest.raises(InputError, match=told):
        make(PINNGaussNewton, given)


def test_velocities_in_some_trajectories_only_are_a_reason_to_skip():
    system = systems.find("phi4")
    data = [seen(system, 0.01, 1, sites=5), seen(system, 0.01, 2, sites=5, velocities=False)]
    with pytest.raises(Skipped, match="some trajectories only"):
        solve(PINNGaussNewton(), data, system.library("equation"), 2, 0)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.001, 0.1])
@pytest.mark.parametrize(("name", "candidates"), FOUR)
def test_the_efficiency_is_at_least_two_thirds(name, candidates, noise):
    system = shaken(name)
    one = system.library(candidates)
    options = {"sites": 22, "times": sample_times(51), "parameters": {"C": 0.8}}
    truth = system.truth(one, {"C": 0.8})
    fits = [
        solve(PINNGaussNewton(), [seen(system, noise, seed, **options)], one, system.order, 0) for seed in range(20)
    ]
    least = bound_of([replace(simulate(system, **options), ends=system.ends)], one, system.order, noise=noise)
    assert least.relative / np.sqrt(np.mean([error(fit, truth) ** 2 for fit in fits])) > 0.65
    scores = np.array([(fit.coefficients - truth) / fit.stderr for fit in fits])
    assert np.mean(np.abs(scores) < 1.96) >= 0.85
