"""Tables as files: CSV with all digits for programs, Markdown and LaTeX to be read, each with its provenance."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from latticebench.bench.escape import csv_table, markdown
from latticebench.bench.paired import paired
from latticebench.bench.provenance import lines
from latticebench.bench.tables import ABOUT, summary, tables
from latticebench.systems.errors import printable
from latticebench.systems.files import write_text
from latticebench.systems.terms import Term

FORMATS = ("csv", "md", "tex")
TABLES = ("cases", "coefficients", "limits", "summary", "errors", "paired")
# A longer table is for programs.
MOST_READ = 1000
NUMBER = re.compile(r"(-?)(\d+)(?:\.(\d+))?(?:e([+-]\d+))?")
# What a LaTeX table needs; without T1 a vertical bar is printed as a dash.
NEEDS = r"needs \usepackage{booktabs,siunitx} \usepackage[T1]{fontenc}"


def matrix(table: pd.DataFrame, value: str = "e2") -> pd.DataFrame:
    """Arrange the summary as part, data and library against method; a cell without a figure says why.

    A cell is the median over the seeds; where there are several, their middle 80 % and number follow. The bound stands
    beside errors where it is known.
    """
    short = summary(table, value)
    if short.empty:
        return pd.DataFrame(columns=ABOUT)
    status = table.drop_duplicates([*ABOUT, "method"])["status"].tolist()

    def shown(row: pd.Series, state: str) -> str:
        figure = format_number(row[value])
        if figure and row["seeds"] > 1:
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


def publish(
    results: Iterable[Mapping[str, Any]], about: Mapping[str, Any], folder: Path, only: Sequence[str] = TABLES
) -> list[Path]:
    """Write the tables, each as CSV, Markdown and LaTeX with its provenance.

    A table without rows is left out; one of more than MOST_READ rows is for programs, and written as CSV alone.

    Raises:
        InputError: a file cannot be written.
    """
    made = tables(results)
    every = made["cases"]
    made |= {"summary": summary(every), "errors": matrix(every), "paired": paired(every)}
    written = []
    for name in only:
        frame = made[name]
        for form in FORMATS if len(frame) <= MOST_READ else FORMATS[:1]:
            if frame.empty:
                continue
            path = folder / f"{name}.{form}"
            write_text(path, render(frame, about, form))
            written.append(path)
    return written


def render(frame: pd.DataFrame, about: Mapping[str, Any], form: str) -> str:
    """Return a table as text with its provenance.

    Args:
        frame: the table; a column `term` holds terms of the term language.
        about: the provenance, see `bench.provenance`.
        form: `csv` with all digits, `md` or `tex` with two digits.
    """
    head = lines(about)
    if form == "csv":
        return "".join(f"# {line}\n" for line in head) + csv_table(frame)
    shown = readable(_without_empty(frame.drop(columns=[name for name in ("identity", "settings") if name in frame])))
    if form == "md":
        return markdown_table(shown) + "\n\n" + "".join(f"{line}\n" for line in markdown_list(head))
    shown.columns = pd.Index([printable(str(name)) for name in shown.columns])
    return "".join(f"% {line}\n" for line in (NEEDS, *head)) + _latex(shown.map(lambda value: printable(str(value))))


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
        quoted["term"] = ["`" + str(term).replace("|", "\\|") + "`" for term in frame["term"]]
    quoted.columns = pd.Index([markdown(str(name)) for name in quoted.columns])
    return str(quoted.to_markdown(index=False, disable_numparse=True))


def markdown_list(texts: Iterable[str]) -> list[str]:
    """Return texts as the lines of a Markdown list."""
    return [f"- {markdown(text)}" for text in texts]


def _latex(texts: pd.DataFrame) -> str:
    """Write a table of texts with the rules of booktabs; a column with numbers in it is one of siunitx."""
    style = texts.style.hide(axis="index").format_index(escape="latex", axis=1)
    columns = []
    for name in texts.columns:
        numbers = [found for text in texts[name] if (found := NUMBER.fullmatch(text))]
        columns.append(_number_column(numbers) if numbers else "l")
        if name == "term":
            style.format(lambda text: f"${Term(str(text)).latex}$", subset=[name])
        else:
            style.format(_number_cell if numbers else None, escape="latex", subset=[name])
    return str(style.to_latex(hrules=True, siunitx=True, column_format="".join(columns)))


def _number_column(numbers: Sequence[re.Match[str]]) -> str:
    """Return the column of siunitx that is wide enough for each of the numbers."""
    sign = "-" if any(one[1] for one in numbers) else ""
    whole = max(len(one[2]) for one in numbers)
    decimals = max(len(one[3] or "") for one in numbers)
    exponents = [int(one[4]) for one in numbers if one[4]]
    form = f"{sign}{whole}" + (f".{decimals}" if decimals else "")
    if exponents:
        form += f"e{'-' if min(exponents) < 0 else ''}{max(len(str(abs(one))) for one in exponents)}"
    return f"S[table-format={form}]"


def _number_cell(value: object) -> str:
    """Write a number as siunitx reads it; braces keep other texts from being read as one."""
    text = str(value)
    if found := NUMBER.fullmatch(text):
        return text[: found.start(4) - 1] + f"e{int(found[4])}" if found[4] else text
    return f"{{{text}}}" if text else ""
