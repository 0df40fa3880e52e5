"""Tables: what they count and what they carry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from latticebench.bench.fitting import FitCase
from latticebench.bench.provenance import describe, origin
from latticebench.bench.publish import format_number, matrix, publish, render
from latticebench.bench.tables import cases, coefficients, limits, read_cases, summary
from latticebench.bench.worker import outcome
from latticebench.systems.errors import InputError

ORIGIN = origin()


def result(method: str, seed: int, e2: float | str | None, status: str = "ok", library: str = "lib1") -> dict[str, Any]:
    case = FitCase(system="phi4", library=library, label=method, method=method, seed=seed)
    about = {"case": case.model_dump(mode="json"), "identity": case.identity, "made": ORIGIN}
    made = {**outcome(case, status, "" if status == "ok" else f"{status} it was"), **about}
    if status == "ok":
        found = {"u[n]": 1.0, "abs(u[n])": 0.5}
        made.update(
            e2=e2,
            residual=0.25,
            seconds=0.1,
            coefficients=found,
            truth=None if e2 is None else {"u[n]": 2.0, "abs(u[n])": 0.0},
        )
    return made


RESULTS = [
    result("a", 1, 0.1), result("a", 2, 0.3), result("a", 3, None, "failed"),
    result("b", 1, 0.2), result("b", 2, None, "timeout"), result("b", 3, None, "died"),
    result("c", 1, None, "skipped"), result("c", 2, None, "skipped"), result("c", 3, None, "skipped"),
    result("d", 1, "inf"), result("d", 2, 0.1), result("d", 3, 0.1),
    result("a", 1, None, library="lib9"), result("b", 1, None, "failed", library="lib9"),
]  # fmt: skip
ABOUT = describe([ORIGIN], {"command": "latticebench run mine"}, [1, 2, 3])


def test_one_row_a_case_and_one_row_a_coefficient() -> None:
    assert len(cases(RESULTS)) == len(RESULTS)
    table = coefficients(RESULTS)
    assert len(table) == 2 * sum(r["status"] == "ok" for r in RESULTS)
    first = table.iloc[0]
    assert (first.term, first.coefficient, first.truth, first.error) == ("u[n]", 1.0, 2.0, -1.0)


def test_a_failure_counts_as_infinite_and_stays_in_the_median_and_a_skip_leaves_no_figure() -> None:
    short = summary(cases(RESULTS)).set_index(["library", "method"])
    assert short.loc[("lib1", "a"), "e2"] == 0.3
    assert short.loc[("lib1", "b"), "e2"] == np.inf
    assert np.isnan(short.loc[("lib1", "c"), "e2"])
    assert short.loc[("lib1", "d"), "e2"] == 0.1
    assert list(short.loc["lib1", "ok"]) == ["2/3", "1/3", "0/3", "3/3"]


def test_a_method_that_is_shown_the_truth_is_marked_wherever_it_is_named(tmp_path: Path) -> None:
    results = [result("a", 1, 0.1), result("oracle", 1, 1e-15), result("oracle", 2, None, "skipped")]
    publish(results, ABOUT, tmp_path)
    for name in ("cases", "coefficients", "summary", "errors"):
        for form in ("csv", "md", "tex"):
            text = (tmp_path / f"{name}.{form}").read_text()
            assert text.count("oracle") - text.count('"method": "oracle"') >= 1
            assert all("(shown the truth)" in line for line in text.splitlines() if "oracle" in line.split('""')[0])
    assert set(cases(results)["method"]) == {"a", "oracle (shown the truth)"}


def test_the_spread_holds_the_middle_of_the_seeds() -> None:
    short = summary(cases([result("a", seed, seed / 100) for seed in range(1, 22)])).iloc[0]
    assert (short["e2"], short["e2_low"], short["e2_high"], short["seeds"]) == (0.11, 0.03, 0.19, 21)
    alone = matrix(cases([result("a", 1, 0.1)]))
    assert list(alone["a"]) == ["0.1"]
    several = cases([result("a", seed, seed / 100) for seed in range(1, 22)])
    assert list(matrix(several)["a"]) == ["0.11 [0.03, 0.19] n=21"]
    assert list(matrix(several, spread=False)["a"]) == ["0.11"]


def test_the_coverage_is_the_share_of_intervals_that_hold_the_truth(tmp_path: Path) -> None:
    def sure(seed: int, value: float, noise: float = 0.01) -> dict[str, Any]:
        made = result("a", seed, 0.1)
        case = {**made["case"], "noise": noise}
        numbers = {"coefficients": {"u[n]": value, "u[n]**3": 2.0}, "truth": {"u[n]": 1.0, "u[n]**3": 2.0}}
        return {**made, "case": case, **numbers, "stderr": {"u[n]": 0.1, "u[n]**3": 0.1}}

    noisy = summary(cases([sure(1, 1.19), sure(2, 1.21), sure(3, 0.7), sure(4, 1.0)]))
    assert list(noisy["coverage"]) == [0.75]
    assert summary(cases([sure(1, 1.0, 0.0)]))["coverage"].isna().all()
    text = render(cases([sure(1, 1.19), sure(2, 1.21)]), {}, "csv")
    (tmp_path / "cases.csv").write_text(text)
    assert list(summary(read_cases(tmp_path))["coverage"]) == [0.75]
    assert summary(cases(RESULTS))["coverage"].isna().all()


def test_the_efficiency_is_the_bound_over_the_root_mean_square_error_of_the_seeds() -> None:
    def bounded(method: str, seed: int, e2: float | None, status: str = "ok") -> dict[str, Any]:
        verdicts = {"u[n]": "known to 1 %", "abs(u[n])": "cannot be known from these samples"}
        if status != "ok":
            return result(method, seed, e2, status)
        return {
            **result(method, seed, e2, status), "bound": 0.02, "bounds": {"u[n]": 0.02, "abs(u[n])": 0.5},
            "verdicts": verdicts,
        }  # fmt: skip

    errors = {"a": [0.03, 0.04, 0.0], "b": [0.02, 0.02, None], "c": [0.02, 0.02]}
    found = [
        bounded(method, seed, e2, "ok" if e2 is not None else "timeout")
        for method, values in errors.items() for seed, e2 in enumerate(values)
    ]  # fmt: skip
    short = summary(cases(found)).set_index("method")["efficiency"]
    assert short["a"] == pytest.approx(0.02 / np.sqrt(0.0025 / 3))
    assert short["b"] == 0.0
    assert np.isnan(short["c"])
    wide = matrix(cases(found))
    assert list(wide["bound"]) == ["0.02"]
    assert "bound" not in matrix(cases(RESULTS))
    table = limits(found)
    assert list(table["term"]) == ["u[n]", "abs(u[n])"]
    assert list(table["verdict"]) == ["known to 1 %", "cannot be known from these samples"]
    assert list(coefficients(found)["verdict"][:2]) == list(table["verdict"])


def test_a_cell_without_a_figure_says_why() -> None:
    wide = matrix(cases(RESULTS)).set_index("library")
    assert list(wide.loc["lib1", ["a", "b", "c", "d"]]) == [
        "0.3 [0.1, inf] n=3", "inf [0.2, inf] n=3", "skipped", "0.1 [0.1, inf] n=3"
    ]  # fmt: skip
    assert wide.loc["lib9", "a"] == "no truth, leaves 0.25"
    assert wide.loc["lib9", "b"] == "failed"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0123, "0.012"), (1e-9, "1.0e-09"), (0.0, "0"), (np.nan, ""), (np.inf, "inf"), (123456.0, "1.2e+05")],
)
def test_numbers_have_two_digits(value: float, text: str) -> None:
    assert format_number(value) == text


def test_parts_of_a_suite_are_told_apart() -> None:
    first, second = result("a", 1, 0.1), result("a", 1, 0.2)
    second["case"]["part"] = "panel (1a)"
    wide = matrix(cases([first, second]))
    assert list(wide["part"]) == ["", "panel (1a)"]
    assert list(wide["a"]) == ["0.1", "0.2"]


def test_what_is_published_can_be_read_and_carries_where_it_comes_from(tmp_path: Path) -> None:
    paths = publish(RESULTS, ABOUT, tmp_path)
    assert len(paths) == 15
    for path in paths:
        text = path.read_text()
        for word in ("command: latticebench run mine", "commit:", "machine:", "versions:", "seeds: 1, 2, 3"):
            assert word in text
    read, made = read_cases(tmp_path), cases(RESULTS)
    for name in ("e2", "residual", "identity", "status"):
        pd.testing.assert_series_equal(read[name], made[name], check_dtype=False)
    tex = (tmp_path / "coefficients.tex").read_text()
    assert r"$\left|{u_{n}}\right|$" in tex
    assert r"forecast\_error" in (tmp_path / "cases.tex").read_text()


def test_a_latex_table_has_rules_of_booktabs_and_columns_of_siunitx() -> None:
    frame = pd.DataFrame({"label_1": ["50 % & more", "b"], "E2": [-1.5e-9, 12.25], "a": ["0.3", "no truth"]})
    table = render(frame, ABOUT, "tex")
    head, rows = table[table.index(r"\begin{tabular}") :].split("\\midrule\n")
    assert head == (
        r"\begin{tabular}{lS[table-format=-2.1e-1]S[table-format=1.1]}" + "\n\\toprule\n"
        r"{label\_1} & {E2} & {a} \\" + "\n"
    )
    assert rows.splitlines()[0] == r"50 \% \& more & -1.5e-9 & 0.3 \\"
    assert rows.splitlines()[1:3] == [r"b & 12 & {no truth} \\", r"\bottomrule"]


def test_a_table_can_be_published_alone_and_a_long_one_for_programs_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("latticebench.bench.publish.MOST_READ", len(RESULTS) - 1)
    paths = publish(RESULTS, ABOUT, tmp_path, ["cases", "errors"])
    assert [path.name for path in paths] == ["cases.csv", "errors.csv", "errors.md", "errors.tex"]


def test_a_file_that_is_no_table_of_cases_is_refused(tmp_path: Path) -> None:
    (tmp_path / "cases.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="identity"):
        read_cases(tmp_path)
    with pytest.raises(InputError, match="no such table"):
        read_cases(tmp_path / "none")


def test_results_of_several_commits_name_them_all() -> None:
    first = {**ORIGIN, "commit": "one", "versions": {"numpy": "1"}}
    second = {**ORIGIN, "commit": "two", "versions": {"numpy": "2"}}
    described = describe([first, second], {})
    assert described["commit"] == ["one", "two"]
    assert described["versions"]["numpy"] == "1 and 2"


def test_a_sharp_sign_in_a_reason_does_not_cut_the_row(tmp_path: Path) -> None:
    odd = {**result("nan", 1, None, "failed"), "reason": "# of sites, | and \\ wrong"}
    publish([odd, *RESULTS], ABOUT, tmp_path)
    read = read_cases(tmp_path)
    assert list(read["identity"]) == list(cases([odd, *RESULTS])["identity"])
    assert read["method"][0] == "nan"


def test_the_provenance_names_no_path_and_no_host() -> None:
    import platform

    text = str(ABOUT)
    assert platform.node() not in text or len(platform.node()) < 4
    assert str(Path.home()) not in text
    assert ABOUT["versions"]["numpy"] == np.__version__
