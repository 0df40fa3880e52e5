"""Samples in folders: what is written is read again, and what cannot be trusted is refused before it is unpacked."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from commandline import Seeds
from latticebench.systems import folders
from latticebench.systems.errors import InputError
from latticebench.systems.readers import read, read_all
from latticebench.systems.samples import Samples
from latticebench.systems.writers import write

pytest.importorskip("zarr")


def trajectory(count: int = 9, sites: int = 5, *, is_complex: bool = False, seed: int = 0) -> Samples:
    draw = np.random.default_rng(seed)
    u, v = draw.normal(size=(2, count, sites))
    u[1, -1] = np.nan
    return Samples(np.arange(count) / 4.0, u + 1j * v if is_complex else u, None if is_complex else v, f=v)


def same(found: Samples, expected: Samples) -> None:
    for name in ("t", "u", "v", "f"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


@pytest.mark.parametrize("is_complex", [False, True])
@pytest.mark.parametrize("several", [False, True])
def test_a_zarr_store_holds_what_was_written_in_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_complex: bool, several: bool
) -> None:
    data = [trajectory(is_complex=is_complex, seed=k) for k in range(1 + several)]
    monkeypatch.setattr(folders, "CHUNK", 12)
    write(data, tmp_path / "store.zarr")
    assert len(list((tmp_path / "store.zarr" / "u").rglob("*"))) > 5
    found = read(tmp_path / "store.zarr")
    assert len(found) == len(data)
    for one, expected in zip(found, data, strict=True):
        same(one, expected)


def test_xarray_opens_a_store_with_names_of_its_dimensions(tmp_path: Path) -> None:
    import xarray

    samples = trajectory()
    write([samples], tmp_path / "store.zarr")
    with xarray.open_zarr(tmp_path / "store.zarr", consolidated=False) as table:
        assert table["u"].dims == ("t", "site")
        np.testing.assert_array_equal(table["t"], samples.t)
        np.testing.assert_array_equal(table["v"].sel(site=2), samples.v[:, 1])  # type: ignore[index]


def test_parquet_in_parts_is_one_table_whose_folders_say_the_trajectory(tmp_path: Path) -> None:
    data = [trajectory(seed=k) for k in range(12)]
    write(data, tmp_path / "all.parquet", parts=True)
    assert (tmp_path / "all.parquet" / "trajectory=12" / "part-0.parquet").exists()
    found = read(tmp_path / "all.parquet")
    assert [one.source.rpartition(" ")[2] for one in found] == [str(k) for k in range(1, 13)]
    for one, expected in zip(found, data, strict=True):
        same(one, expected)
    # A table that a program has cut in time.
    first, second = tmp_path / "cut.parquet" / "part-2.parquet", tmp_path / "cut.parquet" / "part-10.parquet"
    whole = data[0]
    assert whole.v is not None
    assert whole.f is not None
    for path, some in ((first, slice(4)), (second, slice(4, None))):
        write([Samples(whole.t[some], whole.u[some], whole.v[some], whole.f[some])], path)
    (found,) = read(tmp_path / "cut.parquet")
    same(found, whole)


def test_a_folder_of_files_is_one_data_set_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    folder = tmp_path / "many"
    data = [trajectory(4, 2, seed=k) for k in range(300)]
    for number, one in enumerate(data):
        write([one], folder / f"run{number}.csv")
    (folder / ".notes").write_text("x")
    found = read_all([folder])
    assert len(found) == 300
    for one, expected in zip(found, data, strict=True):
        same(one, expected)


def test_what_is_no_data_set_is_refused_with_the_place_and_the_reason(tmp_path: Path) -> None:
    def refusal(path: Path) -> str:
        with pytest.raises(InputError) as caught:
            read(path)
        return str(caught.value)

    empty = tmp_path / "empty"
    empty.mkdir()
    assert "has no files" in refusal(empty)
    write([trajectory()], tmp_path / "mixed" / "a.csv")
    (tmp_path / "mixed" / "b.txt.gz").write_bytes(b"x")
    assert "b.txt.gz: the ending" in refusal(tmp_path / "mixed")
    write([trajectory()], tmp_path / "unlike" / "a.csv")
    write([trajectory(sites=3)], tmp_path / "unlike" / "b.csv")
    assert "3 sites" in refusal(tmp_path / "unlike")
    write([trajectory()], tmp_path / "linked" / "a.csv")
    (tmp_path / "linked" / "b.csv").symlink_to("/etc/hostname")
    assert "neither a regular file" in refusal(tmp_path / "linked")
    os.mkfifo(tmp_path / "linked" / "b.fifo")
    (tmp_path / "linked" / "b.csv").unlink()
    assert "neither a regular file" in refusal(tmp_path / "linked")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"codecs": [{"name": "bytes"}, {"name": "numcodecs.pickle"}]}, "packed with 'numcodecs.pickle'"),
        (
            {"codecs": [{"name": "sharding_indexed", "configuration": {"codecs": [{"name": "pickle"}]}}]},
            "packed with 'pickle'",
        ),
        ({"data_type": "string"}, "string, not numbers"),
        ({"attributes": {"scale_factor": 0.1}}, "are scaled"),
        ({"shape": [10**7, 10**4]}, "MiB of numbers"),
        ({"shape": "no"}, "not a Zarr store"),
    ],
)
def test_a_store_is_looked_at_before_it_is_unpacked(tmp_path: Path, change: dict[str, object], reason: str) -> None:
    write([trajectory()], tmp_path / "s.zarr")
    head = tmp_path / "s.zarr" / "u" / "zarr.json"
    if not head.exists():
        pytest.skip("an older zarr")
    head.write_text(json.dumps(json.loads(head.read_text()) | change))
    with pytest.raises(InputError, match=reason):
        read(tmp_path / "s.zarr")


def test_the_second_form_of_zarr_is_read_and_its_pickles_are_not(tmp_path: Path) -> None:
    import xarray

    samples = trajectory()
    table = xarray.Dataset({"u": (("t", "site"), samples.u)}, {"t": samples.t})
    table.to_zarr(tmp_path / "s.zarr", consolidated=False, zarr_format=2)
    (found,) = read(tmp_path / "s.zarr")
    np.testing.assert_array_equal(found.u, samples.u)
    head = tmp_path / "s.zarr" / "u" / ".zarray"
    head.write_text(json.dumps(json.loads(head.read_text()) | {"filters": [{"id": "pickle"}]}))
    with pytest.raises(InputError, match="packed with 'pickle'"):
        read(tmp_path / "s.zarr")


def test_unknown_arrays_and_folders_that_are_there_are_refused(tmp_path: Path) -> None:
    write([trajectory()], tmp_path / "s.zarr")
    with pytest.raises(InputError, match="there already"):
        write([trajectory()], tmp_path / "s.zarr")
    (tmp_path / "s.zarr" / "v").rename(tmp_path / "s.zarr" / "w")
    with pytest.raises(InputError, match="unknown array 'w'"):
        read(tmp_path / "s.zarr")
    with pytest.raises(InputError, match="only Parquet"):
        write([trajectory()], tmp_path / "s.csv", parts=True)


def chunks(folder: Path) -> list[Path]:
    """The files of an array that hold its values."""
    return [path for path in folder.rglob("*") if path.is_file() and "zarr" not in path.name]


def test_a_chunk_of_zeros_is_written_and_one_that_is_lost_is_no_zeros(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folders, "CHUNK", 12)
    u = np.zeros((9, 5))
    u[:, 4] = 1.0
    write([Samples(np.arange(9.0), u)], tmp_path / "s.zarr")
    same(read(tmp_path / "s.zarr")[0], Samples(np.arange(9.0), u))
    chunks(tmp_path / "s.zarr" / "u")[0].unlink()
    with pytest.raises(InputError, match=r"array 'u': 1 of its \d chunks are not there.*copy the store again"):
        read(tmp_path / "s.zarr")


def test_a_chunk_that_stands_for_missing_values_need_not_be_there(tmp_path: Path) -> None:
    import xarray

    u = np.arange(18.0).reshape(9, 2)
    u[:, 1] = np.nan
    table = xarray.Dataset({"u": (("t", "site"), u)}, {"t": np.arange(9.0)})
    encoding = {"u": {"chunks": (9, 1), "fill_value": np.nan}}
    table.to_zarr(tmp_path / "s.zarr", consolidated=False, encoding=encoding, zarr_format=3)
    assert len(chunks(tmp_path / "s.zarr" / "u")) == 1
    np.testing.assert_array_equal(read(tmp_path / "s.zarr")[0].u, u)


def test_a_damaged_store_is_refused_or_read_as_it_was(tmp_path: Path, seeds: Seeds) -> None:
    """In any of its files: a byte changed, an end cut off, a file lost or in another's place."""
    expected = trajectory(20)
    write([expected], tmp_path / "s.zarr")
    files = sorted(path for path in (tmp_path / "s.zarr").rglob("*") if path.is_file())
    for seed in seeds(40, 400):
        draw, folder = random.Random(seed), tmp_path / "damaged.zarr"
        shutil.copytree(tmp_path / "s.zarr", folder)
        file = folder / draw.choice(files).relative_to(tmp_path / "s.zarr")
        content = bytearray(file.read_bytes())
        match draw.choice(("flip", "cut", "lose", "swap", "number")):
            case "flip":
                content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
                file.write_bytes(content)
            case "cut":
                file.write_bytes(content[: draw.randrange(len(content))])
            case "lose":
                file.unlink()
            case "swap":
                file.write_bytes(draw.choice(files).read_bytes())
            case "number":
                file.write_bytes(
                    re.sub(rb"\d+", draw.choice((b"0", b"-1", b"7", b"9999999999", b"null")), content, count=1)
                )
        try:
            (found,) = read(folder)
        except InputError as error:
            told = str(error)
            assert told.startswith(str(folder)), (seed, told)
            assert "\n" not in told
        else:
            assert found.u.shape == expected.u.shape, seed
        shutil.rmtree(folder)
