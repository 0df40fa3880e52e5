"""Say which method's residual gives the best diagnosis, and write residuals.md and residuals.csv.

    python results/loop/residuals.py
    python results/loop/residuals.py --page    # scores and page again, from the trials in residuals.csv

A specimen is a recording with one force that the declared equation lacks. Each method fits the declared equation; what it leaves, r, is
regressed on what each effect of the catalogue would add. Forces s(n, t) along the method's own state become columns R s by a linear
map R of the method's own:

    trajectory   r: what the shooting fit leaves of the readings, over the noise; R: what a force does to the readings (`diagnosis.tangent`)
    weak         r: the weak equations' residual; R: integrals over the test functions; both whitened by the covariance of the
                 weak equations
    splines,     r = d^order u/dt^order - F(u, v; xi) along the method's curves, and R = 1; means of both over stretches of time,
    pinn-vp      so long that the means count as independent

The stretches are one correlation time of r long, dt (1 + 2 sum of the autocorrelation up to its first zero), pooled over the sites; the first
and the last are left out, since derivatives are worst at the ends. Correlations between sites are not seen to.

Everything else is the same for all (`diagnosis.trace`): the ways in which an effect may be there; the columns of the declared terms are
projected out; with U an orthonormal basis of a way's columns and nu the rows less the declared terms (and, for the trajectory,
the start), the gain is -nu ln(1 - |U^T r|^2 / |r|^2), twice the log likelihood ratio with the noise's size fitted; the evidence is -ln of the
tail of chi squared at the gain, less the cost of the search, and ranks the effects.
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
from latticebench.bench.provenance import origin
from latticebench.bench.publish import format_number
from latticebench.bench.trials import faults, specimen
from latticebench.bench.trials.trial import OFF_SIZE
from latticebench.diagnosis import trace
from latticebench.diagnosis.model import Fitted, Model, first_fit
from latticebench.diagnosis.tangent import Path, Tangent, forces, linearise, orthonormal
from latticebench.methods.method import Smooth, solve
from latticebench.methods.trajectory import Solution, State
from latticebench.methods.weak import ACCURACY, Weak, WeakForm, estimate, linearised
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
# So near the best one in evidence an effect counts as not told from it.
EQUAL = 3.0
TIE = 1e-6
SURROGATES = 100
NOISE = 0.01
# The slowest method is given every third specimen.
SLOW = "pinn-vp"
LEAST_STRETCHES = 6
SCORES = {"first": "ranked first", "two": "within the first two", "near": f"within {EQUAL:g} nats of the first"}


@dataclass(frozen=True, eq=False)
class Along(Path):
    """A method's own state, with the method's own way from forces to rows.

    Attributes:
        project: from forces (columns, F, parts, N) to rows (rows, columns).
    """

    project: Callable[[ndarray], ndarray]

    def answer(self, source: ndarray) -> ndarray:
        """Give what forces add to the residual, one column each."""
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
    """Write a method's residual as a tangent, so that it can be traced as the trajectory's is.

    Args:
        model: the declared equation.
        samples: what was fitted.
        times: of the state (F,).
        field: u and, for order 2, v (F, order, parts, N).
        coefficients: xi.
        project: see `Along`.
        residual: of the rows (rows,); None: what the equation leaves of `rate`, projected.
        rate: the highest derivative (F, parts, N).
    """
    (record,) = model.records([samples])
    none = np.zeros((0, 0, 0))
    path = Along(record, times, 1, field, none, none, none, none, None, project)
    declared = forces(path)
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
    """Take what the shooting fit leaves of the readings."""
    return linearise(first_fit(model, [samples]))


def by_weak(model: Model, samples: Samples) -> Tangent:
    """Take the whitened residual of the weak equations; no declared term is dropped."""
    default = Weak()
    form = WeakForm(samples, model.declared, model.order, default.half_width, default.power)
    found = estimate([form], np.ones(len(model.declared.terms), dtype=bool), default.rounds)
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
    """Take what the equation leaves of the derivative along a method's curves."""

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
    """Give the means over stretches of one correlation time of a residual (Q, parts, N)."""
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


def findings(tangent: Tangent) -> list[trace.Finding]:
    """Rank the effects of the catalogue that are forces by their evidence, the best first."""
    # The name it had before.
    ways = getattr(trace, "ways", None) or trace._tries
    groups = [(effect.name, True, ways(tangent, effect)) for effect in CANDIDATES]
    return trace.rank(tangent, [one for one in groups if one[2]], np.random.default_rng(1), SURROGATES)


def effects(system: System) -> list[str]:
    """Name the effects of the catalogue that are forces which the declared equation lacks."""
    known = [name for name in faults.PUSHES if name not in faults.OTHERS]
    return [name for name in known if find(name) in CANDIDATES and faults.sensible(name, system)]


def trial(name: str, system: System, effect: str, z: float, seed: int, samples: Samples) -> dict[str, object]:
    """Fit, trace, and say where the right effect is ranked; a fit that fails ranks nothing."""
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


def trials() -> pd.DataFrame:
    """Run every trial; one row for each specimen and method."""
    rows = []
    number = 0
    for system in map(systems.find, SYSTEMS):
        for effect, z, seed in itertools.product(effects(system), SIZES, SEEDS):
            draw = np.random.default_rng([seed, zlib.crc32(effect.encode())])
            try:
                one = specimen.make(system, effect, z, draw, noise=NOISE, variation=True)
            except InputError:
                continue
            if abs(one.z / z - 1) > OFF_SIZE:
                continue
            samples = replace(one.samples.observed(), ends=system.ends)
            chosen = [name for name in METHODS if name != SLOW or number % 3 == 0]
            rows += [{**trial(name, system, effect, z, seed, samples), "size": one.z} for name in chosen]
            number += 1
            print(f"{number}: {system.name}, {effect}, z = {z:g}", flush=True)
    return pd.DataFrame(rows)


def scored(table: pd.DataFrame) -> pd.DataFrame:
    """Add the scores; effects that are the same beside the declared terms are first together."""
    table["first"] = table["behind"] <= TIE
    table["two"] = table["first"] | (table["rank"] <= 2)
    table["near"] = table["behind"] <= EQUAL
    table["share"] = table["gain"] / table["size"] ** 2
    return table


# The page -------------------------------------------------------------------------------------------------------------------------

KEYS = ["system", "effect", "z", "seed"]


def percent(share: float) -> str:
    """Write a share as a percentage."""
    return "" if np.isnan(share) else f"{100 * share:.0f} %"


def markdown(table: pd.DataFrame) -> str:
    """Write a table of texts as Markdown."""
    return str(table.astype(str).to_markdown(index=False, disable_numparse=True)) + "\n"


def scores(table: pd.DataFrame) -> str:
    """Write each method's scores on some trials."""
    rows = []
    for name in METHODS:
        mine = table[table["method"] == name]
        if mine.empty:
            continue
        row: dict[str, object] = {"method": f"`{name}`", "specimens": len(mine)}
        row |= {title: percent(float(mine[score].mean())) for score, title in SCORES.items()}
        row |= {f"first, z = {z:g}": percent(float(mine.loc[mine["z"] == z, "first"].mean())) for z in SIZES}
        row |= {"gain / z^2": format_number(float(mine["share"].median())), "rows": f"{mine['rows'].median():.0f}"}
        row |= {"failed": int((mine["status"] != "ok").sum())}
        rows.append(row | {"seconds": format_number(float(mine["seconds"].median()))})
    return markdown(pd.DataFrame(rows))


def firsts(table: pd.DataFrame, by: Sequence[str]) -> str:
    """Write how often the right effect is ranked first, out of how many, for each method."""
    rows = []
    for keys, group in table.groupby(list(by), sort=False):
        row: dict[str, object] = dict(zip(by, keys, strict=True))
        for name in METHODS:
            mine = group.loc[group["method"] == name, "first"]
            row[name] = f"{int(mine.sum())} of {len(mine)}" if len(mine) else ""
        rows.append(row)
    return markdown(pd.DataFrame(rows).replace({"z": {z: f"{z:g}" for z in SIZES}}))


def common(table: pd.DataFrame) -> pd.DataFrame:
    """Keep the specimens that every method was given."""
    return table[table.groupby(KEYS)["method"].transform("nunique") == len(METHODS)]


def split(table: pd.DataFrame, one: str, other: str) -> tuple[int, int, int, int, float]:
    """Count the specimens given to both of two methods: both right, only one, only the other, neither; and the sign test's chance.

    Specimens of one effect on one lattice share what was drawn for them, so the test counts each such effect once, for the method that
    is right on more of its specimens.
    """
    wide = table.pivot_table(index=KEYS, columns="method", values="first", aggfunc="first")[[one, other]].dropna()
    mine, theirs = (wide[name].astype(bool) for name in (one, other))
    more, less = mine & ~theirs, theirs & ~mine
    lead = (more.astype(int) - less.astype(int)).groupby(level=["system", "effect"]).sum()
    ahead, behind = int((lead > 0).sum()), int((lead < 0).sum())
    chance = float(binomtest(ahead, ahead + behind).pvalue) if ahead + behind else 1.0
    return int((mine & theirs).sum()), int(more.sum()), int(less.sum()), int((~mine & ~theirs).sum()), chance


def pairs(table: pd.DataFrame) -> str:
    """Write how every two methods compare."""
    rows = []
    for one, other in itertools.combinations(METHODS, 2):
        *counts, chance = split(table, one, other)
        titles = ("both right", "only the first", "only the second", "neither")
        rows.append(
            {"first": one, "second": other, **dict(zip(titles, counts, strict=True)), "p": format_number(chance)}
        )
    return markdown(pd.DataFrame(rows))


def page(table: pd.DataFrame, about: dict[str, str]) -> str:
    """Write the page."""
    shared = common(table)
    order = shared.groupby("method")["first"].mean().reindex(list(METHODS)).sort_values(ascending=False, kind="stable")
    whole = table[table["method"] != SLOW]
    means = whole.groupby("method")["first"].mean().reindex([name for name in METHODS if name != SLOW])
    ranked = means.sort_values(ascending=False, kind="stable")
    best, second = str(ranked.index[0]), str(ranked.index[1])
    chance = split(table, best, second)[-1]
    share = table.groupby("method")["share"].median()
    seconds = table.groupby("method")["seconds"].median()
    named = table[~table["first"] & (table["status"] == "ok")]
    taken = {name: one["best"].value_counts().head(3) for name, one in named.groupby("method")}
    wrong = "; ".join(
        f"`{name}` " + ", ".join(f"{effect} {count}" for effect, count in taken[name].items())
        for name in METHODS
        if name in taken
    )
    parts = [
        "# Which residual gives the best diagnosis\n",
        "Made by `python results/loop/residuals.py`, whose head says what each residual is and how it is traced; the trials are in "
        f"[residuals.csv](residuals.csv). One round of tracing on recordings with one undeclared force of the size z, {percent(NOISE)} noise, "
        f"25 sites, 50 samples; {len(CANDIDATES)} effects of the catalogue compete, those of the instrument being left out. `{SLOW}`, the slowest, "
        f"is given every third specimen.\n",
        "## In short\n",
        "- Right effect ranked first: " + ", ".join(f"`{name}` {percent(v)}" for name, v in ranked.items())
        + f" of {len(whole) // len(means)} specimens. That `{best}` is ahead of `{second}` is "
        + ("more than chance" if chance < 0.05 else "no more than chance may do")
        + f" (p = {format_number(chance)}).",
        "- On the specimens that all were given: " + ", ".join(f"`{name}` {percent(v)}" for name, v in order.items()) + ".",
        "- With all the information in the recording the right effect would gain z^2, or a little less where it makes up much of the "
        "residual. Median share of it: "
        + ", ".join(f"`{name}` {format_number(share[name])}" for name in METHODS)
        + ". The curves' rows only count as independent; a share above 1 would be more certainty than there is.",
        "- Processor seconds a diagnosis of one round: "
        + ", ".join(f"`{name}` {format_number(seconds[name])}" for name in METHODS)
        + ".",
        "- Named instead of the right effect, most often: " + wrong + ".",
        "- What the curves leave can be written down. Curves held to the equation by a penalty W have, to first order, the residual "
        "(A^T A + W)^-1 A^T rho: the force that ridge regression finds in rho, the trajectory's residual in units of the noise, A being what "
        "forces do to the readings. It is smoothed, shrunk and correlated from site to site; taking that back needs A, and then it is the "
        "trajectory's test. This is algebra, not measured here. W is what each method's cross-validation takes, which has the coefficients "
        "in mind and not the residual; other W were not tried here.\n",
        "## All specimens\n", scores(whole), "Effects that are the same beside the declared terms are first together. "
        "gain / z^2: median of twice the log likelihood ratio of the right effect over the size squared. seconds: median processor time, fit and trace.\n",
        f"## The specimens that `{SLOW}` was given too\n", scores(shared),
        "## In pairs\n", "Specimens that both were given; p: the chance of so uneven a split between two that are equally good (sign test, "
        "each effect on a lattice counting once).\n",
        pairs(table),
        "## Lattices and sizes\n", "Right effect ranked first.\n", firsts(table, ["system", "z"]),
        "## Effects\n", "Right effect ranked first, all lattices and sizes.\n", firsts(table, ["effect"]),
        "".join(f"- {name}: {value}\n" for name, value in about.items()),
    ]  # fmt: skip
    return "\n".join(parts)


def read() -> tuple[pd.DataFrame, dict[str, str]]:
    """Read residuals.csv: the trials, and its head."""
    path = HERE / "residuals.csv"
    head = [line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("# ")]
    return pd.read_csv(path, comment="#"), dict(line.removeprefix("# ").split(": ", 1) for line in head)


def main() -> None:
    """Run the trials, or read them where only the page is asked for, and write both files."""
    if "--page" in sys.argv[1:]:
        table, about = read()
        about["scored at"] = origin()["commit"]
    else:
        made = origin()
        began = time.perf_counter()
        table = trials()
        about = {
            "command": "python results/loop/residuals.py", "commit": made["commit"], "date": made["date"], "machine": made["machine"],
            "versions": "; ".join(f"{name} {version}" for name, version in made["versions"].items()),
            "seeds": ", ".join(map(str, SEEDS)), "minutes": f"{(time.perf_counter() - began) / 60:.0f}",
        }  # fmt: skip
    table = scored(table)
    head = "".join(f"# {name}: {value}\n" for name, value in about.items())
    write_text(HERE / "residuals.csv", head + table.to_csv(index=False, float_format="%.6g"))
    write_text(HERE / "residuals.md", page(table, about))


if __name__ == "__main__":
    main()
