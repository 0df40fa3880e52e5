"""Texts of a user's at the exits: what is a label is shown as one, and steers no reader of a file."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from latticebench.systems.errors import printable

if TYPE_CHECKING:
    import pandas as pd

# A cell that begins so is a formula to a spreadsheet, unless it is a number.
FORMULA = ("=", "+", "-", "@")
# What a less-than sign must stand before for it to begin an element of HTML, a remark, or a link.
BEGINS = re.compile(r"<(?=[A-Za-z/!?])")
# Signs that end a cell or begin mathematics.
SIGNS = str.maketrans({"|": r"\|", "$": "&#36;"})
NUMBER = re.compile(r"[+-]?(inf|nan|(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?)")


def markdown(text: str) -> str:
    """Return a text for a cell of a Markdown table: it begins no HTML or mathematics, is no link, and ends no cell."""
    return re.sub(r"\](?=[(\[])", "&#93;", BEGINS.sub("&lt;", printable(text))).translate(SIGNS)


def csv_cell(value: Any) -> Any:
    """Return a value of a table for a CSV file: a text that a spreadsheet would compute begins with an apostrophe."""
    if not isinstance(value, str):
        return value
    text = printable(value)
    return f"'{text}" if text.startswith((*FORMULA, "'")) and not NUMBER.fullmatch(text) else text


def csv_text(cell: str) -> str:
    """Return the text that a cell of a CSV file holds, without the apostrophe of `csv_cell`."""
    return cell[1:] if cell[:1] == "'" and cell[1:2] in (*FORMULA, "'") else cell


def csv_table(frame: pd.DataFrame) -> str:
    """Return a table as CSV, with all digits."""
    safe = frame.map(csv_cell)
    safe.columns = [csv_cell(str(name)) for name in frame.columns]
    return str(safe.to_csv(index=False))


def label(text: str) -> str:
    """Return a text for a figure, where dollar signs would begin mathematics and an underscore hide a label."""
    shown = printable(text).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown
