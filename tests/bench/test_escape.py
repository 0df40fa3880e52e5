"""Escaping: a text of a user's is shown as it is, and is nothing else to whoever reads the file."""

from __future__ import annotations

import io
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from latticebench.bench.escape import csv_cell, csv_table, csv_text, label, markdown
from latticebench.bench.publish import markdown_table, render
from latticebench.bench.trials.recorded import page_of
from latticebench.systems.errors import printable
from latticebench.systems.files import shown

ODD = st.text(alphabet="=+-@'\"|<>[]()`$_\\,;#\t\r\n\x1b\x00ab1.e \ud800é", max_size=12)


@given(text=ODD)
@settings(max_examples=100, deadline=None)
def test_a_cell_of_a_csv_file_is_no_formula_and_comes_back(text: str) -> None:
    written = csv_table(pd.DataFrame({"a": [text], "b": [1.5]}))
    found = pd.read_csv(io.StringIO(written), dtype=str, keep_default_na=False)["a"][0]
    assert csv_text(found) == printable(text)
    assert found[:1] not in tuple("=@\t\r")
    if found[:1] in ("+", "-"):
        float(found)


@given(text=ODD)
@settings(max_examples=100, deadline=None)
def test_a_cell_of_markdown_begins_no_element_is_no_link_and_ends_no_cell(text: str) -> None:
    found = markdown(text)
    assert "<a" not in found
    assert "](" not in found
    assert "\n" not in found
    assert found.count("|") == found.count("\\|")


@given(name=ODD, value=ODD)
@settings(max_examples=15, deadline=None)
def test_a_table_of_odd_texts_has_its_lines_and_no_others(name: str, value: str) -> None:
    frame = pd.DataFrame({"method": ["a", "b"], f"x{name}": [value, "1"]})
    for form, remark, lines in (("csv", "#", 3), ("md", "-", 5), ("tex", "%", 13)):
        text = render(frame, {"command": name, "settings": {name: value}}, form)
        assert len([line for line in text.splitlines() if not line.startswith(remark)]) == lines, text


@pytest.mark.parametrize(
    ("text", "wanted"),
    [("a\nb", "a\\nb"), ("\x1b[31m", "\\x1b[31m"), ("\ud800", "\\ud800"), ("ü × −", "ü × −"), ("\u202e", "\\u202e")],
)
def test_what_steers_a_terminal_is_written_as_an_escape(text: str, wanted: str) -> None:
    assert printable(text) == wanted


def test_labels_of_figures_are_no_mathematics() -> None:
    assert label("$x$") == r"\$x\$"
    assert not label("_hidden").startswith("_")
    assert csv_cell(-1.5) == -1.5
    assert csv_cell("-1.5e-3") == "-1.5e-3"
    assert csv_cell("-2*u[n]") == "'-2*u[n]"
    assert shown("a\nb.csv") == "a\\nb.csv"


def test_what_a_suite_says_of_a_recording_is_text_in_its_page(tmp_path: Path) -> None:
    evil = "<script>x</script> [a](javascript:x) `"
    case = {"name": "one", "about": evil, "file": evil, "terms": "u[n]", "order": 2, "ends": evil, "rows": None}
    error = {name: {"before": "<b>", "after": 0.5} for name in ("residual", "rms", "forecast")}
    size = {"value": -1.1313, "stderr": 0.0269, "unit": evil}
    effect = {
        "effect": evil,
        "parameters": {"site": evil, evil: 1.0},
        "natural": {evil: size, "time": {**size, "unit": "s"}},
    }
    effect["indistinguishable"] = [evil]
    report = {"verdict": evil, "sentence": evil, "effects": [effect], "noise_lines": [evil], "error": error}
    report["horizons"] = []
    told = [
        {"case": case, "status": "ok", "reason": "", "report": report, "seconds": 1.0},
        {"case": case, "status": "failed", "reason": evil, "report": None, "seconds": None},
    ]
    assert any("time -1.131 ± 0.027 s" in line for line in page_of(told[0]))
    for line in (line for one in told for line in page_of(one)):
        assert "<script" not in line
        assert "<b>" not in line
        assert "](" not in line


def test_a_term_stays_within_its_code_in_a_table() -> None:
    table = markdown_table(pd.DataFrame({"term": ["u[n]` <script>|\x1b"], "value": [1.0]}))
    assert r"`u[n]' <script>\|\x1b`" in table
