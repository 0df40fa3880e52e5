"""The command `latticebench diagnose`, as a user types it."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from commandline import latticebench
from latticebench import systems
from latticebench.bench.report import page
from latticebench.bench.trials.specimen import Conditions, make
from latticebench.diagnosis import repair
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.readers import read
from latticebench.systems.samples import Samples
from latticebench.systems.writers import write

Typed = Callable[..., tuple[int, str, str]]
SYSTEM = """
name = "mine"
equation = "u[n+1]-u[n]"
order = 2
[initials.rest]
u = "0"
[libraries]
some = "u[n+1]; u[n]"
"""
TERMS = "u[n+1]+u[n-1]-2*u[n]; u[n]; u[n]**3"
OWN = """
[[effect]]
name = "cubic-drag"
formula = "v[n]**3"
orders = [2]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A damped phi^4 lattice, a later recording of it, and files that do not fit."""
    place = tmp_path_factory.mktemp("diagnose")
    specimen = make(systems.find("phi4"), "damping", 30, np.random.default_rng(3), Conditions(sites=9, samples=40))
    write([specimen.samples], place / "damped.csv")
    samples = specimen.samples
    assert samples.v is not None
    write([Samples(samples.t[20:], samples.u[20:], samples.v[20:])], place / "later.csv")
    write([Samples(samples.t, samples.u[:, :4], samples.v[:, :4])], place / "short.csv")
    write([Samples(samples.t[:2], samples.u[:2])], place / "two-rows.csv")
    (place / "mine.toml").write_text(SYSTEM)
    (place / "own.toml").write_text(OWN)
    (place / "own-bad.toml").write_text(OWN + "size = 3\n")
    text = (place / "damped.csv").read_text().splitlines()
    text[4] = text[4].replace(text[4].split(",")[2], "seven", 1)
    (place / "bad.csv").write_text("\n".join(text) + "\n")
    return place


@pytest.fixture
def typed(folder: Path) -> Typed:
    """Type a command in the folder and give exit code, standard output and standard error."""
    return functools.partial(latticebench, cwd=folder)


@pytest.fixture(scope="module")
def known(folder: Path) -> repair.Diagnosis:
    """The diagnosis of the damped lattice, for what is only about how it is shown."""
    return repair.diagnose(library("own", TERMS), 2, read(folder / "damped.csv", "free"), CATALOGUE)


@pytest.fixture(scope="module")
def printed() -> list[tuple[int, str, str]]:
    return []


@pytest.fixture
def plain(typed: Typed, printed: list[tuple[int, str, str]]) -> tuple[int, str, str]:
    """What the diagnosis of the damped lattice prints as JSON; it is made once for all tests."""
    if not printed:
        printed.append(typed("diagnose", "damped.csv", "--system", "phi4", "--json", "-"))
    return printed[0]


def test_a_diagnosis_names_the_effect_and_writes_json_and_a_page(typed: Typed, folder: Path) -> None:
    code, out, err = typed(
        "diagnose",
        "damped.csv",
        "--system",
        "phi4",
        "--effects",
        "own.toml",
        "--json",
        "out/found.json",
        "--html",
        "out/found.html",
    )
    assert (code, err) == (0, "")
    assert out.startswith("What the equation lacks: ")
    found = json.loads((folder / "out" / "found.json").read_text())
    assert (found["schema"], found["verdict"]) == ("latticebench/diagnosis/2", "explained")
    assert found["provenance"]["command"].startswith("latticebench diagnose damped.csv --system phi4")
    assert "damping" in {found["effects"][0]["effect"], *found["effects"][0]["indistinguishable"]}
    assert "cubic-drag" in {one["effect"] for horizon in found["horizons"] for one in horizon["tried"]}
    assert list(found["declared"]) == ["u[n+1]+u[n-1]-2*u[n]", "u[n]", "u[n]**3"]
    page = (folder / "out" / "found.html").read_text()
    assert "damped.csv" in page
    assert "latticebench diagnose" in page


def test_what_is_known_when_it_is_interrupted_is_shown(
    typed: Typed, known: repair.Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise repair.Interrupted(known)

    monkeypatch.setattr(repair, "diagnose", stopped)
    arguments = ("diagnose", "damped.csv", "--terms", TERMS, "--order", "2", "--ends", "free")
    code, out, _ = typed(*arguments)
    assert code == 130
    assert out.startswith("Interrupted: ")
    assert "damping" in out
    code, out, _ = typed(*arguments, "--json", "-")
    assert code == 130
    assert json.loads(out)["interrupted"]


def test_a_demo_that_is_interrupted_says_so_and_claims_nothing(
    typed: Typed, known: repair.Diagnosis, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise repair.Interrupted(replace(known, findings=(), verdict="nothing missing"))

    monkeypatch.setattr(repair, "diagnose", stopped)
    code, out, _ = typed("demo", "--out", str(tmp_path / "demo"))
    assert code == 130
    assert "Named by then: nothing." in out
    page = (tmp_path / "demo" / "diagnosis.html").read_text(encoding="utf-8")
    for said in (out, page):
        assert "Interrupted: " in said
        assert "othing is missing" not in said
        assert "nothing missing" not in said


def test_json_to_the_screen_is_nothing_but_json_and_the_same_again(typed: Typed, plain: tuple[int, str, str]) -> None:
    assert typed("diagnose", "damped.csv", "--system", "phi4", "--json", "-") == plain
    assert json.loads(plain[1])["verdict"] == "explained"


def test_ends_that_are_not_told_are_unknown_with_terms_and_the_systems_own_with_a_system(
    typed: Typed, plain: tuple[int, str, str]
) -> None:
    _, out, _ = typed("diagnose", "damped.csv", "--terms", TERMS, "--order", "2", "--json", "-")
    assert any("ends were not declared" in note for note in json.loads(out)["notes"])
    assert not any("ends were not declared" in note for note in json.loads(plain[1])["notes"])


def test_forecasts_are_judged_on_the_file_that_is_held_out(typed: Typed, plain: tuple[int, str, str]) -> None:
    code, out, err = typed("diagnose", "damped.csv", "--system", "phi4", "--holdout", "later.csv", "--json", "-")
    assert (code, err) == (0, "")
    own, held = json.loads(plain[1]), json.loads(out)
    assert held["declared"] == own["declared"]
    assert held["error"]["forecast"] != own["error"]["forecast"]
    assert 0 < held["error"]["forecast"]["after"] < 0.1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nothing.csv", "--system", "phi4"], "nothing.csv: no such file"),
        (["bad.csv", "--system", "phi4"], "bad.csv: row 4, column u2: "),
        (["damped.csv"], "give --system, or --terms and --order"),
        (["damped.csv", "--system", "phi4", "--terms", "u[n]"], "--system declares an equation and its order"),
        (["damped.csv", "--system", "phi4", "--order", "1"], "--system declares an equation and its order"),
        (["damped.csv", "--terms", "u[n]"], "--order: 1 for du/dt"),
        (["damped.csv", "--terms", "u[n]; whatever", "--order", "2"], "unknown name 'whatever'"),
        (["damped.csv", "--terms", "u[n]; f[n]", "--order", "2"], "damped.csv: the library uses f[n]"),
        (["damped.csv", "--terms", "v[n]", "--order", "1"], "order 1 has no velocity"),
        (["damped.csv", "--system", "fi4"], "unknown system 'fi4'"),
        (["damped.csv", "--system", "mine.toml"], "mine.toml: it has no library 'equation'"),
        (["damped.csv", "--system", "dnls"], "damped.csv: the field is real, that of dnls is complex"),
        (["damped.csv", "--system", "phi4", "--ends", "loose"], "--ends"),
        (["damped.csv", "--system", "phi4", "--effects", "none.toml"], "none.toml"),
        (["damped.csv", "--system", "phi4", "--effects", "own-bad.toml"], "own-bad.toml: effect 1: unknown key 'size'"),
        (["damped.csv", "--system", "phi4", "--holdout", "short.csv"], "short.csv: it has 4 sites, damped.csv has 9"),
    ],
)
def test_bad_input_is_one_line_that_says_where(typed: Typed, arguments: list[str], words: str) -> None:
    code, out, err = typed("diagnose", *arguments)
    assert code == 2
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert words in err


def test_too_few_rows_are_refused_in_one_line_or_diagnosed(typed: Typed) -> None:
    code, _, err = typed("diagnose", "two-rows.csv", "--system", "phi4")
    assert code in (0, 2)
    assert code == 0 or (err.startswith("error: two-rows.csv: ") and err.count("\n") == 1)


def test_a_result_that_cannot_be_written_leaves_what_was_there(typed: Typed, folder: Path) -> None:
    (folder / "taken").write_text("mine")
    code, _, err = typed("diagnose", "damped.csv", "--system", "phi4", "--html", "taken/page.html")
    assert code == 2
    assert "cannot be written" in err
    assert (folder / "taken").read_text() == "mine"


def test_a_file_name_of_any_kind_does_no_harm(
    typed: Typed, folder: Path, known: repair.Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(repair, "diagnose", lambda _, __, data, *___, **____: replace(known, data=tuple(data)))
    name = "<img src=x onerror=alert(1)>[bold]$&.csv"
    write(read(folder / "damped.csv"), folder / name)
    code, _, err = typed("diagnose", name, "--system", "phi4", "--html", "named.html")
    assert (code, err) == (0, "")
    page = (folder / "named.html").read_text()
    assert "<img" not in page
    assert "&lt;img src=x onerror=alert(1)&gt;[bold]$&amp;.csv" in page


def test_a_page_that_cannot_be_written_loses_neither_the_json_nor_the_screen(
    typed: Typed, folder: Path, known: repair.Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(repair, "diagnose", lambda *_, **__: known)

    def full(*_: object) -> None:
        raise InputError("found.html: cannot be written: No space left on device")

    monkeypatch.setattr(page, "write_page", full)
    code, out, err = typed("diagnose", "damped.csv", "--system", "phi4", "--json", "kept.json", "--html", "found.html")
    assert code == 2
    assert err == "error: found.html: cannot be written: No space left on device\n"
    assert out.startswith("What the equation lacks: ")
    assert json.loads((folder / "kept.json").read_text())["verdict"] == "explained"
