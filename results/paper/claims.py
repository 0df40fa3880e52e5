"""Test the paper's remarks on a run of the suite `paper`, and write claims.md.

    latticebench run paper --results runs/paper
    latticebench table runs/paper --out results/paper
    python results/paper/claims.py runs/paper    # learning.csv and claims.md
    python results/paper/claims.py               # claims.md again, from the tables beside it

Every figure is computed from cases.csv, coefficients.csv and learning.csv beside this file. The last holds, per library
and initial state, how many steps the network `pinn` needed (to two digits: an error is recorded every 100 steps).
Where a method has several seeds, figures are medians over them. The verdict on a remark follows from the figures by a
rule in the function of that remark.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from latticebench.bench.fitting import FitCase, exact_regression, samples
from latticebench.bench.publish import render
from latticebench.bench.store import open_store
from latticebench.bench.suite import load
from latticebench.bench.tables import ABOUT, read_cases, shown_truth
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
# A fit is right if its E2 is at most this.
RIGHT = 0.05
# A network has learnt the coefficients when their error stays below this.
LEARNT = 0.1
NETWORKS = ("pinn", "pinn-gn", "pielm")
IN_MOTION = ("1a", "1b", "motion")


@dataclass(frozen=True)
class Tables:
    """The tables of a run: one row per method (medians over seeds), per coefficient and seed, per learning curve."""

    cases: pd.DataFrame
    coefficients: pd.DataFrame
    learning: pd.DataFrame


@dataclass(frozen=True)
class Judgement:
    """What the figures say of a remark: "holds" or not, the figures that decide, and the table that they are from."""

    verdict: str
    text: str
    table: pd.DataFrame


def learning(results: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Return how many sites each initial state of phi^4 sets in motion, and how many steps `pinn` needed.

    The number of sites in motion is the participation number (sum e)^2 / sum e^2 with e_n the mean of v_n^2 over time.
    """
    found = []
    for result in results:
        case = FitCase.of(result["case"])
        if case.part not in IN_MOTION or case.label != "pinn" or result["history"] is None:
            continue
        clean = samples(case, Path())[0]
        assert clean.v is not None
        energy = np.mean(clean.v**2, axis=0)
        moving = float(np.sum(energy) ** 2 / np.sum(energy**2)) if np.any(energy) else 0.0
        truth = np.array(list(result["truth"].values()))
        curve = np.linalg.norm(np.array(result["history"]["coefficients"]) - truth, axis=1) / np.linalg.norm(truth)
        late = np.flatnonzero(curve > LEARNT)
        after = int(late[-1]) + 1 if len(late) else 0
        steps = float(result["history"]["step"][after]) if after < len(curve) else np.inf
        start = case.initial or f"kink, v = {case.parameters.get('v', 0):g}"
        found.append([case.data, case.library, start, moving, float(f"{steps:.2g}")])
    return pd.DataFrame(found, columns=["data", "library", "start", "sites in motion", "steps"])


def over_seeds(table: pd.DataFrame) -> pd.DataFrame:
    """Return the medians of a table of cases over its seeds, with their number."""
    groups = table.groupby([*ABOUT, "method"], sort=False, dropna=False)
    return groups.median(numeric_only=True).assign(seeds=groups.size()).reset_index()


# The remarks ----------------------------------------------------------------------------------------------------------


def of_parts(table: pd.DataFrame, *parts: str) -> pd.DataFrame:
    """Return the rows of some parts of the suite."""
    return table[table["part"].isin(parts)]


def even_terms(run: Tables) -> Judgement:
    """Judge whether even-ordered terms need the mirrored data: it holds if `pinn` is right only with them."""
    chosen = of_parts(run.cases, "even")
    alone = chosen[chosen["library"] == "lib2-even"]
    network = alone[~alone["data"].str.contains("with -u")].set_index("method")["e2"]
    least = alone[alone["method"] == "least-squares"]["e2"]
    without, mirrored = float(network["pinn"]), float(network["pinn-mirror"])
    text = (
        f"E2 with the even terms in the library: of the network, {without:.1e} without the mirrored data and "
        f"{mirrored:.1e} with them (a factor of {without / mirrored:.2g}); of least squares, {least.iloc[0]:.1e} "
        f"without and {least.iloc[-1]:.1e} with them."
    )
    columns = ["data", "library", "method", "seeds", "e2", "spurious", "tpr", "conditioning", "cpu_seconds"]
    return Judgement("holds" if without > RIGHT >= mirrored else "does not hold", text, chosen[columns])


def motion(run: Tables) -> Judgement:
    """Judge whether more sites in motion mean faster learning, by the rank correlation of the two."""
    pinn = of_parts(run.cases, *IN_MOTION)
    pinn = pinn[pinn["method"] == "pinn"][["data", "library", "conditioning", "e2"]]
    table = run.learning.merge(pinn, on=["data", "library"]).sort_values(["library", "sites in motion"])
    ranks = [group.rank(numeric_only=True).corr()["steps"] for _, group in table.groupby("library")]
    mean = pd.concat(ranks, axis=1).mean(axis=1)
    by_motion = mean["sites in motion"]
    verdict = "holds" if by_motion <= -0.5 else ("holds only in part" if by_motion <= -0.2 else "does not hold")
    text = (
        "The number of sites in motion is (sum e)^2 / sum e^2 with e_n the mean of v_n^2 over time. Rank correlation "
        f"between the steps needed and the sites in motion: {by_motion:.2f}; between the steps and the conditioning: "
        f"{mean['conditioning']:.2f} (means over the two libraries, five initial states each)."
    )
    table = table.rename(columns={"steps": f"steps to E2 <= {LEARNT}"})
    columns = ["library", "start", "sites in motion", "conditioning", f"steps to E2 <= {LEARNT}", "e2"]
    return Judgement(verdict, text, table[columns])


def size(run: Tables) -> Judgement:
    """Judge whether the lattice size does not matter: it holds if every fit from 20 to 31 sites is right."""
    chosen = of_parts(run.cases, "size", "1b")
    chosen = chosen[chosen["method"].isin([*NETWORKS, "least-squares"])].sort_values(["method", "data"])
    worst = float(chosen["e2"].max())
    spread = chosen.groupby("method")["e2"].agg(lambda e2: e2.max() / e2.min())
    text = f"Worst E2 from 20 to 31 sites: {worst:.1e}. Largest over smallest E2: " + ", ".join(
        f"`{name}` {value:.2g}" for name, value in spread.items()
    )
    columns = ["data", "method", "seeds", "e2", "conditioning", "cpu_seconds"]
    return Judgement("holds" if worst <= RIGHT else "does not hold", text + ".", chosen[columns])


def imaginary(run: Tables) -> Judgement:
    """Judge whether DNLS coefficients come out imaginary: it holds if the real parts of the networks are small."""
    panels = ("2a", "2b", "3a", "3b")
    chosen = of_parts(run.coefficients, *panels)
    keys = [*ABOUT, "method"]
    found = chosen[~chosen["method"].map(shown_truth)].assign(
        real=lambda table: table["coefficient"].abs().where(~table["term"].str.startswith("i*"), 0.0)
    )
    groups = found.groupby([*keys, "seed"], sort=False)
    norms = groups["coefficient"].agg(lambda values: float(np.linalg.norm(values)))
    each = pd.DataFrame({"largest real part": groups["real"].max()})
    each["share"] = each["largest real part"] / norms
    scores = of_parts(run.cases, *panels)[[*keys, "e2", "conditioning"]]
    table = each.groupby(keys, sort=False).max().reset_index().merge(scores, on=keys)
    worst = {name: float(table.loc[table["method"] == name, "share"].max()) for name in NETWORKS}
    text = "Largest real part of any coefficient and seed, as a share of the norm of all coefficients: " + ", ".join(
        f"`{name}` at most {value:.1e}" for name, value in worst.items()
    )
    table = table.rename(columns={"part": "panel"})
    columns = ["panel", "method", "largest real part", "share", "e2", "conditioning"]
    return Judgement("holds" if max(worst.values()) <= RIGHT else "does not hold", text + ".", table[columns])


def complex_coefficients(run: Tables) -> Judgement:
    """Judge whether complex coefficients come out right: it holds if every fit of the networks is right."""
    chosen = of_parts(run.cases, "4a", "4b", "larger")
    networks = chosen[chosen["method"].isin(NETWORKS)]
    worst = networks.loc[networks["e2"].idxmax()]
    text = f"Worst E2 of the networks: {worst['e2']:.1e} (`{worst['method']}`, library `{worst['library']}`)."
    columns = [*ABOUT, "method", "seeds", "e2", "spurious", "tpr", "conditioning", "cpu_seconds"]
    return Judgement("holds" if worst["e2"] <= RIGHT else "does not hold", text, chosen[columns])


def sines(run: Tables) -> Judgement:
    """Judge whether sines are found and the initial state decides; it holds in part if they are found anyway."""
    chosen = of_parts(run.cases, "5a", "5b", "5c", "initial")
    e2 = chosen.set_index(["method", "part", "library"])["e2"]
    right = e2["pinn"] <= RIGHT
    found = right["5a", "sines"]
    decides = right["5c", "mixed"] != right["initial", "mixed"] or found != right["initial", "sines"]

    def errors(part: str, library: str) -> str:
        own, other = (", ".join(f"{e2[name, one, library]:.1e}" for name in NETWORKS) for one in (part, "initial"))
        return f"{own} from the kink of sine-Gordon, {other} from the kink of phi^4"

    text = (
        f"E2 of {', '.join(f'`{name}`' for name in NETWORKS)} with the sines: {errors('5a', 'sines')}. With the mixed "
        f"library: {errors('5c', 'mixed')}. The conditioning shows why: below |u| = 1.3 powers and sines are nearly "
        "the same functions.\n\n"
        "The equation has no truth in powers alone. Their fits from the kink of sine-Gordon, beside least squares on "
        f"the exact derivative of the noise-free state:\n\n{markdown(powers(run))}"
    )
    verdict = "holds" if found and decides else ("holds only in part" if found else "does not hold")
    columns = [*ABOUT, "method", "seeds", "e2", "residual", "conditioning", "cpu_seconds"]
    return Judgement(verdict, text, chosen[columns])


def powers(run: Tables) -> pd.DataFrame:
    """Compare the fits of panel (5b), coefficient by coefficient, with least squares on the exact derivative."""
    case = next(case for case in load("paper").cases if isinstance(case, FitCase) and case.part == "5b")
    _, library = case.resolve(Path())
    exact = exact_regression(samples(case, Path()), library).least_squares()
    found = {"exact least squares": exact}
    for name, group in of_parts(run.coefficients, "5b").groupby("method", sort=False):
        found[str(name)] = group.groupby("term")["coefficient"].median().loc[list(library.texts)].to_numpy()
    table = pd.DataFrame({"method": list(found)})
    for column, term in enumerate(library.texts):
        table[f"`{term}`"] = [f"{values[column]:.4g}" for values in found.values()]
    table["distance"] = [np.linalg.norm(values - exact) / np.linalg.norm(exact) for values in found.values()]
    return table


@dataclass(frozen=True)
class Remark:
    """A remark of the paper: a title, what the paper says, and the function that judges it."""

    title: str
    paper: str
    judge: Callable[[Tables], Judgement]


REMARKS = (
    Remark(
        "Even-ordered terms need the mirrored data",
        "libraries with quadratic and quartic terms are learnt only with both u and -u (section 4.3)",
        even_terms,
    ),
    Remark(
        "More sites in motion mean faster learning",
        "initial states that set more sites in motion lead to faster learning (section 4)",
        motion,
    ),
    Remark(
        "The lattice size does not matter",
        "between 20 and 31 sites the results do not change in a dramatic way (section 4)",
        size,
    ),
    Remark(
        "DNLS coefficients come out purely imaginary",
        "the real parts converge to zero: the scheme detects that the model conserves (section 4.3)",
        imaginary,
    ),
    Remark(
        "Ginzburg-Landau's complex coefficients come out right",
        "also with the libraries of ten and nine terms, and with next-to-next neighbours (section 4.3)",
        complex_coefficients,
    ),
    Remark(
        "Sines are found, powers approximate, the mixed library competes",
        "the initial state decides which library works (section 4.3)",
        sines,
    ),
)


# The page -------------------------------------------------------------------------------------------------------------


def markdown(table: pd.DataFrame) -> str:
    """Return a table as Markdown, numbers with two digits."""
    return render(table, {}, "md").rstrip()


def head(path: Path) -> list[str]:
    """Return the lines at the head of a table that say where it comes from."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [line.removeprefix("# ") for line in lines if line.startswith("# ")]


def page() -> str:
    """Return the text of claims.md, made from the tables beside this file."""
    coefficients, learnt = (pd.read_csv(HERE / f"{name}.csv", comment="#") for name in ("coefficients", "learning"))
    steps = learnt.groupby(["data", "library", "start", "sites in motion"], sort=False)["steps"].median().reset_index()
    run = Tables(over_seeds(read_cases(HERE / "cases.csv")), coefficients, steps)
    verdicts = [remark.judge(run) for remark in REMARKS]
    return "\n".join(
        [
            "# The paper's remarks, tested on a run\n",
            "Made by `python results/paper/claims.py` from a run of the suite `paper`. A fit is right if E2 <= "
            f"{RIGHT}. `pinn` is the paper's network, `pinn-gn` a trained one at its best, `pielm` one whose hidden "
            "units are drawn; all methods saw the same samples. Figures are medians over `seeds`. conditioning: the "
            "ratio of the largest to the smallest singular value of the library's columns on the samples, each scaled "
            "to length 1.\n",
            "| remark | verdict |",
            "|---|---|",
            *(f"| {remark.title} | {one.verdict} |" for remark, one in zip(REMARKS, verdicts, strict=True)),
            "",
            *(
                f"## {remark.title}: {one.verdict}\n\nThe paper: {remark.paper}.\n\n{one.text}\n\n"
                f"{markdown(one.table)}\n"
                for remark, one in zip(REMARKS, verdicts, strict=True)
            ),
            "".join(f"- {line}\n" for line in head(HERE / "cases.csv")),
        ]
    )


def main() -> None:
    """Write learning.csv if a store is given on the command line, and claims.md."""
    if len(sys.argv) > 1:
        results, expected = open_store(Path(sys.argv[1])).results(history=True), len(load("paper").cases)
        if len(results) != expected:
            raise SystemExit(f"the store has {len(results)} of the suite's {expected} results; finish the run first")
        write_text(HERE / "learning.csv", learning(results).to_csv(index=False))
    write_text(HERE / "claims.md", page())


if __name__ == "__main__":
    main()
