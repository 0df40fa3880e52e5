"""Reading: what was written is read to the last digit, and what other programs write is read too."""

import decimal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from latticebench.systems.errors import InputError
from latticebench.systems.readers import FORMATS, read, read_all
from latticebench.systems.samples import LARGEST_VALUE, Samples
from latticebench.systems.writers import write

# Round trips

FINITE = st.floats(-LARGEST_VALUE, LARGEST_VALUE)
# Doubles lie closer than samples may only near zero.
TIMES = FINITE.map(lambda time: time if abs(time) > 1e-30 else 0.0)
REAL = st.one_of(FINITE, st.just(float("nan")))


@st.composite
def data_sets(draw):
    count = draw(st.integers(1, 4))
    is_complex = draw(st.booleans())
    with_v, with_f = draw(st.booleans()) and not is_complex, draw(st.booleans())
    found = []
    for _ in range(draw(st.integers(1, 3))):
        rows = draw(st.integers(2, 6))
        t = np.array(sorted(draw(st.lists(TIMES, min_size=rows, max_size=rows, unique_by=lambda x: x + 0.0))))

        def field(rows=rows):
            return draw(hnp.arrays(float, (rows, count), elements=REAL))

        u = field()
        if is_complex:
            imaginary = field()
            u = np.where(np.isnan(u) | np.isnan(imaginary), complex(np.nan, np.nan), u + 1j * imaginary)
        u[0, 0] = 1.25
        found.append(Samples(t, u, field() if with_v else None, field() if with_f else None))
    return found


def assert_same(got, wanted):
    assert len(got) == len(wanted)
    for one, other in zip(got, wanted, strict=True):
        np.testing.assert_array_equal(one.t, other.t)
        for name in ("u", "v", "f"):
            a, b = getattr(one, name), getattr(other, name)
            assert (a is None) == (b is None)
            if a is not None:
                assert a.dtype == b.dtype
                np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("suffix", FORMATS)
@given(data=data_sets())
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_written_is_read_again_to_the_last_digit(tmp_path, suffix, data):
    path = tmp_path / f"data{suffix}"
    write(data, path)
    assert_same(read(path), data)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", FORMATS)
def test_random_digits_over_all_magnitudes_survive(tmp_path, suffix):
    draw = np.random.default_rng(0)
    u = draw.normal(size=(500, 3)) * 10.0 ** draw.integers(-300, 49, (500, 3))
    data = [Samples(np.cumsum(draw.uniform(1e-9, 1, 500)), u)]
    write(data, tmp_path / f"data{suffix}")
    assert_same(read(tmp_path / f"data{suffix}"), data)


def test_the_upper_case_of_an_ending_is_the_same_format(tmp_path):
    data = [Samples(np.arange(3.0), np.ones((3, 2)))]
    for suffix in FORMATS:
        write(data, tmp_path / f"data{suffix.upper()}")
        assert_same(read(tmp_path / f"data{suffix.upper()}"), data)


def test_a_complex_field_with_velocities_goes_into_npz_only(tmp_path):
    data = [Samples(np.arange(2.0), np.ones((2, 2)) * 1j, np.ones((2, 2)) * (1 + 2j))]
    write(data, tmp_path / "data.npz")
    assert_same(read(tmp_path / "data.npz"), data)
    for suffix in (".csv", ".parquet"):
        with pytest.raises(InputError, match="npz"):
            write(data, tmp_path / f"data{suffix}")
        assert not (tmp_path / f"data{suffix}").exists()


def test_a_table_as_the_design_has_it_is_read(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("# measured on a Monday\nt, u2, u1, f\n0, 2, 1, 0.5\n0.1,, 1.5, nan\n", encoding="utf-8")
    (one,) = read(path, "free")
    np.testing.assert_array_equal(one.u, [[1, 2], [1.5, np.nan]])
    np.testing.assert_array_equal(one.f, [[0.5, 0.5], [np.nan, np.nan]])
    assert one.v is None
    assert one.ends == "free"
    assert one.source == str(path)


def test_a_column_trajectory_splits_a_file_in_the_order_of_first_appearance(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("trajectory,t,u1\nb,0,1\na,0,10\nb,1,2\na,1,20\na,2,30\n")
    first, second = read(path)
    np.testing.assert_array_equal(first.u[:, 0], [1, 2])
    np.testing.assert_array_equal(second.u[:, 0], [10, 20, 30])
    assert "trajectory b" in first.source
    assert str(path) in first.source


def test_a_byte_order_mark_does_not_hide_the_first_column(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"\xef\xbb\xbft,u1\r\n0,1\r\n1,2\r\n")
    np.testing.assert_array_equal(read(path)[0].u, [[1], [2]])


def test_an_npz_of_whole_numbers_and_one_site_is_read(tmp_path):
    np.savez(tmp_path / "a.npz", t=np.arange(3), u=np.array([1, 2, 3]), f=np.array([4, 5, 6]))
    (one,) = read(tmp_path / "a.npz")
    np.testing.assert_array_equal(one.u, [[1.0], [2.0], [3.0]])
    assert one.t.dtype == one.u.dtype == one.f.dtype == float


def test_other_number_types_of_parquet_are_read(tmp_path):
    path = tmp_path / "a.parquet"
    table = {
        "t": pa.array([0, 1], pa.int32()),
        "u1": [decimal.Decimal("1.5"), None],
        "u2": pa.array([1, None], pa.int64()),
        "u3": pa.array([0.5, 1.5], pa.float32()),
    }
    pq.write_table(pa.table(table), path)
    np.testing.assert_array_equal(read(path)[0].u, [[1.5, 1, 0.5], [np.nan, np.nan, 1.5]])


def test_rows_that_end_early_are_told_apart_from_gaps(tmp_path):
    path = tmp_path / "gaps.csv"
    path.write_text("t,u1,u2\n0,1,\n# a remark\n1,,\n2,3,4\n")
    np.testing.assert_array_equal(read(path)[0].u, [[1, np.nan], [np.nan, np.nan], [3, 4]])


@pytest.mark.parametrize("kind", [pa.int8(), pa.uint64(), pa.float16(), pa.decimal128(30, 3)])
def test_a_parquet_column_of_any_numbers_may_have_gaps(tmp_path, kind):
    path = tmp_path / "a.parquet"
    values = np.array([1, 2, 4], np.float16) if kind == pa.float16() else [1, 2, 4]
    column = pa.array(values).cast(kind) if kind != pa.float16() else pa.array(values)
    pq.write_table(pa.table({"t": [0.0, 1.0, 2.0], "u1": column, "u2": pa.array([None, 3, None], pa.int64())}), path)
    np.testing.assert_array_equal(read(path)[0].u, [[1, np.nan], [2, 3], [4, np.nan]])


# Several files


def some(sites=2, is_complex=False, v=False, f=False):
    u = np.ones((3, sites)) * (1j if is_complex else 1.0)
    return Samples(np.arange(3.0), u, np.ones((3, sites)) if v else None, np.ones((3, sites)) if f else None)


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"sites": 3}, "3 sites"),
        ({"is_complex": True}, "complex"),
        ({"v": True}, "v1..vN"),
        ({"f": True}, "f1..fN"),
    ],
)
def test_files_that_do_not_fit_together_are_refused_by_their_names(tmp_path, other, words):
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    write([some()], first)
    write([some(**other)], second)
    with pytest.raises(InputError, match=words) as caught:
        read_all([first, second])
    assert str(first) in str(caught.value)
    assert str(second) in str(caught.value)


def test_files_of_different_lengths_fit_together(tmp_path):
    write([some()], tmp_path / "a.csv")
    write([Samples(np.arange(5.0), np.ones((5, 2)))], tmp_path / "b.npz")
    assert [len(one.t) for one in read_all([tmp_path / "a.csv", tmp_path / "b.npz"])] == [3, 5]


def test_the_formats_are_the_designs():
    assert FORMATS == (".csv", ".npz", ".parquet")
