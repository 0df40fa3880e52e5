"""A recording as it comes from a laboratory is read rightly and said so, or refused with the option that reads it."""

import numpy as np
import openpyxl
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from latticebench.systems.errors import InputError
from latticebench.systems.layout import Layout, unit_of
from latticebench.systems.ordering import unwrapped
from latticebench.systems.readers import from_frame, read, read_all

PENDULA = Layout("time_s", ("theta_*_deg",), "deg")
U = np.array([[10.5, -20.25], [11.0, np.nan], [-3.0, 4.0]])


def lines(separator, decimal=".", *, above="", head="time_s,theta_1_deg,theta_2_deg,temperature"):
    rows = [head.replace(",", separator)]
    for t, row in zip((0.0, 0.5, 1.0), U, strict=True):
        cells = [f"{t}", *("" if np.isnan(one) else f"{one}" for one in row), "21.5"]
        rows.append(separator.join(cell.replace(".", decimal) for cell in cells))
    return above + "\n".join(rows) + "\n"


def written(tmp_path, text, name="a.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_text(text, encoding=encoding)
    return path


def assert_pendula(path, layout=PENDULA):
    (one,) = read(path, "free", layout)
    np.testing.assert_array_equal(one.t, [0, 0.5, 1])
    np.testing.assert_allclose(one.u, np.deg2rad(U), rtol=1e-15)
    assert (one.origin.time, one.origin.unit, one.origin.becomes) == ("s", "deg", "rad")
    assert one.origin.columns == ("theta_1_deg", "theta_2_deg")
    assert "not read: temperature" in one.origin.notes
    return one


@pytest.mark.parametrize(("separator", "decimal"), [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_separators_decimal_commas_and_byte_order_marks_change_nothing(tmp_path, separator, decimal, encoding):
    one = assert_pendula(written(tmp_path, lines(separator, decimal), encoding=encoding))
    assert ("decimals are written with commas" in one.origin.notes) == (decimal == ",")


@pytest.mark.parametrize("dash", ["-", "--", "\N{EN DASH}"])
def test_cells_with_a_dash_are_missing_and_counted(tmp_path, dash):
    path = tmp_path / "a.csv"
    path.write_text(f"t;u1;u2\n0;1,5;2\n1;{dash};2,5\n2;-1,25; {dash}\n3;1;2\n", encoding="utf-8")
    (one,) = read(path, "free", Layout())
    np.testing.assert_array_equal(one.u, [[1.5, 2], [np.nan, 2.5], [-1.25, np.nan], [1, 2]])
    assert {"2 cell(s) with a dash are taken as missing", "decimals are written with commas"} <= {*one.origin.notes}


def test_dashes_in_columns_that_are_not_read_are_not_told_and_labels_stay(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,u1,trajectory,note\n0,1,-,-\n1,2,-,-\n0,3,b,-\n1,4,b,-\n", encoding="utf-8")
    first, second = read(path, "free", Layout())
    assert not any("dash" in note for one in (first, second) for note in one.origin.notes)
    np.testing.assert_array_equal(np.concatenate([first.u, second.u])[:, 0], [1, 2, 3, 4])


def test_a_row_of_units_may_have_a_dash_for_a_column_without_one(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t;u1;u2;count\ns;mm;mm;-\n0;1;2;5\n1;1;2;6\n2;2;1;7\n", encoding="utf-8")
    (one,) = read(path, "free", Layout())
    assert (one.origin.time, one.origin.unit, len(one.t)) == ("s", "mm", 3)


def test_rows_above_the_table_are_skipped_and_counted(tmp_path):
    above = "Torsion chain, run 3\nOperator: R. M., t = 20 C\n# a remark\n\n"
    one = assert_pendula(written(tmp_path, lines(";", ",", above=above)))
    assert "2 row(s) above the table were skipped" in one.origin.notes


def test_a_table_of_spaces_and_a_header_in_a_remark_are_read(tmp_path):
    path = tmp_path / "a.txt"
    np.savetxt(path, np.column_stack([[0, 1, 2], U[:, 0], U[:, 0]]), header="t x_1 x_2")
    (one,) = read(path, layout=Layout(columns=("x_*",)))
    np.testing.assert_array_equal(one.u, U[:, [0, 0]])


def test_the_units_are_found_in_names_and_in_a_row_of_their_own(tmp_path):
    for name, unit in {
        "theta_1_deg": "deg", "x (mm)": "mm", "x [°]": "deg", "x / mV": "mV", "angle deg": "deg", "t_ms": "ms",
        "theta_1": "", "u1": "", "x_total": "", "x (a note of the lab)": "",
    }.items():  # fmt: skip
        assert unit_of(name) == unit, name
    text = "time;x1;x2\n[ms];[mm];[mm]\n0;1;2\n5;2;3\n"
    (one,) = read(written(tmp_path, text), layout=Layout("time", ("x*",), "mm"))
    assert (one.origin.time, one.origin.unit, one.origin.becomes) == ("ms", "mm", "m")
    np.testing.assert_allclose(one.u, [[1e-3, 2e-3], [2e-3, 3e-3]])
    # Old German programs write degrees in Windows-1252.
    text = "Zeit (s);Winkel 1 (°)\n0;1,5\n1;2,5\n"
    (one,) = read(written(tmp_path, text, encoding="cp1252"), layout=Layout("Zeit (s)", ("Winkel *",), "deg"))
    assert one.origin.unit == "deg"
    np.testing.assert_allclose(one.u[:, 0], np.deg2rad([1.5, 2.5]))


def test_columns_of_a_pattern_come_in_the_order_of_their_numbers_and_those_of_a_list_in_its_order(tmp_path):
    path = written(tmp_path, "t,x10,x2,x1\n0,10,2,1\n1,10,2,1\n")
    np.testing.assert_array_equal(read(path, layout=Layout(columns=("x*",)))[0].u[0], [1, 2, 10])
    np.testing.assert_array_equal(read(path, layout=Layout(columns=("x10,x1", "x2")))[0].u[0], [10, 1, 2])
    path = written(tmp_path, "t,a [mm],b [mm]\n0,1,2\n1,1,2\n")
    np.testing.assert_array_equal(read(path, layout=Layout(columns=("* [mm]",)))[0].u[0], [1, 2])


def test_velocities_and_inputs_keep_their_standard_names_beside_chosen_columns(tmp_path):
    path = written(tmp_path, "t,x1,v1,f,u1\n0,1,2,3,9\n1,1,2,3,9\n")
    (one,) = read(path, layout=Layout(columns=("x*",), scale="0.5"))
    assert (one.u[0, 0], one.v[0, 0], one.f[0, 0]) == (0.5, 1.0, 3.0)
    assert "not read: u1" in one.origin.notes


@pytest.mark.parametrize(
    ("head", "scale", "unit", "told"),
    [
        ("t_ms", "ms", "s", "times from t_ms in ms, s in the equation"),
        ("t_ms", "0.001", "", "times from t_ms in ms, times 0.001 in the equation"),
        ("when", "milliseconds", "s", "times from when in ms, s in the equation"),
    ],
)
def test_times_become_seconds_and_velocities_are_per_second_then(tmp_path, head, scale, unit, told):
    path = written(tmp_path, f"{head},x1,v1,f\n0,1,2,3\n500,2,2,3\n")
    (one,) = read(path, layout=Layout(head, ("x*",), "0.5", time_scale=scale))
    np.testing.assert_allclose(one.t, [0, 0.5])
    np.testing.assert_allclose(one.v[:, 0], [1000, 1000])
    assert (one.origin.time, one.u[1, 0], one.f[0, 0]) == (unit, 1.0, 3.0)
    assert one.origin.notes[0].startswith(told)


def test_the_times_of_arrays_and_of_standard_columns_are_scaled_too(tmp_path):
    np.savez(tmp_path / "a.npz", t=np.arange(3), u=np.ones((3, 1)))
    (one,) = read(tmp_path / "a.npz", layout=Layout(time_scale="min"))
    np.testing.assert_allclose(one.t, [0, 60, 120])
    assert one.origin.time == "s"
    (one,) = read(written(tmp_path, "t,u1\n0,1\n1,2\n"), layout=Layout(time_scale="h"))
    assert (one.t[1], one.origin.notes) == (3600, ("times from t in h, s in the equation",))


def test_dates_are_not_scaled_once_more(tmp_path):
    with pytest.raises(InputError, match="--time-scale ms: dates become seconds already"):
        read(written(tmp_path, "t;u1\n10:00;1\n10:01;2\n"), layout=Layout(time_scale="ms"))


def test_a_spreadsheet_is_read_as_the_table_that_it_holds(tmp_path):
    book = openpyxl.Workbook()
    book.active.append(["Torsion chain"])
    book.active.append(["time_s", "theta_1_deg", "theta_2_deg", "temperature"])
    for t, row in zip((0.0, 0.5, 1.0), U, strict=True):
        book.active.append([t, *(None if np.isnan(one) else one for one in row), 21.5])
    book.create_sheet("Remarks")
    book.save(tmp_path / "a.xlsx")
    one = assert_pendula(tmp_path / "a.xlsx")
    assert "sheet 'Sheet' is read, not 'Remarks'" in one.origin.notes
    with pytest.raises(InputError, match="--time time_s --columns"):
        read(tmp_path / "a.xlsx")


def test_a_formula_without_a_value_is_no_gap(tmp_path):
    book = openpyxl.Workbook()
    for row in (["t", "u1"], [0, 1.5], [1, None], [2, "=B2*2"]):
        book.active.append(row)
    book.save(tmp_path / "a.xlsx")
    with pytest.raises(InputError, match="row 4, column 2: a formula whose value is not in the file"):
        read(tmp_path / "a.xlsx")


def test_of_a_workbook_the_sheet_with_the_times_is_read(tmp_path):
    book = openpyxl.Workbook()
    book.active.title = "Notes"
    book.active.append(["Torsion chain", "lab 3"])
    book.active.append(["read by", "two of us"])
    sheet = book.create_sheet("Data")
    for row in (["t", "u1"], [0, 1.5], [1, 2.5]):
        sheet.append(row)
    book.create_sheet("More").append(["t"])
    book.save(tmp_path / "a.xlsx")
    (one,) = read(tmp_path / "a.xlsx")
    assert one.u[:, 0].tolist() == [1.5, 2.5]
    assert "sheet 'Data' is read, not 'Notes', 'More'" in one.origin.notes


def test_a_parquet_with_other_columns_and_a_frame_are_read(tmp_path):
    frame = pd.DataFrame(
        {"time_s": [0.0, 0.5, 1.0], "theta_1_deg": U[:, 0], "theta_2_deg": U[:, 1], "temperature": list("abc")}
    )
    frame.to_parquet(tmp_path / "a.parquet")
    assert_pendula(tmp_path / "a.parquet")
    (one,) = from_frame(frame, "frame", "free", PENDULA)
    np.testing.assert_allclose(one.u, np.deg2rad(U), rtol=1e-15)


def test_what_cannot_be_read_as_it_is_names_the_options_that_read_it(tmp_path):
    path = written(tmp_path, lines(";", ",", above="Run 3\n"))
    with pytest.raises(InputError) as caught:
        read(path)
    options = '--time time_s --columns "theta_*_deg" --scale deg'
    assert options in str(caught.value)
    assert_pendula(path)


def test_the_options_that_read_a_table_turn_its_times_into_seconds(tmp_path):
    with pytest.raises(InputError, match=r'--time t_ms --columns "x\*" --time-scale ms'):
        read(written(tmp_path, "t_ms,x1,x2\n0,1,2\n1,2,3\n"))


def test_times_that_do_not_increase_are_refused_with_the_option_that_sorts_them(tmp_path):
    path = written(tmp_path, "t,u1\n0,1\n2,3\n1,2\n2,5\n")
    with pytest.raises(InputError, match=r"row 3, column t: time 1 after 2; .*--sort"):
        read(path)
    (one,) = read(path, layout=Layout(sort=True))
    np.testing.assert_array_equal(one.t, [0, 1, 2])
    np.testing.assert_array_equal(one.u[:, 0], [1, 2, 4])
    assert [note for note in one.origin.notes if "averaged" in note]
    with pytest.raises(InputError, match="--sort averages"):
        read(written(tmp_path, "t,u1\n0,1\n0,2\n1,2\n"))


@pytest.mark.parametrize(
    ("between", "times", "said"),
    [
        ((1, 3), [1, 2, 3], "rows before 1 or after 3 are not read: 2 of 5"),
        ((1.5, np.inf), [2, 3, 4], "rows before 1.5 are not read: 2 of 5"),
        ((-np.inf, 3.5), [0, 1, 2, 3], "rows after 3.5 are not read: 1 of 5"),
        ((-1, 9), [0, 1, 2, 3, 4], None),
    ],
)
def test_times_beyond_the_stretch_that_is_asked_for_are_left_out_in_the_unit_of_the_file(
    tmp_path, between, times, said
):
    path = written(tmp_path, "t,u1,v1\n" + "".join(f"{t},{t**2},{2 * t}\n" for t in range(5)))
    (one,) = read(path, layout=Layout(between=between, time_scale="ms"))
    np.testing.assert_allclose(one.t, 1e-3 * np.array(times))
    np.testing.assert_allclose(one.u[:, 0], np.square(times))
    np.testing.assert_allclose(one.v[:, 0], 2e3 * np.array(times))
    assert [note for note in one.origin.notes if note.startswith("rows")] == ([said] if said else [])


def test_rows_are_counted_from_the_first_of_the_file(tmp_path):
    path = written(tmp_path, "t,u1\n0,1\n1,2\n2,3\n3,inf\n")
    with pytest.raises(InputError, match="row 4, column u1: infinite"):
        read(path, layout=Layout(between=(1, np.inf)))


def test_an_average_leaves_missing_values_out(tmp_path):
    path = written(tmp_path, "t,u1,u2\n0,1,\n0,,\n1,2,3\n")
    (one,) = read(path, layout=Layout(sort=True))
    np.testing.assert_array_equal(one.u, [[1, np.nan], [2, 3]])


@pytest.mark.parametrize(
    ("first", "second"),
    [("2026-01-05T12:00:00", "2026-01-05T12:00:01.5"), ("12:00:00", "12:00:01,5"), ("11:59:59.5", "12:00:01")],
)
def test_dates_and_times_of_day_become_seconds(tmp_path, first, second):
    (one,) = read(written(tmp_path, f"t;u1\n{first};1\n{second};2\n"))
    np.testing.assert_allclose(one.t, [0, 1.5])
    assert one.origin.time == "s"


@pytest.mark.parametrize(
    ("first", "second", "kind"),
    [
        ("2026-02-28", "2026-02-30", "date"), ("2026-02-28", "x", "date"), ("2026-02-28", "", "date"),
        ("2026-02-28", "0001-01-01", "date"), ("00:01", "2 days", "time of day"), ("00:01", "00:99", "time of day"),
        ("00:01:02", "00:99:99.5", "time of day"), ("00:01", "", "time of day"),
    ],
)  # fmt: skip
def test_what_is_no_time_among_dates_and_times_of_day_is_told_by_its_place(tmp_path, first, second, kind):
    with pytest.raises(InputError) as caught:
        read(written(tmp_path, f"t;u1\n{first};1\n{second};2\n{first};3\n"))
    assert f"row 2, column t: {second!r} is no {kind}" in str(caught.value)


def test_additional_columns_are_left_out_and_named(tmp_path):
    (one,) = read(written(tmp_path, "t,u1,speed\n0,1,x\n1,2,y\n"))
    assert one.origin.notes == ("not read: speed",)


@pytest.mark.parametrize(
    ("layout", "words"),
    [
        (Layout("tme_s"), ["--time", "did you mean 'time_s'"]),
        (Layout("time_s", ("phi_*",)), ["--columns", "'phi_*'"]),
        (Layout("time_s", ("theta_1_deg", "theta_*_deg")), ["'theta_1_deg' is named twice"]),
        (Layout("time_s", ("*_*",)), ["--columns", "'time_s' is the column of the times"]),
        (Layout("time_s", ("theta_1_deg", "temperature")), ["different units"]),
        (Layout("time_s", ("theta_*_deg",), "mm"), ["--scale mm", "in deg"]),
        (Layout("time_s", ("theta_*_deg",), "furlong"), ["--scale", "'furlong'"]),
        (Layout("time_s", ("theta_*_deg",), "0"), ["--scale", "'0'"]),
        (Layout("time_s", ("theta_*_deg",), time_scale="ms"), ["--time-scale ms", "column time_s", "in s"]),
        (Layout("time_s", ("theta_*_deg",), time_scale="fortnight"), ["--time-scale", "'fortnight'"]),
        (Layout("time_s", ("theta_*_deg",), time_scale="-1"), ["--time-scale", "'-1'", "above 0"]),
        (Layout("time_s", ("theta_*_deg",), between=(3, 2)), ["--between 3 2", "a later one"]),
        (Layout("time_s", ("theta_*_deg",), between=(50, np.inf)), ["--between 50 inf", "0 row(s)", "at least 2"]),
        (Layout("time_s"), ["u1..uN", '--columns "theta_*_deg"']),
    ],
    ids=str,
)
def test_a_wrong_layout_is_told(tmp_path, layout, words):
    with pytest.raises(InputError) as caught:
        read(written(tmp_path, lines(",")), layout=layout)
    for word in words:
        assert word in str(caught.value)


def test_points_among_decimal_commas_are_refused_by_their_place(tmp_path):
    path = written(tmp_path, "t;u1\n0;1,5\n1;2.5\n2;3,5\n")
    with pytest.raises(InputError, match="row 1, column u1: '1,5'"):
        read(path)


def test_files_in_different_units_are_not_read_together(tmp_path):
    first = written(tmp_path, "t,x (mm)\n0,1\n1,2\n", "a.csv")
    second = written(tmp_path, "t,x (cm)\n0,1\n1,2\n", "b.csv")
    with pytest.raises(InputError, match=r"b\.csv: readings in cm, those of .*a\.csv in mm"):
        read_all([first, second], layout=Layout(columns=("x*",)))


def test_columns_are_not_chosen_in_an_archive_of_arrays(tmp_path):
    np.savez(tmp_path / "a.npz", t=np.arange(3), u=np.ones((3, 1)))
    with pytest.raises(InputError, match="leave --time and --columns out"):
        read(tmp_path / "a.npz", layout=PENDULA)
    (one,) = read(tmp_path / "a.npz", layout=Layout(scale="deg"))
    np.testing.assert_allclose(one.u, np.pi / 180)


@given(start=st.floats(-1e3, 1e3), steps=st.lists(st.floats(-170, 170), min_size=4, max_size=40))
def test_an_angle_that_starts_anew_goes_on_once_its_turn_is_told(start, steps):
    angle = start + np.cumsum([0.0, *steps])
    told = unwrapped(np.column_stack([angle % 360.0, -angle % 360.0]), 360.0, "file")
    np.testing.assert_allclose(told - told[0], np.outer(angle - angle[0], [1, -1]), atol=1e-7)


@given(
    turns=st.lists(st.integers(-3, 3), min_size=4, max_size=4),
    rests=st.lists(st.floats(-80, 80), min_size=4, max_size=4),
)
def test_neighbours_are_less_than_half_a_turn_apart_whatever_turn_each_was_read_in(turns, rests):
    t = np.linspace(0, 3, 31)
    angles = np.array(rests) + 40 * np.sin(np.outer(t, [1, 2, 3, 4]))
    read_as = (angles + 360 * np.array(turns)) % 360.0
    read_as[:4, 1] = np.nan
    told = unwrapped(read_as, 360.0, "file")
    assert np.nanmax(np.abs(np.diff(told - angles - (told - angles)[:, :1], axis=1))) < 1e-7


@pytest.mark.parametrize(("head", "unit"), [("u1", ""), ("u1 [deg]", " deg")])
def test_angles_that_are_unwrapped_are_told_with_their_turn_in_the_unit_of_the_file(tmp_path, head, unit):
    path = written(tmp_path, f"t,{head}\n0,350\n1,10\n")
    (one,) = read(path, layout=Layout(columns=(head,), turn=360.0))
    assert f"angles are unwrapped (a full turn is 360{unit})" in one.origin.notes


def test_a_turn_goes_on_across_readings_that_are_missing(tmp_path):
    path = written(tmp_path, "t,u1,v1\n0,350,1\n1,,1\n2,10,1\n3,30,1\n")
    (one,) = read(path, layout=Layout(scale="deg", turn=360.0))
    np.testing.assert_allclose(np.rad2deg(one.u[:, 0]), [350, np.nan, 370, 390])
    np.testing.assert_allclose(np.rad2deg(one.v), 1.0)


@pytest.mark.parametrize(
    "rows",
    [
        "0,350,4\n1,359,1\n1,1,2\n2,10,1\n",
        "2,10,1\n1,359,1\n0,350,4\n1,1,2\n",
        "0,350,4\n1,359,1\n1,1,2\n1,,\n2,,\n2,10,1\n",
    ],
)
def test_an_angle_goes_on_before_readings_of_the_same_time_are_averaged(tmp_path, rows):
    path = written(tmp_path, f"t,u1,v1\n{rows}")
    (one,) = read(path, layout=Layout(sort=True, turn=360.0))
    np.testing.assert_array_equal(one.t, [0, 1, 2])
    np.testing.assert_allclose(one.u[:, 0], [350, 360, 370])
    np.testing.assert_allclose(one.v[:, 0], [4, 1.5, 1])


def test_a_time_that_is_missing_is_told_by_its_row_where_rows_are_sorted(tmp_path):
    path = written(tmp_path, "t,u1\n0,1\n0,2\n,3\n1,4\n")
    with pytest.raises(InputError, match="row 3, column t: the time is missing"):
        read(path, layout=Layout(sort=True))


@pytest.mark.parametrize("turn", [np.nan, np.inf, -360.0])
def test_a_turn_that_is_none_is_refused(turn):
    with pytest.raises(InputError, match=r"--turn .*in the unit of the file"):
        _ = Layout(turn=turn).period


def test_complex_readings_have_no_turn():
    with pytest.raises(InputError, match="file: --turn is for angles"):
        unwrapped(np.ones((3, 1)) * 1j, 360.0, "file")


def test_a_file_without_a_header_and_a_workbook_of_several_sheets_are_told_as_such(tmp_path):
    path = written(tmp_path, "0.000 28.954 -1.5e-3\n0.025 28.9 0.0\n0.050 28.7 0.1\n")
    with pytest.raises(InputError, match=r"the file has no header: write a first row such as t,u1,u2 with a name for"):
        read(path)
    book = openpyxl.Workbook()
    book.active.title = "about"
    book.active.append(["who", "when"])
    book.active.append(["me", "today"])
    book.create_sheet("readings").append(["time_s", "x"])
    book.save(tmp_path / "book.xlsx")
    with pytest.raises(InputError, match=r"there is no column t, .*; sheet 'about' is read, not 'readings'"):
        read(tmp_path / "book.xlsx")
