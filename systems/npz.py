"""Arrays of NPZ archives, which are never unpickled: names, types and sizes are looked at before they are unpacked."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.systems.arrays import IN_MEMORY
from latticebench.systems.errors import InputError
from latticebench.systems.files import DATA, reading, shown
from latticebench.systems.layout import listing, quoted
from latticebench.systems.tables import check_count

if TYPE_CHECKING:
    from numpy import ndarray

ARRAYS = ("t", "u", "v", "f", "trajectory")
# Characters of what a library says of a damaged file.
MOST_REASON = 200


def read_npz(path: Path) -> dict[str, ndarray]:
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
                check_names(list(members), shown(path))
                shapes = {name: _shape(archive, one, name, path) for name, one in members.items()}
                check_count(sum(int(np.prod(shape, dtype=object)) for shape in shapes.values()), path)
                return {name: _array(archive, one, path) for name, one in members.items()}
    except InputError:
        raise
    # A damaged archive fails in many ways: zipfile's, zlib's, NumPy's.
    except Exception as error:
        reason = str(error).partition("\n")[0][:MOST_REASON]
        if "pickle" in str(error).lower():
            reason = "it holds pickled objects, which are never loaded"
        elif "object at 0x" in reason:
            reason = "the head of an array is damaged"
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


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo, path: Path) -> ndarray:
    """Return an array; a large one that is not compressed is mapped, and so read where it is looked at."""
    if member.compress_type == zipfile.ZIP_STORED and member.file_size > IN_MEMORY:
        return _mapped(member, path)
    with archive.open(member) as file:
        found: ndarray = np.lib.format.read_array(file, allow_pickle=False)
        return found


def _mapped(member: zipfile.ZipInfo, path: Path) -> ndarray:
    """Return an array that stands in an archive as it is; what is written to it never reaches the file.

    Raises:
        ValueError: it is not all there.
    """
    with path.open("rb") as file:
        # The head of a member ends with its name and what else is told of it, whose lengths stand at 26.
        file.seek(member.header_offset + 26)
        file.seek(int.from_bytes(file.read(2), "little") + int.from_bytes(file.read(2), "little"), os.SEEK_CUR)
        version = np.lib.format.read_magic(file)
        head: Any = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, transposed, kind = head(file)
        return np.memmap(path, kind, "c", file.tell(), shape, "F" if transposed else "C")


def check_names(names: Sequence[str], source: str) -> None:
    """Refuse missing and unknown arrays."""
    for name in ("t", "u"):
        if name not in names:
            raise InputError(f"{source}: the array {name!r} is missing; there are: {listing(names)}")
    for name in names:
        if name not in ARRAYS:
            raise InputError(f"{source}: unknown array {quoted(name)}; known: {', '.join(ARRAYS)}")
