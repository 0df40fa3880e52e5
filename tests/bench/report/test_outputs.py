"""JSON documents: one form, one rule for numbers, published schemas."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pydantic
import pytest

from latticebench.bench import cli
from latticebench.bench.case import blank
from latticebench.bench.cli.arguments import jsonable
from latticebench.bench.compare import compare
from latticebench.bench.provenance import describe, origin
from latticebench.bench.report.document import Content, Number, Provenance, provenance, to_json
from latticebench.bench.report.outputs import (
    CompareDocument,
    FitDocument,
    RunDocument,
    fit_document,
)
from latticebench.bench.report.schema import DOCUMENTS, json_schema
from latticebench.bench.suite import Case
from latticebench.bench.tables import cases
from latticebench.methods.method import Fit
from latticebench.systems.lattice import library

Conforms = Callable[[str, str], dict[str, Any]]
SCHEMAS = resources.files("latticebench.bench.report") / "schemas"


def typed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Type a command and return what it prints."""
    monkeypatch.setattr("sys.argv", ["latticebench", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.main()
    shown = capsys.readouterr()
    assert not end.value.code, shown.err
    return shown.out


def test_the_published_schemas_are_those_of_the_documents() -> None:
    assert {path.name for path in SCHEMAS.iterdir()} == {f"{kind}.json" for kind in DOCUMENTS}
    for kind in DOCUMENTS:
        published = (SCHEMAS / f"{kind}.json").read_text(encoding="utf-8")
        assert published == json_schema(kind), "write them anew: latticebench schema --out bench/report/schemas"
        jsonschema.Draft202012Validator.check_schema(json.loads(published))


def test_schemas_can_be_listed_printed_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert typed(monkeypatch, capsys, "schema").split() == sorted(DOCUMENTS)
    assert typed(monkeypatch, capsys, "schema", "fit") == json_schema("fit")
    typed(monkeypatch, capsys, "schema", "--out", str(tmp_path / "new"))
    assert (tmp_path / "new" / "limit.json").read_text() == json_schema("limit")


def test_an_unknown_schema_is_refused_with_those_that_there_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["latticebench", "schema", "fits"])
    with pytest.raises(SystemExit):
        cli.main()
    assert "unknown document 'fits'" in capsys.readouterr().err


class Numbers(Content):
    one: Number
    more: dict[str, Number]


def test_numbers_that_json_lacks_have_one_rule() -> None:
    values = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf, "half": 0.5, "numpy": np.float64(2.5)}
    text = to_json(Numbers(one=math.nan, more=values))
    found = json.loads(text)
    assert found == {"one": None, "more": {"nan": None, "inf": "inf", "-inf": "-inf", "half": 0.5, "numpy": 2.5}}
    assert found["more"] == jsonable(values)
    again = Numbers.model_validate_json(text)
    assert math.isnan(again.one)
    assert again.more["-inf"] == -math.inf


def test_a_document_of_another_version_is_refused() -> None:
    about = Provenance(command="", commit="", date="", machine="", versions={}, seeds=[])
    text = to_json(fit_document(Fit("mine", library("own", "u[n]"), 2, np.ones(1), 0.5), about))
    with pytest.raises(pydantic.ValidationError):
        FitDocument.model_validate_json(text.replace("fit/1", "fit/2"))


def test_a_fit_and_a_limit_are_written_in_the_published_form(
    conforms: Conforms, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    system = ["--system", "phi4", "--library", "lib1"]
    typed(monkeypatch, capsys, "simulate", "phi4", "--sites", "9", "--samples", "20", "--out", "a b.csv")
    fit = ["fit", "a b.csv", *system, "--method", "least-squares", "--seed", "7", "--json"]
    found = conforms("fit", typed(monkeypatch, capsys, *fit, "-"))
    assert found["provenance"]["command"] == "latticebench fit 'a b.csv' " + " ".join([*fit[2:], "-"])
    assert found["provenance"]["seeds"] == [7]
    assert found["provenance"]["versions"]["numpy"] == np.__version__
    assert found["stderr"] is None
    assert "u''" in typed(monkeypatch, capsys, *fit, "fit.json")
    assert conforms("fit", (tmp_path / "fit.json").read_text())["coefficients"] == found["coefficients"]
    bound = conforms("limit", typed(monkeypatch, capsys, "limit", *system, "--sites", "9", "--json", "-"))
    assert list(bound["terms"]) == list(found["coefficients"])


def test_recordings_are_listed_in_the_published_form(
    conforms: Conforms, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = conforms("list", typed(monkeypatch, capsys, "data", "--json"))
    assert found["kind"] == "recordings"


def result(seed: int, e2: float | str | None, status: str = "ok") -> dict[str, Any]:
    case = Case(system="phi4", library="lib1", label="a", method="a", seed=seed)
    return {**blank(case, status, ""), "e2": e2, "made": origin()}


def test_the_table_of_cases_and_a_comparison_have_the_published_form(conforms: Conforms) -> None:
    old, new = ([result(1, 0.1), result(2, "inf"), result(3, None, "failed")], [result(1, 0.5), result(2, 0.1)])
    about = Provenance(**{"command": "latticebench run mine", **describe(old, {})})
    table = RunDocument.model_validate({"provenance": about, "cases": cases(old).to_dict("records")})
    rows = conforms("run", to_json(table))["cases"]
    assert [row["e2"] for row in rows] == [0.1, "inf", None]
    judged = compare(cases(old), cases(new))
    comparison = CompareDocument(
        provenance=provenance(), worse=judged.worse.to_dict("records"), better=judged.better.to_dict("records"),
        same=judged.same, gone=judged.gone, new=judged.fresh,
    )  # fmt: skip
    found = conforms("compare", to_json(comparison))
    assert [len(found[key]) for key in ("worse", "better", "gone", "new")] == [1, 1, 1, 0]
