"""Whatever a suite can hold: a wrong value is refused when the suite is loaded, with the file and the key."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from latticebench.bench.case import Settings
from latticebench.bench.grid import Contestant, Grid
from latticebench.bench.suite import load
from latticebench.bench.trials.laboratory.case import Batch
from latticebench.bench.trials.measured import Measured
from latticebench.bench.trials.trial import Made
from latticebench.systems.errors import InputError

# As TOML writes them: out of range, of another type, not finite, empty, or too long.
WRONG = (
    "-1", "-0.5", "nan", "inf", "-inf", "true", '""', '" "', '"nope"', "[]", "[-1]", "[nan]", "[true]", '["nope"]',
    "[[1]]", "{}", "{nope = 1}", "{C = true}", "{C = nan}", "1979-05-27", "[1979-05-27]", "1" + "0" * 400, "1e300",
    '"1"', "12:30:00", '["../x.py"]', '"../x"', "1.5", '"a\\u0000b"',
)  # fmt: skip
BLOCKS: Mapping[str, tuple[type[Settings], dict[str, str]]] = {
    "grid": (Grid, {"system": '"phi4"', "libraries": '["lib1"]', "sites": "5", "samples": "8"}),
    "made": (Made, {"systems": '["phi4"]', "effects": '["damping"]', "z": "10.0"}),
    "laboratory": (Batch, {"effects": '["none"]'}),
    "measured": (Measured, {"name": '"x"', "file": '"x.csv"', "terms": '"u[n]"', "order": "2"}),
}
# What is right after all: words that are shown alone, truth values, and what stands for nothing.
WORDS = {"part", "about", "title"}
RIGHT = {
    ("parameters", "{}"), ("terms", "{}"), ("libraries", "[]"), ("time_limit", "1e300"), ("noise", "1e300"),
    ("z", "1e300"), ("z", "1.5"), ("noise", "1.5"), ("span", "1.5"), ("time_limit", "1.5"), ("name", '"nope"'),
    ("name", '"1"'), ("seeds", '"1"'), ("file", '"nope"'),
    ("file", '"../x"'), ("file", '"1"'), ("terms", '"1"'), ("settings", "{}"), ("seeds_of", "{}"),
}  # fmt: skip


def is_right(key: str, value: str, model: type[Settings]) -> bool:
    """Whether a value of WRONG is right for a key."""
    if (key, value) in RIGHT or (key in WORDS and value.startswith('"')):
        return True
    return value in ("true", "[true]") and "bool" in str(model.model_fields[key].annotation)


def refusal(folder: Path, text: str) -> str:
    """Return why a suite is refused; empty where it is taken."""
    (folder / "s.toml").write_text(text)
    try:
        load(str(folder / "s.toml"))
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("block", BLOCKS)
def test_a_wrong_value_of_any_key_of_a_block_is_refused_with_the_file_and_the_key(block: str, tmp_path: Path) -> None:
    model, given = BLOCKS[block]
    head = '[methods.a]\nmethod = "zero"\n'

    def written(values: Mapping[str, str]) -> str:
        return f"{head}[[{block}]]\n" + "".join(f"{key} = {value}\n" for key, value in values.items())

    assert refusal(tmp_path, written(given)) == ""
    for key in model.model_fields:
        for value in WRONG:
            if key != "kind" and not is_right(key, value, model):
                told = refusal(tmp_path, written({**given, key: value}))
                assert "s.toml: " in told, (key, value)
                assert key[:4] in told, (key, value, told)
                assert len(told) < 3000


@pytest.mark.parametrize("key", Contestant.model_fields)
def test_a_wrong_method_or_table_of_settings_is_refused_with_its_label(key: str, tmp_path: Path) -> None:
    grid = '[[grid]]\nsystem = "phi4"\nlibraries = ["lib1"]\n'
    for value in WRONG:
        if (key, value) not in RIGHT:
            given = {"method": '"stlsq"', key: value}
            text = "[methods.a]\n" + "".join(f"{name} = {one}\n" for name, one in given.items()) + grid
            assert "methods.a" in refusal(tmp_path, text), (key, value)


def test_keys_that_do_not_go_together_are_refused_with_their_place(tmp_path: Path) -> None:
    fits = '[methods.a]\nmethod = "zero"\n[[grid]]\nsystem = "phi4"\n'
    for text, told in (
        ('[methods.""]\nmethod = "zero"\n[[grid]]\nsystem = "phi4"\nlibraries = ["lib1"]\n', "methods"),
        (fits + 'libraries = ["lib1"]\nsites = 2\n', "stencil needs 3 sites"),
        (fits + 'terms = {a = ["i*u[n]"]}\n', "the field is real"),
        (fits + 'terms = {a = ["f[n]"]}\n', "no measured input"),
        (fits.replace("phi4", "dnls") + 'terms = {a = ["v[n]"]}\n', "has no velocity"),
        (fits + 'terms = {a = []}\n', "terms"), (fits + 'terms = {a = ["u[n"]}\n', "u[n"),
        (fits + 'libraries = ["lib1"]\nparameters = {C = []}\n', "parameters.C"),
        ('[[measured]]\nname = "x"\nfile = "x"\nterms = "u[n"\norder = 2\n', "measured 1: terms"),
        ('[[measured]]\nname = "x"\nfile = "x"\nterms = "u[n]"\norder = 2\nrows = [5, 5]\n', "measured 1: rows"),
        ('[[measured]]\nname = "x"\nfile = "x"\nterms = "u[n]"\norder = 2\n' * 2, "measured 2: name"),
    ):  # fmt: skip
        assert told in refusal(tmp_path, text), text


def test_a_parameter_for_which_the_initial_state_is_no_number_is_refused_as_the_suite_is_loaded(tmp_path: Path) -> None:
    head = '[methods.a]\nmethod = "zero"\n[[grid]]\nsystem = "phi4"\nlibraries = ["lib1"]\n'
    assert refusal(tmp_path, head + "parameters = { C = [0.5, 1.0] }\n") == ""
    told = refusal(tmp_path, head + "parameters = { C = [0.5, -1.0] }\n")
    assert "s.toml: system 'phi4': the initial state 'kink' is not finite for C=-1" in told
    assert "check the parameters" in told
