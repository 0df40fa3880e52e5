"""Motions and their derivatives: weights, factors and a least stencil, against plain loops, differences and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench import systems
from latticebench.methods.engine import variational
from latticebench.methods.engine.dynamics import Dynamics
from latticebench.methods.engine.sensitivity import Stretches
from latticebench.systems.simulate import simulate
from latticebench.systems.terms import Term

SITES = 6
ENDS = ["free", "fixed", "periodic"]


def neighbour(u, k, ends):
    """The value at site k = 0..N-1, or what stands beyond the ends, for the nearest neighbours."""
    if 0 <= k < len(u):
        return u[k]
    if ends == "fixed":
        return 0.0
    return u[k % len(u)] if ends == "periodic" else u[min(max(k, 0), len(u) - 1)]


def laplacian(u, k, ends):
    return neighbour(u, k + 1, ends) + neighbour(u, k - 1, ends) - 2 * u[k]


# Terms with the factor in time of each. That of `1+i` acts on the two parts separately, as a known force must.
REAL = {
    "u[n+1]+u[n-1]-2*u[n]": None,
    "u[n]**3": None,
    "v[n]": None,
    "1": lambda t: np.cos(1.3 * t)[None, :, None],
    "u[n]": lambda t: np.sin(t)[None, :, None] * np.arange(1.0, SITES + 1),
}
COMPLEX = {
    "i*(u[n+1]+u[n-1]-2*u[n])": None,
    "abs(u[n])**2*u[n]": None,
    "i*u[n]": None,
    "1+i": lambda t: np.stack([np.cos(t), np.sin(2 * t)])[:, :, None] * np.ones(SITES),
    "conj(u[n])": lambda t: np.sin(t)[None, :, None],
}
KINDS = {"real of order 2": (2, False, REAL), "complex of order 1": (1, True, COMPLEX)}


def values(kind, u, v, k, ends):
    """The same terms at site k, without their factors."""
    if KINDS[kind][1]:
        return 1j * laplacian(u, k, ends), abs(u[k]) ** 2 * u[k], 1j * u[k], 1 + 1j, np.conj(u[k])
    return laplacian(u, k, ends), u[k] ** 3, v[k], 1.0, u[k]


COEFFICIENTS = np.array([0.8, -0.5, -0.2, 0.4, 0.3])


def weights():
    draw = np.random.default_rng(1)
    found = draw.uniform(0.5, 1.5, (5, SITES))
    found[0] = 1.0
    found[2] = np.eye(SITES)[2]
    return found


def lattice(kind, ends):
    order, is_complex, terms = KINDS[kind]
    return Dynamics(tuple(map(Term, terms)), order, is_complex, SITES, ends, weights(), tuple(terms.values()))


def by_loops(kind, ends, t, u, v):
    """The highest time derivative at one time, site by site and term by term."""
    _, is_complex, terms = KINDS[kind]
    rate = np.zeros(SITES, dtype=complex)
    for k in range(SITES):
        for j, (value, factor) in enumerate(zip(values(kind, u, v, k, ends), terms.values(), strict=True)):
            one = complex(COEFFICIENTS[j] * weights()[j, k] * value)
            if factor is not None:
                g = np.broadcast_to(factor(np.array([t])), (1 + is_complex, 1, SITES))[:, 0, k]
                one = complex(one.real * g[0], one.imag * g[-1])
            rate[k] += one
    return rate if is_complex else rate.real


def state(kind, seed=3, count=1):
    order, is_complex, _ = KINDS[kind]
    draw = np.random.default_rng(seed)
    return 0.7 * draw.normal(size=(count, order * (1 + is_complex) * SITES))


def fields(kind, y):
    """Read u and v of one state."""
    order, is_complex, _ = KINDS[kind]
    u = y[:SITES] + 1j * y[SITES:] if is_complex else y[:SITES]
    return u, (y[SITES:] if order == 2 else None)


def written(kind, rate, v):
    """Write dy/dt of one state."""
    if KINDS[kind][1]:
        return np.concatenate([rate.real, rate.imag])
    return np.concatenate([v, rate])


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("kind", KINDS)
def test_with_weights_and_factors_the_right_hand_side_is_that_of_plain_loops(kind, ends):
    times, y = np.array([0.4, 1.7, 2.2]), state(kind, count=3)
    found = lattice(kind, ends).linear(COEFFICIENTS, times, y)[0]
    for t, row, own in zip(times, y, found, strict=True):
        u, v = fields(kind, row)
        assert np.allclose(own, written(kind, by_loops(kind, ends, t, u, v), v), rtol=1e-12, atol=1e-13)


def stretches(kind, ends):
    return Stretches(lattice(kind, ends), np.array([0.0, 0.3]), np.array([0.3, 0.7]))


STEPS = np.array([4, 4])


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("kind", KINDS)
def test_with_weights_and_factors_the_derivatives_by_the_start_are_the_differences_of_runs(kind, ends):
    one, y = stretches(kind, ends), state(kind, count=2)
    varied = one.vary(COEFFICIENTS, y, STEPS)
    assert np.allclose(varied.end, one.run(COEFFICIENTS, y, STEPS))
    for place in range(y.shape[1]):
        step = 1e-5 * np.eye(y.shape[1])[place]
        slope = (one.run(COEFFICIENTS, y + step, STEPS) - one.run(COEFFICIENTS, y - step, STEPS)) / 2e-5
        assert np.allclose(varied.by_state[:, place], slope, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("kind", KINDS)
def test_with_weights_and_factors_the_derivatives_by_the_coefficients_are_the_differences_of_runs(kind, ends):
    one, y = stretches(kind, ends), state(kind, count=2)
    varied = one.vary(COEFFICIENTS, y, STEPS)
    for term in range(len(COEFFICIENTS)):
        step = 1e-5 * np.eye(len(COEFFICIENTS))[term]
        slope = (one.run(COEFFICIENTS + step, y, STEPS) - one.run(COEFFICIENTS - step, y, STEPS)) / 2e-5
        assert np.allclose(varied.by_coefficient[:, term], slope, rtol=1e-7, atol=1e-9)
        assert np.any(slope != 0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_motion_under_factor_forces_is_that_of_scipy(kind):
    one, y = stretches(kind, "free"), state(kind, count=2)
    end = one.run(COEFFICIENTS, y, 4 * STEPS)

    def rate(t, row):
        u, v = fields(kind, row)
        return written(kind, by_loops(kind, "free", t, u, v), v)

    for begin, stop, start, own in zip(one.begin, one.end, y, end, strict=True):
        other = solve_ivp(rate, (begin, stop), start, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        assert np.allclose(own, other, atol=1e-9)


def test_weights_and_factors_of_one_change_nothing():
    terms = (Term("u[n+1]+u[n-1]-2*u[n]"), Term("u[n]**3"))
    y, t = state("real of order 2", count=4), np.linspace(0, 1, 4)
    plain = Dynamics(terms, 2, False, SITES, "free").linear(COEFFICIENTS[:2], t, y)[0]
    factors = (lambda t: np.ones((1, len(t), 1)), None)
    other = Dynamics(terms, 2, False, SITES, "free", np.ones((2, SITES)), factors)
    assert np.array_equal(plain, other.linear(COEFFICIENTS[:2], t, y)[0])


def test_at_unknown_ends_a_wider_least_reach_leaves_more_sites_without_an_equation_but_changes_no_other():
    terms = (Term("u[n+1]+u[n-1]-2*u[n]"), Term("u[n]**3"))
    narrow = Dynamics(terms, 2, False, 9, "unknown")
    wide = Dynamics(terms, 2, False, 9, "unknown", least_reach=(2, 3))
    assert list(narrow.border) == [0, 8]
    assert list(wide.border) == [0, 1, 6, 7, 8]
    draw = np.random.default_rng(0)
    u, v = draw.normal(size=(2, 3, 9))
    t = np.arange(3.0)
    rates = []
    for one in (narrow, wide):
        driven = np.stack([u, v], axis=1)[:, :, None, one.border]
        rate = one.linear(np.array([0.7, -0.4]), t, one.pack(u, v), None, driven)[0]
        rates.append(one.whole(rate, None)[:, 1, 0])
    assert np.allclose(rates[0][:, 2:6], rates[1][:, 2:6])
    assert np.all(rates[1][:, [0, 1, 6, 7, 8]] == 0)


def test_at_fixed_ends_a_wider_least_reach_changes_nothing():
    terms = (Term("u[n+1]+u[n-1]-2*u[n]"),)
    y, t = state("real of order 2", count=2), np.arange(2.0)
    plain = Dynamics(terms, 2, False, SITES, "fixed").linear(COEFFICIENTS[:1], t, y)[0]
    assert np.array_equal(
        plain, Dynamics(terms, 2, False, SITES, "fixed", least_reach=(2, 2)).linear(COEFFICIENTS[:1], t, y)[0]
    )


@pytest.mark.parametrize(
    ("name", "candidates"), [("phi4", "lib2"), ("sine-gordon", "lib2"), ("dnls", "four"), ("ginzburg-landau", "four")]
)
def test_sensitivities_agree_with_differences_of_another_integrator(name, candidates):
    system = systems.find(name)
    one = system.library(candidates)
    motion = simulate(system, sites=9)
    truth = system.truth(one, {})
    dynamics = Dynamics(one.terms, system.order, system.is_complex, 9, system.ends)
    start = dynamics.pack(motion.exact.u, motion.exact.v)[3]
    stretches = Stretches(dynamics, np.array([0.0]), np.array([0.4]))
    found = stretches.vary(truth, start[None], np.array([8]))

    def end(coefficients, state):
        def rate(t, y):
            return dynamics.linear(coefficients, np.array([t]), y[None], derivatives=False)[0][0]

        return solve_ivp(rate, (0, 0.4), state, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]

    step = 1e-4
    for k in range(len(truth)):
        shift = step * np.eye(len(truth))[k]
        expected = (end(truth + shift, start) - end(truth - shift, start)) / (2 * step)
        np.testing.assert_allclose(found.by_coefficient[0, k], expected, atol=2e-6)
    for k in (0, dynamics.size // 2, dynamics.size - 1):
        shift = step * np.eye(dynamics.size)[k]
        expected = (end(truth, start + shift) - end(truth, start - shift)) / (2 * step)
        np.testing.assert_allclose(found.by_state[0, k], expected, atol=2e-6)


def test_long_chains_are_disturbed_in_groups_with_the_same_result():
    system = systems.find("phi4")
    one = system.library("lib2")
    motion = simulate(system, sites=40)
    truth = system.truth(one, {})
    dynamics = Dynamics(one.terms, 2, False, 40, "free")
    nodes = dynamics.pack(motion.exact.u, motion.exact.v)[:1]
    stretches = Stretches(dynamics, np.array([0.0]), np.array([0.05]))
    grouped = stretches.vary(truth, nodes, np.array([1]))
    assert isinstance(grouped.by_state, list)
    whole = stretches.vary_in_groups(truth, nodes, np.array([1]), None, 40, 40)
    np.testing.assert_allclose(grouped.by_state[0].toarray(), whole.by_state[0], atol=1e-9)


@pytest.mark.parametrize("ends", ["free", "fixed", "periodic"])
def test_where_nearly_all_sites_couple_a_product_of_matrices_gives_the_same_derivatives(ends, monkeypatch):
    texts = [f"i*(u[n+{r}]+u[n-{r}]-2*u[n])" for r in range(1, 8)] + ["i*abs(u[n])**2*u[n]"]
    dynamics = Dynamics(tuple(map(Term, texts)), 1, True, 9, ends)
    draw = np.random.default_rng(4)
    one = Stretches(dynamics, np.array([0.0, 0.1]), np.array([0.1, 0.2]))
    arguments = draw.normal(size=len(texts)), draw.normal(size=(2, dynamics.size)), np.array([1, 2])
    found = one.vary(*arguments)
    monkeypatch.setattr(variational, "WIDE", np.inf)
    by_windows = one.vary(*arguments)
    np.testing.assert_allclose(found.by_state, by_windows.by_state, atol=1e-12)
    np.testing.assert_allclose(found.by_coefficient, by_windows.by_coefficient, atol=1e-12)


def test_stretches_of_one_equation_join_unless_something_acts_from_outside():
    dynamics = [Dynamics((Term("u[n]"),), 2, False, 3, "free", weights) for weights in (None, np.ones((1, 3)), None)]
    one, weighted, same = (Stretches(each, np.array([0.0]), np.array([1.0])) for each in dynamics)
    driven = Stretches(dynamics[0], np.array([0.0]), np.array([1.0]), lambda t: np.ones((len(t), 3)))
    assert one.joins(same)
    assert not one.joins(weighted)
    assert not one.joins(driven)
    assert not driven.joins(driven)
