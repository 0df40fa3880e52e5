"""Tables for papers: rules of booktabs, numbers of siunitx, the best in bold, no wider than a page of `article`.

Errors are written as briefly as they can be: the spread below the median, long heads upright. A table that fits on a
page is shrunk to its width where it must be. A longer one is a longtable, which cannot be: its font is as small as it
needs, and what is still too wide is continued in another one with the same rows.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import pandas as pd

from latticebench.bench.provenance import lines
from latticebench.systems.errors import printable
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from pandas.io.formats.style import Styler

# Without T1 a vertical bar is printed as a dash.
NEEDS = r"needs \usepackage{booktabs,graphicx,longtable,siunitx} \usepackage[T1]{fontenc}"
NUMBER = re.compile(r"(-?)(\d+)(?:\.(\d+))?(?:e([+-]\d+))?")
SPECIAL = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", **{sign: f"\\{sign}" for sign in "&%$#_{}"},
}  # fmt: skip
SETUP = r"\sisetup{detect-weight,output-exponent-marker=\mathrm{e}}\setlength{\tabcolsep}{3pt}"
SHRINK = r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%"
# A cell of `bench.publish.matrix`: a median, the ends of its spread and the number of seeds; or what a fit leaves.
SCORE = re.compile(r"(?P<middle>inf|[\d.]+(?:e[+-]\d+)?)(?: \[(?P<low>[^,]+), (?P<high>[^]]+)\] n=\d+)?")
LEAVES = re.compile(r"no truth, leaves (\S+)")
# Heads with more characters stand upright.
UPRIGHT = 9
# A page of `article`, a line and the space between two columns, in points; what a caption and a head take of it.
WIDTH, HEIGHT, LINE, BETWEEN, HEAD = 345.0, 550.0, 12.5, 6.0, 90.0
# The width of a character, on the safe side, of the font of 10 points; and of smaller ones, by their commands.
CHARACTER = 5.4
FONTS = {"normalsize": 1.0, "small": 0.93, "footnotesize": 0.87, "scriptsize": 0.81, "tiny": 0.72}
# Of a table that is split.
SPLIT = "scriptsize"
# Characters of a cell that is broken into lines in a longtable.
LONGEST = 22
CAPTIONS = {
    "errors": "Relative error E2 of the coefficients: the median over the seeds and, where there are several, their "
    "10 % and 90 % quantiles in brackets, of at most five the least and the largest. In parentheses, where the "
    "equation is outside the library: what the fit leaves of the derivative.",
    "cases": "Scores of each case.", "coefficients": "Coefficients of each fit and their truth.",
    "limits": "The smallest standard error that an unbiased method can have.",
    "summary": "Scores of each method, medians over the seeds.",
    "against": "Cases won, lost and tied by E2; median ratio of E2 with its 95 % interval by a bootstrap over the "
    "cases; p of the signed-rank test after Holm's correction.",
    "against-cases": "Ratio of E2 of two methods in each case, the median over the seeds with its 95 % interval.",
    "paired": "Which of two methods has the smaller E2: signed-rank test over cases and seeds, p after Holm's "
    "correction.",
}  # fmt: skip


def latex(texts: pd.DataFrame, about: Mapping[str, Any], name: str = "", best: pd.DataFrame | None = None) -> str:
    """Return a table for LaTeX, its provenance as remarks.

    Args:
        texts: the table as it is shown; a column `term` holds terms of the term language.
        about: the provenance, see `bench.provenance`.
        name: of the table; see CAPTIONS.
        best: of the same form, true where a cell is to be bold.
    """
    texts = texts.map(lambda value: printable(str(value)))
    texts.columns = pd.Index([printable(str(column)) for column in texts.columns])
    head = "".join(f"% {line}\n" for line in (NEEDS, *lines(about)))
    caption = _caption(about, name, best is not None and bool(best.to_numpy().any()))
    short = name == "errors"
    widths = [(_seen if short else _width)(texts, column) for column in texts.columns]
    needed = sum(widths) + BETWEEN * len(widths)
    if _lines(texts, short) * LINE * min(1.0, WIDTH / needed) < HEIGHT - HEAD:
        table = _table(texts, best, short=short)
        label = f"\\label{{tab:{name}}}" if name else ""
        above = f"\\caption{{{caption}}}{label}\n" if caption else ""
        return f"{head}\\begin{{table}}\n\\centering{SETUP}\n{above}{SHRINK}\n{table.rstrip()}%\n}}\n\\end{{table}}\n"
    font = next((one for one, share in FONTS.items() if needed * share < WIDTH), SPLIT)
    parts = []
    for number, columns in enumerate(_pieces(texts, WIDTH / FONTS[font])):
        chosen = None if best is None else best[columns]
        title, label = (caption, f"tab:{name}") if not number else (f"{caption} Continued.", f"tab:{name}-{number + 1}")
        parts.append(_table(texts[columns], chosen, title or "Results.", label))
    return f"{head}\\begingroup\\{font}{SETUP}\n{''.join(parts)}\\endgroup\n"


def escaped(text: str) -> str:
    """Return a text as LaTeX prints it."""
    return "".join(SPECIAL.get(sign, sign) for sign in text)


def _caption(about: Mapping[str, Any], name: str, bold: bool) -> str:
    told = [CAPTIONS.get(name, printable(name))] if name else []
    if bold:
        told.append("The best of each row is bold.")
    if "published" in about:
        told.append(f"An asterisk marks published results ({printable(about['published'])}).")
    facts = lines({key: about[key] for key in ("seeds", "commit") if key in about})
    told += [f"{fact[0].upper()}{fact[1:].replace(':', '', 1)}." for fact in facts]
    return escaped(" ".join(told))


def _pieces(texts: pd.DataFrame, room: float) -> list[list[str]]:
    """Split the columns into groups that are no wider than `room`, each with the texts that begin the rows."""
    names = list(texts.columns)
    first = next((k for k, name in enumerate(names) if _numbers(texts[name])), len(names))
    keys = names[:first]
    taken = sum(_broken(texts, name) + BETWEEN for name in keys)
    pieces: list[list[str]] = []
    left = 0.0
    for name in names[first:]:
        width = _broken(texts, name) + BETWEEN
        if not pieces or width > left:
            pieces.append([*keys])
            left = room - taken
        pieces[-1].append(name)
        left -= width
    return pieces or [keys]


def _width(texts: pd.DataFrame, name: str) -> float:
    """Return about how wide a column is, in points of the font of 10 points."""
    return CHARACTER * max(len(name), *(len(text) for text in texts[name])) if len(texts) else CHARACTER * len(name)


def _broken(texts: pd.DataFrame, name: str) -> float:
    """Return the width of a column of a longtable, where long texts are broken into lines, and formulae are not."""
    return _width(texts, name) if name == "term" else min(_width(texts, name), LONGEST * CHARACTER)


def _seen(texts: pd.DataFrame, name: str) -> float:
    """Return the same of a column as `_short` writes it."""
    if not texts[name].map(SCORE.fullmatch).astype(bool).any():
        return min(_width(texts, name), LONGEST * CHARACTER)
    scores = [(found["middle"], found["high"]) for text in texts[name] if (found := SCORE.fullmatch(text))]
    return CHARACTER * max(len(middle) + (5 if high else 0) for middle, high in scores)


def _lines(texts: pd.DataFrame, short: bool) -> int:
    """Return how many lines a table has, with those of broken texts and of spreads."""
    cells = texts.map(lambda text: 2 if "[" in text else min(-(-len(text) // LONGEST), 4)).clip(lower=1)
    return int(cells.max(axis=1).sum()) if short and len(texts.columns) else len(texts)


def _table(
    texts: pd.DataFrame, best: pd.DataFrame | None, caption: str = "", label: str = "", *, short: bool = False
) -> str:
    """Write a tabular, or a longtable where there is a caption; `short` of a table of errors, see `_short`."""
    style = texts.style.hide(axis="index").format_index(_upright if short else _text_cell, axis=1)
    columns = []
    for name in texts.columns:
        if short:
            columns.append(_short(style, texts, name))
            continue
        numbers = _numbers(texts[name])
        text = "l"
        if caption and _broken(texts, name) < _width(texts, name):
            text = f">{{\\raggedright\\arraybackslash}}p{{{LONGEST / 2.2:.0f}em}}"
        columns.append(_number_column(numbers) if numbers else text)
        cell = _term_cell if name == "term" else _number_cell if numbers else _text_cell
        style.format(cell, subset=[name])
    if best is not None:
        bold = best.map(lambda one: "bfseries: ;" if one else "").set_axis(texts.columns, axis=1)
        style.apply(lambda _: bold, axis=None)
    return style.to_latex(
        hrules=True, siunitx=True, column_format="".join(columns), environment="longtable" if caption else None,
        caption=caption or None, label=label or None,
    )  # fmt: skip


def _short(style: Styler, texts: pd.DataFrame, name: str) -> str:
    """Write the cells of a column of a table of errors, and return the column."""
    if texts[name].map(SCORE.fullmatch).astype(bool).any():
        style.format(_score_cell, subset=[name])
        return "r"
    style.format(_text_cell, subset=[name])
    long = _width(texts, name) > LONGEST * CHARACTER
    return f">{{\\raggedright\\arraybackslash}}p{{{LONGEST / 2.2:.0f}em}}" if long else "l"


def _upright(value: object) -> str:
    head = str(value)
    return f"\\rotatebox{{90}}{{{escaped(head)}}}" if len(head) > UPRIGHT else escaped(head)


def _score_cell(value: object) -> str:
    text = str(value)
    if found := LEAVES.fullmatch(text):
        return f"({_number(found[1])})"
    if not (found := SCORE.fullmatch(text)):
        return escaped(text)
    middle = _number(found["middle"])
    if found["low"] is None:
        return middle
    return f"\\shortstack[r]{{{middle}\\\\{{\\scriptsize[{_number(found['low'])}, {_number(found['high'])}]}}}}"


def _number(text: str) -> str:
    return "$\\infty$" if text == "inf" else f"\\num{{{text}}}"


def _numbers(column: pd.Series[str]) -> list[re.Match[str]]:
    return [found for text in column if (found := NUMBER.fullmatch(text))]


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


def _term_cell(value: object) -> str:
    return f"${Term(str(value)).latex}$"


def _text_cell(value: object) -> str:
    return escaped(str(value))


def _number_cell(value: object) -> str:
    """Write a number as siunitx reads it; braces keep other texts from being read as one."""
    text = str(value)
    if found := NUMBER.fullmatch(text):
        return text[: found.start(4) - 1] + f"e{int(found[4])}" if found[4] else text
    return f"{{{escaped(text)}}}" if text else ""
