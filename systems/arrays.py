"""Arrays that may be larger than the memory: where they are kept, and how they are gone through piece by piece."""

from __future__ import annotations

import math
import os
import tempfile
import weakref
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from numpy import ndarray

# Bytes of arrays that are kept in memory at a time; what is more than that is in temporary files, mapped.
IN_MEMORY = 2**27
# Values that are computed with at once where that is free to choose: 16 MiB of double precision.
PIECE = 2**21


# The arrays of `empty` that are in memory, by their number, as long as they are in use.
_in_use: weakref.WeakValueDictionary[int, ndarray] = weakref.WeakValueDictionary()


def empty(shape: tuple[int, ...], kind: Any = float) -> ndarray:
    """Return an array without values, in memory or in a temporary file (in TMPDIR) that is mapped.

    It is in a file if with it the arrays of this function that are still in use took more than IN_MEMORY. The file has
    no name; it is gone with the array.

    Raises:
        InputError: the disk has no room for it.
    """
    size = math.prod(shape) * np.dtype(kind).itemsize
    if size + sum(one.nbytes for one in list(_in_use.values())) <= IN_MEMORY:
        found = np.empty(shape, kind)
        _in_use[id(found)] = found
        return found
    try:
        with tempfile.TemporaryFile(prefix="latticebench-") as file:
            # A mapped file for which the disk has no room ends the process when it is written to.
            reserve = getattr(os, "posix_fallocate", lambda handle, _, length: os.truncate(handle, length))
            reserve(file.fileno(), 0, size)
            return np.memmap(file, kind, "r+", shape=shape)
    except OSError as error:
        raise InputError(
            f"{size / 2**20:.0f} MiB of temporary files cannot be kept in {tempfile.gettempdir()}: {error.strerror}; "
            "set TMPDIR to a folder with more room"
        ) from error


def pieces(count: int, size: int, most: int = PIECE) -> Iterator[slice]:
    """Yield slices that go through `count` rows of `size` values, each of at most `most` values or of one row."""
    step = max(1, most // max(size, 1))
    for begin in range(0, count, step):
        yield slice(begin, min(begin + step, count))


def rows_of(array: ndarray) -> Iterator[slice]:
    """Yield the slices that go through the rows of a two-dimensional array."""
    return pieces(array.shape[0], array.shape[1])


def free_memory() -> float:
    """Return the bytes that this process may still take, by its own limit and by what the machine has."""
    import psutil

    free = float(psutil.virtual_memory().available)
    try:
        import resource
    except ImportError:
        return free
    limit, _ = resource.getrlimit(resource.RLIMIT_DATA)
    if limit == resource.RLIM_INFINITY:
        return free
    # Only Linux tells what counts against this limit, and only there is it enforced.
    taken = getattr(psutil.Process().memory_info(), "data", 0)
    return max(0.0, min(free, float(limit - taken)))
