"""Figures of results, drawn with matplotlib; each PNG carries its provenance in its metadata."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from bench.provenance import lines
from bench.suite import Case
from bench.tables import cases, summary
from systems.files import whole
from systems.terms import Term

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("tab:blue", "tab:red", "tab:green", "goldenrod", "tab:purple", "tab:cyan", "tab:brown", "tab:pink")
MARKERS = "os^Dv<>Ph*Xp"
# Errors of round-off size share the lowest place of an axis.
LOWEST = 1e-12
# A library as large as the paper's largest fits beside an axis.
MOST_NAMES = 14


def draw_all(results: Sequence[Mapping[str, Any]], about: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw every figure that the results allow, and give the files.

    Raises:
        InputError: a file cannot be written.
    """
    written = []
    for result in results:
        if result["history"] is not None and result["coefficients"] is not None:
            title = Case.model_validate(result["case"]).title
            written.append(_save(learning_curve(result), folder / f"coefficients-{slug(title)}.png", about))
    table = cases(results)
    if table["e2"].notna().any():
        written.append(_save(errors(table), folder / "errors.png", about))
        written.append(_save(error_against_seconds(table), folder / "error-against-seconds.png", about))
        if table["noise"].nunique() > 1:
            written.append(_save(error_against_noise(table), folder / "error-against-noise.png", about))
    return written


def slug(text: str) -> str:
    """Turn a title into a file name."""
    return re.sub(r"[^a-z0-9.=]+", "-", text.lower()).strip("-")


def learning_curve(result: Mapping[str, Any]) -> Figure:
    """Draw coefficients against iteration, as the paper's figures: solid found, dashed true, absent terms black."""
    case = Case.model_validate(result["case"])
    history, truth = result["history"], result["truth"]
    terms = list(result["coefficients"])
    curves = np.array(history["coefficients"])
    figure, axes = _axes(7.0, 4.2)
    colours = iter(COLOURS)
    for k, term in enumerate(terms):
        absent = truth is not None and truth[term] == 0
        colour = "black" if absent else next(colours, "tab:gray")
        axes.plot(history["step"], curves[:, k], color=colour, lw=0.9 if absent else 1.6, label=f"${Term(term).latex}$")
        if truth is not None and not absent:
            axes.axhline(truth[term], color=colour, ls="--", lw=1)
    axes.set_xlabel("iteration")
    axes.set_ylabel("coefficient")
    if truth is not None:
        values = [*truth.values(), 0.0]
        margin = 0.6 * (max(values) - min(values) or 1)
        axes.set_ylim(min(values) - margin, max(values) + margin)
    error = "" if result["e2"] is None else f"   E2 = {float(result['e2']):.1e}"
    axes.set_title(f"{case.data}, {case.library}, {case.label}{error}", fontsize=9)
    if len(terms) <= MOST_NAMES:
        axes.legend(fontsize=7, ncol=1, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    return figure


def errors(table: pd.DataFrame) -> Figure:
    """Draw the median E2 by system and method: one row for data and library, one mark a method."""
    short = summary(table)
    short = short[short["e2"].notna()]
    rows = list(dict.fromkeys(zip(short["data"], short["library"], strict=True)))
    methods = list(dict.fromkeys(short["method"]))
    figure, axes = _axes(7.5, 1.2 + 0.28 * len(rows))
    for k, method in enumerate(methods):
        chosen = short[short["method"] == method]
        places = [rows.index(pair) for pair in zip(chosen["data"], chosen["library"], strict=True)]
        axes.plot(
            _bounded(chosen["e2"]),
            places,
            MARKERS[k % len(MARKERS)],
            color=f"C{k % 10}",
            label=method,
            ms=6,
            alpha=0.85,
        )
    axes.set_xscale("log")
    axes.set_yticks(range(len(rows)), [f"{data}   {library}" for data, library in rows], fontsize=8)
    axes.invert_yaxis()
    axes.grid(axis="both", alpha=0.25)
    axes.set_xlabel(f"relative error of the coefficients, E2 (median over seeds; below {LOWEST:.0e}: round-off)")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    return figure


def error_against_seconds(table: pd.DataFrame) -> Figure:
    """Draw E2 against the wall time of the fit, one mark a case, one colour a method."""
    good = table[(table["status"] == "ok") & table["e2"].notna()]
    figure, axes = _axes(6.5, 4.2)
    for k, method in enumerate(dict.fromkeys(good["method"])):
        chosen = good[good["method"] == method]
        axes.plot(
            np.maximum(chosen["seconds"], 1e-4), _bounded(chosen["e2"]), MARKERS[k % len(MARKERS)], color=f"C{k % 10}",
            label=method, ms=6, alpha=0.75,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("seconds of the fit (one core)")
    axes.set_ylabel("relative error of the coefficients, E2")
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    return figure


def error_against_noise(table: pd.DataFrame) -> Figure:
    """Draw the median E2 against the noise level, one line a method, one panel for system and library."""
    import matplotlib.pyplot as plt

    known = table[table["e2"].notna() | ~table["status"].isin(["ok", "skipped"])].copy()
    known["system"] = known["data"].str.replace(r" noise=\S+", "", regex=True)
    known.loc[known["e2"].isna(), "e2"] = np.inf
    levels = known.groupby(["system", "library"])["noise"].nunique()
    panels = [pair for pair in dict.fromkeys(zip(known["system"], known["library"], strict=True)) if levels[pair] > 1]
    across = min(len(panels), 3)
    down = -(-len(panels) // across)
    figure, grid = plt.subplots(down, across, figsize=(4.2 * across, 3.4 * down), squeeze=False, layout="constrained")
    methods = list(dict.fromkeys(known["method"]))
    smallest = known.loc[known["noise"] > 0, "noise"].min()
    for axes, (system, library) in zip(grid.flat, panels, strict=False):
        for k, method in enumerate(methods):
            chosen = known[(known["system"] == system) & (known["library"] == library) & (known["method"] == method)]
            median = chosen.groupby("noise")["e2"].median()
            axes.plot(
                median.index, _bounded(median), f"-{MARKERS[k % len(MARKERS)]}", color=f"C{k % 10}", label=method, ms=4
            )
        axes.set_xscale("symlog", linthresh=smallest)
        axes.set_yscale("log")
        axes.set_title(f"{system}, {library}", fontsize=8)
        axes.grid(alpha=0.25)
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    figure.supxlabel("noise level", fontsize=9)
    figure.supylabel("E2 (median over seeds)", fontsize=9)
    handles, names = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, names, fontsize=8, loc="outside right center", frameon=False)
    return figure


def _bounded(values: pd.Series) -> np.ndarray:
    """Bring errors onto a logarithmic axis: round-off to its lower end, infinity out of it."""
    return np.where(np.isinf(values), np.nan, np.maximum(values, LOWEST))


def _axes(width: float, height: float) -> tuple[Figure, Axes]:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=(width, height), layout="constrained")


def _save(figure: Figure, path: Path, about: Mapping[str, Any]) -> Path:
    import matplotlib.pyplot as plt

    with whole(path) as temporary:
        figure.savefig(
            temporary, dpi=140, metadata={"Description": "\n".join(lines(about)), "Software": "latticebench"}
        )
    plt.close(figure)
    return path
