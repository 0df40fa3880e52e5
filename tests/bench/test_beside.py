"""A run beside published results, and tables for papers."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from latticebench.bench.beside import Published, read_published, without_method
from latticebench.bench.fitting import FitCase
from latticebench.bench.latex import NEEDS, escaped
from latticebench.bench.paired import paired
from latticebench.bench.publish import TABLES, best, matrix, publish, render
from latticebench.bench.published import read_head
from latticebench.bench.store import create
from latticebench.bench.tables import CASES, SHOWN, cases, read_cases
from latticebench.bench.worker import outcome
from latticebench.systems.errors import InputError

RESULTS = Path(__file__).parents[2] / "results"
COMMIT = read_head(RESULTS / "paper" / "cases.csv")["commit"]
PAPER = f"results/paper, commit {COMMIT}"
MADE = {"commit": "abc", "date": "2026-01-01", "machine": "m", "versions": {"numpy": "2"}}
PDFLATEX = shutil.which("pdflatex")


def result(label: str, e2: float | None, *, method: str = "mine.py", **about: Any) -> dict[str, Any]:
    case = FitCase(**{"system": "phi4", "library": "lib1", "label": label, "method": method, **about})
    known = {"case": case.model_dump(mode="json"), "identity": case.identity, "e2": e2, "residual": 0.25}
    return {**outcome(case, "ok"), **known}


def panel(library: str, **about: Any) -> dict[str, Any]:
    """The settings of a panel of the paper about the kink of phi^4."""
    return {"library": library, "parameters": {"C": 2.0, "v": 0.5}, **about}


def test_a_run_joins_published_rows_of_the_same_cases_whoever_fitted_them() -> None:
    own = cases([result("mine", 1e-3, **panel("lib1")), result("mine", 2e-3, **panel("lib2", settings={"a": 1}))])
    published = read_published(RESULTS / "paper")
    table = published.joined(own)
    assert list(table.columns) == [*own.columns, "published"]
    there = pd.read_csv(RESULTS / "paper" / "cases.csv", comment="#")
    there = there[there["seed"] == 1]
    for library, part in (("lib1", "1a"), ("lib2", "1b")):
        rows = table[table["library"] == library]
        wanted = there[there["part"] == part]
        named = wanted["method"].str.removesuffix(SHOWN) + "*"
        assert list(rows["method"].str.removesuffix(SHOWN)) == ["mine", *named]
        assert list(rows["e2"][1:]) == list(wanted["e2"])
        assert set(rows["part"]) == {part}
        assert list(rows["published"]) == ["", *[COMMIT] * len(wanted)]
    assert published.about == PAPER
    # Nothing else of what was published.
    assert len(table) == 2 + (there["part"].isin(["1a", "1b"])).sum()
    # A method that sees the truth is none to be compared with, though tables of earlier versions do not mark it.
    assert "oracle* (shown the truth)" in set(table["method"])
    assert not paired(table)["method"].str.startswith("oracle").any()


def test_other_data_and_other_seeds_are_other_cases() -> None:
    published = read_published(RESULTS / "paper")
    for other in (panel("lib1", noise=0.05), panel("lib1", seed=99), panel("lib1", samples=51)):
        with pytest.raises(InputError, match=f"{PAPER}: it has none of these cases"):
            published.joined(cases([result("mine", 1e-3, **other)]))
    assert without_method(FitCase(**panel("lib1"), system="phi4", label="a", method="a").identity) == without_method(
        FitCase(**panel("lib1", settings={"x": 2}), system="phi4", label="b", method="b").identity
    )


def test_a_case_that_stands_in_two_parts_is_shown_in_both_and_one_of_ones_own_in_its_own() -> None:
    old = pd.concat([cases([result("a", 0.1, method="a", part=part)]) for part in ("one", "two")])
    own = cases([result("mine", 0.2, part="mine"), result("mine", 0.3, library="lib2", part="mine")])
    table = Published(old, "there", "abc").joined(own)
    assert list(zip(table["part"], table["library"], table["method"], strict=True)) == [
        ("one", "lib1", "mine"), ("two", "lib1", "mine"), ("mine", "lib2", "mine"),
        ("one", "lib1", "a*"), ("two", "lib1", "a*"),
    ]  # fmt: skip


def test_another_store_can_stand_for_what_was_published_and_other_files_are_refused(tmp_path: Path) -> None:
    store = create(tmp_path / "store")
    case = FitCase(system="phi4", library="lib1", label="a", method="zero")
    store.plan({case.identity: "key"}, {})
    store.put("key", case, {**outcome(case, "ok"), "e2": 1.0}, MADE)
    table = read_published(tmp_path / "store").joined(cases([result("mine", 0.5)]))
    assert list(table["e2"]) == [0.5, 1.0]
    assert list(table["published"]) == ["", "abc"]
    (tmp_path / "cases.csv").write_text("identity,status,e2,method,part,data,library\nx,ok,1,a,,d,l\n")
    with pytest.raises(InputError, match="'x' is no identity"):
        read_published(tmp_path).joined(cases([result("mine", 0.5)]))


def test_the_best_of_a_row_is_the_least_error_and_never_that_of_the_truth() -> None:
    rows = [
        result("a", 0.3), result("a", 0.1, seed=2), result("b", 0.2), result("b", 0.2, seed=2),
        result("oracle", 1e-15, method="oracle"), result("oracle", 1e-15, method="oracle", seed=2),
        result("a", None, library="lib9"), result("b", None, library="lib9"), result("a", 0.5, library="alone"),
    ]  # fmt: skip
    marked = best(matrix(cases(rows)).set_index("library", drop=False))
    assert marked.columns[marked.loc["lib1"]].tolist() == ["a", "b"]
    assert not marked.loc[["lib9", "alone"]].to_numpy().any()
    assert not best(matrix(cases(rows[4:6]))).to_numpy().any()
    text = render(
        matrix(cases([result("a", 0.3), result("b", 2e-4), result("c", 0.1)])), {"seeds": [1]}, "tex", "errors"
    )
    assert r"phi4 & lib1 & \num{0.3} & \bfseries \num{2.0e-04} & \num{0.1} \\" in text


def test_a_caption_names_score_seeds_commit_and_what_was_published(tmp_path: Path) -> None:
    own = [result("mine", 1e-3, **panel("lib1"))]
    about = {"command": "latticebench run x", "commit": "0123_4", "seeds": [1, 2]}
    publish(own, about, tmp_path, TABLES, read_published(RESULTS / "paper"))
    caption = re.findall(r"\\caption\{(.*)\}\\label", (tmp_path / "errors.tex").read_text())[0]
    for told in ("E2", "Seeds 1, 2.", r"Commit 0123\_4.", f"({PAPER})", "best of each row"):
        assert told in caption
    assert f"# published: {PAPER}" in (tmp_path / "cases.csv").read_text()


def compiled(folder: Path, *names: str) -> str:
    """Compile tables in an article, and return the log."""
    packages = re.findall(r"\\usepackage(?:\[.*?\])?\{.*?\}", NEEDS)
    body = "".join(f"\\input{{{name}}}\\clearpage\n" for name in names)
    (folder / "doc.tex").write_text(
        f"\\documentclass{{article}}{''.join(packages)}\\begin{{document}}\n{body}\\end{{document}}\n"
    )
    for _ in range(2):
        subprocess.run(
            [str(PDFLATEX), "-interaction=nonstopmode", "-halt-on-error", "doc.tex"], cwd=folder, capture_output=True,
            check=False,
        )  # fmt: skip
    return (folder / "doc.log").read_text(errors="replace")


@pytest.mark.skipif(PDFLATEX is None, reason="there is no LaTeX")
def test_tables_compile_without_overfull_boxes_and_a_table_of_the_paper_is_one_page(tmp_path: Path) -> None:
    paper = read_cases(RESULTS / "paper").reindex(columns=list(CASES))
    odd = r"50 % & more_ #1 $x$ {a} \b ^ ~ <c> | "
    hard = [result(odd, 1e-3, part=odd, **panel("lib1")), result("b", float("inf"), part=odd, **panel("lib1"))]
    frames = {"errors": matrix(paper), "cases": paper.head(120), "odd": matrix(cases(hard))}
    terms = {"term": ["i*abs(u[n])**2*u[n]", "sin(2*u[n])"] * 60, "coefficient": [1.5e-9, -20.25] * 60}
    frames["coefficients"] = pd.DataFrame(terms)
    for name, frame in frames.items():
        (tmp_path / f"{name}.tex").write_text(render(frame, {"commit": "abc", "seeds": [1]}, "tex", name))
    log = compiled(tmp_path, "errors")
    assert "Output written on doc.pdf (1 page" in log
    log = compiled(tmp_path, *frames)
    assert "Output written on doc.pdf" in log
    assert [line for line in log.splitlines() if line.startswith(("Overfull", "!"))] == []


def test_what_latex_would_read_as_a_command_is_written_out() -> None:
    assert escaped(r"50% & {a_b} \x ^~#$") == (
        r"50\% \& \{a\_b\} \textbackslash{}x \textasciicircum{}\textasciitilde{}\#\$"
    )
