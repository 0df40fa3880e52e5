"""Reading samples from files.

CSV and Parquet have the columns `t,u1..uN[,v1..vN][,f1..fN | f]` (real field) or `t,re1..reN,im1..imN[,f1..fN | f]`
(complex field), and a column `trajectory` where one file holds several. NPZ has the arrays
`t, u[, v, f, trajectory]` and is never unpickled. Missing values are empty cells or NaN.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.errors import InputError
from latticebench.systems.samples import Samples, check_alike
from latticebench.systems.stencil import Ends

if TYPE_CHECKING:
    import pandas
    from numpy import ndarray

FORMATS = (".csv", ".npz", ".parquet")


def read(path: Path, ends: Ends = "unknown") -> list[Samples]:
    """Return the trajectories of one file.

    Args:
        path: a CSV, NPZ or Parquet file.
        ends: how the chain ends.

    Raises:
        InputError: the file is missing, of another form, or holds invalid data; the message names file, row and column.
    """
    check_ending(path)
    if path.is_dir():
        raise InputError(f"{path}: a folder, not a file")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty (0 bytes)")
    match path.suffix.lower():
        case ".npz":
            return _from_arrays(_read_npz(path), str(path), ends)
        case ".csv":
            return _from_table(_read_csv(path), str(path), ends)
        case _:
            return _from_table(_read_parquet(path), str(path), ends)


def read_all(paths: Sequence[Path], ends: Ends = "unknown") -> list[Samples]:
    """Return the trajectories of several files, which must have the same sites and columns.

    Raises:
        InputError: a file is invalid, or two of them differ.
    """
    data = [samples for path in paths for samples in read(path, ends)]
    check_alike(data)
    return data


def check_ending(path: Path) -> None:
    """Check that the ending of a path is one of `FORMATS`, in small letters or capitals.

    Raises:
        InputError: it is not.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: the ending {path.suffix!r} is not one of {', '.join(FORMATS)}")


def _trajectories(arrays: dict[str, ndarray | None], labels: ndarray | None, source: str, ends: Ends) -> list[Samples]:
    """Return the samples of arrays t, u, v and f, one trajectory per label in order of first appearance."""
    t, u, v, f = (arrays[name] for name in ("t", "u", "v", "f"))
    assert t is not None
    assert u is not None
    if labels is None:
        return [Samples(t, u, v, f, None, source, ends)]
    found = []
    for label in dict.fromkeys(labels.tolist()):
        rows = labels == label
        own_v, own_f = (None if array is None else array[rows] for array in (v, f))
        found.append(Samples(t[rows], u[rows], own_v, own_f, None, f"{source}, trajectory {label}", ends))
    return found


# CSV and Parquet


def _read_parquet(path: Path) -> pandas.DataFrame:
    import pandas as pd

    try:
        table = pd.read_parquet(path)
    except Exception as error:
        raise InputError(f"{path}: not a Parquet file: {str(error).splitlines()[0]}") from None
    table.columns = pd.Index(_named_once([str(column).strip() for column in table.columns], path))
    return table


def _read_csv(path: Path) -> pandas.DataFrame:
    import pandas as pd

    try:
        # The header is read as a row, so that a column that occurs twice is seen before pandas renames it.
        raw = pd.read_csv(path, header=None, comment="#", skipinitialspace=True, dtype=str, encoding="utf-8")
    except pd.errors.EmptyDataError:
        raise InputError(f"{path}: the file is empty; its first line must be a header such as t,u1,u2") from None
    except pd.errors.ParserError as error:
        reason = str(error).strip().splitlines()[0].removeprefix("Error tokenizing data. C error: ")
        raise InputError(f"{path}: not a table: {reason}; every row needs as many values as the header") from None
    except (UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path}: not a text file (UTF-8): {error}") from None
    header = _named_once([str(name).strip() for name in raw.iloc[0]], path)
    body = raw.iloc[1:].reset_index(drop=True)
    body.columns = pd.Index(header)
    if body.iloc[:, -1].isna().any():
        _refuse_short_rows(path, len(header))
    return body


def _named_once(header: list[str], path: Path) -> list[str]:
    """Return a header, unless a column occurs twice."""
    for name in header:
        if header.count(name) > 1:
            raise InputError(f"{path}: the column {name!r} occurs twice; leave one out")
    return header


def _refuse_short_rows(path: Path, width: int) -> None:
    """Refuse rows that end early, as in a file that was cut off; pandas fills them up with gaps."""
    with path.open(encoding="utf-8", newline="") as lines:
        rows = (row for row in csv.reader(line.partition("#")[0] for line in lines) if "".join(row).strip())
        for number, row in enumerate(rows):
            if len(row) < width:
                raise InputError(
                    f"{path}: row {number}: it has {len(row)} value(s), the header {width}; the row was cut off, or a "
                    "missing value needs its comma"
                )


def _from_table(table: pandas.DataFrame, source: str, ends: Ends) -> list[Samples]:
    columns = list(table.columns)
    _check_header(columns, source)
    if len(table) == 0:
        raise InputError(f"{source}: it has 0 row(s) of data; a motion needs at least 2")
    numbers = {column: _numbers(table, column, source) for column in columns if column != "trajectory"}
    u, v, f, real, imaginary = (_field(numbers, prefix, source) for prefix in ("u", "v", "f", "re", "im"))
    if (real is None) != (imaginary is None) or (u is None) == (real is None):
        raise InputError(f"{source}: give either columns u1..uN (real field) or re1..reN and im1..imN (complex field)")
    if real is not None and imaginary is not None:
        if real.shape != imaginary.shape:
            raise InputError(
                f"{source}: {real.shape[1]} columns re but {imaginary.shape[1]} columns im; they must be the same"
            )
        u = real + 1j * imaginary
    assert u is not None
    if "f" in numbers:
        if f is not None:
            raise InputError(f"{source}: both f and f1.. are there; keep one of them")
        f = np.repeat(numbers["f"][:, None], u.shape[1], axis=1)
    labels = table["trajectory"].astype(str).to_numpy() if "trajectory" in columns else None
    return _trajectories({"t": numbers["t"], "u": u, "v": v, "f": f}, labels, source, ends)


def _check_header(columns: list[str], source: str) -> None:
    """Refuse a table without times or with unknown columns."""
    if any(sign in column for column in columns for sign in (";", "\t")):
        raise InputError(f"{source}: the columns are separated by something else; separate them by commas")
    if "t" not in columns:
        raise InputError(
            f"{source}: there is no column t; the header must be t,u1..uN[,v1..vN][,f1..fN] or t,re1..reN,im1..imN"
        )
    for column in columns:
        if not re.fullmatch(r"t|f|trajectory|(u|v|f|re|im)[1-9]\d{0,5}", column):
            raise InputError(
                f"{source}: unknown column {column!r}; known: u1.., v1.., f1.. or f, re1.., im1.., t, trajectory"
            )


def _numbers(table: pandas.DataFrame, column: str, source: str) -> ndarray:
    """Return the values of a column, NaN where they are missing."""
    import pandas as pd

    given = table[column]
    if pd.api.types.is_datetime64_any_dtype(given) or pd.api.types.is_timedelta64_dtype(given):
        raise InputError(f"{source}: column {column}: dates are not numbers; give the time since the first row")
    values = pd.to_numeric(given, errors="coerce")
    wrong = values.isna() & given.notna() & (given.astype(str).str.strip().str.lower() != "nan")
    if wrong.any():
        row = int(np.flatnonzero(wrong.to_numpy())[0])
        raise InputError(
            f"{source}: row {row + 1}, column {column}: {str(given.iloc[row])[:40]!r} is not a number; "
            "leave the cell empty if the value is missing"
        )
    # pandas reads numbers in texts fast, but not to the last digit; Python does.
    return np.array([float(value) for value in given.where(values.notna(), np.nan)])


def _field(numbers: dict[str, ndarray], prefix: str, source: str) -> ndarray | None:
    """Return the columns `prefix`1, `prefix`2, ... as an array (T, N), or None if there are none."""
    found = sorted(int(name[len(prefix) :]) for name in numbers if re.fullmatch(rf"{prefix}\d+", name))
    if not found:
        return None
    if found != list(range(1, len(found) + 1)):
        missing = next(k for k in range(1, len(found) + 1) if k not in found)
        raise InputError(
            f"{source}: column {prefix}{missing} is missing; sites are numbered {prefix}1, {prefix}2, ... without gaps"
        )
    return np.column_stack([numbers[f"{prefix}{k}"] for k in found])


# NPZ


def _read_npz(path: Path) -> dict[str, ndarray]:
    try:
        # Opened here, so that it is closed when NumPy gives up.
        with path.open("rb") as handle:
            stored = np.load(handle, allow_pickle=False)
            if not isinstance(stored, np.lib.npyio.NpzFile):
                raise ValueError("it holds one array without a name")
            with stored:
                return {name: stored[name] for name in stored.files}
    # A damaged archive fails in many ways: zipfile's, zlib's, NumPy's.
    except Exception as error:
        reason = "it holds pickled objects, which are never loaded" if "pickle" in str(error).lower() else str(error)
        raise InputError(
            f"{path}: not an NPZ file of plain arrays: {reason}; write it with numpy.savez(path, t=t, u=u)"
        ) from None


def _from_arrays(arrays: dict[str, ndarray], source: str, ends: Ends) -> list[Samples]:
    _check_arrays(arrays, source)
    t, labels = arrays["t"], arrays.get("trajectory")
    u, v, f = (_matrix(arrays, name, source) for name in ("u", "v", "f"))
    assert u is not None
    if f is not None and f.shape[1] == 1:
        f = np.repeat(f, u.shape[1], axis=1)
    if labels is not None and labels.shape != t.shape:
        raise InputError(f"{source}: array trajectory has shape {labels.shape}; it must be {t.shape}")
    return _trajectories({"t": t.astype(float), "u": u, "v": v, "f": f}, labels, source, ends)


def _check_arrays(arrays: dict[str, ndarray], source: str) -> None:
    """Refuse missing and unknown arrays, those that hold no numbers, and times that are complex or not (T,)."""
    for name in ("t", "u"):
        if name not in arrays:
            raise InputError(f"{source}: the array {name!r} is missing; there are: {', '.join(arrays) or 'none'}")
    for name, array in arrays.items():
        if name not in ("t", "u", "v", "f", "trajectory"):
            raise InputError(f"{source}: unknown array {name!r}; known: t, u, v, f, trajectory")
        if not isinstance(array, np.ndarray):
            raise InputError(f"{source}: {name!r} is not an array; write it with numpy.savez(path, t=t, u=u)")
        if name != "trajectory" and array.dtype.kind not in "fiuc":
            raise InputError(f"{source}: array {name}: its values are {array.dtype}, not numbers")
    if arrays["t"].dtype.kind == "c":
        raise InputError(f"{source}: array t: times are real")
    if arrays["t"].ndim != 1:
        raise InputError(f"{source}: array t has shape {arrays['t'].shape}; it must be (T,)")


def _matrix(arrays: dict[str, ndarray], name: str, source: str) -> ndarray | None:
    """Return an array as (T, N) floating-point or complex numbers, or None if it is not there."""
    if name not in arrays:
        return None
    array, count = arrays[name], len(arrays["t"])
    array = array.astype(complex if array.dtype.kind == "c" else float)
    if array.ndim == 1:
        array = array.reshape(-1, 1)
    if array.ndim != 2 or len(array) != count:
        raise InputError(
            f"{source}: array {name} has shape {array.shape}; it must be ({count}, N) as t has {count} times"
        )
    return array
