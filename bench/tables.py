"""Tidy tables: one row a case, one row a coefficient, and a summary; as Markdown, CSV and LaTeX."""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from latticebench.bench.provenance import lines
from latticebench.bench.suite import Case
from latticebench.systems.errors import InputError
from latticebench.systems.files import write_text
from latticebench.systems.terms import Term

SCORES = (
    "e2", "einf", "spurious", "tpr", "bound", "forecast_error", "forecast_horizon", "residual", "conditioning",
    "seconds", "cpu_seconds", "peak_mib",
)  # fmt: skip
FORMATS = ("csv", "md", "tex")
# Over fewer seeds a root-mean-square error says little.
FEW = 3
# Standard errors to each side of a 95 % interval.
INTERVAL = 1.96
TABLES = ("cases", "coefficients", "limits", "summary", "errors")
MOST_READ = 1000
# What a row of the matrix is about; a column of it is a method.
ABOUT = ["part", "data", "library"]


def cases(results: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of cases: one row each, its settings first.

    Scores of a case that gave none are NaN; `status` and `reason` say why. An error that is infinite stays infinite.
    """
    rows = []
    for result in results:
        case = Case.model_validate(result["case"])
        rows.append(
            {
                "part": case.part, "data": case.data, "library": case.library, "method": case.label, "noise": case.noise,
                "seed": case.seed, "status": result["status"],
                **{name: _number(result[name]) for name in SCORES}, "covered": _covered(result) if case.noise else np.nan,
                "reason": result["reason"] or result["note"], "settings": _settings(case.settings), "identity": case.identity,
            }
        )  # fmt: skip
    columns = [
        "part",
        "data",
        "library",
        "method",
        "noise",
        "seed",
        "status",
        *SCORES,
        "covered",
        "reason",
        "settings",
        "identity",
    ]
    return pd.DataFrame(rows, columns=columns)


def coefficients(results: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of coefficients: one row each, with truth and error where there are any.

    `bound` is the smallest standard error that an unbiased method can have on these samples, `verdict` what follows from it.
    """
    rows = []
    for result in results:
        case = Case.model_validate(result["case"])
        for term, value in (result["coefficients"] or {}).items():
            truth = np.nan if result["truth"] is None else result["truth"][term]
            stderr, bound = (
                np.nan if result[name] is None else _number(result[name][term]) for name in ("stderr", "bounds")
            )
            rows.append(
                {
                    "part": case.part, "data": case.data, "library": case.library, "method": case.label,
                    "noise": case.noise, "seed": case.seed, "term": term, "coefficient": value, "truth": truth, "error": value - truth,
                    "stderr": stderr, "bound": bound, "verdict": (result["verdicts"] or {}).get(term, ""),
                }
            )  # fmt: skip
    columns = [
        "part", "data", "library", "method", "noise", "seed", "term", "coefficient", "truth", "error", "stderr", "bound", "verdict",
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=columns)


def limits(results: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Make the table of what can be known: one row for each term of the data and libraries that have a bound.

    `bound` is the smallest standard error of an unbiased method, in units of the coefficient.
    """
    rows: dict[tuple[str, ...], dict[str, Any]] = {}
    for result in results:
        case = Case.model_validate(result["case"])
        for term, verdict in (result["verdicts"] or {}).items():
            # Where the bound depends on the seed, the first one stands for all.
            about = {"part": case.part, "data": case.data, "library": case.library, "term": term}
            found = {"truth": result["truth"][term], "bound": _number(result["bounds"][term]), "verdict": verdict}
            rows.setdefault(tuple(about.values()), {**about, **found})
    return pd.DataFrame(list(rows.values()), columns=[*ABOUT, "term", "truth", "bound", "verdict"])


def _covered(result: Mapping[str, Any]) -> float:
    """Give the share of a case's 95 % intervals that hold the truth; NaN without truth or standard errors.

    Without noise there is nothing that an interval could be of.
    """
    errors, truth = result["stderr"], result["truth"]
    if not errors or not truth or not result["coefficients"]:
        return np.nan
    held = [
        abs(value - truth[term]) <= INTERVAL * _number(errors[term]) for term, value in result["coefficients"].items()
    ]
    return float(np.mean(held))


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Sum the table of cases up over seeds: one row for data, library and method.

    A case that failed or ran out of time counts as an infinite error and stays in the median; one that was skipped leaves no
    figure. `ok` counts the cases that ended with a fit. `efficiency` is the Cramer-Rao bound over the root-mean-square of E2
    over the seeds: 1 is the best that an unbiased method can do, a failure makes it 0, and with fewer than FEW seeds it is left
    out. `coverage` is the share of the 95 % intervals (1.96 standard errors to each side) that hold the truth. A biased method may pass 1 where the samples say little: 0 for every coefficient is never more than 100 % off.
    """
    if table.empty:
        return pd.DataFrame(columns=[*ABOUT, "method"])
    counted = table.copy()
    missed = ~counted["status"].isin(["ok", "skipped"])
    # Where fits ended and yet none has an E2, there is no truth.
    ended = (counted["status"] == "ok").groupby([counted[name] for name in ABOUT]).transform("any")
    no_truth = ended & counted.groupby(ABOUT)["e2"].transform(lambda e: bool(e.isna().all()))
    counted.loc[missed & ~no_truth, ["e2", "einf", "forecast_error"]] = np.inf
    counted.loc[missed, ["tpr", "forecast_horizon"]] = 0.0
    grouped = counted.groupby([*ABOUT, "method"], sort=False)
    found = grouped[[*SCORES]].median()
    found["efficiency"] = grouped[["bound", "e2"]].apply(_efficiency)
    if "covered" in counted:
        found["coverage"] = grouped["covered"].mean()
    found.insert(0, "ok", grouped["status"].agg(lambda s: f"{int((s == 'ok').sum())}/{len(s)}"))
    keys = pd.MultiIndex.from_frame(counted[[*ABOUT, "method"]].drop_duplicates())
    return found.reindex(keys).reset_index()


def _efficiency(group: pd.DataFrame) -> float:
    """Divide the bound by the root-mean-square of E2 over the seeds; a case that failed has no bound of its own."""
    e2, bound = group["e2"].dropna(), group["bound"].dropna()
    if len(e2) < FEW or bound.empty or not np.any(e2 > 0):
        return np.nan
    return float(np.sqrt(np.mean(bound**2) / np.mean(e2**2)))


def matrix(table: pd.DataFrame, value: str = "e2") -> pd.DataFrame:
    """Arrange the summary as part, data and library against method; a cell without a figure says why.

    Beside errors stands their bound, where there is one.
    """
    short = summary(table)
    if short.empty:
        return pd.DataFrame(columns=ABOUT)
    status = table.drop_duplicates([*ABOUT, "method"])["status"].tolist()

    def shown(row: pd.Series, state: str) -> str:
        figure = format_number(row[value])
        if figure or state != "ok":
            return figure or state
        # Where the equation is outside the library, what it leaves of the derivative is all there is to say.
        left = format_number(row["residual"])
        return f"no truth, leaves {left}" if left else "no truth"

    short["cell"] = [shown(row, state) for (_, row), state in zip(short.iterrows(), status, strict=True)]
    wide = short.pivot(index=ABOUT, columns="method", values="cell")
    rows = pd.MultiIndex.from_frame(short[ABOUT].drop_duplicates())
    wide = wide.reindex(index=rows, columns=list(dict.fromkeys(short["method"]))).fillna("").reset_index()
    wide.columns.name = None
    if value == "e2" and short["bound"].notna().any():
        floors = short.groupby(ABOUT, sort=False)["bound"].max()
        wide["bound"] = [format_number(floors[tuple(row)]) for row in wide[ABOUT].itertuples(index=False)]
    return _without_empty(wide)


def _without_empty(frame: pd.DataFrame) -> pd.DataFrame:
    """Leave the column of parts out where the suite has none."""
    return frame.drop(columns="part") if "part" in frame and not frame["part"].astype(bool).any() else frame


def format_number(value: Any) -> str:
    """Write a number with two digits; nothing for NaN."""
    if isinstance(value, str):
        return value
    if value is None or np.isnan(value):
        return ""
    if np.isinf(value):
        return "inf"
    return f"{value:.2g}" if 1e-3 <= abs(value) < 1e4 or value == 0 else f"{value:.1e}"


def publish(
    results: Sequence[Mapping[str, Any]], about: Mapping[str, Any], folder: Path, only: Sequence[str] = TABLES
) -> list[Path]:
    """Write the tables, each as CSV, Markdown and LaTeX with its provenance.

    A table without rows is left out; one of more than MOST_READ rows is for programs, and written as CSV alone.

    Raises:
        InputError: a file cannot be written.
    """
    table = cases(results)
    made: dict[str, Callable[[], pd.DataFrame]] = {
        "cases": lambda: table,
        "coefficients": lambda: coefficients(results),
        "limits": lambda: limits(results),
        "summary": lambda: summary(table),
        "errors": lambda: matrix(table),
    }
    written = []
    for name in only:
        frame = made[name]()
        for form in FORMATS if len(frame) <= MOST_READ else FORMATS[:1]:
            if frame.empty:
                continue
            path = folder / f"{name}.{form}"
            write_text(path, render(frame, about, form))
            written.append(path)
    return written


def render(frame: pd.DataFrame, about: Mapping[str, Any], form: str) -> str:
    """Write a table as text: `csv` with all digits, `md` and `tex` to be read; the provenance stands at its head."""
    head = lines(about)
    if form == "csv":
        return "".join(f"# {line}\n" for line in head) + frame.to_csv(index=False)
    readable = _without_empty(frame.drop(columns=[name for name in ("identity", "settings") if name in frame]))
    for name in readable.columns:
        if pd.api.types.is_float_dtype(readable[name]):
            readable[name] = [format_number(value) for value in readable[name]]
    if form == "md":
        quoted = readable.map(lambda value: str(value).replace("|", "\\|"))
        if "term" in quoted:
            quoted["term"] = [f"`{term}`" for term in quoted["term"]]
        return quoted.to_markdown(index=False, disable_numparse=True) + "\n\n" + "".join(f"- {line}\n" for line in head)
    if "term" in readable:
        readable["term"] = [f"${Term(text).latex}$" for text in readable["term"]]
    escaped = readable.map(lambda value: str(value) if str(value).startswith("$") else _tex(str(value)))
    escaped.columns = pd.Index([_tex(str(name)) for name in escaped.columns])
    body = " \\\\\n".join(" & ".join(row) for row in escaped.itertuples(index=False))
    columns = "l" * len(escaped.columns)
    return (
        "".join(f"% {line}\n" for line in head)
        + f"\\begin{{tabular}}{{{columns}}}\n\\hline\n"
        + " & ".join(escaped.columns) + " \\\\\n\\hline\n" + body + " \\\\\n\\hline\n\\end{tabular}\n"
    )  # fmt: skip


def read_cases(path: Path) -> pd.DataFrame:
    """Read a published table of cases, or make it from a store.

    Raises:
        InputError: there is neither at `path`.
    """
    if path.is_dir():
        if (path / "store.json").is_file():
            from latticebench.bench.store import open_store

            return cases(open_store(path).all())
        path = path / "cases.csv"
    if not path.is_file():
        raise InputError(f"{path}: no such table; give a store of results, a folder with cases.csv, or a cases.csv")
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        body = itertools.dropwhile(lambda line: line.startswith("#"), lines)
        table = pd.read_csv(io.StringIO("".join(body)), dtype=str, keep_default_na=False)
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a table of cases: {error}") from None
    missing = [name for name in ("identity", "status", "e2") if name not in table]
    if missing:
        raise InputError(f"{path}: not a table of cases: the column {missing[0]!r} is missing")
    for name in (*SCORES, "covered", "noise", "seed"):
        if name in table:
            table[name] = pd.to_numeric(table[name], errors="coerce")
    return table


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)


def _settings(given: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value}" for name, value in given.items())


def _tex(text: str) -> str:
    table = {
        "\\": r"\textbackslash{}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}",
        "^": r"\^{}", "~": r"\~{}", "|": r"\textbar{}",
    }  # fmt: skip
    return "".join(table.get(letter, letter) for letter in text)
