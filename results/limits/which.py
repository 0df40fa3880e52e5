"""Show which method serves when, from the published table of the suite `limits`, and write which.md.

    latticebench run limits
    latticebench table runs/limits --only cases --only limits --only summary --only errors --out results/limits
    latticebench figures runs/limits --only error-against-noise --out results/limits
    python results/limits/which.py

Every figure is computed from cases.csv beside this file. E2 is the relative error of the coefficients; the bound is the
smallest root-mean-square of E2 that an unbiased method can have if it keeps every term (Cramer-Rao); the efficiency is
the bound over the root-mean-square of E2 over the seeds. A fit is lost when it failed, or when its E2 is more than LOST
times the bound.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from latticebench.bench.publish import render
from latticebench.bench.tables import read_cases, summary
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
LOST = 10.0
# A method with fewer seeds is left out of a comparison in which others have more.
FEW = 3
# A method serves where its median error is at most this multiple of the smallest.
SERVES = 1.25
# The methods to choose from: `least-squares` and `zero` are floors, and `sr3` comes out as `stlsq` does.
CONTESTANTS = (
    "trajectory",
    "trajectory-select",
    "splines",
    "pinn-gn",
    "weak",
    "sindy-tuned",
    "stlsq",
    "stlsq-differences",
)
# The methods that come near the bound.
NEAR_BOUND = ("trajectory", "splines", "pinn-gn", "weak")
# The values of settings that a case leaves out, and the noise level at which samples and sites are varied.
BASE = {"samples": 50, "sites": 31}
COMPARED = 0.01


def load(path: Path) -> pd.DataFrame:
    """Read the cases and add columns for samples, sites, system, the lattice's own library and lost fits."""
    table = read_cases(path)
    settings = [json.loads(text) for text in table["identity"]]
    for name, value in BASE.items():
        table[name] = [one.get(name, value) for one in settings]
    table["system"] = [one["system"] for one in settings]
    # Samples and sites are varied with the lattice's own library alone.
    own = table.loc[table["part"] == "samples", ["system", "library"]].drop_duplicates()
    table["own"] = pd.MultiIndex.from_frame(table[["system", "library"]]).isin(pd.MultiIndex.from_frame(own))
    ended = table["status"] == "ok"
    table.loc[~ended & (table["status"] != "skipped"), "e2"] = np.inf
    groups = [table[name] for name in ("data", "library")]
    table["bound"] = table["bound"].fillna(table["bound"].groupby(groups).transform("mean"))
    table["lost"] = table["e2"] > LOST * table["bound"]
    return table


def fair(table: pd.DataFrame) -> pd.DataFrame:
    """Keep the contestants, and per kind of data the seeds that all of them have: the same samples for everyone.

    A contestant with fewer than FEW seeds is left out where others have more.
    """
    kept = []
    for _, group in table[table["method"].isin(CONTESTANTS)].groupby(["data", "library"], sort=False):
        seeds = {name: set(one["seed"]) for name, one in group.groupby("method")}
        many = {name: one for name, one in seeds.items() if len(one) >= min(FEW, max(map(len, seeds.values())))}
        common = set.intersection(*many.values())
        kept.append(group[group["method"].isin(many) & group["seed"].isin(common)])
    return pd.concat(kept)


# Tables and numbers as text -----------------------------------------------------------------------------------------


def markdown(table: pd.DataFrame) -> str:
    """Return a table and its index as Markdown, numbers with two digits."""
    return render(table.rename(columns=str).reset_index(), {}, "md").rstrip() + "\n"


def percent(values: pd.Series) -> pd.Series:
    """Return shares as percentages."""
    return values.map(lambda value: f"{100 * value:g} %")


def span(values: pd.Series) -> str:
    """Return the smallest and the largest of some numbers, each with two digits."""
    low, high = (f"{float(f'{value:.2g}'):g}" for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def counted(names: pd.Series) -> str:
    """Return each name with the number of times it occurs, the most frequent first."""
    return ", ".join(f"`{name}` {count}" for name, count in names.value_counts().items())


def lost_fits(table: pd.DataFrame, methods: Sequence[str]) -> str:
    """Count the lost fits of each method by system and noise level."""
    found = []
    for method in methods:
        mine = table[table["method"] == method]
        lost = mine[mine["lost"]]
        cells = lost.assign(cell=lost["system"] + ", " + percent(lost["noise"])).groupby("cell", sort=False)
        places = "; ".join(f"{cell}: {len(group)}" for cell, group in cells)
        found.append(f"`{method}` " + (f"{len(lost)} of {len(mine)} ({places})" if places else f"none of {len(mine)}"))
    return "; ".join(found)


# Comparisons --------------------------------------------------------------------------------------------------------


def arranged(table: pd.DataFrame, rows: Sequence[str], value: str, *, bound: bool = False) -> pd.DataFrame:
    """Arrange the medians of a score as rows against methods; of `efficiency` each entry has a single value."""
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


def scatter(table: pd.DataFrame, method: str) -> float:
    """Return the relative standard error of an efficiency, from a bootstrap over the seeds; median over the entries."""
    draw = np.random.default_rng(0)
    found = []
    for _, group in table[(table["method"] == method) & ~table["lost"]].groupby(["data", "library"]):
        square = group["e2"].to_numpy() ** 2
        if len(square) > 2:
            again = np.sqrt(np.mean(draw.choice(square, (500, len(square))), axis=1))
            found.append(np.std(again) / np.mean(again))
    return float(np.median(found))


def winners(table: pd.DataFrame) -> pd.DataFrame:
    """Find the method with the smallest median error and the fastest that serves, per kind of data and library."""
    rows = []
    for (data, library), group in fair(table).groupby(["data", "library"], sort=False):
        short = group.groupby("method", sort=False).agg(e2=("e2", "median"), seconds=("cpu_seconds", "median"))
        serving = short[short["e2"] <= SERVES * short["e2"].min()]
        first = group.iloc[0]
        rows.append(
            {
                "part": first["part"], "own": first["own"], "data": data, "library": library,
                "best": short["e2"].idxmin(), "fastest": serving["seconds"].idxmin(),
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def error_ratio(table: pd.DataFrame, method: str, other: str) -> pd.Series:
    """Divide a method's median error on each kind of data by that of another, over the seeds that both have."""
    errors = [
        table[table["method"] == name].set_index(["data", "library", "seed"])["e2"].rename(name)
        for name in (method, other)
    ]
    medians = pd.concat(errors, axis=1, join="inner").groupby(level=["data", "library"], sort=False).median()
    return medians[method] / medians[other]


# The sections of the page -------------------------------------------------------------------------------------------


def own_terms(table: pd.DataFrame) -> str:
    """Write the section on the lattices' own terms, with noise."""
    noisy = table[(table["part"] == "noise") & table["own"] & (table["noise"] > 0)]
    scattered, seeds = 100 * scatter(noisy, "trajectory"), noisy["seed"].nunique()
    return "\n".join(
        [
            "## The lattice's own terms\n",
            f"Efficiency with 50 samples of 31 sites; 1 is the best that an unbiased method can reach. Over {seeds} "
            f"seeds an efficiency scatters by about {scattered:.0f} %. A seed draws the same noise for every method, "
            "so methods compare better than that, and at every level, only scaled, so averaging over the levels does "
            "not reduce this scatter.\n",
            markdown(arranged(noisy, ["system", "noise"], "efficiency")),
            f"Lost fits (E2 above {LOST:g} times the bound): {lost_fits(noisy, NEAR_BOUND)}.\n",
        ]
    )


def large_libraries(table: pd.DataFrame) -> str:
    """Write the section on the large libraries, with noise."""
    noisy = table[(table["part"] == "noise") & ~table["own"] & (table["noise"] > 0)]
    large = set(noisy["method"])
    right = noisy.assign(right=(noisy["tpr"] == 1).astype(float))
    support = right[right["method"].isin(CONTESTANTS)].pivot_table(
        index="noise", columns="method", values="right", aggfunc="mean"
    )
    support = support.reindex(columns=[name for name in CONTESTANTS if name in support])
    support.index = pd.Index(percent(pd.Series(support.index)), name="noise")
    support.columns.name = None
    return "\n".join(
        [
            "## Large libraries\n",
            "Median E2. The bound is for a method that keeps all terms; one that drops absent terms can do better. It "
            "bounds a root-mean-square: where one combination of coefficients dominates the error, the median over a "
            "few seeds can be far smaller.\n",
            markdown(arranged(fair(noisy), ["system", "library", "noise"], "e2", bound=True)),
            "Share of fits with the right support (a term is found when its share of the derivative is nearer to that "
            "of the least true term than to 0):\n",
            markdown(support.round(2)),
            f"Lost fits: {lost_fits(noisy, [name for name in CONTESTANTS if name in large])}.\n",
        ]
    )


def more_of(table: pd.DataFrame, axis: str) -> str:
    """Write the section on more samples or more sites; the values in the middle are those of the part `noise`."""
    middle = (table["part"] == "noise") & table["own"] & (table["noise"] == COMPARED)
    arm = table[middle | (table["part"] == axis)].sort_values(["system", axis], kind="stable")
    arm = arm[arm["method"].isin(arm.loc[arm["part"] == axis, "method"])]
    wide = arranged(fair(arm), ["system", axis], "e2", bound=True)
    least, most = min(arm[axis]), max(arm[axis])
    falls = {
        name: span(wide[name].xs(least, level=axis) / wide[name].xs(most, level=axis))
        for name in ("bound", "trajectory", "weak", "stlsq")
    }
    seconds = arm.pivot_table(index=axis, columns="method", values="cpu_seconds", aggfunc="median")
    seconds = seconds.reindex(columns=[name for name in CONTESTANTS if name in seconds and name in wide])
    seconds.columns.name = None
    fixed = ", ".join(f"{value} {name}" for name, value in BASE.items() if name != axis)
    return "\n".join(
        [
            f"## More {axis}\n",
            f"Median E2 with the lattice's own terms, 1 % noise, {fixed}.\n\n{markdown(wide)}",
            f"From {least} to {most} {axis} the bound falls by a factor of {falls.pop('bound')}, depending on the "
            f"lattice, and the median error of {', '.join(f'`{name}` by {fall}' for name, fall in falls.items())}.\n",
            f"Median processor seconds per fit:\n\n{markdown(seconds)}",
        ]
    )


def without_noise(table: pd.DataFrame) -> str:
    """Write the section on noise-free samples."""
    clean = table[(table["part"] == "noise") & (table["noise"] == 0)]
    errors = arranged(clean, ["system", "library"], "e2")
    return f"## No noise\n\nE2 of a single fit per entry.\n\n{markdown(errors)}"


def forecasts(table: pd.DataFrame) -> str:
    """Write the section on forecasts with the equations found."""
    chosen = table[(table["part"] == "noise") & table["own"] & (table["noise"] == COMPARED)]
    return (
        "## Forecasts\n\nMedian relative error of a forecast from an initial state that no method saw, with the "
        f"lattice's own terms and 1 % noise.\n\n{markdown(arranged(fair(chosen), ['system'], 'forecast_error'))}"
    )


def advice(own: pd.DataFrame, large: pd.DataFrame) -> list[str]:
    """Write the advice; which method it names follows from the figures, by the rule stated beside them."""
    seconds = own.groupby("method")["cpu_seconds"].median()
    efficiency = arranged(own, ["system", "noise"], "efficiency")
    lowest = efficiency[list(NEAR_BOUND)].min().round(2)
    first = min(NEAR_BOUND, key=lambda name: (-lowest[name], seconds[name]))
    others = ", ".join(f"`{name}` {lowest[name]:.2g}" for name in NEAR_BOUND if name != first)
    quick = min(NEAR_BOUND, key=lambda name: seconds[name])
    errors = {
        name: float(error_ratio(large, name, "trajectory").median()) for name in ("trajectory-select", "weak", "stlsq")
    }
    chooser = min(errors, key=lambda name: errors[name])
    slower = large.groupby("method")["cpu_seconds"].median()
    bounds = large.groupby("data")["bound"].mean() / own.groupby("data")["bound"].mean()
    return [
        f"- **If the terms are known**: `{first}`. Its lowest efficiency over four lattices and four noise levels, "
        f"{lowest[first]:.2g}, is the highest ({others}; the faster method wins a tie). A fit takes "
        f"{seconds[first]:.2g} s.",
        f"- **If there are many fits to do**: `{quick}`. A fit takes {seconds[quick]:.2g} s, and its error is "
        f"{span(error_ratio(own, quick, first))} times that of `{first}`.",
        f"- **If only a large library is known**: `{chooser}`. A fit takes {slower[chooser]:.2g} s, and its "
        f"error is {span(error_ratio(large, chooser, 'trajectory'))} times that of `trajectory`, which keeps all "
        f"terms. The error of `weak` is {span(error_ratio(large, 'weak', 'trajectory'))} times "
        f"that of `trajectory`, at {slower['weak']:.2g} s per fit.",
        f"- **The network** (`pinn-gn`) has {span(error_ratio(own, 'pinn-gn', first))} times the error of `{first}` "
        f"and takes {seconds['pinn-gn'] / seconds[first]:.1f} times as long.",
        f"- **Regression on derivatives** (`stlsq`) is fast, at {seconds['stlsq']:.2g} s per fit. With noise "
        f"its error is {span(error_ratio(own, 'stlsq', first))} times that of `{first}`; with pysindy's finite "
        f"differences, {span(error_ratio(own, 'stlsq-differences', first))} times. `sindy-tuned`, which chooses "
        f"optimiser, differentiation and settings from the samples, takes {seconds['sindy-tuned']:.2g} s per fit; its "
        f"error is {span(error_ratio(own, 'sindy-tuned', first))} times that of `{first}` and, with large libraries, "
        f"{span(error_ratio(large, 'sindy-tuned', chooser))} times that of `{chooser}`.",
        "- **A large library costs accuracy as well as time**: with every term kept, its bound is "
        f"{span(bounds)} times that of the lattice's own terms.",
    ]


def in_short(table: pd.DataFrame) -> str:
    """Write the section with the advice and the counts behind it."""
    noisy = table[table["noise"] > 0]
    base = noisy[noisy["part"] == "noise"]
    found = winners(noisy)
    groups = {
        "own terms, noise": found[found["own"] & (found["part"] == "noise")],
        "large libraries, noise": found[~found["own"]],
        "own terms, samples and sites": found[found["part"] != "noise"],
    }
    return "\n".join(
        [
            "## In short\n",
            *advice(base[base["own"]], base[~base["own"]]),
            "\nNumber of kinds of data, with noise, on which each method has the smallest median error, and on which "
            f"it is the fastest of those with a median error of at most {SERVES:g} times the smallest:\n",
            f"| | kinds of data | smallest error | fastest within {SERVES:g} times |",
            "|---|---|---|---|",
            *(
                f"| {name} | {len(group)} | {counted(group['best'])} | {counted(group['fastest'])} |"
                for name, group in groups.items()
            ),
            "",
        ]
    )


def page() -> str:
    """Return the text of which.md, made from cases.csv."""
    table = load(HERE)
    head = (HERE / "cases.csv").read_text(encoding="utf-8").splitlines()
    made = [line.removeprefix("# ") for line in head if line.startswith("# ")]
    # Settings and versions are at the head of the tables.
    made = [line for line in made if line.split(":")[0] in ("command", "commit", "date", "machine", "seeds")]
    parts = [
        "# Which method when\n",
        "Made by `python results/limits/which.py` from [cases.csv](cases.csv), a run of the suite `limits`: four "
        "lattices with known ends; noise, samples and sites are varied one at a time about 50 samples of 31 sites at "
        "1 % noise. The bound of each coefficient is in [limits.md](limits.md); "
        "[error-against-noise.png](error-against-noise.png) shows the errors.\n",
        in_short(table),
        own_terms(table),
        large_libraries(table),
        more_of(table, "samples"),
        more_of(table, "sites"),
        without_noise(table),
        forecasts(table),
        "".join(f"- {line}\n" for line in made),
    ]
    return "\n".join(parts)


if __name__ == "__main__":
    write_text(HERE / "which.md", page())
