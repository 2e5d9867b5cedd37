"""Rotation and vertical from an IMU, against movements whose attitude is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises
from scipy.spatial.transform import Rotation

from rille.datasets.imu import ImuRecord, at_frames, integrate, read_imu, resting_bias
from rille.stages.geometry.geometry import RigidTransform, rotation_exp

IDENTITY = RigidTransform.identity()
T_IMU_LEFT = RigidTransform(rotation_exp([0.3, -1.2, 0.7]), np.array([0.1, 0.2, 0.3]))
BIAS = np.array([-0.002, 0.021, 0.078])
G = np.array([0.0, 0.0, 9.81])


def nodding(t):
    """R_world_imu that turns about the vertical and nods: its axes do not commute. t (n,), s."""
    return Rotation.from_euler("ZX", np.column_stack([0.8 * t, 0.5 * np.sin(2.0 * t)])).as_matrix()


def nodding_rates(t):
    """Rates (n, 3) in the sensor's axes: R = Rz(a) Rx(b) has w = b' e_x + Rx(-b) a' e_z."""
    b, db, da = 0.5 * np.sin(2.0 * t), np.cos(2.0 * t), 0.8
    return np.column_stack([db, da * np.sin(b), da * np.cos(b)])


def angle(R):
    return np.degrees(np.linalg.norm(Rotation.from_matrix(R).as_rotvec()))


def resting(seconds=4.0, rate=200.0, R=None, bias=BIAS, noise=0.0, seed=0):
    """Record of a sensor that stands at R_world_imu; forces point up."""
    t = np.arange(round(seconds * rate)) / rate
    rng = np.random.default_rng(seed)
    force = (np.eye(3) if R is None else R).T @ G
    shape = (len(t), 3)
    return ImuRecord(t, bias + noise * rng.standard_normal(shape), force + 10 * noise * rng.standard_normal(shape))


def test_rates_become_the_rotation_between_frames():
    t = np.arange(0, 4.0, 0.005)
    at = np.array([0.5, 1.0, 1.0025, 1.7312, 3.9])
    found = at_frames(ImuRecord(t, nodding_rates(t), np.tile(G * 3, (len(t), 1))), at, T_IMU_LEFT)
    truth = nodding(at) @ T_IMU_LEFT.rotation
    ours = np.array(found.attitude)
    for k in range(1, len(at)):
        assert angle((ours[0].T @ ours[k]).T @ (truth[0].T @ truth[k])) < 0.003
    assert found.up == (None,) * len(at)  # thrice the gravity
    assert "bias is not known" in found.notes[0]


def test_the_error_falls_with_the_square_of_the_sampling():
    errors = []
    for dt in (0.02, 0.01):
        t = np.arange(0, 3.0 + dt / 2, dt)
        R = integrate(t, nodding_rates(t))[-1]
        errors.append(angle(R.T @ (nodding(t)[0].T @ nodding(t)[-1])))
    assert 3.5 < errors[0] / errors[1] < 4.5


def test_bias_is_what_a_resting_sensor_reads():
    # median of 40 means of 20 samples of sigma 0.01: 0.00044 rad/s; four of them
    bias, notes = resting_bias(resting(noise=0.01), 0, 4)
    np.testing.assert_allclose(bias, BIAS, atol=0.0018)
    assert notes[0].endswith("rad/s from 4.0 s of rest")


def test_bias_is_removed_before_the_rotation():
    rest = resting(2.0)
    t = np.arange(0, 4.0, 0.005)
    moved = ImuRecord(
        np.concatenate([rest.times, 2.0 + t]),
        np.concatenate([rest.rates, nodding_rates(t) + BIAS]),
        np.concatenate([rest.forces, nodding(t).transpose(0, 2, 1) @ G]),
    )
    found = at_frames(moved, [2.5, 5.5], IDENTITY)
    a, b = (np.array(r) for r in found.attitude)
    truth = nodding(np.array([0.5, 3.5]))
    # unremoved it would be 3 s x 0.081 rad/s = 14 degrees
    assert angle((a.T @ b).T @ (truth[0].T @ truth[1])) < 0.02


def test_a_steady_turn_is_not_taken_for_a_bias_where_a_quieter_rest_is():
    still, turning = resting(3.0, noise=0.001), resting(3.0, bias=BIAS + np.array([0, 0, 0.05]), noise=0.01, seed=1)
    record = ImuRecord(
        np.concatenate([still.times, 3.0 + turning.times]),
        np.concatenate([still.rates, turning.rates]),
        np.concatenate([still.forces, turning.forces]),
    )
    bias, _ = resting_bias(record, 3.0, 6.0)
    np.testing.assert_allclose(bias, BIAS, atol=2e-4)


def test_a_turn_faster_than_any_bias_is_no_rest():
    assert resting_bias(resting(bias=np.array([0, 0, 0.2])), 0, 4)[0] is None
    assert resting_bias(resting(0.5), 0, 4)[0] is None


def test_the_rest_nearest_to_the_frames_counts():
    early, late = resting(10.0), resting(10.0, bias=BIAS + 0.001)
    record = ImuRecord(
        np.concatenate([early.times, 10.0 + late.times]),
        np.concatenate([early.rates, late.rates]),
        np.concatenate([early.forces, late.forces]),
    )
    np.testing.assert_allclose(resting_bias(record, 1.0, 2.0)[0], BIAS, atol=1e-12)
    np.testing.assert_allclose(resting_bias(record, 18.0, 19.0)[0], BIAS + 0.001, atol=1e-12)


def test_up_is_where_a_resting_accelerometer_points():
    R_world_imu = rotation_exp([0.4, -0.3, 1.0])
    found = at_frames(resting(R=R_world_imu, noise=0.01), [0.0, 2.0, 3.99], T_IMU_LEFT)
    wanted = T_IMU_LEFT.rotation.T @ R_world_imu.T @ [0, 0, 1]
    # first and last frame: mean of 200 samples of sigma 0.1 m/s^2, 0.007 m/s^2 an axis, 0.04 degrees
    for up in found.up:
        np.testing.assert_allclose(up, wanted, atol=0.004)


def test_up_is_carried_to_the_frame_of_a_sensor_that_turns_slowly():
    t = np.arange(0, 6.0, 0.005)
    rate = np.array([0.1, 0.0, 0.0])
    R = Rotation.from_rotvec(t[:, None] * rate).as_matrix()
    found = at_frames(ImuRecord(t, np.tile(rate, (len(t), 1)), R.transpose(0, 2, 1) @ G), [3.0, 5.999], IDENTITY)
    # the force turns, so that there is no rest and no bias; at the end the mean over one side is carried all the same
    for moment, up in zip((3.0, 5.999), found.up, strict=True):
        np.testing.assert_allclose(up, [0, np.sin(0.1 * moment), np.cos(0.1 * moment)], atol=1e-3)


def test_vibration_does_not_matter():
    record = resting(4.0)
    shake = np.sin(2 * np.pi * 43.0 * record.times)[:, None] * [1.0, 0.5, 0.7]
    found = at_frames(ImuRecord(record.times, record.rates, record.forces + shake), [2.0], IDENTITY)
    np.testing.assert_allclose(found.up[0], [0, 0, 1], atol=0.003)


def _brakes(t):
    return np.where((t > 1.5) & (t < 2.5), 2.0, 0.0)[:, None] * [1.0, 0, 0]


def _falls(t):
    return np.tile(-G, (len(t), 1))


def _heavy(t):
    return np.tile([0, 0, 0.3], (len(t), 1))


@pytest.mark.parametrize(("more", "said"), [(_brakes, False), (_falls, True), (_heavy, True)])
def test_no_up_from_an_accelerated_body_or_a_wrong_scale_which_is_said(more, said):
    record = resting(4.0)
    forces = record.forces + more(record.times)
    found = at_frames(ImuRecord(record.times, record.rates, forces), [2.0], IDENTITY)
    assert found.up == (None,)
    assert any("RIL-850" in line for line in found.warnings) == said


def test_no_up_from_a_body_that_turns_fast():
    record = resting(4.0, bias=np.array([0, 0, 0.3]))
    assert at_frames(record, [2.0], IDENTITY).up == (None,)


def test_after_a_gap_the_reference_is_lost_but_not_the_vertical():
    record = resting(10.0)
    keep = (record.times < 6.0) | (record.times > 6.5)
    cut = ImuRecord(record.times[keep], record.rates[keep], record.forces[keep], "imu0")
    found = at_frames(cut, [1.0, 3.0, 5.0, 6.2, 7.7, 8.0], IDENTITY)
    assert [a is not None for a in found.attitude] == [True, True, True, False, False, False]
    assert [u is not None for u in found.up] == [True, True, True, False, True, True]
    assert found.warnings == (
        "RIL-688: no attitude from imu0 for 3 of 6 frames, in 1 stretch: "
        "first at 5.20 s, last at 7.00 s of the sequence",
    )


def test_a_short_gap_is_bridged():
    t = np.arange(0, 4.0, 0.005)
    t = t[(t < 1.0) | (t > 1.05)]
    found = at_frames(ImuRecord(t, nodding_rates(t), nodding(t).transpose(0, 2, 1) @ G), [0.5, 3.0], IDENTITY)
    a, b = (np.array(r) for r in found.attitude)
    truth = nodding(np.array([0.5, 3.0]))
    assert angle((a.T @ b).T @ (truth[0].T @ truth[1])) < 0.1


def test_a_sensor_that_stops_or_starts_late():
    found = at_frames(resting(4.0), [-0.5, 1.0, 3.9, 4.0, 4.5], IDENTITY)
    assert [a is not None for a in found.attitude] == [False, True, True, True, False]
    assert len(found.warnings) == 1


def test_no_common_time_names_both_ranges():
    with raises("RIL-269", "0.000", "3.995", "100.000", "101.000"):
        at_frames(resting(4.0), [100.0, 101.0], IDENTITY)


# -- files -------------------------------------------------------------------------------------------------------------

EUROC = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],a_y,a_z"


def record_file(tmp_path, header, rows):
    path = tmp_path / "imu.csv"
    path.write_text("\n".join([header, *(",".join(str(v) for v in row) for row in rows)]) + "\n")
    return path


def test_columns_by_order_and_by_name(tmp_path):
    t = [1403715273262142976, 1403715273267142912]
    plain = read_imu(record_file(tmp_path, EUROC, [(t[0], 1, 2, 3, 4, 5, 6), (t[1], 1, 2, 3, 4, 5, 6)]))
    np.testing.assert_array_equal(plain.rates, [[1, 2, 3]] * 2)
    np.testing.assert_array_equal(plain.forces, [[4, 5, 6]] * 2)
    np.testing.assert_allclose(np.diff(plain.times), 0.005, atol=3e-7)
    unnamed = read_imu(record_file(tmp_path, "", [(0.0, 1, 2, 3, 4, 5, 6), (0.1, 1, 2, 3, 4, 5, 6)]))
    np.testing.assert_array_equal(unnamed.forces, plain.forces)
    header = "time,acc_x,acc_y,acc_z,gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s]"
    named = read_imu(record_file(tmp_path, header, [(0.0, 4, 5, 6, 90, 0, 180), (0.1, 4, 5, 6, 90, 0, 180)]))
    np.testing.assert_array_equal(named.forces, plain.forces)
    np.testing.assert_allclose(named.rates, [[np.pi / 2, 0, np.pi]] * 2)
    header = header.replace("time", "time [ms]")
    assert read_imu(record_file(tmp_path, header, [(0, 4, 5, 6, 1, 0, 1), (100, 4, 5, 6, 1, 0, 1)])).times[1] == 0.1


@pytest.mark.parametrize(
    ("row", "code"),
    [
        ((0, 0, 0), "RIL-186"),
        ((0, 0, 0, 9.8, 0, 0, 0), "RIL-187"),
        ((0, 0, 0, 0, 0, 0, 1), "RIL-188"),
        ((0, 0, 0, 0, 0, 0, 0.02), "RIL-188"),  # gravity was taken off
        ((0, 0, 0, 0, 0, 0, 1000), "RIL-188"),  # of thousandths of g
    ],
)
def test_what_cannot_be_is_refused(tmp_path, row, code):
    with raises(code) as caught:
        read_imu(record_file(tmp_path, "", [row, (1, *row[1:])]))
    assert caught.value.remedy


@pytest.mark.parametrize(("column", "value", "unit"), [(2, "1e19", "rad/s"), (6, "-6e3", "m/s^2")])
def test_a_value_beyond_any_sensor_is_refused_with_its_line(tmp_path, column, value, unit):
    rows = [["0.0", "0", "0", "0", "0", "0", "9.81"], ["0.1", "0", "0", "0", "0", "0", "9.81"]]
    rows[1][column] = value
    (tmp_path / "imu.csv").write_text("".join(",".join(row) + "\n" for row in rows))
    with raises("RIL-854", "line 2", unit):
        read_imu(tmp_path / "imu.csv")


@pytest.mark.parametrize(
    "names",
    [
        "time,acc_x,acc_y,acc_z,u,v,w",
        "time,u,v,w,gyro_x,gyro_y,gyro_z",
        "time,ang_acc_x,ang_acc_y,ang_acc_z,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z",
    ],
)
def test_no_column_is_taken_for_another_sensors(tmp_path, names):
    """Of names that tell one sensor alone, out of the usual order, the other is nowhere: not in that one's columns."""
    row = [9.81] * (len(names.split(",")) - 1)
    with raises("RIL-191", "only those of one sensor"):
        read_imu(record_file(tmp_path, names, [(0.0, *row), (0.1, *row)]))


@pytest.mark.parametrize(
    ("names", "scale"),
    [
        ("t,wx,wy,wz,ax,ay,az", 1),
        ("t,gyro_x(dps),gyro_y(dps),gyro_z(dps),acc_x,acc_y,acc_z", np.pi / 180),
        ("t,gyro_x [\N{DEGREE SIGN}/s],gyro_y [\N{DEGREE SIGN}/s],gyro_z [\N{DEGREE SIGN}/s],ax,ay,az", np.pi / 180),
        (
            "%time,"
            + ",".join(f"field.{what}.{axis}" for what in ("angular_velocity", "linear_acceleration") for axis in "xyz")
            + ",field.angular_velocity_covariance0",
            1,
        ),
    ],
)
def test_names_and_units_as_loggers_write_them(tmp_path, names, scale):
    path = tmp_path / "imu.csv"
    more = ",9" if "covariance" in names else ""
    path.write_text(
        f"{names}\n0,0.1,0.2,0.3,0,0,9.8{more}\n1,,,,,,{more}\n2,0.1,0.2,0.3,0,0,9.8{more}\n", encoding="utf-8"
    )
    found = read_imu(path)
    assert found.times.tolist() == [0, 2]
    np.testing.assert_allclose(found.rates, np.tile([0.1 * scale, 0.2 * scale, 0.3 * scale], (2, 1)))
    assert "1 row of 3" in found.warnings[0]


def test_names_of_one_sensor_in_the_usual_order_are_enough(tmp_path):
    rows = [(t, 1, 2, 3, 0, 0, 9.81) for t in (0.0, 0.1)]
    for names in ("time,gyro_x,gyro_y,gyro_z,ax,ay,az", "time,wx,wy,wz,acc_x,acc_y,acc_z"):
        found = read_imu(record_file(tmp_path, names, rows))
        assert found.rates[0].tolist() == [1, 2, 3]
        assert found.forces[0].tolist() == [0, 0, 9.81]


@pytest.mark.parametrize(
    ("names", "order"),
    [
        ("t,ax,ay,az,gx,gy,gz", (0, 4, 5, 6, 1, 2, 3)),
        ("t,gyro_y [rad/s],gyro_x [rad/s],gyro_z [rad/s],acc_z,acc_y,acc_x", (0, 2, 1, 3, 6, 5, 4)),
        ("timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z", (0, 1, 2, 3, 4, 5, 6)),
        (",time,gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z", (7, 0, 1, 2, 3, 4, 5, 6)),
        ("gyro_x,gyro_y,gyro_z,acc_x,acc_y,acc_z,timestamp [s]", (1, 2, 3, 4, 5, 6, 0)),
    ],
    ids=["accelerations first", "axes in another order", "Kalibr", "a column of numbers before", "times last"],
)
def test_columns_in_any_order_are_those_of_their_names(tmp_path, names, order):
    rows = [(t, 0.1, 0.2, 0.3, 1, 2, 9.5, 7) for t in (0.5, 0.6)]
    found = read_imu(record_file(tmp_path, names, [[row[k] for k in order] for row in rows]))
    assert found.times.tolist() == [0.5, 0.6]
    assert found.rates[0].tolist() == [0.1, 0.2, 0.3]
    assert found.forces[0].tolist() == [1, 2, 9.5]


def test_times_without_their_unit_are_no_seconds(tmp_path):
    rows = [(5 * t, 0, 0, 0, 0, 0, 9.8) for t in range(4)]
    with raises("RIL-798", "5 s apart", "time_ms"):
        read_imu(record_file(tmp_path, "t,gx,gy,gz,ax,ay,az", rows))
    for name, unit in (("time_ms", 1e-3), ("TimeUS", 1e-6)):
        record = read_imu(record_file(tmp_path, f"{name},gx,gy,gz,ax,ay,az", rows))
        np.testing.assert_allclose(record.times, 5 * unit * np.arange(4))


def test_accelerations_in_multiples_of_gravity_are_converted_where_the_names_say_so(tmp_path):
    names = "t," + ",".join(f"gyro_{a}_mrad" for a in "xyz") + "," + ",".join(f"acc_{a} [g]" for a in "xyz")
    read_imu(record_file(tmp_path, names, [(t, 0, 0, 0, 0, 0, 1) for t in (0.0, 0.1)]))
    with raises("RIL-995", "gyro_x_mm"):
        read_imu(record_file(tmp_path, names.replace("mrad", "mm"), [(t, 0, 0, 0, 0, 0, 1) for t in (0.0, 0.1)]))
    found = read_imu(
        record_file(tmp_path, names.replace("_mrad", "_deg_s"), [(t, 90, 0, 0, 0, 0, 1) for t in (0.0, 0.1)])
    )
    np.testing.assert_allclose(found.rates[0], [np.pi / 2, 0, 0])
    np.testing.assert_allclose(found.forces[0], [0, 0, 9.80665])
