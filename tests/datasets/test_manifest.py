"""Manifests: what they open to, and the one line that each kind of bad input gives."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from inspect import getdoc
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w
from folders import CAMERAS, write_images, write_lines, write_sequence
from raising import raises

from rille.datasets.georeference import Georeference
from rille.datasets.images.files import Digests
from rille.datasets.inspection.folder import inspect
from rille.datasets.manifest import model
from rille.datasets.manifest.model import Manifest, read_manifest
from rille.datasets.manifest.opening import dotted, open_manifest
from rille.datasets.protocol import Sequence
from rille.datasets.registry import open_sequence
from rille.datasets.text.validation import known_keys, tables
from rille.stages.geometry.geometry import RigidTransform, rotation_exp


def opened(path: Path) -> Sequence:
    return open_manifest(path, Digests())


def tum(t: float, x: float) -> str:
    return f"{t} {x} 0 0 0 0 0 1"


# -- what it opens to --------------------------------------------------------------------------------------------------


BASE = 1_600_000_000
"""s; an afternoon of 2020."""


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
"keyframes.stride" = 1
"""
    s = opened(write_sequence(tmp_path, text, head='name = "dune"\nnotes = ["dusty"]'))
    assert (s.name, s.times, s.notes) == ("dune", (0.0, 0.25, 0.5), ("dusty",))
    assert s.pitch == pytest.approx(math.radians(20))
    assert s.vehicle is not None
    assert (s.vehicle.name, s.vehicle.max_step, s.vehicle.track) == ("crawler", 0.05, 0.6)
    assert s.defaults == {"locus.cell_size": 0.02, "keyframes.stride": 1}


def test_root_may_name_a_variable(tmp_path, monkeypatch):
    write_sequence(tmp_path / "data" / "a")
    path = tmp_path / "elsewhere.toml"
    path.write_text('root = "${ROVERS}/a"\n' + (tmp_path / "data" / "a" / "rover.rille.toml").read_text())
    monkeypatch.setenv("ROVERS", str(tmp_path / "data"))
    s = opened(path)
    assert (s.name, s.frames) == ("elsewhere", 3)
    monkeypatch.setenv("ROVERS", str(tmp_path / "nothing"))
    with raises("RIL-215", "elsewhere.toml"):
        opened(path)
    monkeypatch.delenv("ROVERS")
    with raises("RIL-214"):
        opened(path)


def test_name_of_a_plain_manifest_is_its_folders(tmp_path):
    write_sequence(tmp_path / "sands").rename(tmp_path / "sands" / "manifest.toml")
    assert opened(tmp_path / "sands" / "manifest.toml").name == "sands"


def test_relative_pose_may_be_stated(tmp_path):
    T = RigidTransform(rotation_exp([0.0, 0.05, 0.01]), np.array([-0.2, 0.01, 0.0]))
    rig = f"[rig]\nT_right_left = {np.round(T.matrix34, 15).tolist()}\n"
    s = opened(write_sequence(tmp_path, rig=rig))
    np.testing.assert_allclose(s.rig.T_right_left.matrix34, T.matrix34, atol=1e-12)


def test_a_rig_that_is_pinned_is_used_as_it_is(tmp_path):
    given = opened(write_sequence(tmp_path / "a")).rig
    T = RigidTransform(rotation_exp([0.01, 0.0, 0.0]), np.array([-0.1, 0.001, 0.0]))
    (tmp_path / "rig.toml").write_text(tomli_w.dumps({"rig": replace(given, T_right_left=T).to_dict()}))
    manifest = write_sequence(tmp_path / "b", rig='[rig]\nfile = "../rig.toml"\n')
    pinned = opened(manifest)
    np.testing.assert_array_equal(pinned.rig.T_right_left.matrix34, T.matrix34)
    assert pinned.defaults["rig.mode"] == "fixed"
    other = given.to_dict() | {"left": given.left.to_dict() | {"fx": 61.0}}
    (tmp_path / "rig.toml").write_text(tomli_w.dumps({"rig": other}))
    with raises("RIL-021"):
        opened(manifest)
    (tmp_path / "rig.toml").write_text("a = 1\n")
    with raises("RIL-022"):
        opened(manifest)


def test_distortion_gives_lenses(tmp_path):
    cameras = CAMERAS + "distortion = [-0.3, 0.1, 0.0, 0.0]\n"
    s = opened(write_sequence(tmp_path, cameras=cameras))
    assert s.lenses is not None
    assert {c: (lens.model, lens.coefficients) for c, lens in s.lenses.items()} == dict.fromkeys(
        ("left", "right"), ("radtan", (-0.3, 0.1, 0.0, 0.0))
    )


INFO = """image_width: 64
image_height: 48
camera_matrix: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients: [-0.3, 0.1, 0, 0, 0]
rectification_matrix: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix: [55, 0, 30, {shift}, 0, 55, 24, 0, 0, 0, 1, 0]
"""


@pytest.mark.parametrize(
    ("places", "more", "rectified"),
    [
        ("{side}", "", False),
        ("image_rect/{side}", "", True),
        ("{side}_rectified", "", True),
        ("{side}/imageRect", "", True),
        ("unrectified/{side}", "", False),
        ("{side}_corrected", "", False),
        ("rectangle/{side}", "", False),
        ("image_rect/{side}", "rectified = false", False),
        ("{side}", "rectified = true", True),
    ],
)
def test_distortion_is_not_taken_off_twice(tmp_path, places, more, rectified):
    """A camera_info has both cameras: K and D are those of raw images, P is that of the rectified ones."""
    for k, side in enumerate(("left", "right")):
        folder = tmp_path / places.format(side=side)
        folder.mkdir(parents=True)
        cv2.imwrite(str(folder / "00.png"), np.full((48, 64), 9, np.uint8))
        (tmp_path / f"{side}.yaml").write_text(INFO.format(shift=-5.5 * k))
    left, right = (f"{places.format(side=side)}/*.png" for side in ("left", "right"))
    lines = [f'images = {{ left = "{left}", right = "{right}"{f", {more}" if more else ""} }}']
    (tmp_path / "m.toml").write_text("\n".join([*lines, 'cameras = { left = "left.yaml", right = "right.yaml" }']))
    s = opened(tmp_path / "m.toml")
    assert s.rig.baseline == pytest.approx(0.1)
    assert (s.rig.left.fx, s.lenses is None) == ((55, True) if rectified else (60, False))
    assert any("RIL-817" in line for line in s.warnings) == (rectified and not more)


@pytest.mark.parametrize(("baseline", "told"), [(0.1, False), (0.1005, False), (0.102, True), (0.098, True)])
def test_another_baseline_than_that_of_the_calibration_is_told(tmp_path, baseline, told):
    for k, side in enumerate(("left", "right")):
        (tmp_path / f"{side}.yaml").write_text(INFO.format(shift=-5.5 * k))
    cameras = '[cameras]\nleft = "left.yaml"\nright = "right.yaml"\n'
    s = opened(write_sequence(tmp_path, cameras=cameras, rig=f"[rig]\nbaseline = {baseline}\n"))
    assert s.rig.baseline == pytest.approx(baseline)
    assert any("RIL-693" in line for line in s.warnings) == told


def test_a_baseline_beside_a_calibration_that_turns_a_camera_replaces_its_length_alone(tmp_path):
    R = rotation_exp([0.01, 0.05, 0.0])
    camera = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "R": R.tolist(), "T": [-200.0, 3.0, 0.0]}  # mm
    (tmp_path / "rig.json").write_text(json.dumps(camera))
    s = opened(write_sequence(tmp_path, cameras='[cameras]\nfile = "rig.json"\n', rig="[rig]\nbaseline = 0.2\n"))
    assert s.rig.baseline == pytest.approx(0.2)
    np.testing.assert_allclose(s.rig.T_right_left.rotation, R, atol=1e-9)
    np.testing.assert_allclose(s.rig.T_right_left.translation[1] / s.rig.T_right_left.translation[0], -0.015)


def test_a_distortion_without_projection_is_refused(tmp_path):
    path = write_sequence(tmp_path, cameras=CAMERAS + "distortion = [-0.3, 0.1, 0, 0]\n")
    path.write_text(path.read_text().replace("[images]", "[images]\nrectified = true"))
    with raises("RIL-816", "rectified"):
        opened(path)


def test_cameras_may_differ(tmp_path):
    cameras = (
        "[cameras.left]\nfx = 60.0\ncx = 31.5\ncy = 23.5\n[cameras.right]\nfx = 61.0\nfy = 62.0\ncx = 30.0\ncy = 23.0\n"
    )
    rig = opened(write_sequence(tmp_path, cameras=cameras)).rig
    assert (rig.left.fx, rig.left.fy, rig.right.fx, rig.right.fy, rig.right.cx) == (60, 60, 61, 62, 30)


@pytest.mark.parametrize(
    ("right", "said"), [("", 1), ("distortion = [0, 0, 0, 0]\n", 0), ("distortion = [0.1, 0, 0, 0]\n", 0)]
)
def test_a_distortion_of_one_camera_alone_is_said(tmp_path, right, said):
    figures = "fx = 60.0\ncx = 31.5\ncy = 23.5\n"
    cameras = f"[cameras.left]\n{figures}distortion = [0.1, 0, 0, 0]\n[cameras.right]\n{figures}{right}"
    lines = opened(write_sequence(tmp_path, cameras=cameras)).warnings
    assert ["RIL-105" in line and "right" in line for line in lines] == [True] * said


@pytest.mark.parametrize(("names", "said"), [("", 1), ('names = ["cam0", "cam2"]\n', 0)])
def test_two_of_several_cameras_are_told(tmp_path, names, said):
    one = "{}:\n  camera_model: pinhole\n  intrinsics: [60, 60, 31.5, 23.5]\n  distortion_model: radtan\n"
    one += "  distortion_coeffs: [0, 0, 0, 0]\n  resolution: {}\n"
    link = "  T_cn_cnm1: [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    chain = [one.format("cam0", [64, 48]), one.format("cam1", [640, 480]) + link, one.format("cam2", [64, 48]) + link]
    (tmp_path / "chain.yaml").write_text("".join(chain))
    s = opened(write_sequence(tmp_path, cameras=f'[cameras]\nfile = "chain.yaml"\n{names}', rig=""))
    assert s.rig.baseline == pytest.approx(0.2)
    assert ["cam0 is taken as the left and cam2" in line for line in s.warnings if "RIL-719" in line] == [True] * said


def smaller_right_images(folder: Path) -> Path:
    """A sequence whose left images have 64 x 48 pixels and whose right ones half as many a side."""
    manifest = write_sequence(folder)
    for path in sorted(folder.rglob("*.png")):
        if "right" in str(path.relative_to(folder)):
            cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[::2, ::2])
    return manifest


def test_two_cameras_may_have_two_sizes_of_images(tmp_path):
    manifest = smaller_right_images(tmp_path)
    with raises("RIL-960", "64 x 48", "32 x 24"):
        opened(manifest)
    both = "[cameras.left]\nfx = 60.0\ncx = 31.5\ncy = 23.5\n[cameras.right]\nfx = 30.0\ncx = 15.5\ncy = 11.5\n"
    manifest.write_text(manifest.read_text().replace(CAMERAS, both))
    sequence = opened(manifest)
    assert [(c.width, c.height) for c in (sequence.rig.left, sequence.rig.right)] == [(64, 48), (32, 24)]
    taken = [sequence.image(0, camera).args for camera in ("left", "right")]
    assert [(args["header"]["width"], args["header"]["height"]) for args in taken] == [(64, 48), (32, 24)]


def test_a_calibration_that_states_two_sizes_is_that_of_images_of_two_sizes(tmp_path):
    manifest = smaller_right_images(tmp_path)
    manifest.write_text(manifest.read_text().replace(CAMERAS, '[cameras]\nfile = "rig.yaml"\n'))
    rig = """%YAML:1.0
image_size1: [64, 48]
image_size2: [{}]
M1: [60., 0., 31.5, 0., 60., 23.5, 0., 0., 1.]
D1: [0., 0., 0., 0.]
M2: [30., 0., 15.5, 0., 30., 11.5, 0., 0., 1.]
D2: [0., 0., 0., 0.]
R: [1., 0., 0., 0., 1., 0., 0., 0., 1.]
T: [-0.1, 0., 0.]
"""
    (tmp_path / "rig.yaml").write_text(rig.format("32, 24"))
    assert opened(manifest).rig.right.width == 32
    (tmp_path / "rig.yaml").write_text(rig.format("64, 48"))
    with raises("RIL-131", "64 x 48", "32 x 24"):
        opened(manifest)


def test_direction_of_up_is_that_of_the_left_camera_where_no_file_states_another(tmp_path):
    s = opened(write_sequence(tmp_path, "[world]\nup = [0, -2, 0]\n"))
    assert s.up == ((0.0, -1.0, 0.0),) * 3
    assert s.georeference is None


def test_place_on_earth(tmp_path):
    place = 'crs = "EPSG:32633"\norigin = [500100.0, 5200200.0, 1800.0]\nazimuth_deg = 90.0\n'
    s = opened(write_sequence(tmp_path, f"[world]\n{place}"))
    assert s.georeference == Georeference("EPSG:32633", (500100.0, 5200200.0, 1800.0), math.pi / 2)


@pytest.mark.parametrize(
    ("left", "right"), [("left", "right/"), ("left/*.PNG", "right/??.png"), ("my [left]/*.png", "my [[]right]/*.png")]
)
def test_folders_brackets_and_the_case_of_suffixes_in_patterns(tmp_path, left, right):
    path = write_sequence(tmp_path)
    (tmp_path / "left" / "01.png").rename(tmp_path / "left" / "01.PNG")
    for side in ("left", "right"):
        (tmp_path / side / "notes.txt").write_text("none")
        (tmp_path / f"my [{side}]").symlink_to(side)
    path.write_text(path.read_text().replace("left/*.png", left).replace("right/*.png", right))
    s = opened(path)
    assert (s.frames, s.lost) == (3, {})


# -- times -------------------------------------------------------------------------------------------------------------


def test_times_of_a_file_in_order_or_by_name(tmp_path):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n')
    write_lines(tmp_path / "t.txt", ["0.0", "0.5", "1.0"])
    assert opened(path).times == (0.0, 0.5, 1.0)
    write_lines(tmp_path / "t.txt", ["# stamp file", "9.0 99.png", "10.0 00.png", "10.5 01.png", "11.0 02.png"])
    assert opened(path).times == (10.0, 10.5, 11.0)
    write_lines(tmp_path / "t.txt", ['"name";"time"', '"1.5"', '"2.5"', '"3.5"'])
    assert opened(path).times == (1.5, 2.5, 3.5)


@pytest.mark.parametrize(
    "lines",
    [
        ["00.png 10.0", "01.png 10.5", "02.png 11.0"],
        ["filename,timestamp", "left/02.png,11.0", "left/01.png,10.5", "left/00.png,10.0"][::-1],
        ["#frame;time [s];image name", *(f"{k};{10 + k / 2};C:\\x\\0{k}.jpg" for k in range(3))],
        ["index time", "0 10.0", "1 10.5", "2 11.0"],
        ["0 10.0", "1 10.5", "2 11.0"],
        ["0 left/00.png 10.0", "1 left/01.png 10.5", "2 left/02.png 11.0"],
        ["1970-01-01 02:00:10+02:00", "1969-12-31T19:00:10.5-05:00", "1970-01-01 01:00:11 +0100"],
        ["1970-01-01 00:00:10.000000000", "1970-01-01T00:00:10.5Z", "19700101_000011"],
    ],
)
def test_tables_of_times_of_other_programs(tmp_path, lines):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n')
    write_lines(tmp_path / "t.txt", lines)
    assert opened(path).times == (10.0, 10.5, 11.0)


@pytest.mark.parametrize(
    ("step", "unit", "warned"), [(100, "", True), (100, "s", False), (100.5, "", False), (5, "", False)]
)
def test_whole_numbers_of_times_that_are_far_apart_may_be_milliseconds(tmp_path, step, unit, warned):
    write_lines(tmp_path / "times.txt", [str(k * step) for k in range(3)])
    stated = f'unit = "{unit}"' if unit else ""
    s = open_manifest(write_sequence(tmp_path, f'[times]\nfile = "times.txt"\n{stated}'), Digests())
    assert any("RIL-718" in line for line in s.warnings) == warned
    assert s.times[1] == step


def test_the_title_of_a_column_of_times_states_their_unit(tmp_path):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n')
    write_lines(tmp_path / "t.txt", ["time_ms,image", "0,00.png", "500,01.png", "1000,02.png"])
    assert opened(path).times == (0.0, 0.5, 1.0)
    write_lines(tmp_path / "t.txt", ["time [msec]", "0", "500", "1000"])
    assert opened(path).times == (0.0, 0.5, 1.0)
    write_lines(path, [path.read_text() + 'unit = "s"'])
    assert opened(path).times == (0.0, 500.0, 1000.0)


@pytest.mark.parametrize("lines", [["0.0 7", "1.0 8", "2.0 9"], ["0 a", "1 b", "2 c"]])
def test_seconds_that_count_stay_times(tmp_path, lines):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n')
    write_lines(tmp_path / "t.txt", lines)
    assert opened(path).times == (0.0, 1.0, 2.0)


def test_seconds_and_nanoseconds_in_two_columns_are_one_time(tmp_path):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n')
    for head in ([], ["# secs nsecs"]):
        write_lines(tmp_path / "t.txt", [*head, "1400000000 900000000", "1400000002 0", "1400000003 100000000"])
        assert opened(path).times == pytest.approx((1400000000.9, 1400000002.0, 1400000003.1), abs=1e-6)
    write_lines(tmp_path / "t.txt", ["sec,nanosec", "1400000000,900000000", "1400000002,0", "1400000003,100000000"])
    assert opened(path).times == pytest.approx((1400000000.9, 1400000002.0, 1400000003.1), abs=1e-6)


def test_a_table_of_other_images_is_refused(tmp_path):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n')
    write_lines(tmp_path / "t.txt", ["0.0 07.png", "0.5 08.png", "1.0 09.png"])
    with raises("RIL-229", "none of 00"):
        opened(path)


def test_a_pair_that_lost_its_image_needs_no_time(tmp_path):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n', frames=4)
    (tmp_path / "left" / "01.png").unlink()
    write_lines(tmp_path / "t.txt", ["0.0 00.png", "1.0 02.png", "1.5 03.png", "2.0 04.png"])
    assert opened(path).times == (0.0, 0.5, 1.0, 1.5)


def test_dates_in_names_are_times_and_counts_are_not(tmp_path):
    for k, name in enumerate(["20240229_235959_750", "20240301_000000_250", "20240301_000000_750"]):
        write_images(tmp_path, [f"{side}/{name}.png" for side in ("left", "right")])
        write_images(tmp_path, [f"count/{side}/{k:03d}.png" for side in ("left", "right")])
    path = write_sequence(tmp_path, "[times]\nnames = true\n", frames=0)
    times = opened(path).times
    assert times is not None
    assert [t - times[0] for t in times] == [0.0, 0.5, 1.0]
    path = write_sequence(tmp_path / "count", "[times]\nnames = true\n", frames=0)
    with raises("RIL-227", "000.png", 'times.unit = "s"'):
        opened(path)
    path.write_text(path.read_text() + 'unit = "s"\n')
    assert opened(path).times == (0.0, 1.0, 2.0)


def test_numbers_without_a_leading_zero_are_no_hidden_files(tmp_path):
    path = write_sequence(tmp_path, frames=4)
    for side in ("left", "right"):
        for k, name in enumerate((".75", ".5", "1.25", ".tmp")):
            (tmp_path / side / f"{k:02d}.png").rename(tmp_path / side / f"{name}.png")
    assert [opened(path).image(k, "left").hints["path"].rpartition("/")[2] for k in range(3)] == [
        ".5.png",
        ".75.png",
        "1.25.png",
    ]
    assert opened(path).frames == 3


def test_times_of_names(tmp_path):
    names = [f"{side}/{1_500_000_000 + k}.5.png" for k in range(3) for side in ("left", "right")]
    path = write_sequence(tmp_path, "[times]\nnames = true\n", frames=0)
    write_images(tmp_path, names)
    assert opened(path).times == (1_500_000_000.5, 1_500_000_001.5, 1_500_000_002.5)


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (["0.0", "0.5"], ("RIL-229", "t.txt")),
        (["1500000000.0", "1500000000500000000", "1500000001000000000"], ("RIL-292", "t.txt")),
        (["0.0", "0.5", "0.5"], ("RIL-293", "t.txt")),
        (["0.0", "NaN", "0.5"], ("RIL-291", "line 2")),
        (["# Nantes", "0.0", "0.1", "inf"], ("RIL-291", "line 4")),
    ],
)
def test_bad_times(tmp_path, lines, expected):
    path = write_sequence(tmp_path, '[times]\nfile = "t.txt"\n')
    write_lines(tmp_path / "t.txt", lines)
    with raises(*expected):
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


COLMAP = """# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
7 {half} 0 {half} 0 0 0 -2 1 {folder}02.png
1 2 3 4 5 6 7 8 9 1.5 2.5 -1
3 1 0 0 0 0 0 0 1 {folder}00.png

4 1 0 0 0 -0.3 0 0 2 right/00.png
1.5 2.5 -1
"""


@pytest.mark.parametrize("folder", ["left/", "", "other/"])
def test_truth_of_colmap_is_that_of_the_images_that_it_names(tmp_path, folder):
    path = write_sequence(tmp_path, '[truth]\nfile = "images.txt"\n')
    (tmp_path / "images.txt").write_text(COLMAP.format(half=math.sqrt(0.5), folder=folder))
    if folder == "other/":
        with raises("RIL-975", "02.png"):
            opened(path)
        return
    first, second, third = opened(path).truth
    assert second is None
    np.testing.assert_allclose(first.matrix34, np.eye(3, 4))
    # x_camera = R x_world + t: a quarter turn about y, and the world's origin 2 m behind.
    np.testing.assert_allclose(third.matrix34, [[0, 0, -1, -2], [0, 1, 0, 0], [1, 0, 0, 0]], atol=1e-9)


def test_poses_of_colmap_are_named_to_whoever_has_to_know_their_scale(tmp_path):
    write_sequence(tmp_path)
    (tmp_path / "images.txt").write_text(COLMAP.format(half=math.sqrt(0.5), folder="left/"))
    found = inspect(tmp_path)
    assert "truth" not in found.tables
    assert any("poses by COLMAP" in line and "[truth]" in line for line in found.unread)


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
    ("columns", "header", "times"),
    [
        ("", "time,x,y", (0.0, 0.5, 1.0)),
        ("", "Northing [m];Easting [m];t_ms;Height", (0.0, 0.5, 1.0)),
        ('columns = { time = "GPS week s", x = "to E", y = "to N" }', "sats,GPS week s,to N,to E", (0.0, 0.5, 1.0)),
        ("columns = { time = 3, y = 1, x = 2 }", "", (0.0, 0.5, 1.0)),
        ("", "x y z", None),
        ('columns = { x = "x", y = "z" }', "x,y,z", None),
    ],
)
def test_truth_of_positions_alone(tmp_path, columns, header, times):
    path = write_sequence(tmp_path, f'[times]\nrate_hz = 1.0\n[truth]\nfile = "p.csv"\nmax_gap = 1.0\n{columns}\n')
    rows = {
        "time,x,y": ["0,5,7", "0.5,6,8", "1,7,9"],
        "Northing [m];Easting [m];t_ms;Height": ["7;5;0;3", "8;6;500;3", "9;7;1000;3"],
        "sats,GPS week s,to N,to E": ["9,0,7,5", "8,0.5,8,6", "9,1,9,7"],
        "": ["7 5 0", "8 6 0.5", "9 7 1"],
        "x y z": ["5 7 3", "6 8 3", "7 9 3"],
        "x,y,z": ["5,3,7", "6,3,8", "7,3,9"],
    }[header]
    write_lines(tmp_path / "p.csv", [*([header] if header else []), *rows])
    s = opened(path)
    found = s.truth_positions
    assert s.truth is None
    assert found is not None
    assert found.times == times
    assert [row[:2] for row in found.positions] == [(5, 7), (6, 8), (7, 9)]
    assert {len(row) for row in found.positions} == {3 if header == "x y z" or "Height" in header else 2}
    assert "p.csv" in s.truth_source


def test_unit_and_lever_arm_of_the_truth(tmp_path):
    text = '[times]\nrate_hz = 1.0\n[truth]\nfile = "p.txt"\nunit = 0.001\n'
    write_lines(tmp_path / "p.txt", [tum(0, 1500), tum(1, 2500), tum(2, 3500)])
    mount = "T_body_left = [[1,0,0,0],[0,1,0,0],[0,0,1,2]]\n"
    s = opened(write_sequence(tmp_path, text + mount))
    assert [pose.translation.tolist() for pose in s.truth] == [[x, 0.0, 2.0] for x in (1.5, 2.5, 3.5)]
    assert s.truth_mount.translation.tolist() == [0.0, 0.0, 2.0]
    arm, sigma = "lever_arm = [0.1, -0.2, 0.3]\n", "sigma_m = 0.02\nsigma_deg = 0.1\n"
    assert (s.truth_sigma_m, s.truth_sigma_rad) == (0.0, 0.0)
    stated = opened(write_sequence(tmp_path, text + sigma))
    assert (stated.truth_sigma_m, stated.truth_sigma_rad) == pytest.approx((0.02, math.radians(0.1)))
    with raises("RIL-782", "p.txt", "T_body_left"):
        opened(write_sequence(tmp_path, text + arm))
    write_lines(tmp_path / "p.txt", ["x y", "1000 0", "2000 0", "3000 0"])
    with raises("RIL-807", "p.txt", "sigma_deg"):
        opened(write_sequence(tmp_path, text + sigma))
    found = opened(write_sequence(tmp_path, text + arm)).truth_positions
    assert found.positions == ((1.0, 0.0), (2.0, 0.0), (3.0, 0.0))
    assert found.to_dict()["lever_arm"] == (0.1, -0.2, 0.3)


def test_poses_that_are_numbered_by_frame_belong_to_the_numbers_in_the_names(tmp_path):
    """Rows of a frame's number and a 3 x 4 matrix, as KITTI-360 has them."""
    write_lines(tmp_path / "p.txt", [f"{k} 1 0 0 {k}.5 0 1 0 0 0 0 1 0" for k in (0, 2)])
    path = write_sequence(tmp_path, '[times]\nnames = true\nunit = "s"\n[truth]\nfile = "p.txt"\n')
    assert [pose and pose.translation[0] for pose in opened(path).truth] == [0.5, None, 2.5]


def test_true_positions_are_those_of_the_body_that_the_camera_stands_in(tmp_path):
    write_lines(tmp_path / "p.csv", ["time,x,y", "0,1,2", "0.1,2,3", "0.2,3,4"])
    mount = "T_body_left = [[0,0,1,2],[-1,0,0,0],[0,-1,0,0.5]]\n"
    text = f'[times]\nrate_hz = 10\n[truth]\nfile = "p.csv"\n{mount}'
    assert opened(write_sequence(tmp_path, text)).truth_positions.lever_arm == (0.0, 0.5, -2.0)


@pytest.mark.parametrize(
    ("more", "lines", "expected"),
    [
        ("", ["1 2 3", "2 3 4"], ("RIL-805", "3 without names")),
        ('columns = { x = "E" }', ["time,x,y", "0,1,2"], ("RIL-806", "'E'", "time, x, y")),
        ("", ["x,y", "1,2", "2,3"], ("RIL-803", "2 positions for 3 pairs")),
        ("", ["time,x,y", "0,1,2", "1,2,3"], ("RIL-804", "0.5 s", "1 s apart")),
        ("", ["time,x,y", "44087.1,1,2", "44087.2,2,3"], ("RIL-269", "44087.100")),
        ("", ["time,x,y", "0,1,?", "1,2,3"], ("RIL-284", "line 2")),
    ],
)
def test_bad_truth_of_positions_alone(tmp_path, more, lines, expected):
    path = write_sequence(tmp_path, f'[times]\nrate_hz = 1.0\n[truth]\nfile = "p.csv"\n{more}\n')
    write_lines(tmp_path / "p.csv", lines)
    with raises(*expected):
        opened(path)


ONE = "1 0 0 {} 0 1 0 0 0 0 1 0"


@pytest.mark.parametrize("stamps", ["", "[times]\nrate_hz = 10\n", '[times]\nfile = "t.txt"\n'])
@pytest.mark.parametrize("row", ["{0} " + ONE, "{0} " + ONE + " 0 0 0 1", "{0} {1} 0 0 0 0 0 1"])
def test_poses_by_the_numbers_of_the_images(tmp_path, stamps, row):
    """As in KITTI-360: a number stands in place of a time, and not all images have a pose."""
    write_lines(tmp_path / "t.txt", [f"2013-05-28 08:46:0{k}.904512000" for k in range(6)])
    path = write_sequence(tmp_path, stamps + '[truth]\nfile = "p.txt"\n', frames=6)
    numbers = [1, 2, 4, 5]
    row = row.replace("{}", "{1}")
    write_lines(tmp_path / "p.txt", [row.format(k, 0.5 * k) for k in numbers])
    s = opened(path)
    assert s.truth is not None
    assert {k: pose.translation[0] for k, pose in enumerate(s.truth) if pose} == {k: 0.5 * k for k in numbers}
    assert any("numbers" in note for note in s.notes)


@pytest.mark.parametrize("rate", [1.0, 2.0])
def test_whole_seconds_stay_times(tmp_path, rate):
    text = f'[times]\nrate_hz = {rate}\n[truth]\nfile = "p.txt"\n'
    path = write_sequence(tmp_path, text, frames=5)
    write_lines(tmp_path / "p.txt", [tum(k, 7 + k) for k in range(5)])
    s = opened(path)
    assert s.truth is not None
    assert [pose and pose.translation[0] for pose in s.truth] == [
        7 + k / rate if k % rate == 0 else None for k in range(5)
    ]


@pytest.mark.parametrize(
    ("name", "first", "step", "said"),
    [("epoch", 1.7e9, 0.1, True), ("clock", 1_700_000_000, 1, True), ("frame", 0, 5, False), ("v", 1.5, 0, False)],
)
@pytest.mark.parametrize("pose", ["x,y,z,qx,qy,qz,qw", "x,y,z"])
def test_a_column_that_may_be_the_time_is_told(tmp_path, pose, name, first, step, said):
    path = write_sequence(tmp_path, '[times]\nrate_hz = 1\n[truth]\nfile = "p.csv"\n', frames=5)
    rest = ",0,0,0,1" * ("q" in pose)
    write_lines(tmp_path / "p.csv", [f"{name},{pose}", *(f"{first + k * step},{7 - k},0,0{rest}" for k in range(5))])
    s = opened(path)
    assert s.truth or s.truth_positions
    assert [name in line for line in s.warnings if "RIL-717" in line] == [True] * said


@pytest.mark.parametrize(
    ("columns", "unread"),
    [
        ("rx,ry,rz", "rx, ry, rz"),
        ("rvec_0,rvec_1,rvec_2", "rvec_0"),
        ("qx,qy,qz", "qx"),
        ("r11,r21,r31,r12,r22,r32,r13,r23,r33", "r11, r21"),
        ("heading [deg],fix,v", "heading [deg]"),
        ("vx,vy,sats", ""),
        (".header.seq,steering_angle,axis", ""),
    ],
)
def test_rotations_that_are_not_read_are_told(tmp_path, columns, unread):
    path = write_sequence(tmp_path, '[times]\nrate_hz = 1\n[truth]\nfile = "p.csv"\nmax_gap = 1\n')
    zeros = ",1" * (columns.count(",") + 1)
    write_lines(tmp_path / "p.csv", [f"time,x,y,z,{columns}", *(f"{k},{k},0,0{zeros}" for k in range(3))])
    s = opened(path)
    assert s.truth_positions is not None
    assert [unread in line for line in s.warnings if "RIL-749" in line] == [True] * bool(unread)
    path.write_text(path.read_text() + 'columns = { x = "x", y = "y", time = "time" }\n')
    assert not opened(path).warnings


@pytest.mark.parametrize(
    ("text", "lines", "expected"),
    [
        ('[truth]\nfile = "p.txt"\n', ["1 0 0 0 0 1 0 0 0 0 1 0"], ("RIL-230",)),
        (
            '[truth]\nfile = "p.txt"\n',
            ["frame time,qw,qx,qy,qz", "7,1,0,0,0"],
            ("RIL-230", "frame time", "is called time"),
        ),
        ('[truth]\nfile = "p.txt"\n', [tum(0, 0), tum(0.5, 1)], ("RIL-231", "p.txt", "[ti")),
        ('[truth]\nfile = "p.txt"\n', [tum(7, 0), tum(8, 1)], ("RIL-231", "p.txt", "[ti")),
        ('[truth]\nfile = "nothing.txt"\n', [], ("RIL-138", "nothing.txt")),
    ],
)
def test_bad_truth(tmp_path, text, lines, expected):
    path = write_sequence(tmp_path, text)
    write_lines(tmp_path / "p.txt", lines)
    with raises(*expected):
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
    with raises("RIL-232", "[times]"):
        opened(write_sequence(tmp_path, text))


def test_a_baseline_of_two_stations_far_apart_is_read_where_its_unit_is_stated(tmp_path):
    rig = "[rig]\nbaseline = 97\n"
    with raises("RIL-244", "0.097 or 0.97", "rig.unit = 1"):
        opened(write_sequence(tmp_path, rig=rig))
    assert opened(write_sequence(tmp_path, rig=rig + "unit = 1\n")).rig.baseline == pytest.approx(97.0)


@pytest.mark.parametrize(("file", "unit", "doubted"), [(3.9, "", True), (3.9, "unit = 1\n", False), (0.5, "", False)])
def test_a_baseline_that_may_be_squares_of_a_chessboard_is_doubted(tmp_path, file, unit, doubted):
    rows = f"100 0 31.5 0 0 100 23.5 0 0 0 1 0\n100 0 31.5 {-100 * file} 0 100 23.5 0 0 0 1 0\n"
    (tmp_path / "calib.txt").write_text(rows)
    sequence = opened(write_sequence(tmp_path, cameras='[cameras]\nfile = "calib.txt"\n', rig=f"[rig]\n{unit}"))
    assert [line for line in sequence.warnings if "square of the chessboard" in line] == [*sequence.warnings][:doubted]
    by_name = open_sequence(str(tmp_path / "rover.rille.toml"))
    assert [line.split(": ")[1] for line in by_name.warnings] == [str(tmp_path / "rover.rille.toml")] * doubted


def test_a_unit_that_the_file_and_the_manifest_state_is_not_taken_twice(tmp_path):
    K, R = "[100, 0, 31.5, 0, 100, 23.5, 0, 0, 1]", "[1, 0, 0, 0, 1, 0, 0, 0, 1]"
    (tmp_path / "rig.yaml").write_text(f"unit: mm\nK1: {K}\nK2: {K}\nR: {R}\nT: [-97, 0, 0]\n")
    cameras = '[cameras]\nfile = "rig.yaml"\n'
    assert opened(write_sequence(tmp_path, cameras=cameras, rig="[rig]\n")).rig.baseline == pytest.approx(0.097)
    with raises("RIL-856", "9.7e-05 m by rig.unit = 0.001", "leave rig.unit out"):
        opened(write_sequence(tmp_path, cameras=cameras, rig="[rig]\nunit = 0.001\n"))


# -- bad input, one line each ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ({"rig": "[rig]\nbaseline = 97\n"}, ("RIL-244", "0.097 or 0.97")),
        ({"rig": "[rig]\nbaseline = -0.1\n"}, ("RIL-223", "-0.1")),
        (
            {"rig": "[rig]\nT_right_left = [[1,0,0],[0,1,0],[0,0,1]]\n"},
            ("RIL-223", "rig.T_right_left"),
        ),
        ({"rig": "[rig]\nT_right_left = [[2,0,0,-1],[0,1,0,0],[0,0,1,0]]\n"}, ("RIL-223", "rig.T_right_left")),
        ({"rig": "[rig]\nbaselin = 0.1\n"}, ("RIL-223", "'rig.baselin'", "0.1", "mean rig.baseline?")),
        ({"rig": ""}, ("RIL-241",)),
        ({"cameras": ""}, ("RIL-235",)),
        (
            {"cameras": "[cameras]\nfx = 60.0\ncx = 3.0\n"},
            ("RIL-223",),
        ),
        (
            {"cameras": "[cameras]\nfx = -60.0\ncx = 3.0\ncy = 3.0\n"},
            ("RIL-223", "cameras.fx", "-60.0"),
        ),
        ({"cameras": CAMERAS + 'file = "x.yaml"\n'}, ("RIL-223",)),
        ({"cameras": '[cameras]\nleft = "x.yaml"\n'}, ("RIL-223",)),
        (
            {"cameras": CAMERAS + "distortion = [0.1, 0.2, 0.3]\n"},
            ("RIL-370",),
        ),
        ({"cameras": CAMERAS + 'model = "fish"\n'}, ("RIL-223", "cameras.model", "'fish'", "'fisheye'")),
        (
            {"cameras": CAMERAS + "width = 640\nheight = 480\n"},
            ("RIL-131", "640 x 480", "64 x 48"),
        ),
        ({"cameras": '[cameras]\nfile = "nothing.yaml"\n'}, ("RIL-138", "nothing.yaml")),
        ({"head": "baseline = 0.1"}, ("RIL-223", "'baseline'", "0.1", "mean rig.baseline?")),
        ({"head": "colour = 1"}, ("RIL-223", "'colour'")),
        ({"head": "name = "}, ("RIL-026", "rover.rille.toml")),
        ({"text": "[images.more]\n"}, ("RIL-223", "'images.more'")),
        ({"text": "[positions]\nfile = 'x'\nsigma = -1\n"}, ("RIL-223", "positions.sigma = -1 is not")),
        ({"text": "[positions]\nfile = 'x'\nsigma = 1\ncolumns = { t = 1 }\n"}, ("RIL-223", "positions.columns.t = ")),
        ({"head": "name = 1" + 1000 * "0"}, ("RIL-223", "name = 100")),
        ({"text": "[times]\nrate_hz = 1.0\nnames = true\n"}, ("RIL-223", "rate_hz")),
        ({"text": "[world]\npitch_deg = 3.0\nup = [0, 0, 1]\n"}, ("RIL-223",)),
        ({"text": '[world]\ncrs = "EPSG:32633"\n'}, ("RIL-223", "azimuth_deg")),
        ({"text": "[world]\nup = [0, 0, 0]\n"}, ("RIL-223", "world.up", "0")),
        ({"text": "[vehicle]\nmax_step = 0.5\n"}, ("RIL-223", "max_step", "0.5", "0.2")),
        ({"text": "[vehicle]\nwidth = 0.5\n"}, ("RIL-223", "cameras.width", "known here are clearance", "track")),
        ({"text": "[vehicle]\nmax_steps = 0.5\n"}, ("RIL-223", "'vehicle.max_steps'", "mean vehicle.max_step?")),
    ],
)
def test_bad_manifests(tmp_path, parts, expected):
    path = write_sequence(tmp_path, **parts)
    with raises(*expected) as caught:
        opened(path)
    assert "\n" not in str(caught.value)
    assert "rille init" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (
            'left = "lft/*.png"\nright = "right/*.png"',
            ("RIL-217", "'lft/*.png'"),
        ),
        ('left = "*/*.png"\nright = "right/*.png"', ("RIL-218",)),
        ('left = "/left/*.png"\nright = "right/*.png"', ("RIL-217", "'/left/*.png' finds no file:")),
        ('left = "left/*.png"', ("RIL-223", "images.right")),
        ('left = "left/*.png"\nright = "right/00.png"', ("RIL-259", "01.png")),
        ('left = "left/*.png"\nright = "right/*.png"\npair = "size"', ("RIL-223", "images.pair", "'size'")),
    ],
)
def test_bad_patterns(tmp_path, line, expected):
    path = write_sequence(tmp_path)
    path.write_text(f"[images]\n{line}\n")
    with raises(*expected):
        opened(path)


def test_images_at_absolute_paths(tmp_path):
    """They may lie in folders that no root has in common."""
    path = write_sequence(tmp_path)
    left, right = f'"{tmp_path}/left/*.png"', f'"{tmp_path}/right"'
    text = path.read_text().replace('"left/*.png"', left).replace('"right/*.png"', right)
    (tmp_path / "elsewhere").mkdir()
    path = tmp_path / "elsewhere" / path.name
    path.write_text(text)
    assert len(opened(path).frame_names) == 3


@pytest.mark.parametrize("name", ["a\n01.png", "\udcff01.png"])
def test_images_whose_names_no_line_can_hold_are_refused(tmp_path, name):
    path = write_sequence(tmp_path)
    (tmp_path / "left" / "01.png").rename(tmp_path / "left" / name)
    with raises("RIL-185", repr(name)):
        opened(path)


@pytest.mark.parametrize(
    ("parts", "line"),
    [
        ({"cameras": "[cameras]\nfx = 6.4\ncx = 31.5\ncy = 23.5\n"}, r"fx = 6\.4 px gives an angle of view of 157"),
        (
            {"cameras": "[cameras]\nfx = 60.0\ncx = 315.0\ncy = 23.5\n"},
            r"principal point \(315, 23\.5\) px is 442 % of the width off the centre .* cut or scaled",
        ),
        ({"cameras": "[cameras]\nfx = 60.0\ncx = 35.0\ncy = 23.5\n"}, r"px is 4\.69 % of the width off the centre"),
        ({"cameras": CAMERAS + "fy = 120.0\n"}, r"fx = 60 and fy = 120 px differ much"),
    ],
)
def test_unusual_figures_are_warnings(tmp_path, parts, line):
    warnings = opened(write_sequence(tmp_path, **parts)).warnings
    assert any(re.search(line, w) for w in warnings)
    assert len(warnings) <= 2


@pytest.mark.parametrize("rows", [(-0.5, 0.55, 1.6), (-0.501, -0.5, 0.55, 0.551, 1.601, 1.602)])
def test_poses_that_are_farther_apart_than_may_be_interpolated_are_refused_as_that(tmp_path, rows):
    path = write_sequence(tmp_path, '[times]\nrate_hz = 10.0\n[truth]\nfile = "p.tum"\n', frames=9)
    write_lines(tmp_path / "p.tum", [tum(t, t) for t in rows])
    with raises("RIL-804", "1.05 s apart, more than 0.5 s"):
        opened(path)
    # At the times of the images nothing has to be.
    path = write_sequence(tmp_path, '[times]\nrate_hz = 1.0\n[truth]\nfile = "p.tum"\n', frames=9)
    write_lines(tmp_path / "p.tum", [tum(t, t) for t in range(9)])
    assert all(opened(path).truth)


def test_images_of_another_scale_than_that_of_the_calibration_are_refused_and_the_figures_are_said(tmp_path):
    of_twice_the_size = "[cameras]\nfx = 120.0\ncx = 63.5\ncy = 47.5\n"
    with raises("RIL-974", "some 128 x 96 pixels, the images are 64 x 48", "cx and cy times 0.5"):
        opened(write_sequence(tmp_path, cameras=of_twice_the_size))
    with raises("RIL-131", "fx = 60, fy = 60, cx = 31.5, cy = 23.5"):
        opened(write_sequence(tmp_path, cameras=of_twice_the_size + "width = 128\nheight = 96\n"))
    with raises("RIL-131", "if they were scaled, it has fx = 60, fy = 60.631579"):  # a row was left over
        opened(write_sequence(tmp_path, cameras=of_twice_the_size + "width = 128\nheight = 95\n"))
    # It is the images' own: stated as such, or with a lens off the middle of one side.
    assert opened(write_sequence(tmp_path, cameras=of_twice_the_size + "width = 64\nheight = 48\n")).warnings
    assert opened(write_sequence(tmp_path, cameras="[cameras]\nfx = 60.0\ncx = 63.5\ncy = 23.5\n")).warnings


def test_columns_and_rows_that_are_exchanged_are_named_as_that(tmp_path):
    stated = "[cameras]\nfx = 60.0\ncx = {}\ncy = {}\nwidth = {}\nheight = {}\n"
    with raises("RIL-133", "the centre of 64 x 48 images if cx and cy were exchanged"):
        opened(write_sequence(tmp_path, cameras=stated.format(23.5, 31.5, 64, 48)))
    with raises("RIL-131", "auto-orient", "width and height are exchanged"):
        opened(write_sequence(tmp_path, cameras=stated.format(31.5, 23.5, 48, 64)))
    # Off the centre by a crop, not by an exchange.
    assert opened(write_sequence(tmp_path, cameras=stated.format(24.0, 28.5, 64, 48))).warnings


@pytest.mark.parametrize("fx", [0.004, 3.0, 1e9])
def test_focal_lengths_that_no_lens_has_are_refused_when_the_manifest_is_read(tmp_path, fx):
    with raises("RIL-987", "64 x 48"):
        opened(write_sequence(tmp_path, cameras=f"[cameras]\nfx = {fx!r}\ncx = 31.5\ncy = 23.5\n"))


def test_missing_manifest(tmp_path):
    with raises("RIL-138"):
        read_manifest(tmp_path / "no.toml")


def test_every_key_is_described():
    kinds = [kind for kind in vars(model).values() if isinstance(kind, type) and issubclass(kind, model.Table)]
    undescribed = {
        f"{kind.__name__}.{key}"
        for kind in kinds
        for key, field in kind.model_fields.items()
        if not tables(field.annotation) and not any(f"\n{key} : " in (getdoc(base) or "") for base in kind.__mro__)
    }
    assert undescribed == set()
    assert {"rig.baseline", "cameras.left.fx", "vehicle.max_step", "times.rate_hz"} <= set(known_keys(Manifest))


def test_nested_defaults_become_dotted():
    assert dotted({"a": {"b": {"c": 1}, "d": 2}, "e.f": 3}) == [("a.b.c", 1), ("a.d", 2), ("e.f", 3)]


# -- other sensors as measurements -------------------------------------------------------------------------------------

TIMED = "[times]\nrate_hz = 1.0\n"


def test_sensors_say_how_good_they_are(tmp_path):
    write_lines(tmp_path / "gnss.csv", ["time,E,N,h", "0,1000,2000,5", "0.5,1100,2000,6", "2.5,1200,2000,7"])
    write_lines(tmp_path / "wheels.tum", [tum(k, 0.1 * k) for k in range(3)])
    write_lines(tmp_path / "ahrs.csv", ["t,roll_deg,pitch_deg,yaw_deg", *(f"{k},0,0,{k}" for k in range(3))])
    text = """
[positions]
file = "gnss.csv"
columns = { z = "h" }
sigma = [0.1, 0.2, 0.3]
lever_arm = [1, 2, 3]
unit = 0.01
time_offset = 0.25
[odometry]
file = "wheels.tum"
drift = 0.02
turn_deg = 1.0
[attitude]
file = "ahrs.csv"
up = [0, 0, 1]
sigma_deg = 0.5
"""
    priors = opened(write_sequence(tmp_path, TIMED + text)).priors
    assert priors["positions"] == {
        "positions": [[10.0, 20.0, 0.05], [11.0, 20.0, 0.06], [12.0, 20.0, 0.07]],
        "times": [0.25, 0.75, 2.75],
        "sigma": [0.1, 0.2, 0.3],
        "lever": [1.0, 2.0, 3.0],
    }
    plane = {"up": [0.0, 0.0, 1.0], "origin": [0.0, 0.0, 0.0]}
    assert priors["odometry"] == {"drift": 0.02, "turn": pytest.approx(math.radians(1.0)), **plane}
    assert priors["attitude"] == priors["up"] == {"sigma": pytest.approx(math.radians(0.5))}


@pytest.mark.parametrize(
    ("names", "last", "plane"),
    [
        ("time,x,y,yaw_deg", "2,0.2,0.1,5", True),
        ("time,x,y,z,roll_deg,pitch_deg,yaw_deg", "2,0.2,0.1,0,0,0,5", True),
        ("time,x,y,z,roll_deg,pitch_deg,yaw_deg", "2,0.2,0.1,0,0,0.01,5", False),
        ("time,x,y,z,roll_deg,pitch_deg,yaw_deg", "2,0.2,0.1,0.01,0,0,5", True),  # z of a barometer
        ("time,x,y,z,roll_deg,pitch_deg,yaw_deg", "2,0.2,0.1,0.01,0,0,0", False),  # no rotations
    ],
)
def test_odometry_that_never_rolls_or_pitches_measures_neither_slopes_nor_tilts(tmp_path, names, last, plane):
    still = ["0," + ",".join("0" for _ in names.split(",")[1:]), "1," + ",".join("0" for _ in names.split(",")[1:])]
    write_lines(tmp_path / "wheels.csv", [names, *still, last])
    mount = "[[0, 0, 1, 0.4], [-1, 0, 0, 0], [0, -1, 0, 0.9]]"  # looks ahead, 0.9 m above the axle
    text = f'[odometry]\nfile = "wheels.csv"\ndrift = 0.02\nturn_deg = 1.0\nT_body_left = {mount}\n'
    stated = opened(write_sequence(tmp_path, TIMED + text)).priors["odometry"]
    found = (stated["up"], stated["origin"]) if "up" in stated else None
    assert found == ((pytest.approx([0, -1, 0]), pytest.approx([0, 0.9, -0.4])) if plane else None)


E = "431000,5411000,100"


@pytest.mark.parametrize(
    ("names", "rows", "left"),
    [
        ("time,x,y,z", [f"0,{E}", "0.5,nan,nan,nan", f"1,{E}"], (0, 1)),
        ("time,x,y,z", ["0,,,", f"0.5,{E}", f"1,{E}"], (0.5, 1)),
        ("tow,E,N,h", ["0,0,0,0", f"0.5,{E}", f"1,{E}"], (0.5, 1)),
        ("time,x,y,z", ["0,0,0,0", "0.5,1,0,0", "1,2,0,0"], (0, 0.5, 1)),  # where the drive begins
        ("time,x,y,z,quality", [f"0,{E},0", f"0.5,{E},4", f"1,{E},5"], (0.5, 1)),
        ("time,x,y,z,q", [f"0,{E},0", f"0.5,{E},0", f"1,{E},0"], (0, 0.5, 1)),  # says nothing
        ("time,x,y,z", [f"{k / 4},{k // 2},0,0" for k in range(6)], (0, 0.5, 1)),  # held until the next one
        ("time,x,y,z", [f"{k / 4},{max(k, 2)},0,0" for k in range(6)], (0, 0.25, 0.5, 0.75, 1, 1.25)),  # stood
    ],
)
def test_positions_without_a_fix_are_left_out_and_counted(tmp_path, names, rows, left):
    write_lines(tmp_path / "gnss.csv", [names, *rows])
    s = opened(write_sequence(tmp_path, f'{TIMED}[positions]\nfile = "gnss.csv"\nsigma = 0.5\n'))
    assert tuple(s.priors["positions"]["times"]) == left
    assert sum("RIL-706" in line for line in s.warnings) == (len(left) < len(rows))


@pytest.mark.parametrize("place", ["", "origin = [1e3, 2e3, 0]\nazimuth_deg = 0\n"])
@pytest.mark.parametrize("more", ["", 'columns = { time = "time", x = "longitude", y = "latitude" }'])
def test_positions_in_degrees_are_read_in_metres(tmp_path, more, place):
    write_lines(tmp_path / "gnss.csv", ["time,latitude,longitude", "0,48.1,9", "1,48.1,9.00001"])
    s = opened(write_sequence(tmp_path, f'{TIMED}[positions]\nfile = "gnss.csv"\nsigma = 0.5\n{more}\n'))
    (x, y), (x1, y1) = s.priors["positions"]["positions"]
    assert (x1 - x, y1 - y) == (pytest.approx(0.744, abs=0.002), pytest.approx(0, abs=1e-3))
    assert [line for line in s.warnings if "RIL-774" in line and "EPSG:32632" in line]
    text = f'{TIMED}[world]\ncrs = "EPSG:32633"\n{place}[positions]\nfile = "gnss.csv"\nsigma = 0.5\n{more}\n'
    s = opened(write_sequence(tmp_path, text))
    assert s.priors["positions"]["positions"][0][0] < 100e3  # six degrees west of the middle of its zone
    assert not [line for line in s.warnings if "RIL-774" in line]  # as stated


NAMED = ["left/02.png,3,30", "left/00.png,1,10", "right/01.png,9,9", "left/01.png,2,20"]


@pytest.mark.parametrize(
    ("lines", "xs", "times"),
    [
        (NAMED, [1, 2, 3], None),
        ([line.replace("/", "\\").replace(".png", "") for line in NAMED], [1, 2, 3], None),
        ([line.replace("left/", "") for line in NAMED if "right" not in line], [1, 2, 3], None),
        ([*NAMED[:2], "left/01.png,,"], [1, 3], [0, 2]),
        ([f"./{line}" for line in NAMED[:2]], [1, 3], [0, 2]),
    ],
)
def test_positions_by_names_of_images(tmp_path, lines, xs, times):
    """In any order, of some images or of both cameras', and without a measurement for one."""
    write_lines(tmp_path / "gnss.csv", ["image,easting,northing", *lines])
    text = '[positions]\nfile = "gnss.csv"\nsigma = 0.5\n'
    path = write_sequence(tmp_path, f"{TIMED if times else ''}{text}")
    found = opened(path).priors["positions"]
    assert ([row[0] for row in found["positions"]], found["times"]) == (xs, times or [0, 1, 2])
    found = opened(write_sequence(tmp_path, text)).priors["positions"]  # by numbers of pairs
    assert ([row[0] for row in found["positions"]], found["times"]) == (xs, times or [0, 1, 2])
    write_lines(tmp_path / "gnss.csv", ["image,easting,northing", *(f"other/{k}.png,1,2" for k in range(3))])
    with raises("RIL-803", "0 positions by names of left images for 3 pairs"):
        opened(path)


@pytest.mark.parametrize(("step", "told"), [(1, False), (1000, True)])
def test_positions_of_another_unit_of_time_are_doubted(tmp_path, step, told):
    write_lines(tmp_path / "p.csv", ["time,x,y", *(f"{k * step},{k},0" for k in range(3))])
    s = opened(write_sequence(tmp_path, TIMED + '[positions]\nfile = "p.csv"\nsigma = 0.5\n'))
    assert [line for line in s.warnings if "RIL-797" in line and "1 of its 3" in line] == list(s.warnings)
    assert bool(s.warnings) == told


@pytest.mark.parametrize(("more", "told"), [("", 1), ("time_offset = -18", 0)])
@pytest.mark.parametrize("table", ["positions", "truth"])
def test_gps_time_is_not_that_of_the_images(tmp_path, table, more, told):
    """As RTKLIB writes it."""
    write_lines(
        tmp_path / "p.pos",
        ["%  GPST  e-baseline(m) n-baseline(m)", *(f"{BASE + 18 * (not told) + k} {k} 0" for k in range(3))],
    )
    write_lines(tmp_path / "t.txt", [f"{BASE + k}" for k in range(3)])
    text = f'[times]\nfile = "t.txt"\n[{table}]\nfile = "p.pos"\n{more}\n' + (
        "sigma = 0.5\n" if table == "positions" else "max_gap = 2\n"
    )
    lines = opened(write_sequence(tmp_path, text)).warnings
    assert [("RIL-785" in line, "time_offset = -18" in line) for line in lines] == [(True, True)] * told


def test_gps_weeks_are_said_to_be_read_as_utc(tmp_path):
    write_lines(tmp_path / "p.csv", ["week,tow,x,y", *(f"2123,{44818 + k},{k},0" for k in range(3))])
    write_lines(tmp_path / "t.txt", [f"{1600000000 + k}" for k in range(3)])
    text = '[times]\nfile = "t.txt"\n[positions]\nfile = "p.csv"\nsigma = 0.5\n'
    [line] = opened(write_sequence(tmp_path, text)).warnings
    assert "RIL-785" in line
    assert "time_offset = 18" in line


def test_positions_may_be_those_of_poses_with_names(tmp_path):
    write_lines(tmp_path / "p.csv", ["time,x,y,z,qx,qy,qz,qw", *(f"{k},{k},{10 * k},0,0,0,0,1" for k in range(3))])
    s = opened(write_sequence(tmp_path, TIMED + '[positions]\nfile = "p.csv"\nsigma = 0.5\n'))
    assert s.priors["positions"]["positions"] == [[0, 0, 0], [1, 10, 0], [2, 20, 0]]


def test_angles_of_photographs_are_told_and_their_places_are_truth(tmp_path):
    lines = ["#Label,X/Easting,Y/Northing,Z/Altitude,Yaw,Pitch,Roll", *(f"{k:02d}.png,{k},5,0,1,2,3" for k in range(3))]
    write_lines(tmp_path / "p.txt", lines)
    s = opened(write_sequence(tmp_path, '[truth]\nfile = "p.txt"\n'))
    assert [row[0] for row in s.truth_positions.positions] == [0, 1, 2]
    assert [line for line in s.warnings if "RIL-749" in line and "yaw, pitch, roll" in line]


def test_without_standard_deviations_sensors_are_no_measurements(tmp_path):
    write_lines(tmp_path / "wheels.tum", [tum(k, 0.1 * k) for k in range(3)])
    s = opened(write_sequence(tmp_path, TIMED + '[odometry]\nfile = "wheels.tum"\n'))
    assert s.odometry is not None
    assert s.priors == {}


@pytest.mark.parametrize(
    ("more", "lines", "expected"),
    [
        ("sigma = 0.5", [tum(k, k) for k in range(3)], ("RIL-453", "p.txt", "columns = ")),
        ("sigma = 0.5", ["x,y", "1,2", "2,3"], ("RIL-803", "2 positions for 3 pairs")),
        ("sigma = 0.5", ["time,x,y", "100,1,2", "101,2,3"], ("RIL-269", "100.000")),
        ("sigma = 0.5", ["x-ecef,y-ecef,when", "50.1,8.2,0", "50.1,8.3,1"], ("RIL-805", "x-ecef")),
        ('sigma = 0.5\ncolumns = { x = "E" }', ["time,x,y", "0,1,2"], ("RIL-806", "'E'")),
        ("sigma = 0.5", ["time,x,y", "0,1,?", "1,2,3"], ("RIL-284", "line 2")),
        ("", ["time,x,y", "0,1,2", "1,2,3"], ("RIL-223", "positions", "sigma")),
        ("sigma = 1e-300", ["time,x,y", "0,1,2", "1,2,3"], ("RIL-223", "positions", "sigma")),
    ],
)
def test_positions_that_cannot_be_used(tmp_path, more, lines, expected):
    write_lines(tmp_path / "p.txt", lines)
    code, *facts = expected
    with raises(code, *facts):
        opened(write_sequence(tmp_path, f'{TIMED}[positions]\nfile = "p.txt"\n{more}\n'))


def test_a_drift_alone_is_refused(tmp_path):
    write_lines(tmp_path / "p.txt", [tum(k, k) for k in range(3)])
    with raises("RIL-223", "turn_deg"):
        opened(write_sequence(tmp_path, f'{TIMED}[odometry]\nfile = "p.txt"\ndrift = 0.02\n'))
