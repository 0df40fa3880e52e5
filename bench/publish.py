"""Tables as files: CSV with all digits for programs, Markdown and LaTeX to be read, each with its provenance."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from latticebench.bench.beside import Published
from latticebench.bench.escape import csv_table, markdown
from latticebench.bench.latex import latex
from latticebench.bench.paired import paired
from latticebench.bench.provenance import lines
from latticebench.bench.tables import ABOUT, shown_truth, summary, tables
from latticebench.systems.errors import printable
from latticebench.systems.files import write_text

FORMATS = ("csv", "md", "tex")
TABLES = ("cases", "coefficients", "limits", "summary", "errors", "paired")
# Of these, those that have what was published beside a run.
JOINED = ("cases", "summary", "errors", "paired")
# A longer table is for programs.
MOST_READ = 1000
# The number that a cell of `matrix` begins with.
LEADING = re.compile(r"(inf|\d+(?:\.\d+)?(?:e[+-]\d+)?)(?: |$)")


def matrix(table: pd.DataFrame, value: str = "e2", *, spread: bool = True) -> pd.DataFrame:
    """Arrange the summary as part, data and library against method; a cell without a figure says why.

    A cell is the median over the seeds; where there are several, their 10 % and 90 % quantiles and number follow; of at
    most five that is the least and the largest. Without `spread` it is the median alone. The bound stands beside errors
    where it is known.
    """
    short = summary(table, value)
    if short.empty:
        return pd.DataFrame(columns=ABOUT)
    status = table.drop_duplicates([*ABOUT, "method"])["status"].tolist()

    def shown(row: pd.Series, state: str) -> str:
        figure = format_number(row[value])
        if figure and spread and row["seeds"] > 1:
            low, high = (format_number(row[f"{value}_{end}"]) for end in ("low", "high"))
            return f"{figure} [{low}, {high}] n={row['seeds']}"
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


def best(wide: pd.DataFrame) -> pd.DataFrame:
    """Return which cells of a matrix of errors are the least of their row.

    Methods that are shown the truth do not count.
    """
    others = [*ABOUT, "bound", *(name for name in wide.columns if shown_truth(str(name)))]
    found = pd.DataFrame(False, index=wide.index, columns=wide.columns)
    for row, cells in wide.drop(columns=others, errors="ignore").iterrows():
        values = {name: float(number[1]) for name, cell in cells.items() if (number := LEADING.match(cell))}
        least = min(values.values(), default=np.inf)
        if np.isfinite(least) and len(values) > 1:
            found.loc[row, [name for name, value in values.items() if value == least]] = True
    return found


def publish(
    results: Iterable[Mapping[str, Any]],
    about: Mapping[str, Any],
    folder: Path,
    only: Sequence[str] = TABLES,
    beside: Published | None = None,
) -> list[Path]:
    """Write the tables, each as CSV, Markdown and LaTeX with its provenance.

    A table without rows is left out; one of more than MOST_READ rows is for programs, and written as CSV alone. What
    was published is put beside the results of the same cases, see `bench.beside`.

    Raises:
        InputError: a file cannot be written.
    """
    made = tables(results)
    every = made["cases"]
    told = dict.fromkeys(TABLES, about)
    if beside is not None:
        every = made["cases"] = beside.joined(every)
        told |= {name: {**about, "published": beside.about} for name in JOINED}
    made |= {"summary": summary(every), "errors": matrix(every), "paired": paired(every)}
    written = []
    for name in only:
        frame = made[name]
        for form in FORMATS if len(frame) <= MOST_READ else FORMATS[:1]:
            if frame.empty:
                continue
            path = folder / f"{name}.{form}"
            write_text(path, render(frame, told[name], form, name))
            written.append(path)
    return written


def render(frame: pd.DataFrame, about: Mapping[str, Any], form: str, name: str = "") -> str:
    """Return a table as text with its provenance.

    Args:
        frame: the table; a column `term` holds terms of the term language.
        about: the provenance, see `bench.provenance`.
        form: `csv` with all digits, `md` or `tex` with two digits.
        name: of the table, one of TABLES.
    """
    head = lines(about)
    if form == "csv":
        return "".join(f"# {line}\n" for line in head) + csv_table(frame)
    shown = readable(_without_empty(frame.drop(columns=[name for name in ("identity", "settings") if name in frame])))
    if form == "md":
        return markdown_table(shown) + "\n\n" + "".join(f"{line}\n" for line in markdown_list(head))
    return latex(shown, about, name, best(shown) if name == "errors" else None)


def readable(frame: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose numbers that are not whole have two digits; nothing stands for one that is missing."""
    shown = frame.copy()
    for name in shown.columns:
        if pd.api.types.is_float_dtype(shown[name]):
            shown[name] = [format_number(value) for value in shown[name]]
        elif shown[name].dtype == object:
            shown[name] = [_readable(value) for value in shown[name]]
    return shown


def _readable(value: Any) -> Any:
    return format_number(value) if value is None or isinstance(value, float) else value


def markdown_table(frame: pd.DataFrame) -> str:
    """Return a table as Markdown, its numbers readable; terms of a column `term` are quoted as code."""
    quoted = readable(frame).map(lambda value: markdown(str(value)))
    if "term" in quoted:
        # What stands between backticks is shown as it is, but for the end of a cell.
        quoted["term"] = [
            "`" + printable(str(term)).replace("|", "\\|").replace("`", "'") + "`" for term in frame["term"]
        ]
    quoted.columns = pd.Index([markdown(str(name)) for name in quoted.columns])
    return str(quoted.to_markdown(index=False, disable_numparse=True))


def markdown_list(texts: Iterable[str]) -> list[str]:
    """Return texts as the lines of a Markdown list."""
    return [f"- {markdown(text)}" for text in texts]
