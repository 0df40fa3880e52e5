"""Fit a tenth of the published cases again under several kernels of OpenBLAS: kernels.csv and kernels.md.

    python results/default/kernels.py

A kernel adds up in another order, so it changes the last digits of every sum. A method that is stable shows the same
error; one whose training is long enough to be chaotic shows another draw of its own scatter, which its seeds measure.
The cases are drawn method by method from cases.csv beside this file. Each kernel has a process of its own, since
OpenBLAS chooses when it is loaded. A kernel that the processor cannot run, or that OpenBLAS does not have, is refused.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from latticebench.bench.case import Folders
from latticebench.bench.fitting import FitCase
from latticebench.bench.provenance import origin
from latticebench.bench.publish import markdown_table, render
from latticebench.bench.published import read_head
from latticebench.bench.tables import read_cases
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
# Those of processors without and with 256 and 512 bit wide instructions.
KERNELS = ("Nehalem", "Haswell", "SkylakeX")
SHARE = 0.1
SEED = 1
# Errors below this are rounding, whose size no table tells.
ROUNDING = 1e-13
# A change of E2 that no published digit shows, mostly.
SHOWN = 0.005


def chosen() -> pd.DataFrame:
    """Draw a tenth of the published cases of each method that have an error; `zero` computes nothing."""
    table = read_cases(HERE / "cases.csv")
    table = table[(table["status"] == "ok") & table["e2"].notna() & (table["method"] != "zero")]
    draw = np.random.default_rng(SEED)
    rows = [
        np.sort(draw.choice(group.index, math.ceil(SHARE * len(group)), replace=False))
        for _, group in table.groupby("method", sort=False)
    ]
    return table.loc[np.concatenate(rows)]


def errors(identities: list[str]) -> list[float]:
    """Fit cases in this process; return their E2."""
    found = []
    for text in identities:
        identity = json.loads(text)
        case = FitCase.of({**identity, "label": identity["method"]})
        result = case.blank()
        case.run(Folders(), result)
        found.append(float(result["e2"]))
    return found


def under(kernel: str, identities: list[str]) -> list[float]:
    """Fit cases in a process with one kernel; return their E2.

    Raises:
        SystemExit: OpenBLAS took another kernel.
    """
    environment = {**os.environ, "OPENBLAS_CORETYPE": kernel, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, __file__, "--worker"], input=json.dumps(identities), env=environment, text=True,
        stdout=subprocess.PIPE, check=True,
    )  # fmt: skip
    answer: dict[str, Any] = json.loads(done.stdout)
    if answer["kernels"] != [kernel]:
        raise SystemExit(f"OpenBLAS took {', '.join(answer['kernels'])} where {kernel} was asked for")
    return list(answer["errors"])


def work() -> None:
    """Fit the cases that standard input names, and write their errors and the kernels in use."""
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_info

    found = errors(json.load(sys.stdin))
    used = sorted({str(one.get("architecture")) for one in threadpool_info() if one["user_api"] == "blas"})
    json.dump({"errors": found, "kernels": used}, sys.stdout)


def spread(table: pd.DataFrame) -> pd.DataFrame:
    """Add the least and the largest error that was published over the seeds of each case."""
    published = read_cases(HERE / "cases.csv")
    groups = published[published["status"] == "ok"].groupby(["data", "library", "method"])["e2"]
    ends = groups.agg(least="min", largest="max", seeds="count").reset_index()
    return table.merge(ends, on=["data", "library", "method"], how="left")


def compared(table: pd.DataFrame) -> pd.DataFrame:
    """Return how far the errors of each method change with the kernel, and how many stay within the seeds' spread.

    The kernel that the published run had is left out: there the errors are the same ones.
    """
    published = read_head(HERE / "cases.csv")["kernels"]
    others = [kernel for kernel in KERNELS if kernel not in published]
    long = table.melt(
        ["data", "library", "method", "seed", "published", "least", "largest", "seeds"], others, "kernel", "e2"
    )
    rows = []
    for method, group in long.groupby("method", sort=False):
        change = np.abs(group["e2"] / group["published"] - 1).where(group["e2"] > ROUNDING, 0.0)
        inside = (change <= SHOWN) | group["e2"].between(group["least"] * (1 - SHOWN), group["largest"] * (1 + SHOWN))
        rows.append((
            method, group["data"].add(group["library"]).add(group["seed"].astype(str)).nunique(), len(group),
            int(group["seeds"].max()), float(change.median()), float(change.max()), int(inside.sum()),
        ))  # fmt: skip
    columns = ["method", "cases", "fits", "seeds", "median change", "largest change", "covered"]
    return pd.DataFrame(rows, columns=columns)


def page() -> str:
    """Return the text of kernels.md, made from kernels.csv and cases.csv beside this file."""
    head = read_head(HERE / "kernels.csv")
    table = pd.read_csv(HERE / "kernels.csv", comment="#")
    about = "".join(f"- {name}: {told}\n" for name, told in head.items())
    columns = ["data", "library", "method", "seed", "published", *KERNELS]
    return (
        "# The published cases under three kernels\n\n"
        "Made by `python results/default/kernels.py`: a tenth of the cases of each method, drawn with a seed, fitted "
        f"again under the kernels {', '.join(KERNELS)} of OpenBLAS. change: of E2, as a share of the published one; "
        f"covered: fits whose E2 is the published one to {100 * SHOWN:g} %, is rounding (below {ROUNDING:g}), or lies "
        "between the least and the largest of the published seeds. (Of fits with a new seed beside n others, "
        "(n - 1) / (n + 1) would lie there: of n + 1 draws two are the ends.) The kernel of the published run is left "
        "out of the first table.\n\n"
        f"{markdown_table(compared(table))}\n\nE2 of each case:\n\n{markdown_table(table[columns])}\n\n{about}"
    )


def main() -> None:
    """Fit the cases under each kernel and write the two files."""
    about = {"command": "python results/default/kernels.py", **origin(), "kernels": ", ".join(KERNELS)}
    table = chosen()
    made = pd.DataFrame({name: table[name] for name in ("data", "library", "method", "seed")})
    made["published"] = table["e2"]
    for kernel in KERNELS:
        made[kernel] = under(kernel, table["identity"].tolist())
    write_text(HERE / "kernels.csv", render(spread(made), about, "csv"))
    write_text(HERE / "kernels.md", page())


if __name__ == "__main__":
    work() if "--worker" in sys.argv else main()
