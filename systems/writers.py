"""Writing samples to files, in the forms that `readers` reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.arrays import IN_MEMORY, empty
from latticebench.systems.errors import InputError
from latticebench.systems.files import shown, whole
from latticebench.systems.folders import ZARR, whole_folder, write_zarr
from latticebench.systems.readers import FORMATS, check_ending
from latticebench.systems.samples import Samples, check_alike

if TYPE_CHECKING:
    import pandas
    from numpy import ndarray


def write(data: Sequence[Samples], path: Path, *, parts: bool = False) -> None:
    """Write trajectories to one CSV, NPZ or Parquet file or Zarr store, whole or not at all; numbers keep all digits.

    Arrays that are large are not compressed in an NPZ file, so that it can be read in parts.

    Args:
        data: the trajectories.
        path: the file, or the folder of a Zarr store.
        parts: write a folder of Parquet files, one for each trajectory.

    Raises:
        InputError: the ending is unknown, the trajectories differ in sites or columns, or the file cannot be written.
    """
    check_ending(path, (*FORMATS, ZARR))
    check_alike(data)
    if parts:
        _write_parts(data, path)
        return
    if path.suffix.lower() == ZARR:
        write_zarr(_arrays(data), path)
        return
    with whole(path) as temporary:
        match path.suffix.lower():
            case ".npz":
                # NumPy appends .npz to a path that ends otherwise, in capitals too.
                arrays = _arrays(data)
                large = sum(array.nbytes for array in arrays.values()) > IN_MEMORY
                with temporary.open("wb") as handle:
                    (np.savez if large else np.savez_compressed)(handle, allow_pickle=False, **arrays)
            case ".csv":
                _table(data).to_csv(temporary, index=False)
            case _:
                _table(data).to_parquet(temporary, index=False)


def _write_parts(data: Sequence[Samples], path: Path) -> None:
    """Write a folder of Parquet files, one for each trajectory."""
    if path.suffix.lower() != ".parquet":
        raise InputError(f"{shown(path)}: only Parquet is written in parts; let the name end in .parquet")
    with whole_folder(path) as temporary:
        for number, samples in enumerate(data, start=1):
            place = temporary / f"trajectory={number}"
            place.mkdir()
            _table([samples]).to_parquet(place / "part-0.parquet", index=False)


def _arrays(data: Sequence[Samples]) -> dict[str, ndarray]:
    """Return the arrays of an NPZ file."""
    arrays = {"t": np.concatenate([samples.t for samples in data])}
    for name in ("u", "v", "f"):
        found = [getattr(samples, name) for samples in data]
        if found[0] is not None:
            arrays[name] = found[0] if len(found) == 1 else _joined(found)
    if len(data) > 1:
        arrays["trajectory"] = np.repeat(np.arange(1, len(data) + 1), [len(samples.t) for samples in data])
    return arrays


def _joined(arrays: Sequence[ndarray]) -> ndarray:
    """Return the rows of one array after those of another."""
    whole = empty((sum(map(len, arrays)), arrays[0].shape[1]), arrays[0].dtype)
    np.concatenate(arrays, out=whole)
    return whole


def _table(data: Sequence[Samples]) -> pandas.DataFrame:
    """Return the table of a CSV or Parquet file."""
    import pandas as pd

    tables = []
    for number, samples in enumerate(data, start=1):
        if samples.is_complex and samples.v is not None:
            raise InputError("a complex field with velocities has no form in tables; write it as .npz")
        columns: dict[str, ndarray] = {"t": samples.t}
        fields = [("re", samples.u.real), ("im", samples.u.imag)] if samples.is_complex else [("u", samples.u)]
        fields += [(name, array) for name, array in (("v", samples.v), ("f", samples.f)) if array is not None]
        for name, array in fields:
            columns.update({f"{name}{site + 1}": array[:, site] for site in range(samples.sites)})
        table = pd.DataFrame(columns)
        if len(data) > 1:
            table.insert(0, "trajectory", number)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)
