"""The parser: what is outside the term language is refused by one clear line, and nothing is ever run."""

import contextlib
import time
import warnings

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from latticebench.systems.errors import InputError
from latticebench.systems.parser import FUNCTIONS, MAX_LENGTH, MAX_OFFSET, MAX_POWER, TermError
from latticebench.systems.terms import Term

ATTACKS = [
    "__import__('os').system('x')",
    "().__class__",
    "().__class__.__bases__[0].__subclasses__()",
    "u[n+10**9]",
    "u**u**u**u",
    "u[n]**u[n]",
    "u[n]**True",
    "u[n], u[n+1]",
    "u[n]**10**10",
    "9**9**9**9",
    "u[n+1000000000]",
    f"u[n+{MAX_OFFSET + 1}]",
    f"u[n]**{MAX_POWER + 1}",
    "((u[n]**12)**12)**12",
    "1e400*u[n]",
    "1e-400*u[n]",
    "u[n]+1e-320",
    "ｕ[n]",
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
        *(f"{name}[n]" for name in "uvf"), "u[n+1]", "u[n-2]", "u[", "]", "(", ")", "+", "-", "*", "**", "/", "//", ",",
        ".",
        "n", "t", "i", "pi", "0", "1", "2.5", "1e9", "99", *(f"{name}(" for name in FUNCTIONS), "__class__", "import ",
        "lambda ", "'", '"', "#", "\n", " ", ";", ":", "=", "if ", "else ", "j", "\\", "{", "}", "é", "u",
    ]
)  # fmt: skip


@given(st.text(max_size=60))
@settings(deadline=None)
def test_any_text_is_a_term_or_a_term_error_and_takes_no_minutes(text):
    survive(text)


@given(st.lists(PIECES, max_size=25).map("".join))
@settings(deadline=None)
def test_any_pieces_of_the_language_are_a_term_or_a_term_error_and_take_no_minutes(text):
    survive(text)


def survive(text):
    # Processor time, which a busy machine does not stretch.
    begin = time.process_time()
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
    # It takes some milliseconds, the first one seconds for imports.
    assert time.process_time() - begin < 60


@given(st.text(alphabet="()-+~*unt[]1 .", min_size=50, max_size=MAX_LENGTH))
@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.large_base_example])
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
