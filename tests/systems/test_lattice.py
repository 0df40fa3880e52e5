"""Libraries and systems: what is invalid is refused by its name."""

import dataclasses

import numpy as np
import pytest

from latticebench import systems
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library, library
from latticebench.systems.stencil import evaluate
from latticebench.systems.terms import split


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


@pytest.mark.parametrize("other", ["(u[n+1])", "u[ n + 1 ]", "u[n+0x1]"])
def test_a_term_that_is_written_in_two_ways_is_one_term_twice(other):
    with pytest.raises(InputError, match=r"also written 'u\[n\+1\]', twice"):
        Library("twice", split(f"u[n+1]; {other}"))


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


def test_an_unknown_system_is_answered_with_the_nearest():
    with pytest.raises(InputError, match="did you mean 'phi4'"):
        systems.find("phi5")


def test_a_system_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        systems.find("phi4").order = 1
