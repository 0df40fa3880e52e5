"""Measure which method's residual gives the best diagnosis, and write residuals.csv and residuals.md.

    python results/loop/residuals.py
    python results/loop/residuals.py --page    # the page again, from residuals.csv

A trial is a simulated recording with one force that the declared equation lacks. Each method fits the declared
equation, and its residual r is regressed on what each effect of the catalogue would add to it. A force s(n, t) along
the method's own state becomes a column R s, where the linear map R depends on the method:

    trajectory   r: the readings less the shooting fit, in units of the noise;
                 R: the response of the readings to a force (`diagnosis.tangent`)
    weak         r: the residual of the weak equations; R: integrals over the test functions;
                 both whitened with the covariance of the weak equations
    splines,     r = d^order u/dt^order - F(u, v; xi) along the method's curves; R = 1;
    pinn-vp      both averaged over stretches of time so long that the means count as independent

A stretch is one correlation time of r, dt (1 + 2 sum of the autocorrelation up to its first zero), pooled over the
sites. The first and the last stretch are left out, since derivatives are least accurate at the ends. Correlations
between sites are ignored.

Everything else is the same for all methods (`diagnosis.trace`): the ways in which an effect may act, and the
projection that removes the columns of the declared terms. With U an orthonormal basis of the columns of a way of
acting, and nu the number of rows less that of the declared terms (and, for the trajectory, of the initial state), the
gain is

    -nu ln(1 - |U^T r|^2 / |r|^2),

twice the log likelihood ratio with the size of the noise fitted. Effects are ranked by their evidence: -ln of the upper
tail probability of chi squared at the gain, less the cost of the search.
"""

from __future__ import annotations

import itertools
import sys
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as File

import numpy as np
import pandas as pd
from numpy import ndarray
from scipy.stats import binomtest

from latticebench import methods, systems
from latticebench.bench.provenance import lines, origin
from latticebench.bench.publish import format_number, render
from latticebench.bench.trials import faults, specimen
from latticebench.bench.trials.trial import OFF_SIZE
from latticebench.diagnosis import trace
from latticebench.diagnosis.catalogued import candidates_of
from latticebench.diagnosis.model import Fitted, Model, first_fit
from latticebench.diagnosis.tangent import Path, Tangent, linearise, orthonormal, own_forces
from latticebench.methods.engine.errors_in_variables import ROUNDS, estimate
from latticebench.methods.engine.shooting import Solution, State
from latticebench.methods.engine.weak_form import ACCURACY, WeakForm, linearised
from latticebench.methods.method import Smooth, solve
from latticebench.systems.effects import CATALOGUE, INSTRUMENT, find
from latticebench.systems.errors import InputError
from latticebench.systems.files import write_text
from latticebench.systems.lattice import System
from latticebench.systems.samples import Samples

HERE = File(__file__).parent
SYSTEMS = ("phi4", "sine-gordon", "dnls", "ginzburg-landau")
SIZES = (10.0, 30.0)
SEEDS = (1,)
CANDIDATES = tuple(effect for effect in CATALOGUE if effect.acts not in INSTRUMENT)
# Two effects whose evidence differs by less than EQUAL nats are not told apart; by less than TIE, they are the same.
EQUAL = 3.0
TIE = 1e-6
SURROGATES = 100
NOISE = 0.01
# The slowest method is given every third trial.
SLOW = "pinn-vp"
# A residual along curves is averaged over at least this many stretches.
LEAST_STRETCHES = 6
SCORES = {"first": "ranked first", "two": "within the first two", "near": f"within {EQUAL:g} nats of the first"}


@dataclass(frozen=True, eq=False)
class Along(Path):
    """The state that a method estimated, with the method's own map from forces to rows of its residual.

    Attributes:
        project: from forces (columns, F, parts, N) to rows (rows, columns).
    """

    project: Callable[[ndarray], ndarray]

    def answer(self, source: ndarray) -> ndarray:
        """Return what forces add to the residual, one column per force."""
        return self.project(source)


def along(
    model: Model,
    samples: Samples,
    times: ndarray,
    field: ndarray,
    coefficients: ndarray,
    project: Callable[[ndarray], ndarray],
    residual: ndarray | None = None,
    rate: ndarray | None = None,
) -> Tangent:
    """Return a method's residual as a tangent, so that it can be traced as that of a trajectory is.

    Args:
        model: the declared equation.
        samples: what was fitted.
        times: times of the state (F,).
        field: u and, for order 2, v (F, order, parts, N).
        coefficients: xi of the declared terms.
        project: see `Along`.
        residual: the rows (rows,); if None, `rate` less the declared terms, projected.
        rate: the highest derivative (F, parts, N); needed if `residual` is None.
    """
    (record,) = model.records([samples])
    none = np.zeros((0, 0, 0))
    path = Along(record, times, 1, field, none, none, none, none, None, project)
    declared = own_forces(path)
    if residual is None:
        assert rate is not None
        residual = project((rate - np.tensordot(coefficients, declared, (0, 0)))[None])[:, 0]
    rows = len(residual)
    path = replace(path, weight=np.ones((rows, 1, 1, 1)), own=np.zeros((rows, 0)))
    jacobian = project(declared)
    known = orthonormal(jacobian)
    count, one = np.array([float(rows)]), np.ones(1)
    state = State(coefficients, (field[:, :, 0].reshape(len(times), -1),), (None,))
    solution = Solution(state, one, np.eye(len(coefficients)), one, count, len(coefficients), True, ())
    left = residual - known @ (known.T @ residual)
    return Tangent(Fitted(model, (samples,), (record,), solution), (path,), left, residual, known, jacobian)


def by_trajectory(model: Model, samples: Samples) -> Tangent:
    """Return the tangent of the readings less the shooting fit."""
    return linearise(first_fit(model, [samples]))


def by_weak(model: Model, samples: Samples) -> Tangent:
    """Return the tangent of the whitened residual of the weak equations; no declared term is dropped."""
    form = WeakForm(samples, model.declared, model.order)
    found = estimate([form], np.ones(len(model.declared.terms), dtype=bool), ROUNDS)
    accuracy = ACCURACY * float(np.sqrt(np.mean(form.rows(form.state.seen)[0] ** 2)))
    target, design, _, covariance = linearised(form, found.states[0], found.coefficients, accuracy)

    def project(source: ndarray) -> ndarray:
        integrals = np.einsum("kg,cgps->spkc", form.tests[0], source[..., form.sites], optimize=True)
        return covariance.whiten(integrals.reshape(-1, form.count, len(source)))

    fields = form.fields(found.states[0])[: model.order]
    parts = np.stack([np.stack([one.real, one.imag][: form.parts], axis=1) for one in fields], axis=1)
    left = covariance.whiten(target - design @ found.coefficients)[:, 0]
    return along(model, samples, form.grid, parts, found.coefficients, project, left)


def by_curves(name: str) -> Callable[[Model, Samples], Tangent]:
    """Return the function that makes the tangent of the derivative less the declared terms, along a method's curves."""

    def make(model: Model, samples: Samples) -> Tangent:
        fit = solve(methods.find(name)(), [samples], model.declared, model.order, 1)
        if fit.smooth is None:
            raise InputError(f"{name}: {fit.status}")
        (curves,) = fit.smooth
        field, rate = np.moveaxis(curves.levels[:-1], 0, 1), curves.levels[-1]
        given = (model, samples, curves.times, field, fit.coefficients)
        plain = along(*given, lambda source: source.reshape(len(source), -1).T, None, rate)
        return along(*given, stretches(plain.residual.reshape(rate.shape), curves), None, rate)

    return make


def stretches(residual: ndarray, curves: Smooth) -> Callable[[ndarray], ndarray]:
    """Return the map to means over stretches of time, each one correlation time of a residual (Q, parts, N) long."""
    series = residual.reshape(len(residual), -1)
    inner = series - series.mean(axis=0)
    products = [float(np.sum(inner[k:] * inner[: len(inner) - k])) for k in range(len(inner) // 2)]
    alike = np.array(products) / products[0]
    last = int(np.argmax(alike <= 0)) if np.any(alike <= 0) else len(alike)
    count = int(np.clip(len(series) / (1 + 2 * np.sum(alike[1:last])), LEAST_STRETCHES, len(series)))
    begin = np.cumsum(curves.share) - curves.share / 2
    number = np.minimum((begin * count).astype(int), count - 1)
    means = np.stack([curves.share * (number == k) for k in range(1, count - 1)]) * count
    return lambda source: np.einsum("kq,cqps->kpsc", means, source, optimize=True).reshape(-1, len(source))


METHODS: dict[str, Callable[[Model, Samples], Tangent]] = {
    "trajectory": by_trajectory, "weak": by_weak, "splines": by_curves("splines"), "pinn-vp": by_curves("pinn-vp"),
}  # fmt: skip


def findings(tangent: Tangent) -> list[trace.Screened]:
    """Rank the effects of the catalogue that are forces by their evidence, the best first."""
    groups = [(effect.name, True, candidates_of(tangent, effect)) for effect in CANDIDATES]
    return trace.rank(tangent, [one for one in groups if one[2]], np.random.default_rng(1), SURROGATES)


def effects(system: System) -> list[str]:
    """Return the names of the effects that are forces and that a system's equation lacks."""
    known = [name for name in faults.PUSHES if name not in faults.OTHERS]
    return [name for name in known if find(name) in CANDIDATES and faults.sensible(name, system)]


def diagnose(name: str, system: System, effect: str, z: float, seed: int, samples: Samples) -> dict[str, object]:
    """Fit and trace one trial by one method, and return its row; where the fit fails, nothing is ranked."""
    row: dict[str, object] = {
        "method": name, "system": system.name, "effect": effect, "z": z, "seed": seed, "status": "ok", "best": "",
        "rank": np.nan, "behind": np.inf, "gain": np.nan, "rows": 0,
    }  # fmt: skip
    began = time.process_time()
    try:
        tangent = METHODS[name](Model(system.library("equation"), system.order), samples)
        row |= {"rows": len(tangent.residual), "fit_seconds": time.process_time() - began}
        found = findings(tangent)
    except (InputError, np.linalg.LinAlgError, FloatingPointError) as error:
        return row | {"status": f"failed: {error}", "seconds": time.process_time() - began}
    names = [one.name for one in found]
    place = names.index(effect) if effect in names else None
    if place is not None:
        behind = float(found[0].evidence - found[place].evidence)
        row |= {"rank": place + 1, "behind": behind, "gain": found[place].gain}
    return row | {"best": names[0], "seconds": time.process_time() - began}


def run() -> pd.DataFrame:
    """Run all trials; one row per trial and method."""
    rows = []
    number = 0
    for system in map(systems.find, SYSTEMS):
        for effect, z, seed in itertools.product(effects(system), SIZES, SEEDS):
            draw = np.random.default_rng([seed, zlib.crc32(effect.encode())])
            try:
                one = specimen.make(system, effect, z, draw, specimen.Conditions(noise=NOISE, variation=True))
            except InputError:
                continue
            if abs(one.z / z - 1) > OFF_SIZE:
                continue
            samples = replace(one.samples.observed(), ends=system.ends)
            chosen = [name for name in METHODS if name != SLOW or number % 3 == 0]
            rows += [{**diagnose(name, system, effect, z, seed, samples), "size": one.z} for name in chosen]
            number += 1
            print(f"{number}: {system.name}, {effect}, z = {z:g}", flush=True)
    return pd.DataFrame(rows)


def scored(table: pd.DataFrame) -> pd.DataFrame:
    """Add the scores; effects that are the same beside the declared terms share the first rank."""
    table["first"] = table["behind"] <= TIE
    table["two"] = table["first"] | (table["rank"] <= 2)
    table["near"] = table["behind"] <= EQUAL
    table["share"] = table["gain"] / table["size"] ** 2
    return table


# The page -----------------------------------------------------------------------------------------------------------

KEYS = ["system", "effect", "z", "seed"]


def percent(share: float) -> str:
    """Return a share as a percentage."""
    return "" if np.isnan(share) else f"{100 * share:.0f} %"


def each(values: pd.Series, text: Callable[[float], str] = format_number) -> str:
    """Return one number per method as text."""
    return ", ".join(f"`{name}` {text(value)}" for name, value in values.items())


def markdown(rows: Sequence[dict[str, object]]) -> str:
    """Return rows as a Markdown table."""
    return render(pd.DataFrame(rows).astype(str), {}, "md").rstrip() + "\n"


def scores(table: pd.DataFrame) -> str:
    """Return a table of each method's scores on some trials."""
    rows = []
    for name in METHODS:
        mine = table[table["method"] == name]
        if mine.empty:
            continue
        row: dict[str, object] = {"method": f"`{name}`", "trials": len(mine)}
        row |= {title: percent(float(mine[score].mean())) for score, title in SCORES.items()}
        row |= {f"first, z = {z:g}": percent(float(mine.loc[mine["z"] == z, "first"].mean())) for z in SIZES}
        row |= {"gain / z^2": format_number(float(mine["share"].median())), "rows": f"{mine['rows'].median():.0f}"}
        row |= {"failed": int((mine["status"] != "ok").sum())}
        rows.append(row | {"seconds": format_number(float(mine["seconds"].median()))})
    return markdown(rows)


def firsts(table: pd.DataFrame, by: Sequence[str]) -> str:
    """Return a table of how often each method ranks the right effect first, grouped by columns."""
    rows = []
    for keys, group in table.groupby(list(by), sort=False):
        row: dict[str, object] = {name: f"{key:g}" if name == "z" else key for name, key in zip(by, keys, strict=True)}
        for name in METHODS:
            mine = group.loc[group["method"] == name, "first"]
            row[name] = f"{int(mine.sum())} of {len(mine)}" if len(mine) else ""
        rows.append(row)
    return markdown(rows)


def common(table: pd.DataFrame) -> pd.DataFrame:
    """Keep the trials that every method was given."""
    return table[table.groupby(KEYS)["method"].transform("nunique") == len(METHODS)]


def split(table: pd.DataFrame, one: str, other: str) -> tuple[int, int, int, int, float]:
    """Compare two methods on the trials that both were given, by a sign test.

    Trials of one effect on one lattice share what was drawn for them, so the test counts each such effect once, for the
    method that is right on more of its trials.

    Returns:
        The number of trials on which both methods, only the first, only the second, and neither rank the right effect
        first; and the two-sided p-value of the test.
    """
    wide = table.pivot_table(index=KEYS, columns="method", values="first", aggfunc="first")[[one, other]].dropna()
    mine, theirs = (wide[name].astype(bool) for name in (one, other))
    more, less = mine & ~theirs, theirs & ~mine
    lead = (more.astype(int) - less.astype(int)).groupby(level=["system", "effect"]).sum()
    ahead, behind = int((lead > 0).sum()), int((lead < 0).sum())
    p = float(binomtest(ahead, ahead + behind).pvalue) if ahead + behind else 1.0
    return int((mine & theirs).sum()), int(more.sum()), int(less.sum()), int((~mine & ~theirs).sum()), p


def pairs(table: pd.DataFrame) -> str:
    """Return a table that compares every two methods."""
    titles = ("both right", "only the first", "only the second", "neither")
    rows = []
    for one, other in itertools.combinations(METHODS, 2):
        *counts, p = split(table, one, other)
        row = {"first": one, "second": other, **dict(zip(titles, counts, strict=True)), "p": format_number(p)}
        rows.append(row)
    return markdown(rows)


def confused(table: pd.DataFrame) -> str:
    """Return the three effects that each method most often ranks first in place of the right one."""
    wrong = table[~table["first"] & (table["status"] == "ok")]
    counts = {name: wrong.loc[wrong["method"] == name, "best"].value_counts().head(3) for name in METHODS}
    return "; ".join(
        f"`{name}` " + ", ".join(f"{effect} {count}" for effect, count in mine.items())
        for name, mine in counts.items()
        if len(mine)
    )


def in_short(table: pd.DataFrame) -> str:
    """Return the findings of the page as a list."""
    whole, methods = table[table["method"] != SLOW], table.groupby("method")
    names = [name for name in METHODS if name != SLOW]
    ranked = whole.groupby("method")["first"].mean().reindex(names).sort_values(ascending=False, kind="stable")
    shared = common(table).groupby("method")["first"].mean().reindex(list(METHODS))
    best, second = map(str, ranked.index[:2])
    p = split(table, best, second)[-1]
    return "\n".join(
        [
            "## In short\n",
            f"- The right effect is ranked first in this share of {len(whole) // len(names)} trials: "
            f"{each(ranked, percent)}. The lead of `{best}` over `{second}` is "
            f"{'' if p < 0.05 else 'not '}significant (p = {format_number(p)}).",
            "- On the trials that all methods were given: "
            f"{each(shared.sort_values(ascending=False, kind='stable'), percent)}.",
            "- With all the information in the recording the right effect would gain z^2, or slightly less where it "
            "makes up much of the residual. Median of gain / z^2: "
            f"{each(methods['share'].median().reindex(list(METHODS)))}. The rows of the curves (`splines`, `pinn-vp`) "
            "only count as independent; a ratio above 1 would claim more certainty than the recording holds.",
            "- Median processor seconds per trial (fit and one round of tracing): "
            f"{each(methods['seconds'].median().reindex(list(METHODS)))}.",
            f"- Most often ranked first in place of the right effect: {confused(table)}.",
            "- The residual of the curves has a closed form. To first order, curves held to the equation by a penalty "
            "W leave (A^T A + W)^-1 A^T rho, where rho is the residual of the trajectory in units of the noise and A "
            "maps forces to readings. This is the force that ridge regression finds in rho: smoothed, shrunk and "
            "correlated between sites. Undoing that needs A, and leads back to the test on the trajectory. This is "
            "derived, not measured. W is the choice of each method's cross-validation, which aims at the coefficients "
            "and not at the residual; no other W was measured.\n",
        ]
    )


def page() -> str:
    """Return the text of residuals.md, made from residuals.csv."""
    text = (HERE / "residuals.csv").read_text(encoding="utf-8")
    about = [line.removeprefix("# ") for line in text.splitlines() if line.startswith("# ")]
    table = scored(pd.read_csv(HERE / "residuals.csv", comment="#"))
    parts = [
        "# Which residual gives the best diagnosis\n",
        "Made by `python results/loop/residuals.py`, which defines each residual and how it is traced; the trials are "
        "in [residuals.csv](residuals.csv). Each is a recording of 25 sites and 50 samples with "
        f"{percent(NOISE)} noise and one force that the declared equation lacks. z is the size of the force "
        "over the smallest standard error that it can be known with. The residual is traced once, to every effect of "
        f"the catalogue but those of the instrument. `{SLOW}`, the slowest method, was given every third trial.\n",
        in_short(table),
        "## All trials\n",
        scores(table[table["method"] != SLOW]),
        "Effects that are the same beside the declared terms share the first rank. gain / z^2: median of twice the log "
        "likelihood ratio of the right effect, over z^2. seconds: median processor time of fit and trace.\n",
        f"## The trials that `{SLOW}` was given\n",
        scores(common(table)),
        "## Methods in pairs\n",
        "Trials that both methods were given, and the p-value of a two-sided sign test, in which each effect on a "
        "lattice counts once.\n",
        pairs(table),
        "## Lattices and sizes\n",
        "Trials in which the right effect is ranked first.\n",
        firsts(table, ["system", "z"]),
        "## Effects\n",
        "Trials in which the right effect is ranked first, over all lattices and sizes.\n",
        firsts(table, ["effect"]),
        "".join(f"- {line}\n" for line in about),
    ]
    return "\n".join(parts)


def main() -> None:
    """Run the trials, unless only the page is asked for, and write the page."""
    if "--page" not in sys.argv[1:]:
        made, began = origin(), time.perf_counter()
        table = scored(run())
        about = {
            "command": "python results/loop/residuals.py", **made,
            "effects": len(CANDIDATES), "seeds": SEEDS, "minutes": f"{(time.perf_counter() - began) / 60:.0f}",
        }  # fmt: skip
        head = "".join(f"# {line}\n" for line in lines(about))
        write_text(HERE / "residuals.csv", head + table.to_csv(index=False, float_format="%.6g"))
    write_text(HERE / "residuals.md", page())


if __name__ == "__main__":
    main()
