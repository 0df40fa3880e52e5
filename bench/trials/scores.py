"""Tables and pictures of a suite of diagnoses."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from latticebench.bench.provenance import lines
from latticebench.bench.publish import format_number
from latticebench.bench.trials.faults import BLIND, FIFTH_BLIND, FOURTH_BLIND, NONE, OTHERS, SECOND_BLIND, THIRD_BLIND
from latticebench.bench.trials.trial import is_right
from latticebench.systems.errors import InputError
from latticebench.systems.files import whole, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = (
    "system", "effect", "z", "noise", "velocities", "seed", "status", "size", "apart", "verdict", "named", "alike", "right", "extra",
    "residual_before", "residual_after", "forecast_before", "forecast_after", "forecast_true", "coefficients_before", "coefficients_after",
    "seconds", "cpu_seconds", "message",
)  # fmt: skip
# From here on what no single effect of the catalogue can do is visible beside the best one (in units of its standard error).
APART = 5.0
TRUE_TIMES = 1.5


def is_run(folder: Path) -> bool:
    """Say whether a folder holds results of diagnoses."""
    return folder.is_dir() and any(_rows(folder))


def read(folder: Path) -> list[dict[str, Any]]:
    """Read the results of a run.

    Raises:
        InputError: there are none.
    """
    found = list(_rows(folder))
    if not found:
        raise InputError(f"{folder}: there are no diagnoses in it; run a suite of them with --results {folder}")
    return found


def _rows(folder: Path) -> list[dict[str, Any]]:
    rows = []
    for path in sorted(folder.glob("*.json")):
        row = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(row, dict) and ("effect" in row or "terms" in row):
            rows.append(row)
    return rows


def about(rows: Sequence[Mapping[str, Any]], folder: Path) -> dict[str, Any]:
    """Describe where results come from: command, commit, machine, versions and seeds."""
    path = folder / "about.txt"
    described: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    for name in ("commit", "date", "machine"):
        described[name] = sorted({str(row["made"][name]) for row in rows})
    described["versions"] = rows[0]["made"]["versions"]
    seeds = sorted({int(row["seed"]) for row in rows if "seed" in row})
    return {**described, "seeds": seeds or [1]}


def kind(effect: str, apart: float) -> str:
    """Sort trials into kinds; one from outside the catalogue that an effect of it comes near could be told from it by nobody."""
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


def table(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Give a row a trial."""
    # Derived here, so that a run is judged by the rule as it stands now.
    frame = pd.DataFrame([{**row, "right": _judged(row)} if row["status"] == "ok" else row for row in rows])
    for name in COLUMNS:
        if name not in frame:
            frame[name] = None
    frame = frame.assign(
        named=[" + ".join(names) if isinstance(names, list) else "" for names in frame["named"]],
        alike=["; ".join(", ".join(group) for group in groups) if isinstance(groups, list) else "" for groups in frame["alike"]],
    )  # fmt: skip
    return (
        frame[list(COLUMNS)]
        .sort_values(["system", "effect", "z", "noise", "velocities", "seed"])
        .reset_index(drop=True)
    )


def _judged(row: Mapping[str, Any]) -> bool:
    effect = row["effect"]
    wanted = [] if effect == NONE or effect in OTHERS else effect.split("+")
    return is_right(wanted, row["named"], row["alike"], row["verdict"], effect)


def summary(frame: pd.DataFrame) -> pd.DataFrame:
    """Give, for each kind of trial, how often the diagnosis was right, and the errors before and after (medians)."""
    ran = frame[frame["status"] == "ok"].assign(
        kind=lambda f: [kind(effect, apart) for effect, apart in zip(f["effect"], f["apart"], strict=True)]
    )
    found = []
    for names, group in ran.groupby(["kind", "z", "noise", "velocities"], sort=True):
        found.append(_line(dict(zip(("kind", "z", "noise", "velocities"), names, strict=True)), group))
    for name, group in ran.groupby("kind"):
        found.append(_line({"kind": name, "z": "all", "noise": "all", "velocities": "all"}, group))
    return pd.DataFrame(found)


def _line(head: dict[str, Any], group: pd.DataFrame) -> dict[str, Any]:
    values = {name: group[name].astype(float).median() for name in (
        "residual_before", "residual_after", "forecast_before", "forecast_after", "coefficients_before", "coefficients_after",
        "cpu_seconds",
    )}  # fmt: skip
    return {
        **head, "trials": len(group), "right": float(group["right"].astype(float).mean()),
        "effects too many": float((group["extra"].astype(float) > 0).mean()), **values, **_ahead(group),
    }  # fmt: skip


def _ahead(group: pd.DataFrame) -> dict[str, float]:
    """Compare forecasts with those of the true model fitted to the same data: the median ratio, and the share of at most TRUE_TIMES."""
    ratio = (group["forecast_after"].astype(float) / group["forecast_true"].astype(float)).dropna()
    return {
        "forecast over that of the true model": float(ratio.median()) if len(ratio) else float("nan"),
        f"at most {TRUE_TIMES:g} times that": float((ratio <= TRUE_TIMES).mean()) if len(ratio) else float("nan"),
    }


def by_effect(frame: pd.DataFrame) -> pd.DataFrame:
    """Give, for each effect, how often it was named right at each size."""
    ran = frame[(frame["status"] == "ok") & (frame["effect"] != NONE)]
    found = ran.assign(right=ran["right"].astype(float)).pivot_table(
        index="effect", columns="z", values="right", aggfunc=["mean", "count"]
    )
    sizes = found.columns.get_level_values(1)
    titles = ["right" if what == "mean" else "trials" for what in found.columns.get_level_values(0)]
    found.columns = pd.Index([f"{title} at z = {z:g}" for title, z in zip(titles, sizes, strict=True)])
    return found.reset_index()


def confusion(frame: pd.DataFrame, least: float = 10.0) -> Figure:
    """Draw which effect was named first for each effect that was there; all that were named where only pairs were there."""
    from matplotlib.figure import Figure

    ran = frame[(frame["status"] == "ok") & ((frame["z"] >= least) | (frame["effect"] == NONE))]
    pairs = ran["effect"].str.contains("+", regex=False)
    ran = ran if pairs.all() else ran[~pairs]
    first = [
        (text if pairs.all() else text.split(" + ")[0]) or verdict
        for text, verdict in zip(ran["named"], ran["verdict"], strict=True)
    ]
    counts = pd.crosstab(ran["effect"], pd.Series(first, index=ran.index))
    order = [name for name in counts.index if name in counts.columns]
    rest = [name for name in counts.columns if name not in order]
    counts = counts.reindex(
        index=[*order, *(name for name in counts.index if name not in order)], columns=[*order, *rest]
    )
    share = counts.div(counts.sum(axis=1), axis=0).fillna(0.0)
    # As high as the rows and the names below them need.
    names = max(len(name) for name in counts.columns) if len(counts.columns) else 0
    figure = Figure(figsize=(11, 1.5 + 0.2 * len(counts) + 0.085 * names), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(share.to_numpy(), cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(np.arange(share.shape[1]), share.columns, rotation=90)
    axes.set_yticks(np.arange(share.shape[0]), share.index)
    for row, column in np.argwhere(counts.fillna(0).to_numpy() > 0):
        value = counts.iloc[row, column]
        axes.text(
            column,
            row,
            f"{value:.0f}",
            ha="center",
            va="center",
            fontsize=7,
            color="white" if share.iloc[row, column] > 0.5 else "black",
        )
    axes.set_xlabel("named first, or the verdict where nothing was named")
    axes.set_ylabel("what the recording had")
    axes.set_title(f"z of at least {least:g}; numbers of trials")
    return figure


def publish(rows: Sequence[Mapping[str, Any]], about: Mapping[str, Any], out: Path) -> list[Path]:
    """Write the tables as CSV and Markdown, and the picture."""
    out.mkdir(parents=True, exist_ok=True)
    made = [row for row in rows if "effect" in row]
    measured = sorted((row for row in rows if "terms" in row), key=lambda row: str(row["name"]))
    head = [f"- {line}" for line in lines(about)]
    written = []
    if made:
        frame = table(made)
        frames = {"trials": frame, "summary": summary(frame), "effects": by_effect(frame)}
        for name, one in frames.items():
            path = out / f"{name}.csv"
            write_text(path, "".join(f"# {line}\n" for line in lines(about)) + one.to_csv(index=False))
            written.append(path)
        path = out / "summary.md"
        parts = ["# Diagnoses", "", *head, "", "How often the diagnosis was right; errors are medians.", "", _markdown(frames["summary"]), "",
                 "By effect:", "", _markdown(frames["effects"]), "", "![what was named](confusion.png)", ""]  # fmt: skip
        write_text(path, "\n".join(parts))
        written.append(path)
        with whole(out / "confusion.png") as temporary:
            confusion(frame).savefig(temporary, format="png", dpi=110)
        written.append(out / "confusion.png")
    if measured:
        path = out / "measured.md"
        write_text(
            path,
            "\n".join(
                ["# Measured recordings", "", *head, "", *(line for row in measured for line in _recording(row))]
            ),
        )
        written.append(path)
        for row in measured:
            if row["status"] == "ok":
                path = out / f"{row['name']}.json"
                write_text(path, json.dumps(row["report"], indent=1) + "\n")
                written.append(path)
    return written


def _recording(row: Mapping[str, Any]) -> list[str]:
    """Write what was found in one recording."""
    rows = f", rows {row['rows'][0]} to {row['rows'][1]}" if row["rows"] else ""
    text = [
        f"## {row['name']}",
        "",
        f"`{row['file']}`{rows}. Declared: {row['about']} (`{row['terms']}`, order {row['order']}, ends {row['ends']}).",
        "",
    ]
    if row["status"] != "ok":
        return [*text, f"{row['status']}: {row['message']}", ""]
    report = row["report"]
    text += [f"Verdict: **{report['verdict']}**, {row['seconds']:.0f} s.", ""]
    for effect in report["effects"]:
        values = ", ".join(
            f"{name} {format_number(value)}"
            for name, value in [*effect["parameters"].items(), *effect["coefficients"].items()]
            if value is not None
        )
        alike = f"; cannot be told from {', '.join(effect['indistinguishable'])}" if effect["indistinguishable"] else ""
        text.append(f"- {effect['effect']}: {values}{alike}")
    error = report["error"]
    text += ["", "| | before | after |", "|---|---|---|"]
    for name in ("residual", "forecast"):
        text.append(f"| {name} | {format_number(error[name]['before'])} | {format_number(error[name]['after'])} |")
    text += ["", "What was tried in each round, the best first (evidence in natural logarithms):", ""]
    for number, one in enumerate(report["rounds"], start=1):
        listed = ", ".join(f"{entry['effect']} {entry['evidence']:.0f}" for entry in one["ranking"][:6])
        text.append(f"{number}. {listed}")
    return [*text, ""]


def _markdown(frame: pd.DataFrame) -> str:
    readable = frame.copy()
    for name in readable.columns:
        readable[name] = [format_number(value) if isinstance(value, float) else value for value in readable[name]]
    return str(readable.astype(str).to_markdown(index=False, disable_numparse=True))
