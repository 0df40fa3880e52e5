"""Say which method serves when, from the published table of the suite `limits`, and write which.md.

    latticebench run limits
    latticebench table runs/limits --only cases --only limits --only summary --only errors --out results/limits
    latticebench figures runs/limits --only error-against-noise --out results/limits
    python results/limits/which.py

Every figure is computed from cases.csv beside this file. E2 is the relative error of the coefficients, the bound its smallest
root-mean-square for an unbiased method that keeps every term (Cramer-Rao), the efficiency the bound over the root-mean-square of
E2 over the seeds. A fit is lost when its E2 is more than LOST times the bound, or when it failed.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from latticebench.bench.publish import format_number
from latticebench.bench.tables import read_cases, summary
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
LOST = 10.0
FEW = 3
# A method serves where its median error is at most so many times the best one.
SERVES = 1.25
# The floor, the ceiling and the variants are no choices of their own.
CONTESTANTS = (
    "trajectory",
    "trajectory-select",
    "splines",
    "weak",
    "pinn-vp",
    "sindy-tuned",
    "stlsq",
    "stlsq-differences",
)
FINE = ("trajectory", "splines", "weak")
BASE = {"samples": 50, "sites": 31}
COMPARED = 0.01


def load(path: Path) -> pd.DataFrame:
    """Read the cases, and add what their settings say: system, samples, sites, and whether the library is the lattice's own."""
    table = read_cases(path)
    settings = [json.loads(text) for text in table["identity"]]
    for name, value in BASE.items():
        table[name] = [one.get(name, value) for one in settings]
    table["system"] = [one["system"] for one in settings]
    own = table.loc[table["part"] == "samples", ["system", "library"]].drop_duplicates()
    table["own"] = pd.MultiIndex.from_frame(table[["system", "library"]]).isin(pd.MultiIndex.from_frame(own))
    ended = table["status"] == "ok"
    table.loc[~ended & (table["status"] != "skipped"), "e2"] = np.inf
    groups = [table[name] for name in ("data", "library")]
    table["bound"] = table["bound"].fillna(table["bound"].groupby(groups).transform("mean"))
    table["lost"] = table["e2"] > LOST * table["bound"]
    return table


def fair(table: pd.DataFrame) -> pd.DataFrame:
    """Keep the contestants, and for each kind of data the seeds that all of them have: the same samples for everyone.

    A contestant of fewer than FEW seeds is left out where others have more.
    """
    kept = []
    for _, group in table[table["method"].isin(CONTESTANTS)].groupby(["data", "library"], sort=False):
        seeds = {name: set(one["seed"]) for name, one in group.groupby("method")}
        many = {name: one for name, one in seeds.items() if len(one) >= min(FEW, max(map(len, seeds.values())))}
        common = set.intersection(*many.values())
        kept.append(group[group["method"].isin(many) & group["seed"].isin(common)])
    return pd.concat(kept)


def shown(table: pd.DataFrame) -> str:
    """Write a table as Markdown, numbers with two digits."""
    readable = table.reset_index()
    readable.columns = [str(name) for name in readable.columns]
    for name in readable.columns:
        if pd.api.types.is_float_dtype(readable[name]):
            readable[name] = [format_number(value) for value in readable[name]]
    return str(readable.astype(str).to_markdown(index=False, disable_numparse=True)) + "\n"


def percent(values: pd.Series) -> pd.Series:
    """Write shares as percentages."""
    return values.map(lambda value: f"{100 * value:g} %")


def arranged(table: pd.DataFrame, rows: Sequence[str], value: str, *, bound: bool = False) -> pd.DataFrame:
    """Arrange the medians of a score as rows against methods; `efficiency` is no median but one figure a cell."""
    methods = [name for name in CONTESTANTS if name in set(table["method"])]
    if value == "efficiency":
        pairs = [*rows, "method"]
        short = summary(table).merge(
            table[[*pairs, "data", "library"]].drop_duplicates(), on=["data", "library", "method"]
        )
        wide = short.pivot(index=list(rows), columns="method", values="efficiency")
    else:
        wide = table.pivot_table(index=list(rows), columns="method", values=value, aggfunc="median")
    order = table[list(rows)].drop_duplicates()
    wide = wide.reindex(
        index=pd.MultiIndex.from_frame(order) if len(rows) > 1 else pd.Index(order[rows[0]]), columns=methods
    )
    if bound:
        wide["bound"] = table.groupby(list(rows))["bound"].mean().reindex(wide.index)
    wide.columns.name = None
    if "noise" in rows:
        wide = wide.reset_index()
        wide["noise"] = percent(wide["noise"])
        wide = wide.set_index(list(rows))
    return wide


def span(values: pd.Series) -> str:
    """Write the smallest and the largest of some numbers, each with two digits."""
    low, high = (f"{float(f'{value:.2g}'):g}" for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def scatter(table: pd.DataFrame, method: str) -> float:
    """Say by how much an efficiency over these seeds scatters, as a share: a bootstrap over the seeds, median over the cells."""
    draw = np.random.default_rng(0)
    found = []
    for _, group in table[(table["method"] == method) & ~table["lost"]].groupby(["data", "library"]):
        square = group["e2"].to_numpy() ** 2
        if len(square) > 2:
            again = np.sqrt(np.mean(draw.choice(square, (500, len(square))), axis=1))
            found.append(np.std(again) / np.mean(again))
    return float(np.median(found))


def lost(table: pd.DataFrame, method: str) -> str:
    """Count the lost fits of a method, and say where they are."""
    mine = table[table["method"] == method]
    gone = mine[mine["lost"]]
    if gone.empty:
        return f"none of {len(mine)}"
    cells = gone.assign(cell=gone["system"] + ", " + percent(gone["noise"])).groupby("cell", sort=False)
    places = [f"{cell}: {len(group)}" for cell, group in cells]
    return f"{len(gone)} of {len(mine)} ({'; '.join(places)})"


def picks(table: pd.DataFrame) -> pd.DataFrame:
    """Find for each kind of data and library the best median error, and the quickest method that serves."""
    rows = []
    for (data, library), group in fair(table).groupby(["data", "library"], sort=False):
        short = group.groupby("method", sort=False).agg(e2=("e2", "median"), seconds=("cpu_seconds", "median"))
        serving = short[short["e2"] <= SERVES * short["e2"].min()]
        first = group.iloc[0]
        rows.append(
            {
                "part": first["part"], "own": first["own"], "data": data, "library": library,
                "best": short["e2"].idxmin(), "quickest": serving["seconds"].idxmin(),
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def counted(names: pd.Series) -> str:
    """Write how often each name occurs, the most frequent first."""
    return ", ".join(f"`{name}` {count}" for name, count in names.value_counts().items())


def times(table: pd.DataFrame, method: str, other: str) -> pd.Series:
    """Divide a method's median error on each kind of data by another's, or by the bound, on the seeds that both have."""
    mine = table[table["method"] == method].set_index(["data", "library", "seed"])
    theirs = mine["bound"] if other == "bound" else table[table["method"] == other].set_index(mine.index.names)["e2"]
    both = pd.concat([mine["e2"], theirs.rename("other")], axis=1, join="inner")
    medians = both.groupby(level=["data", "library"], sort=False).median()
    return medians["e2"] / medians["other"]


def own_terms(table: pd.DataFrame) -> str:
    """Tell of the lattices' own terms, with noise."""
    noisy = table[(table["part"] == "noise") & table["own"] & (table["noise"] > 0)]
    efficiency = arranged(noisy, ["system", "noise"], "efficiency")
    lost_ones = "; ".join(f"`{name}` {lost(noisy, name)}" for name in (*FINE, "pinn-vp"))
    return "\n".join(
        [
            "## The terms are known\n",
            "Efficiency with the lattice's own terms, 50 samples of 31 sites; 1 is the best that anyone can do. Ten seeds (three for "
            f"`pinn-vp`), over which an efficiency scatters by about {100 * scatter(noisy, 'trajectory'):.0f} %; since the noise of a seed is "
            "the same at every level but for its size, the levels do not average that out.\n",
            shown(efficiency),
            f"Lost fits (E2 above {LOST:g} times the bound): {lost_ones}.\n",
        ]
    )


def large_libraries(table: pd.DataFrame) -> str:
    """Tell of the large libraries, with noise."""
    noisy = table[(table["part"] == "noise") & ~table["own"] & (table["noise"] > 0)]
    right = noisy.assign(right=(noisy["tpr"] == 1).astype(float))
    support = right[right["method"].isin(CONTESTANTS)].pivot_table(
        index="noise", columns="method", values="right", aggfunc="mean"
    )
    support = support.reindex(columns=[name for name in CONTESTANTS if name in support])
    support.index = pd.Index(percent(pd.Series(support.index)), name="noise")
    support.columns.name = None
    return "\n".join(
        [
            "## Only a long list of terms is known\n",
            "Median E2. The bound is that of a method which keeps all terms; one that drops the right ones can do better. It is a "
            "root-mean-square, and where one direction dominates, a median over few seeds scatters widely below it.\n",
            shown(arranged(fair(noisy), ["system", "library", "noise"], "e2", bound=True)),
            "Share of fits with the right support (a term counts as found when it is at least 5 % of the derivative):\n",
            shown(support.round(2)),
            "Lost fits: " + "; ".join(f"`{name}` {lost(noisy, name)}" for name in (*FINE, "trajectory-select")) + ".\n",
        ]
    )


def more_of(table: pd.DataFrame, axis: str) -> str:
    """Tell of more samples or sites: the arm of the star, with its middle from the noise axis."""
    middle = (table["part"] == "noise") & table["own"] & (table["noise"] == COMPARED)
    arm = table[middle | (table["part"] == axis)].sort_values(["system", axis], kind="stable")
    arm = arm[arm["method"] != "pinn-vp"]
    wide = arranged(fair(arm), ["system", axis], "e2", bound=True)
    ends = sorted(arm[axis].unique())
    change = {
        name: wide[name].xs(ends[0], level=axis) / wide[name].xs(ends[-1], level=axis)
        for name in ("trajectory", "weak", "stlsq")
    }  # fmt: skip
    seconds = arm.pivot_table(index=axis, columns="method", values="cpu_seconds", aggfunc="median")
    seconds = seconds.reindex(columns=[name for name in CONTESTANTS if name in seconds and name in wide])
    seconds.columns.name = None
    return "\n".join(
        [
            f"## More {axis}\n",
            f"Median E2 at 1 % noise, own terms, everything else as before.\n\n{shown(wide)}",
            f"From {ends[0]} to {ends[-1]} {axis} the bound falls by a factor of "
            f"{span(wide['bound'].xs(ends[0], level=axis) / wide['bound'].xs(ends[-1], level=axis))}; the median error of "
            + ", ".join(f"`{name}` by {span(values)}" for name, values in change.items())
            + ".\n",
            f"Processor seconds a fit (median over the systems):\n\n{shown(seconds)}",
        ]
    )


def without_noise(table: pd.DataFrame) -> str:
    """Tell of noise-free samples."""
    clean = table[(table["part"] == "noise") & (table["noise"] == 0)]
    return "\n".join(
        ["## No noise\n", "E2 of one fit each.\n", shown(arranged(clean, ["system", "library"], "e2"))]
    )  # fmt: skip


def forecasts(table: pd.DataFrame) -> str:
    """Tell how far the found equations foretell."""
    chosen = table[(table["part"] == "noise") & table["own"] & (table["noise"] == COMPARED)]
    wide = arranged(fair(chosen), ["system"], "forecast_error")
    return "\n".join(
        [
            "## Forecasts\n",
            "Median relative error of a simulation from an initial state that no method saw, own terms, 1 % noise.\n",
            shown(wide),
        ]
    )


def in_short(table: pd.DataFrame) -> str:
    """Give the advice: which method is meant follows from the figures by the rule that is told beside it."""
    noisy = table[table["noise"] > 0]
    own = noisy[(noisy["part"] == "noise") & noisy["own"]]
    large = noisy[(noisy["part"] == "noise") & ~noisy["own"]]
    seconds = own.groupby("method")["cpu_seconds"].median()
    efficiency = arranged(own, ["system", "noise"], "efficiency")
    worst = efficiency[list(FINE)].min().round(2)
    # The least efficiency decides, and between equals the time.
    first = min(FINE, key=lambda name: (-worst[name], seconds[name]))
    quick = min(FINE, key=lambda name: seconds[name])
    network = times(own, "pinn-vp", first)
    errors = {name: float(times(large, name, "trajectory").median()) for name in ("trajectory-select", "weak", "stlsq")}
    chooser = min(errors, key=lambda name: errors[name])
    slower = large.groupby("method")["cpu_seconds"].median()
    lines = [
        "## In short\n",
        f"- **The terms are known**: `{first}`, whose least efficiency over four lattices and four noise levels is the highest "
        f"({worst[first]:.2g}; "
        + ", ".join(f"`{name}` {worst[name]:.2g}" for name in FINE if name != first)
        + f"; equals are told apart by their time), in {seconds[first]:.2g} s.",
        f"- **There are many fits to do**: `{quick}` takes {seconds[quick]:.2g} s, and its error is {span(times(own, quick, first))} times that of "
        f"`{first}`.",
        f"- **Only a long list of terms is known**: `{chooser}`, whose error is {span(times(large, chooser, 'trajectory'))} times that of the same "
        f"fit with all terms kept, in {slower[chooser]:.2g} s; `weak` {span(times(large, 'weak', 'trajectory'))} times, in {slower['weak']:.2g} s.",
        f"- **The network** (`pinn-vp`): {span(network)} times the error of `{first}` in {seconds['pinn-vp'] / seconds[first]:.0f} times its time.",
        f"- **Regression on derivatives** (`stlsq`), with noise: {span(times(own, 'stlsq', first))} times the error of `{first}`; with "
        f"pysindy's finite differences {span(times(own, 'stlsq-differences', first))} times. It is the quickest, {seconds['stlsq']:.2g} s. "
        f"With optimiser, differentiation and settings chosen by the samples (`sindy-tuned`, {seconds['sindy-tuned']:.2g} s): "
        f"{span(times(own, 'sindy-tuned', first))} times; of long lists {span(times(large, 'sindy-tuned', chooser))} times that of `{chooser}`.",
        "- **The long list costs knowledge, not only time**: with every term kept, the bound is "
        f"{span(large.groupby('data')['bound'].mean() / own.groupby('data')['bound'].mean())} times that of the lattice's own terms.",
        "",
        f"Counted over the kinds of data with noise, a method serving where its median error is at most {SERVES:g} times the best:\n",
    ]
    found = picks(noisy)
    rows = []
    for name, group in (
        ("own terms, noise", found[found["own"] & (found["part"] == "noise")]),
        ("large libraries, noise", found[~found["own"]]),
        ("own terms, samples and sites", found[found["part"] != "noise"]),
    ):
        rows.append(f"| {name} | {len(group)} | {counted(group['best'])} | {counted(group['quickest'])} |")
    lines += ["| | kinds of data | best | quickest that serves |", "|---|---|---|---|", *rows, ""]
    return "\n".join(lines)


def main() -> None:
    """Write which.md beside this file."""
    path = HERE / "cases.csv"
    table = load(HERE)
    made = [line.removeprefix("# ") for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("# ")]
    # The head's lines about the run; the machine's and the versions' stand in the tables.
    made = [line for line in made if line.split(":")[0] in ("command", "commit", "date", "machine", "seeds")]
    parts = [
        "# Which method when\n",
        "Made by `python results/limits/which.py` from [cases.csv](cases.csv), a run of the suite `limits`: four lattices from known ends, "
        "noise, samples and sites varied one after the other about 50 samples of 31 sites at 1 % noise. What may be known of each "
        "coefficient stands in [limits.md](limits.md), the figure in [error-against-noise.png](error-against-noise.png).\n",
        in_short(table), own_terms(table), large_libraries(table), more_of(table, "samples"), more_of(table, "sites"),
        without_noise(table), forecasts(table), "".join(f"- {line}\n" for line in made),
    ]  # fmt: skip
    write_text(HERE / "which.md", "\n".join(parts))


if __name__ == "__main__":
    main()
