"""Tables of texts from CSV files and spreadsheets as instruments and people write them.

The header is the first row that has the column of the times; rows above it are skipped. Values are separated by commas,
semicolons, tabs or spaces; where not by commas, decimals may be written with a comma. A row of units may follow the
header. `#` begins a remark.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from latticebench.systems.errors import InputError
from latticebench.systems.files import DATA, LARGEST, largest, read_bytes, read_text, reading, shown
from latticebench.systems.layout import Layout, is_unit, quoted

if TYPE_CHECKING:
    import pandas

SEPARATORS = (",", ";", "\t", " ")
NAMES = {";": "semicolons", "\t": "tabs", " ": "spaces"}
# Rows that a header is looked for in.
MOST_HEAD = 200
# Characters of a cell; the longest number has some 25.
MOST_IN_A_CELL = 10_000
# What tables have in the place of a value that is missing.
DASHES = ("-", "--", "---", "\N{EN DASH}", "\N{EM DASH}")
NUMBER = re.compile(r"\s*[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?\s*|\s*nan\s*", re.IGNORECASE)
COMMA = r"\s*[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?\s*"


@dataclass(frozen=True, eq=False)
class Table:
    """A table of texts.

    Attributes:
        body: the rows below the header, NaN where a cell is empty.
        units: of columns, by name, where a row of units follows the header.
        notes: how it was read, where that is not plain.
    """

    body: pandas.DataFrame
    units: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


# Text files -----------------------------------------------------------------------------------------------------------


def read_csv(path: Path, layout: Layout) -> Table:
    """Return the table of a text file.

    Raises:
        InputError: it is no table.
    """
    import pandas as pd

    text, notes = _decoded(path)
    check_count(max(text.count(one) for one in SEPARATORS[:3]), path)
    number, separator, remark = _head_of_text(text, layout.time or "t")
    above, rest = _parted(text, number)
    skipped = sum(1 for line in above if line.strip() and not line.lstrip().startswith("#"))
    # Empty lines keep the numbers of the others.
    text = "\n" * number + (rest.lstrip("# ") if remark else rest)
    try:
        # The header is read as a row, so that a column that occurs twice is seen before pandas renames it.
        raw = pd.read_csv(
            io.StringIO(text), header=None, comment="#", skipinitialspace=True, dtype=str,
            sep=r"\s+" if separator == " " else separator,
        )  # fmt: skip
    except pd.errors.EmptyDataError:
        raise InputError(f"{shown(path)}: the file is empty; its first line must be a header such as t,u1,u2") from None
    except pd.errors.ParserError as error:
        reason = str(error).strip().splitlines()[0].removeprefix("Error tokenizing data. C error: ")
        raise InputError(
            f"{shown(path)}: not a table: {reason}; every row needs as many values as the header"
        ) from None
    except (ValueError, OverflowError) as error:
        raise InputError(f"{shown(path)}: not a table: {error}") from None
    if separator != " " and raw.iloc[1:, -1].isna().any() and pd.notna(raw.iloc[0, -1]):
        _refuse_short_rows(text, raw.shape[1], separator, path)
    if separator in NAMES:
        notes.append(f"values are separated by {NAMES[separator]}")
        if _with_points(raw):
            notes.append("decimals are written with commas")
    return _with_header(raw, path, (*_skipped(skipped), *notes))


def _decoded(path: Path) -> tuple[str, list[str]]:
    """Return the text of a file in UTF-8, or as older programs write it, with what is to be said of that."""
    notes = []
    content = read_bytes(path, DATA)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        try:
            text = content.decode("utf-16")
        except UnicodeDecodeError as error:
            raise InputError(f"{shown(path)}: not a text file (UTF-16): {error.reason}; save it as one") from None
    else:
        try:
            content.decode("utf-8")
            text = read_text(path, DATA)
        except UnicodeDecodeError:
            # Signs that no text has tell other files from texts of older programs.
            if re.search(rb"[\x00-\x08\x0e-\x1f\x7f\x81\x8d\x8f\x90\x9d]", content):
                text = read_text(path, DATA)
            text = content.decode("cp1252")
            notes.append("the text is not UTF-8: it is read as Windows-1252")
    return text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n"), notes


def _parted(text: str, number: int) -> tuple[list[str], str]:
    """Return the first lines of a text, and the rest."""
    parts = text.split("\n", number)
    return parts[:number], parts[number]


def _head_of_text(text: str, time: str) -> tuple[int, str, bool]:
    """Return the line of the header, the separator and whether it is a remark; the first line where none is found."""
    lines = text.split("\n", MOST_HEAD)[:MOST_HEAD]
    for remarks in (False, True):
        for separator in SEPARATORS:
            rows = [_cells(line, separator, remarks=remarks) for line in lines]
            number = _head(rows, lambda row: time in row, equal=separator == " " or remarks)
            if number is not None:
                return number, separator, remarks
    guesses = []
    for separator in SEPARATORS:
        rows = [_cells(line, separator) for line in lines]
        number = _head(rows, lambda row: sum(bool(NUMBER.fullmatch(cell)) for cell in row) < len(row) / 2, equal=True)
        if number is not None:
            guesses.append((len(rows[number]), number, separator))
    # Of separators that make tables of a text, the one that leaves most columns; a comma where several do.
    if guesses:
        _, number, separator = max(guesses, key=lambda one: one[0])
        return number, separator, False
    return (
        next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), 0),
        ",",
        False,
    )


def _cells(line: str, separator: str, *, remarks: bool = False) -> list[str]:
    """Return the cells of a line; none of a remark, unless these are looked at."""
    if line.lstrip().startswith("#"):
        line = line.lstrip("# ") if remarks else ""
    if separator == " ":
        return line.split()
    try:
        cells = next(csv.reader([line.partition("#")[0]], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        cells = line.split(separator)
    return [cell.strip() for cell in cells]


def _head(rows: Sequence[Sequence[str]], is_head: Callable[[Sequence[str]], bool], *, equal: bool) -> int | None:
    """Return the first row of several names that is a header; with `equal`, one of numbers must follow, as wide."""
    for number, row in enumerate(rows):
        if len(row) < 2 or not is_head(row):
            continue
        after = next((other for other in rows[number + 1 :] if other and any(other)), None)
        if not equal or (after is not None and len(after) == len(row) and _is_data(after)):
            return number
    return None


def _is_data(row: Sequence[str]) -> bool:
    """Return whether a row holds numbers, or units."""
    told = [cell for cell in row if cell]
    return sum(bool(NUMBER.fullmatch(cell)) or is_unit(cell) for cell in told) >= len(told) / 2 > 0


def _refuse_short_rows(text: str, width: int, separator: str, path: Path) -> None:
    """Refuse rows that end early, as in a file that was cut off; pandas fills them up with gaps."""
    rows = csv.reader((line.partition("#")[0] for line in io.StringIO(text, newline="")), delimiter=separator)
    try:
        for number, row in enumerate(row for row in rows if "".join(row).strip()):
            if len(row) < width:
                raise InputError(
                    f"{shown(path)}: row {number}: it has {len(row)} value(s), the header {width}; the row was cut "
                    "off, or a missing value needs its separator"
                )
    except csv.Error as error:
        raise InputError(f"{shown(path)}: line {rows.line_num}: {error}; a cell holds one number") from None


def _with_points(raw: pandas.DataFrame) -> bool:
    """Replace commas in decimals by points, column by column; return whether there were any."""
    found = False
    for name in raw.columns:
        commas = raw[name].iloc[1:].str.fullmatch(COMMA, na=False).astype(bool)
        # A column with both is left as it is, and refused at its first comma.
        if commas.any() and not raw[name].iloc[1:].str.contains(".", regex=False, na=False).any():
            column = raw[name].copy()
            column.iloc[1:] = column.iloc[1:].str.replace(",", ".", regex=False)
            raw[name] = column
            found = True
    return found


# Spreadsheets ---------------------------------------------------------------------------------------------------------


def read_sheet(path: Path, layout: Layout) -> Table:
    """Return a table of a spreadsheet (.xlsx), with the values that its formulas had when it was saved.

    It is the first sheet that names the column of the times, or the first of all.

    Raises:
        InputError: it is no spreadsheet, or holds no table.
    """
    import pandas as pd

    try:
        with reading(path, DATA) as handle:
            with zipfile.ZipFile(handle) as archive:
                size = sum(one.file_size for one in archive.infolist())
            if size > largest(DATA):
                raise InputError(
                    f"{shown(path)}: it unpacks to {size / 2**20:.0f} MiB, at most {largest(DATA) // 2**20} are read; "
                    f"if it is meant to be so long, raise that with --largest-file or {LARGEST}"
                )
            handle.seek(0)
            rows, notes = _rows_of_sheet(handle, path, layout.time or "t")
    except InputError:
        raise
    # A damaged file fails in many ways: zipfile's, the XML parser's, openpyxl's.
    except Exception as error:
        raise InputError(
            f"{shown(path)}: not a spreadsheet: {str(error).partition(chr(10))[0]}; save it anew as .xlsx or as .csv"
        ) from None
    first = [[cell or "" for cell in row] for row in rows[:MOST_HEAD]]
    number = _head(first, lambda row: (layout.time or "t") in row, equal=False)
    if number is None:
        number = _head(first, lambda row: not any(NUMBER.fullmatch(cell) for cell in row), equal=True) or 0
    skipped = sum(1 for row in first[:number] if any(row))
    return _with_header(pd.DataFrame(rows[number:], dtype=object), path, (*_skipped(skipped), *notes))


def _rows_of_sheet(handle: Any, path: Path, time: str) -> tuple[list[list[str | None]], list[str]]:
    """Return the cells of the sheet with the times as texts, and what is to be said of it."""
    import openpyxl

    book = openpyxl.load_workbook(handle, read_only=True, data_only=True)
    sheet = next((one for one in book.worksheets if _names(one, time)), book.worksheets[0])
    rows: list[list[str | None]] = []
    cells = 0
    for row in sheet.iter_rows(values_only=True):
        cells += len(row)
        check_count(cells, path)
        if any(cell is not None for cell in row):
            rows.append([None if cell is None else _written(cell) for cell in row])
    if len(rows) < 2:
        raise InputError(
            f"{shown(path)}: sheet {quoted(sheet.title)} has {len(rows)} row(s); it needs a header and data"
        )
    if any(None in row for row in rows):
        _check_formulas(handle, sheet, path)
    width = max(len(row) for row in rows)
    others = [one.title for one in book.worksheets if one is not sheet]
    notes = [f"sheet {quoted(sheet.title)} is read, not {', '.join(map(quoted, others))}"] if others else []
    return [[*row, *[None] * (width - len(row))] for row in rows], notes


def _check_formulas(handle: Any, sheet: Any, path: Path) -> None:
    """Refuse formulas whose values are not in the file, as where no spreadsheet program has ever saved it.

    Raises:
        InputError: there is one.
    """
    import openpyxl

    handle.seek(0)
    formulas = openpyxl.load_workbook(handle, read_only=True)[sheet.title]
    every = zip(sheet.iter_rows(values_only=True), formulas.iter_rows(values_only=True), strict=False)
    for number, (values, texts) in enumerate(every, 1):
        for place, (value, text) in enumerate(zip(values, texts, strict=False), 1):
            if value is None and isinstance(text, str) and text.startswith("="):
                raise InputError(
                    f"{shown(path)}: row {number}, column {place}: a formula whose value is not in the file; open it "
                    "in a spreadsheet program and save it"
                )


def _names(sheet: Any, name: str) -> bool:
    """Return whether one of the first rows of a sheet has a cell with a name."""
    return any(name in map(_written, row) for row in sheet.iter_rows(max_row=MOST_HEAD, values_only=True))


def _written(cell: Any) -> str:
    """Return a cell as text; numbers to their last digit."""
    return cell.isoformat() if hasattr(cell, "isoformat") else str(cell).strip()


# Both -----------------------------------------------------------------------------------------------------------------


def check_count(values: int, path: Path) -> None:
    """Refuse more numbers than a file of the largest size could hold as they are.

    Raises:
        InputError: there are more, be it that a small file unpacks to them.
    """
    if 8 * values > largest(DATA):
        raise InputError(
            f"{shown(path)}: it holds {8 * values / 2**20:.0f} MiB of numbers, at most {largest(DATA) // 2**20} are "
            f"read; if it is meant to be so long, raise that with --largest-file or {LARGEST}"
        )


def named_once(header: Sequence[str], path: Path) -> list[str]:
    """Return a header, unless a column occurs twice."""
    seen = set()
    for name in header:
        if name in seen and name:
            raise InputError(f"{shown(path)}: the column {quoted(name)} occurs twice; leave one out")
        seen.add(name)
    return list(header)


def _skipped(count: int) -> tuple[str, ...]:
    return (f"{count} row(s) above the table were skipped",) if count else ()


def _with_header(raw: pandas.DataFrame, path: Path, notes: tuple[str, ...]) -> Table:
    """Return a table whose first row is its header, and perhaps its second one its units."""
    import pandas as pd

    header = ["" if pd.isna(name) else str(name).strip()[:MOST_IN_A_CELL] for name in raw.iloc[0]]
    # A separator at the end of each row makes an empty column.
    kept = [k for k, name in enumerate(header) if name or not raw.iloc[1:, k].isna().all()]
    header = named_once([header[k] for k in kept], path)
    body = raw.iloc[1:, kept].reset_index(drop=True)
    body.columns = pd.Index(header)
    units: dict[str, str] = {}
    if len(body):
        second = ["" if pd.isna(cell) else str(cell).strip() for cell in body.iloc[0]]
        units = {name: cell for name, cell in zip(header, second, strict=True) if is_unit(cell)}
        # A column without a unit has nothing there, or a dash.
        others = {cell for cell in second if not is_unit(cell)}
        if units and others <= {"", *DASHES} and not any(map(NUMBER.fullmatch, second)):
            body = body.iloc[1:].reset_index(drop=True)
        else:
            units = {}
    return Table(body, units, notes)
