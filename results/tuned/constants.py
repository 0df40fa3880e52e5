"""Choose the two constants of the criterion by which the tuned methods choose their models, and write constants.md.

    python results/tuned/constants.py

Methods that are tuned by the samples judge models by the equation integrated over windows
(`methods.engine.integrated_equation`): SPAN is the length of a window, PRICE what a term costs. Both are chosen here,
on lattices of which none is in the benchmark, from states that it does not have. Each of these lattices is simulated
from two states, sampled 50 times densely from one and sparsely from the other; `sindy-tuned` makes its models of the
samples at each level of noise; and each pair of constants chooses among them. Only here the truth is in view: E2 of the
model chosen over that of the best model there is, and whether its support is right.

The pair with the least geometric mean of that ratio, each ratio counted as at most WORST, is taken.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from latticebench import methods
from latticebench.bench.provenance import describe, origin
from latticebench.bench.publish import render
from latticebench.methods.engine.integrated_equation import PRICE, SPAN, integrate_equation
from latticebench.systems.files import write_text
from latticebench.systems.lattice import Initial, System, library
from latticebench.systems.simulate import observe, sample_times, simulate

HERE = Path(__file__).parent
SPANS = (0.35, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
PRICES = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
NOISE = (0.0, 0.001, 0.01, 0.05)
# Of the recordings, in units of time.
LENGTHS = (8.0, 20.0)
# A model that is so many times worse than the best is as bad as any.
WORST = 10.0
WAVES = "0.9*sin(0.5*x+draw)+0.6*cos(1.1*x+2*draw)"
PUSH = "0.7*cos(0.8*x+3*draw)"
SPRINGS = "u[n+1]+u[n-1]-2*u[n]"
TODA = "exp(u[n-1]-u[n])-exp(u[n]-u[n+1])"
CUBIC, SQUARE = (f"(u[n+1]-u[n])**{power}-(u[n]-u[n-1])**{power}" for power in (3, 2))
NEXT = "abs(u[n])**2*(u[n+1]+u[n-1])"
# Of each lattice the equation, the candidate terms, the order, and whether it is complex.
LATTICES = {
    "fput": (f"{SPRINGS}+0.8*({CUBIC})", f"{SPRINGS}; {CUBIC}; {SQUARE}; u[n]; u[n]**3; v[n]", 2, False),
    "toda": (TODA, f"{TODA}; {SPRINGS}; u[n]; {SQUARE}; v[n]", 2, False),
    "morse": (
        f"0.6*({SPRINGS})+2*(exp(-2*u[n])-exp(-u[n]))",
        f"{SPRINGS}; exp(-2*u[n]); exp(-u[n]); v[n]; u[n+2]-u[n-2]", 2, False,
    ),
    "van-der-pol": (
        f"0.5*({SPRINGS})-u[n]+0.8*v[n]-0.8*u[n]**2*v[n]",
        f"{SPRINGS}; u[n]; v[n]; u[n]**2*v[n]; u[n]**3; v[n]**3", 2, False,
    ),
    "nagumo": (
        f"0.4*({SPRINGS})-0.3*u[n]+1.3*u[n]**2-u[n]**3",
        f"{SPRINGS}; u[n]; u[n]**2; u[n]**3; 1; (u[n+1]-u[n-1])/2", 1, False,
    ),
    "ablowitz-ladik": (
        f"i*0.7*({SPRINGS})+i*0.5*{NEXT}",
        f"i*({SPRINGS}); {SPRINGS}; i*{NEXT}; i*abs(u[n])**2*u[n]; abs(u[n])**2*u[n]; i*u[n]; u[n]", 1, True,
    ),
}  # fmt: skip


def lattices() -> Iterator[System]:
    """Return the lattices to choose on."""
    for name, (equation, terms, order, is_complex) in LATTICES.items():
        start = Initial(f"{WAVES}+i*{PUSH}" if is_complex else WAVES, PUSH if order == 2 else "0")
        yield System(
            name, name, equation, order, is_complex, {"draw": 1.0}, {"waves": start},  # type: ignore[arg-type]
            (library("all", terms),), "textbooks; state and numbers are this project's", sites=12,
        )  # fmt: skip


def measure(systems: Iterator[System]) -> pd.DataFrame:
    """Return one row per lattice, state, noise, span and price: the ratio of the errors, and whether it is right."""
    method = methods.find("sindy-tuned")()
    rows = []
    for number, system in enumerate(systems):
        terms = system.libraries[0]
        for draw, length in enumerate(LENGTHS, start=1):
            clean = simulate(system, parameters={"draw": float(draw)}, times=sample_times(50, length))
            truth = clean.truth(terms)
            assert truth is not None
            for noise in NOISE:
                data = [observe(clean, np.random.default_rng([number, draw]), noise=noise).observed()]
                models = [one.coefficients for one in method.search(data, terms, system.order, 1)]  # type: ignore[attr-defined]
                errors = [float(np.linalg.norm(one - truth)) for one in models]
                for span in SPANS:
                    judge = integrate_equation(data, terms, system.order, span)
                    for price in PRICES:
                        best = int(np.nanargmin(judge.bic(models, price)))
                        right = np.array_equal(models[best] != 0, truth != 0)
                        rows.append((system.name, draw, noise, span, price, errors[best] / min(errors), right))
    return pd.DataFrame(rows, columns=["system", "draw", "noise", "span", "price", "ratio", "right"])


def means(table: pd.DataFrame) -> pd.DataFrame:
    """Return one row per span and price: the geometric mean of the ratios, and the share of right supports."""
    capped = table.assign(ratio=np.log(table["ratio"].clip(upper=WORST)))
    found = capped.groupby(["span", "price"], as_index=False)[["ratio", "right"]].mean()
    return found.assign(ratio=np.exp(found["ratio"]))


def chosen(table: pd.DataFrame) -> tuple[float, float]:
    """Return the span and the price of the least mean ratio."""
    best = means(table).sort_values("ratio", kind="stable").iloc[0]
    return float(best["span"]), float(best["price"])


if __name__ == "__main__":
    found = measure(lattices())
    about = describe([origin()], {"command": "python results/tuned/constants.py"})
    write_text(HERE / "constants.csv", render(means(found), about, "csv"))
    write_text(HERE / "constants.md", render(means(found), about, "md"))
    print(f"span {chosen(found)[0]:g}, price {chosen(found)[1]:g}; in use: {SPAN:g}, {PRICE:g}", file=sys.stderr)
