"""Files of users: a system or a catalogue is read, and each mistake is one line that names file and place."""

import numpy as np
import pytest

from latticebench import systems
from latticebench.systems.effects import Effect
from latticebench.systems.errors import InputError
from latticebench.systems.user_files import load_effects, load_module, load_system

# A system

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
        "    parameters={'K': 2.0}, initials={'one': Initial('1')}, libraries=(library('own', 'i*u[n]'),),\n"
        "    source='here')\n"
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


# A catalogue of effects

GOOD = """
[[effect]]
name = "cubic-drag"
formula = "v[n]**3"
orders = [2]
look_for = "amplitudes that fall as one over the root of time"

[[effect]]
name = "twist"
formula = "u[n+1]-u[n-1]"
complex_field = "conj(u[n])"
acts = "harmonic"
real = true
source = "me"
"""


def test_a_users_own_catalogue_is_read(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(GOOD)
    drag, twist = load_effects(path)
    assert drag == Effect(
        "cubic-drag", "v[n]**3", orders=(2,), look_for="amplitudes that fall as one over the root of time"
    )
    assert drag.texts(1, False) == ()
    assert twist.acts == "harmonic"
    assert twist.texts(1, True) == ("conj(u[n])",)


BASE = 'name = "first"\nformula = "u[n]"\n\n[[effect]]\n'


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        ('name = "mine"\nformula = "u[n]"\ncolour = "red"', "colour"),
        ('name = "mine"', "formula"),
        ('formula = "u[n]"', "name"),
        ('name = "mine"\nformula = 3', "formula"),
        ('name = "mine"\nformula = "u[n"', "mine"),
        ('name = "mine"\nformula = "__import__(1)"', "mine"),
        ('name = "mine"\nformula = "u[n]"\ncomplex_field = "q[n]"', "mine"),
        ('name = "My Effect"\nformula = "u[n]"', "My Effect"),
        ('name = "mine"\nformula = "u[n]"\nacts = "sometimes"', "sometimes"),
        ('name = "mine"\nformula = "u[n]"\nacts = 3', "acts"),
        ('name = "mine"\nformula = "u[n]"\norders = [3]', "orders"),
        ('name = "mine"\nformula = "u[n]"\norders = []', "orders"),
        ('name = "mine"\nformula = "u[n]"\norders = 2', "orders"),
        ('name = "mine"\nformula = "u[n]"\norders = ["2"]', "orders"),
        ('name = "mine"\nformula = "u[n]"\norders = [[1]]', "orders"),
        ('name = "mine"\nformula = "u[n]"\norders = [true]', "orders"),
        ('name = "mine"\nformula = ""', "mine"),
        ('name = "mine"\nformula = "u[n]"\nreal = 1', "real"),
        ('name = "mine"\nformula = "u[n]"\ntakes = "yes"', "takes"),
        ('name = "mine"\nformula = "u[n]"\nlook_for = 1', "look_for"),
    ],
)
def test_a_bad_entry_is_refused_by_file_number_and_fault(tmp_path, entry, says):
    path = tmp_path / "mine.toml"
    path.write_text(f"[[effect]]\n{BASE}{entry}\n")
    with pytest.raises(InputError) as caught:
        load_effects(path)
    text = str(caught.value)
    assert "mine.toml: effect 2" in text
    assert says in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (f'[[effect]]\n{BASE}name = "first"\nformula = "v[n]"', "first"),
        ('[[effect]]\nname = "damping"\nformula = "v[n]"', "damping"),
        ('effect = "damping"', "[[effect]]"),
        ("effect = []", "[[effect]]"),
        ("effect = [3]", "effect 1"),
        ('[effect]\nname = "mine"\nformula = "u[n]"', "[[effect]]"),
        ("", "[[effect]]"),
        ('[[efect]]\nname = "mine"\nformula = "u[n]"', "efect"),
        ("[[effect", "mine.toml"),
    ],
)
def test_a_file_that_is_no_catalogue_is_refused_by_name_and_fault(tmp_path, content, says):
    path = tmp_path / "mine.toml"
    path.write_text(content)
    with pytest.raises(InputError) as caught:
        load_effects(path)
    assert "mine.toml" in str(caught.value)
    assert says in str(caught.value)


def test_a_catalogue_that_is_not_there_is_refused_by_name(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.toml"):
        load_effects(tmp_path / "nowhere.toml")
