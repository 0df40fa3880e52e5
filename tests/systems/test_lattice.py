"""Lattices: every right-hand side against plain loops, the ends, the Jacobian, and users' own systems."""

import dataclasses
import math

import numpy as np
import pytest

from latticebench import systems
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Initial, Library, System, library
from latticebench.systems.motion import motion
from latticebench.systems.stencil import evaluate, ghosts, observed
from latticebench.systems.terms import Term, split
from latticebench.systems.user_files import load_module, load_system

ENDS = ("free", "fixed", "periodic", "antiperiodic")

# A second implementation ----------------------------------------------------------------------------------------------------


def neighbour(u, k, ends):
    """The value at site k = 0..N-1, or what stands beyond the ends, written from their definitions."""
    count = len(u)
    if 0 <= k < count:
        return u[k]
    if ends == "fixed":
        return 0.0
    if ends == "periodic":
        return u[k - count] if k >= count else u[k + count]
    if ends == "antiperiodic":
        return -u[k - count] if k >= count else -u[k + count]
    # Free: u_0 = u_1 and u_{N+1} = u_N, further sites mirrored about the same bond.
    return u[-1 - k] if k < 0 else u[2 * count - 1 - k]


def by_loops(name, u, coupling, ends):
    """The highest time derivative of the paper's equations (1)-(4), site by site."""
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
def test_the_right_hand_side_is_that_of_plain_loops(name, ends, count):
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
def test_terms_along_a_trajectory_sum_to_the_right_hand_side(name, ends):
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
def test_a_wide_stencil_with_velocities_time_and_place_is_that_of_plain_loops(ends):
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


# Ends -----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ends", "wanted"),
    [
        ("free", [2, 1, 1, 2, 3, 4, 4, 3]),
        ("fixed", [0, 0, 1, 2, 3, 4, 0, 0]),
        ("periodic", [3, 4, 1, 2, 3, 4, 1, 2]),
        ("antiperiodic", [-3, -4, 1, 2, 3, 4, -1, -2]),
    ],
)
def test_two_sites_beyond_each_end_repeat_what_the_ends_say(ends, wanted):
    index, factor = ghosts(4, 2, 2, ends)
    np.testing.assert_array_equal(np.array([1.0, 2.0, 3.0, 4.0])[index] * factor, wanted)


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize(("count", "left", "right"), [(1, 1, 1), (2, 2, 1), (2, 0, 2), (3, 3, 0), (5, 2, 2)])
def test_ghosts_agree_with_the_definitions_of_the_ends(ends, count, left, right):
    u = np.random.default_rng(1).normal(size=count)
    index, factor = ghosts(count, left, right, ends)
    wanted = [neighbour(u, k, ends) for k in range(-left, count + right)]
    np.testing.assert_array_equal(u[index] * factor, wanted)


def test_unknown_ends_use_only_sites_whose_whole_stencil_was_observed():
    u = np.random.default_rng(1).normal(size=(3, 6))
    values = evaluate([Term("u[n+2]"), Term("u[n-1]")], u, None, None, np.arange(3.0), ends="unknown")
    np.testing.assert_array_equal(values[0, 0], u[:, 3:])
    np.testing.assert_array_equal(values[0, 1], u[:, 0:3])
    assert observed(6, (1, 2), "unknown") == slice(1, 4)
    assert observed(6, (1, 2), "free") == slice(0, 6)


@pytest.mark.parametrize(("ends", "count"), [("unknown", 2), ("free", 1), ("periodic", 1), ("antiperiodic", 1)])
def test_a_chain_shorter_than_the_stencil_is_refused_with_the_numbers(ends, count):
    reach = (1, 1) if ends == "unknown" else (2, 2)
    with pytest.raises(InputError, match=f"(have|has) {count}"):
        ghosts(count, *reach, ends)


def test_the_site_number_is_counted_from_the_middle():
    u = np.ones((2, 5))
    t = np.arange(2.0)
    for ends, wanted in (("free", [-2, -1, 0, 1, 2]), ("unknown", [-1, 0, 1])):
        values = evaluate(split("n*u[n]; u[n+1]; u[n-1]"), u, None, None, t, ends=ends)
        np.testing.assert_array_equal(values[0, 0, 0], wanted)


def test_a_missing_value_spoils_only_the_terms_that_see_it():
    u = np.ones((2, 6))
    u[0, 0] = np.nan
    terms = split("u[n]; u[n-1]; u[n-2]; u[n+1]")
    values = evaluate(terms, u, None, None, np.arange(2.0), ends="fixed")[0, :, 0]
    np.testing.assert_array_equal(np.isnan(values).nonzero(), [[0, 1, 2], [0, 1, 2]])
    np.testing.assert_array_equal(values[1:3, 0], [0, 0])


def test_time_velocity_and_input_reach_the_terms_that_name_them():
    draw = np.random.default_rng(0)
    u, v, f = draw.normal(size=(3, 4, 5))
    t = np.array([0.0, 0.1, 0.5, 0.6])
    values = evaluate(split("t*u[n]; v[n+1]; f[n-1]*u[n]; cos(2*t)"), u, v, f, t, ends="periodic")[0]
    np.testing.assert_allclose(values[0], t[:, None] * u)
    np.testing.assert_allclose(values[1], np.roll(v, -1, axis=1))
    np.testing.assert_allclose(values[2], np.roll(f, 1, axis=1) * u)
    np.testing.assert_allclose(values[3], np.cos(2 * t)[:, None] * np.ones(5))


@pytest.mark.parametrize("name", ["v", "f"])
def test_a_library_with_what_was_not_observed_is_refused(name):
    with pytest.raises(InputError, match=f"{name}1..{name}N"):
        evaluate([Term(f"{name}[n]")], np.ones((2, 3)), None, None, np.arange(2.0), ends="free")


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


# Libraries and parameters ---------------------------------------------------------------------------------------------------


def test_an_imaginary_companion_follows_each_term():
    made = library("two", "u[n]; u[n+1]-u[n]; u[n]/2; conj(u[n])**2", with_imaginary=True)
    values = evaluate(made.terms, np.array([[1 + 2j, 3 - 1j]] * 2), None, None, np.arange(2.0), ends="periodic")
    as_complex = values[0] + 1j * values[1]
    np.testing.assert_allclose(as_complex[1::2], 1j * as_complex[0::2])


def test_a_library_without_terms_or_with_one_twice_is_refused():
    with pytest.raises(InputError, match="'none' has no terms"):
        library("none", " ; ")
    with pytest.raises(InputError, match="twice"):
        Library("twice", split("u[n]; u[n+1]; u[n]"))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "2", None, True])
def test_a_parameter_that_is_no_finite_number_is_refused_by_name(value):
    with pytest.raises(InputError, match="parameter C"):
        systems.find("phi4").with_parameters({"C": value})


def test_an_unknown_parameter_library_or_initial_state_is_answered_with_the_nearest():
    phi4 = systems.find("phi4")
    with pytest.raises(InputError, match="did you mean 'C'"):
        phi4.with_parameters({"CC": 1.0})
    with pytest.raises(InputError, match=r"did you mean 'lib\d'"):
        phi4.library("lib9")
    with pytest.raises(InputError, match="did you mean 'kink'"):
        phi4.initial_state({}, 5, "kin")


@pytest.mark.parametrize("parameters", [{"C": 0.0}, {"C": -1.0}, {"v": 1.0}, {"v": -1.5}])
@pytest.mark.parametrize("name", ["phi4", "sine-gordon"])
def test_parameters_without_an_initial_state_are_told_and_not_simulated(name, parameters):
    with pytest.raises(InputError, match="check the parameters"):
        systems.find(name).initial_state(parameters, 11)


# A user's own system --------------------------------------------------------------------------------------------------------

TOML = {
    "name": '"pendula"',
    "equation": '"C*(u[n+1]+u[n-1]-2*u[n]) - sin(u[n]) - d*v[n]"',
    "order": "2",
    "parameters": "{C = 1, d = 0.1}",
    "initials": '{bump = {u = "exp(-x**2)", v = "0.1*x"}}',
    "libraries": '{own = ["u[n+1]+u[n-1]-2*u[n]", "sin(u[n])", "v[n]"], text = "u[n]; v[n]"}',
    "half_length": '"N/2"',
    "sites": "9",
    "ends": '"periodic"',
}


def write_toml(path, **changes):
    lines = {**TOML, **changes}
    path.write_text(
        "\n".join(f"{key} = {value}" for key, value in lines.items() if value is not None), encoding="utf-8"
    )
    return path


def test_a_system_from_a_toml_file_is_found_and_derives_its_truth(tmp_path):
    path = write_toml(tmp_path / "pendula.toml")
    system = systems.find(str(path))
    assert (system.name, system.sites, system.ends, system.order) == ("pendula", 9, "periodic", 2)
    np.testing.assert_allclose(system.truth(system.library("own"), {"d": 0.25}), [1, -1, -0.25])
    assert system.library("text").texts == ("u[n]", "v[n]")
    assert systems.find("pendula.toml", base=tmp_path) == system


def test_a_system_from_a_python_file_is_found(tmp_path):
    path = tmp_path / "rotor.py"
    path.write_text(
        "from __future__ import annotations\n"
        "from dataclasses import dataclass\n"
        "from latticebench.systems.lattice import Initial, System, library\n"
        "@dataclass\nclass Notes:\n    text: str = 'a dataclass of the user'\n"
        "SYSTEM = System(name='rotor', title='rotor', equation='-K*i*u[n]', order=1, is_complex=True,\n"
        "    parameters={'K': 2.0}, initials={'one': Initial('1')}, libraries=(library('own', 'i*u[n]'),), source='here')\n"
    )
    system = systems.find(str(path))
    assert system.name == "rotor"
    np.testing.assert_allclose(system.truth(system.library("own"), {}), [-2])


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"name": None}, "'name'"),
        ({"equation": None}, "'equation'"),
        ({"order": None}, "'order'"),
        ({"initials": None}, "'initials'"),
        ({"name": "3"}, "name"),
        ({"title": "3"}, "title"),
        ({"equation": "3"}, "equation"),
        ({"equation": '"K*u[n]"'}, "equation"),
        ({"equation": '"__import__(1)"'}, "equation"),
        ({"order": '"two"'}, "order"),
        ({"order": "3"}, "order"),
        ({"order": "true"}, "order"),
        ({"complex": '"false"'}, "complex"),
        ({"complex": "1"}, "complex"),
        ({"parameters": "3"}, "parameters"),
        ({"parameters": '{C = "two", d = 1}'}, "parameter C"),
        ({"parameters": "{C = nan, d = 1}"}, "parameter C"),
        ({"parameters": "{C = true, d = 1}"}, "parameter C"),
        ({"parameters": "{C = 1, d = 1, sin = 1}"}, "'sin'"),
        ({"parameters": "{C = 1, d = 1, x = 1}"}, "'x'"),
        ({"initials": "3"}, "initials"),
        ({"initials": "{}"}, "initial state"),
        ({"initials": '{bump = "x"}'}, "initials.bump"),
        ({"initials": '{bump = {w = "x"}}'}, "initials.bump"),
        ({"initials": '{bump = {u = "x", w = "x"}}'}, "initials.bump"),
        ({"initials": "{bump = {u = 3}}"}, "initials.bump.u"),
        ({"initials": '{bump = {u = "q"}}'}, "initials.bump.u"),
        ({"initials": '{bump = {u = "u[n]"}}'}, "initials.bump.u"),
        ({"initials": '{bump = {u = "x", v = "t"}}'}, "initials.bump.v"),
        ({"libraries": "3"}, "libraries"),
        ({"libraries": "{own = 3}"}, "libraries.own"),
        ({"libraries": "{own = [3]}"}, "libraries.own"),
        ({"libraries": '{own = ["q"]}'}, "libraries.own"),
        ({"libraries": "{own = []}"}, "'own'"),
        ({"libraries": '{own = ["u[n]", "u[n]"]}'}, "'own'"),
        ({"sites": '"many"'}, "sites"),
        ({"sites": "0"}, "sites"),
        ({"sites": "2.5"}, "sites"),
        ({"ends": '"open"'}, "ends"),
        ({"ends": '"unknown"'}, "ends"),
        ({"ends": '["free"]'}, "ends"),
        ({"integrator": '"euler"'}, "integrator"),
        ({"half_length": "3"}, "half_length"),
        ({"half_length": '"q"'}, "half_length"),
        ({"half_length": '"u[n]"'}, "half_length"),
        ({"notes": "3"}, "notes"),
        ({"source": "3"}, "source"),
        ({"equations": '"u[n]"'}, "did you mean 'equation'"),
    ],
    ids=str,
)
def test_each_mistake_in_a_toml_file_is_one_line_that_names_file_and_key(tmp_path, changes, key):
    path = write_toml(tmp_path / "wrong.toml", **changes)
    with pytest.raises(InputError) as caught:
        load_system(path)
    message = str(caught.value)
    assert str(path) in message
    assert key in message.replace(str(path), "")
    assert "\n" not in message


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"name = ", "not TOML"),
        (b"\xff\xfe\x00", "not a text file"),
        (b"", "missing"),
        (b"[initials]\n[initials]\n", "not TOML"),
    ],
)
def test_a_file_that_is_no_toml_is_named(tmp_path, content, words):
    path = tmp_path / "wrong.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        load_system(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"def f(:\n", "SyntaxError"),
        (b"1/0\n", "ZeroDivisionError"),
        (b"import no_such_module_anywhere\n", "ModuleNotFoundError"),
        (b"raise SystemExit(3)\n", "SystemExit"),
        (b"\xff\xfe", "SyntaxError"),
        (b"x = 1\n", "SYSTEM"),
        (b"SYSTEM = 3\n", "SYSTEM"),
        (b"from latticebench.systems.terms import Term\nTerm('q')\n", "unknown name 'q'"),
    ],
)
def test_each_mistake_in_a_python_file_is_one_error_that_names_it(tmp_path, content, words):
    path = tmp_path / "wrong.py"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        load_system(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("name", ["gone.py", "gone.toml"])
def test_a_missing_file_is_named(tmp_path, name):
    with pytest.raises(InputError, match="no such file"):
        systems.find(name, base=tmp_path)
    with pytest.raises(InputError, match="no such file"):
        load_module(tmp_path / name)


def test_an_unknown_system_is_answered_with_the_nearest():
    with pytest.raises(InputError, match="did you mean 'phi4'"):
        systems.find("phi5")


def test_an_equation_with_velocities_needs_second_order():
    with pytest.raises(InputError, match="no velocity"):
        motion(a_system(equation="-v[n]", order=1), {}, 5)


def test_an_equation_that_is_complex_on_a_real_field_is_refused():
    with pytest.raises(InputError, match="the field is real"):
        motion(a_system(equation="i*u[n]", order=1), {}, 5)


def test_a_measured_input_cannot_be_simulated():
    with pytest.raises(InputError, match="measured input"):
        _ = motion(a_system(equation="f[n]-u[n]"), {}, 5).right_hand_side


def test_a_system_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        systems.find("phi4").order = 1
