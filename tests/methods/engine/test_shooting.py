"""Maximum likelihood by multiple shooting: against SciPy's least squares, and in pieces as piece by piece."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from latticebench import systems
from latticebench.methods.engine.record import prepare
from latticebench.methods.engine.shooting import maximise
from latticebench.methods.engine.starts import guess
from latticebench.systems.simulate import observe, sample_times, simulate


@pytest.mark.parametrize(("name", "off"), [("phi4", 1.0), ("phi4", 1.05), ("dnls", 1.0)])
def test_with_the_coefficients_held_only_the_states_are_fitted_and_are_those_of_scipys_least_squares(name, off):
    system = systems.find(name)
    one = system.library("equation")
    clean = simulate(system, sites=5, times=sample_times(20, 4.0))
    samples = replace(observe(clean, np.random.default_rng(4), noise=0.03).observed(), ends=system.ends)
    record = prepare(samples, one.terms, system.order)
    known = off * system.truth(one, {})
    start = replace(guess([samples], [record]), coefficients=known)
    found = maximise([record], start, held=True)
    assert np.array_equal(found.state.coefficients, known)
    free = maximise([record], start)
    assert not np.array_equal(free.state.coefficients, known)
    assert np.sum(free.misfit / found.sigma**2) <= np.sum(found.misfit / found.sigma**2) + 1e-6
    dynamics = record.stretches.dynamics
    levels = record.value.shape[1]

    def rate(t, y):
        return dynamics.linear(known, np.array([t]), y[None], derivatives=False)[0][0]

    def left(y):
        path = solve_ivp(rate, samples.t[[0, -1]], y, t_eval=samples.t, method="DOP853", rtol=1e-9, atol=1e-10).y.T
        whole = dynamics.whole(path, None)[:, :levels]
        return ((record.value - whole) / found.sigma[:, None, None]).ravel()

    best = least_squares(left, found.state.nodes[0][0], x_scale=0.1)
    error_of = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    assert np.max(np.abs(found.state.nodes[0][0] - best.x) / error_of) < 0.05
    # The states between follow the motion.
    np.testing.assert_allclose(
        left(found.state.nodes[0][0]) ** 2 @ np.ones(record.value.size), 2 * best.cost, rtol=1e-3
    )


def test_a_record_in_pieces_is_fitted_as_the_pieces_are_one_by_one():
    phi4 = systems.find("phi4")
    clean = simulate(phi4, sites=5, times=np.linspace(0, 12, 60))
    data = observe(clean, np.random.default_rng(1), noise=0.01).observed()
    terms = phi4.library("equation").terms
    pieces = [
        replace(data, ends="free", t=data.t[k : k + 20], u=data.u[k : k + 20], v=data.v[k : k + 20])
        for k in (0, 20, 40)
    ]
    records = [prepare(one, terms, 2) for one in pieces]
    state = guess(pieces, records)
    # A factor of one in time keeps the second piece apart from the others.
    dynamics = replace(
        records[1].stretches.dynamics, factors=(*(None for _ in terms[1:]), lambda t: np.ones((1, len(t), 1)))
    )
    apart = [records[0], replace(records[1], stretches=replace(records[1].stretches, dynamics=dynamics)), records[2]]
    one, other = (maximise(some, state, tolerance=0.02) for some in (records, apart))
    np.testing.assert_allclose(one.state.coefficients, other.state.coefficients, rtol=1e-12)
    for left, right in zip(one.state.nodes, other.state.nodes, strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-9, atol=1e-12)


def test_states_of_dense_samples_follow_the_motion_within_a_few_steps():
    """Closing the small gaps between them costs likelihood at first, and is no reason for shorter and shorter steps."""
    system = systems.find("phi4")
    clean = simulate(system, sites=9, times=np.linspace(0, 10, 401))
    samples = observe(clean, np.random.default_rng(0), noise=0.01).observed()
    samples = replace(samples, v=None, ends=system.ends)
    library = system.library("lib2")
    records = [prepare(samples, library.terms, 2)]
    start = guess([samples], records)
    held = maximise(records, replace(start, coefficients=system.truth(library, {})), tolerance=0.1, held=True)
    assert held.converged
    assert len(held.steps) <= 5
    free = maximise(records, held.state)
    assert free.converged
    assert len(free.steps) <= 6
