"""Reading samples from files.

CSV and Parquet have the columns `t,u1..uN[,v1..vN][,f1..fN | f]` (real field) or `t,re1..reN,im1..imN[,f1..fN | f]`
(complex field), and a column `trajectory` where one file holds several. NPZ has the arrays
`t, u[, v, f, trajectory]` and is never unpickled. Missing values are empty cells or NaN.
"""

from __future__ import annotations

import csv
import io
import re
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.systems.errors import InputError
from latticebench.systems.files import DATA, LARGEST, check_regular, largest, read_text, reading, shown
from latticebench.systems.samples import Samples, check_alike
from latticebench.systems.stencil import Ends

if TYPE_CHECKING:
    import pandas
    import pyarrow
    from numpy import ndarray

FORMATS = (".csv", ".npz", ".parquet")
ARRAYS = ("t", "u", "v", "f", "trajectory")
# Characters of a cell; the longest number has some 25.
MOST_IN_A_CELL = 10_000


def read(path: Path, ends: Ends = "unknown") -> list[Samples]:
    """Return the trajectories of one file.

    Args:
        path: a CSV, NPZ or Parquet file.
        ends: how the chain ends.

    Raises:
        InputError: the file is missing, of another form, or holds invalid data; the message names file, row and column.
    """
    check_ending(path)
    check_regular(path)
    if path.stat().st_size == 0:
        raise InputError(f"{shown(path)}: the file is empty (0 bytes)")
    match path.suffix.lower():
        case ".npz":
            return _from_arrays(_read_npz(path), shown(path), ends)
        case ".csv":
            return _from_table(_read_csv(path), shown(path), ends)
        case _:
            return _from_table(_read_parquet(path), shown(path), ends)


def _check_count(values: int, path: Path) -> None:
    """Refuse more numbers than a file of the largest size could hold as they are.

    Raises:
        InputError: there are more, be it that a small file unpacks to them.
    """
    if 8 * values > largest(DATA):
        raise InputError(
            f"{shown(path)}: it holds {8 * values / 2**20:.0f} MiB of numbers, at most {largest(DATA) // 2**20} are "
            f"read; if it is meant to be so long, raise that with --largest-file or {LARGEST}"
        )


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
        raise InputError(f"{shown(path)}: the ending {shown(path.suffix)!r} is not one of {', '.join(FORMATS)}")


def _trajectories(arrays: dict[str, ndarray | None], labels: ndarray | None, source: str, ends: Ends) -> list[Samples]:
    """Return the samples of arrays t, u, v and f, one trajectory per label in order of first appearance."""
    t, u, v, f = (arrays[name] for name in ("t", "u", "v", "f"))
    assert t is not None
    assert u is not None
    if labels is None:
        return [Samples(t, u, v, f, None, source, ends)]
    found = []
    names, first, group = np.unique(labels, return_index=True, return_inverse=True)
    if 2 * len(names) > len(labels):
        alone = names[np.argmin(np.bincount(group))]
        raise InputError(f"{source}, trajectory {alone}: it has 1 row(s) of data; a motion needs at least 2")
    members = np.split(np.argsort(group, kind="stable"), np.cumsum(np.bincount(group))[:-1])
    for number in np.argsort(first):
        label, rows = names[number], members[number]
        own_v, own_f = (None if array is None else array[rows] for array in (v, f))
        found.append(Samples(t[rows], u[rows], own_v, own_f, None, f"{source}, trajectory {label}", ends))
    return found


# CSV and Parquet


def _read_parquet(path: Path) -> pandas.DataFrame:
    """Return a table of floats, NaN where a value is missing, and of labels."""
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with reading(path, DATA) as handle, pq.ParquetFile(handle) as file:
            schema, about = file.schema_arrow, file.metadata
            _check_count(about.num_rows * about.num_columns, path)
            header = _named_once([name.strip() for name in schema.names], path)
            _check_header(header, shown(path))
            columns = {}
            for name, kind, column in zip(header, schema.types, file.read().itercolumns(), strict=True):
                if name == "trajectory" and (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
                    columns[name] = column.to_numpy()
                    continue
                _check_type(kind, name, path)
                columns[name] = column.cast(pa.float64()).to_numpy()
    except InputError:
        raise
    # A damaged file fails in many ways.
    except Exception as error:
        raise InputError(f"{shown(path)}: not a Parquet file: {str(error).partition(chr(10))[0]}") from None
    if "trajectory" in columns:
        columns["trajectory"] = columns["trajectory"].astype(str)
    return pd.DataFrame(columns)


def _check_type(kind: pyarrow.DataType, name: str, path: Path) -> None:
    import pyarrow as pa

    if pa.types.is_temporal(kind):
        raise InputError(f"{shown(path)}: column {name}: dates are not numbers; give the time since the first row")
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)):
        raise InputError(
            f"{shown(path)}: row 1, column {name}: it holds values of type {kind}, not numbers; write it as float64"
        )


def _read_csv(path: Path) -> pandas.DataFrame:
    """Return a table of texts, NaN where a cell is empty."""
    import pandas as pd

    text = read_text(path, DATA).removeprefix("\ufeff")
    _check_count(text.count(","), path)
    try:
        # The header is read as a row, so that a column that occurs twice is seen before pandas renames it.
        raw = pd.read_csv(io.StringIO(text), header=None, comment="#", skipinitialspace=True, dtype=str)
    except pd.errors.EmptyDataError:
        raise InputError(f"{shown(path)}: the file is empty; its first line must be a header such as t,u1,u2") from None
    except pd.errors.ParserError as error:
        reason = str(error).strip().splitlines()[0].removeprefix("Error tokenizing data. C error: ")
        raise InputError(
            f"{shown(path)}: not a table: {reason}; every row needs as many values as the header"
        ) from None
    except (ValueError, OverflowError) as error:
        raise InputError(f"{shown(path)}: not a table: {error}") from None
    header = _named_once([str(name).strip()[:MOST_IN_A_CELL] for name in raw.iloc[0]], path)
    body = raw.iloc[1:].reset_index(drop=True)
    body.columns = pd.Index(header)
    if body.iloc[:, -1].isna().any():
        _refuse_short_rows(text, len(header), path)
    return body


def _named_once(header: list[str], path: Path) -> list[str]:
    """Return a header, unless a column occurs twice."""
    seen = set()
    for name in header:
        if name in seen:
            raise InputError(f"{shown(path)}: the column {_quoted(name)} occurs twice; leave one out")
        seen.add(name)
    return header


def _quoted(text: str) -> str:
    """Return the beginning of a text of the user's in quotes."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _refuse_short_rows(text: str, width: int, path: Path) -> None:
    """Refuse rows that end early, as in a file that was cut off; pandas fills them up with gaps."""
    rows = csv.reader(line.partition("#")[0] for line in io.StringIO(text, newline=""))
    try:
        for number, row in enumerate(row for row in rows if "".join(row).strip()):
            if len(row) < width:
                raise InputError(
                    f"{shown(path)}: row {number}: it has {len(row)} value(s), the header {width}; the row was cut "
                    "off, or a missing value needs its comma"
                )
    except csv.Error as error:
        raise InputError(f"{shown(path)}: line {rows.line_num}: {error}; a cell holds one number") from None


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
                f"{source}: unknown column {_quoted(column)}; known: u1.., v1.., f1.. or f, re1.., im1.., t, trajectory"
            )


NUMBER = r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|inf(inity)?)|nan"


def _numbers(table: pandas.DataFrame, column: str, source: str) -> ndarray:
    """Return the values of a column, NaN where they are missing."""
    given = table[column]
    if given.dtype.kind == "f":
        return given.to_numpy()
    # Not by pandas, whose reader of numbers reads beyond the end of some damaged texts.
    text = given.str.strip()
    wrong = given.notna() & ~text.str.fullmatch(NUMBER, flags=re.ASCII | re.IGNORECASE, na=False)
    if wrong.any():
        row = int(np.flatnonzero(wrong.to_numpy())[0])
        raise InputError(
            f"{source}: row {row + 1}, column {column}: {_quoted(given.iloc[row])} is not a number; "
            "leave the cell empty if the value is missing"
        )
    return np.array([float(value) for value in text.where(given.notna(), np.nan)])


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
    """Return the arrays, whose names, types and sizes are looked at before they are unpacked."""
    try:
        with reading(path, DATA) as handle:
            if handle.peek(1)[:1] != b"P":  # type: ignore[attr-defined]
                np.load(handle, allow_pickle=False)
                raise ValueError("it holds one array without a name")
            with zipfile.ZipFile(handle) as archive:
                members = {one.filename.removesuffix(".npy"): one for one in archive.infolist()}
                if len(members) < len(archive.infolist()):
                    raise ValueError("an array occurs twice")
                _check_names(list(members), shown(path))
                shapes = {name: _shape(archive, one, name, path) for name, one in members.items()}
                _check_count(sum(int(np.prod(shape, dtype=object)) for shape in shapes.values()), path)
                return {name: _array(archive, one) for name, one in members.items()}
    except InputError:
        raise
    # A damaged archive fails in many ways: zipfile's, zlib's, NumPy's.
    except Exception as error:
        reason = "it holds pickled objects, which are never loaded" if "pickle" in str(error).lower() else str(error)
        raise InputError(
            f"{shown(path)}: not an NPZ file of plain arrays: {reason}; write it with numpy.savez(path, t=t, u=u)"
        ) from None


def _shape(archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str, path: Path) -> tuple[int, ...]:
    """Return the shape that the head of an array tells.

    Raises:
        InputError: it is no array, or one of other things than numbers.
        ValueError: it holds objects.
    """
    with archive.open(member) as file:
        if file.read(len(np.lib.format.MAGIC_PREFIX)) != np.lib.format.MAGIC_PREFIX:
            raise InputError(f"{shown(path)}: {name!r} is not an array; write it with numpy.savez(path, t=t, u=u)")
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        head: Any = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, kind = head(file)
    if kind.hasobject:
        raise ValueError("pickled objects")
    if kind.kind not in ("fiuc" if name != "trajectory" else "fiuU") or kind.itemsize > 1000:
        raise InputError(f"{shown(path)}: array {name}: its values are {kind}, not numbers")
    return tuple(shape)


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> ndarray:
    with archive.open(member) as file:
        found: ndarray = np.lib.format.read_array(file, allow_pickle=False)
        return found


def _from_arrays(arrays: dict[str, ndarray], source: str, ends: Ends) -> list[Samples]:
    _check_times(arrays["t"], source)
    t, labels = arrays["t"], arrays.get("trajectory")
    u, v, f = (_matrix(arrays, name, source) for name in ("u", "v", "f"))
    assert u is not None
    if f is not None and f.shape[1] == 1:
        f = np.repeat(f, u.shape[1], axis=1)
    if labels is not None and labels.shape != t.shape:
        raise InputError(f"{source}: array trajectory has shape {labels.shape}; it must be {t.shape}")
    return _trajectories({"t": t.astype(float), "u": u, "v": v, "f": f}, labels, source, ends)


def _check_names(names: Sequence[str], source: str) -> None:
    """Refuse missing and unknown arrays."""
    for name in ("t", "u"):
        if name not in names:
            raise InputError(f"{source}: the array {name!r} is missing; there are: {', '.join(map(_quoted, names))}")
    for name in names:
        if name not in ARRAYS:
            raise InputError(f"{source}: unknown array {_quoted(name)}; known: {', '.join(ARRAYS)}")


def _check_times(t: ndarray, source: str) -> None:
    """Refuse times that are complex or not (T,)."""
    if t.dtype.kind == "c":
        raise InputError(f"{source}: array t: times are real")
    if t.ndim != 1:
        raise InputError(f"{source}: array t has shape {t.shape}; it must be (T,)")


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
