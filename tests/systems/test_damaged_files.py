"""Files that are invalid, damaged or made to harm: each is refused by its name and the place in it."""

import io
import pickle
import time
import zipfile

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from latticebench.systems.errors import InputError
from latticebench.systems.files import LARGEST
from latticebench.systems.readers import FORMATS, read
from latticebench.systems.samples import Samples
from latticebench.systems.writers import write


def refused(path, *words):
    with pytest.raises(InputError) as caught:
        read(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    for word in words:
        assert word in message
    return message


def data_or_error(path):
    """Read a file that may be sound or not: the data and the message, one of them empty."""
    try:
        return read(path), ""
    except InputError as error:
        return [], str(error)


BAD_TABLES = {
    "no t": ("u1,u2\n0,1\n1,2\n", ["no column t"]),
    "no u": ("t\n0\n1\n", ["u1..uN"]),
    "text in a number column": ("t,u1,u2\n0,1,2\n1,2,three\n", ["row 2", "column u2", "'three'"]),
    "text in t": ("t,u1\n0,1\nnoon,2\n", ["row 2", "column t", "'noon'"]),
    "a decimal comma": ('t,u1\n0,"1,5"\n1,2\n', ["row 1", "column u1"]),
    "a truth value": ("t,u1\n0,True\n1,2\n", ["row 1", "column u1", "'True'"]),
    "times that do not increase": ("t,u1\n0,1\n1,2\n0.5,3\n", ["row 3", "column t", "0.5 after 1"]),
    "a time twice": ("t,u1\n0,1\n1,2\n1,3\n", ["row 3", "column t"]),
    "a missing time": ("t,u1\n0,1\n,2\n2,3\n", ["row 2", "column t"]),
    "an endless time": ("t,u1\n0,1\ninf,2\n", ["row 2", "column t"]),
    "one row": ("t,u1\n0,1\n", ["1 row"]),
    "no rows": ("t,u1\n", ["0 row"]),
    "all NaN": ("t,u1,u2\n0,,nan\n1,nan,\n", ["every value of u is missing"]),
    "an infinite value": ("t,u1,u2\n0,1,2\n1,-inf,2\n", ["row 2", "column u1", "infinite"]),
    "a time that no power can be taken of": ("t,u1\n0,1\n1e300,2\n", ["row 2", "column t", "beyond 1e+50"]),
    "a value that no power can be taken of": ("t,u1,u2\n0,1,2\n1,-1e300,2\n", ["row 2", "column u1", "beyond 1e+50"]),
    "an imaginary part as large": ("t,re1,im1\n0,1,2\n1,2,-1e300\n", ["row 2", "column u1", "beyond 1e+50"]),
    "sites of u and v differ": ("t,u1,u2,v1\n0,1,2,3\n1,1,2,3\n", ["u has 2 sites", "v"]),
    "sites of re and im differ": ("t,re1,re2,im1\n0,1,2,3\n1,1,2,3\n", ["2 columns re", "1 columns im"]),
    "re without im": ("t,re1\n0,1\n1,1\n", ["re1..reN and im1..imN"]),
    "u and re": ("t,u1,re1,im1\n0,1,1,1\n1,1,1,1\n", ["either"]),
    "a column twice": ("t,u1,u1\n0,1,2\n1,2,3\n", ["'u1' occurs twice"]),
    "t twice": ("t,u1, t\n0,1,2\n1,2,3\n", ["'t' occurs twice"]),
    "a gap in the site numbers": ("t,u1,u3\n0,1,2\n1,2,3\n", ["column u2 is missing"]),
    "sites from zero": ("t,u0,u1\n0,1,2\n1,2,3\n", ["'u0'"]),
    "a misspelt column": ("t,u1,U2\n0,1,2\n1,2,3\n", ["unknown column 'U2'"]),
    "f and f1": ("t,u1,f,f1\n0,1,2,3\n1,2,3,4\n", ["both f and f1"]),
    "a long row": ("t,u1\n0,1\n1,2,3\n", ["line 3"]),
    "a short row": ("t,u1,u2\n0,1,2\n1,2\n2,3,4\n", ["row 2", "2 value(s)"]),
    "cut off in the last row": ("t,u1,u2\n0,1,2\n1,2,3\n2,", ["row 3", "2 value(s)"]),
    "an open quote": ('t,u1\n"0,1\n1,2\n', ["not a table"]),
    "blank lines only": ("\n\n", ["empty"]),
    "a remark only": ("# t,u1\n", ["empty"]),
    "one bad trajectory": ("trajectory,t,u1\na,0,1\na,1,2\nb,0,1\n", ["trajectory b", "1 row"]),
}


@pytest.mark.parametrize("name", BAD_TABLES)
def test_a_bad_table_is_told_by_file_and_place(tmp_path, name):
    text, words = BAD_TABLES[name]
    path = tmp_path / "bad.csv"
    path.write_text(text, encoding="utf-8")
    refused(path, *words)


@pytest.mark.parametrize("suffix", FORMATS)
def test_an_empty_file_a_folder_and_a_missing_file_are_told(tmp_path, suffix):
    empty, folder = tmp_path / f"empty{suffix}", tmp_path / f"folder{suffix}"
    empty.touch()
    folder.mkdir()
    refused(empty, "empty")
    refused(folder, "folder")
    refused(tmp_path / f"gone{suffix}", "no such file")


def test_an_unknown_ending_is_told(tmp_path):
    path = tmp_path / "data.ods"
    path.write_text("t,u1\n0,1\n1,2\n")
    refused(path, "'.ods'", ".csv")
    for suffix in (".ods", ".xlsx", ".txt"):
        with pytest.raises(InputError, match=rf"\{suffix}"):
            write([Samples(np.arange(2.0), np.ones((2, 1)))], tmp_path / f"data{suffix}")


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("seed", range(6))
def test_binary_garbage_is_refused_in_every_format(tmp_path, suffix, seed):
    path = tmp_path / f"garbage{suffix}"
    draw = np.random.default_rng(seed)
    path.write_bytes(bytes(draw.integers(0, 256, 10 ** (1 + seed % 4), dtype=np.uint8)))
    refused(path)


@given(content=st.binary(min_size=1, max_size=200))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_are_data_or_an_input_error(tmp_path, content):
    for suffix in FORMATS:
        path = tmp_path / f"any{suffix}"
        path.write_bytes(content)
        found, told = data_or_error(path)
        assert found or told.startswith(str(path))


@given(text=st.text(alphabet='tuv12,.\n-#e "na', max_size=60).map("t,u1,u2\n0,1,2\n".__add__))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_table_is_data_or_an_input_error(tmp_path, text):
    path = tmp_path / "any.csv"
    path.write_text(text, encoding="utf-8")
    found, told = data_or_error(path)
    assert (len(found) == 1 and found[0].sites == 2) or told.startswith(str(path))


def test_a_pickled_npz_is_never_loaded(tmp_path):
    proof = tmp_path / "proof"

    class Bomb:
        def __reduce__(self):
            return (open, (str(proof), "w"))

    path = tmp_path / "bomb.npz"
    np.savez(path, t=np.arange(2.0), u=np.array([Bomb()], dtype=object))
    refused(path, "pickled", "numpy.savez")
    path.write_bytes(pickle.dumps(Bomb()))
    refused(path, "pickled")
    assert not proof.exists()


def test_a_damaged_npz_is_refused_wherever_a_bit_is_flipped(tmp_path):
    path = tmp_path / "a.npz"
    u = np.random.default_rng(0).normal(size=(4, 2))
    write([Samples(np.arange(4.0), u)], path)
    whole = path.read_bytes()
    for place in range(0, len(whole), 3):
        damaged = bytearray(whole)
        damaged[place] ^= 0x5A
        path.write_bytes(bytes(damaged))
        found, told = data_or_error(path)
        if not told:
            np.testing.assert_array_equal(found[0].t, np.arange(4.0))
            np.testing.assert_array_equal(found[0].u, u)
            assert len(found) == 1
        else:
            assert told.startswith(str(path))
    for end in range(1, len(whole), 7):
        path.write_bytes(whole[:end])
        refused(path)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"u": np.ones((2, 1))}, ["'t' is missing"]),
        ({"t": np.arange(2.0)}, ["'u' is missing"]),
        ({"t": np.arange(2.0), "u": np.ones((2, 1)), "w": np.ones(2)}, ["unknown array 'w'"]),
        ({"t": np.arange(2.0), "u": np.array([["a"], ["b"]])}, ["array u", "not numbers"]),
        ({"t": np.arange(2.0) * 1j, "u": np.ones((2, 1))}, ["array t", "real"]),
        ({"t": np.ones((2, 1)), "u": np.ones((2, 1))}, ["array t", "(2, 1)"]),
        ({"t": np.arange(3.0), "u": np.ones((2, 1))}, ["array u", "3 times"]),
        ({"t": np.arange(2.0), "u": np.ones((2, 1, 1))}, ["array u", "(2, 1, 1)"]),
        ({"t": np.arange(2.0), "u": np.ones((2, 3)), "v": np.ones((2, 2))}, ["3 sites", "v has shape"]),
        ({"t": np.arange(2.0), "u": np.ones((2, 3)), "v": 1j * np.ones((2, 3))}, ["v is complex"]),
        ({"t": np.arange(2.0), "u": np.ones((2, 3)), "f": 1j * np.ones((2, 3))}, ["f is complex"]),
        ({"t": np.arange(2.0), "u": np.ones((2, 0))}, ["no sites"]),
        ({"t": np.arange(1.0), "u": np.ones((1, 2))}, ["1 row"]),
        ({"t": np.array([0.0, 0.0]), "u": np.ones((2, 2))}, ["row 2", "column t"]),
        ({"t": np.arange(2.0), "u": np.full((2, 2), np.nan)}, ["every value of u is missing"]),
        ({"t": np.arange(2.0), "u": np.array([[1, 2], [3, np.inf]])}, ["row 2", "column u2"]),
        ({"t": np.arange(2.0), "u": np.ones((2, 2)), "trajectory": np.ones(3)}, ["trajectory", "(3,)"]),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else None,
)
def test_an_npz_with_the_wrong_arrays_is_told_by_file_and_array(tmp_path, arrays, words):
    path = tmp_path / "bad.npz"
    np.savez(path, **arrays)
    refused(path, *words)


def test_other_files_under_the_name_of_an_npz_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    with path.open("wb") as handle:
        np.save(handle, np.arange(4.0))
    refused(path, "NPZ")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("t.npy", "not an array")
        archive.writestr("u.npy", "nor this one")
    refused(path, "'t' is not an array")


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"t": [0.0, 1.0], "u1": ["a", "b"]}, ["row 1", "column u1"]),
        ({"t": [0.0, 1.0], "u1": [[1.0], [2.0]]}, ["row 1", "column u1"]),
        ({"t": [0.0, 1.0], "u1": [{"a": 1}, {"a": 2}]}, ["row 1", "column u1"]),
        ({"t": [0.0, 1.0], " t": [0.0, 1.0], "u1": [1.0, 2.0]}, ["'t' occurs twice"]),
        ({"t": pd.to_datetime(["2020-01-01", "2020-01-02"]), "u1": [1.0, 2.0]}, ["column t", "dates"]),
        ({"u1": [1.0, 2.0]}, ["no column t"]),
        ({"t": [0.0, 1.0], "u1": pa.array([None, None], pa.float64())}, ["every value of u is missing"]),
        ({"t": [1.0, 0.0], "u1": [1.0, 2.0]}, ["row 2", "column t"]),
        ({"t": [0.0], "u1": [1.0]}, ["1 row"]),
    ],
    ids=["a text", "lists", "structures", "twice", "dates", "no t", "all missing", "backwards", "one row"],
)
def test_a_bad_parquet_is_told_by_file_and_place(tmp_path, table, words):
    path = tmp_path / "bad.parquet"
    pq.write_table(pa.table(table), path)
    refused(path, *words)


def test_a_cut_parquet_is_refused(tmp_path):
    path = tmp_path / "a.parquet"
    write([Samples(np.arange(4.0), np.ones((4, 2)))], path)
    whole = path.read_bytes()
    for end in range(1, len(whole), 101):
        path.write_bytes(whole[:end])
        refused(path, "Parquet")


# Files made to harm


def test_an_npz_is_weighed_before_it_is_unpacked(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, t=np.arange(3.0), u=np.zeros((3, 1)), spare=np.zeros(10**6))
    refused(path, "unknown array 'spare'")

    def archive(**members):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
            for name, (head, body) in members.items():
                content = io.BytesIO()
                np.lib.format.write_array_header_1_0(content, {"fortran_order": False, **head})
                file.writestr(f"{name}.npy", content.getvalue() + body)

    def head(*shape, descr="<f8"):
        return {"descr": descr, "shape": shape}

    times = (head(3), np.arange(3.0).tobytes())
    archive(t=times, u=(head(3, 10**12), b""))
    refused(path, "MiB of numbers", "--largest-file")
    archive(t=times, u=(head(3, 10**30), b""))
    refused(path, "MiB of numbers")
    archive(t=times, u=(head(3, -1), b""))
    refused(path)
    archive(t=times, u=(head(3, 5), b"\0" * 8))
    refused(path)
    archive(t=times, u=(head(3, 1, descr="|b1"), b"\1\1\1"))
    refused(path, "array u", "bool")
    archive(t=times, u=(head(3, 1, descr="<U100000"), b""))
    refused(path, "array u")
    with zipfile.ZipFile(path, "w") as file:
        for name in ("t.npy", "u.npy"):
            file.writestr(name, b"")
        with pytest.warns(UserWarning, match="Duplicate"):
            file.writestr("u.npy", b"")
    refused(path, "occurs twice")


def test_a_small_parquet_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.parquet"
    pq.write_table(pa.table({"t": np.arange(2e5), "u1": np.zeros(200_000)}), path)
    assert len(read(path)) == 1
    monkeypatch.setenv(LARGEST, "2")
    refused(path, "MiB of numbers", "--largest-file")
    monkeypatch.setenv(LARGEST, "4")
    assert len(read(path)) == 1
    monkeypatch.setenv(LARGEST, "many")
    with pytest.raises(InputError, match="whole number of MiB"):
        read(path)


@pytest.mark.parametrize("kind", [pa.bool_(), pa.binary(), pa.string(), pa.timestamp("s"), pa.duration("s"), pa.null()])
def test_a_parquet_column_of_other_things_than_numbers_is_refused_by_its_type(tmp_path, kind):
    path = tmp_path / "a.parquet"
    pq.write_table(pa.table({"t": [0.0, 1.0], "u1": pa.array([None, None], kind)}), path)
    refused(path, "column u1")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,u1\0\n0,1\n1,2\n", ["line 1", "not a text file"]),
        ("t,u1\n0,1\n1,2\0\n", ["line 3", "not a text file"]),
        (f"t,u1,u2\n0,1,2\n1,{'0' * 200_000}1\n", ["line 3", "one number"]),
        (f"t,{'u' * 200_000}\n0,1\n1,2\n", ["u1..uN", "--columns"]),
        ("t,u1\n0,1_0\n1,2\n", ["row 1", "'1_0'"]),
        ("t,u1\n0,0x1A\n1,2\n", ["row 1", "'0x1A'"]),
        ("t,u1\n0,\u0661\n1,2\n", ["row 1", "column u1"]),
        (f"t,u1\n0,{'9' * 5000}\n1,2\n", ["row 1", "column u1"]),
    ],
    ids=["NUL in the header", "NUL in a cell", "long cell", "long name", "underscore", "hexadecimal", "digit", "huge"],
)
def test_a_cell_that_is_no_plain_number_is_told_by_its_place(tmp_path, text, words):
    path = tmp_path / "bad.csv"
    path.write_text(text, encoding="utf-8")
    assert len(refused(path, *words)) < 1000


def test_many_trajectories_are_split_in_no_time(tmp_path):
    count = 20_000
    u = np.arange(2.0 * count).reshape(-1, 1)
    labels = np.repeat(np.arange(count)[::-1], 2)
    np.savez(tmp_path / "a.npz", t=np.tile([0.0, 1.0], count), u=u, trajectory=labels)
    began = time.process_time()
    found = read(tmp_path / "a.npz")
    assert time.process_time() - began < 20
    assert len(found) == count
    assert found[0].source.endswith(f"trajectory {count - 1}")
    np.testing.assert_array_equal(found[-1].u[:, 0], u[-2:, 0])
    np.savez(tmp_path / "b.npz", t=np.arange(3.0), u=np.ones((3, 1)), trajectory=np.array([1, 2, 3]))
    refused(tmp_path / "b.npz", "trajectory 1", "1 row")
