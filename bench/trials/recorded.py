"""What the diagnosis found in measured recordings, as a page and as one JSON file per recording."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from latticebench.bench.case import NAME
from latticebench.bench.escape import markdown
from latticebench.bench.provenance import lines
from latticebench.bench.publish import format_number, markdown_list, readable
from latticebench.bench.report.units import with_unit
from latticebench.systems.errors import InputError
from latticebench.systems.files import write_text

TABLES = ("measured",)
FIGURES: tuple[str, ...] = ()
# Candidates that the page shows.
SHOWN = 6
ERRORS = {
    "residual": "residual over the noise", "rms": "residual in the readings' units", "forecast": "forecast",
}  # fmt: skip


def table(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of recordings: one row each with the verdict, what was named, and errors before and after."""
    columns = [
        "name", "file", "terms", "status", "verdict", "partly", "named", "residual_before", "residual_after",
        "forecast_before", "forecast_after", "seconds", "message",
    ]  # fmt: skip
    rows = []
    for result in results:
        row = {**result["case"], **result, **summarised(result["report"]), "message": result["reason"]}
        rows.append({name: row[name] for name in columns})
    return pd.DataFrame(rows, columns=columns)


def summarised(report: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the verdict, the named effects, and the errors before and after of a report; None for each without one."""
    errors = [f"{name}_{when}" for name in ("residual", "forecast") for when in ("before", "after")]
    if report is None:
        return dict.fromkeys(["verdict", "partly", "named", *errors])
    found = {name: report["error"][name.split("_")[0]][name.split("_")[1]] for name in errors}
    named = " + ".join(one["effect"] for one in report["effects"])
    # A report of an earlier version did not say.
    return {"verdict": report["verdict"], "partly": "; ".join(report.get("partly", ())), "named": named, **found}


def publish(
    results: Iterable[Mapping[str, Any]], about: Mapping[str, Any], folder: Path, only: Sequence[str] = TABLES
) -> list[Path]:
    """Write the page, and the report on each recording.

    Raises:
        InputError: a file cannot be written, or a recording's name is none of a file.
    """
    if not only:
        return []
    ordered = sorted(results, key=lambda result: str(result["case"]["name"]))
    for result in ordered:
        # The store may be anybody's; its names must not lead out of the folder.
        if not re.fullmatch(NAME, str(result["case"]["name"])):
            raise InputError(f"{folder}: a recording called {result['case']['name']!r} can have no file of that name")
    head = markdown_list(lines(about))
    text = ["# Measured recordings", "", *head, ""]
    for result in ordered:
        text += page_of(result)
    path = folder / "measured.md"
    write_text(path, "\n".join(text))
    written = [path]
    for result in ordered:
        if result["report"] is not None:
            path = folder / f"{result['case']['name']}.json"
            write_text(path, _document(result, about))
            written.append(path)
    return written


def _document(result: Mapping[str, Any], about: Mapping[str, Any]) -> str:
    """Return the report on a recording as the text of a JSON file, see `latticebench schema diagnosis`."""
    from latticebench.bench.report.content import DiagnosisDocument
    from latticebench.bench.report.document import to_json

    made = {"command": about.get("command", ""), **result["made"], "seeds": []}
    return to_json(DiagnosisDocument.model_validate({"provenance": made, **result["report"]}))


def draw_all(
    results: Iterable[Mapping[str, Any]],  # noqa: ARG001
    about: Mapping[str, Any],  # noqa: ARG001
    folder: Path,  # noqa: ARG001
    only: Sequence[str] = FIGURES,  # noqa: ARG001
) -> list[Path]:
    """Draw nothing: the pictures of one recording are those of `latticebench diagnose --html`."""
    return []


def show(results: Iterable[Mapping[str, Any]], value: str = "") -> None:  # noqa: ARG001
    """Print the verdict on each recording."""
    from latticebench.bench.report.screen import show_rows

    frame = table(results).drop(columns=["file", "terms"])
    show_rows(list(frame.columns), readable(frame).to_numpy().tolist())


def page_of(result: Mapping[str, Any]) -> list[str]:
    """Return what was found in one recording as lines of Markdown, in which what a suite says is text and no markup."""
    return [line if line.startswith("|") else markdown(line) for line in _recording(result)]


def _recording(result: Mapping[str, Any]) -> list[str]:
    case, report = result["case"], result["report"]
    rows = f", rows {case['rows'][0]} to {case['rows'][1]}" if case["rows"] else ""
    declared = f"{case['about']} (`{case['terms']}`, order {case['order']}, ends {case['ends']})"
    text = [f"## {case['name']}", "", f"`{case['file']}`{rows}. Declared: {declared}.", ""]
    if report is None:
        return [*text, f"{result['status']}: {result['reason']}", ""]
    text += [f"Verdict: **{report['verdict']}**, {result['seconds']:.0f} s. {report['sentence']}", ""]
    for effect in report["effects"]:
        natural = effect["natural"]
        where = [f"{name} {value}" for name, value in effect["parameters"].items() if name not in natural]
        values = ", ".join([*where, *(f"{name} {_sized(size)}" for name, size in natural.items())])
        alike = f"; cannot be told from {', '.join(effect['indistinguishable'])}" if effect["indistinguishable"] else ""
        text.append(f"- {effect['effect']}: {values}{alike}")
    text += ["", *(f"Noise: {line}." for line in report["noise_lines"])]
    error = report["error"]
    text += ["", "| | before | after |", "|---|---|---|"]
    for name, title in ERRORS.items():
        before, after = (markdown(format_number(error[name][when])) for when in ("before", "after"))
        text.append(f"| {title} | {before} | {after} |")
    text += ["", "How the search went: the best model on each horizon, and how far the next one was behind (nats):", ""]
    for one in report["horizons"]:
        best, *others = one["models"]
        far = others[0]["behind"] if others else 0.0
        behind = f"; {_named(others[0])} {abs(far):.1f} {'ahead' if far < 0 else 'behind'}" if others else ""
        text.append(f"- {one['samples']} samples, {one['periods']:.2g} periods: {_named(best)}{behind}")
    tried = report["horizons"][-1]["tried"] if report["horizons"] else []
    listed = ", ".join(f"{one['effect']} {one['gain']:.1f} ({one['price']:.1f})" for one in tried[:SHOWN])
    text += ["", f"Candidates beside the last model, with what they gain and what they cost (nats): {listed}."]
    return [*text, ""]


def _sized(size: Mapping[str, Any]) -> str:
    """Return a number with its standard error and its unit, as far as they are known."""
    if size["value"] is None:
        return "unknown"
    error = "" if size["stderr"] is None else f" ± {size['stderr']:.2g}"
    return with_unit(f"{size['value']:.4g}{error}", size["unit"])


def _named(model: Mapping[str, Any]) -> str:
    """Return the effects of a model in one text."""
    return " + ".join(model["effects"]) or "as declared"
