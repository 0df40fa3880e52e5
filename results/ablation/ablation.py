"""Show what each part of the trained network buys, from a run of the suite `networks`: ablation.md and cost.png.

    latticebench run networks
    latticebench table runs/networks --out results/ablation
    python results/ablation/ablation.py

Every figure is computed from cases.csv beside this file. The middle of a point is the median over seeds and initial
states, its bars hold the middle 80 %, of the error and of the processor seconds.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from latticebench.bench.colours import INK, SERIES, series
from latticebench.bench.figures import LOWEST, MARKERS, save
from latticebench.bench.paired import UNDECIDED, paired
from latticebench.bench.publish import markdown_table
from latticebench.bench.published import read_head
from latticebench.bench.tables import SPREAD, counted, read_cases
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
# The method that the others are compared with.
WHOLE = "pinn-gn"
STARTS = {"paper": "the paper's states", "shaken": "random states"}


def load() -> pd.DataFrame:
    """Read the cases, with the lattice of each and an infinite error where a fit failed."""
    table = counted(read_cases(HERE / "cases.csv"))
    systems = [Path(json.loads(text)["system"]).stem for text in table["identity"]]
    return table.assign(lattice=[name.removesuffix("-shaken") for name in systems])


def cost(table: pd.DataFrame) -> Figure:
    """Draw E2 against processor seconds: rows are starts and noise levels, columns lattices."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    rows = list(dict.fromkeys(zip(table["part"], table["noise"], strict=True)))
    lattices, methods = (list(dict.fromkeys(table[name])) for name in ("lattice", "method"))
    figure, grid = plt.subplots(
        len(rows), len(lattices), figsize=(13, 2.6 * len(rows)), sharex=True, sharey="row", layout="constrained"
    )
    for (row, (part, noise)), (column, lattice) in itertools.product(enumerate(rows), enumerate(lattices)):
        axes = grid[row, column]
        here = table[(table["part"] == part) & (table["noise"] == noise) & (table["lattice"] == lattice)]
        for place, method in enumerate(methods):
            point(axes, here[here["method"] == method], place, method)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.grid(alpha=0.25)
        axes.set_title(f"{lattice}, {STARTS[part]}, {100 * noise:g} % noise", fontsize=8)
    figure.supxlabel("processor seconds of the fit", fontsize=9)
    figure.supylabel("relative error of the coefficients, E2", fontsize=9)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), fontsize=8, loc="outside right center", frameon=False)
    return figure


def point(axes: Axes, chosen: pd.DataFrame, place: int, method: str) -> None:
    """Draw the median of a method in one panel, with the middle 80 % of its errors and seconds."""
    good = chosen[np.isfinite(chosen["e2"])]
    if good.empty:
        return
    ends, middles = [], []
    for name, least in (("cpu_seconds", 1e-4), ("e2", LOWEST)):
        low, middle, high = (
            max(float(good[name].quantile(share, interpolation="nearest")), least)
            for share in (SPREAD[0], 0.5, SPREAD[1])
        )
        middles.append(middle)
        ends.append([[middle - low], [high - middle]])
    (seconds, error), (across, along) = middles, ends
    # There is one method more than colours.
    colour = series(place) if place < len(SERIES) else INK
    axes.errorbar(
        seconds, error, yerr=along, xerr=across, fmt=MARKERS[place % len(MARKERS)], color=colour, ms=5,
        elinewidth=1.2, alpha=0.85, label=method,
    )  # fmt: skip


def compared(table: pd.DataFrame) -> pd.DataFrame:
    """Return how each method does beside WHOLE, by start and noise: medians of paired ratios, and the paired test."""
    found = []
    for (key, noise), here in table.groupby(["part", "noise"], sort=False):
        part, tests = str(key), paired(here, over="seeds")
        for method in dict.fromkeys(here["method"]):
            own = here[here["method"] == method]
            row = {"start": STARTS[part], "noise": noise, "method": method, "fits": len(own)}
            row |= {"lost": int(np.isinf(own["e2"]).sum()), "e2": own["e2"].median(), "largest e2": own["e2"].max()}
            row["cpu seconds"] = own["cpu_seconds"].median()
            test = tests[
                ((tests["method"] == method) & (tests["against"] == WHOLE))
                | ((tests["method"] == WHOLE) & (tests["against"] == method))
            ]
            if not test.empty:
                one = test.iloc[0]
                ratio = one["ratio"] if one["method"] == method else 1 / one["ratio"]
                row |= {"pairs": str(one["pairs"]), "ratio": ratio, "p": one["p"]}
                better = one["verdict"].removesuffix(" better")
                row["beside it"] = {UNDECIDED: UNDECIDED, method: "better"}.get(better, "worse")
            found.append(row)
    return pd.DataFrame(found).fillna({"pairs": "", "beside it": ""})


def page() -> str:
    """Return the text of ablation.md, made from cases.csv beside this file."""
    about = [f"- {name}: {told}\n" for name, told in read_head(HERE / "cases.csv").items()]
    return (
        "# What each part of the trained network buys\n\n"
        "Made by `python results/ablation/ablation.py` from a run of the suite `networks`: four lattices, their own "
        f"terms, known ends. `{WHOLE}` has a layer of sines as wide as the samples ask for, trained, and a weight of "
        "the equation that grows until it holds. `drawn`: the layer stays as it was drawn. `soft`: the weight stays "
        "where it starts. `narrow`: 24 units; `narrow-tanh`: of them, tanh in place of sines; `-drawn`: not trained. "
        "ratio: the median over pairs (same samples and seed) of the error over that of "
        f"`{WHOLE}`; p: signed-rank test over the seeds of these four lattices, corrected for all pairs of methods "
        "(Holm); lost: fits without a result. "
        "E2 and seconds are medians over lattices, seeds and initial states. ![Error and cost](cost.png)\n\n"
        f"{markdown_table(compared(load()))}\n\n{''.join(about)}"
    )


def main() -> None:
    """Write ablation.md and cost.png."""
    about = read_head(HERE / "cases.csv")
    save(cost(load()), HERE / "cost.png", {**about, "command": "python results/ablation/ablation.py"})
    write_text(HERE / "ablation.md", page())


if __name__ == "__main__":
    main()
