"""Poses of files, and between their rows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raising import raises
from scipy.spatial.transform import Rotation

from rille.datasets.inspection.tables import table_kind
from rille.datasets.poses import TimedPoses, coverage, interpolate, poses_of, positions_of, read_motion, refuse_apart
from rille.stages.geometry.geometry import RigidTransform, rotation_exp

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""90 degrees about z: quaternion w = z = sqrt(1/2)."""

H = "0.7071068"


def read(tmp_path, text, **kwargs):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    return poses_of(read_motion(path, kwargs.get("format", "auto")), **kwargs)


@pytest.mark.parametrize(
    ("text", "format"),
    [
        (f"1 1 2 3 0 0 {H} {H}\n2 1 2 3 0 0 0 1\n", "auto"),
        (f"# timestamp tx ty tz qx qy qz qw\n1 1 2 3 0 0 {H} {H}\n2 1 2 3 0 0 0 1\n", "auto"),
        (f"1,1,2,3,{H},0,0,{H},9,9,9\n2,1,2,3,1,0,0,0,9,9,9\n", "auto"),
        (f"#time(s),px,py,pz,qw,qx,qy,qz,vx,vy,vz,bwx\n1,1,2,3,{H},0,0,{H},9,9,9,9\n2,1,2,3,1,0,0,0,9,9,9,9", "auto"),
        (
            "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
            f"1,1,2,3,{H},0,0,{H}\n2,1,2,3,1,0,0,0\n",
            "auto",
        ),
        (f"frame,time,tx,ty,tz,rx,ry,rz,rw\n0,1,1,2,3,0,0,{H},{H}\n1,2,1,2,3,0,0,0,1\n", "auto"),
        (f"qx,qy,qz,qw,z,y,x,time\n0,0,{H},{H},3,2,1,1\n0,0,0,1,3,2,1,2\n", "csv"),
        (f"1 1 2 3 {H} 0 0 {H}\n2 1 2 3 1 0 0 0\n", "euroc"),
        (f"1,1,2,3,0,0,{H},{H}\n2,1,2,3,0,0,0,1\n", "tum"),
    ],
    ids=["tum", "tum named", "euroc", "euroc named", "vicon", "r", "csv in any order", "as euroc", "as tum"],
)
def test_forms_of_one_pose(tmp_path, text, format):
    found = read(tmp_path, text, format=format)
    assert found.times == (1.0, 2.0)
    np.testing.assert_allclose(found.poses[0].rotation, TURN, atol=1e-7)
    np.testing.assert_allclose(found.poses[1].rotation, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(found.poses[0].translation, [1, 2, 3])


@pytest.mark.parametrize("header", ["", "time,r11,r12,r13,tx,r21,r22,r23,ty,r31,r32,r33,tz\n"])
@pytest.mark.parametrize(("last", "separator"), [("", " "), (" 0 0 0 1", " "), ("", ",")])
def test_matrices_behind_times(tmp_path, header, last, separator):
    rows = ["1 0 -1 0 1 1 0 0 2 0 0 1 3", "2" + " nan" * 12, "3" + " 0" * 12, "4 1 0 0 1 0 1 0 2 0 0 1 3"]
    text = "\n".join(separator.join((row + last).split()) for row in rows)
    header = "" if last else header.replace(",", separator)
    (tmp_path / "p.txt").write_text(header + text)
    assert positions_of(read_motion(tmp_path / "p.txt"), "auto", {}) is None
    for format in ("auto", "kitti"):
        found = read(tmp_path, header + text, format=format)
        assert found.times == (1.0, 4.0)
        np.testing.assert_allclose(found.poses[0].rotation, TURN, atol=1e-7)
        np.testing.assert_array_equal(found.poses[-1].translation, [1, 2, 3])


def test_the_order_of_quaternions_without_names_between_commas_is_not_guessed(tmp_path):
    with raises("RIL-745", 'format = "tum"'):
        read(tmp_path, f"1.0,1,2,3,0,0,{H},{H}\n2.0,1,2,3,0,0,0,1\n")
    assert read(tmp_path, f"1403715273262142976,1,2,3,{H},0,0,{H}\n").poses[0].rotation[1, 0] == pytest.approx(1.0)


def test_poses_without_times_are_one_a_frame(tmp_path):
    """As TartanAir has them."""
    for row, kwargs in ((f"1 2 3 0 0 {H} {H}\n", {}), (f"1,2,3,{H},0,0,{H}\n", {"format": "euroc"})):
        found = read(tmp_path, row * 2, **kwargs)
        assert (found.times, len(found.poses)) == (None, 2)
        np.testing.assert_allclose(found.poses[0].matrix34, np.c_[TURN, [1, 2, 3]], atol=1e-6)
        assert positions_of(read_motion(tmp_path / "poses.txt"), "auto", {}) is None
    with raises("RIL-745"):
        read(tmp_path, f"1,2,3,{H},0,0,{H}\n")
    with raises("RIL-264", "7 numbers"):
        read(tmp_path, "1 2 3 0 0 7 7\n")


def test_poses_of_a_message_as_tools_of_ros_write_it(tmp_path):
    names = [
        f"field.pose.pose.{part}.{axis}" for part, of in (("position", "xyz"), ("orientation", "xyzw")) for axis in of
    ]
    text = f"%time,field.header.frame_id,{','.join(names)},field.twist.twist.linear.x\n1,odom,1,2,3,0,0,{H},{H},9\n"
    found = read(tmp_path, text)
    np.testing.assert_allclose(found.poses[0].rotation, TURN, atol=1e-7)
    np.testing.assert_array_equal(found.poses[0].translation, [1, 2, 3])


def test_moments_in_which_a_tracker_has_lost_its_target_are_left_out(tmp_path):
    found = read(tmp_path, "1 0 0 0 0 0 0 1\n2 nan nan nan nan nan nan nan\n3 0 0 0 0 0 0 0\n4 1 0 0 0 0 0 1\n")
    assert found.times == (1.0, 4.0)
    assert "2 rows of 4" in found.warnings[0]


def test_the_pose_at_the_origin_is_none_where_the_row_before_is_far_from_it(tmp_path):
    def lines(first, there):
        rows = [
            *first,
            "1.5 nan nan nan nan nan nan nan",
            *(f"{k} {there + 0.1 * k:g} 0 0 0 0 0.6 0.8" for k in range(2, 8)),
            "8 0 0 0 0 0 0 1",
        ]
        return "\n".join(rows) + "\n"

    at_rest = ["0 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 1"]
    assert read(tmp_path, lines(at_rest, 5.0)).times == (0, 1, 2, 3, 4, 5, 6, 7)
    # Who is near comes back.
    assert read(tmp_path, lines(at_rest, -1.0)).times[-1] == 8
    matrices = ["1 0 0 0 0 1 0 0 0 0 1 0", "0 " * 12, "1 0 0 3 0 1 0 0 0 0 1 0"]
    assert [pose is None for pose in read(tmp_path, "\n".join(matrices)).poses] == [False, True, False]


def test_names_in_a_bracket_that_commas_part_tell_the_order_of_a_quaternion(tmp_path):
    names = "# stamp, translation (t_x, t_y, t_z), rotation quaternion (q_x, q_y, q_z, q_w), scale\n"
    found = read(tmp_path, names + f"5,1,2,3,0,0,{H},{H},1\n")
    assert found.times == (5.0,)
    np.testing.assert_allclose(found.poses[0].matrix34, np.column_stack([TURN, [1, 2, 3]]), atol=1e-12)


def test_coordinates_that_were_rounded_to_single_precision_are_named_with_their_step(tmp_path):
    way = np.array([431000.0, 5411000.0, 300.0]) + np.arange(8)[:, None] * [0.71, 0.83, 0.01]

    def table(places):
        (tmp_path / "p.csv").write_text(
            "\n".join(["time,x,y,z", *(f"{k},{x},{y},{z}" for k, (x, y, z) in enumerate(places))])
        )
        return read_motion(tmp_path / "p.csv")

    [line] = positions_of(table(way.astype(np.float32)), "auto", {}).warnings
    assert "steps of 0.5 m" in line
    assert positions_of(table(way.round(2)), "auto", {}).warnings == ()
    assert positions_of(table(way.round()), "auto", {}).warnings == ()
    near = (way - way[0]).astype(np.float32)
    assert positions_of(table(near), "auto", {}).warnings == ()


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        *(("time_ms", 1e-3), ("timestamp [ns]", 1e-9), ("t_s", 1.0), ("time", 1.0)),
        *(("time (milliseconds)", 1e-3), ("time_usec", 1e-6), ("t [sec]", 1.0), ("time [nanosecond]", 1e-9)),
    ],
)
def test_the_name_of_a_column_states_the_unit_of_its_times(tmp_path, name, factor):
    found = read(tmp_path, f"{name},qw,qx,qy,qz\n0,1,0,0,0\n100,1,0,0,0\n")
    assert found.times == (0.0, pytest.approx(100 * factor))


def test_matrices_have_no_times_and_become_rotations(tmp_path):
    rows = "0 -1 0 1 1 0 0 2 0 0 1 3\n0.99995 0.01 0 4 -0.01 0.99995 0 5 0 0 1 6\n"
    found = read(tmp_path, rows)
    assert found.times is None
    np.testing.assert_array_equal(found.poses[0].matrix34, np.column_stack([TURN, [1, 2, 3]]))
    R = found.poses[1].rotation
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    square = "0 -1 0 1 1 0 0 2 0 0 1 3 0 0 0 1\n"
    np.testing.assert_array_equal(read(tmp_path, square).poses[0].matrix34, found.poses[0].matrix34)


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_angles_are_those_of_vehicles(tmp_path, unit):
    roll, pitch, yaw = 10.0, 20.0, 30.0
    scale = 1.0 if unit == "deg" else np.pi / 180
    text = f"time,yaw [{unit}],pitch_{unit},roll_{unit}\n5,{yaw * scale},{pitch * scale},{roll * scale}\n"
    found = read(tmp_path, text)
    Rx, Ry, Rz = (rotation_exp(np.deg2rad(a) * np.eye(3)[k]) for k, a in enumerate((roll, pitch, yaw)))
    np.testing.assert_allclose(found.poses[0].rotation, Rz @ Ry @ Rx, atol=1e-12)
    np.testing.assert_array_equal(found.poses[0].translation, 0)
    assert found.times == (5.0,)


def test_angles_beyond_a_turn_can_only_be_degrees(tmp_path):
    found = read(tmp_path, "time,roll,pitch,yaw\n0,0,0,0\n1,0,0,90\n")
    np.testing.assert_allclose(found.poses[1].rotation, TURN, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "format", "expected"),
    [
        ("time,roll,pitch,yaw\n0,0.1,0,0\n", "auto", ("RIL-265", "angles roll and pitch and yaw have no unit")),
        ("time,roll_deg,pitch_rad,yaw_deg\n0,0.1,0,0\n", "auto", ("RIL-265", "two units")),
        ("time,x,y,theta\n0,1,2,0.1\n", "auto", ("RIL-265", "angles theta have no unit", "yaw_rad")),
        (f"1 1 2 3 0 0 {H} {H}\n2 1 2 3 0 0 0 2\n", "tum", ("RIL-266", "line 2")),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 2 0 0 0 0 2 0\n", "kitti", ("RIL-333", "line 2")),
        ("1 2 3 4\n", "auto", ("RIL-264", "4 numbers")),
        ("time,v,omega\n0,1,2\n", "auto", ("RIL-264", "time, v, omega")),
        ("t,m00,m01,m02,m03,m10,m11,m12,m13\n0,1,0,0,0,0,1,0,0\n", "auto", ("RIL-264", "m00", "state the format")),
        ("1 2 3 4\n", "kitti", ("RIL-267",)),
        ("1 2 3 4\n", "csv", ("RIL-264",)),
        ("1 2 3 4\n", "bag", ("RIL-264", "bag")),
        (f"2 1 2 3 0 0 {H} {H}\n1 1 2 3 0 0 0 1\n", "auto", ("RIL-293", "line 2")),
    ],
)
def test_what_is_wrong_is_one_line_with_a_remedy(tmp_path, text, format, expected):
    with raises(*expected) as caught:
        read(tmp_path, text, format=format)
    assert "\n" not in str(caught.value)
    assert caught.value.remedy


# -- between rows ------------------------------------------------------------------------------------------------------

QUARTER = TimedPoses(
    (10.0, 12.0), (RigidTransform.identity(), RigidTransform(TURN, np.array([4.0, 0.0, 2.0]))), "quarter"
)


def test_half_way_is_half_the_turn_and_half_the_way():
    (found,) = interpolate(QUARTER, [11.0], 2.0)
    s = np.sqrt(0.5)
    np.testing.assert_allclose(found.rotation, [[s, -s, 0], [s, s, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(found.translation, [2.0, 0.0, 1.0], atol=1e-12)


@given(
    rate=st.tuples(*[st.floats(-1.5, 1.5)] * 3),
    velocity=st.tuples(*[st.floats(-3, 3)] * 3),
    moments=st.lists(st.floats(0, 4), min_size=1, max_size=8),
)
@settings(max_examples=40, deadline=None)
def test_a_steady_movement_is_met_exactly(rate, velocity, moments):
    def pose(t):
        return RigidTransform(rotation_exp(np.array(rate) * t), np.array(velocity) * t)

    rows = (0.0, 0.7, 1.0, 2.2, 3.0, 4.0)
    timed = TimedPoses(rows, tuple(pose(t) for t in rows))
    for t, found in zip(moments, interpolate(timed, moments, 1.3), strict=True):
        np.testing.assert_allclose(found.matrix34, pose(t).matrix34, atol=1e-9)


def test_the_sign_of_a_quaternion_does_not_turn_the_long_way(tmp_path):
    q = Rotation.from_rotvec([0, 0, np.deg2rad([10])[0]]).as_quat()
    text = "0 0 0 0 0 0 0 1\n1 0 0 0 {} {} {} {}\n".format(*(-q))
    (found,) = interpolate(read(tmp_path, text), [0.5], 1.0)
    assert np.degrees(np.arctan2(found.rotation[1, 0], found.rotation[0, 0])) == pytest.approx(5.0)


def test_gaps_and_ends_have_no_pose():
    still = RigidTransform.identity()
    timed = TimedPoses((0.0, 1.0, 4.0, 5.0), (still,) * 4)
    at = (-0.1, 0.0, 0.5, 1.0, 1.1, 3.9, 4.0, 4.5, 5.0, 5.1)
    found = interpolate(timed, at, 1.0)
    assert [f is not None for f in found] == [False, True, True, True, False, False, True, True, True, False]
    assert coverage(found, at, "truth") == (
        "RIL-688: no truth for 4 of 10 frames, in 3 stretches: first at 0.00 s, last at 5.20 s of the sequence",
    )
    assert coverage(found[1:4], at[1:4], "truth") == ()


@pytest.mark.parametrize(
    ("later", "hint"),
    [
        (7200.5, "of another time zone? Then time_offset = 7200;"),
        (-19790.0, "of another time zone? Then time_offset = -19800;"),
        (315964782.4, "since 1980 (GPS time)? Then time_offset = 315964782;"),
        (250.0, "check that both"),
        (6000.0, "check that both"),
    ],
)
def test_of_clocks_that_differ_as_known_ones_do_the_offset_is_named(later, hint):
    with raises("RIL-269", hint):
        refuse_apart([1e9, 1e9 + 5], [1e9 + later, 1e9 + later + 5], "gnss.csv")


def test_no_common_time_names_both_ranges():
    with raises("RIL-269", "10.000", "12.000", "0.000", "9.000") as caught:
        interpolate(QUARTER, [0.0, 9.0], 1.0)
    assert caught.value.remedy


def test_one_row_and_no_times():
    alone = TimedPoses((1.0,), QUARTER.poses[1:])
    assert [f is not None for f in interpolate(alone, [0.5, 1.0], 1.0)] == [False, True]
    with raises("RIL-268"):
        interpolate(TimedPoses(None, QUARTER.poses), [0.0], 1.0)


@pytest.mark.parametrize("header", ["time,x,y", "t,x,y,z", "timestamp,px,py,pz"])
def test_positions_alone_are_said_to_lack_a_rotation(tmp_path, header):
    rows = "\n".join(",".join(str(k + j) for j in range(header.count(",") + 1)) for k in range(3))
    with raises("RIL-801", "qw", *header.split(",")[1:3]):
        read(tmp_path, f"{header}\n{rows}\n")


@pytest.mark.parametrize("name", ["heading", "heading_deg", "course [deg]", "imu/hdg"])
def test_a_heading_is_told_to_be_perhaps_a_yaw_that_counts_otherwise(tmp_path, name):
    with raises("RIL-801", "yaw_deg", f"90 less {name}", "counter-clockwise"):
        read(tmp_path, f"time,x,y,{name}\n0,0,0,90\n1,1,0,91\n")


@pytest.mark.parametrize("header", ["time,pitch_rate,heading", "time,speed,heading"])
def test_a_heading_without_positions_is_told_too(tmp_path, header):
    with raises("RIL-264", "yaw_deg", "90 less heading"):
        read(tmp_path, f"{header}\n" + "".join(",".join([str(k)] * (header.count(",") + 1)) + "\n" for k in range(3)))


@pytest.mark.parametrize(
    ("names", "per_second"),
    [
        ("gps_week,tow", 1),
        ("GPS Week,GPS Seconds", 1),
        ("WN,iTOW", 1000),
        ("week_number,time_of_week_ms", 1000),
        ("GPSWeek,SecondsOfWeek", 1),
        ("week,sow", 1),
        ("Week,GPSTime", 1),
    ],
)
def test_gps_weeks_and_times_within_them_are_seconds_since_1970(tmp_path, names, per_second):
    rows = "".join(f"2123,{(44818 + k / 10) * per_second:.1f},{k},0\n" for k in range(3))
    path = tmp_path / "gnss.csv"
    path.write_text(f"{names},x,y\n{rows}")
    found = positions_of(read_motion(path), "csv", {})
    assert found.times == pytest.approx([1.6e9, 1.6e9 + 0.1, 1.6e9 + 0.2], abs=1e-6)


def test_times_since_1970_beside_gps_weeks_stay_as_they_are(tmp_path):
    path = tmp_path / "gnss.csv"
    path.write_text("week,time,x,y\n2123,1600000000,0,0\n2123,1600000001,1,0\n")
    assert positions_of(read_motion(path), "csv", {}).times == (1.6e9, 1.6e9 + 1)


def test_a_tracker_of_positions_alone_writes_zeros_in_the_place_of_a_quaternion(tmp_path):
    path = tmp_path / "prism.csv"
    path.write_text("time,x,y,z,qx,qy,qz,qw\n1,2,3,4,0,0,0,0\n2,3,4,5,0,0,0,0\n")
    assert positions_of(read_motion(path), "auto", {}).positions == ((2, 3, 4), (3, 4, 5))


def test_a_first_column_of_dates_is_the_time(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("date;x;y\n2020-09-13T12:26:40.5Z;1;2\n2020-09-13T12:26:41Z;2;2\n")
    assert positions_of(read_motion(path), "auto", {}).times == (1600000000.5, 1600000001.0)
    path.write_text("date,x,y\n09/13/2020 12:26:40,1,2\n09/13/2020 12:26:41,2,2\n")
    with raises("RIL-291", "09/13/2020"):
        positions_of(read_motion(path), "auto", {})


def test_units_below_the_names_do_not_exchange_the_parts_of_a_quaternion(tmp_path):
    rows = "1,0,0,0,0.1,0.2,0.3,0.927\n2,0,0,0,0.1,0.2,0.3,0.927\n"
    plain, with_units = (read(tmp_path, f"time,x,y,z,qx,qy,qz,qw\n{units}{rows}") for units in ("", "s,m,m,m,,,,\n"))
    np.testing.assert_array_equal(plain.poses[0].rotation, with_units.poses[0].rotation)


@pytest.mark.parametrize("names", ["secs,nsecs", "field.header.stamp.sec,field.header.stamp.nanosec"])
def test_seconds_and_nanoseconds_in_two_columns_are_one_time(tmp_path, names):
    (tmp_path / "p.csv").write_text(f"{names},x,y\n1400000000,100000000,1,2\n1400000001,9000,1,3\n")
    found = positions_of(read_motion(tmp_path / "p.csv"), "auto", {"time": names.partition(",")[0]})
    assert found is not None
    assert found.times == pytest.approx((1400000000.1, 1400000001.000009), abs=1e-6)
    assert positions_of(read_motion(tmp_path / "p.csv"), "auto", {}) == found
    (tmp_path / "p.csv").write_text(f"{names},x,y\n1400000000,1e8,1,2\n")
    with raises("RIL-291", "line 2", "1e8"):
        positions_of(read_motion(tmp_path / "p.csv"), "auto", {})


@pytest.mark.parametrize("header", ["time,x,y,yaw_deg", "time,x,y,theta [deg]", "time,x,y,qx,qy,qz,qw"])
def test_a_robot_on_a_plane_has_neither_height_nor_tilt(tmp_path, header):
    turn = "0,0,0.7071068,0.7071068" if "qw" in header else "90"
    found = read(tmp_path, f"{header}\n1,2,3,{turn}\n2,3,3,{turn}\n")
    np.testing.assert_allclose(found.poses[0].rotation, TURN, atol=1e-6)
    np.testing.assert_array_equal([pose.translation for pose in found.poses], [[2, 3, 0], [3, 3, 0]])


def test_a_part_of_a_quaternion_beside_angles_is_none(tmp_path):
    found = read(tmp_path, "time,qw,roll_deg,pitch_deg,yaw_deg\n1,7,0,0,90\n2,7,0,0,90\n")
    np.testing.assert_allclose(found.poses[0].rotation, TURN, atol=1e-9)


def test_positions_without_a_measured_coordinate_are_refused_and_without_heights_have_none(tmp_path):
    for text, row in (("time,x,y\n1,,2\n2,,3\n", "line 2"), ("time,x,y,z\n1,2,3,\n2,4,5,\n", "")):
        (tmp_path / "p.csv").write_text(text)
        if row:
            with raises("RIL-284", row):
                positions_of(read_motion(tmp_path / "p.csv"), "auto", {})
        else:
            assert positions_of(read_motion(tmp_path / "p.csv"), "auto", {}).positions == ((2.0, 3.0), (4.0, 5.0))


@pytest.mark.parametrize("name", ["{} [mm]", "{}_mm", "{} (mm)"])
def test_positions_are_in_the_unit_that_their_columns_state(tmp_path, name):
    x, y = (name.format(axis) for axis in "xy")
    (tmp_path / "p.csv").write_text(f"time,{x},{y}\n1,2000,3000\n2,4000,5000\n")
    assert positions_of(read_motion(tmp_path / "p.csv"), "auto", {}).positions == ((2.0, 3.0), (4.0, 5.0))
    # What a manifest states goes before what a name says.
    assert positions_of(read_motion(tmp_path / "p.csv"), "auto", {}, 1.0).positions[0] == (2000.0, 3000.0)
    found = read(tmp_path, f"time,{x},{y},yaw_deg\n1,2000,3000,90\n")
    np.testing.assert_allclose(found.poses[0].translation, [2, 3, 0])
    np.testing.assert_allclose(found.poses[0].rotation, TURN, atol=1e-9)


@pytest.mark.parametrize(
    "names",
    [
        "%time,field.latitude,field.longitude,field.altitude",
        "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude",
        "image,wgs84_lat,wgs84_lon,wgs84_alt",
        "Bild;Hochwert;Rechtswert;H\N{LATIN SMALL LETTER O WITH DIAERESIS}he",
        "point,N,E,H",
    ],
)
def test_heights_are_read_by_their_names(tmp_path, names):
    """Of ROS, EXIF (by exiftool), and surveyors."""
    rows = "0,48.1,9.0,500\n1,48.2,9.0,501\n".replace(",", ";" if ";" in names else ",")
    (tmp_path / "p.csv").write_text(f"{names}\n{rows}", encoding="utf-8")
    assert [place[2] for place in positions_of(read_motion(tmp_path / "p.csv"), "auto", {}).positions] == [500, 501]


def test_positions_that_count_downwards_are_turned_upwards(tmp_path):
    """North, east, down, as an IMU's maker has them, and the depth of a vehicle under water."""
    for header in ("time,north,east,down", "time,northing,easting,depth [m]", "time,n,e,d"):
        (tmp_path / "p.csv").write_text(f"{header}\n0,5,2,3\n1,6,2,3.5\n")
        found = positions_of(read_motion(tmp_path / "p.csv"), "auto", {})
        assert found.positions == ((2.0, 5.0, -3.0), (2.0, 6.0, -3.5))


def test_a_column_called_d_counts_downwards_beside_north_and_east_alone(tmp_path):
    (tmp_path / "p.csv").write_text("time,d,y\n0,5,2\n1,6,2\n")
    assert positions_of(read_motion(tmp_path / "p.csv"), "auto", {"x": "d"}).positions == ((5.0, 2.0), (6.0, 2.0))


def test_positions_of_rtklib(tmp_path):
    text = "% program : RTKPOST\n%  GPST   {}(m) {}(m) {}(m)  Q  ns\n2020/09/13 12:26:40.0 1 2 3 1 9\n"
    path = tmp_path / "gnss.pos"
    path.write_text(text.format("e-baseline", "n-baseline", "u-baseline"))
    assert positions_of(read_motion(path), "auto", {}).positions == ((1.0, 2.0, 3.0),)
    path.write_text(text.format("x-ecef", "y-ecef", "z-ecef"))
    with raises("RIL-805", "UTM"):
        positions_of(read_motion(path), "auto", {})
    path.write_text("%  GPST   latitude(deg) longitude(deg) height(m) Q\n2123 388800.5 48.1 9.0 500 1\n")
    found = positions_of(read_motion(path), "auto", {})
    assert (found.times, found.positions[0][2]) == ((1600343982.5,), 500)


@pytest.mark.parametrize("names", ["x,y,z", "ecef_x,ecef_y,ecef_z", "x-ecef(m),y-ecef(m),z-ecef(m)"])
def test_positions_from_the_centre_of_the_earth_become_metres_of_a_plane(tmp_path, names):
    """At 48 degrees north and 9 degrees east: an ellipsoid's point by its definition, and ten metres up."""
    east, north = np.deg2rad(9.0), np.deg2rad(48.0)
    radius = 6378137.0 / np.sqrt(1.0 - 6.69437999014e-3 * np.sin(north) ** 2)
    up = np.array([np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)])
    place = (radius * up) * [1, 1, 1 - 6.69437999014e-3]
    rows = [",".join(f"{x:.4f}" for x in place + height * up) for height in (0.0, 10.0)]
    (tmp_path / "p.csv").write_text(f"time,{names}\n0,{rows[0]}\n1,{rows[1]}\n2,0,0,0\n")
    found = positions_of(read_motion(tmp_path / "p.csv"), "auto", {})
    np.testing.assert_allclose(found.positions[1][:2], found.positions[0][:2], atol=1e-3)
    np.testing.assert_allclose(found.positions, [(500000, 5316300.2, 0), (500000, 5316300.2, 10)], atol=1.0)


def test_northings_as_large_as_the_earth_are_no_distance_from_its_centre(tmp_path):
    (tmp_path / "p.csv").write_text("time,x,y,z\n0,500000,6350000,90\n1,500001,6350000,90\n")
    assert positions_of(read_motion(tmp_path / "p.csv"), "auto", {}).positions[0] == (500000.0, 6350000.0, 90.0)


@pytest.mark.parametrize("steps", ["{1},{0}", "{0},{1}"])
def test_motions_from_frame_to_frame_are_no_poses(tmp_path, steps):
    """As RobotCar has them in vo.csv."""
    rows = [steps.format(100 + k, 101 + k) + ",1,0,0,0,0,0.1" for k in range(3)]
    (tmp_path / "vo.csv").write_text("\n".join(["source_timestamp,destination_timestamp,x,y,z,roll,pitch,yaw", *rows]))
    for read in (read_motion, lambda path: table_kind(path, 3)):
        with raises("RIL-775", "vo.csv", "destination_timestamp"):
            read(tmp_path / "vo.csv")


@pytest.mark.parametrize("south", [1, -1])
@pytest.mark.parametrize(
    ("names", "row"),
    [
        ("time,latitude,longitude,altitude", "{k},{lat},{lon},7"),
        ("#Label,X/Longitude,Y/Latitude,Z/Altitude", "img{k}.jpg,{lon},{lat},7"),
        ("time [s];GPS_Lat [deg];gps lng;height", "{k};{lat};{lon};7"),
        ("__time,/fix/latitude,/fix/longitude,/fix/altitude", "{k},{lat},{lon},7"),
        ("time,lat,lon,/imu/depth,roll,pitch,yaw", "{k},{lat},{lon},-7,1,2,3"),
    ],
)
def test_degrees_become_metres_of_the_zone_of_the_first_place(tmp_path, names, row, south):
    """On the meridian in a zone's middle; places beyond the zone's edge stay in it, and 0, 0 is no place."""
    places = [(48.1, 9.0), (48.101, 9.0), (48.1, 12.1), (0, 0)]
    lines = [row.format(k=k, lat=south * lat, lon=lon) for k, (lat, lon) in enumerate(places)]
    (tmp_path / "p.csv").write_text("\n".join([names, *lines]))
    table = read_motion(tmp_path / "p.csv")
    assert table.crs == f"EPSG:32{'6' if south > 0 else '7'}32"
    found = positions_of(table, "auto", {})
    (x, y, z), (x1, y1, _), (x2, _, _) = found.positions
    assert (x, x1, z) == (pytest.approx(500000), pytest.approx(500000), 7)
    # 6 335 439 m / (1 - e2 sin2)^1.5 is the radius of the meridian; 0.9996 the scale of UTM.
    radius = 6335439.3 / (1 - 0.00669438 * np.sin(np.deg2rad(48.1)) ** 2) ** 1.5
    assert y1 - y == pytest.approx(south * 0.9996 * radius * np.deg2rad(0.001), rel=1e-5)
    assert x2 - x == pytest.approx(111320 * np.cos(np.deg2rad(48.1)) * 3.1, rel=0.01)
    assert sum("RIL-706" in line for line in found.warnings) == 1


def test_places_all_around_the_earth_make_no_plane(tmp_path):
    (tmp_path / "p.csv").write_text("time,latitude,longitude\n0,48,9\n1,0,99\n")
    with raises("RIL-776", "EPSG:32632"):
        read_motion(tmp_path / "p.csv")


@pytest.mark.parametrize("row", ["0,4806.1,930.2", "0,lost,9"])
def test_what_is_no_degree_is_no_place(tmp_path, row):
    """Degrees and minutes, as in sentences of NMEA."""
    (tmp_path / "p.csv").write_text(f"time,latitude,longitude\n{row}\n")
    with raises("RIL-805", "degrees"):
        positions_of(read_motion(tmp_path / "p.csv"), "auto", {})


def test_positions_in_degrees_are_refused_by_their_unit(tmp_path):
    (tmp_path / "p.csv").write_text("time,x_deg,y_deg\n1,15,47\n2,15,47\n")
    with raises("RIL-995", "x_deg"):
        positions_of(read_motion(tmp_path / "p.csv"), "auto", {})


@pytest.mark.parametrize("timed", [False, True])
def test_matrices_column_by_column_are_turned(tmp_path, timed):
    poses = [RigidTransform(rotation_exp([0.1, 0.2 * k, 0.3]), [k, 2.0, 3.0]) for k in range(3)]
    rows = [np.vstack([pose.matrix34, [0, 0, 0, 1]]).T.ravel() for pose in poses]
    rows[1:1] = [] if timed else [np.full(16, np.nan)]
    lines = [" ".join(map(str, [*([k] if timed else []), *row])) for k, row in enumerate(rows)]
    (tmp_path / "p.txt").write_text("\n".join(lines))
    found = [pose for pose in poses_of(read_motion(tmp_path / "p.txt")).poses if pose]
    for pose, read in zip(poses, found, strict=True):
        np.testing.assert_allclose(read.matrix34, pose.matrix34, atol=1e-12)


def test_names_of_columns_that_stand_twice_mean_nothing(tmp_path):
    """As in tables of motion capture: x, y, z of the quaternion come first."""
    lines = ["frame,time,x,y,z,w,x,y,z", *(f"{k},{k},0,0,0,1,{k},2,3" for k in range(3))]
    (tmp_path / "take.csv").write_text("\n".join(lines))
    table = read_motion(tmp_path / "take.csv")
    assert positions_of(table, "auto", {}) is None
    with raises("RIL-264", "x, y, z, w, x, y, z"):
        poses_of(table)
    found = positions_of(table, "auto", {"x": 7, "y": 8, "z": 9})
    assert found is not None
    assert found.positions == tuple((float(k), 2.0, 3.0) for k in range(3))
