"""Summarise the suite `cross`, in which noise, samples, sites and libraries are all crossed, and write cross.md.

    latticebench run cross
    latticebench table runs/cross --only summary --only errors --out results/cross
    python results/cross/cross.py

Every figure is computed from summary.csv beside this file, which has one row per kind of data, library and method. E2
is the relative error of the coefficients; the bound is the smallest root-mean-square of E2 that an unbiased method can
have if it keeps every term (Cramer-Rao). A method that selects terms can have a smaller error, and so can a single
draw of the noise.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from latticebench.bench.publish import format_number, render
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
OWN = ("lib2", "four")
METHODS = ("trajectory", "weak", "stlsq", "sr3")
# The values of settings that the name of a kind of data leaves out.
USUAL = {"samples": 50, "sites": 31, "noise": 0.0}
VARIED = {"noise": "noise level", "samples": "number of samples", "sites": "number of sites", "system": "system"}
# A fit is lost when its E2 exceeds this multiple of the bound.
LOST = 4.0


def load(path: Path) -> pd.DataFrame:
    """Read the summary and add what the names of data and library say, E2 / bound, and whether the support is right."""
    table = pd.read_csv(path, comment="#")
    table["system"] = table["data"].str.split().str[0]
    for name, usual in USUAL.items():
        table[name] = table["data"].str.extract(rf"{name}=([\d.]+)")[0].astype(float).fillna(usual)
    table["own"] = table["library"].isin(OWN)
    table["ratio"] = table["e2"] / table["bound"]
    table["right"] = ((table["tpr"] == 1) & (table["spurious"] == 0)).where(table["e2"].notna()).astype(float)
    return table


def by_method(noisy: pd.DataFrame) -> pd.DataFrame:
    """Compare the methods over all kinds of data with noise, for own terms and large libraries."""
    groups = noisy.groupby(["own", "method"])
    compared = pd.DataFrame({
        "kinds of data": groups.size(),
        "with a bound": groups["ratio"].count(),
        "E2 / bound, median": groups["ratio"].median(),
        "90th percentile": groups["ratio"].quantile(0.9),
        "largest": groups["ratio"].max(),
        "right support": groups["right"].mean(),
        "seconds, median": groups["seconds"].median(),
        "largest seconds": groups["seconds"].max(),
    })  # fmt: skip
    compared = compared.loc[[(own, name) for own in (True, False) for name in METHODS]]
    return compared.rename(index={True: "own terms", False: "large"}, level="own").rename_axis(["library", "method"])


def by_setting(noisy: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return the median of E2 / bound with the own terms, methods against the values of one setting."""
    own = noisy[noisy["own"]]
    return own.pivot_table(index="method", columns=name, values="ratio", aggfunc="median").loc[list(METHODS)]


def markdown(table: pd.DataFrame) -> str:
    """Return a table and its index as Markdown, numbers with two digits."""
    flat = table.reset_index()
    flat.columns = pd.Index([f"{name:g}" if isinstance(name, float) else str(name) for name in flat.columns])
    return render(flat, {}, "md").rstrip()


def lost_fits(trajectory: pd.DataFrame) -> str:
    """List the lost fits of `trajectory`, one per line, of those that have a bound."""
    lost, bounded = trajectory[trajectory["ratio"] > LOST], trajectory["ratio"].count()
    refused = int(trajectory["e2"].isna().sum())
    lines = [f"- {row.data} ({row.library}): {row.ratio:.2g} times the bound" for row in lost.itertuples()]
    title = (
        f"Lost fits of `trajectory` (E2 more than {LOST:g} times the bound): {len(lost)} of the {bounded} that have a "
        f"bound. {len(trajectory) - bounded} have none, as computing it takes more memory than a case may use; "
        f"{refused} fits were refused, as they would take more, too."
    )
    return "\n".join([title, *(["", *lines] if lines else []), ""])


def page() -> str:
    """Return the text of cross.md, made from summary.csv."""
    table = load(HERE / "summary.csv")
    noisy, exact = table[table["noise"] > 0], table[table["noise"] == 0]
    seeds = table["ok"].str.split("/", expand=True).astype(int)
    succeeded, fits = seeds.sum()
    trajectory = noisy[noisy["method"] == "trajectory"]
    many, slow, single = (seeds.loc[part.index, 1].max() for part in (noisy, trajectory, exact))
    kept, selected = (noisy[~noisy["own"] & (noisy["method"] == name)] for name in ("trajectory", "weak"))
    worst = exact[exact["own"]].groupby("method")["e2"].max()
    parts = [
        "# Noise, samples, sites and libraries, all crossed\n",
        "Made by `python results/cross/cross.py` from [summary.csv](summary.csv): "
        f"{len(table.groupby(['data', 'library']))} combinations of data and library, {fits} fits, of which "
        f"{succeeded} succeeded. `own terms` is the library of the four terms of the lattice's own equation, "
        f"`large` one of 10 to 13 terms. Each entry has {many} seeds ({slow} for `trajectory`) "
        f"with noise and {single} without.\n",
        f"## With noise ({', '.join(f'{100 * level:g}' for level in sorted(noisy['noise'].unique()))} %)\n",
        markdown(by_method(noisy)),
        "\nEach library has a bound of its own, for a method that keeps all of its terms; that of a large library is "
        "larger. `weak`, `stlsq` and `sr3` select terms; `trajectory` keeps them all (`trajectory-select` is compared "
        "in [limits](../limits/which.md)). With the large libraries, `weak` finds the right support for "
        f"{100 * selected['right'].mean():.0f} % of the kinds of data, and its median error is "
        f"{selected['ratio'].median():.2g} times the bound; that of `trajectory` is {kept['ratio'].median():.2g}.\n",
        lost_fits(trajectory),
        "## Median E2 / bound with the own terms\n",
        *(f"By {title}:\n\n{markdown(by_setting(noisy, name))}\n" for name, title in VARIED.items()),
        "## Without noise\n",
        f"Largest E2 with the own terms: {', '.join(f'`{name}` {format_number(worst[name])}' for name in METHODS)}.",
    ]
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    write_text(HERE / "cross.md", page())
