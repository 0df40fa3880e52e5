"""Say what the whole cross of noise, samples, sites and libraries shows, from the published summary of the suite `cross`; write cross.md.

    latticebench run cross
    latticebench table runs/cross --only summary --only errors --out results/cross
    python results/cross/cross.py

Every figure is computed from summary.csv beside this file, which has a row for each kind of data, library and method. E2 is the relative error of
the coefficients, the bound its smallest root-mean-square for an unbiased method that keeps every term (Cramer-Rao). A method that selects
terms may go below it; and a single draw scatters about it.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from latticebench.bench.publish import format_number
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
OWN = ("lib2", "four")
METHODS = ("trajectory", "weak", "stlsq", "sr3")
# What a kind of data does not say, as the suite's files leave it out.
USUAL = {"samples": 50, "sites": 31, "noise": 0.0}
LOST = 4.0


def load(path: Path) -> pd.DataFrame:
    """Read the summary, and add what each kind of data is: system, noise, samples and sites."""
    table = pd.read_csv(path, comment="#")
    table["system"] = table["data"].str.split().str[0]
    for name, usual in USUAL.items():
        table[name] = table["data"].str.extract(rf"{name}=([\d.]+)")[0].astype(float).fillna(usual)
    table["own"] = table["library"].isin(OWN)
    table["ratio"] = table["e2"] / table["bound"]
    table["right"] = (table["tpr"] == 1) & (table["spurious"] == 0)
    return table


def methods(noisy: pd.DataFrame) -> pd.DataFrame:
    """Compare the methods over all kinds of data with noise."""
    groups = noisy.groupby(["own", "method"])
    told = pd.DataFrame({
        "kinds of data": groups.size(),
        "E2 / bound, median": groups["ratio"].median(),
        "90 % below": groups["ratio"].quantile(0.9),
        "largest": groups["ratio"].max(),
        "terms right": groups["right"].mean(),
        "seconds, median": groups["seconds"].median(),
        "largest seconds": groups["seconds"].max(),
    })  # fmt: skip
    return told.loc[[(own, name) for own in (True, False) for name in METHODS]].rename(
        index={True: "own terms", False: "large"}, level="own"
    )


def spread(noisy: pd.DataFrame, by: str) -> pd.DataFrame:
    """Give the median error over the bound with the lattice's own terms, by one thing that the cross varies."""
    own = noisy[noisy["own"]]
    return own.pivot_table(index="method", columns=by, values="ratio", aggfunc="median").loc[list(METHODS)]


def markdown(table: pd.DataFrame) -> str:
    """Write a table as Markdown, numbers with two digits."""
    flat = table.reset_index()
    flat.columns = [f"{name:g}" if isinstance(name, float) else str(name) for name in flat.columns]
    cells = flat.astype(object).map(lambda cell: format_number(cell) if isinstance(cell, float) else str(cell))
    return cells.to_markdown(index=False, disable_numparse=True)


def page(table: pd.DataFrame) -> str:
    """Write the page."""
    noisy, exact = table[table["noise"] > 0], table[table["noise"] == 0]
    seeds = table["ok"].str.split("/", expand=True).astype(int)
    ended = seeds.sum()
    trajectory = noisy[noisy["method"] == "trajectory"]
    lost = trajectory[trajectory["ratio"] > LOST]
    kept, selected = (noisy[~noisy["own"] & (noisy["method"] == name)] for name in ("trajectory", "weak"))
    worst = exact[exact["own"]].groupby("method")["e2"].max()
    parts = [
        "# Everything crossed with everything\n",
        f"Made by `python results/cross/cross.py` from [summary.csv](summary.csv): {len(table.groupby(['data', 'library']))} kinds of data and libraries, "
        f"{ended[1]} fits, {ended[0]} of which ended. `own terms`: the four terms of the lattice's own equation and its like; `large`: 10 to 13 terms. "
        f"Seeds: {seeds.loc[noisy.index, 1].max()} with noise, {seeds.loc[trajectory.index, 1].max()} for `trajectory`, "
        f"{seeds.loc[exact.index, 1].max()} where there is no noise.\n",
        "## With noise (0.1, 1, 5, 10 %)\n",
        markdown(methods(noisy)),
        "\nA library with every term kept is bounded by its own, larger bound; `weak`, `stlsq` and `sr3` select, `trajectory` here does not: it keeps what "
        f"it is given (`trajectory-select` is in [limits](../limits/which.md)). With the large libraries `weak` has the terms right in "
        f"{100 * selected['right'].mean():.0f} % and a median error of {selected['ratio'].median():.2g} times the bound of all terms; `trajectory`, which keeps "
        f"them, {kept['ratio'].median():.2g} times.\n",
        "Lost fits of `trajectory` (E2 more than "
        f"{LOST:g} times the bound): {len(lost)} of {len(trajectory)}"
        + (": " + "; ".join(f"{row.data} ({row.library}, {row.ratio:.2g} times)" for row in lost.itertuples()) if len(lost) else "")
        + ".\n",
        "## Error over the bound, own terms, by what is varied (medians)\n",
        *(f"{markdown(spread(noisy, name))}\n" for name in ("noise", "samples", "sites", "system")),
        "## Without noise\n",
        "Largest E2 with the own terms: " + ", ".join(f"`{name}` {format_number(worst[name])}" for name in METHODS) + ".",
    ]  # fmt: skip
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    write_text(HERE / "cross.md", page(load(HERE / "summary.csv")))
