"""Show how near the bound the methods come, from a run of the suite `efficiency`: efficiency.md.

    latticebench run efficiency
    latticebench table runs/efficiency --only cases --only summary --only errors --out results/efficiency
    python results/efficiency/efficiency.py

Every figure is computed from cases.csv beside this file. The efficiency is the bound over the root-mean-square of E2,
over the recordings of a lattice at one noise level (each in units of its own bound); a fit without a result counts as
an infinite error.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from latticebench.bench.publish import markdown_table
from latticebench.bench.published import read_head
from latticebench.bench.tables import counted, read_cases
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
PARTS = {
    "noise": "From the paper's initial states",
    "shaken": "From random initial states",
    "u alone": "Positions alone, from the paper's initial states",
}
# The method that the others are compared with, and how often the recordings are drawn anew for an interval.
FIRST = "trajectory"
DRAWS = 2000
TOLD = ("command", "commit", "date", "machine", "kernels", "seeds")


def load(path: Path = HERE / "cases.csv") -> pd.DataFrame:
    """Read the cases, with the lattice of each and E2 in units of the bound."""
    table = counted(read_cases(path))
    names = table["data"].str.split().str[0]
    table["lattice"] = names.str.removeprefix("systems/").str.removesuffix("-shaken.toml")
    table["ratio"] = table["e2"] / table["bound"]
    return table


def efficiency(ratios: pd.Series) -> float:
    """Return the efficiency over some recordings."""
    return float(1 / np.sqrt(np.mean(ratios**2)))


def interval(ratios: pd.Series) -> tuple[float, float]:
    """Return the 95 % interval of an efficiency, by a bootstrap over the recordings."""
    draw = np.random.default_rng(0)
    again = 1 / np.sqrt(np.mean(draw.choice(ratios.to_numpy() ** 2, (DRAWS, len(ratios))), axis=1))
    low, high = np.quantile(again, (0.025, 0.975))
    return float(low), float(high)


def measured(table: pd.DataFrame) -> pd.DataFrame:
    """Return the efficiency of each method by part, lattice and noise, its interval, and how it does beside FIRST.

    `beside` is the root-mean-square error over that of FIRST on the recordings that both have.
    """
    rows = []
    for (part, lattice, noise), here in table.groupby(["part", "lattice", "noise"], sort=False):
        wide = here.pivot(index=["data", "seed"], columns="method", values="ratio")
        for method, group in here.groupby("method", sort=False):
            both = wide[[FIRST, method]].dropna()
            low, high = interval(group["ratio"])
            rows.append({
                "part": part, "lattice": lattice, "noise": noise, "method": method, "n": len(group),
                "efficiency": efficiency(group["ratio"]), "low": low, "high": high,
                "beside": efficiency(both[FIRST]) / efficiency(both[method]), "covered": group["covered"].mean(),
                "seconds": group["cpu_seconds"].median(), "lost": int(np.sum(~(group["ratio"] < 10))),
            })  # fmt: skip
    return pd.DataFrame(rows)


def ends(values: pd.Series, scale: float = 1.0, digits: int = 2) -> str:
    """Return the least and the largest of some numbers."""
    return f"{scale * values.min():.{digits}f} to {scale * values.max():.{digits}f}"


def ranges(found: pd.DataFrame, part: str) -> pd.DataFrame:
    """Return the ranges of each method over lattices and noise levels."""
    own = found[found["part"] == part]
    return pd.DataFrame([
        {
            "method": method, "efficiency": ends(group["efficiency"]),
            f"error over that of `{FIRST}`, same recordings": ends(group["beside"]),
            "coefficients within their 95 % interval": f"{ends(group['covered'], 100, 0)} %",
            "processor seconds, median": f"{group['seconds'].median():.2g}", "lost": int(group["lost"].sum()),
        }
        for method, group in own.groupby("method", sort=False)
    ])  # fmt: skip


def section(found: pd.DataFrame, part: str) -> str:
    """Write the section on one part of the suite."""
    own = found[found["part"] == part]
    shown = own.assign(
        noise=[f"{100 * level:g} %" for level in own["noise"]],
        cell=[
            f"{middle:.2f} [{low:.2f}, {high:.2f}] n={count}"
            for middle, low, high, count in zip(own["efficiency"], own["low"], own["high"], own["n"], strict=True)
        ],
    )
    order = shown[["lattice", "noise"]].drop_duplicates()
    wide = shown.pivot(index=["lattice", "noise"], columns="method", values="cell")
    wide = wide.reindex(index=pd.MultiIndex.from_frame(order), columns=list(dict.fromkeys(shown["method"])))
    tables = (ranges(found, part), wide.reset_index())
    return f"## {PARTS[part]}\n\n" + "".join(f"{markdown_table(table)}\n\n" for table in tables)


def page() -> str:
    """Return the text of efficiency.md, made from cases.csv beside this file."""
    found = measured(load())
    told = read_head(HERE / "cases.csv")
    about = "".join(
        f"- {name}: {told[name]}\n" for name in ("command", "commit", "date", "machine", "kernels", "seeds")
    )
    parts = [section(found, part) for part in PARTS]
    return (
        "# How near the bound\n\n"
        "Made by `python results/efficiency/efficiency.py` from [cases.csv](cases.csv), a run of the suite "
        "`efficiency`. Efficiency: the Cramer-Rao bound over the root-mean-square of E2; 1 is the best that an "
        "unbiased method can reach on average. [...]: 95 %, bootstrap over the n recordings; lost: E2 more than 10 "
        "times the bound.\n\n" + "".join(parts) + about
    )


if __name__ == "__main__":
    write_text(HERE / "efficiency.md", page())
