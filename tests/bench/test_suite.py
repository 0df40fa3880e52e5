"""Suites: what they expand to, and what is wrong with them when it is."""

from __future__ import annotations

from pathlib import Path

import pytest

from latticebench.bench.case import Case
from latticebench.bench.choice import Choice
from latticebench.bench.fitting import FitCase
from latticebench.bench.source import keys
from latticebench.bench.suite import Suite, load, names
from latticebench.systems.errors import InputError

SUITE = """
title = "two by two"

[methods.floor]
method = "zero"

[methods.dense]
method = "least-squares"
settings = { differentiation = "spline" }

[defaults]
noise = [0.0, 0.01]

[[grid]]
system = "phi4"
parameters = { C = [0.5, 2.0] }
libraries = ["lib1", "lib2"]
seeds = [1, 2]
"""


def write(folder: Path, text: str) -> str:
    path = folder / "mine.toml"
    path.write_text(text)
    return str(path)


def test_a_suite_is_the_product_of_its_lists(tmp_path: Path) -> None:
    suite = load(write(tmp_path, SUITE))
    assert suite.name == "mine"
    assert len(suite.cases) == 2 * 2 * 2 * 2 * 2
    assert len({case.identity for case in suite.cases}) == len(suite.cases)
    assert {case.label for case in suite.cases if isinstance(case, FitCase)} == {"floor", "dense"}
    assert suite.cases[1].settings == {"differentiation": "spline"}


def test_a_cell_that_two_grids_share_is_one_case(tmp_path: Path) -> None:
    once = load(write(tmp_path, SUITE))
    twice = load(write(tmp_path, SUITE + SUITE[SUITE.index("[[grid]]") :]))
    assert len(twice.cases) == len(once.cases)


@pytest.mark.parametrize("name", names())
def test_every_suite_of_the_package_is_sound(name: str) -> None:
    suite = load(name)
    assert suite.title
    assert suite.cases


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("libraries", "librarys", r"grid 1: unknown key 'librarys'; did you mean 'libraries'"),
        ("[defaults]", "[default]", r"unknown key 'default'; did you mean 'defaults'"),
        ("settings", "setings", r"methods\.dense\.setings: unknown key 'setings'; did you mean 'settings'"),
        ('"phi4"', '"phi5"', r"unknown system 'phi5'; did you mean 'phi4'"),
        ('"lib2"]', '"lib9"]', r"unknown library 'lib9'"),
        ('"zero"', '"zeroo"', r"unknown method 'zeroo'; did you mean 'zero'"),
        (
            "differentiation =",
            "diferentiation =",
            r"methods\.dense: method 'least-squares': unknown setting 'diferentiation'",
        ),
        ("C =", "D =", r"unknown parameter 'D'"),
        ("[0.5, 2.0]", '["a"]', r"grid 1: parameters"),
        ("[0.0, 0.01]", "[-1]", r"grid 1: noise"),
        ("seeds = [1, 2]", 'initial = "kinky"', r"unknown initial state 'kinky'; did you mean 'kink'"),
        ("seeds = [1, 2]", 'methods = ["floors"]', r"unknown method 'floors'; did you mean 'floor'"),
        ("[[grid]]", "[[grid", r"not TOML"),
        ('libraries = ["lib1", "lib2"]', "", r"libraries: give at least one"),
        ("[[grid]]", "[[grids]]", r"unknown key 'grids'; did you mean 'grid'"),
    ],
)
def test_a_mistake_is_told_with_the_file_and_the_key(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = write(tmp_path, SUITE.replace(old, new))
    with pytest.raises(InputError, match=told) as error:
        load(path)
    assert "mine.toml" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_suite_is_told_with_the_names_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="tiny"):
        load("tinny")
    with pytest.raises(InputError, match=r"nowhere\.toml"):
        load(str(tmp_path / "nowhere.toml"))


METHOD = '''
from dataclasses import dataclass
from typing import ClassVar
import numpy as np
from latticebench.methods.method import Abilities, Fit

@dataclass(frozen=True)
class Ones:
    """Says one."""

    name: ClassVar[str] = "ones"
    value: float = 1.0

    @property
    def abilities(self):
        return Abilities()

    def fit(self, data, library, order, seed):
        return Fit(self.name, library, order, np.full(len(library.terms), self.value), 0.5)

METHODS = (Ones,)
'''


def key_of(case: Case, suite: Suite) -> str:
    return keys({case.identity: case}, suite.folders)[case.identity]


def test_the_key_of_a_case_covers_the_source_of_its_method_but_not_its_comments(tmp_path: Path) -> None:
    (tmp_path / "ones.py").write_text(METHOD)
    suite = load(write(tmp_path, SUITE.replace('"zero"', '"ones.py"')))
    case = next(case for case in suite.cases if case.label == "floor")
    key = key_of(case, suite)
    (tmp_path / "ones.py").write_text("# a remark\n" + METHOD.replace("Says one.", "Says 1."))
    assert key_of(case, suite) == key
    (tmp_path / "ones.py").write_text(METHOD.replace("0.5)", "0.25)"))
    assert key_of(case, suite) != key


def test_a_range_of_seeds_is_the_list_of_them(tmp_path: Path) -> None:
    suite = load(write(tmp_path, SUITE.replace("seeds = [1, 2]", 'seeds = "3-5"')))
    assert sorted({case.seed for case in suite.cases}) == [3, 4, 5]


@pytest.mark.parametrize("text", ["5-3", "1-", "a-b", "1-99999", "-1-3", "1.5-2"])
def test_what_is_no_range_of_seeds_is_refused_with_its_place(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match=r"seeds.*1-100"):
        load(write(tmp_path, SUITE.replace("seeds = [1, 2]", f'seeds = "{text}"')))


def drawn(suite: Suite) -> dict[str, list[int]]:
    found: dict[str, set[int]] = {}
    for case in suite.cases:
        assert isinstance(case, FitCase)
        found.setdefault(case.label, set()).add(case.seed)
    return {label: sorted(seeds) for label, seeds in found.items()}


def test_a_method_has_the_seeds_that_a_block_gives_it_and_the_others_those_of_the_block(tmp_path: Path) -> None:
    file = write(tmp_path, SUITE + 'seeds_of = { floor = "2-4" }\n')
    assert drawn(load(file)) == {"floor": [2, 3, 4], "dense": [1, 2]}
    # Eight kinds of data and libraries.
    assert len(load(file).cases) == 8 * (3 + 2)
    assert drawn(load(file, choice=Choice(seeds=(7,)))) == {"floor": [7], "dense": [7]}
    assert drawn(load(file, choice=Choice(methods=("dense",)))) == {"dense": [1, 2]}
    assert drawn(load(file, choice=Choice(methods=("floor",)))) == {"floor": [2, 3, 4]}


def test_seeds_of_a_method_that_is_not_in_the_suite_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown method 'flor'; did you mean 'floor'"):
        load(write(tmp_path, SUITE + 'seeds_of = { flor = "2-4" }\n'))


def test_the_key_of_a_case_does_not_depend_on_its_label_or_limits(tmp_path: Path) -> None:
    suite = load(write(tmp_path, SUITE))
    case = suite.cases[0]
    same = case.model_copy(update={"label": "another", "time_limit": 5.0})
    other = case.model_copy(update={"seed": 77})
    assert key_of(same, suite) == key_of(case, suite) != key_of(other, suite)


@pytest.mark.parametrize("lacking", ["title", "roots", "blank", "run"])
def test_a_kind_of_case_that_lacks_a_part_cannot_be_made(lacking: str) -> None:
    parts = {name: getattr(FitCase, name) for name in ("title", "roots", "blank", "run") if name != lacking}
    kind = type("Incomplete", (Case,), {"__module__": __name__, **parts})
    with pytest.raises(TypeError, match=lacking):
        kind(kind="incomplete")
