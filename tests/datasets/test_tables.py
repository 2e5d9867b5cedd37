"""Tables in text files: columns, names, lines."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises

from rille.datasets.text.tables import read_table
from rille.datasets.text.units import ANGLES, FORCES, LENGTHS, RATES, unitless


def table(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "t.csv"
    path.write_bytes(text.encode(encoding))
    return read_table(path, "table")


@pytest.mark.parametrize(
    "text",
    [
        "#time [s], a ,B\n1,2,3\n4,5,6\n",
        "time [s],a,B\r\n1,2,3\r\n\r\n4,5,6",
        "# a file\n# by a program\ntime [s];a;B\n1;2;3\n4;5;6\n",
        '"time [s]","a","B"\n"1","2","3"\n"4","5","6"\n',
        "time [s],a,B\n1,2,3,\n# a remark\n4,5,6,\n",
        "%time [s],a,B\r1,2,3\r% a remark\r// another\r4,5,6",
        "time [s],a,B\n1970-01-01 02:00:01+02:00,2,3\n1970-01-01T00:00:04.0Z,5,6\n",
    ],
)
def test_commas_semicolons_and_remarks(tmp_path, text):
    t = table(tmp_path, text)
    assert t.header == ("time [s]", "a", "b")
    np.testing.assert_array_equal(t.numbers([0, 2]), [[1, 3], [4, 6]])
    assert t.commas


def test_blanks_and_a_byte_order_mark(tmp_path):
    t = table(tmp_path, "# t x y\n1.5  -2e3 .5\n\n2.5 0 1\n", "utf-8-sig")
    assert t.header == ("t", "x", "y")
    assert t.lines == (2, 4)
    assert t.text(1) == ["-2e3", "0"]
    np.testing.assert_array_equal(t.numbers([0, 1, 2]), [[1.5, -2000, 0.5], [2.5, 0, 1]])


@pytest.mark.parametrize("text", ["time [s]\ta\tB\n1\t2\t3\n4\t5\t6\n", "time[s] a B\n1 \t2\t3\n4 5\t\t6\n"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_tabs(tmp_path, text, encoding):
    t = table(tmp_path, text, encoding)
    assert [name.replace(" ", "") for name in t.header] == ["time[s]", "a", "b"]
    np.testing.assert_array_equal(t.numbers([0, 2]), [[1, 3], [4, 6]])
    assert not t.commas


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_rows_in_which_nothing_was_measured_are_counted(tmp_path, separator):
    rows = ["time,x,y,z", "1,,,", "2,5,6,7", "3,nan,NaN,nan", "4,-,n/a,", "5,6,7,8"]
    t = table(tmp_path, "\n".join(rows).replace(",", separator) + "\n")
    kept, lines = t.measured([1, 2, 3])
    assert (kept.text(0), kept.lines) == (["2", "5"], (3, 6))
    assert len(lines) == 1
    assert all(word in lines[0] for word in ("RIL-706", "3 rows of 5", "line 2"))
    assert t.measured([0], lost=True) == (t, ())


def test_rows_that_were_written_twice_count_once(tmp_path):
    """As messages of ROS; another position at the same time stays, and is refused with its line."""
    kept, lines = table(tmp_path, "time,x,y\n1,2,3\n1,2,3\n2,2,3\n2,2,4\n").measured([0, 1, 2])
    assert (kept.lines, len(lines)) == ((2, 4, 5), 1)
    assert "RIL-706" in lines[0]


def test_names_that_do_not_fit_the_columns_are_none(tmp_path):
    for remark in ("recorded in the yard", "groundtruth"):
        read = table(tmp_path, f"# {remark}\n1 2 3\n")
        assert (read.header, read.columns) == ((), 3)


def test_a_name_may_stand_first_in_a_row(tmp_path):
    """As AirSim's recording has it."""
    of_airsim = table(
        tmp_path, "VehicleName\tTimeStamp\tPOS_X\tImageFile\tQ\nDrone 1\t5\t1\ta.png\t2\nDrone 1\t6\t2\tb.png\t2\n"
    )
    assert of_airsim.header[1:3] == ("timestamp", "pos_x")
    assert of_airsim.values([1, 2]).tolist() == [[5, 1], [6, 2]]


@pytest.mark.parametrize(
    ("crs", "place"),
    [
        ("EPSG:4326", ("longitude", "latitude", "altitude")),
        ("+proj=longlat +datum=WGS84 +no_defs", ("longitude", "latitude", "altitude")),
        ("EPSG:32633", ("x", "y", "z")),
        ("WGS84 UTM 33N", ("x", "y", "z")),
    ],
)
@pytest.mark.parametrize("more", ["", " 0 0 0 0.02 0.05"])
def test_columns_below_a_crs_are_an_image_and_its_place(tmp_path, crs, place, more):
    """``geo.txt`` of OpenDroneMap."""
    read = table(tmp_path, f"{crs}\n" + "".join(f"DJI_{k}.JPG 15.0{k} 47.8 500{more}\n" for k in range(3)))
    assert read.header[:4] == ("image", *place)
    assert read.text(0) == ["DJI_0.JPG", "DJI_1.JPG", "DJI_2.JPG"]
    np.testing.assert_array_equal(read.values([1]).T, [[15.00, 15.01, 15.02]])


def test_the_first_row_of_a_table_without_names_may_begin_with_one(tmp_path):
    read = table(tmp_path, "a.png 1.0 2.0 3.0\nb.png 4.0 5.0 6.0\n")
    assert (read.header, read.text(0)) == ((), ["a.png", "b.png"])


def test_names_in_brackets_are_no_json(tmp_path):
    assert table(tmp_path, "[s] [m]\n1 2\n").header == ("[s]", "[m]")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1,2,3\n4,5\n", ("RIL-285", "t.csv", "line 2")),
        ("1,2,3\n4,five,6\n", ("RIL-284", "t.csv", "line 2", "'five'")),
        ("1,2,3\n4,nan,6\n", ("RIL-284", "t.csv", "line 2", "'nan'")),
        ("1,2,3\n4,-1e300,6\n", ("RIL-284", "t.csv", "line 2", "'-1e300'")),
        ("time,x\n", ("RIL-286", "t.csv")),
        ('{"frames": [\n 1.0,\n 2.0\n]}\n', ("RIL-979", "JSON")),
        ("[\n  [1, 2, 3],\n  [4, 5, 6]\n]\n", ("RIL-979", "JSON")),
        ('\n<?xml version="1.0"?>\n<gpx>\n</gpx>\n', ("RIL-979", "XML")),
        ("$GPGGA,122640,4900.03,N,824.1,E\n$GPRMC,122640,A\n", ("RIL-979", "NMEA")),
        ("1600000000.5 $GNGGA,122640,4900.03,N,824.1,E\n", ("RIL-979", "NMEA")),
        ("time,x\n2020-09-13,1\n", ("RIL-286", "t.csv", "'2020-09-13,1'")),
    ],
)
def test_what_is_wrong_names_the_line(tmp_path, text, expected):
    with raises(*expected) as caught:
        table(tmp_path, text).numbers([0, 1])
    assert caught.value.remedy


def test_a_last_row_that_was_cut_off_is_left_out(tmp_path):
    """As by a recorder that was switched off."""
    assert table(tmp_path, "time,x,y\n1,2,3\n4,5").rows == (("1", "2", "3"),)


def test_a_missing_or_binary_file(tmp_path):
    with raises("RIL-138"):
        read_table(tmp_path / "none.csv", "table")
    (tmp_path / "b.csv").write_bytes(b"\xff\x00\x80")
    with raises("RIL-140"):
        read_table(tmp_path / "b.csv", "table")


@pytest.mark.parametrize("units", ["s,m,[m s^-2],", "# s, m, (m s-2),"])
def test_a_row_of_units_below_the_names_is_theirs(tmp_path, units):
    names = table(tmp_path, f"time,x,ax,n\n{units}\n1,2,3,4\n").header
    assert (*names[:2], names[2][:6], names[3]) == ("time [s]", "x [m]", "ax [m ", "n")


def test_words_below_the_names_that_are_no_units_are_the_names(tmp_path):
    assert table(tmp_path, "a,b\nm,x\n1,2\n").header == ("m", "x")


@pytest.mark.parametrize(
    ("name", "unit", "bare"),
    [
        ("x [mm]", "mm", "x"),
        ("north_cm", "cm", "north"),
        ("up (feet)", "ft", "up"),
        ("yaw_degrees", "", "yaw_degrees"),
        ("yaw (degrees)", "deg", "yaw"),
        ("w_RS_S_x [rad s^-1]", "rad s", "w_rs_s_x"),
        ("w_RS_S_x", "", "w_rs_s_x"),
        ("gyro_deg_x", "deg", "gyro_x"),
        ("gyro_x [\N{DEGREE SIGN}/s]", "deg s", "gyro_x"),
        ("acc_x (m/s2)", "m s", "acc_x"),
        ("x (east)", "", "x"),
    ],
)
def test_the_unit_in_the_name_of_a_column(tmp_path, name, unit, bare):
    found = table(tmp_path, f"time,{name}\n1,2\n")
    assert (found.unit(1), unitless(found.header[1])) == (unit, bare)


def test_units_are_brought_to_si_unless_the_caller_states_one(tmp_path):
    found = table(tmp_path, "time,x_mm,y [km],z\n1,2,3,4\n")
    assert found.measures([1, 2, 3], LENGTHS).tolist() == [[2e-3, 3e3, 4.0]]
    assert found.measures([1, 2, 3], LENGTHS, 0.5).tolist() == [[1.0, 1.5, 2.0]]
    with raises("RIL-995", "'x_mm'"):
        found.measures([1], ANGLES)


@pytest.mark.parametrize(
    ("name", "factors", "si"),
    [
        ("x_in", LENGTHS, 0.0254),
        ("x_inch", LENGTHS, 0.0254),
        ("East [inches]", LENGTHS, 0.0254),
        ("E (US survey feet)", LENGTHS, 1200 / 3937),
        ("E [US ft]", LENGTHS, 1200 / 3937),
        ("E (ftUS)", LENGTHS, 1200 / 3937),
        ("x [dm]", LENGTHS, 0.1),
        ("y_yd", LENGTHS, 0.9144),
        ("x [um]", LENGTHS, 1e-6),
        ("yaw [gon]", ANGLES, np.pi / 200),
        ("yaw (grad)", ANGLES, np.pi / 200),
        ("roll_mrad", ANGLES, 1e-3),
        ("gyro_x [mdps]", RATES, np.pi / 180e3),
        ("acc_x [mg]", FORCES, 9.80665e-3),
    ],
)
def test_units_of_surveyors_and_of_makers_of_sensors(tmp_path, name, factors, si):
    assert table(tmp_path, f"time,{name}\n1,2\n").measures([1], factors) == pytest.approx(2 * si, rel=1e-12)


def test_a_line_of_unit_words_below_a_title_is_a_line_of_names(tmp_path):
    assert table(tmp_path, "# a log of 2026\ns,m,m\n1,2,3\n").header == ("s", "m", "m")
