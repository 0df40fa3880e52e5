"""Figures of results, drawn with matplotlib; each PNG carries its provenance in its metadata."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from latticebench.bench.colours import FAINT, SERIES, series
from latticebench.bench.escape import label
from latticebench.bench.fitting import FitCase
from latticebench.bench.provenance import lines
from latticebench.bench.tables import cases, named, summary
from latticebench.systems.errors import unknown
from latticebench.systems.files import shown, whole
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from latticebench.bench.beside import Published

FIGURES = ("coefficients", "errors", "error-against-seconds", "error-against-noise", "cost")
# Endings of figures, and what the provenance and the program are called in such a file.
IMAGES = {".png": ("Description", "Software"), ".svg": ("Description", "Creator"), ".pdf": ("Subject", "Creator")}
_ENDING: ContextVar[str] = ContextVar("ending", default="")
MARKERS = "os^Dv<>Ph*Xp"
BOUND = "Cramer-Rao bound, all terms kept"
# Errors of round-off size share the lowest place of an axis.
LOWEST = 1e-12
# An equation that is ten times off is as wrong as any.
HIGHEST = 10.0
# A library as large as the paper's largest fits beside an axis.
MOST_NAMES = 14
# Characters of a title in the name of a file, which may have 255.
MOST_OF_A_NAME = 200


def draw_all(
    results: Iterable[Mapping[str, Any]],
    about: Mapping[str, Any],
    folder: Path,
    only: Sequence[str] = FIGURES,
    beside: Published | None = None,
) -> list[Path]:
    """Draw every figure that the results allow, or those of some kinds, and return the files.

    Figures of errors have what was published of the same cases, too, see `bench.beside`.

    Raises:
        InputError: a file cannot be written.
    """
    written = []
    results = [_labelled(one) for one in results]
    if "coefficients" in only:
        for name, group in panels(results).items():
            written.append(save(panel(group), folder / f"coefficients-{name}.png", about))
    table = cases(results)
    if beside is not None:
        names = ("part", "data", "library", "method")
        shown = beside.cases.assign(**{name: beside.cases[name].map(label) for name in names})
        table = replace(beside, cases=shown).joined(table)
        about = {**about, "published": beside.about}
    if ((table["status"] == "ok") & table["e2"].notna()).any():
        drawn: dict[str, Callable[[pd.DataFrame], Figure]] = {
            "errors": errors, "error-against-seconds": error_against_seconds
        }  # fmt: skip
        if not _by_noise(table[table["e2"].notna()]).empty:
            drawn |= {"error-against-noise": error_against_noise, "cost": cost}
        for name, draw in drawn.items():
            if name in only:
                written.append(save(draw(table), folder / f"{name}.png", about))
    return written


def _labelled(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result whose names are as they must be written for matplotlib to show them as they are."""
    names = ("part", "system", "library", "label", "initial")
    return {**result, "case": {**result["case"], **{n: label(result["case"][n]) for n in names if result["case"][n]}}}


def panels(results: Iterable[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """Group results by what was fitted: those of one group share their samples and library.

    Only groups in which a method kept its history are returned, each under a name for its file.
    """
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for result in results:
        case = FitCase.of(result["case"])
        if result["coefficients"] is not None:
            groups.setdefault(slug(f"{case.part} {case.data} {case.library} seed {case.seed}"), []).append(result)
    return {name: group for name, group in groups.items() if any(result["history"] for result in group)}


def slug(text: str) -> str:
    """Turn a title into a file name."""
    return re.sub(r"[^a-z0-9.=]+", "-", text.lower()).strip("-")[:MOST_OF_A_NAME]


def panel(group: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw coefficients against iteration, as the paper's figures, and beside them what each method ends with.

    Solid lines are found, dashed ones true; absent terms are black; a term has one colour throughout.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.lines import Line2D

    learnt = [result for result in group if result["history"]]
    case = FitCase.of(group[0]["case"])
    terms, truth = list(group[0]["coefficients"]), group[0]["truth"]
    colours = _colours(terms, truth)
    widths = [4.0] * len(learnt) + [0.8 + 0.55 * len(group)]
    figure, all_axes = plt.subplots(
        1, len(widths), figsize=(sum(widths) + 1.6, 4.3), sharey=True, squeeze=False, layout="constrained",
        gridspec_kw={"width_ratios": widths},
    )  # fmt: skip
    for axes, result in zip(all_axes[0], learnt, strict=False):
        history, name = result["history"], named(result["case"])
        curves = np.array(history["coefficients"])
        for k, term in enumerate(terms):
            axes.plot(history["step"], curves[:, k], color=colours[term], lw=0.9 if colours[term] == "black" else 1.6)
        axes.set_xlabel("iteration")
        axes.set_title(_with_error(name, result), fontsize=8)
    last = all_axes[0][-1]
    for place, result in enumerate(group):
        for k, (term, value) in enumerate(result["coefficients"].items()):
            # Side by side, since terms with the same coefficient would hide each other.
            beside = place + 0.6 * ((k + 0.5) / len(terms) - 0.5)
            last.plot(beside, value, "o", color=colours[term], ms=3 if colours[term] == "black" else 4)
    names = [_with_error(named(result["case"]), result) for result in group]
    last.set_xticks(range(len(group)), names, rotation=60, ha="right", rotation_mode="anchor", fontsize=7)
    last.set_xlim(-0.6, len(group) - 0.4)
    for axes in all_axes[0]:
        for term in terms:
            if truth is not None and truth[term] != 0:
                axes.axhline(truth[term], color=colours[term], ls="--", lw=0.9)
        axes.grid(axis="y", alpha=0.2)
    all_axes[0][0].set_ylabel("coefficient")
    values = [0.0, *(truth.values() if truth is not None else group[0]["coefficients"].values())]
    margin = 0.4 * (max(values) - min(values) or 1)
    all_axes[0][0].set_ylim(min(values) - margin, max(values) + margin)
    marks = [Line2D([], [], color=colours[term], label=f"${Term(term).latex}$") for term in terms[:MOST_NAMES]]
    figure.legend(handles=marks, fontsize=7, loc="outside right center", frameon=False)
    figure.suptitle(" ".join(part for part in (case.part, case.data + ",", case.library) if part), fontsize=9)
    return figure


def _colours(terms: Sequence[str], truth: Mapping[str, float] | None) -> dict[str, str]:
    """Return a colour per term: one of its own where the term is in the equation, else black."""
    colours = iter(SERIES)
    return {term: "black" if truth is not None and truth[term] == 0 else next(colours, "tab:gray") for term in terms}


def _with_error(name: str, result: Mapping[str, Any]) -> str:
    return name if result["e2"] is None else f"{name}  E2 {float(result['e2']):.0e}"


def errors(table: pd.DataFrame) -> Figure:
    """Draw the median E2 by system and method: one row per data and library, one mark per method.

    The marks of a row lie a little above each other, since methods of equal errors would hide one another.
    """
    short = summary(table)
    short = short[short["e2"].notna()]
    rows = list(dict.fromkeys(zip(short["data"], short["library"], strict=True)))
    methods = list(dict.fromkeys(short["method"]))
    figure, axes = _axes(7.5, 1.2 + max(0.28, 0.04 * len(methods)) * len(rows))
    for k, method in enumerate(methods):
        chosen = short[short["method"] == method]
        beside = 0.7 * ((k + 0.5) / len(methods) - 0.5)
        places = [rows.index(pair) + beside for pair in zip(chosen["data"], chosen["library"], strict=True)]
        axes.plot(
            _bounded(chosen["e2"]),
            places,
            MARKERS[k % len(MARKERS)],
            color=series(k),
            label=method,
            ms=4.5,
        )
    for place in range(1, len(rows)):
        axes.axhline(place - 0.5, color=FAINT, lw=0.6, zorder=0)
    axes.set_xscale("log")
    axes.set_yticks(range(len(rows)), [f"{data}   {library}" for data, library in rows], fontsize=8)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.grid(axis="x", alpha=0.25)
    told = f"relative error of the coefficients, E2 (median over seeds; below {LOWEST:.0e}: round-off)"
    axes.set_xlabel(f"{told}{_published(table)}")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    return figure


def _published(table: pd.DataFrame) -> str:
    """Return what the asterisk of published methods means; empty where there is none, see `bench.beside`."""
    commits = [one for one in table["published"].unique() if one] if "published" in table else []
    return f"\n* published, commit {', '.join(commits)}" if commits else ""


def error_against_seconds(table: pd.DataFrame) -> Figure:
    """Draw E2 against the processor time of the fit (one thread), one mark per case, one colour per method."""
    good = table[(table["status"] == "ok") & table["e2"].notna()]
    figure, axes = _axes(6.5, 4.2)
    for k, method in enumerate(dict.fromkeys(good["method"])):
        chosen = good[good["method"] == method]
        axes.plot(
            np.maximum(chosen["cpu_seconds"], 1e-4), _bounded(chosen["e2"]), MARKERS[k % len(MARKERS)],
            color=series(k),
            label=method, ms=6, alpha=0.75,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(f"processor seconds of the fit{_published(table)}")
    axes.set_ylabel("relative error of the coefficients, E2")
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    return figure


def cost(table: pd.DataFrame) -> Figure:
    """Draw E2 against the processor seconds of the fit, one panel per noise level (down), system and library (across).

    Only systems and libraries that were run at several noise levels are drawn; one mark per case.
    """
    import matplotlib.pyplot as plt

    good = _by_noise(table[(table["status"] == "ok") & table["e2"].notna()])
    across = list(dict.fromkeys(zip(good["system"], good["library"], strict=True)))
    down = sorted(good["noise"].unique())
    methods = list(dict.fromkeys(good["method"]))
    figure, grid = plt.subplots(
        len(down), len(across), figsize=(3.3 * len(across) + 1.8, 2.7 * len(down)), squeeze=False, layout="constrained",
        sharex=True, sharey=True,
    )  # fmt: skip
    for (row, noise), (column, (system, library)) in itertools.product(enumerate(down), enumerate(across)):
        axes = grid[row][column]
        for k, method in enumerate(methods):
            here = (good["system"] == system) & (good["library"] == library) & (good["noise"] == noise)
            chosen = good[here & (good["method"] == method)]
            axes.plot(
                np.maximum(chosen["cpu_seconds"], 1e-4), _bounded(chosen["e2"]), MARKERS[k % len(MARKERS)],
                color=series(k), ms=5, alpha=0.75, label=method,
            )  # fmt: skip
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.grid(alpha=0.25)
        axes.set_title(f"{system}, {library}, {100 * noise:g} % noise", fontsize=8)
    figure.supxlabel(f"processor seconds of the fit{_published(table)}", fontsize=9)
    figure.supylabel("relative error of the coefficients, E2", fontsize=9)
    figure.legend(*grid[0][0].get_legend_handles_labels(), fontsize=8, loc="outside right center", frameon=False)
    return figure


def _by_noise(table: pd.DataFrame) -> pd.DataFrame:
    """Take the systems and libraries that have several noise levels, with `system` as the data without its noise."""
    named = table.assign(system=table["data"].str.replace(r" noise=\S+", "", regex=True))
    levels = named.groupby(["system", "library"])["noise"].transform("nunique")
    return named[levels > 1]


def error_against_noise(table: pd.DataFrame) -> Figure:
    """Draw E2 against the noise level, one line per method, one panel per system and library.

    A line is the median over the seeds, the bar at it goes from their 10 % to their 90 % quantile, and the dashed line
    is the Cramer-Rao bound. With two noise levels or more, the noise-free cases are left to the tables: their errors
    are of another order.
    """
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullLocator

    known = _by_noise(table[table["e2"].notna() | ~table["status"].isin(["ok", "skipped"])]).copy()
    known.loc[known["e2"].isna(), "e2"] = np.inf
    noisy = known[known["noise"] > 0]
    alone = noisy["noise"].nunique() < 2
    if not alone:
        known = noisy
    panels = list(dict.fromkeys(zip(known["system"], known["library"], strict=True)))
    across = 4 if len(panels) % 4 == 0 else min(len(panels), 3)
    down = -(-len(panels) // across)
    figure, grid = plt.subplots(
        down, across, figsize=(3.4 * across + 1.6, 3.3 * down), squeeze=False, layout="constrained",
        sharex=True, sharey=True,
    )  # fmt: skip
    methods = list(dict.fromkeys(known["method"]))
    handles: dict[str, Line2D] = {}
    for axes, (system, library) in zip(grid.flat, panels, strict=False):
        here = known[(known["system"] == system) & (known["library"] == library)]
        # A little beside each other, since the best methods lie on one line.
        for name, line in _noise_curves(axes, here, methods, 0.014).items():
            handles.setdefault(name, line)
        if alone:
            axes.set_xscale("symlog", linthresh=noisy["noise"].min())
        else:
            axes.set_xscale("log")
            levels = sorted(known["noise"].unique())
            axes.set_xticks(levels, [f"{100 * level:g} %" for level in levels])
            axes.xaxis.set_minor_locator(NullLocator())
        axes.set_yscale("log")
        axes.set_title(f"{system}, {library}".replace(_shared([one for one, _ in panels]), ""), fontsize=9)
        axes.grid(alpha=0.25)
    grid[0][0].set_ylim(_lowest(known, alone), HIGHEST)
    for axes in list(grid.flat)[len(panels) :]:
        axes.set_visible(False)
    figure.supxlabel(f"noise level: sigma over the RMS of the field{_published(table)}", fontsize=9)
    figure.supylabel("E2 (median over seeds, 10 % to 90 % quantile)", fontsize=9)
    ordered = sorted(handles.items(), key=lambda item: item[0] == BOUND)
    figure.legend(handles=[line for _, line in ordered], fontsize=8, loc="outside right center", frameon=False)
    return figure


def _noise_curves(axes: Axes, here: pd.DataFrame, methods: Sequence[str], apart: float) -> dict[str, Line2D]:
    """Draw one panel of `error_against_noise`.

    Args:
        axes: of the panel.
        here: its cases.
        methods: of all panels, in the order of their colours.
        apart: how far neighbouring methods are moved apart, in decades of the noise.

    Returns:
        one line per method, and the bound where there are several levels of it.
    """
    drawn = {}
    for k, method in enumerate(methods):
        by_noise = here[here["method"] == method].groupby("noise")["e2"]
        low, middle, high = (by_noise.quantile(share, interpolation="nearest") for share in (0.1, 0.5, 0.9))
        if middle.empty:
            continue
        place = k - (len(methods) - 1) / 2
        at = np.array(middle.index) * 10 ** (apart * place)
        # Noise-free cases are where the axis is linear.
        at[at == 0] = here["noise"].max() * apart * math.log(10) * place
        colour = series(k)
        axes.vlines(at, _bounded(low), np.minimum(high, HIGHEST), color=colour, alpha=0.35, lw=2.2)
        style = f"-{MARKERS[k % len(MARKERS)]}"
        (drawn[method],) = axes.plot(at, _bounded(middle), style, color=colour, label=method, ms=3.5, lw=0.9)
    floor = here.groupby("noise")["bound"].max().dropna()
    if len(floor) > 1:
        (drawn[BOUND],) = axes.plot(floor.index, floor, "--", color="black", lw=1.5, zorder=5, label=BOUND)
    return drawn


def _lowest(known: pd.DataFrame, alone: bool) -> float:
    """Return the lower end of the axis of errors: below every median, and below the bound where it is drawn."""
    seen = known["e2"].replace(np.inf, np.nan)
    medians = seen.groupby([known["system"], known["library"], known["method"], known["noise"]]).median()
    least = min(medians.min(), HIGHEST)
    return float(max((least if alone else min(least, known["bound"].min())) / 2, LOWEST / 2))


def _shared(texts: Sequence[str]) -> str:
    """Return the words that all texts end with, which a title need not repeat."""
    words = [text.split() for text in texts]
    count = 0
    while all(len(one) > count + 1 and one[-1 - count] == words[0][-1 - count] for one in words):
        count += 1
    return " " + " ".join(words[0][len(words[0]) - count :]) if count else ""


def _bounded(values: pd.Series) -> np.ndarray:
    """Bring errors onto a logarithmic axis: round-off to its lower end, infinity out of it."""
    return np.where(np.isinf(values), np.nan, np.maximum(values, LOWEST))


def _axes(width: float, height: float) -> tuple[Figure, Axes]:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=(width, height), layout="constrained")


@contextmanager
def drawn_as(ending: str) -> Iterator[None]:
    """Let `save` write figures with another ending than that of their names while the block lasts."""
    token = _ENDING.set(ending)
    try:
        yield
    finally:
        _ENDING.reset(token)


def save(figure: Figure, path: Path, about: Mapping[str, Any]) -> Path:
    """Write a figure with its provenance, as PNG, SVG or PDF by its ending, and close it.

    Returns:
        the file; see `drawn_as`.

    Raises:
        InputError: the file cannot be written, or it has another ending.
    """
    import matplotlib.pyplot as plt

    path = path.with_suffix(_ENDING.get()) if _ENDING.get() else path
    if path.suffix.lower() not in IMAGES:
        raise unknown("ending", path.suffix, IMAGES, shown(path))
    key, maker = IMAGES[path.suffix.lower()]
    with whole(path) as temporary:
        figure.savefig(temporary, dpi=140, metadata={key: "\n".join(lines(about)), maker: "latticebench"})
    plt.close(figure)
    return path
