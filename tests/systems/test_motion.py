"""Motion: every right-hand side and Jacobian against plain loops and differences."""

import math

import numpy as np
import pytest

from latticebench import systems
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Initial, System
from latticebench.systems.motion import motion
from latticebench.systems.stencil import evaluate

ENDS = ("free", "fixed", "periodic", "antiperiodic")


@pytest.fixture(scope="module")
def by_loops(neighbour):
    """The highest time derivative of the paper's equations (1)-(4), site by site."""

    def by_loops(name, u, coupling, ends):
        rate = []
        for k in range(len(u)):
            here = complex(u[k])
            laplacian = neighbour(u, k + 1, ends) + neighbour(u, k - 1, ends) - 2 * here
            if name == "phi4":
                value = coupling * laplacian + 2 * (here - here**3)
            elif name == "sine-gordon":
                value = coupling * laplacian - math.sin(here.real)
            elif name == "dnls":
                # i du/dt = -C(...) - |u|^2 u, divided by i.
                value = (-coupling * laplacian - abs(here) ** 2 * here) / 1j
            else:
                value = (1 + 1j) * coupling * laplacian - (1 - 1j) * abs(here) ** 2 * here + here
            rate.append(value)
        return np.array(rate)

    return by_loops


def patterns(count, is_complex, seed=5):
    draw = np.random.default_rng(seed)
    turn = (0.6 + 0.8j) if is_complex else 1.0
    found = {
        "zeros": np.zeros(count),
        "ones": turn * np.ones(count),
        "alternating": turn * (-1.0) ** np.arange(count),
        "repeating by three": turn * np.array([0.3, -1.1, 0.7])[np.arange(count) % 3],
        "repeating by four": turn * np.array([1.0, 0.0, -1.0, 0.5])[np.arange(count) % 4],
        "ramp": turn * np.linspace(-1, 2, count),
        "one site": turn * (np.arange(count) == 0),
    }
    for k in range(3):
        field = draw.normal(size=count)
        found[f"random {k}"] = field + 1j * draw.normal(size=count) if is_complex else field
    return {key: field.astype(complex if is_complex else float) for key, field in found.items()}


@pytest.mark.parametrize("count", [1, 2, 3, 8, 31])
@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("name", ["dnls", "ginzburg-landau", "phi4", "sine-gordon"])
def test_the_right_hand_side_is_that_of_plain_loops(by_loops, name, ends, count):
    system = systems.find(name)
    for coupling in (2.0, 0.5):
        chain = motion(system, {"C": coupling}, count, ends)
        for pattern, u in patterns(count, system.is_complex).items():
            v = np.cos(u.real) if system.order == 2 else None
            rate = chain.right_hand_side(0.0, chain.pack(u, v))
            du, dv = chain.unpack(rate)
            if system.order == 2:
                np.testing.assert_array_equal(du, v)
            wanted = by_loops(name, u, coupling, ends)
            got = dv if system.order == 2 else du
            np.testing.assert_allclose(got, wanted, rtol=1e-13, atol=1e-13, err_msg=pattern)


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("name", ["dnls", "ginzburg-landau", "phi4", "sine-gordon"])
def test_terms_along_a_trajectory_sum_to_the_right_hand_side(by_loops, name, ends):
    system = systems.find(name)
    terms = system.library("equation").terms
    truth = system.truth(system.library("equation"), {})
    fields = np.stack(list(patterns(9, system.is_complex).values()))
    values = evaluate(terms, fields, None, None, np.arange(len(fields)) * 1.0, ends=ends)
    assert values.shape == (1 + system.is_complex, len(terms), len(fields), 9)
    combined = np.einsum("pkts,k->pts", values, truth)
    wanted = np.stack([by_loops(name, u, system.parameters["C"], ends) for u in fields])
    np.testing.assert_allclose(combined[0], wanted.real, atol=1e-13)
    if system.is_complex:
        np.testing.assert_allclose(combined[1], wanted.imag, atol=1e-13)


@pytest.mark.parametrize("count", [1, 2, 5, 12])
@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("name", ["dnls", "ginzburg-landau", "phi4", "sine-gordon"])
def test_the_jacobian_is_that_of_central_differences(name, ends, count):
    system = systems.find(name)
    chain = motion(system, {}, count, ends)
    u = patterns(count, system.is_complex)["random 1"]
    y = chain.pack(u, np.sin(u) if system.order == 2 else None)
    step = 1e-6
    columns = [
        (chain.right_hand_side(0.3, y + shift) - chain.right_hand_side(0.3, y - shift)) / (2 * step)
        for shift in step * np.eye(len(y))
    ]
    np.testing.assert_allclose(chain.jacobian(0.3, y).toarray(), np.stack(columns, axis=1), rtol=1e-7, atol=2e-8)


WIDE = "u[n+2]-4*u[n+1]+6*u[n]-4*u[n-1]+u[n-2] - 0.3*v[n+1]*v[n] + 0.2*v[n-2] + n*0.1*u[n] + sin(0.7*t)"


def a_system(**changes):
    fields = {
        "name": "own",
        "title": "own",
        "equation": WIDE,
        "order": 2,
        "is_complex": False,
        "parameters": {},
        "initials": {"bump": Initial("exp(-x**2)")},
        "libraries": (),
        "source": "here",
    }
    return System(**{**fields, **changes})


@pytest.mark.parametrize("ends", ENDS)
def test_a_wide_stencil_with_velocities_time_and_place_is_that_of_plain_loops(neighbour, ends):
    count, t = 7, 1.3
    draw = np.random.default_rng(2)
    u, v = draw.normal(size=(2, count))
    chain = motion(a_system(), {}, count, ends)
    y = chain.pack(u, v)
    _, got = chain.unpack(chain.right_hand_side(t, y))

    def at(field, k):
        return neighbour(field, k, ends)

    for k in range(count):
        place = k + 1 - (count + 1) / 2
        wanted = (
            at(u, k + 2) - 4 * at(u, k + 1) + 6 * u[k] - 4 * at(u, k - 1) + at(u, k - 2)
            - 0.3 * at(v, k + 1) * v[k] + 0.2 * at(v, k - 2) + 0.1 * place * u[k] + math.sin(0.7 * t)
        )  # fmt: skip
        assert got[k] == pytest.approx(wanted, rel=1e-12, abs=1e-13)
    step = 1e-6
    columns = [
        (chain.right_hand_side(t, y + shift) - chain.right_hand_side(t, y - shift)) / (2 * step)
        for shift in step * np.eye(len(y))
    ]
    np.testing.assert_allclose(chain.jacobian(t, y).toarray(), np.stack(columns, axis=1), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("is_complex", [False, True])
def test_packing_and_unpacking_a_state_gives_it_back(order, is_complex):
    field = "u[n]" if order == 1 else "u[n]+v[n]"
    chain = motion(a_system(equation=field, order=order, is_complex=is_complex), {}, 4)
    draw = np.random.default_rng(4)
    u, v = (draw.normal(size=4) + (1j * draw.normal(size=4) if is_complex else 0) for _ in range(2))
    got_u, got_v = chain.unpack(chain.pack(u, v))
    np.testing.assert_array_equal(got_u, u)
    assert (got_v is None) == (order == 1)
    if order == 2:
        np.testing.assert_array_equal(got_v, v)
    many = np.stack([chain.pack(u, v), chain.pack(2 * u, v)], axis=1)
    np.testing.assert_array_equal(chain.unpack(many)[0], np.stack([u, 2 * u]))


def test_an_equation_with_velocities_needs_second_order():
    with pytest.raises(InputError, match="no velocity"):
        motion(a_system(equation="-v[n]", order=1), {}, 5)


def test_an_equation_that_is_complex_on_a_real_field_is_refused():
    with pytest.raises(InputError, match="the field is real"):
        motion(a_system(equation="i*u[n]", order=1), {}, 5)


def test_a_measured_input_cannot_be_simulated():
    with pytest.raises(InputError, match="measured input"):
        _ = motion(a_system(equation="f[n]-u[n]"), {}, 5).right_hand_side
