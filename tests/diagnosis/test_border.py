"""Unknown ends: outer sites are read with noise, and what they really did is fitted along with the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.fitting import fit
from latticebench.diagnosis.horizon import Layout, follow, linearised
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Structure
from latticebench.diagnosis.problem import Problem
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

SITES, T = 5, np.linspace(0, 30, 301)
DECLARED, TRUTH = library("chain", "u[n+1]+u[n-1]-2*u[n]; u[n]"), (2.0, -1.5)
NOISE = 0.02


def rate(_, y):
    u, v = np.split(y, 2)
    beside = np.concatenate([u[1:], [0]]) + np.concatenate([[0], u[:-1]])
    return np.concatenate([v, 2.0 * (beside - 2 * u) - 1.5 * u])


def problem(seed, noise=NOISE, every=1):
    """Return a chain between walls of which nobody says so, read at every so many of the times."""
    draw = np.random.default_rng(seed)
    start = draw.normal(size=2 * SITES)
    u = solve_ivp(rate, (0, T[-1]), start, t_eval=T, rtol=1e-10, atol=1e-12).y[:SITES].T
    read = (u + noise * draw.normal(size=u.shape))[::every]
    samples = Samples(T[::every], read, ends="unknown")
    return Problem.of(DECLARED, 2, [samples], ())


def laid_out(one, length):
    layout = Layout.of(one, length, None, 1e-4)
    near = [nodes[rows] for nodes, rows in zip(one.nodes, layout.rows, strict=True)]
    model = Model(DECLARED, 2, TRUTH)
    return model, layout.with_substeps(model, near, one.top), near


def test_derivatives_by_the_curves_of_the_border_are_those_of_differences():
    one = problem(1)
    model, layout, near = laid_out(one, 60)
    border = layout.borders[0]
    followed = linearised(follow(model, layout, near), layout)
    size, step = followed.size, 1e-5
    for column in (0, 3, border.size - 1):
        change = np.zeros((layout.pieces, border.size))
        change[2, column] = step
        moved = [layout.bordered(0, followed.splines[0], change)]
        # From the same initial states: closing the gaps keeps the first state of each piece.
        other = follow(model, layout, followed.nodes, splines=moved)
        found = ((other.level - followed.level) / step).reshape(layout.pieces, -1)
        wanted = followed.slope[:, :, size + column].reshape(layout.pieces, -1)
        np.testing.assert_allclose(found[2], wanted[2], atol=2e-4 * np.max(np.abs(wanted)))
        # No piece has numbers of another one.
        assert np.max(np.abs(np.delete(found, 2, axis=0))) < 1e-6


def test_without_noise_the_curves_of_the_border_do_no_harm():
    one = problem(2, noise=0.0)
    model, layout, near = laid_out(one, 301)
    found = fit(replace(model, coefficients=(1.9, -1.4)), layout, near, structure=Structure())
    np.testing.assert_allclose(found.model.coefficients, TRUTH, rtol=3e-3)


def test_the_noise_of_each_sensor_is_found_where_curves_take_many_numbers():
    found = []
    for seed in range(8):
        model, layout, near = laid_out(problem(200 + seed, every=3), 101)
        one = fit(model, layout, near, structure=Structure(own_sizes=True))
        taken = np.sum(one.curved) / layout.readings()
        found.append(one.noise.size / NOISE)
        # All that the outer sites' curves have, and more than a tenth of what was read.
        assert np.sum(one.curved) == pytest.approx(layout.borders[0].size * layout.pieces)
        assert taken > 0.1
    # Of one sensor over all seeds, within three standard errors.
    np.testing.assert_allclose(np.mean(found, axis=0), 1, atol=3 / np.sqrt(2 * 8 * 101 * 0.7))


@pytest.mark.slow
def test_standard_errors_hold_where_the_border_is_noisy():
    wrong = []
    for seed in range(20):
        one = problem(100 + seed)
        model, layout, near = laid_out(one, 301)
        found = fit(model, layout, near, structure=Structure())
        wrong.append((np.array(found.model.coefficients) - TRUTH) / found.stderr)
    # Of 40 values; the mean square of normal ones is 0.6 to 1.5 in 95 of 100 cases.
    assert 0.4 < np.mean(np.square(wrong)) < 1.8


def test_curves_of_the_border_follow_no_noise_that_has_a_memory():
    from scipy.signal import lfilter

    one = problem(3, noise=0.0)
    record = one.records[0]
    rho, draw = 0.8, np.random.default_rng(4)
    noise = 0.05 * lfilter([np.sqrt(1 - rho**2)], [1, -rho], draw.normal(size=record.value.shape), axis=0)
    noisy = replace(one, records=(replace(record, value=record.value + noise),))
    memory = (T[1] - T[0]) / -np.log(rho)
    clean, blind, told = (
        Layout.of(each, 301, None, 1e-4, time).borders[0].basis.count
        for each, time in ((one, 0.0), (noisy, 0.0), (noisy, memory))
    )
    assert told < 0.6 * blind
    assert told < clean
