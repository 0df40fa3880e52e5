"""Terms: their properties are those of the text, and equations are derived over libraries of them."""

import matplotlib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.mathtext import MathTextParser

from latticebench import systems
from latticebench.systems.errors import InputError
from latticebench.systems.parser import TermError
from latticebench.systems.terms import Term, combination, express, split, substitute

matplotlib.use("Agg")


@pytest.mark.parametrize("text", ["u[n]/0", "log(0)*u[n]", "u[n]*0**(0-1)"])
def test_a_division_by_zero_is_told_before_anything_is_computed(text):
    with pytest.raises(TermError):
        _ = Term(text).expression


# Properties


def every_text():
    for name in systems.names():
        system = systems.find(name)
        yield system.motion({}).text
        for library in system.libraries:
            yield from library.texts


def test_the_latex_of_every_term_can_be_typeset(cases):
    parser = MathTextParser("path")
    for text in sorted({*every_text(), *(text for text, _ in cases)}):
        latex = Term(text).latex
        assert latex
        parser.parse(f"${latex}$")


def test_latex_reads_as_the_formula():
    assert Term("u[n+1]").latex == "u_{n+1}"
    assert Term("u[n]**3").latex == "u_{n}^{3}"
    assert Term("sin(2*u[n])").latex == r"\sin{\left(2 u_{n} \right)}"


@pytest.mark.parametrize(
    ("text", "parity"),
    [
        ("u[n]", -1),
        ("u[n+1]+u[n-1]-2*u[n]", -1),
        ("u[n]**2", 1),
        ("u[n]**3", -1),
        ("u[n]**2+u[n]", None),
        ("sin(3*u[n])", -1),
        ("cos(u[n])", 1),
        ("u[n]*v[n]", 1),
        ("abs(u[n])**2*u[n]", -1),
        ("abs(u[n])**2", 1),
        ("sign(v[n])", -1),
        ("exp(u[n])", None),
        ("n*u[n]", -1),
        ("cos(1.7*t)", 1),
        ("t*f[n]", -1),
        ("conj(u[n])**2", 1),
    ],
)
def test_parity_is_that_of_the_formula(text, parity):
    assert Term(text).parity == parity


def test_parity_agrees_with_the_numbers(text, plainly, draw_values):
    values, t, n = draw_values(11, True)
    plus, minus = (
        np.array([plainly(text, {k: sign * a[j] for k, a in values.items()}, t[j], n[j]) for j in range(4)])
        for sign in (1, -1)
    )
    same, opposite = np.allclose(plus, minus), np.allclose(plus, -minus)
    assert Term(text).parity == (1 if same else -1 if opposite else None)


@pytest.mark.parametrize(
    ("text", "turns"),
    [
        ("u[n]", True),
        ("i*u[n+1]", True),
        ("u[n+1]+u[n-1]-2*u[n]", True),
        ("abs(u[n])**2*u[n]", True),
        ("abs(u[n])**2*(u[n+1]+u[n-1])", True),
        ("u[n]*(abs(u[n+1])**2+abs(u[n-1])**2)", True),
        ("conj(u[n])*u[n+1]**2", True),
        ("(1+i)*2*(u[n+1]-u[n]) - (1-i)*abs(u[n])**2*u[n] + u[n]", True),
        ("abs(u[n])**2", False),
        ("conj(u[n])**2", False),
        ("conj(u[n])", False),
        ("u[n]**2", False),
        ("u[n]**3", False),
        ("sin(u[n])", False),
        ("re(u[n])", False),
        ("1", False),
    ],
)
def test_phase_symmetry_is_that_of_the_formula(text, turns):
    assert Term(text).turns_with_phase is turns


def test_reach_and_sites_are_those_of_the_text():
    term = Term("u[n+3]*v[n-2]+f[n]")
    assert term.reach == (2, 3)
    assert term.sites == {("u", 3), ("v", -2), ("f", 0)}
    assert term.names == {"u", "v", "f"}
    assert Term("n*u[n+1]").names == {"n", "u"}
    assert Term("u[n+1]").reach == (0, 1)
    assert Term("u[n-1]").reach == (1, 0)


@pytest.mark.parametrize(
    ("text", "degrees"),
    [
        ("u[n]", (1, 0, 0)), ("2", (0, 0, 0)), ("u[n]*v[n]**2", (1, 2, 0)), ("u[n+1]+u[n-1]-2*u[n]", (1, 0, 0)),
        ("abs(v[n])*v[n]", (0, 2, 0)), ("sign(v[n])", (0, 0, 0)), ("abs(u[n])**0.5*f[n]", (0.5, 0, 1)),
        ("(u[n+1]-u[n])**3", (3, 0, 0)), ("u[n]/f[n]", (1, 0, -1)), ("-u[n]**2", (2, 0, 0)),
        ("sin(u[n])", None), ("u[n]+u[n]**3", None), ("u[n]+v[n]", None), ("exp(f[n])", None), ("u[n]-u[n]", None),
    ],
)  # fmt: skip
def test_the_degrees_of_a_term_are_the_powers_with_which_it_grows(text, degrees):
    found = Term(text).degrees
    assert found == (degrees if degrees is None else pytest.approx(degrees))


def test_of_all_terms_dry_friction_alone_jumps():
    assert Term("sign(v[n])").jumps
    assert Term(" sign( v[n] ) ").jumps
    assert not any(
        Term(text).jumps for text in ("abs(v[n])*v[n]", "sign(u[n])", "f[n]", "u[n]", "v[n]", "2*sign(v[n])")
    )


def test_split_reads_terms_in_their_order_and_keeps_their_texts():
    assert [term.text for term in split(" u[n+1];u[n]**3 ; ;sin( u[n] )")] == ["u[n+1]", "u[n]**3", "sin( u[n] )"]


@given(value=st.floats(-5, 5).filter(lambda value: abs(value) > 1e-3))
@settings(max_examples=60, deadline=None)
def test_a_parameter_keeps_its_sign_under_every_operator(plainly, value):
    for text in (
        "C**2*u[n]",
        "-C**3*u[n]",
        "2-C*u[n]",
        "u[n]/C",
        "(C-1)**2*u[n]",
        "u[n]-C",
        "C*(u[n]-C*v[n])",
        "abs(C)",
    ):
        put = substitute(text, {"C": value})
        values = {("u", 0): 0.7, ("v", 0): -0.4}
        direct = plainly(text.replace("C", f"({value!r})"), values, 0.0, 0.0)
        assert plainly(put, values, 0.0, 0.0) == pytest.approx(direct, rel=1e-12)


# Truths


@pytest.mark.parametrize(
    ("target", "terms", "is_complex", "wanted"),
    [
        ("2*(u[n+1]+u[n-1]-2*u[n])+2*(u[n]-u[n]**3)", "u[n+1]; u[n-1]; u[n]; u[n]**3", False, [2, 2, -2, -2]),
        (
            "2*(u[n+1]+u[n-1]-2*u[n])+2*(u[n]-u[n]**3)",
            "u[n+1]+u[n-1]-2*u[n]; (u[n+1]-u[n-1])/2; u[n]; u[n]**3",
            False,
            [2, 0, 2, -2],
        ),
        ("0.5*(u[n+1]+u[n-1]-2*u[n])-sin(u[n])", "u[n+1]; u[n-1]; u[n]; sin(u[n])", False, [0.5, 0.5, -1, -1]),
        ("i*(u[n+1]-u[n])+i*abs(u[n])**2*u[n]", "i*u[n+1]; i*u[n]; i*u[n]*conj(u[n])*u[n]", True, [1, -1, 1]),
        ("(1-2*i)*u[n]", "u[n]; i*u[n]", True, [1, -2]),
        ("(1+i)*(1-i)*u[n]", "u[n]; i*u[n]", True, [2, 0]),
        ("abs(u[n])**2*u[n]", "u[n]; u[n]**3", False, [0, 1]),
        ("conj(u[n])", "u[n]", False, [1]),
        ("(u[n]+u[n+1])**2", "u[n]**2; u[n]*u[n+1]; u[n+1]**2", False, [1, 2, 1]),
        ("0.1*cos(1.7*t)-0.05*v[n]", "v[n]; cos(1.7*t); n*u[n]", False, [-0.05, 0.1, 0]),
        ("3", "1; u[n]", False, [3, 0]),
    ],
)
def test_express_derives_the_coefficients(target, terms, is_complex, wanted):
    found = express(Term(target), split(terms), is_complex)
    np.testing.assert_allclose(found, wanted, rtol=1e-13, atol=0)


@pytest.mark.parametrize(
    ("target", "terms", "is_complex"),
    [
        ("u[n+1]-sin(u[n])", "u[n+1]; u[n]; u[n]**3; u[n]**5", False),
        ("u[n]", "u[n+1]; u[n-1]", False),
        ("i*u[n]", "u[n]", True),
        ("abs(u[n])**2*u[n]", "u[n]**3; u[n]", True),
        ("conj(u[n])", "u[n]; i*u[n]", True),
        ("u[n]**2", "u[n]; u[n+1]", False),
    ],
)
def test_outside_the_span_there_is_no_truth(target, terms, is_complex):
    assert express(Term(target), split(terms), is_complex) is None


@pytest.mark.parametrize(
    ("terms", "is_complex"),
    [
        ("u[n]; u[n+1]; u[n]+u[n+1]", False),
        ("u[n]; 2*u[n]", False),
        ("abs(u[n])**2; u[n]**2", False),
        ("u[n]; i*u[n]; (1+i)*u[n]", True),
        ("abs(u[n])**2*u[n]; u[n]*conj(u[n])*u[n]", True),
        ("u[n]; u[n+1]-u[n+1]", False),
    ],
)
def test_terms_that_depend_on_each_other_are_refused(terms, is_complex):
    with pytest.raises(InputError, match="leave"):
        express(Term("u[n]"), split(terms), is_complex)


def test_a_combination_keeps_every_digit_and_leaves_zeros_out(plainly):
    terms = split("u[n]; u[n+1]-u[n-1]; u[n]**3; sin(u[n])")
    numbers = [1 / 3, -0.1, 0.0, 2e-17]
    made = combination(terms, numbers)
    assert "**3" not in made.text
    values = {("u", 0): 0.7, ("u", 1): -1.1, ("u", -1): 0.4}
    wanted = sum(c * plainly(term.text, values, 0, 0) for c, term in zip(numbers, terms, strict=True) if c)
    assert plainly(made.text, values, 0, 0) == wanted
    assert combination(terms, [0.0] * 4).text == "0"


@pytest.mark.parametrize("text", ["exp(exp(exp(9)))*u[n]", "exp(exp(exp(exp(9))))*u[n]", "exp(1e12)*u[n]"])
def test_a_number_that_no_computer_holds_is_told(text):
    with pytest.raises(InputError, match="too large"):
        express(Term(text), split("u[n]"), False)


@given(st.lists(st.floats(-9, 9).map(lambda value: round(value, 6)), min_size=5, max_size=5))
@settings(max_examples=25, deadline=None)
def test_express_gives_back_what_a_combination_was_made_of(numbers):
    terms = split("u[n+1]; u[n]; u[n]**3; sin(2*u[n]); u[n]*v[n]")
    text = " + ".join(f"({number!r})*({term})" for number, term in zip(numbers, terms, strict=True))
    found = express(Term(text), terms, False)
    scale = max(abs(number) for number in numbers)
    np.testing.assert_allclose(found, numbers, rtol=1e-10, atol=1e-11 * scale)


def test_the_parity_of_a_sine_of_a_large_multiple_is_known_at_once():
    # SymPy's simplification of it does not come to an end.
    assert Term("sin(1024*u[n])").parity == -1
    assert Term("cos(4096*u[n])").parity == 1
    assert Term("sin(u[n])**2+cos(u[n])**2-1").parity == 1
