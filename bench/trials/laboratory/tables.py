"""Tables and the picture of diagnoses of laboratory recordings, with binomial (Wilson, 95 %) intervals."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from latticebench.bench.figures import save
from latticebench.bench.provenance import lines
from latticebench.bench.publish import markdown_list, markdown_table, readable, render
from latticebench.bench.trials.laboratory.judging import WORSE, found_in, judge, matched, written
from latticebench.systems.files import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TABLES = ("laboratory", "summary", "effects")
FIGURES = ("confusion",)
COLUMNS = (
    "part", "asked", "seed", "instrument", "sites", "ends", "readings", "periods", "declared", "status", "count",
    "truth", "verdict", "partly", "named", "right", "right_alike", "missed", "invented", "placed", "covered",
    "intervals", "residual_before", "residual_after", "pieces", "forecast_before", "forecast_after", "seconds",
    "cpu_seconds", "message",
)  # fmt: skip
# What the residual, in units of the noise that was added, may be when all has been found.
FITS = 1.3
# Bounds of z of the table by effect.
BANDS = (5.0, 10.0, 30.0, 100.0, np.inf)
# A recording that gave no diagnosis (a limit, an exception) counts as wrong.
LOST = ("failed", "memory", "timeout", "died")


def table(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of recordings: one row each, judged by the rule as it stands."""
    rows = [_row(result) for result in results]
    frame = pd.DataFrame([{name: row.get(name) for name in COLUMNS} for row in rows], columns=list(COLUMNS))
    return frame.sort_values(["part", "asked", "seed"]).reset_index(drop=True)


def _known(result: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a result with what is in its recording: that of a case that was stopped at a limit is made anew."""
    if result["recording"] is not None or result["status"] not in LOST:
        return result
    from latticebench.bench.trials.laboratory.case import Laboratory, about

    one = Laboratory.of(result["case"]).recording()
    return {**result, "recording": about(one), "truth": written(one)}


def _row(incomplete: Mapping[str, Any]) -> dict[str, Any]:
    result = _known(incomplete)
    case, made, truth = result["case"], result["recording"] or {}, result["truth"] or []
    row = {**case, **{name: result[name] for name in COLUMNS if name in result}, **made}
    row["asked"] = f"{case['instrument']} | {case['effects']}" + (f" | N={case['sites']}" if case["sites"] else "")
    row["partly"] = "; ".join(result["partly"] or ())
    row.update(message=result["reason"] or None, count=None if result["truth"] is None else len(truth))
    row["truth"] = " + ".join(f"{one['name']} z={one['z']:.3g}" for one in truth)
    if result["status"] != "ok":
        return {**row, "right": False, "right_alike": False} if result["status"] in LOST else row
    found = judge(truth, found_in(result), made["instrument"])
    row["named"] = " + ".join(" or ".join([one["name"], *one["alternatives"]]) for one in result["findings"])
    row.update(
        right=found.right, right_alike=found.right_alike, missed=" + ".join(found.missed),
        invented=" + ".join(found.invented), placed=_ratio(found.placed), covered=found.covered[0],
        intervals=found.covered[1],
    )  # fmt: skip
    return row


def _ratio(counts: tuple[int, int]) -> str:
    return f"{counts[0]}/{counts[1]}" if counts[1] else ""


def share(values: Sequence[bool] | pd.Series) -> str:
    """Return a share in per cent with its 95 % interval after Wilson, and of how many it is."""
    from scipy.stats import binomtest

    good, count = int(np.sum(np.asarray(values, dtype=bool))), len(values)
    if not count:
        return ""
    interval = binomtest(good, count).proportion_ci(method="wilson")
    return f"{100 * good / count:.1f} ({100 * interval.low:.1f}-{100 * interval.high:.1f}) of {count}"


def summary(frame: pd.DataFrame) -> pd.DataFrame:
    """Return how good the diagnosis is: on the whole, by part, instrument, number of effects and sites."""
    ran = frame[frame["status"].isin(["ok", *LOST])]
    something = ran[ran["count"] != 0]
    found = [_line("all", "with something missing", something)]
    for by in ("part", "instrument", "count", "sites"):
        values = sorted(something[by].dropna().unique().tolist())
        found += [_line(by, str(value), something[something[by] == value]) for value in values if value != ""]
    return pd.DataFrame(found)


def _line(by: str, value: str, group: pd.DataFrame) -> dict[str, Any]:
    ok = group[group["status"] == "ok"]
    after, before = (pd.to_numeric(ok[f"forecast_{when}"], errors="coerce") for when in ("after", "before"))
    residual = pd.to_numeric(ok["residual_after"], errors="coerce")
    covered, intervals = int(ok["covered"].fillna(0).sum()), int(ok["intervals"].fillna(0).sum())
    return {
        "by": by, "value": value.removesuffix(".0"), "right": share(group["right"] == True),  # noqa: E712
        "right, alike counted": share(group["right_alike"] == True),  # noqa: E712
        "nothing invented": share(ok["invented"].fillna("") == ""),
        f"residual at most {FITS:g}": share(residual <= FITS),
        "intervals that hold": share([True] * covered + [False] * (intervals - covered)),
        "forecast worse": share(~(after <= (1 + WORSE) * before)[after.notna() | before.notna()]),
        "seconds (median)": float(pd.to_numeric(ok["cpu_seconds"]).median()),
        "seconds (worst)": float(pd.to_numeric(ok["cpu_seconds"]).max()),
        "no answer": int((group["status"] != "ok").sum()),
    }  # fmt: skip


def nothing_missing(frame: pd.DataFrame) -> pd.DataFrame:
    """Return, per instrument, how often something is named though nothing is missing, or 'unexplained' is said."""
    ran = frame[frame["status"].isin(["ok", *LOST]) & (frame["count"] == 0)]
    found = []
    for kind, group in [("all", ran), *ran.groupby("instrument")]:
        ok = group[group["status"] == "ok"]
        found.append({
            "instrument": kind, "false alarms": share(ok["invented"].fillna("") != ""),
            "unexplained": share(ok["verdict"].isin(["unexplained", "partly explained"])),
            "seconds (median)": float(pd.to_numeric(ok["cpu_seconds"]).median()), "no answer": len(group) - len(ok),
        })  # fmt: skip
    return pd.DataFrame(found)


def by_effect(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Return, per effect and range of z, how often it was named, alone or in its group; where no answer came, not."""
    rows = []
    for result in map(_known, results):
        if result["status"] in ("ok", *LOST):
            pairs = matched(result["truth"], found_in(result) if result["status"] == "ok" else ())
            rows += [(one["name"], one["z"], j is not None) for one, j in zip(result["truth"], pairs, strict=True)]
    frame = pd.DataFrame(rows, columns=["effect", "z", "named"])
    found = []
    for name, group in [("all", frame), *frame.groupby("effect")]:
        line = {"effect": name, "named": share(group["named"])}
        for low, high in itertools.pairwise(BANDS):
            title = f"z {low:g}-{high:g}" if np.isfinite(high) else f"z from {low:g}"
            line[title] = share(group[(group["z"] >= low) & (group["z"] < high)]["named"])
        found.append(line)
    return pd.DataFrame(found)


def counts(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Count what was named (columns) per effect that was there (rows); "missed" and "not there" for the rest."""
    pairs: list[tuple[str, str]] = []
    for result in results:
        if result["status"] != "ok":
            continue
        found, truth = found_in(result), result["truth"]
        judged = judge(truth, found, result["recording"]["instrument"])
        places = matched(truth, found)
        pairs += [(one["name"], "missed" if j is None else found[j].name) for one, j in zip(truth, places, strict=True)]
        pairs += [("not there", name) for name in judged.invented]
    frame = pd.DataFrame(pairs, columns=["there", "named"])
    table = pd.crosstab(frame["there"], frame["named"])
    rows = sorted(table.index, key=lambda name: (name == "not there", name))
    names = sorted(table.columns, key=lambda name: (name == "missed", name not in table.index, name))
    return table.reindex(index=rows, columns=names)


def confusion(results: Iterable[Mapping[str, Any]]) -> Figure:
    """Draw what was named per effect that was there, and what was invented."""
    from matplotlib.figure import Figure

    table = counts(results)
    portion = table.div(table.sum(axis=1), axis=0).fillna(0.0)
    figure = Figure(figsize=(11, 3.2 + 0.24 * len(table)), layout="constrained")
    axes = figure.add_subplot()
    if table.size:
        axes.imshow(portion.to_numpy(), cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(np.arange(table.shape[1]), table.columns, rotation=90)
    axes.set_yticks(np.arange(table.shape[0]), table.index)
    for row, column in np.argwhere(table.to_numpy() > 0):
        colour = "white" if portion.iloc[row, column] > 0.5 else "black"
        text = f"{table.iloc[row, column]:.0f}"
        axes.text(column, row, text, ha="center", va="center", fontsize=7, color=colour)
    axes.set_xlabel("what was named for it")
    axes.set_ylabel("what the recording had")
    axes.set_title("laboratory recordings; numbers of effects")
    return figure


def publish(
    results: Iterable[Mapping[str, Any]], about: Mapping[str, Any], folder: Path, only: Sequence[str] = TABLES
) -> list[Path]:
    """Write the tables as CSV, and the summary as Markdown with its picture.

    Raises:
        InputError: a file cannot be written.
    """
    kept = list(results)
    frame = table(kept)
    frames = {"laboratory": frame, "summary": summary(frame), "effects": by_effect(kept)}
    written = []
    for name in only:
        path = folder / f"{name}.csv"
        write_text(path, render(frames[name], about, "csv"))
        written.append(path)
    if "summary" in only:
        path = folder / "summary.md"
        parts = [
            "# Laboratory recordings", "", *markdown_list(lines(about)), "",
            "Shares in per cent with 95 % intervals (Wilson). Right: every effect named, alone or in its group, and "
            "nothing invented; no answer is wrong. Alike counted: an effect that does the same in these readings "
            "counts as the effect. Residuals are in units of the noise that was added.", "",
            markdown_table(frames["summary"]), "", "Nothing missing:", "", markdown_table(nothing_missing(frame)), "",
            "Named, by effect and its size z:", "", markdown_table(frames["effects"]), "",
            "![what was named](confusion.png)", "",
        ]  # fmt: skip
        write_text(path, "\n".join(parts))
        written += [path, *_save(kept, about, folder)]
    return written


def draw_all(
    results: Iterable[Mapping[str, Any]], about: Mapping[str, Any], folder: Path, only: Sequence[str] = FIGURES
) -> list[Path]:
    """Draw what was named for what was there.

    Raises:
        InputError: a file cannot be written.
    """
    return _save(list(results), about, folder) if only else []


def _save(results: Sequence[Mapping[str, Any]], about: Mapping[str, Any], folder: Path) -> list[Path]:
    if not any(result["status"] == "ok" for result in results):
        return []
    return [save(confusion(results), folder / "confusion.png", about)]


def show(results: Iterable[Mapping[str, Any]], value: str = "") -> None:  # noqa: ARG001
    """Print how good the diagnosis is."""
    from latticebench.bench.report.screen import console, show_rows

    frame = table(results)
    for short in (summary(frame), nothing_missing(frame)):
        show_rows(list(short.columns), readable(short).astype(str).to_numpy().tolist())
    for _, row in frame[frame["status"].isin(LOST)].iterrows():
        line = f"{row['status']}: {row['instrument']} seed {row['seed']}: {row['message']}"
        console().print(line, style="red", highlight=False, markup=False)
