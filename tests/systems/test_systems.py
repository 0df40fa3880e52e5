"""What every system must keep to, and what the room may import."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from latticebench import systems
from latticebench.systems.motion import Motion, motion
from latticebench.systems.samples import SimulatedSamples
from latticebench.systems.simulate import simulate
from latticebench.systems.stencil import evaluate
from latticebench.systems.terms import Term

ROOT = Path(__file__).parents[2]
PAPER = ("dnls", "ginzburg-landau", "phi4", "sine-gordon")
LIBRARIES = [(name, library.name) for name in systems.names() for library in systems.find(name).libraries]

# The contract


def test_the_papers_four_systems_are_there():
    assert set(PAPER) <= set(systems.names())
    assert systems.names() == sorted(set(systems.names()))


@pytest.mark.parametrize("name", systems.names())
def test_a_system_says_what_it_is_and_where_it_comes_from(name):
    system = systems.find(name)
    assert system.name == name
    assert system.title
    assert system.source
    assert all(library.source for library in system.libraries)
    assert "equation" in [library.name for library in system.libraries]


@pytest.mark.parametrize("name", systems.names())
@pytest.mark.parametrize("ends", ["free", "fixed", "periodic", "antiperiodic"])
def test_a_system_simulates_on_every_end(name, ends):
    system = systems.find(name)
    for kind in system.initials:
        samples = simulate(system, sites=8, times=np.array([0.0, 0.1, 0.2]), ends=ends, initial=kind)
        assert isinstance(samples, SimulatedSamples)
        assert samples.u.shape == (3, 8)
        assert samples.is_complex == system.is_complex
        assert (samples.v is not None) == (system.order == 2)
        assert np.all(np.isfinite(samples.u))


@pytest.mark.parametrize("name", systems.names())
def test_a_system_starts_from_its_initial_state(name):
    system = systems.find(name)
    samples = simulate(system, times=np.array([0.0, 0.01]))
    u, v = system.initial_state({}, system.sites)
    np.testing.assert_allclose(samples.u[0], u, rtol=0, atol=1e-15)
    assert (v is None) == (system.order == 1)
    if v is not None:
        np.testing.assert_allclose(samples.v[0], v, rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", systems.names())
def test_a_system_has_a_truth_over_its_own_terms_that_reproduces_its_rate(name):
    system = systems.find(name)
    samples = simulate(system, sites=9, times=np.linspace(0, 1, 4))
    library = system.library("equation")
    truth = samples.truth(library)
    assert truth is not None
    values = evaluate(library.terms, samples.u, samples.v, None, samples.t, ends=system.ends)
    combined = np.einsum("pkts,k->pts", values, truth)
    np.testing.assert_allclose(combined[0], samples.rate.real, atol=1e-12)
    if system.is_complex:
        np.testing.assert_allclose(combined[1], samples.rate.imag, atol=1e-12)


@pytest.mark.parametrize(("name", "listed"), LIBRARIES)
def test_a_library_has_a_truth_that_reproduces_the_rate_or_none(name, listed):
    system = systems.find(name)
    library = system.library(listed)
    truth = system.truth(library, {})
    if truth is None:
        assert (name, listed) == ("sine-gordon", "powers")
        return
    draw = np.random.default_rng(1)
    shape = (3, 9)
    u = draw.normal(size=shape) + (1j * draw.normal(size=shape) if system.is_complex else 0)
    v = draw.normal(size=shape) + (1j * draw.normal(size=shape) if system.is_complex else 0)
    t = np.arange(3.0)
    values = np.einsum("pkts,k->pts", evaluate(library.terms, u, v, None, t, ends="periodic"), truth)
    wanted = evaluate([system.motion({})], u, v, None, t, ends="periodic")[:, 0]
    np.testing.assert_allclose(values, wanted, atol=1e-12)


@pytest.mark.parametrize(("name", "listed"), LIBRARIES)
def test_a_library_is_fit_for_its_field(name, listed):
    system = systems.find(name)
    library = system.library(listed)
    u = np.random.default_rng(0).normal(size=(2, 9)) * (1 + 1j if system.is_complex else 1)
    values = evaluate(library.terms, u, None, None, np.arange(2.0), ends="free")
    assert values.shape[:2] == (1 + system.is_complex, len(library.terms))
    assert np.all(np.isfinite(values))
    for term in library.terms:
        assert term.latex


@pytest.mark.parametrize("name", systems.names())
def test_the_right_hand_side_and_the_jacobian_have_the_size_of_the_state(name):
    system = systems.find(name)
    chain = motion(system, {}, 7)
    assert isinstance(chain, Motion)
    y = chain.pack(*system.initial_state({}, 7))
    assert y.shape == (system.order * (1 + system.is_complex) * 7,)
    assert chain.right_hand_side(0.0, y).shape == y.shape
    assert chain.jacobian(0.0, y).shape == (len(y), len(y))


@pytest.mark.parametrize("name", systems.names())
def test_the_same_call_gives_the_same_samples_to_the_last_digit(name):
    system = systems.find(name)
    first, again = (simulate(system, sites=6, times=np.array([0.0, 0.3, 0.5])) for _ in range(2))
    np.testing.assert_array_equal(first.u, again.u)
    np.testing.assert_array_equal(first.rate, again.rate)


# What the paper says


def grid(count, coupling):
    length = count / (2 * np.sqrt(coupling))
    return np.linspace(-length, length, count)


def test_the_initial_states_are_those_of_the_papers_table():
    count, v = 31, 0.5
    for name, kind, wanted in (
        ("phi4", "kink", lambda x: np.tanh(x / np.sqrt(1 - v**2))),
        ("sine-gordon", "kink", lambda x: 4 * np.arctan(np.exp(x / np.sqrt(1 - v**2)))),
        ("sine-gordon", "phi4-kink", lambda x: np.tanh(x / np.sqrt(1 - v**2))),
        ("dnls", "gauss", lambda x: np.exp(-(x**2))),
        ("ginzburg-landau", "hole", lambda x: np.tanh(x) * np.exp(1j * np.log(np.cosh(x)))),
    ):
        system = systems.find(name)
        for coupling in (2.0, 0.5):
            given = {"C": coupling, "v": v} if system.order == 2 else {"C": coupling}
            u, _ = system.initial_state(given, count, kind)
            np.testing.assert_allclose(u, wanted(grid(count, coupling)), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(("name", "kind"), [("phi4", "kink"), ("sine-gordon", "kink"), ("sine-gordon", "phi4-kink")])
def test_the_initial_velocity_is_that_of_a_profile_moving_at_v(name, kind):
    speed, step = 0.4, 1e-5
    system = systems.find(name)
    # Long enough for exp(x) to overflow at its end, which must not spoil the profile.
    u, v = system.initial_state({"C": 1.0, "v": speed}, 2001, kind)
    x = grid(2001, 1.0)
    shape = {"tanh": np.tanh, "kink": lambda y: 4 * np.arctan(np.exp(y))}["kink" if np.max(u) > 2 else "tanh"]
    gamma = 1 / np.sqrt(1 - speed**2)
    with np.errstate(over="ignore"):
        np.testing.assert_allclose(u, shape(gamma * x), rtol=1e-12)
        moved = (shape(gamma * (x - speed * step)) - shape(gamma * (x + speed * step))) / (2 * step)
    np.testing.assert_allclose(v, moved, atol=1e-9)


def test_the_integrators_are_the_papers():
    assert {name: systems.find(name).integrator for name in PAPER} == {
        "phi4": "rk4", "sine-gordon": "rk4", "dnls": "bdf", "ginzburg-landau": "bdf",
    }  # fmt: skip
    assert all(systems.find(name).ends == "free" for name in PAPER)
    assert all(systems.find(name).sites == 31 for name in PAPER)


C = 2.0
TRUTHS = {
    ("phi4", "lib1"): {"u[n+1]+u[n-1]-2*u[n]": C, "u[n]": 2, "u[n]**3": -2},
    ("phi4", "lib2"): {"u[n+1]": C, "u[n-1]": C, "u[n]": 2 - 2 * C, "u[n]**3": -2},
    ("phi4", "lib3"): {"u[n+1]": C, "u[n-1]": C, "u[n]": 2 - 2 * C, "u[n]**3": -2},
    ("phi4", "lib4"): {"u[n+1]": C, "u[n-1]": C, "u[n]": 2 - 2 * C, "u[n]**3": -2},
    ("phi4", "lib2-even"): {"u[n+1]": C, "u[n-1]": C, "u[n]": 2 - 2 * C, "u[n]**3": -2},
    ("sine-gordon", "sines"): {"u[n+1]": C, "u[n-1]": C, "u[n]": -2 * C, "sin(u[n])": -1},
    ("sine-gordon", "mixed"): {"u[n+1]": C, "u[n-1]": C, "u[n]": -2 * C, "sin(u[n])": -1},
    ("sine-gordon", "lib2"): {"u[n+1]": C, "u[n-1]": C, "u[n]": -2 * C, "sin(u[n])": -1},
    **{
        ("dnls", name): {"i*u[n+1]": C, "i*u[n-1]": C, "i*u[n]": -2 * C, "i*abs(u[n])**2*u[n]": 1}
        for name in ("four", "ten", "nine", "four-next")
    },
    **{
        ("ginzburg-landau", name): {
            "u[n+1]": C, "i*u[n+1]": C, "u[n-1]": C, "i*u[n-1]": C, "u[n]": 1 - 2 * C, "i*u[n]": -2 * C,
            "abs(u[n])**2*u[n]": -1, "i*abs(u[n])**2*u[n]": 1,
        }
        for name in ("four", "ten", "nine", "four-next")
    },
}  # fmt: skip


@pytest.mark.parametrize(("name", "listed"), TRUTHS)
def test_the_derived_truth_is_what_the_papers_equation_says(name, listed):
    system = systems.find(name)
    library = system.library(listed)
    truth = dict(zip(library.texts, system.truth(library, {"C": C}), strict=True))
    assert {text: value for text, value in truth.items() if value != 0} == pytest.approx(TRUTHS[name, listed])


def test_powers_cannot_express_the_sine():
    system = systems.find("sine-gordon")
    assert system.truth(system.library("powers"), {}) is None


@pytest.mark.parametrize(
    ("name", "listed", "size"),
    [
        ("phi4", "lib1", 4), ("phi4", "lib2", 4), ("phi4", "lib3", 6), ("phi4", "lib4", 13), ("phi4", "lib2-even", 6),
        ("sine-gordon", "sines", 8), ("sine-gordon", "powers", 5), ("sine-gordon", "mixed", 8),
        ("dnls", "four", 8), ("dnls", "ten", 20), ("dnls", "nine", 18),
        ("ginzburg-landau", "four", 8), ("ginzburg-landau", "ten", 20), ("ginzburg-landau", "nine", 18),
    ],
)  # fmt: skip
def test_the_libraries_have_the_papers_sizes_with_two_real_terms_for_a_complex_coefficient(name, listed, size):
    assert len(systems.find(name).library(listed).terms) == size


def test_the_symmetries_of_the_equations_are_the_papers():
    for name in PAPER:
        system = systems.find(name)
        equation = system.motion({})
        assert equation.parity == -1
        assert equation.turns_with_phase == system.is_complex


@pytest.mark.parametrize("name", PAPER)
def test_the_equations_do_not_change_when_the_chain_is_turned_round(name):
    system = systems.find(name)
    draw = np.random.default_rng(0)
    u = draw.normal(size=9) + (1j * draw.normal(size=9) if system.is_complex else 0)
    rates = []
    for field in (u, u[::-1]):
        chain = motion(system, {}, 9)
        rate = chain.unpack(chain.right_hand_side(0.0, chain.pack(field, None)))
        rates.append(rate[1] if system.order == 2 else rate[0])
    np.testing.assert_allclose(rates[0], rates[1][::-1], atol=1e-13)


# Imports


def test_listing_the_systems_loads_no_heavy_package():
    script = (
        "import sys\nfrom latticebench import systems\n"
        "listed = systems.names()\n"
        "assert all(systems.find(name).libraries for name in listed)\n"
        "print(*listed, sep=',')\n"
        "print(*{name.split('.')[0] for name in sys.modules}, sep=',')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    listed, loaded = (set(line.split(",")) for line in done.stdout.splitlines())
    assert set(PAPER) <= listed
    assert not loaded & {
        "sympy",
        "torch",
        "pandas",
        "scipy",
        "pysindy",
        "matplotlib",
        "sklearn",
        "pyarrow",
        "jaxtyping",
    }


def test_a_term_of_every_library_is_its_text():
    for name, listed in LIBRARIES:
        for text in systems.find(name).library(listed).texts:
            assert str(Term(text)) == text
