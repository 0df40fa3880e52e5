"""Simulation: the order of each integrator, closed forms, conserved quantities, and sampling."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import solve_ivp

from latticebench import systems
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Initial, System
from latticebench.systems.motion import motion
from latticebench.systems.samples import Samples
from latticebench.systems.simulate import (
    drift,
    follow,
    integrate,
    observe,
    runge_kutta,
    sample_times,
    simulate,
)
from latticebench.systems.stencil import evaluate
from latticebench.systems.terms import Term, substitute

ENDS = ("free", "fixed", "periodic", "antiperiodic")


def own(equation, order=2, is_complex=False, initial=("exp(-x**2)", "0"), **changes):
    fields = {
        "name": "own",
        "title": "own",
        "equation": equation,
        "order": order,
        "is_complex": is_complex,
        "parameters": {},
        "initials": {"start": Initial(*initial)},
        "libraries": (),
        "source": "here",
        "sites": 8,
    }
    return System(**{**fields, **changes})


# Integrators


def slope(steps, errors):
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


def test_runge_kutta_is_of_order_four_on_an_oscillator_with_a_known_motion():
    steps = np.array([0.1, 0.05, 0.025, 0.0125])
    errors = []
    for step in steps:
        y = runge_kutta(lambda _, y: np.array([y[1], -y[0]]), np.array([1.0, 0.0]), np.array([0.0, 5.0]), step)[:, -1]
        errors.append(np.max(np.abs(y - [np.cos(5), -np.sin(5)])))
    assert slope(steps, errors) == pytest.approx(4, abs=0.05)


def test_runge_kutta_is_of_order_four_when_the_force_depends_on_time():
    steps = np.array([0.1, 0.05, 0.025])
    errors = [
        abs(runge_kutta(lambda t, y: -2 * t * y, np.ones(1), np.array([0.0, 1.5]), step)[0, -1] - np.exp(-(1.5**2)))
        for step in steps
    ]
    assert slope(steps, errors) == pytest.approx(4, abs=0.15)


@pytest.mark.parametrize("name", ["phi4", "sine-gordon"])
def test_runge_kutta_is_of_order_four_on_the_lattices(name):
    system = systems.find(name)
    chain = motion(system, {}, 9)
    start = chain.pack(*system.initial_state({}, 9))
    times = np.array([0.0, 1.0])
    exact = integrate(chain, start, times, "dop853")[:, -1]
    steps = np.array([0.1, 0.05, 0.025])
    errors = [np.max(np.abs(runge_kutta(chain.right_hand_side, start, times, step)[:, -1] - exact)) for step in steps]
    assert slope(steps, errors) == pytest.approx(4, abs=0.2)


def test_runge_kutta_ends_exactly_on_uneven_sample_times():
    times = np.array([0.0, 0.01, 0.013, 0.5, 1.237, 1.2371, 3.0])
    seen = []

    def rate(t, y):
        seen.append(t)
        return np.array([1.0, np.cos(t)])

    states = runge_kutta(rate, np.zeros(2), times, 0.1)
    np.testing.assert_allclose(states[0], times, rtol=1e-14)
    np.testing.assert_allclose(states[1], np.sin(times), atol=1e-6)
    assert all(np.min(np.abs(np.array(seen) - t)) < 1e-14 for t in times)
    assert max(seen) <= times[-1]


def linear_chain(ends, order):
    """A chain of springs, and the matrix A of dy/dt = A y put together entry by entry."""
    count = 6
    system = own("0.7*(u[n+1]+u[n-1]-2*u[n])-0.2*u[n]" + ("-0.1*v[n]" if order == 2 else ""), order)
    matrix = np.zeros((count, count))
    for k in range(count):
        matrix[k, k] -= 1.4 + 0.2
        for other in (k - 1, k + 1):
            if 0 <= other < count:
                matrix[k, other] += 0.7
            elif ends == "free":
                matrix[k, k] += 0.7
            elif ends != "fixed":
                matrix[k, other % count] += 0.7 if ends == "periodic" else -0.7
    if order == 2:
        zero, one = np.zeros((count, count)), np.eye(count)
        matrix = np.block([[zero, one], [matrix, -0.1 * one]])
    return motion(system, {}, count, ends), matrix


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize(("method", "tolerance"), [("dop853", 1e-11), ("rk4", 1e-11), ("bdf", 1e-6)])
def test_each_integrator_follows_the_matrix_exponential_of_a_linear_lattice(method, tolerance, ends, order):
    chain, matrix = linear_chain(ends, order)
    start = np.random.default_rng(3).normal(size=len(matrix))
    times = np.array([0.0, 0.3, 1.1, 2.0])
    wanted = np.stack([scipy.linalg.expm(matrix * t) @ start for t in times], axis=1)
    np.testing.assert_allclose(integrate(chain, start, times, method), wanted, atol=tolerance)


def test_dop853_meets_the_tolerance_that_it_states():
    chain, matrix = linear_chain("free", 2)
    start = np.random.default_rng(4).normal(size=len(matrix))
    times = np.linspace(0, 10, 11)
    wanted = np.stack([scipy.linalg.expm(matrix * t) @ start for t in times], axis=1)
    assert np.max(np.abs(integrate(chain, start, times, "dop853") - wanted)) < 2e-12


@pytest.mark.parametrize("name", ["dnls", "ginzburg-landau"])
def test_the_error_of_backward_differences_falls_with_their_tolerance_and_the_stated_one_is_the_best(name):
    system = systems.find(name)
    chain = motion(system, {}, 11)
    start = chain.pack(*system.initial_state({}, 11))
    times = np.array([0.0, 1.0, 2.0])
    exact = integrate(chain, start, times, "dop853")
    errors = []
    for tolerance in (1e-3, 1e-5, 1e-7):
        found = solve_ivp(
            chain.right_hand_side, (0, 2), start, method="BDF", t_eval=times, jac=chain.jacobian,
            rtol=tolerance, atol=tolerance / 100,
        )  # fmt: skip
        errors.append(np.max(np.abs(found.y - exact)))
    errors.append(np.max(np.abs(integrate(chain, start, times, "bdf") - exact)))
    assert all(late < early / 10 for early, late in itertools.pairwise(errors))
    assert errors[-1] < 1e-6


@pytest.mark.parametrize("name", systems.names())
def test_the_papers_integrator_and_the_reference_give_the_same_samples(name):
    system = systems.find(name)
    times = sample_times(6, 2.0)
    usual = simulate(system, sites=12, times=times)
    reference = simulate(system, sites=12, times=times, integrator="dop853")
    np.testing.assert_allclose(usual.u, reference.u, atol=1e-11 if system.integrator == "rk4" else 1e-6)


@pytest.mark.parametrize("method", ["bdf", "dop853"])
def test_a_motion_that_would_take_hopelessly_many_evaluations_is_told_soon(method, monkeypatch):
    monkeypatch.setattr("latticebench.systems.simulate.TRIED", 1000)
    with pytest.raises(InputError, match=r"too fast: to t = 3\.0625 it would take"):
        simulate(own("-1e12*sin(1e12*u[n])"), integrator=method, times=sample_times(8, 3.5))


def test_a_force_that_is_not_finite_is_told():
    with pytest.raises(InputError, match="grows without bound"):
        simulate(own("exp(1e9)"))


@pytest.mark.parametrize("method", ["rk4", "bdf", "dop853"])
def test_a_state_that_grows_without_bound_is_told(method):
    with pytest.raises(InputError, match="without bound"):
        simulate(own("5*u[n]**3", 1, initial=("2", "0")), integrator=method)


@pytest.mark.parametrize("method", ["bdf", "dop853"])
def test_where_no_step_is_small_enough_the_motion_is_told_to_end(method):
    # u' = -1/u from 1 is sqrt(1 - 2 t), which ends at t = 1/2.
    with pytest.raises(InputError, match=r"fails near t = 0\.4375"):
        simulate(own("-1/u[n]", 1, initial=("1", "0")), integrator=method, times=sample_times(8, 3.5))


def test_a_chain_that_breaks_off_is_followed_as_far_as_it_goes():
    # u' = u^2 from 1 is 1/(1 - t), which ends at t = 1.
    chain = motion(own("u[n]**2", 1), {}, 3)
    times = np.array([0.0, 0.5, 0.9, 1.1, 2.0])
    states, reached = follow(chain, np.ones(3), times, 1e-10, 100_000)
    assert reached == 3
    np.testing.assert_allclose(states[0], 1 / (1 - times[:3]), rtol=1e-8)
    assert follow(chain, np.ones(3), times, 1e-10, 20)[1] == 1
    whole, reached = follow(chain, -np.ones(3), times, 1e-10, 100_000)
    assert reached == 5
    np.testing.assert_allclose(whole[0], -1 / (1 + times), rtol=1e-8)


# Closed forms


def test_a_uniform_ginzburg_landau_ring_follows_its_closed_form():
    # u = r exp(i a) has r' = r - r^3 and a' = r^2, so that r^2 = 1/(1 + c exp(-2t)) and
    # a = t + ln((1 + c exp(-2t))/(1 + c))/2.
    start = 0.3
    c = 1 / start**2 - 1
    system = systems.find("ginzburg-landau")
    times = np.linspace(0, 4, 9)
    chain = motion(system, {}, 5, "periodic")
    for method, tolerance in (("dop853", 1e-11), ("bdf", 1e-6)):
        u = chain.unpack(integrate(chain, chain.pack(np.full(5, start + 0j), None), times, method))[0]
        radius = 1 / np.sqrt(1 + c * np.exp(-2 * times))
        angle = times + np.log((1 + c * np.exp(-2 * times)) / (1 + c)) / 2
        wanted = (radius * np.exp(1j * angle))[:, None] * np.ones(5)
        np.testing.assert_allclose(u, wanted, atol=tolerance)


@pytest.mark.parametrize("wave_number", [0, 1, 3])
def test_a_plane_wave_on_a_dnls_ring_turns_at_its_frequency(wave_number):
    count, coupling, amplitude = 8, 2.0, 0.7
    k = 2 * np.pi * wave_number / count
    frequency = 4 * coupling * np.sin(k / 2) ** 2 - amplitude**2
    sites, times = np.arange(count), np.linspace(0, 3, 7)
    chain = motion(systems.find("dnls"), {"C": coupling}, count, "periodic")
    start = amplitude * np.exp(1j * k * sites)
    u = chain.unpack(integrate(chain, chain.pack(start, None), times))[0]
    np.testing.assert_allclose(u, amplitude * np.exp(1j * (k * sites - frequency * times[:, None])), atol=1e-11)


def test_a_small_phonon_of_phi4_about_a_well_has_its_frequency():
    count, coupling, size = 8, 2.0, 1e-5
    k = 2 * np.pi / count
    frequency = np.sqrt(4 + 4 * coupling * np.sin(k / 2) ** 2)
    mode, times = np.cos(k * np.arange(count)), np.linspace(0, 5, 11)
    chain = motion(systems.find("phi4"), {"C": coupling}, count, "periodic")
    u = chain.unpack(integrate(chain, chain.pack(1 + size * mode, np.zeros(count)), times, "rk4"))[0]
    np.testing.assert_allclose((u - 1) / size, mode * np.cos(frequency * times)[:, None], atol=1e-4)


@pytest.mark.parametrize(("name", "level"), [("sine-gordon", np.pi), ("phi4", 0.0)])
def test_a_kink_near_the_continuum_moves_at_its_speed(name, level):
    speed, coupling, count = 0.5, 25.0, 201
    spacing = 1 / np.sqrt(coupling)
    times = np.linspace(0, 6, 7)
    samples = simulate(
        systems.find(name), parameters={"C": coupling, "v": speed}, sites=count, times=times, integrator="dop853"
    )
    # Positions are taken from [-L, L] with N points, so that they are N/(N-1) lattice spacings apart.
    x = np.linspace(-count * spacing / 2, count * spacing / 2, count)
    centres = np.array([np.interp(level, row, x) for row in np.maximum.accumulate(samples.u, axis=1)])
    velocities = np.diff(centres) / np.diff(times)
    np.testing.assert_allclose(velocities, speed, rtol=0.02)


# Conserved quantities


def bond_sum(u, ends):
    """Sum |u_{n+1} - u_n|^2 over the bonds of each row, those to walls and around the ring too."""
    total = sum(abs(u[:, k + 1] - u[:, k]) ** 2 for k in range(u.shape[1] - 1))
    first, last = u[:, 0], u[:, -1]
    across = {
        "free": 0,
        "fixed": abs(first) ** 2 + abs(last) ** 2,
        "periodic": abs(first - last) ** 2,
        "antiperiodic": abs(first + last) ** 2,
    }
    return total + across[ends]


def energy(name, u, v, coupling, ends):
    if name == "phi4":
        return np.sum(v**2 / 2 + (u**2 - 1) ** 2 / 2, axis=1) + coupling / 2 * bond_sum(u, ends)
    if name == "sine-gordon":
        return np.sum(v**2 / 2 + 1 - np.cos(u), axis=1) + coupling / 2 * bond_sum(u, ends)
    return coupling * bond_sum(u, ends) - np.sum(np.abs(u) ** 4, axis=1) / 2


def random_motion(name, ends, integrator, span=5.0):
    system = systems.find(name)
    samples = simulate(
        system,
        sites=10,
        times=np.linspace(0, span, 11),
        ends=ends,
        variation=np.random.default_rng(6),
        integrator=integrator,
    )
    assert np.ptp(np.abs(samples.u)) > 0.1
    return samples, system.parameters["C"]


@pytest.mark.parametrize(("integrator", "span"), [("rk4", 2.0), ("dop853", 5.0)])
@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("name", ["phi4", "sine-gordon"])
def test_the_energy_of_a_second_order_lattice_is_kept(name, ends, integrator, span):
    samples, coupling = random_motion(name, ends, integrator, span)
    kept = energy(name, samples.u, samples.v, coupling, ends)
    assert np.ptp(samples.v) > 0.1
    np.testing.assert_allclose(kept, kept[0], rtol=2e-11)


@pytest.mark.parametrize(("integrator", "tolerance"), [("bdf", 2e-6), ("dop853", 2e-11)])
@pytest.mark.parametrize("ends", ENDS)
def test_the_norm_and_the_energy_of_the_dnls_lattice_are_kept(ends, integrator, tolerance):
    samples, coupling = random_motion("dnls", ends, integrator)
    norm = np.sum(np.abs(samples.u) ** 2, axis=1)
    np.testing.assert_allclose(norm, norm[0], rtol=tolerance)
    kept = energy("dnls", samples.u, None, coupling, ends)
    np.testing.assert_allclose(kept, kept[0], rtol=0, atol=tolerance * np.sum(coupling * norm[0]))


@pytest.mark.parametrize("ends", ENDS)
def test_the_norm_of_the_ginzburg_landau_lattice_changes_as_its_balance_says(ends):
    system = systems.find("ginzburg-landau")
    samples = simulate(system, sites=9, times=np.linspace(0, 1, 5), ends=ends, variation=np.random.default_rng(1))
    u, rate = samples.u, samples.rate
    change = np.sum(2 * np.real(np.conj(u) * rate), axis=1)
    balance = 2 * np.sum(np.abs(u) ** 2 - np.abs(u) ** 4, axis=1) - 2 * system.parameters["C"] * bond_sum(u, ends)
    np.testing.assert_allclose(change, balance, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("name", ["phi4", "sine-gordon", "dnls"])
def test_the_conserved_density_of_a_lattice_sums_to_its_energy_or_norm(name, ends):
    samples, coupling = random_motion(name, ends, "dop853", 2.0)
    system = systems.find(name)
    density = Term(substitute(system.conserved, system.parameters))
    found = np.sum(evaluate([density], samples.u, samples.v, None, samples.t, ends=ends)[0, 0], axis=1)
    norm = np.sum(np.abs(samples.u) ** 2, axis=1)
    wanted = norm if name == "dnls" else energy(name, samples.u, samples.v, coupling, ends)
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    assert drift(system, {}, samples, ends) < 2e-11
    faster = replace(samples, u=samples.u * np.where(samples.t > 1, 1.001, 1.0)[:, None])
    assert drift(system, {}, faster, ends) > 1e-5


def test_a_field_that_doubles_has_drifted_by_three_times_its_norm():
    samples = Samples(np.array([0.0, 1.0, 2.0]), np.array([[1.0 + 1j, 2.0]] * 3) * np.array([[1.0], [2.0], [1.5]]))
    assert drift(systems.find("dnls"), {}, samples, "fixed") == pytest.approx(3.0)


def test_a_lattice_that_conserves_nothing_has_no_drift():
    samples = simulate(systems.find("ginzburg-landau"), sites=9, times=np.array([0.0, 0.1]))
    assert drift(systems.find("ginzburg-landau"), {}, samples) is None


# Large lattices


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("name", systems.names())
def test_a_right_hand_side_in_parts_of_the_chain_is_that_of_the_whole_chain(monkeypatch, name, ends):
    system = systems.find(name)
    draw = np.random.default_rng(2)
    whole = motion(system, {}, 23, ends)
    y = draw.normal(size=system.order * whole.parts * 23)
    wanted = whole.right_hand_side(0.3, y)
    monkeypatch.setattr("latticebench.systems.motion.CACHED", 5)
    np.testing.assert_allclose(motion(system, {}, 23, ends).right_hand_side(0.3, y), wanted, rtol=1e-14, atol=1e-14)


def test_a_large_lattice_is_integrated_by_the_reference_unless_asked_otherwise():
    system, times = systems.find("phi4"), np.array([0.0, 0.01, 0.02])
    for sites, usual in ((1000, "rk4"), (1001, "dop853")):
        found = simulate(system, sites=sites, times=times)
        np.testing.assert_array_equal(found.u, simulate(system, sites=sites, times=times, integrator=usual).u)


# Sampling


def test_the_papers_samples_are_fifty_at_steps_of_a_fifth():
    times = sample_times()
    np.testing.assert_allclose(times, 0.2 * np.arange(50), atol=1e-14)
    samples = simulate(systems.find("phi4"), times=times[:3])
    assert samples.u.shape == (3, 31)
    assert samples.is_even


def test_uneven_times_start_at_zero_increase_and_follow_their_seed():
    first, again, other = (sample_times(40, 10.0, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert first[0] == 0
    assert np.all(np.diff(first) > 0)
    assert first[-1] < 10
    samples = simulate(systems.find("phi4"), sites=5, times=first[:6])
    assert not samples.is_even
    np.testing.assert_array_equal(samples.t, first[:6])


def test_the_motion_does_not_depend_on_when_it_is_looked_at():
    system = systems.find("sine-gordon")
    coarse = simulate(system, sites=7, times=np.array([0.0, 2.0]), integrator="dop853")
    fine = simulate(system, sites=7, times=np.array([0.0, 0.1, 0.77, 1.9, 2.0]), integrator="dop853")
    np.testing.assert_allclose(coarse.u[-1], fine.u[-1], atol=1e-11)


@pytest.mark.parametrize("name", systems.names())
def test_the_velocity_and_the_rate_are_the_derivatives_of_the_field(name):
    system = systems.find(name)
    step = 1e-3
    samples = simulate(system, sites=9, times=1 + step * np.arange(-2, 3), integrator="dop853")
    u = samples.u
    slope_of_u = (u[0] - 8 * u[1] + 8 * u[3] - u[4]) / (12 * step)
    if system.order == 1:
        np.testing.assert_allclose(slope_of_u, samples.rate[2], atol=1e-9)
        assert samples.v is None
    else:
        v = samples.v
        np.testing.assert_allclose(slope_of_u, v[2], atol=1e-9)
        np.testing.assert_allclose((v[0] - 8 * v[1] + 8 * v[3] - v[4]) / (12 * step), samples.rate[2], atol=1e-9)


def test_velocities_can_be_left_out():
    exact = simulate(systems.find("phi4"), sites=5, times=np.array([0.0, 0.1]))
    samples = observe(exact, np.random.default_rng(0), velocities=False)
    assert samples.v is None
    assert samples.exact.v is not None


def test_varied_trajectories_differ_and_the_same_seed_gives_the_same():
    system = systems.find("dnls")

    def start(seed):
        draw = None if seed is None else np.random.default_rng(seed)
        return system.initial_state({}, 21, variation=draw)[0]

    np.testing.assert_array_equal(start(1), start(1))
    written = start(None)
    for one, other in ((start(1), start(2)), (start(1), written), (start(2), written)):
        distance = np.linalg.norm(one - other) / np.linalg.norm(written)
        assert 0.01 < distance < 2


def test_several_draws_from_one_generator_give_several_trajectories():
    draw = np.random.default_rng(9)
    starts = [simulate(systems.find("phi4"), sites=6, times=np.array([0, 0.01]), variation=draw).u[0] for _ in range(3)]
    assert all(not np.allclose(starts[a], starts[b]) for a, b in ((0, 1), (0, 2), (1, 2)))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"sites": 0}, "sites"),
        ({"ends": "unknown"}, "ends"),
        ({"initial": "hump"}, "initial state"),
        ({"parameters": {"K": 1.0}}, "parameter"),
        ({"times": np.array([0.0])}, "times"),
        ({"times": np.array([0.0, 2.0, 1.0])}, "times"),
        ({"times": np.array([0.0, np.nan])}, "times"),
        ({"sites": 10**9}, "more than"),
    ],
    ids=lambda value: str(value)[:30],
)
@pytest.mark.parametrize("integrator", ["rk4", "bdf", "dop853"])
def test_an_unsound_setting_is_refused_by_name(integrator, settings, words):
    with pytest.raises(InputError, match=words):
        simulate(systems.find("phi4"), integrator=integrator, **settings)


@pytest.mark.parametrize(("count", "span"), [(1, 10.0), (0, 10.0), (5, 0.0), (5, -1.0), (5, float("nan"))])
def test_unsound_sample_times_are_refused(count, span):
    with pytest.raises(InputError):
        sample_times(count, span)
