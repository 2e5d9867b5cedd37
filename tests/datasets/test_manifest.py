"""Manifests: what they open to, and the one line that each kind of bad input gives."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from folders import CAMERAS, write_images, write_lines, write_sequence

from datasets.files import Digests
from datasets.georeference import Georeference
from datasets.manifest import dotted, open_manifest
from datasets.manifest_model import Manifest, known_keys, read_manifest, tables
from datasets.protocol import Sequence
from stages.errors import InputError
from stages.geometry import RigidTransform, rotation_exp


def opened(path: Path) -> Sequence:
    return open_manifest(path, Digests())


def tum(t: float, x: float) -> str:
    return f"{t} {x} 0 0 0 0 0 1"


# -- what it opens to --------------------------------------------------------------------------------------------------


def test_smallest_manifest(tmp_path, materialise):
    s = opened(write_sequence(tmp_path))
    assert (s.name, s.frames, s.frame_names) == ("rover", 3, ("00", "01", "02"))
    assert (s.rig.left.fx, s.rig.left.fy, s.rig.left.cx, s.rig.left.width, s.rig.left.height) == (60, 60, 31.5, 64, 48)
    np.testing.assert_array_equal(s.rig.T_right_left.matrix34, np.hstack([np.eye(3), [[-0.1], [0], [0]]]))
    assert (s.lenses, s.times, s.truth, s.up, s.attitude, s.odometry, s.vehicle, s.warnings) == (*[None] * 7, ())
    for frame in range(3):
        for k, camera in enumerate(("left", "right")):
            assert (materialise(s.image(frame, camera))["image"] == 2 * frame + k).all()


def test_a_missing_image_is_a_lost_frame(tmp_path, materialise):
    """The others keep their numbers, and what is read by the left images' names is still found."""
    path = write_sequence(tmp_path, '[times]\nfile = "times.csv"\n')
    write_lines(tmp_path / "times.csv", [f"{0.5 * k},{k:02d}.png" for k in range(3)])
    (tmp_path / "left" / "01.png").unlink()
    s = opened(path)
    assert (s.frames, s.frame_names, s.times) == (3, ("00", "01", "02"), (0.0, 0.5, 1.0))
    assert s.lost == {1: "left/01.png is missing"}
    assert (materialise(s.image(2, "right"))["image"] == 5).all()


def test_everything_else_that_a_manifest_may_say(tmp_path):
    text = """
[times]
rate_hz = 4.0
[world]
pitch_deg = 20.0
[vehicle]
name = "crawler"
max_step = 0.05
[defaults]
locus.cell_size = 0.02
"select.stride" = 1
[notes]
text = ["dusty"]
"""
    s = opened(write_sequence(tmp_path, text, head='name = "dune"'))
    assert (s.name, s.times, s.notes) == ("dune", (0.0, 0.25, 0.5), ("dusty",))
    assert s.pitch == pytest.approx(math.radians(20))
    assert s.vehicle is not None
    assert (s.vehicle.name, s.vehicle.max_step, s.vehicle.track) == ("crawler", 0.05, 0.6)
    assert s.defaults == {"locus.cell_size": 0.02, "select.stride": 1}


def test_root_may_name_a_variable(tmp_path, monkeypatch):
    write_sequence(tmp_path / "data" / "a")
    path = tmp_path / "elsewhere.toml"
    path.write_text('root = "${ROVERS}/a"\n' + (tmp_path / "data" / "a" / "rover.rille.toml").read_text())
    monkeypatch.setenv("ROVERS", str(tmp_path / "data"))
    s = opened(path)
    assert (s.name, s.frames) == ("elsewhere", 3)
    monkeypatch.setenv("ROVERS", str(tmp_path / "nothing"))
    with pytest.raises(InputError, match=r"elsewhere\.toml: root = .*there is no folder .*nothing"):
        opened(path)
    monkeypatch.delenv("ROVERS")
    with pytest.raises(InputError, match=r"needs the environment variable ROVERS, which is not set: export ROVERS="):
        opened(path)


def test_name_of_a_plain_manifest_is_its_folders(tmp_path):
    write_sequence(tmp_path / "sands").rename(tmp_path / "sands" / "manifest.toml")
    assert opened(tmp_path / "sands" / "manifest.toml").name == "sands"


def test_relative_pose_may_be_stated(tmp_path):
    T = RigidTransform(rotation_exp([0.0, 0.05, 0.01]), np.array([-0.2, 0.01, 0.0]))
    rig = f"[rig]\nT_right_left = {np.round(T.matrix34, 15).tolist()}\n"
    s = opened(write_sequence(tmp_path, rig=rig))
    np.testing.assert_allclose(s.rig.T_right_left.matrix34, T.matrix34, atol=1e-12)


def test_distortion_gives_lenses(tmp_path):
    cameras = CAMERAS + "distortion = [-0.3, 0.1, 0.0, 0.0]\n"
    s = opened(write_sequence(tmp_path, cameras=cameras))
    assert s.lenses is not None
    assert {c: (lens.model, lens.coefficients) for c, lens in s.lenses.items()} == dict.fromkeys(
        ("left", "right"), ("radtan", (-0.3, 0.1, 0.0, 0.0))
    )


def test_cameras_may_differ(tmp_path):
    cameras = (
        "[cameras.left]\nfx = 60.0\ncx = 31.5\ncy = 23.5\n[cameras.right]\nfx = 61.0\nfy = 62.0\ncx = 30.0\ncy = 23.0\n"
    )
    rig = opened(write_sequence(tmp_path, cameras=cameras)).rig
    assert (rig.left.fx, rig.left.fy, rig.right.fx, rig.right.fy, rig.right.cx) == (60, 60, 61, 62, 30)


def test_direction_of_up_is_that_of_the_left_camera_where_no_file_states_another(tmp_path):
    s = opened(write_sequence(tmp_path, "[world]\nup = [0, -2, 0]\n"))
    assert s.up == ((0.0, -1.0, 0.0),) * 3
    assert s.georeference is None


def test_place_on_earth(tmp_path):
    place = 'crs = "EPSG:32633"\norigin = [500100.0, 5200200.0, 1800.0]\nazimuth_deg = 90.0\n'
    s = opened(write_sequence(tmp_path, f"[world]\n{place}"))
    assert s.georeference == Georeference("EPSG:32633", (500100.0, 5200200.0, 1800.0), math.pi / 2)


# -- times -------------------------------------------------------------------------------------------------------------


def test_times_of_a_file_in_order_or_by_name(tmp_path):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n')
    write_lines(tmp_path / "t.txt", ["0.0", "0.5", "1.0"])
    assert opened(path).times == (0.0, 0.5, 1.0)
    write_lines(tmp_path / "t.txt", ["# stamp file", "9.0 99.png", "10.0 00.png", "10.5 01.png", "11.0 02.png"])
    assert opened(path).times == (10.0, 10.5, 11.0)


def test_times_of_names(tmp_path):
    names = [f"{side}/{1_500_000_000 + k}.5.png" for k in range(3) for side in ("left", "right")]
    path = write_sequence(tmp_path, "[times]\nnames = true\n", frames=0)
    write_images(tmp_path, names)
    assert opened(path).times == (1_500_000_000.5, 1_500_000_001.5, 1_500_000_002.5)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["0.0", "0.5"], r"t\.txt has 2 times for 3 pairs"),
        (["1500000000.0", "1500000000500000000", "1500000001000000000"], r"t\.txt"),
        (["0.0", "0.5", "0.5"], r"t\.txt.*3"),
    ],
)
def test_bad_times(tmp_path, lines, message):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n')
    write_lines(tmp_path / "t.txt", lines)
    with pytest.raises(InputError, match=message):
        opened(path)


# -- poses and sensors -------------------------------------------------------------------------------------------------


def test_truth_of_a_body_becomes_that_of_the_left_camera(tmp_path):
    text = '[truth]\nfile = "p.txt"\nsource = "total station"\nT_body_left = [[0,0,1,2],[-1,0,0,0],[0,-1,0,0]]\n'
    path = write_sequence(tmp_path, text)
    write_lines(tmp_path / "p.txt", [f"1 0 0 {k} 0 1 0 0 0 0 1 0" for k in range(3)])
    s = opened(path)
    assert s.truth_source == "total station"
    assert s.truth is not None
    for k, pose in enumerate(s.truth):
        assert pose is not None
        np.testing.assert_allclose(pose.translation, [k + 2, 0, 0])
        np.testing.assert_allclose(pose.rotation @ [0, 0, 1], [1, 0, 0])


def test_truth_with_a_gap_is_a_warning(tmp_path):
    path = write_sequence(tmp_path, '[times]\nrate_hz = 1.0\n[truth]\nfile = "p.tum"\nmax_gap = 1.0\n', frames=6)
    write_lines(tmp_path / "p.tum", [tum(t, t) for t in (-0.5, 0.5, 1.5, 3.5, 4.5, 5.5)])
    s = opened(path)
    assert s.truth is not None
    assert [None if p is None else round(float(p.translation[0]), 9) for p in s.truth] == [0, 1, None, None, 4, 5]
    assert any("truth" in line for line in s.warnings)


def test_time_offset_moves_the_poses(tmp_path):
    path = write_sequence(
        tmp_path, '[times]\nrate_hz = 1.0\n[truth]\nfile = "p.tum"\ntime_offset = 100.0\nmax_gap = 9\n'
    )
    write_lines(tmp_path / "p.tum", [tum(t, t) for t in (-100.0, -99.0, -98.0)])
    truth = opened(path).truth
    assert truth is not None
    assert [round(float(p.translation[0]), 9) for p in truth if p is not None] == [-100, -99, -98]


@pytest.mark.parametrize(
    ("text", "lines", "message"),
    [
        ('[truth]\nfile = "p.txt"\n', ["1 0 0 0 0 1 0 0 0 0 1 0"], r"truth\.file: .*p\.txt has 1 poses for 3 pairs"),
        ('[truth]\nfile = "p.txt"\n', [tum(0, 0), tum(1, 1)], r"p\.txt have times, but the pairs have none: give \[ti"),
        ('[truth]\nfile = "nothing.txt"\n', [], r"nothing\.txt"),
    ],
)
def test_bad_truth(tmp_path, text, lines, message):
    path = write_sequence(tmp_path, text)
    write_lines(tmp_path / "p.txt", lines)
    with pytest.raises(InputError, match=message):
        opened(path)


def test_attitude_and_its_vertical(tmp_path):
    """A sensor whose z is up carries a camera that looks along its x; the body turns by 0.1 rad a second about up."""
    text = (
        '[times]\nrate_hz = 1.0\n[attitude]\nfile = "a.csv"\nup = [0, 0, 1]\nmax_gap = 2.0\n'
        "T_body_left = [[0,0,1,0],[-1,0,0,0],[0,-1,0,0]]\n"
    )
    path = write_sequence(tmp_path, text)
    rows = [f"{k},{math.cos(0.05 * k)},0,0,{math.sin(0.05 * k)}" for k in range(3)]
    write_lines(tmp_path / "a.csv", ["time,qw,qx,qy,qz", *rows])
    s = opened(path)
    assert s.attitude is not None
    assert s.up is not None
    for k in range(3):
        np.testing.assert_allclose(s.up[k], [0, -1, 0], atol=1e-12)
    turn = np.transpose(s.attitude[2]) @ np.array(s.attitude[0])
    np.testing.assert_allclose(turn, rotation_exp([0, 0.2, 0]), atol=1e-9)


def test_imu_gives_the_rotation_and_says_where_it_stops(tmp_path):
    """Gyroscope at 100 Hz, 0.2 rad/s about the camera's y axis; it ends before the last of six pairs."""
    text = '[times]\nrate_hz = 1.0\n[imu]\nfile = "imu.csv"\nT_imu_left = [[1,0,0,0],[0,1,0,0],[0,0,1,0]]\n'
    path = write_sequence(tmp_path, text, frames=6)
    header = "#timestamp [s],w_x [rad s^-1],w_y [rad s^-1],w_z [rad s^-1],a_x [m s^-2],a_y [m s^-2],a_z [m s^-2]"
    write_lines(tmp_path / "imu.csv", [header] + [f"{0.01 * k:.2f},0,0.2,0,0,-9.81,0" for k in range(-20, 451)])
    s = opened(path)
    assert s.attitude is not None
    assert s.attitude[5] is None
    assert any("imu" in line.lower() for line in s.warnings)
    turn = np.transpose(s.attitude[3]) @ np.array(s.attitude[0])
    np.testing.assert_allclose(turn, rotation_exp([0, -0.6, 0]), atol=2e-3)


def test_sensors_need_times(tmp_path):
    text = '[imu]\nfile = "imu.csv"\nT_imu_left = [[1,0,0,0],[0,1,0,0],[0,0,1,0]]\n'
    with pytest.raises(InputError, match=r"\[imu\] needs times, but the pairs have none: give \[times\]"):
        opened(write_sequence(tmp_path, text))


# -- bad input, one line each ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"rig": "[rig]\nbaseline = 97\n"}, r"baseline is 97 m, .*millimetres: did you mean 0\.097\?"),
        ({"rig": "[rig]\nbaseline = -0.1\n"}, r"rig\.baseline = -0\.1 m is not positive: .*swapped"),
        ({"rig": "[rig]\nT_right_left = [[1,0,0,0.1],[0,1,0,0],[0,0,1,0]]\n"}, "swap"),
        (
            {"rig": "[rig]\nT_right_left = [[1,0,0],[0,1,0],[0,0,1]]\n"},
            r"rig\.T_right_left = .*give rows of \[R \| t\]",
        ),
        ({"rig": "[rig]\nT_right_left = [[2,0,0,-1],[0,1,0,0],[0,0,1,0]]\n"}, r"rig\.T_right_left .*not a rotation"),
        ({"rig": "[rig]\nbaselin = 0.1\n"}, r"unknown key 'rig\.baselin' \(value 0\.1\): did you mean 'rig\.baseline'"),
        ({"rig": ""}, r"the rig is not known: .*give rig\.baseline \(m"),
        ({"cameras": ""}, r"the cameras are not known: give cameras\.file"),
        (
            {"cameras": "[cameras]\nfx = 60.0\ncx = 3.0\n"},
            r"cameras: cy is missing \(px\); fx, cx alone make no camera",
        ),
        (
            {"cameras": "[cameras]\nfx = -60.0\ncx = 3.0\ncy = 3.0\n"},
            r"cameras\.fx = -60\.0 is not permitted: .*greater",
        ),
        ({"cameras": CAMERAS + 'file = "x.yaml"\n'}, r"cameras: give fx, fy .* or file, or left and right"),
        ({"cameras": '[cameras]\nleft = "x.yaml"\n'}, "cameras: right is missing"),
        (
            {"cameras": CAMERAS + "distortion = [0.1, 0.2, 0.3]\n"},
            "cameras: .*radtan has 3 coefficients, it takes 4 or 5",
        ),
        ({"cameras": CAMERAS + 'model = "fish"\n'}, r"cameras\.model = 'fish' is not permitted: .*'fisheye'"),
        (
            {"cameras": CAMERAS + "width = 640\nheight = 480\n"},
            "calibrated for 640 x 480 pixels, the images are 64 x 48",
        ),
        ({"cameras": '[cameras]\nfile = "nothing.yaml"\n'}, r"nothing\.yaml"),
        ({"head": "baseline = 0.1"}, r"unknown key 'baseline' \(value 0\.1\): did you mean 'rig\.baseline'\?"),
        ({"head": "colour = 1"}, r"unknown key 'colour' \(value 1\): known here are name, root, images"),
        ({"head": "name = "}, r"rover\.rille\.toml is not TOML: "),
        ({"text": "[images.more]\n"}, r"unknown key 'images\.more'"),
        ({"text": "[times]\nrate_hz = 1.0\nnames = true\n"}, "times: give one of file, names = true or rate_hz"),
        ({"text": "[world]\npitch_deg = 3.0\nup = [0, 0, 1]\n"}, r"world\.up and world\.pitch_deg both state"),
        ({"text": '[world]\ncrs = "EPSG:32633"\n'}, r"world\.origin and world\.azimuth_deg missing"),
        ({"text": "[world]\nup = [0, 0, 0]\n"}, r"world\.up = \[0\.0, 0\.0, 0\.0\] has no direction"),
        ({"text": "[vehicle]\nmax_step = 0.5\n"}, r"vehicle: max_step 0\.5 m is higher than clearance 0\.2 m"),
        ({"text": "[vehicle]\nmax_steps = 0.5\n"}, r"unknown key 'vehicle\.max_steps'.*'vehicle\.max_step'"),
    ],
)
def test_bad_manifests(tmp_path, parts, message):
    path = write_sequence(tmp_path, **parts)
    with pytest.raises(InputError, match=message) as caught:
        opened(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            'left = "lft/*.png"\nright = "right/*.png"',
            r"images\.left = 'lft/\*\.png' finds no file in .*correct the pat",
        ),
        ('left = "*/*.png"\nright = "right/*.png"', "images.left and images.right both find"),
        ('left = "/left/*.png"\nright = "right/*.png"', r"images\.left = '/left/\*\.png' is no pattern"),
        ('left = "left/*.png"', r"images\.right is missing"),
        ('left = "left/*.png"\nright = "right/00.png"', r"01\.png has no partner by name .*; 3 left, 1 right"),
        ('left = "left/*.png"\nright = "right/*.png"\npair = "size"', r"images\.pair = 'size' is not permitted"),
    ],
)
def test_bad_patterns(tmp_path, line, message):
    path = write_sequence(tmp_path)
    path.write_text(f"[images]\n{line}\n")
    with pytest.raises(InputError, match=message):
        opened(path)


@pytest.mark.parametrize(
    ("parts", "line"),
    [
        ({"rig": "[rig]\nbaseline = 5.4\n"}, r"baseline 5\.4 m is unusual \(0\.02 to 2 m is common\)"),
        ({"cameras": "[cameras]\nfx = 0.004\ncx = 31.5\ncy = 23.5\n"}, r"fx = 0\.004 px gives an angle of view of 180"),
        (
            {"cameras": "[cameras]\nfx = 60.0\ncx = 315.0\ncy = 23.5\n"},
            r"principal point \(315, 23\.5\) px is far from",
        ),
        ({"cameras": CAMERAS + "fy = 120.0\n"}, r"fx = 60 and fy = 120 px differ much"),
    ],
)
def test_unusual_figures_are_warnings(tmp_path, parts, line):
    warnings = opened(write_sequence(tmp_path, **parts)).warnings
    assert any(re.search(line, w) for w in warnings)
    assert len(warnings) <= 2


def test_missing_manifest(tmp_path):
    with pytest.raises(InputError, match=r"manifest .*no\.toml cannot be read"):
        read_manifest(tmp_path / "no.toml")


def test_every_key_is_described():
    kinds = [Manifest, *(table for field in Manifest.model_fields.values() for table in tables(field.annotation))]
    fields = [(kind, name, field) for kind in kinds for name, field in kind.model_fields.items()]
    assert not [(k, name) for k, name, field in fields if field.description is None and not tables(field.annotation)]
    assert {"rig.baseline", "cameras.left.fx", "vehicle.max_step", "times.rate_hz"} <= set(known_keys())


def test_nested_defaults_become_dotted():
    assert dotted({"a": {"b": {"c": 1}, "d": 2}, "e.f": 3}) == [("a.b.c", 1), ("a.d", 2), ("e.f", 3)]
