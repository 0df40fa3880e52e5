"""Samples in folders: Zarr stores, Parquet in parts, and a file for each trajectory.

A Zarr store has the arrays of an NPZ file, chunked in time and sites; it is written and can be opened by xarray, with
the dimensions t and site. What its chunks are packed with is looked at before anything is unpacked: only codecs that
make numbers of bytes are read. A folder whose name ends in .parquet is one table in parts, those in `trajectory=NAME`
of that trajectory. Any other folder is a data set: each file in it holds a trajectory or several.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.systems.arrays import empty, pieces
from latticebench.systems.errors import InputError
from latticebench.systems.files import DATA, LARGEST, largest, read_json, shown

if TYPE_CHECKING:
    from numpy import ndarray

ZARR = ".zarr"
ENDINGS = (".zarr", ".parquet")
# What a chunk may be packed with.
CODECS = frozenset(
    ("bytes", "transpose", "blosc", "zstd", "gzip", "zlib", "lz4", "bz2", "lzma", "crc32c", "shuffle", "delta",
     "sharding_indexed", "numcodecs.zstd", "numcodecs.blosc", "numcodecs.lz4", "numcodecs.shuffle")
)  # fmt: skip
# Values of a chunk: 4 MiB of double precision.
CHUNK = 2**19


def files_in(folder: Path) -> list[Path]:
    """Return the files of a folder and of the folders in it, in the order of their names, 2 before 10.

    Hidden files, and those that begin with _ as marks of programs do, are left out.

    Raises:
        InputError: there are none, something is no regular file, or all together are too long.
    """
    found, total = [], 0
    for place, folders, names in os.walk(folder, onerror=_refuse):
        folders[:] = [name for name in folders if name[0] not in "._"]
        for name in [*folders, *names]:
            path = Path(place) / name
            about = path.lstat()
            if name in folders and stat.S_ISDIR(about.st_mode):
                continue
            if not stat.S_ISREG(about.st_mode):
                raise InputError(f"{shown(path)}: neither a regular file nor a folder; a data set has nothing else")
            if name[0] not in "._":
                total += about.st_size
                found.append(path)
    if not found:
        raise InputError(f"{shown(folder)}: the folder has no files")
    if total > largest(DATA):
        raise InputError(
            f"{shown(folder)}: its files have {total / 2**20:.0f} MiB, at most {largest(DATA) // 2**20} are read; if "
            f"it is meant to be so long, raise that with --largest-file or {LARGEST}"
        )
    return sorted(found, key=_natural)


def _refuse(error: OSError) -> None:
    raise InputError(f"{shown(error.filename)}: {error.strerror}")


def _natural(path: Path) -> list[tuple[int, int | str]]:
    return [(0, int(part)) if part.isdigit() else (1, part) for part in re.split(r"(\d+)", str(path)) if part]


def partition(file: Path, folder: Path) -> str | None:
    """Return the trajectory that a part of a Parquet folder belongs to, by the folder trajectory=NAME that it is in."""
    parents = [part for part in file.relative_to(folder).parts[:-1] if part.startswith("trajectory=")]
    return parents[-1].partition("=")[2] if parents else None


# Zarr -----------------------------------------------------------------------------------------------------------------


def zarr_arrays(path: Path, known: Sequence[str]) -> dict[str, ndarray]:
    """Return the arrays of a Zarr store; large ones are temporary files, and no more than a chunk is in memory.

    Args:
        path: its folder.
        known: names of arrays that it may have; `site`, the numbers of the sites, is left out.

    Raises:
        InputError: zarr is not installed, or the store is damaged, too large, or packed in another way.
    """
    try:
        import zarr
    except ImportError:
        raise InputError(f"{shown(path)}: reading Zarr needs zarr; pip install 'latticebench[zarr]'") from None
    files_in(path)
    names = sorted(one.parent.name for kind in ("zarr.json", ".zarray") for one in path.glob(f"*/{kind}"))
    for name in names:
        if name not in (*known, "site"):
            raise InputError(f"{shown(path)}: unknown array {name[:40]!r}; known: {', '.join(known)}")
        _check_packing(path / name)
    try:
        store = zarr.open_group(str(path), mode="r")
        arrays = {name: store[name] for name in names if name != "site"}
        values = sum(int(np.prod(one.shape, dtype=object)) for one in arrays.values())
        if 8 * values > largest(DATA):
            raise InputError(
                f"{shown(path)}: it holds {8 * values / 2**20:.0f} MiB of numbers, at most {largest(DATA) // 2**20} "
                f"are read; if it is meant to be so long, raise that with --largest-file or {LARGEST}"
            )
        for name, one in arrays.items():
            _check_whole(one, f"{shown(path)}: array {name!r}")
        return {name: _loaded(one) for name, one in arrays.items()}
    except InputError:
        raise
    # A damaged store fails in many ways.
    except Exception as error:
        raise InputError(f"{shown(path)}: not a Zarr store: {str(error).partition(chr(10))[0]}") from None


def _check_packing(folder: Path) -> None:
    """Refuse arrays of other things than numbers, and those that are packed with what might run code.

    Raises:
        InputError: an array is such, or its head cannot be read.
    """
    third = folder / "zarr.json"
    about = read_json(third if third.exists() else folder / ".zarray")
    if not isinstance(about, Mapping):
        raise InputError(f"{shown(folder)}: its head is no table; write it with xarray.Dataset.to_zarr")
    used, scaled = _codecs(about.get("codecs")), about.get("attributes") or {}
    if not third.exists():
        used = _codecs([about.get("compressor"), *(about.get("filters") or ())])
        marks = folder / ".zattrs"
        scaled = read_json(marks) if marks.exists() else {}
    wrong = sorted(set(used) - CODECS)
    if wrong:
        raise InputError(
            f"{shown(folder)}: its chunks are packed with {wrong[0][:40]!r}; read are {', '.join(sorted(CODECS))}"
        )
    kind = str(about.get("data_type", about.get("dtype")))
    if not re.fullmatch(r"[<>|]?[fiuc]\d+|(float|u?int|complex)\d+", kind):
        raise InputError(f"{shown(folder)}: its values are {kind[:40]}, not numbers")
    if {"scale_factor", "add_offset"} & set(scaled):
        raise InputError(f"{shown(folder)}: its numbers are scaled (scale_factor, add_offset); write them as they are")


def _check_whole(array: Any, where: str) -> None:
    """Refuse an array of which chunks are not there, unless they stand for missing values.

    Raises:
        InputError: chunks are not there, and Zarr would have a number in their place.
    """
    lost, fill = array.nchunks - array.nchunks_initialized, array.fill_value
    if lost > 0 and (fill is None or not np.isnan(fill)):
        raise InputError(
            f"{where}: {lost} of its {array.nchunks} chunks are not there, and would be read as {fill}; copy the store "
            "again, or, if it was written so, write it with write_empty_chunks=True"
        )


def _codecs(given: Any) -> list[str]:
    """Return the names of codecs, and of those within them."""
    found = []
    for one in given or ():
        if isinstance(one, Mapping):
            found.append(str(one.get("name", one.get("id"))))
            inner = one.get("configuration")
            if isinstance(inner, Mapping):
                found += _codecs(inner.get("codecs")) + _codecs(inner.get("index_codecs"))
    return found


def _loaded(array: Any) -> ndarray:
    """Return the values of an array, some columns after others."""
    found = empty(tuple(array.shape), array.dtype)
    if found.ndim != 2:
        found[...] = array[...]
        return found
    width = array.chunks[1]
    for some in pieces(-(-array.shape[1] // width), array.shape[0] * width):
        columns = slice(some.start * width, some.stop * width)
        found[:, columns] = array[:, columns]
    return found


def write_zarr(arrays: Mapping[str, ndarray], path: Path) -> None:
    """Write the arrays of an NPZ file as a Zarr store, chunked in sites, and in time where a column is long.

    Raises:
        InputError: xarray or zarr is not installed, or the folder cannot be written or is there already.
    """
    try:
        import xarray
        import zarr  # noqa: F401
    except ImportError:
        raise InputError(f"{shown(path)}: writing Zarr needs zarr; pip install 'latticebench[zarr]'") from None
    times, sites = arrays["u"].shape
    rows = min(times, CHUNK)
    chunks = (rows, min(sites, max(1, CHUNK // rows)))
    fields = {name: (("t", "site"), array) for name, array in arrays.items() if array.ndim == 2}
    coordinates = {name: (("t",), array) for name, array in arrays.items() if array.ndim == 1}
    coordinates["site"] = (("site",), np.arange(1, sites + 1))
    table = xarray.Dataset(fields, coordinates)
    with whole_folder(path) as temporary:
        encoding = {name: {"chunks": chunks} for name in fields}
        # A chunk that is not there is then one that was lost.
        table.to_zarr(temporary, mode="w", consolidated=False, encoding=encoding, write_empty_chunks=True)


@contextlib.contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, and rename it to `path` when the block ends without an error.

    Raises:
        InputError: there is something already, or it cannot be written.
    """
    if path.exists() or path.is_symlink():
        raise InputError(f"{shown(path)}: it is there already, and no folder is replaced; remove it, or choose another")
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.stem[:40]}-", dir=path.parent))
        yield temporary
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o777 & ~mask)
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"{shown(path)}: cannot be written: {error.strerror or error}; nothing was changed") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
