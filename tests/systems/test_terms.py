"""The term language: what it refuses, and that its functions, symmetries and derivatives are those of the text."""

import cmath
import contextlib
import math
import time
import warnings

import matplotlib
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from matplotlib.mathtext import MathTextParser

from latticebench import systems
from latticebench.systems.compiler import Slot, compiled, partials
from latticebench.systems.errors import InputError
from latticebench.systems.parser import FUNCTIONS, MAX_LENGTH, MAX_OFFSET, MAX_POWER, TermError
from latticebench.systems.terms import Term, combination, express, split, substitute

matplotlib.use("Agg")

ATTACKS = [
    "__import__('os').system('x')",
    "().__class__",
    "().__class__.__bases__[0].__subclasses__()",
    "u[n+10**9]",
    "u**u**u**u",
    "u[n]**u[n]",
    "u[n]**10**10",
    "9**9**9**9",
    "u[n+1000000000]",
    f"u[n+{MAX_OFFSET + 1}]",
    f"u[n]**{MAX_POWER + 1}",
    "((u[n]**12)**12)**12",
    "1e400*u[n]",
    "10**13",
    "(2**12)**12",
    "(-1)**0.5",
    "1/(2-2)",
    "9" * 400,
    "u[n]" + "+u[n]" * MAX_LENGTH,
    "-" * 490 + "u[n]",
    "(" * 300 + "u[n]" + ")" * 300,
    "abs(" * 150 + "u[n]" + ")" * 150,
    "sin(" * 30 + "u[n]" + ")" * 30,
    "(" + "+".join(f"u[n+{k}]" for k in range(20)) + ")**12",
    "*".join(["(" + "+".join(f"u[n+{k}]" for k in range(9)) + ")"] * 9),
    "",
    "   ",
    "u",
    "u[m]",
    "u[1]",
    "u[n,m]",
    "u[n+1,m]",
    "u[n:n+1]",
    "u[n+x]",
    "u[u[n]]",
    "w[n]",
    "x",
    "sin",
    "sin()",
    "sin(u[n], u[n])",
    "sin(x=u[n])",
    "sin(*u)",
    "eval('1')",
    "exec('1')",
    "open('/etc/passwd')",
    "sin.__globals__",
    "u.__class__[n]",
    "sin(u[n]).evalf",
    "lambda: u[n]",
    "[u[n] for n in n]",
    "(u := 1)",
    "u[n] if t else 0",
    "u[n] and v[n]",
    "u[n] < 1",
    "not t",
    "~n",
    "u[n] @ v[n]",
    "u[n] // 2",
    "u[n] % 2",
    "u[n] ^ 2",
    "|u[n]|",
    "'u[n]'",
    "f'{u}'",
    "b'u'",
    "True",
    "None",
    "...",
    "2j*u[n]",
    "u[n]; v[n]",
    "u[n] = 1",
    "import os",
    "u[n] # a remark",
    "(u[n]\n+1)",
    "u[n]\0",
    "\ud800",
    "{u: n}",
    "*u[n]",
    "yield",
    "await u",
    "print(1)",
]


@pytest.mark.parametrize("text", ATTACKS, ids=lambda text: repr(text[:24]))
def test_a_text_outside_the_language_is_one_clear_line(text):
    with pytest.raises(TermError) as caught:
        Term(text)
    message = str(caught.value)
    assert message.startswith("term ")
    assert f"column {caught.value.column + 1}: " in message
    assert "\n" not in message
    assert len(message) < 400


def test_a_term_error_is_an_input_error():
    assert issubclass(TermError, InputError)


def test_no_attack_runs_a_command(tmp_path):
    proof = tmp_path / "proof"
    for attack in (
        f"__import__('pathlib').Path({str(proof)!r}).touch()",
        f"open({str(proof)!r}, 'w')",
        f"sin(open({str(proof)!r}, 'w'))",
        f"u[open({str(proof)!r}, 'w')]",
        f"[0 for _ in [open({str(proof)!r}, 'w')]]",
    ):
        with pytest.raises(TermError):
            Term(attack)
    assert not proof.exists()


PIECES = st.sampled_from(
    [
        *(f"{name}[n]" for name in "uvf"), "u[n+1]", "u[n-2]", "u[", "]", "(", ")", "+", "-", "*", "**", "/", "//", ",", ".",
        "n", "t", "i", "pi", "0", "1", "2.5", "1e9", "99", *(f"{name}(" for name in FUNCTIONS), "__class__", "import ",
        "lambda ", "'", '"', "#", "\n", " ", ";", ":", "=", "if ", "else ", "j", "\\", "{", "}", "é", "u",
    ]
)  # fmt: skip
TEXTS = st.one_of(st.text(max_size=60), st.lists(PIECES, max_size=25).map("".join))


@given(TEXTS)
@settings(derandomize=True, max_examples=500, deadline=None)
def test_any_text_is_a_term_or_a_term_error_within_a_second(text):
    begin = time.perf_counter()
    term, column = None, 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            term = Term(text)
        except TermError as error:
            column = error.column
    if term is not None:
        assert all(abs(offset) <= MAX_OFFSET for _, offset in term.sites)
        assert term.names <= {"u", "v", "f", "t", "n", "i", "pi", *FUNCTIONS}
    assert 0 <= column <= max(len(text), 1)
    assert time.perf_counter() - begin < 1


@given(st.text(alphabet="()-+~*unt[]1 .", min_size=50, max_size=MAX_LENGTH))
@settings(derandomize=True, max_examples=100, deadline=None, suppress_health_check=[HealthCheck.large_base_example])
def test_long_nested_texts_never_exhaust_the_stack(text):
    with contextlib.suppress(TermError):
        Term(text)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("u[n] + w[n]", "w[n]"),
        ("u[n] + K*v[n]", "K"),
        ("  u[n] + K", "K"),
        ("u[n]**v[n]", "v[n]"),
        ("u[n] + u[n+99]", "n+99"),
        ("u[n] + u[m]", "m]"),
        ("2*tan2(u[n])", "tan2"),
        ("u[n] + 3j", "3j"),
        ("u[n] + u[n].real", "u[n].real"),
        ("u[n] + u[n]**13", "13"),
        ("u[n] + u[n+1,m]", "n+1,m"),
        ("u[n] # b", "# b"),
    ],
)
def test_the_column_of_an_error_points_at_the_place(text, place):
    with pytest.raises(TermError) as caught:
        Term(text)
    assert caught.value.column == text.rindex(place)


@pytest.mark.parametrize("text", ["u[n]/0", "log(0)*u[n]", "u[n]*0**(0-1)"])
def test_a_division_by_zero_is_told_before_anything_is_computed(text):
    with pytest.raises(TermError):
        _ = Term(text).expression


# Functions ------------------------------------------------------------------------------------------------------------------

ARRAYS = ("u[n]", "u[n+1]", "u[n-2]", "v[n]", "f[n]")
TERMS = [
    "u[n]",
    "u[n+1]+u[n-2]-2*u[n]",
    "u[n]**3",
    "abs(u[n])**2*u[n]",
    "abs(u[n])**3",
    "conj(u[n])**2",
    "u[n]*conj(u[n+1])*v[n]",
    "sin(2*u[n])",
    "sign(v[n])",
    "cos(1.7*t)",
    "n*u[n]",
    "n**2",
    "f[n]*u[n]",
    "re(u[n])*im(u[n+1])",
    "sqrt(abs(u[n]))",
    "sqrt(2)*u[n]",
    "sin(1)*log(3)*exp(0.5)*u[n]",
    "pi*u[n]/7",
    "u[n]**-2",
    "-u[n]",
    "+u[n]-0.1*v[n]",
    "(u[n]-0.25)*(u[n]+0.5)/(1+abs(u[n+1])**2)",
    "3",
    "0*u[n]",
    "tanh(u[n])*cosh(u[n+1])-sinh(v[n])",
    "1e-3*exp(-abs(u[n])**2)",
]
COMPLEX_TERMS = [
    *TERMS,
    "i*u[n]",
    "(1+2*i)*conj(u[n])",
    "i*abs(u[n])**2*u[n]",
    *(f"{name}(u[n])" for name in FUNCTIONS),
    *(f"{name}(0.3*u[n]+i*u[n+1]+0.1)" for name in FUNCTIONS),
    "u[n]**1.7",
    "u[n]**0.5",
    "sign(u[n])*v[n]",
]
REAL_TERMS = [
    *TERMS,
    *(f"{name}(0.2+u[n]**2)" for name in FUNCTIONS),
    "abs(u[n])",
    "abs(v[n])*v[n]",
    "atan(u[n])",
    "i*i*u[n]",
    "abs(i*u[n])",
]
PLAIN = {
    "abs": abs,
    "conj": lambda z: complex(z).conjugate(),
    "re": lambda z: complex(z).real,
    "im": lambda z: complex(z).imag,
    "sign": lambda z: z / abs(z) if z else 0.0,
    **{name: getattr(cmath, name) for name in FUNCTIONS if name not in ("abs", "conj", "re", "im", "sign")},
}


def plainly(text, values, t, n):
    """Evaluate a term by Python itself, for one site; the texts are this file's own."""
    fields = {name: {n + offset: value for (key, offset), value in values.items() if key == name} for name in "uvf"}
    return complex(eval(text, {"__builtins__": {}}, {**PLAIN, **fields, "t": t, "n": n, "i": 1j, "pi": math.pi}))


def draw_values(seed, is_complex, count=4):
    draw = np.random.default_rng(seed)
    keys = [("u", 0), ("u", 1), ("u", -2), ("v", 0), ("f", 0)]
    real = {key: draw.uniform(-1.5, 1.5, count) for key in keys}
    if is_complex:
        real = {key: a + (1j * draw.uniform(-1.5, 1.5, count) if key[0] != "f" else 0) for key, a in real.items()}
    return real, draw.uniform(0, 3, count), np.arange(count) - 1.5


def arrays_for(slots, values, t, n):
    def one(slot):
        if slot.name in ("t", "n"):
            return {"t": t, "n": n}[slot.name]
        value = values[slot.name, slot.offset]
        return value.imag.copy() if slot.part == "im" else value.real.copy()

    return [one(slot) for slot in slots]


CASES = [(text, False) for text in REAL_TERMS] + [(text, True) for text in COMPLEX_TERMS]


@pytest.mark.parametrize(("text", "is_complex"), CASES)
def test_numpy_torch_and_plain_python_agree_on_a_term(text, is_complex):
    values, t, n = draw_values(7, is_complex)
    expected = np.array([plainly(text, {k: a[j] for k, a in values.items()}, t[j], n[j]) for j in range(4)])
    parts = [expected.real, expected.imag] if is_complex else [expected.real]
    if not is_complex:
        np.testing.assert_allclose(expected.imag, 0, atol=1e-14)
    by_numpy = compiled((text,), is_complex)
    found = by_numpy.function(*arrays_for(by_numpy.slots, values, t, n))
    assert len(found) == len(parts)
    for got, wanted in zip(found, parts, strict=True):
        np.testing.assert_allclose(np.broadcast_to(got, 4), wanted, rtol=1e-12, atol=1e-13)
    by_torch = compiled((text,), is_complex, "torch")
    assert by_torch.slots == by_numpy.slots
    tensors = [torch.tensor(a, dtype=torch.float64) for a in arrays_for(by_torch.slots, values, t, n)]
    for got, wanted in zip(by_torch.function(*tensors), parts, strict=True):
        np.testing.assert_allclose(np.broadcast_to(np.asarray(got), 4), wanted, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("is_complex", [False, True])
def test_terms_compiled_together_give_what_each_gives_alone(is_complex):
    values, t, n = draw_values(8, is_complex)
    together = compiled(tuple(TERMS), is_complex)
    found = together.function(*arrays_for(together.slots, values, t, n))
    assert len(found) == (1 + is_complex) * len(TERMS)
    for k, text in enumerate(TERMS):
        alone = compiled((text,), is_complex)
        for part, wanted in enumerate(alone.function(*arrays_for(alone.slots, values, t, n))):
            np.testing.assert_allclose(
                np.broadcast_to(found[part * len(TERMS) + k], 4), np.broadcast_to(wanted, 4), rtol=1e-13, atol=1e-14
            )


@pytest.mark.parametrize(("text", "is_complex"), CASES)
@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_partials_agree_with_central_differences(text, is_complex, backend):
    values, t, n = draw_values(9, is_complex)
    whole = compiled((text,), is_complex)
    bundle, places = partials((text,), is_complex, backend)
    arrays = arrays_for(bundle.slots, values, t, n)
    given_arrays = [torch.tensor(a, dtype=torch.float64) for a in arrays] if backend == "torch" else arrays
    derived = {
        (part, slot): np.broadcast_to(np.asarray(value), 4)
        for (_, part, slot), value in zip(places, bundle.function(*given_arrays), strict=True)
    }
    step = 1e-5
    for position, slot in enumerate(whole.slots):
        if slot.name not in ("u", "v"):
            assert all(found != slot for _, found in derived)
            continue
        ahead, behind = ([a.copy() for a in arrays_for(whole.slots, values, t, n)] for _ in range(2))
        ahead[position] += step
        behind[position] -= step
        for part in range(1 + is_complex):
            difference = np.asarray(whole.function(*ahead)[part]) - np.asarray(whole.function(*behind)[part])
            got = derived.get((part, slot), np.zeros(4))
            np.testing.assert_allclose(got, np.broadcast_to(difference / (2 * step), 4), rtol=2e-6, atol=2e-7)


@pytest.mark.parametrize("text", ["u[n]**3-sin(2*u[n])*u[n+1]", "abs(u[n])**2*u[n+1]"])
def test_torch_differentiates_through_a_compiled_term_as_partials_do(text):
    bundle, places = partials((text,), False)
    draw = np.random.default_rng(3)
    arrays = [draw.uniform(-1, 1, 5) for _ in bundle.slots]
    tensors = [torch.tensor(a, dtype=torch.float64, requires_grad=True) for a in arrays]
    compiled((text,), False, "torch").function(*tensors)[0].sum().backward()
    gradients = dict(zip(bundle.slots, tensors, strict=True))
    for (_, _, slot), value in zip(places, bundle.function(*arrays), strict=True):
        np.testing.assert_allclose(gradients[slot].grad.numpy(), value, rtol=1e-12)


def test_a_complex_term_on_a_real_field_is_an_error_that_says_so():
    with pytest.raises(TermError, match="complex, but the field is real"):
        compiled(("i*u[n]",), False)


def test_single_precision_tensors_stay_single():
    function = compiled(("sqrt(2)*sin(1)*u[n]",), False, "torch").function
    assert function(torch.ones(3, dtype=torch.float32))[0].dtype == torch.float32


# Properties -----------------------------------------------------------------------------------------------------------------


def every_text():
    for name in systems.names():
        system = systems.find(name)
        yield system.motion({}).text
        for library in system.libraries:
            yield from library.texts


@pytest.mark.parametrize("text", sorted({*every_text(), *REAL_TERMS, *COMPLEX_TERMS}))
def test_the_latex_of_a_term_can_be_typeset(text):
    latex = Term(text).latex
    assert latex
    MathTextParser("path").parse(f"${latex}$")


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


@pytest.mark.parametrize("text", [text for text in TERMS if text != "0*u[n]"])
def test_parity_agrees_with_the_numbers(text):
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


def test_split_reads_terms_in_their_order_and_keeps_their_texts():
    assert [term.text for term in split(" u[n+1];u[n]**3 ; ;sin( u[n] )")] == ["u[n+1]", "u[n]**3", "sin( u[n] )"]


@given(st.floats(-5, 5).filter(lambda value: abs(value) > 1e-3))
@settings(derandomize=True, max_examples=60, deadline=None)
def test_a_parameter_keeps_its_sign_under_every_operator(value):
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


# Truths ---------------------------------------------------------------------------------------------------------------------


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


def test_a_combination_keeps_every_digit_and_leaves_zeros_out():
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
@settings(derandomize=True, max_examples=25, deadline=None)
def test_express_gives_back_what_a_combination_was_made_of(numbers):
    terms = split("u[n+1]; u[n]; u[n]**3; sin(2*u[n]); u[n]*v[n]")
    text = " + ".join(f"({number!r})*({term})" for number, term in zip(numbers, terms, strict=True))
    found = express(Term(text), terms, False)
    scale = max(abs(number) for number in numbers)
    np.testing.assert_allclose(found, numbers, rtol=1e-10, atol=1e-11 * scale)


def test_slots_sort_by_name_offset_and_part():
    assert sorted([Slot("v"), Slot("u", 1), Slot("u", -1, "re"), Slot("u", -1, "im")])[0] == Slot("u", -1, "im")
