"""Samples of a lattice's motion, and the files that hold them.

CSV and Parquet have the columns `t,u1..uN[,v1..vN][,f1..fN | f]` (real field) or `t,re1..reN,im1..imN` (complex), and a
column `trajectory` where one file holds several. NPZ has the arrays `t, u[, v, f, trajectory]` and is never unpickled.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from latticebench.systems.errors import InputError, unknown
from latticebench.systems.files import whole
from latticebench.systems.lattice import Ends, Library
from latticebench.systems.terms import Term, express

if TYPE_CHECKING:
    import pandas
    from jaxtyping import Float
    from numpy import ndarray

FORMATS = (".csv", ".npz", ".parquet")


@dataclass(frozen=True, eq=False)
class Samples:
    """What was observed of one trajectory.

    Attributes:
        t: times (T,), increasing; need not be evenly spaced.
        u: the field (T, N), real or complex; NaN where a value is missing.
        v: its velocity (T, N), or None where it was not observed.
        f: the measured input (T, N), or None.
        sigma: standard deviation of the noise on u, or None where it is not known.
        source: the file or simulation that they come from.
        ends: how the chain ends, as far as that is known.

    Raises:
        InputError: shapes differ, times do not increase, or there is nothing to fit.
    """

    t: Float[ndarray, " time"]
    u: Float[ndarray, "time sites"]
    v: Float[ndarray, "time sites"] | None = None
    f: Float[ndarray, "time sites"] | None = None
    sigma: float | None = None
    source: str = "samples"
    ends: Ends = "unknown"

    def __post_init__(self) -> None:
        """Check shapes, times and values, and keep the arrays from being changed."""
        where = self.source
        for name in ("t", "u", "v", "f"):
            if getattr(self, name) is not None:
                # A view: whoever made the array may go on writing to it.
                kept = np.asarray(getattr(self, name)).view()
                kept.setflags(write=False)
                object.__setattr__(self, name, kept)
        if self.t.ndim != 1 or self.u.ndim != 2 or self.u.shape[0] != len(self.t):
            raise InputError(f"{where}: t has shape {self.t.shape} and u {self.u.shape}; they must be (T,) and (T, N)")
        if len(self.t) < 2:
            raise InputError(f"{where}: it has {len(self.t)} row(s) of data; a motion needs at least 2")
        if self.u.shape[1] < 1:
            raise InputError(f"{where}: it has no sites; give columns u1, u2, ...")
        if not np.all(np.isfinite(self.t)):
            row = int(np.flatnonzero(~np.isfinite(self.t))[0])
            raise InputError(
                f"{where}: row {row + 1}, column t: the time is missing or not finite; fill it in or leave the row out"
            )
        steps = np.diff(self.t)
        if np.any(steps <= 0):
            row = int(np.flatnonzero(steps <= 0)[0]) + 1
            raise InputError(
                f"{where}: row {row + 1}, column t: time {self.t[row]:g} after {self.t[row - 1]:g}; times must increase: "
                "sort the rows, or give several trajectories a column 'trajectory'"
            )
        for name, array in (("u", self.u), ("v", self.v), ("f", self.f)):
            if array is None:
                continue
            if array.shape != self.u.shape:
                raise InputError(
                    f"{where}: u has {self.u.shape[1]} sites in {self.u.shape[0]} rows, {name} has shape {array.shape}; "
                    "they must be the same"
                )
            if np.iscomplexobj(array) and (name == "f" or not np.iscomplexobj(self.u)):
                raise InputError(f"{where}: {name} is complex; it must be real{'' if name == 'f' else ' as u is'}")
            if np.any(np.isinf(array)):
                row, site = (int(k) for k in np.argwhere(np.isinf(array))[0])
                raise InputError(
                    f"{where}: row {row + 1}, column {name}{site + 1}: infinite; leave the cell empty if it is missing"
                )
        if np.all(np.isnan(self.u)):
            raise InputError(f"{where}: every value of u is missing")
        if self.sigma is not None and not (np.isfinite(self.sigma) and self.sigma >= 0):
            raise InputError(f"{where}: sigma is {self.sigma!r}; a standard deviation is a number >= 0")
        if self.ends not in get_args(Ends):
            raise unknown("ends", str(self.ends), get_args(Ends), where)

    @property
    def sites(self) -> int:
        """The number of sites N."""
        return int(self.u.shape[1])

    @property
    def is_complex(self) -> bool:
        """Whether the field is complex."""
        return bool(np.iscomplexobj(self.u))

    @property
    def is_even(self) -> bool:
        """Whether the times are evenly spaced, to a thousandth of a step."""
        steps = np.diff(self.t)
        return bool(np.ptp(steps) <= 1e-3 * np.mean(steps))

    @property
    def has_missing(self) -> bool:
        """Whether any value is NaN."""
        return any(bool(np.any(np.isnan(array))) for array in (self.u, self.v, self.f) if array is not None)

    def forcing(self) -> Callable[[ndarray], ndarray]:
        """Give the measured input at any time: a function of times (B,) with values (B, N).

        Each site's is the cubic spline through its samples, after gaps have been bridged by straight lines.

        Raises:
            InputError: no input was measured, or that of a site is missing throughout.
        """
        from scipy.interpolate import make_interp_spline

        if self.f is None:
            raise InputError(f"{self.source}: there is no measured input f or f1..f{self.sites}")
        f = self.f.real.copy()
        for site in range(f.shape[1]):
            seen = np.isfinite(f[:, site])
            if not np.any(seen):
                raise InputError(f"{self.source}: the measured input of site {site + 1} is missing throughout")
            f[~seen, site] = np.interp(self.t[~seen], self.t[seen], f[seen, site])
        curve: Callable[[ndarray], ndarray] = make_interp_spline(self.t, f, k=min(3, len(self.t) - 1))
        return curve

    def mirrored(self) -> Samples:
        """Give the samples of -u, which an equation of odd terms has as a solution too."""
        return replace(self, u=-self.u, v=None if self.v is None else -self.v, f=None if self.f is None else -self.f)


@dataclass(frozen=True, eq=False)
class SimulatedSamples(Samples):
    """Samples that know their truth. Methods get them through `observed`, which takes it away.

    Attributes:
        equation: the true right-hand side, with numbers.
        exact: the same trajectory without noise and with nothing missing.
        rate: its highest derivative (T, N): du/dt for first order, d^2u/dt^2 for second.
        noise: the noise level, sigma over the RMS of the field about its mean.
    """

    equation: str = ""
    exact: Samples | None = None
    rate: Float[ndarray, "time sites"] | None = None
    noise: float = 0.0

    def mirrored(self) -> SimulatedSamples:
        """Give the samples of -u with their truth.

        Raises:
            InputError: the equation is not odd, so that -u is no solution of it.
        """
        if Term(self.equation).parity != -1:
            raise InputError(
                f"{self.source}: the equation is not odd, so that -u does not solve it; leave the mirrored data out"
            )
        mirrored = super().mirrored()
        assert isinstance(mirrored, SimulatedSamples)
        exact = None if self.exact is None else self.exact.mirrored()
        return replace(mirrored, exact=exact, rate=None if self.rate is None else -self.rate)

    def observed(self) -> Samples:
        """Give what an experiment would have: no truth, and no word on the noise."""
        return Samples(self.t, self.u, self.v, self.f, None, "simulated samples", self.ends)

    def truth(self, candidates: Library) -> Float[ndarray, " terms"] | None:
        """Derive the true coefficients over a library; None where the equation is outside its span."""
        return express(Term(self.equation), candidates.terms, self.is_complex)


# Files --------------------------------------------------------------------------------------------------------------------


def read(path: Path, ends: Ends = "unknown") -> list[Samples]:
    """Read the trajectories of one file.

    Raises:
        InputError: the file is missing, of another form, or holds unsound data; the text names file, row and column.
    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: the ending {path.suffix!r} is not one of {', '.join(FORMATS)}")
    if path.is_dir():
        raise InputError(f"{path}: a folder, not a file")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty (0 bytes)")
    if path.suffix.lower() == ".npz":
        return _read_npz(path, ends)
    return _from_table(_read_table(path), str(path), ends)


def read_all(paths: Sequence[Path], ends: Ends = "unknown") -> list[Samples]:
    """Read the trajectories of several files; all must have the same sites and kind of field.

    Raises:
        InputError: a file is unsound, or they do not fit together.
    """
    data = [samples for path in paths for samples in read(path, ends)]
    _check_alike(data)
    return data


def _check_alike(data: Sequence[Samples]) -> None:
    """Refuse trajectories of different sites or columns, and none at all."""
    if not data:
        raise InputError("no samples are given; give at least one file or trajectory")
    first = data[0]
    for samples in data[1:]:
        if samples.sites != first.sites:
            raise InputError(
                f"{samples.source}: it has {samples.sites} sites, {first.source} has {first.sites}; fit them apart"
            )
        if samples.is_complex != first.is_complex:
            raise InputError(
                f"{samples.source}: one of it and {first.source} is real, the other complex; fit them apart"
            )
        for name in ("v", "f"):
            if (getattr(samples, name) is None) != (getattr(first, name) is None):
                raise InputError(
                    f"{samples.source}: only one of it and {first.source} has columns {name}1..{name}N; fit them apart"
                )


def write(data: Sequence[Samples], path: Path) -> None:
    """Write trajectories to one CSV, NPZ or Parquet file, whole or not at all; numbers keep all their digits.

    Raises:
        InputError: the ending is unknown or the file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"{path}: the ending {path.suffix!r} is not one of {', '.join(FORMATS)}")
    _check_alike(data)
    with whole(path) as temporary:
        if suffix == ".npz":
            arrays = {"t": np.concatenate([samples.t for samples in data])}
            for name in ("u", "v", "f"):
                found = [getattr(samples, name) for samples in data]
                if found[0] is not None:
                    arrays[name] = np.concatenate(found)
            if len(data) > 1:
                arrays["trajectory"] = np.repeat(np.arange(1, len(data) + 1), [len(samples.t) for samples in data])
            # NumPy appends .npz to a path that ends otherwise, in capitals too.
            with temporary.open("wb") as handle:
                np.savez_compressed(handle, allow_pickle=False, **arrays)
        elif suffix == ".csv":
            _to_table(data).to_csv(temporary, index=False)
        else:
            _to_table(data).to_parquet(temporary, index=False)


def _read_table(path: Path) -> pandas.DataFrame:
    import pandas as pd

    if path.suffix.lower() == ".parquet":
        try:
            table = pd.read_parquet(path)
        except Exception as error:
            raise InputError(f"{path}: not a Parquet file: {str(error).splitlines()[0]}") from None
        table.columns = pd.Index(_named_once([str(column).strip() for column in table.columns], path))
        return table
    try:
        # The header by itself, so that a column that occurs twice is seen before pandas renames it.
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
    """Refuse a column that occurs twice."""
    for name in header:
        if header.count(name) > 1:
            raise InputError(f"{path}: the column {name!r} occurs twice; leave one out")
    return header


def _refuse_short_rows(path: Path, width: int) -> None:
    """Refuse rows that end early, which pandas fills up with gaps: a file that was cut off looks so."""
    with path.open(encoding="utf-8", newline="") as lines:
        rows = (row for row in csv.reader(line.partition("#")[0] for line in lines) if "".join(row).strip())
        for number, row in enumerate(rows):
            if len(row) < width:
                raise InputError(
                    f"{path}: row {number}: it has {len(row)} value(s), the header {width}; the row was cut off, or a "
                    "missing value needs its comma"
                )


def _from_table(table: pandas.DataFrame, source: str, ends: Ends) -> list[Samples]:
    import pandas as pd

    columns = list(table.columns)
    if any(sign in column for column in columns for sign in (";", "\t")):
        raise InputError(f"{source}: the columns are separated by something else; separate them by commas")
    if "t" not in columns:
        raise InputError(
            f"{source}: there is no column t; the header must be t,u1..uN[,v1..vN][,f1..fN] or t,re1..reN,im1..imN"
        )
    for column in columns:
        if not re.fullmatch(r"t|f|trajectory|(u|v|f|re|im)[1-9]\d{0,5}", column):
            raise InputError(
                f"{source}: unknown column {column!r}; there are: t, u1.., v1.., f1.. or f, re1.., im1.., trajectory"
            )
    if len(table) == 0:
        raise InputError(f"{source}: it has 0 row(s) of data; a motion needs at least 2")
    numbers = {}
    for column in columns:
        if column == "trajectory":
            continue
        if pd.api.types.is_datetime64_any_dtype(table[column]) or pd.api.types.is_timedelta64_dtype(table[column]):
            raise InputError(f"{source}: column {column}: dates are not numbers; give the time since the first row")
        values = pd.to_numeric(table[column], errors="coerce")
        wrong = values.isna() & table[column].notna() & (table[column].astype(str).str.strip().str.lower() != "nan")
        if wrong.any():
            row = int(np.flatnonzero(wrong.to_numpy())[0])
            raise InputError(
                f"{source}: row {row + 1}, column {column}: {str(table[column].iloc[row])[:40]!r} is not a number; "
                "leave the cell empty if the value is missing"
            )
        # pandas reads numbers in texts fast, but not to the last digit; Python does.
        exact = table[column].where(values.notna(), np.nan)
        numbers[column] = np.array([float(value) for value in exact])

    def block(prefix: str) -> np.ndarray | None:
        found = sorted(int(c[len(prefix) :]) for c in columns if re.fullmatch(rf"{prefix}\d+", c))
        if not found:
            return None
        if found != list(range(1, len(found) + 1)):
            missing = next(k for k in range(1, len(found) + 1) if k not in found)
            raise InputError(
                f"{source}: column {prefix}{missing} is missing; sites are numbered {prefix}1, {prefix}2, ... without gaps"
            )
        return np.column_stack([numbers[f"{prefix}{k}"] for k in found])

    u, v, f, real, imaginary = (block(prefix) for prefix in ("u", "v", "f", "re", "im"))
    if (real is None) != (imaginary is None) or (u is not None and real is not None) or (u is None and real is None):
        raise InputError(f"{source}: give either columns u1..uN (real field) or re1..reN and im1..imN (complex field)")
    if real is not None and imaginary is not None:
        if real.shape != imaginary.shape:
            raise InputError(
                f"{source}: {real.shape[1]} columns re but {imaginary.shape[1]} columns im; they must be the same"
            )
        u = real + 1j * imaginary
    assert u is not None
    if "f" in columns:
        if f is not None:
            raise InputError(f"{source}: both f and f1.. are there; keep one of them")
        f = np.repeat(numbers["f"][:, None], u.shape[1], axis=1)
    if "trajectory" not in columns:
        return [Samples(numbers["t"], u, v, f, None, source, ends)]
    labels = table["trajectory"].astype(str).to_numpy()
    return [
        Samples(
            numbers["t"][rows], u[rows], None if v is None else v[rows], None if f is None else f[rows],
            None, f"{source}, trajectory {label}", ends,
        )
        for label in dict.fromkeys(labels)
        for rows in [labels == label]
    ]  # fmt: skip


def _to_table(data: Sequence[Samples]) -> pandas.DataFrame:
    import pandas as pd

    tables = []
    for number, samples in enumerate(data, start=1):
        columns: dict[str, np.ndarray] = {"t": samples.t}
        fields = [("re", samples.u.real), ("im", samples.u.imag)] if samples.is_complex else [("u", samples.u)]
        fields += [(name, a) for name, a in (("v", samples.v), ("f", samples.f)) if a is not None]
        if samples.is_complex and samples.v is not None:
            raise InputError("a complex field with velocities has no form in tables; write it as .npz")
        for name, array in fields:
            columns.update({f"{name}{site + 1}": array[:, site] for site in range(samples.sites)})
        table = pd.DataFrame(columns)
        if len(data) > 1:
            table.insert(0, "trajectory", number)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


def _read_npz(path: Path, ends: Ends) -> list[Samples]:
    try:
        # Opened here, so that it is closed when NumPy gives up.
        with path.open("rb") as handle:
            stored = np.load(handle, allow_pickle=False)
            if not isinstance(stored, np.lib.npyio.NpzFile):
                raise ValueError("it holds one array without a name")
            with stored:
                arrays = {name: stored[name] for name in stored.files}
    # A damaged archive fails in many ways: zipfile's, zlib's, NumPy's.
    except Exception as error:
        reason = "it holds pickled objects, which are never loaded" if "pickle" in str(error).lower() else str(error)
        raise InputError(
            f"{path}: not an NPZ file of plain arrays: {reason}; write it with numpy.savez(path, t=t, u=u)"
        ) from None
    for name in ("t", "u"):
        if name not in arrays:
            raise InputError(f"{path}: the array {name!r} is missing; there are: {', '.join(arrays) or 'none'}")
    for name, array in arrays.items():
        if name not in ("t", "u", "v", "f", "trajectory"):
            raise InputError(f"{path}: unknown array {name!r}; there are: t, u, v, f, trajectory")
        if not isinstance(array, np.ndarray):
            raise InputError(f"{path}: {name!r} is not an array; write it with numpy.savez(path, t=t, u=u)")
        if name != "trajectory" and array.dtype.kind not in "fiuc":
            raise InputError(f"{path}: array {name}: its values are {array.dtype}, not numbers")
    if arrays["t"].dtype.kind == "c":
        raise InputError(f"{path}: array t: times are real")
    if arrays["t"].ndim != 1:
        raise InputError(f"{path}: array t has shape {arrays['t'].shape}; it must be (T,)")

    def matrix(name: str) -> np.ndarray | None:
        if name not in arrays:
            return None
        array: np.ndarray = arrays[name]
        array = array.astype(complex if array.dtype.kind == "c" else float)
        if array.ndim == 1:
            array = array.reshape(-1, 1)
        if array.ndim != 2 or len(array) != len(arrays["t"]):
            raise InputError(
                f"{path}: array {name} has shape {array.shape}; it must be ({len(arrays['t'])}, N) as t has {len(arrays['t'])} times"
            )
        return array

    t, u, v, f = arrays["t"].astype(float), matrix("u"), matrix("v"), matrix("f")
    assert u is not None
    if f is not None and f.shape[1] == 1:
        f = np.repeat(f, u.shape[1], axis=1)
    if "trajectory" not in arrays:
        return [Samples(t, u, v, f, None, str(path), ends)]
    labels = arrays["trajectory"]
    if labels.shape != t.shape:
        raise InputError(f"{path}: array trajectory has shape {labels.shape}; it must be {t.shape}")
    return [
        Samples(t[rows], u[rows], None if v is None else v[rows], None if f is None else f[rows],
                None, f"{path}, trajectory {label}", ends)
        for label in dict.fromkeys(labels.tolist())
        for rows in [labels == label]
    ]  # fmt: skip
