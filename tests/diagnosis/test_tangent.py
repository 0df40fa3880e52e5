"""What a fitted model's readings answer to forces and parameters, against differences of simulations by SciPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import BSpline

from latticebench.diagnosis.model import Fitted, Model
from latticebench.diagnosis.placed import Force, PlacedEffect
from latticebench.diagnosis.tangent import by_psi, force_along, linearise, orthonormal
from latticebench.methods.engine.shooting import Solution, State
from latticebench.methods.engine.starts import guess
from latticebench.systems.effects import find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples
from latticebench.systems.terms import Term

SITES = 6
TIMES = np.linspace(0, 4, 21)
SIGMA = 1e-4
LIBRARIES = {
    "real": (2, library("real", ["u[n+1]+u[n-1]-2*u[n]", "u[n]", "u[n]**3"]), np.array([1.5, -1.0, -0.5])),
    "complex": (
        1, library("complex", ["i*(u[n+1]+u[n-1]-2*u[n])", "i*abs(u[n])**2*u[n]", "u[n]"]), np.array([0.8, 1.0, -0.1]),
    ),
}  # fmt: skip


def laplacian(u, ends):
    """Neighbours' differences, with the field beyond the ends written from their definitions."""
    beyond = {"free": (u[0], u[-1]), "fixed": (0.0, 0.0), "periodic": (u[-1], u[0])}[ends]
    padded = np.concatenate([[beyond[0]], u, [beyond[1]]])
    return padded[2:] + padded[:-2] - 2 * u


def highest(kind, ends, xi, u):
    """The highest time derivative, written out."""
    if kind == "real":
        return xi[0] * laplacian(u, ends) + xi[1] * u + xi[2] * u**3
    return 1j * xi[0] * laplacian(u, ends) + 1j * xi[1] * abs(u) ** 2 * u + xi[2] * u


def simulated(kind, ends, *, xi=None, force=None, scale=None, times=TIMES):
    """Readings (T, levels, parts, N) of a motion from a state that is always the same."""
    xi = LIBRARIES[kind][2] if xi is None else xi
    u0 = np.sin(1.0 + 0.9 * np.arange(SITES)) * (1.0 if kind == "real" else np.exp(0.7j * np.arange(SITES)))
    scale = np.ones(SITES) if scale is None else scale

    def rate(t, y):
        u = y[:SITES]
        high = scale * (highest(kind, ends, xi, u) + (0.0 if force is None else force(t)))
        return np.concatenate([y[SITES:], high]) if kind == "real" else high

    start = np.concatenate([u0, 0.3 * np.cos(np.arange(SITES))]) if kind == "real" else u0.astype(complex)
    y = solve_ivp(rate, times[[0, -1]], start, t_eval=times, method="DOP853", rtol=1e-11, atol=1e-12).y.T
    if kind == "real":
        return np.stack([y[:, :SITES], y[:, SITES:]], axis=1)[:, :, None]
    return np.stack([y.real, y.imag], axis=1)[:, None]


def fitted(kind, ends, effects=(), extra=(), **options):
    """A model as it is after a perfect fit: the coefficients known, the states those of the simulation."""
    order, declared, xi = LIBRARIES[kind]
    readings = simulated(kind, ends, **options)
    if kind == "real":
        samples = Samples(TIMES, readings[:, 0, 0], readings[:, 1, 0], ends=ends)
        states = readings.reshape(len(TIMES), -1)
    else:
        samples = Samples(TIMES, readings[:, 0, 0] + 1j * readings[:, 0, 1], ends=ends)
        states = readings.reshape(len(TIMES), -1)
    return perfect(Model(declared, order, tuple(effects)), samples, np.concatenate([xi, extra]), states)


def perfect(model, samples, xi, states, splines=None):
    levels = 1 if samples.v is None else 2
    solution = Solution(
        State(xi, (states,), (splines,)), np.full(levels, SIGMA), np.eye(len(xi)), np.ones(levels), np.ones(levels),
        1, True, (),
    )  # fmt: skip
    return Fitted(model, (samples,), tuple(model.records([samples])), solution)


def slope(make, step):
    """Central difference of readings by one number."""
    return (make(step) - make(-step)) / (2 * step)


def assert_same(columns, expected, tolerance=2e-4):
    expected = np.asarray(expected).ravel() / SIGMA
    assert np.linalg.norm(expected) > 0
    assert np.linalg.norm(np.ravel(columns) - expected) < tolerance * np.linalg.norm(expected)


CASES = [(kind, ends) for kind in LIBRARIES for ends in ("free", "fixed", "periodic")]


def push(kind):
    """A force that differs from site to site and turns in time."""
    place = 1.0 + np.arange(SITES) / 3
    if kind == "real":
        return lambda t: place * np.cos(1.3 * t + place)
    return lambda t: place * np.exp(1j * (1.3 * t + place))


@pytest.mark.parametrize(("kind", "ends"), CASES)
def test_the_answer_to_a_force_is_the_difference_of_two_simulations(kind, ends):
    path = linearise(fitted(kind, ends)).paths[0]
    force = push(kind)
    values = np.array([force(t) for t in path.times])
    source = np.stack([values.real, values.imag], axis=1) if kind == "complex" else values[:, None]
    answer = path.answer(np.stack([source, 2 * source]))
    assert_same(answer[:, 0], slope(lambda e: simulated(kind, ends, force=lambda t: e * force(t)), 1e-5))
    np.testing.assert_allclose(answer[:, 1], 2 * answer[:, 0])


@pytest.mark.parametrize(("kind", "ends"), CASES)
def test_a_coefficients_column_is_the_difference_of_two_simulations(kind, ends):
    tangent = linearise(fitted(kind, ends))
    xi = LIBRARIES[kind][2]
    path = tangent.paths[0]
    for j, unit in enumerate(np.eye(len(xi))):
        expected = slope(lambda e, unit=unit: simulated(kind, ends, xi=xi + e * unit), 1e-5).ravel() / SIGMA
        assert_same(tangent.jacobian[:, j], SIGMA * path.free(expected[:, None]))


def test_a_reading_that_was_not_seen_has_no_row():
    whole = fitted("real", "free")
    hole = whole.data[0].u.copy()
    hole[3, 2] = np.nan
    part = perfect(
        whole.model, replace(whole.data[0], u=hole), whole.solution.state.coefficients, whole.solution.state.nodes[0]
    )
    every, some = linearise(whole).paths[0], linearise(part).paths[0]
    source = np.ones((1, len(every.times), 1, SITES))
    expected = np.delete(every.answer(source)[:, 0], 3 * 2 * SITES + 2)
    np.testing.assert_allclose(some.answer(source)[:, 0], expected, rtol=1e-6, atol=1e-6 * np.max(abs(expected)))


# Unknown ends ---------------------------------------------------------------------------------------------------------

WIDE = 11


def inner_motion(samples, record, splines, start, border, xi):
    """Readings of a chain whose outer sites move as B-splines in time; the others by their equation."""
    drive = record.stretches.drive
    curves = BSpline(drive.knots, splines[:, 0], drive.degree)
    slopes = curves.derivative()
    inside = np.setdiff1d(np.arange(WIDE), border)

    def whole(t, y):
        u = np.empty(WIDE)
        u[border], u[inside] = curves(t), y[: len(inside)]
        return u

    def rate(t, y):
        u = whole(t, y)
        second = np.convolve(u, [1, -2, 1], "same")
        return np.concatenate([y[len(inside) :], (xi[0] * second + xi[1] * u + xi[2] * u**3)[inside]])

    t = samples.t
    y = solve_ivp(rate, t[[0, -1]], start, t_eval=t, method="DOP853", rtol=1e-11, atol=1e-12).y.T
    found = np.empty((len(t), 2, WIDE))
    found[:, 0, inside], found[:, 1, inside] = y[:, : len(inside)], y[:, len(inside) :]
    found[:, 0, border], found[:, 1, border] = curves(t), slopes(t)
    return found, y


def test_at_unknown_ends_what_the_start_and_the_outer_sites_splines_can_do_is_taken_off_and_nothing_else():
    order, declared, xi = LIBRARIES["real"]
    n = np.arange(WIDE)
    u = np.cos(0.8 * TIMES[:, None] + 0.5 * n)
    samples = Samples(TIMES, u, -0.8 * np.sin(0.8 * TIMES[:, None] + 0.5 * n), ends="unknown")
    model = Model(declared, order)
    record = model.records([samples])[0]
    border = record.stretches.dynamics.border
    assert list(border) == [0, 1, WIDE - 2, WIDE - 1]
    state = guess([samples], [record])
    splines, start = state.splines[0], state.nodes[0][0]

    def moved(placed, place=None, of_start=0.0):
        other = splines.copy()
        if place is not None:
            other[place] += placed
        return inner_motion(samples, record, other, start + of_start, border, xi)

    readings, nodes = moved(0.0)
    exact = replace(samples, u=readings[:, 0], v=readings[:, 1])
    path = linearise(perfect(model, exact, xi, nodes, splines)).paths[0]
    assert path.own.shape[1] <= nodes.shape[1] + splines.size
    draw = np.random.default_rng(0)
    for place in [(0, 0, 0), (0, 0, 1), (3, 0, 1), (len(splines) // 2, 0, 2), (len(splines) - 1, 0, 3)]:
        column = slope(lambda e, place=place: moved(e, place)[0], 1e-5).ravel()[:, None] / SIGMA
        assert np.linalg.norm(path.free(column)) < 2e-4 * np.linalg.norm(column)
    unit = draw.normal(size=len(start))
    column = slope(lambda e: moved(0.0, None, e * unit)[0], 1e-5).ravel()[:, None] / SIGMA
    assert np.linalg.norm(path.free(column)) < 2e-4 * np.linalg.norm(column)
    noise = draw.normal(size=column.shape)
    expected = np.sqrt(1 - path.own.shape[1] / len(noise))
    assert np.linalg.norm(path.free(noise)) / np.linalg.norm(noise) == pytest.approx(expected, abs=0.05)


# Parameters that are not coefficients ---------------------------------------------------------------------------------


def psi_column(model):
    """The first change's only columns, before anything is projected out."""
    return by_psi(model, 0, linearise(model).paths[0])


@pytest.mark.parametrize("ends", ["free", "periodic"])
def test_the_column_of_a_drives_frequency_is_the_difference_of_two_simulations(ends):
    placed = PlacedEffect(find("drive"), ("1",), {"omega": 1.7})

    def force(omega):
        return lambda t: 0.3 * np.cos(omega * t) - 0.2 * np.sin(omega * t)

    column = psi_column(fitted("real", ends, [placed], [0.3, -0.2], force=force(1.7)))
    assert_same(column, slope(lambda e: simulated("real", ends, force=force(1.7 + e)), 1e-4))


def test_the_column_of_a_complex_drives_frequency_is_the_difference_of_two_simulations():
    placed = PlacedEffect(find("drive"), find("drive").texts(1, True), {"omega": 1.7})

    def force(omega):
        return lambda t: (0.3 + 0.1j) * np.cos(omega * t) + (-0.2 + 0.4j) * np.sin(omega * t)

    # The forces' order: text by text (1, i), and for each cos and sin.
    model = fitted("complex", "free", [placed], [0.3, -0.2, 0.1, 0.4], force=force(1.7))
    assert_same(psi_column(model), slope(lambda e: simulated("complex", "free", force=force(1.7 + e)), 1e-4))


def test_the_columns_of_a_pulses_time_and_width_are_the_differences_of_two_simulations():
    placed = PlacedEffect(find("kick"), ("1",), {"at": 1.5, "width": 0.4})

    def force(at=1.5, width=0.4):
        return lambda t: 0.8 * np.exp(-(((t - at) / width) ** 2) / 2)

    columns = psi_column(fitted("real", "free", [placed], [0.8], force=force()))
    assert_same(columns[:, 0], slope(lambda e: simulated("real", "free", force=force(at=1.5 + e)), 1e-4), 1e-3)
    assert_same(columns[:, 1], slope(lambda e: simulated("real", "free", force=force(width=0.4 + e)), 1e-4), 1e-3)


@pytest.mark.parametrize("kind", LIBRARIES)
def test_the_column_of_a_delay_is_the_difference_of_two_simulations(kind):
    texts = find("memory").texts(*((1, True) if kind == "complex" else (2, False)))

    # Any smooth field will do; where it jumps in slope, as at the start of a record, the integral of the force is less
    # exact.
    def past(t):
        return np.sin(np.multiply.outer(t, 1 + np.arange(SITES) / 4)) * (1 if kind == "real" else 1 + 0.5j)

    placed = PlacedEffect(find("memory"), texts, {"delay": 0.63}, past=(past,))
    extra = [0.4, -0.3] if kind == "complex" else [0.4]
    amount = 0.4 - 0.3j if kind == "complex" else 0.4

    def force(delay):
        return lambda t: amount * past(t - delay)

    model = fitted(kind, "free", [placed], extra, force=force(0.63))
    assert_same(psi_column(model), slope(lambda e: simulated(kind, "free", force=force(0.63 + e)), 1e-3))


@pytest.mark.parametrize(("kind", "ends"), CASES)
def test_the_column_of_a_sites_mass_is_the_difference_of_two_simulations(kind, ends):
    placed = PlacedEffect(find("unequal-masses"), (), {"scale": 0.4}, site=2)
    unit = np.eye(SITES)[2]
    column = psi_column(fitted(kind, ends, [placed], scale=1 + 0.4 * unit))
    assert_same(column, slope(lambda e: simulated(kind, ends, scale=1 + (0.4 + e) * unit), 1e-4))


@pytest.mark.parametrize("kind", LIBRARIES)
def test_the_columns_of_the_instrument_are_the_differences_of_what_it_shows(kind):
    field = simulated(kind, "free")
    at_three, parts = np.eye(SITES)[3], 1 + (kind == "complex")

    def column(name, psi, both=False):
        return psi_column(fitted(kind, "free", [PlacedEffect(find(name), psi=psi, both=both, site=3)]))

    def only_u(wrong):
        whole = np.zeros(field.shape)
        whole[:, 0] = wrong
        return whole

    assert_same(column("sensor-gain", {"real_4": 0.0}), only_u(field[:, 0] * at_three), 1e-6)
    assert_same(column("sensor-gain", {"real_4": 0.0}, both=True), field * at_three, 1e-6)
    first = np.zeros((parts, SITES))
    first[0, 3] = 1
    assert_same(column("sensor-offset", {"real_4": 0.0}), only_u(np.broadcast_to(first, field[:, 0].shape)), 1e-6)
    if kind == "complex":
        assert_same(
            column("sensor-offset", {"imaginary_4": 0.0}), only_u(np.broadcast_to(first[::-1], field[:, 0].shape)), 1e-6
        )
        size = np.hypot(field[:, 0, 0], field[:, 0, 1])[:, None]
        assert_same(column("sensor-curve", {"real": 0.0}), only_u(size * field[:, 0]), 1e-6)
    else:
        both = np.stack([field[:, 0] ** 2, 2 * field[:, 0] * field[:, 1]], axis=1)
        assert_same(column("sensor-curve", {"real": 0.0}), only_u(field[:, 0] ** 2), 1e-6)
        assert_same(column("sensor-curve", {"real": 0.0}, both=True), both, 1e-6)


@pytest.mark.parametrize("kind", LIBRARIES)
def test_the_columns_of_the_clock_are_the_differences_of_what_is_read_at_other_times(kind):
    rate = psi_column(fitted(kind, "free", [PlacedEffect(find("clock"), psi={"rate": 0.0})]))

    def stretched(e):
        # A clock that is slow by e: the field is older than the time says. Both motions start at the same time.
        return simulated(kind, "free", times=TIMES * (1 + e))

    assert_same(rate, slope(stretched, 1e-5), 1e-5)
    row = psi_column(fitted(kind, "free", [PlacedEffect(find("clock"), psi={"row_6": 0.0})]))
    late = [simulated(kind, "free", times=np.array([0, TIMES[5] + e]))[1] for e in (1e-5, -1e-5)]
    expected = np.zeros((len(TIMES), *late[0].shape))
    expected[5] = (late[0] - late[1]) / 2e-5
    assert_same(row, expected, 1e-5)


# What is projected out ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", LIBRARIES)
def test_the_projections_are_orthogonal(kind):
    model = fitted(kind, "free", [PlacedEffect(find("unequal-masses"), (), {"scale": 0.0}, site=2)])
    noisy = replace(
        model.records[0],
        value=model.records[0].value + SIGMA * np.random.default_rng(1).normal(size=model.records[0].value.shape),
    )
    tangent = linearise(replace(model, records=(noisy,)))
    path = tangent.paths[0]
    for basis in (path.own, tangent.known):
        np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-10)
    assert tangent.known.shape[1] == 4
    assert np.max(np.abs(path.own.T @ tangent.known)) < 1e-9
    columns = path.free(np.random.default_rng(0).normal(size=(len(tangent.residual), 3)))
    left = tangent.new(columns)
    np.testing.assert_allclose(tangent.new(left), left, atol=1e-10)
    assert np.max(np.abs(tangent.known.T @ left)) < 1e-10
    assert np.all(tangent.new(tangent.jacobian @ np.ones((4, 1))) == 0)
    for basis in (path.own, tangent.known):
        assert np.max(np.abs(basis.T @ tangent.residual)) < 1e-8
    assert tangent.spare == len(tangent.residual) - path.own.shape[1] - 4
    assert np.sum(tangent.residual**2) / tangent.spare == pytest.approx(1, abs=5 * np.sqrt(2 / tangent.spare))


def test_two_records_columns_stand_under_each_other_and_share_nothing_but_the_parameters():
    one = fitted("real", "free")
    nodes = one.solution.state.nodes[0]
    state = replace(one.solution.state, nodes=(nodes, nodes), splines=(None, None))
    two = replace(one, data=one.data * 2, records=one.records * 2, solution=replace(one.solution, state=state))
    single, double = linearise(one), linearise(two)
    np.testing.assert_allclose(double.jacobian, np.concatenate([single.jacobian] * 2))
    assert double.known.shape[1] == single.known.shape[1]
    assert double.spare == 2 * single.spare + single.known.shape[1]


def test_columns_that_are_the_same_to_rounding_count_once():
    draw = np.random.default_rng(0)
    column = draw.normal(size=(30, 1))
    other = draw.normal(size=(30, 1))
    basis = orthonormal(np.concatenate([column, 1e6 * column + 1e-6, np.zeros((30, 1)), other], axis=1))
    assert basis.shape[1] == 2
    assert orthonormal(np.zeros((30, 2))).shape == (30, 0)
    assert orthonormal(np.zeros((30, 0))).shape == (30, 0)


# Dry friction ---------------------------------------------------------------------------------------------------------


def test_where_the_noise_hides_which_way_a_site_moves_friction_counts_by_its_mean():
    path = linearise(fitted("real", "free")).paths[0]
    v = path.field[:, 1]
    blurred = force_along(path, [Force(Term("sign(v[n])"))])[0]
    draw = np.random.default_rng(1)
    slowest = np.unravel_index(np.argmin(np.abs(v)), v.shape)
    expected = np.mean(np.sign(v[slowest] + SIGMA * draw.normal(size=100_000)))
    assert blurred[slowest] == pytest.approx(expected, abs=0.02)
    fast = np.abs(v) > 5 * SIGMA
    np.testing.assert_allclose(blurred[fast], np.sign(v)[fast], atol=1e-5)
