"""A mass or a support of which nothing is read, held against SciPy's integrator and against finite differences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.methods.engine.bsplines import BSplines
from latticebench.methods.engine.dynamics import Dynamics
from latticebench.methods.engine.resonator import Absorber, Support
from latticebench.methods.engine.sensitivity import Stretches
from latticebench.systems.terms import Term

SITES, TIME, SUBSTEPS = 4, 0.3, np.array([4, 4, 4])
CARRIES = Support((0, 1, 2, 3), 0.15, 3.0, 0.3)
HANGING = (Absorber((1,), 0.3, 4.6, 0.2, 0.1), Absorber((3,), 0.1, 6.0, 0.1, 0.4), CARRIES)
COEFFICIENTS = np.array([3.0, -20.0])
START = 0.3 * np.random.default_rng(0).standard_normal((3, 2 * SITES + 2 * len(HANGING)))


def stretches(*hanging):
    terms = (Term("u[n+1]+u[n-1]-2*u[n]"), Term("sin(u[n])"))
    dynamics = Dynamics(terms, 2, False, SITES, "free", resonators=hanging)
    return Stretches(dynamics, np.zeros(len(START)), np.full(len(START), TIME))


def rate(_, y):
    """The equations of the chain and of what hangs on it, written out."""
    u, v, hidden = y[:SITES], y[SITES : 2 * SITES], y[2 * SITES :].reshape(-1, 2)
    terms = 3 * np.diff(np.r_[u[0], u, u[-1]], 2) - 20 * np.sin(u)
    force, own = terms.copy(), []
    for one, (place, speed) in zip(HANGING, hidden, strict=True):
        if isinstance(one, Support):
            sway = -(one.omega**2) * place - one.gamma * speed - one.mass * np.sum(terms)
            force -= sway
            own += [speed, sway]
            continue
        (site,) = one.sites
        pull = one.omega**2 * (place - u[site]) + one.gamma * (speed - v[site])
        force[site] += one.mass * pull
        own += [speed, -pull - one.drag * speed]
    return np.r_[v, force, own]


def test_what_hangs_on_a_chain_moves_as_scipy_says():
    found = stretches(*HANGING).run(COEFFICIENTS, START, SUBSTEPS)
    expected = [solve_ivp(rate, (0, TIME), y, rtol=1e-11, atol=1e-12).y[:, -1] for y in START]
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_derivatives_by_the_start_the_coefficients_and_the_numbers_of_what_hangs_are_finite_differences():
    every, step = stretches(*HANGING), 1e-6
    found = every.vary(COEFFICIENTS, START, SUBSTEPS, dense=True)

    def slope(ends):
        return (ends(step) - ends(-step)) / (2 * step)

    for k, change in enumerate(np.eye(START.shape[1])):
        by = slope(lambda h, change=change: every.run(COEFFICIENTS, START + h * change, SUBSTEPS))
        np.testing.assert_allclose(found.by_state[:, k], by, atol=1e-7)
    for k, change in enumerate(np.eye(len(COEFFICIENTS))):
        by = slope(lambda h, change=change: every.run(COEFFICIENTS + h * change, START, SUBSTEPS))
        np.testing.assert_allclose(found.by_coefficient[:, k], by, atol=1e-7)
    names = [(k, name) for k, one in enumerate(HANGING) for name in ("mass", "omega", "gamma", "drag")[: one.numbers]]
    for number, (k, name) in enumerate(names, len(COEFFICIENTS)):

        def ends(h, k=k, name=name):
            moved = list(HANGING)
            moved[k] = replace(moved[k], **{name: getattr(moved[k], name) + h})
            return stretches(*moved).run(COEFFICIENTS, START, SUBSTEPS)

        assert np.max(np.abs(slope(ends))) > 1e-3
        np.testing.assert_allclose(found.by_coefficient[:, number], slope(ends), atol=1e-7)


def test_without_losses_what_hangs_keeps_the_energy_and_going_back_in_time_mirrors_the_motion():
    one = Absorber((2,), 0.25, 5.0, 0.0, 0.0)
    alone, y = stretches(one), START[:, : 2 * SITES + 2]

    def energy(y):
        u, v, place, speed = y[:, :SITES], y[:, SITES:-2], y[:, -2], y[:, -1]
        chain = v**2 / 2 - 20 * np.cos(u)
        bonds = 1.5 * np.sum(np.diff(u, axis=1) ** 2, axis=1)
        return np.sum(chain, axis=1) + bonds + one.mass * (speed**2 + one.omega**2 * (place - u[:, 2]) ** 2) / 2

    end = alone.run(COEFFICIENTS, y, SUBSTEPS)
    np.testing.assert_allclose(energy(end), energy(y), rtol=1e-9)
    mirror = alone.dynamics.mirror
    np.testing.assert_allclose(alone.run(COEFFICIENTS, end * mirror, SUBSTEPS) * mirror, y, atol=1e-8)


def test_without_losses_a_support_keeps_the_energy_that_sites_have_by_their_absolute_velocities():
    """Seen from the bench, a site moves at v + y'; the support weighs as much as 1 / mass of them."""
    one = Support((0, 1, 2, 3), 0.15, 3.0, 0.0)
    alone, y = stretches(one), START[:, : 2 * SITES + 2]

    def energy(y):
        u, v, place, speed = y[:, :SITES], y[:, SITES:-2], y[:, -2], y[:, -1]
        chain = (v + speed[:, None]) ** 2 / 2 - 20 * np.cos(u)
        bonds = 1.5 * np.sum(np.diff(u, axis=1) ** 2, axis=1)
        return np.sum(chain, axis=1) + bonds + (speed**2 + one.omega**2 * place**2) / one.mass / 2

    np.testing.assert_allclose(energy(alone.run(COEFFICIENTS, y, SUBSTEPS)), energy(y), rtol=1e-8)


def test_a_lattice_without_anything_beside_it_has_a_state_of_what_is_read():
    plain = stretches().dynamics
    assert plain.size == plain.read == 2 * SITES
    assert stretches(*HANGING).dynamics.size == plain.size + 6
    assert plain.sized([1.0, 2.0]).tolist() == pytest.approx([1.0] * SITES + [2.0] * SITES)


def test_derivatives_are_right_beside_sites_that_follow_a_curve_of_their_own():
    """With unknown ends the outer sites have no equation, and their curves have numbers of their own."""
    begin, end, draw = np.linspace(0, 0.4, 3), np.linspace(0.2, 0.6, 3), np.random.default_rng(2)
    basis = BSplines(np.r_[[0.0] * 4, 0.3, [0.6] * 4], 3)
    terms = (Term("u[n+1]+u[n-1]-2*u[n]"), Term("sin(u[n])"))
    splines, start = 0.3 * draw.standard_normal((basis.count, 1, 2)), 0.3 * draw.standard_normal((3, 8))

    def ends(one, curves):
        dynamics = Dynamics(terms, 2, False, 5, "unknown", resonators=(one,))
        return Stretches(dynamics, begin, end, drive=basis), curves

    def run(one, curves):
        some, curves = ends(one, curves)
        return some.run(COEFFICIENTS, start, SUBSTEPS, curves)

    one, step = HANGING[0], 1e-6
    some, _ = ends(one, splines)
    found = some.vary(COEFFICIENTS, start, SUBSTEPS, splines, dense=True)
    for number, name in enumerate(("mass", "omega", "gamma", "drag"), len(COEFFICIENTS)):
        moved = (replace(one, **{name: getattr(one, name) + h}) for h in (step, -step))
        by = np.subtract(*(run(each, splines) for each in moved)) / (2 * step)
        assert np.max(np.abs(by)) > 1e-3
        np.testing.assert_allclose(found.by_coefficient[:, number], by, atol=1e-7)
    change = np.zeros_like(splines)
    change[2, 0, 1] = step
    by = (run(one, splines + change) - run(one, splines - change)) / (2 * step)
    # The columns of the drive: spline coefficient, part, site.
    columns = [2 * (2 - first) + 1 for first in found.first]
    np.testing.assert_allclose(found.by_drive[np.arange(3), columns], by, atol=1e-7)
