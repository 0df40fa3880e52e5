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

from commandline import refused, succeed
from latticebench.bench.adequacy import Adequacy
from latticebench.bench.case import Case
from latticebench.bench.compare import compare, of_fits
from latticebench.bench.fitting import FitCase
from latticebench.bench.provenance import describe, origin
from latticebench.bench.report.document import Content, Number, Provenance, provenance, to_json
from latticebench.bench.report.outputs import (
    FitDocument,
    FitRow,
    LaboratoryRow,
    RecordingRow,
    compare_document,
    fit_document,
    run_document,
)
from latticebench.bench.report.schema import DOCUMENTS, json_schema
from latticebench.bench.report.units import units_of
from latticebench.bench.tables import cases
from latticebench.bench.trials import recorded, scores
from latticebench.bench.trials.laboratory import tables as tables_of_laboratory
from latticebench.bench.trials.laboratory.case import Laboratory
from latticebench.bench.trials.measured import Measured
from latticebench.bench.trials.trial import Trial
from latticebench.bench.worker import outcome
from latticebench.methods.method import Fit
from latticebench.systems.lattice import library
from latticebench.systems.samples import Origin

Conforms = Callable[[str, str], dict[str, Any]]
SCHEMAS = resources.files("latticebench.bench.report") / "schemas"


def test_the_published_schemas_are_those_of_the_documents() -> None:
    assert {path.name for path in SCHEMAS.iterdir()} == {f"{kind}.json" for kind in DOCUMENTS}
    for kind in DOCUMENTS:
        published = (SCHEMAS / f"{kind}.json").read_text(encoding="utf-8")
        assert published == json_schema(kind), "write them anew: latticebench schema --out bench/report/schemas"
        jsonschema.Draft202012Validator.check_schema(json.loads(published))


def test_schemas_can_be_listed_printed_and_written(tmp_path: Path) -> None:
    assert succeed("schema", cwd=tmp_path).split() == sorted(DOCUMENTS)
    assert succeed("schema", "fit", cwd=tmp_path) == json_schema("fit")
    succeed("schema", "--out", str(tmp_path / "new"), cwd=tmp_path)
    assert (tmp_path / "new" / "limit.json").read_text() == json_schema("limit")
    succeed("schema", "fit", "--out", str(tmp_path / "one"), cwd=tmp_path)
    assert [path.name for path in (tmp_path / "one").iterdir()] == ["fit.json"]


def test_an_unknown_schema_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    assert "unknown document 'fits'" in refused("schema", "fits", cwd=tmp_path)


class Numbers(Content):
    one: Number
    more: dict[str, Number]


def test_numbers_that_json_lacks_have_one_rule() -> None:
    values = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf, "half": 0.5, "numpy": np.float64(2.5)}
    text = to_json(Numbers(one=math.nan, more=values))
    found = json.loads(text)
    assert found == {"one": None, "more": {"nan": None, "inf": "inf", "-inf": "-inf", "half": 0.5, "numpy": 2.5}}
    again = Numbers.model_validate_json(text)
    assert math.isnan(again.one)
    assert again.more["-inf"] == -math.inf


def test_a_document_of_another_version_is_refused() -> None:
    about = Provenance(command="", commit="", date="", machine="", versions={}, seeds=[])
    fit = Fit("mine", library("own", "u[n]"), 2, np.ones(1), 0.5)
    text = to_json(fit_document(fit, Adequacy(0.5, 0.5, 1.0, fits=True), units_of(Origin()), about))
    with pytest.raises(pydantic.ValidationError):
        FitDocument.model_validate_json(text.replace("fit/1", "fit/2"))


def test_a_fit_and_a_limit_are_written_in_the_published_form(conforms: Conforms, tmp_path: Path) -> None:
    system = ["--system", "phi4", "--library", "lib1"]
    succeed("simulate", "phi4", "--sites", "9", "--samples", "20", "--out", "a b.csv", cwd=tmp_path)
    fit = ["fit", "a b.csv", *system, "--method", "least-squares", "--seed", "7", "--json"]
    found = conforms("fit", succeed(*fit, "-", cwd=tmp_path))
    assert found["provenance"]["command"] == "latticebench fit 'a b.csv' " + " ".join([*fit[2:], "-"])
    assert found["provenance"]["seeds"] == [7]
    assert found["provenance"]["versions"]["numpy"] == np.__version__
    assert found["stderr"] is None
    assert "u''" in succeed(*fit, "fit.json", cwd=tmp_path)
    assert conforms("fit", (tmp_path / "fit.json").read_text())["coefficients"] == found["coefficients"]
    bound = conforms("limit", succeed("limit", *system, "--sites", "9", "--json", "-", cwd=tmp_path))
    assert list(bound["terms"]) == list(found["coefficients"])
    assert (found["warnings"], found["quality"]["fits"], bound["warnings"]) == ([], True, [])


def test_recordings_are_listed_in_the_published_form(conforms: Conforms, tmp_path: Path) -> None:
    found = conforms("list", succeed("data", "--json", cwd=tmp_path))
    assert found["kind"] == "recordings"


def row(case: Case, status: str, **found: Any) -> dict[str, Any]:
    """A result as the store gives it."""
    about = {"case": case.model_dump(mode="json"), "identity": case.identity, "made": origin()}
    return {**outcome(case, status, "" if status == "ok" else "it was so", {**case.blank(), **found}), **about}


def fit(seed: int, e2: float | str | None, status: str = "ok") -> dict[str, Any]:
    return row(FitCase(system="phi4", library="lib1", label="a", method="a", seed=seed), status, e2=e2)


def test_a_run_of_all_kinds_has_the_published_form(conforms: Conforms) -> None:
    trial, recording = Trial(system="phi4", effect="damping", z=10), Measured(name="a", file="a", terms="u[n]", order=2)
    report = {
        "verdict": "explained", "effects": [{"effect": "damping"}],
        "error": {name: {"before": "inf", "after": 1.0} for name in ("residual", "forecast")},
    }  # fmt: skip
    found = {
        "named": ["damping"], "alike": [[]], "verdict": "partly explained", "partly": ["a", "b"], "apart": 0.0,
        "residual_after": 1.0,
    }  # fmt: skip
    lost = {"recording": {"instrument": "coarse"}, "truth": []}
    tables = [
        cases([fit(1, 0.1), fit(2, "inf"), fit(3, None, "failed")]),
        scores.table([row(trial, "ok", **found), row(trial, "timeout")]),
        recorded.table([row(recording, "ok", report=report), row(recording, "skipped")]),
        tables_of_laboratory.table([row(Laboratory(seed=20_001), "memory", **lost)]),
    ]
    every = [one for table in tables for one in table.to_dict("records")]
    written = conforms("run", to_json(run_document(every, describe([origin()], {"command": "x", "jobs": 2}, [1, 2]))))
    assert [one["e2"] for one in written["cases"][:3]] == [0.1, "inf", None]
    assert [one["right"] for one in written["cases"][3:5]] == [True, None]
    assert [one["partly"] for one in written["cases"][3:5]] == ["a; b", ""]
    assert [one["forecast_before"] for one in written["cases"][5:]] == ["inf", None, None]
    assert [list(written["cases"][place]) for place in (0, 5, 7)] == [
        list(one.model_fields) for one in (FitRow, RecordingRow, LaboratoryRow)
    ]


def test_a_comparison_has_the_published_form(conforms: Conforms) -> None:
    old, new = ([fit(1, 0.1), fit(2, "inf"), fit(3, None, "failed")], [fit(1, 0.5), fit(2, 0.1)])
    judged = compare(*(of_fits(cases(results)) for results in (old, new)))
    found = conforms("compare", to_json(compare_document(judged, provenance())))
    assert [len(found[key]) for key in ("worse", "better", "gone", "new")] == [1, 1, 1, 0]
    assert found["worse"][0]["ratio"] == 5
