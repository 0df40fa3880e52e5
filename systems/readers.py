"""Reading samples from files.

As this project writes them, CSV and Parquet have the columns `t,u1..uN[,v1..vN][,f1..fN | f]` (real field) or
`t,re1..reN,im1..imN[,f1..fN | f]` (complex field), and a column `trajectory` where one file holds several. NPZ has the
arrays `t, u[, v, f, trajectory]` and is never unpickled. Missing values are empty cells or NaN. A `Layout` says where
else times and readings are, and in which units; text files and spreadsheets may look as `latticebench.systems.tables`
says.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.systems.errors import InputError
from latticebench.systems.files import DATA, check_regular, reading, shown
from latticebench.systems.folders import ZARR, files_in, partition, zarr_arrays
from latticebench.systems.layout import UNITS, Layout, choose, quoted
from latticebench.systems.npz import ARRAYS, check_names, read_npz
from latticebench.systems.options import option
from latticebench.systems.ordering import averaged, in_order, unwrapped
from latticebench.systems.samples import Origin, Samples, check_alike, check_units
from latticebench.systems.stencil import Ends
from latticebench.systems.tables import DASHES, Table, check_count, named_once, read_csv, read_sheet
from latticebench.systems.timing import evened

if TYPE_CHECKING:
    import pandas
    import pyarrow
    from numpy import ndarray
    from numpy.typing import ArrayLike

    from latticebench.systems.ordering import Arrays

# What is written and read, and what is only read.
FORMATS = (".csv", ".npz", ".parquet")
OTHERS = (".txt", ".tsv", ".dat", ".xlsx")
PLAIN = Layout()


def read(path: Path, ends: Ends = "unknown", layout: Layout = PLAIN) -> list[Samples]:
    """Return the trajectories of one file, or of a folder as `latticebench.systems.folders` says.

    Args:
        path: a file of `FORMATS` or `OTHERS`, or a folder.
        ends: how the chain ends.
        layout: how the recording lies in the file, if not as this project writes it.

    Raises:
        InputError: the file is missing, of another form, or holds invalid data; the message names file, row and column.
    """
    if os.path.isdir(path):
        return _from_folder(path, ends, layout)
    check_ending(path, (*FORMATS, *OTHERS))
    check_regular(path)
    if path.stat().st_size == 0:
        raise InputError(f"{shown(path)}: the file is empty (0 bytes)")
    source = shown(path)
    match path.suffix.lower():
        case ".npz":
            return _from_arrays(read_npz(path), source, ends, layout)
        case ".parquet":
            return _from_table(_read_parquet(path, layout), source, ends, layout)
        case ".xlsx":
            return _from_table(read_sheet(path, layout), source, ends, layout)
        case _:
            return _from_table(read_csv(path, layout), source, ends, layout)


def read_all(paths: Sequence[Path], ends: Ends = "unknown", layout: Layout = PLAIN) -> list[Samples]:
    """Return the trajectories of several files, which must have the same sites, columns and units.

    Raises:
        InputError: a file is invalid, or two of them differ.
    """
    data = [samples for path in paths for samples in read(path, ends, layout)]
    check_alike(data)
    check_units(data)
    return data


def _from_folder(folder: Path, ends: Ends, layout: Layout) -> list[Samples]:
    """Return the trajectories of a Zarr store, of a Parquet table in parts, or of all files in a folder."""
    if folder.suffix.lower() == ZARR:
        arrays = zarr_arrays(folder, ARRAYS)
        check_names(list(arrays), shown(folder))
        return _from_arrays(arrays, shown(folder), ends, layout)
    files = files_in(folder)
    if folder.suffix.lower() == ".parquet":
        return _from_table(_parts(folder, files, layout), shown(folder), ends, layout)
    found = [samples for file in files for samples in read(file, ends, layout)]
    check_alike(found)
    return found


def _parts(folder: Path, files: Sequence[Path], layout: Layout) -> Table:
    """Return the table of a Parquet folder."""
    import pandas as pd

    bodies: list[pd.DataFrame] = []
    for file in files:
        check_ending(file, (".parquet",))
        body, label = _read_parquet(file, layout).body, partition(file, folder)
        if label is not None and "trajectory" in body:
            raise InputError(f"{shown(file)}: its folder and a column both say the trajectory; leave one out")
        if bodies and list(body.columns) != list(bodies[0].columns)[: len(body.columns)]:
            raise InputError(f"{shown(file)}: its columns are not those of {shown(files[0])}")
        bodies.append(body if label is None else body.assign(trajectory=label))
    labelled = ["trajectory" in body for body in bodies]
    if any(labelled) and not all(labelled):
        raise InputError(f"{shown(files[labelled.index(False)])}: it belongs to no trajectory, other parts do")
    return Table(pd.concat(bodies, ignore_index=True))


def check_ending(path: Path, endings: Sequence[str] = FORMATS) -> None:
    """Check the ending of a path, in small letters or capitals.

    Raises:
        InputError: it is not one of `endings`, which are those of files that are written if none are given.
    """
    if path.suffix.lower() not in endings:
        raise InputError(f"{shown(path)}: the ending {shown(path.suffix)!r} is not one of {', '.join(endings)}")


@dataclass(frozen=True)
class _Told:
    """What is known of arrays besides their values: where they come from, and the name of the times."""

    source: str
    ends: Ends
    origin: Origin
    time: str = "t"
    layout: Layout = PLAIN


def _trajectories(arrays: Arrays, labels: ndarray | None, told: _Told) -> list[Samples]:
    """Return the samples of arrays t, u, v and f, one trajectory per label in order of first appearance."""
    if labels is None:
        return [_samples(arrays, told)]
    found, source = [], told.source
    names, first, group = np.unique(labels, return_index=True, return_inverse=True)
    if 2 * len(names) > len(labels):
        alone = names[np.argmin(np.bincount(group))]
        raise InputError(f"{source}, trajectory {alone}: it has 1 row(s) of data; a motion needs at least 2")
    members = np.split(np.argsort(group, kind="stable"), np.cumsum(np.bincount(group))[:-1])
    for number in np.argsort(first):
        label, rows = names[number], members[number]
        own = {name: None if array is None else array[rows] for name, array in arrays.items()}
        found.append(_samples(own, replace(told, source=f"{source}, trajectory {label}")))
    return found


def _samples(arrays: Arrays, told: _Told) -> Samples:
    """Return one trajectory, in the units of the equation."""
    arrays, notes = in_order(arrays, told.source, told.time, sort=told.layout.sort)
    origin = told.origin.noting(*notes)
    turn, pace = told.layout.period, told.layout.time_factor
    if turn:
        assert arrays["u"] is not None
        # Before rows of the same time are averaged: halfway from 359 to 1 is 360, not 180.
        arrays = {**arrays, "u": unwrapped(arrays["u"], turn, told.source)}
        unit = f" {origin.unit}" if origin.unit else ""
        origin = origin.noting(f"angles are unwrapped (a full turn is {turn:g}{unit})")
    if told.layout.sort:
        arrays, notes = averaged(arrays)
        origin = origin.noting(*notes)
    t, u, v, f = (arrays[name] for name in ("t", "u", "v", "f"))
    assert t is not None
    assert u is not None
    if origin.scale != 1:
        u, v = u * origin.scale, None if v is None else v * origin.scale
    if pace != 1:
        t, v = t * pace, None if v is None else v / pace
    samples = _within(Samples(t, u, v, f, None, told.source, told.ends, origin), told.layout)
    # In the unit of the file, whose decimals are asked for, and after rows are chosen by the times that it has.
    t, notes = evened(samples.t / pace)
    return replace(samples, t=t * pace, origin=samples.origin.noting(*notes)) if notes else samples


def _within(samples: Samples, layout: Layout) -> Samples:
    """Return the rows of the times that are to be read.

    Raises:
        InputError: fewer than two rows are left.
    """
    (first, last), t = layout.stretch, samples.t / layout.time_factor
    begin, end = int(np.searchsorted(t, first)), int(np.searchsorted(t, last, side="right"))
    if (left := end - begin) == len(t):
        return samples
    if left < 2:
        raise InputError(
            f"{samples.source}: {option('between', (first, last))}: {left} row(s) are there; a motion needs at least "
            f"2, and times go from {t[0]:g} to {t[-1]:g}"
        )
    sides = [f"{word} {time:g}" for word, time in (("before", first), ("after", last)) if np.isfinite(time)]
    said = f"rows {' or '.join(sides)} are not read: {len(t) - left} of {len(t)}"
    return replace(samples.of_rows(slice(begin, end)), origin=samples.origin.noting(said))


# CSV and Parquet


def _read_parquet(path: Path, layout: Layout) -> Table:
    """Return a table of floats, NaN where a value is missing, and of labels; the columns that are read."""
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with reading(path, DATA) as handle, pq.ParquetFile(handle) as file:
            schema, about = file.schema_arrow, file.metadata
            check_count(about.num_rows * about.num_columns, path)
            header = named_once([name.strip() for name in schema.names], path)
            chosen = set(choose(header, layout, shown(path)).names.values())
            columns: dict[str, ndarray] = {}
            for name, kind, column in zip(header, schema.types, file.read().itercolumns(), strict=True):
                if name not in chosen:
                    columns[name] = np.full(about.num_rows, np.nan)
                elif name == "trajectory" and (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
                    columns[name] = column.to_numpy().astype(str)
                else:
                    _check_type(kind, name, path)
                    columns[name] = _as_floats(column, name, path)
    except InputError:
        raise
    # A damaged file fails in many ways.
    except Exception as error:
        raise InputError(f"{shown(path)}: not a Parquet file: {str(error).partition(chr(10))[0]}") from None
    return Table(pd.DataFrame(columns))


def _check_type(kind: pyarrow.DataType, name: str, path: Path) -> None:
    import pyarrow as pa

    if pa.types.is_temporal(kind):
        raise InputError(f"{shown(path)}: column {name}: dates are not numbers; give the time since the first row")
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind)):
        raise InputError(
            f"{shown(path)}: row 1, column {name}: it holds values of type {kind}, not numbers; write it as float64"
        )


def from_frame(frame: pandas.DataFrame, source: str, ends: Ends = "unknown", layout: Layout = PLAIN) -> list[Samples]:
    """Return the trajectories of a table with names of columns.

    Raises:
        InputError: a column is missing, or holds something else than numbers.
    """
    time = layout.time or "t"
    # A table of measurements often has its times as its index.
    named = (frame.reset_index() if time in frame.index.names and time not in frame else frame).rename(columns=str)
    return _from_table(Table(named), source, ends, layout)


def _from_table(table: Table, source: str, ends: Ends, layout: Layout) -> list[Samples]:
    try:
        choice = choose(list(table.body.columns), layout, source, table.units)
    except InputError as error:
        # Of a workbook, that may be the wrong sheet.
        told = [note for note in table.notes if note.startswith("sheet ")]
        raise InputError("; ".join([str(error), *told])) from None
    if len(table.body) == 0:
        raise InputError(f"{source}: it has 0 row(s) of data; a motion needs at least 2")
    body, origin = table.body, replace(choice.origin, notes=(*table.notes, *choice.origin.notes))
    read = list(dict.fromkeys(old for new, old in choice.names.items() if new != "trajectory"))
    dashes = body[read].isin(DASHES)
    if count := int(dashes.to_numpy().sum()):
        body = body.assign(**body[read].mask(dashes))
        origin = origin.noting(f"{count} cell(s) with a dash are taken as missing")
    body, said = _with_seconds(body, choice.names["t"], source)
    if said and layout.time_factor != 1:
        where = f"{source}: {option('time-scale', layout.time_scale)}"
        raise InputError(f"{where}: dates become seconds already; leave it out")
    if said:
        origin = replace(origin.noting(said), time="s")
    numbers = {new: _numbers(body, old, source) for new, old in choice.names.items() if new != "trajectory"}
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
    labels = body[choice.names["trajectory"]].astype(str).to_numpy() if "trajectory" in choice.names else None
    arrays = {"t": numbers["t"], "u": u, "v": v, "f": f}
    return _trajectories(arrays, labels, _Told(source, ends, origin, choice.names["t"], layout))


def _with_seconds(body: pandas.DataFrame, time: str, source: str) -> tuple[pandas.DataFrame, str]:
    """Return a table whose times are numbers: dates and times of day become seconds after the first row.

    Raises:
        InputError: the first one is such, another one is not.
    """
    import pandas as pd

    given = body[time]
    if given.dtype.kind in "fiu":
        return body, ""
    if given.dtype.kind != "M":
        texts = given.astype("string").fillna("").str.strip().str.replace(",", ".", regex=False)
        if re.match(r"\d{4}-\d\d-\d\d", texts.iloc[0], re.ASCII):
            given = pd.to_datetime(texts, format="ISO8601", errors="coerce", utc=True)
            kind = "date from 1678 to 2261, written 2024-02-29 or 2024-02-29T13:45:00"
        elif re.match(r"\d{1,2}:\d\d", texts.iloc[0], re.ASCII):
            # pandas takes 0:99 and "2 days", too.
            written = texts.where(texts.str.fullmatch(CLOCK, flags=re.ASCII))
            given = pd.to_timedelta(written.str.replace(r"^(\d+:\d+)$", r"\1:00", regex=True), errors="coerce")
            kind = "time of day, written 13:45 or 13:45:00.25"
        else:
            return body, ""
        if given.isna().any():
            row = int(np.flatnonzero(given.isna())[0])
            raise InputError(f"{source}: row {row + 1}, column {time}: {quoted(texts.iloc[row])} is no {kind}")
    since = (given - given.iloc[0]).dt.total_seconds()
    return body.assign(**{time: since}), f"times are seconds after the first row, {body[time].iloc[0]}"


# A date as it is not read, since nobody knows which number is the month.
DATE = re.compile(r"\d{1,2}[./-]\d{1,2}[./-]\d{2,4}", re.ASCII)
# As in tables, hours may pass a day.
CLOCK = r"\d{1,2}:[0-5]\d(:[0-5]\d(\.\d*)?)?"
NUMBER = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|inf(inity)?)|nan", re.ASCII | re.IGNORECASE)


def _numbers(table: pandas.DataFrame, column: str, source: str) -> ndarray:
    """Return the values of a column, NaN where they are missing."""
    given = table[column]
    if given.dtype.kind in "fiu":
        return given.to_numpy(dtype=float)
    # Not by pandas: its reader of numbers reads beyond the end of some damaged texts, and its other ways take a
    # millisecond for a column of whatever length, of which there may be thousands.
    missing = given.isna().to_numpy()
    texts = ["nan" if gap else str(one).strip() for one, gap in zip(given.tolist(), missing.tolist(), strict=True)]
    for row, text in enumerate(texts):
        if not NUMBER.fullmatch(text):
            remedy = (
                "write dates as 2024-05-03 12:00:00" if DATE.match(text) else "leave the cell empty if it is missing"
            )
            raise InputError(
                f"{source}: row {row + 1}, column {column}: {quoted(str(given.iloc[row]))} is not a number; {remedy}"
            )
    return np.array([float(text) for text in texts])


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


def _as_floats(column: Any, name: str, path: Path) -> ndarray:
    """Return a column of a Parquet table as floats.

    Raises:
        InputError: a whole number is too large to be one exactly.
    """
    import pyarrow as pa

    try:
        found: ndarray = column.cast(pa.float64()).to_numpy()
    except pa.ArrowInvalid:
        values = column.cast(pa.float64(), safe=False).to_numpy()
        row = int(np.argmax(np.abs(np.nan_to_num(values)) > 2**53))
        raise InputError(
            f"{shown(path)}: row {row + 1}, column {name}: {values[row]:g} has more digits than a reading can have; "
            "save the column as floats"
        ) from None
    return found


# Arrays


def from_arrays(
    t: ArrayLike, u: ArrayLike, source: str, ends: Ends = "unknown", layout: Layout = PLAIN
) -> list[Samples]:
    """Return the trajectory of times (T,) and readings (T, N), or (T,) of one site.

    Raises:
        InputError: they are no arrays of numbers, or of other shapes, or hold invalid data.
    """
    return _from_arrays({"t": _given(t, "t", source), "u": _given(u, "u", source)}, source, ends, layout)


def _given(values: ArrayLike, name: str, source: str) -> ndarray:
    """Return an array of numbers, NaN where one is None."""
    try:
        array = np.asarray(values)
        array = array.astype(float) if array.dtype.kind == "O" else array
    # Rows of different lengths, and objects that are no numbers.
    except (TypeError, ValueError) as error:
        raise InputError(f"{source}: array {name} is none of numbers: {error}") from None
    if array.dtype.kind not in "biufc":
        raise InputError(f"{source}: array {name}: its values are {array.dtype}, not numbers")
    return array


def _from_arrays(arrays: dict[str, ndarray], source: str, ends: Ends, layout: Layout) -> list[Samples]:
    if layout.time is not None or layout.columns:
        raise InputError(
            f"{source}: it has arrays t and u, no columns; leave {option('time')} and {option('columns')} out"
        )
    _check_times(arrays["t"], source)
    t, labels = arrays["t"], arrays.get("trajectory")
    u, v, f = (_matrix(arrays, name, source) for name in ("u", "v", "f"))
    assert u is not None
    if f is not None and f.shape[1] == 1:
        f = np.repeat(f, u.shape[1], axis=1)
    if labels is not None and labels.shape != t.shape:
        raise InputError(f"{source}: array trajectory has shape {labels.shape}; it must be {t.shape}")
    becomes = UNITS[layout.unit][1] if layout.unit else ""
    origin = Origin(time="s" if layout.time_unit else "", unit=layout.unit, scale=layout.factor, becomes=becomes)
    told = _Told(source, ends, origin, layout=layout)
    return _trajectories({"t": t.astype(float), "u": u, "v": v, "f": f}, labels, told)


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
    array = array.astype(complex if array.dtype.kind == "c" else float, copy=False)
    if array.ndim == 1:
        array = array.reshape(-1, 1)
    if array.ndim != 2 or len(array) != count:
        raise InputError(
            f"{source}: array {name} has shape {array.shape}; it must be ({count}, N) as t has {count} times"
        )
    return array
