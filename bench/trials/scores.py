"""Tables and the picture of trials: how often the diagnosis was right, and what it named instead."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from latticebench.bench.figures import save
from latticebench.bench.provenance import lines
from latticebench.bench.publish import markdown_list, markdown_table, readable, render
from latticebench.bench.trials.faults import BLIND, FIFTH_BLIND, FOURTH_BLIND, NONE, OTHERS, SECOND_BLIND, THIRD_BLIND
from latticebench.bench.trials.trial import is_right
from latticebench.systems.files import write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TABLES = ("trials", "summary", "effects")
FIGURES = ("confusion",)
# By which a trial is known in a published table.
SETTINGS = ("system", "effect", "z", "noise", "velocities", "seed")
COLUMNS = (
    *SETTINGS, "status", "size", "apart", "verdict", "partly", "named", "alike", "right", "extra",
    "residual_before", "residual_after", "forecast_before", "forecast_after",
    "coefficients_before", "coefficients_after", "seconds", "cpu_seconds", "message",
)  # fmt: skip
# What no single effect of the catalogue can do is visible from this size on, in units of its standard error.
APART = 5.0


def group_of(effect: str, apart: float) -> str:
    """Return which trials a trial is counted with.

    One from outside the catalogue that an effect of it comes near could be told from that effect by nobody.
    """
    if effect == NONE:
        return "nothing missing"
    if effect in OTHERS:
        sets = {
            "blind set, ": BLIND, "second blind set, ": SECOND_BLIND, "third blind set, ": THIRD_BLIND,
            "fourth blind set, ": FOURTH_BLIND, "fifth blind set, ": FIFTH_BLIND,
        }  # fmt: skip
        outside = "outside the catalogue, " + next((text for text, names in sets.items() if effect in names), "")
        return outside + (f"{APART:g} or more from it" if apart >= APART else f"less than {APART:g} from it")
    return "two at once" if "+" in effect else "one effect"


def table(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of trials: one row each, its settings first."""
    rows = []
    for result in results:
        row = {**result["case"], **result, "message": result["reason"] or None}
        if row["status"] == "ok":
            # Judged here, so that a run is judged by the rule as it stands.
            row["right"] = is_right(row["effect"], row["named"], row["alike"], row["verdict"])
        row["named"] = " + ".join(row["named"] or ())
        row["partly"] = "; ".join(row["partly"] or ())
        row["alike"] = "; ".join(", ".join(group) for group in row["alike"] or ())
        rows.append({name: row[name] for name in COLUMNS})
    frame = pd.DataFrame(rows, columns=list(COLUMNS))
    return frame.sort_values(list(SETTINGS)).reset_index(drop=True)


def summary(frame: pd.DataFrame) -> pd.DataFrame:
    """Return, per group of trials, how often the diagnosis was right, and the medians of errors before and after."""
    ran = frame[frame["status"] == "ok"].assign(
        kind=lambda f: [group_of(effect, apart) for effect, apart in zip(f["effect"], f["apart"], strict=True)]
    )
    found = []
    for names, group in ran.groupby(["kind", "z", "noise", "velocities"], sort=True):
        found.append(_line(dict(zip(("kind", "z", "noise", "velocities"), names, strict=True)), group))
    for name, group in ran.groupby("kind"):
        found.append(_line({"kind": name, "z": "all", "noise": "all", "velocities": "all"}, group))
    return pd.DataFrame(found)


def _line(head: dict[str, Any], group: pd.DataFrame) -> dict[str, Any]:
    values = {name: group[name].astype(float).median() for name in (
        "residual_before", "residual_after", "forecast_before", "forecast_after", "coefficients_before",
        "coefficients_after", "cpu_seconds",
    )}  # fmt: skip
    return {
        **head, "trials": len(group), "right": float(group["right"].astype(float).mean()),
        "effects too many": float((group["extra"].astype(float) > 0).mean()), **values,
    }  # fmt: skip


def by_effect(frame: pd.DataFrame) -> pd.DataFrame:
    """Return, per effect and size, how often it was named right."""
    ran = frame[(frame["status"] == "ok") & (frame["effect"] != NONE)]
    found = ran.assign(right=ran["right"].astype(float)).pivot_table(
        index="effect", columns="z", values="right", aggfunc=["mean", "count"]
    )
    sizes = found.columns.get_level_values(1)
    titles = ["right" if what == "mean" else "trials" for what in found.columns.get_level_values(0)]
    found.columns = pd.Index([f"{title} at z = {z:g}" for title, z in zip(titles, sizes, strict=True)])
    return found.reset_index()


def confusion(frame: pd.DataFrame, least: float = 10.0) -> Figure:
    """Draw which effect was named first per effect that was there; all that were named where only pairs were there."""
    from matplotlib.figure import Figure

    counts = _counts(frame, least)
    share = counts.div(counts.sum(axis=1), axis=0).fillna(0.0)
    # As high as the rows and the names below them need.
    names = max(len(name) for name in counts.columns) if len(counts.columns) else 0
    figure = Figure(figsize=(11, 1.5 + 0.2 * len(counts) + 0.085 * names), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(share.to_numpy(), cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(np.arange(share.shape[1]), share.columns, rotation=90)
    axes.set_yticks(np.arange(share.shape[0]), share.index)
    for row, column in np.argwhere(counts.fillna(0).to_numpy() > 0):
        colour = "white" if share.iloc[row, column] > 0.5 else "black"
        text = f"{counts.iloc[row, column]:.0f}"
        axes.text(column, row, text, ha="center", va="center", fontsize=7, color=colour)
    axes.set_xlabel("named first, or the verdict where nothing was named")
    axes.set_ylabel("what the recording had")
    axes.set_title(f"z of at least {least:g}; numbers of trials")
    return figure


def _counts(frame: pd.DataFrame, least: float) -> pd.DataFrame:
    """Count what was named first (columns) per effect (rows), in the same order as far as the names are the same."""
    ran = frame[(frame["status"] == "ok") & ((frame["z"] >= least) | (frame["effect"] == NONE))]
    pairs = ran["effect"].str.contains("+", regex=False)
    ran = ran if pairs.all() else ran[~pairs]
    first = [
        (text if pairs.all() else text.split(" + ")[0]) or verdict
        for text, verdict in zip(ran["named"], ran["verdict"], strict=True)
    ]
    counts = pd.crosstab(ran["effect"], pd.Series(first, index=ran.index))
    order = [name for name in counts.index if name in counts.columns]
    return counts.reindex(
        index=[*order, *(name for name in counts.index if name not in order)],
        columns=[*order, *(name for name in counts.columns if name not in order)],
    )


def publish(
    results: Iterable[Mapping[str, Any]], about: Mapping[str, Any], folder: Path, only: Sequence[str] = TABLES
) -> list[Path]:
    """Write the tables as CSV, and the summary as Markdown with its picture.

    Raises:
        InputError: a file cannot be written.
    """
    frame = table(results)
    frames = {"trials": frame, "summary": summary(frame), "effects": by_effect(frame)}
    written = []
    for name in only:
        path = folder / f"{name}.csv"
        write_text(path, render(frames[name], about, "csv"))
        written.append(path)
    if "summary" in only:
        path = folder / "summary.md"
        parts = [
            "# Diagnoses", "", *markdown_list(lines(about)), "",
            "How often the diagnosis was right; errors are medians.", "", markdown_table(frames["summary"]), "",
            "By effect:", "", markdown_table(frames["effects"]), "", "![what was named](confusion.png)", "",
        ]  # fmt: skip
        write_text(path, "\n".join(parts))
        written += [path, *_save(frame, about, folder)]
    return written


def draw_all(
    results: Iterable[Mapping[str, Any]], about: Mapping[str, Any], folder: Path, only: Sequence[str] = FIGURES
) -> list[Path]:
    """Draw what was named for what was there.

    Raises:
        InputError: a file cannot be written.
    """
    return _save(table(results), about, folder) if only else []


def _save(frame: pd.DataFrame, about: Mapping[str, Any], folder: Path) -> list[Path]:
    if not (frame["status"] == "ok").any():
        return []
    return [save(confusion(frame), folder / "confusion.png", about)]


def show(results: Iterable[Mapping[str, Any]], value: str = "") -> None:  # noqa: ARG001
    """Print how often the diagnosis was right."""
    from latticebench.bench.report.screen import console, show_rows

    frame = table(results)
    short = summary(frame)
    show_rows(list(short.columns), readable(short).astype(str).to_numpy().tolist())
    for _, row in frame[~frame["status"].isin(["ok", "skipped"])].iterrows():
        line = f"{row['status']}: {row['system']} {row['effect']} z={row['z']:g} seed {row['seed']}: {row['message']}"
        console().print(line, style="red", highlight=False, markup=False)
