"""What a folder holds, told from names and content; and that the manifest written from it says the same."""

from __future__ import annotations

import errno
import os
import tomllib
from pathlib import Path

import pytest
from folders import SIZE, write_images, write_lines
from raising import raises

from rille.datasets.images.files import Digests
from rille.datasets.inspection.folder import inspect
from rille.datasets.inspection.patterns import pattern
from rille.datasets.inspection.tables import table_kind
from rille.datasets.inspection.views import find_views
from rille.datasets.manifest.model import read_manifest
from rille.datasets.manifest.opening import find_pairs, open_manifest
from rille.datasets.manifest.text import manifest_text, needs
from rille.datasets.registry import open_sequence
from rille.datasets.text.names import derived_name
from rille.stages.core.errors import InputError

ORB_SETTINGS = """%YAML:1.0
Camera.fx: 60.0
Camera.fy: 60.0
Camera.cx: 31.5
Camera.cy: 23.5
Camera.k1: 0.0
Camera.k2: 0.0
Camera.p1: 0.0
Camera.p2: 0.0
Camera.width: {0}
Camera.height: {1}
Camera.bf: {bf}
"""

TSAI = """fu = 60
fv = 60
cu = 31.5
cv = 23.5
u_direction = 1 0 0
v_direction = 0 1 0
w_direction = 0 0 1
C = {x} 0 0
R = 1 0 0 0 1 0 0 0 1
k1 = -0.3
k2 = 0.1
p1 = 0
p2 = 0
"""


def both(template: str, names: list[str]) -> list[str]:
    return [template.format(side=side, name=name) for name in names for side in ("left", "right")]


CAMERAS_5_6 = "left/*_Camera_5.png", "right/*_Camera_6.png"
CAM_3_4 = "A/cam3/rgb/*.png", "A/cam4/rgb/*.png"
LEFT_RIGHT = "*/left.png", "*/right.png"
CAMERA_0_2 = "camera_00/im*.png", "camera_02/im*.png"
CAMERA_0_2_OF_SCENES = "*/camera_00/im0.png", "*/camera_02/im0.png"
LCAM = "image_lcam/*.png", "image_rcam/*.png"


@pytest.mark.parametrize(
    ("files", "left", "right", "pairs"),
    [
        (["left4.png", "right4.png"], "left4.png", "right4.png", 1),
        (both("{side}{name}.jpg", ["01", "02", "13"]), "left*.jpg", "right*.jpg", 3),
        (both("{side}/{name}.png", ["000", "001"]), "left/*.png", "right/*.png", 2),
        (both("run/{side}/{side}_{name}.png", ["1", "2"]), "run/left/left_*.png", "run/right/right_*.png", 2),
        (["a1_l.png", "a1_r.png", "a2_l.png", "a2_r.png"], "a*_l.png", "a*_r.png", 2),
        (["mav0/cam0/data/5.png", "mav0/cam1/data/5.png"], "mav0/cam0/data/5.png", "mav0/cam1/data/5.png", 1),
        ([f"image_{c}/{k}.png" for c in range(4) for k in (1, 2)], "image_0/*.png", "image_1/*.png", 2),
        (["im0.png", "im1.png"], "im0.png", "im1.png", 1),
        (["infra1/7.png", "infra2/7.png"], "infra1/7.png", "infra2/7.png", 1),
        ([f"{c}_{k}.png" for c in ("ir1", "ir2", "rgb") for k in (1, 2)], "ir1_*.png", "ir2_*.png", 2),
        ([*both("{side}/{name}.png", ["1", "2"]), "left/9.jpg", "right/9.jpg"], "left/*.png", "right/*.png", 2),
        (both("{side}/{name}", ["1.png", "2.PNG"]), "left/*.png", "right/*.png", 2),
        ([f"{side}/{k}.png" for side in ("droite", "gauche") for k in (1, 2)], "gauche/*.png", "droite/*.png", 2),
        (both("{name}_{side}_7.png", ["day1", "day2"]), "day*_left_7.png", "day*_right_7.png", 2),
        (both("f{name}/{side}.png", ["9", "10", "11"]), "*/left.png", "*/right.png", 3),
        (both("a/{name}/{side}/x.png", ["9", "10"]), "a/*/left/x.png", "a/*/right/x.png", 2),
        ([f"{k:03d}/v_{c}.png" for k in range(3) for c in (3, 4)], "*/v_3.png", "*/v_4.png", 3),
        (both("{name}/{side}.png", ["aloe", "cones"]), "aloe/left.png", "aloe/right.png", 1),
        ([f"{c}/{k}.png" for c in ("rgb_left", "mono_right") for k in (1, 2)], "rgb_left/*.png", "mono_right/*.png", 2),
        ([f"{c}/{k}.png" for c in "右左" for k in (1, 2)], "左/*.png", "右/*.png", 2),
        (both("{name}/{side}.png", ["1", "2"]) + both("{name}/{side}_disp.png", ["1", "2"]), *LEFT_RIGHT, 2),
        ([f"A/cam{c}/{what}/{k}.png" for c in (3, 4) for what in ("rgb", "depth") for k in (1, 2, 3)], *CAM_3_4, 3),
        ([f"{s}/im{k}.png" for s in ("aloe", "cones", "teddy") for k in (0, 1)], "aloe/im0.png", "aloe/im1.png", 1),
        ([f"run{k}/cam_{c}.png" for k in (1, 2) for c in (3, 4)], "*/cam_3.png", "*/cam_4.png", 2),
        ([f"{s}/camera_{c}/im0.png" for s in ("a_b", "c") for c in ("00", "02")], *CAMERA_0_2_OF_SCENES, 2),
        ([f"camera_{c}/im0.png" for c in ("00", "02")], "camera_00/im0.png", "camera_02/im0.png", 1),
        *([[f"camera_{c}/im{k}.png" for c in ("00", "02") for k in range(n)], *CAMERA_0_2, n] for n in (2, 3, 5)),
        ([f"{c}/im{k}.png" for c in ("im0", "im1") for k in range(3)], "im0/im*.png", "im1/im*.png", 3),
        ([f"{s}/{k}_Camera_{n}.png" for s, n in (("left", 5), ("right", 6)) for k in (1, 2, 3)], *CAMERAS_5_6, 3),
        ([f"{what}_{c}cam/{k}.png" for what in ("depth", "image") for c in "lr" for k in (1, 2)], *LCAM, 2),
    ],
)
def test_pairs_are_told_from_names(tmp_path, files, left, right, pairs):
    write_images(tmp_path, files)
    views = inspect(tmp_path).views
    assert (views.left, views.right, views.pairs, views.trouble) == (left, right, pairs, "")
    assert views.sizes == ((SIZE, SIZE) if files[0].endswith("png") else views.sizes)


@pytest.mark.parametrize("name", ["{k}/{side}.png", "{k}/{side}_{k}.png", "{k}/{side}/x.png", "{side}/{k}/x.png"])
def test_a_folder_for_each_frame_is_paired_in_the_order_of_the_folders(tmp_path, name):
    write_images(tmp_path, [name.format(k=k, side=side) for k in (9, 10, 11) for side in ("left", "right")])
    views = inspect(tmp_path).views
    head, cameras = "[cameras]\nfx = 60.0\ncx = 31.5\ncy = 23.5\n", "[rig]\nbaseline = 0.1\n"
    text = f'[images]\nleft = "{views.left}"\nright = "{views.right}"\n{head}{cameras}'
    (tmp_path / "m.toml").write_text(text)
    pairs = find_pairs(read_manifest(tmp_path / "m.toml").images, tmp_path, [], Digests())
    for k, pair in zip((9, 10, 11), pairs, strict=True):
        places = [path.relative_to(tmp_path).as_posix() for path in (pair.left, pair.right)]
        assert places == [name.format(k=k, side=side) for side in ("left", "right")]
    lost = name.format(k=10, side="right")
    (tmp_path / lost).unlink()
    assert open_sequence(str(tmp_path / "m.toml")).lost == {1: f"{lost} is missing"}
    views = inspect(tmp_path).views
    assert (views.pairs, views.absent) == (3, (f"{lost} is missing",))


@pytest.mark.parametrize(
    ("left", "right", "patterns"),
    [
        ("A/{}.png", "B/{}.png", ("A/*.png", "B/*.png")),
        ("cam1/{}.png", "cam2/{}.png", ("cam1/*.png", "cam2/*.png")),
        ("cam1/cam1_{}.png", "cam2/cam2_{}.png", ("cam1/cam1_*.png", "cam2/cam2_*.png")),
        ("A/image_{}.png", "B/image_{}.png", ("A/image_*.png", "B/image_*.png")),
        ("NLB_39768133{}EDR_04096M_.png", "NRB_39768133{}EDR_04096M_.png", None),
        ("a/acA__22345678__20260503_10111{}123_07.png", "b/acA__22345679__20260503_10111{}131_07.png", None),
        ("cam-40012345__1700000000.{}10.png", "cam-40012399__1700000000.{}14.png", None),
        ("LocCam_2015_{}_0.png", "LocCam_2015_{}_1.png", ("LocCam_2015_*_0.png", "LocCam_2015_*_1.png")),
    ],
)
def test_two_cameras_of_any_names_are_told_apart_and_left_is_a_guess(tmp_path, left, right, patterns):
    write_images(tmp_path, [name.format(k) for k in (0, 1, 2) for name in (left, right)])
    (tmp_path / "rig.yaml").write_text(ORB_SETTINGS.format(*SIZE, bf=6.0))
    found = inspect(tmp_path)
    assert (found.views.pairs, found.views.trouble) == (3, "")
    assert patterns in (None, (found.views.left, found.views.right))
    text = manifest_text(found, ".")
    assert "are taken for the left and the right camera, in order" in text
    path = tmp_path / "m.rille.toml"
    path.write_text(text)
    assert open_manifest(path, Digests()).frames == 3


@pytest.mark.parametrize("name", ["{c}/00{k}.png", "run{k}/cam_{c}.png", "cam{c}/frame{k}.png"])
def test_two_frames_of_two_cameras_differ_by_a_number(tmp_path, name):
    write_images(tmp_path, [name.format(k=k, c=c) for k in (1, 2) for c in "ab"])
    views = inspect(tmp_path).views
    assert (views.pairs, views.trouble) == (2, "")
    assert "'a' and 'b'" in views.lines[0].replace("cam", "")


def test_names_that_differ_by_two_numbers_tell_no_cameras_apart(tmp_path):
    write_images(tmp_path, [f"run{k}/view_{c}.png" for k in (1, 2) for c in (3, 4)])
    with raises("RIL-194"):
        inspect(tmp_path)


def test_the_folder_of_one_camera_is_in_a_folder_of_both(tmp_path):
    write_images(tmp_path, both("my rig/{side}/{name}.png", ["1", "2"]))
    remedy = f"give the folder of both: `rille init '{tmp_path}/my rig'`"
    with raises("RIL-194", remedy):
        inspect(tmp_path / "my rig" / "left")
    with raises("RIL-277", remedy):
        open_sequence(str(tmp_path / "my rig" / "left"))


def test_a_counter_that_began_anew_is_no_reason_to_pair_by_time_stamps(tmp_path):
    write_images(tmp_path, both("{side}/img{name}.png", ["998", "999", "000", "001"]))
    text = manifest_text(inspect(tmp_path), ".")
    assert "began anew" in text
    assert "pair" not in tomllib.loads(text)["images"]


def test_names_that_are_time_stamps(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1403715273262142976", "1403715273312143104"]))
    found = inspect(tmp_path)
    assert found.views.stamped
    assert tomllib.loads(manifest_text(found, "."))["times"] == {"names": True}
    dates = ["img_2026-05-31_12-00-00", "img_2026-05-31_12-00-01"]
    write_images(tmp_path / "dates", both("{side}/{name}.png", dates))
    assert inspect(tmp_path / "dates").views.stamped
    for k, names in enumerate((["000048978", "000048979"], [f"{dates[0]}_a", f"{dates[0]}_b"])):
        write_images(tmp_path / str(k), both("{side}/{name}.png", names))
        assert not inspect(tmp_path / str(k)).views.stamped


def test_patterns_escape_what_is_special(tmp_path):
    assert pattern([tmp_path / "a[1]" / "x1.png", tmp_path / "a[1]" / "x2.png"], tmp_path) == "a[[]1]/x*.png"


def test_images_that_cannot_be_told_apart(tmp_path):
    write_images(tmp_path, ["1.png", "2.png"])
    with raises("RIL-194", "2 images (1.png to 2.png), 0 named as left and 0 as right"):
        inspect(tmp_path)
    write_images(tmp_path / "high", ["1.png"], (48, 64))
    with raises("RIL-194", "one above the other, crop=iw:ih/2"):
        inspect(tmp_path / "high")
    (tmp_path / "videos" / "a" / "b" / "c" / "d" / "e").mkdir(parents=True)
    with raises("RIL-194", "0 images", "(4 folders deep): name the folder that holds the images"):
        inspect(tmp_path / "videos")
    (tmp_path / "videos" / "left.mp4").touch()
    with raises("RIL-194", "(4 folders deep): 1 video (left.mp4): take its images out"):
        inspect(tmp_path / "videos")
    write_images(tmp_path / "one", [f"image_{k}.png" for k in range(4)])
    assert "'image_0' and 'image_1' are taken for two cameras" in inspect(tmp_path / "one").views.lines[0]
    with raises("RIL-193"):
        inspect(tmp_path / "nothing")
    with raises("RIL-193", "ZED SDK"):
        inspect(tmp_path / "drive.svo")
    with raises("RIL-194"):
        find_views(tmp_path, [])


def test_an_image_without_partner_is_marked(tmp_path):
    write_images(tmp_path, [*both("{side}/{name}.png", ["1"]), "left/2.png", "left/3.png"])
    found = inspect(tmp_path)
    assert "2.png has no partner" in found.views.trouble
    assert any("2.png has no partner" in line for line in needs(manifest_text(found, ".")))


def test_a_gap_that_the_manifest_bridges_is_told_and_needs_nothing(tmp_path):
    write_images(tmp_path, [*both("{side}/{name}.png", ["1", "2", "4"]), "left/3.png", "right/5.png"])
    (tmp_path / "rig.yaml").write_text(ORB_SETTINGS.format(*SIZE, bf=6.0))
    text = manifest_text(inspect(tmp_path), ".")
    assert "# They make 5 pairs (right/3.png is missing and 1 more) of 64 x 48 pixels." in text
    assert not needs(text)
    path = tmp_path / "m.rille.toml"
    path.write_text(text)
    assert sorted(open_manifest(path, Digests()).lost) == [2, 4]


@pytest.mark.parametrize(
    ("lines", "kind"),
    [
        (["1 0 0 0 0 1 0 0 0 0 1 0"] * 2, "truth"),
        (["1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"] * 2, "truth"),
        (["0.1 0.6 0.8 0 9 -0.8 0.6 0 8 0 0 1 7"] * 2, "truth"),
        (["700 0 30 0 0 700 20 0 0 0 1 0"] * 2, ""),
        (["1e200 0 0 0 0 1 0 0 0 0 1 0"] * 2, ""),
        (["5 0 0 0 0 0.6 0.8"] * 2, "truth"),
        (["5 0 0 0 0 0.6 0.8"] * 3, ""),
        (["t,ax,ay,az,gx,gy,gz", "140,0,0,9.8,0.1,-3.6,0"], "imu"),
        (["# time x y z qx qy qz qw", "0.1 0 0 0 0 0 0.6 0.8"], "truth"),
        (["#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z", "1403,0.9,2.2,0.9,0.8,0.6,0.0,0.0,0.1,0.2"], "truth"),
        (["#timestamp [ns],w_RS_S_x [rad s^-1],y,z,a,b,c", "140,0,0,0,9.8,0.1,-3.6"], "imu"),
        (["time,roll_deg,pitch_deg,yaw_deg", "0,1,2,3"], "attitude"),
        (["time,x,y", "0,1,2", "1,2,3"], "positions"),
        (["time,x,y,yaw_deg", "0,1,2,0", "1,2,3,5"], "odometry"),
        (["time,x,y,theta", "0,1,2,0", "1,2,3,0.1"], "odometry"),
        (["time,easting,northing,yaw_deg", "0,431000,5411000,0", "1,431002,5411003,5"], "positions"),
        (["time,latitude,longitude,altitude", "0,48,9,2"], "positions"),
        (["time,lat,lon,alt,roll,pitch,yaw", "0,48,9,2,0.1,0.2,3"], "positions"),
        (["#Label,X/Longitude,Y/Latitude,Z/Altitude", *(f"0{k}.jpg,9,48,2" for k in range(4))], "positions"),
        (["#Label,X/Easting,Y/Northing,Z,Yaw,Pitch,Roll", *(f"{k}.jpg,9,8,2,1,2,3" for k in range(4))], "positions"),
        (["image,easting,northing", *(f"img_{k}.jpg,9,48" for k in range(4))], "positions"),
        (["east north", "1 2", "3 4"], "positions"),
        (["east north", "1 2", "3 4", "5 6"], ""),
        (["image_00: 1 0 0 0 0 1 0 0 0 0 1 0", "image_01: 1 0 0 1 0 1 0 0 0 0 1 0"], ""),
        (["1 0 0 0 0 1 0 0 0 0 1 0"], ""),
        (["0.0", "0.5"], "times"),
        (["0.5", "0.5"], ""),
        (["# id timestamp image_name", "0 1600000000.1 a.png", "1 1600000000.2 b.png"], "times"),
        (["0.0", "0.5", "1.0"], ""),
        (["00000 1600000000.1 5.0", "00001 1600000000.2 5.0"], ""),
        (["hello", "1 of these"], ""),
        ([], ""),
    ],
)
def test_tables_are_told_by_content(tmp_path, lines, kind):
    write_lines(tmp_path / "table.txt", lines)
    assert table_kind(tmp_path / "table.txt", 2) == kind


def test_poses_that_cannot_be_read_are_no_truth_but_are_told(tmp_path):
    """As Virtual KITTI's, of both cameras."""
    write_images(tmp_path, both("{side}/{name}.png", ["0", "1"]))
    rows = [f"{k} {c} 1 0 0 {-0.5 * c} 0 1 0 0 0 0 1 {-k} 0 0 0 1" for k in range(2) for c in range(2)]
    write_lines(tmp_path / "extrinsic.txt", ["frame camera r1 r2 r3 t1 r4 r5 r6 t2 r7 r8 r9 t3 0 0 0 1", *rows])
    found = inspect(tmp_path)
    assert not found.tables
    assert any("extrinsic.txt" in line and "no pose" in line for line in found.unread)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("wheel_odometry.tum", "odometry"), ("odom.csv", "odometry"), ("gt_odom.tum", "truth"), ("poses.tum", "truth")],
)
def test_dead_reckoning_is_no_truth(tmp_path, name, kind):
    write_lines(tmp_path / name, ["# time x y z qx qy qz qw", *(f"{k} {k} 0 0 0 0 0.6 0.8" for k in range(3))])
    assert table_kind(tmp_path / name, 2) == kind
    for rows in (["{} 1 0 0 0 0.6 0 0.8"], ["1 0 0 {} 0 1 0 0 0 0 1 0"]):
        write_lines(tmp_path / name, [row.format(k) for row in rows for k in range(3)])
        assert table_kind(tmp_path / name, 3) == kind, "without names of columns, too"


@pytest.mark.parametrize(
    "place", ["48\N{DEGREE SIGN} 6.000000' N,11\N{DEGREE SIGN} 30.0' E", "4806.0,1130.0", "48:06:00,11:30:00"]
)
def test_degrees_and_minutes_are_told_with_what_to_write_instead(tmp_path, place):
    write_lines(tmp_path / "gnss.csv", ["time,latitude,longitude,altitude", *(f"{k},{place},500" for k in range(3))])
    with raises("RIL-805", "decimal degrees", "(neither minutes"):
        table_kind(tmp_path / "gnss.csv", 3)


@pytest.mark.parametrize("row", ["{0:05d} {1}.5 8.0", "{1}500000000 {1}.5", "{1}.5"])
def test_times_stand_in_a_file_that_is_called_so(tmp_path, row):
    write_lines(tmp_path / "times.txt", [row.format(k, 1600000000 + k) for k in range(4)])
    assert table_kind(tmp_path / "times.txt", 2) == "times"


def test_a_rising_figure_of_cameras_is_no_time(tmp_path):
    write_lines(tmp_path / "focaldistance.txt", ["4.1", "4.2"])
    assert not table_kind(tmp_path / "focaldistance.txt", 2)


def test_poses_with_cells_of_text_are_found(tmp_path):
    """As ROS 2 writes them."""
    names = [*(f"p.position.{a}" for a in "xyz"), *(f"p.orientation.{a}" for a in "xyzw")]
    lines = [",".join(["header.stamp.sec", "header.stamp.nanosec", "header.frame_id", *names])]
    write_lines(tmp_path / "p.csv", lines + [f"17000000{k:02d},5,map,{k},0,0,0,0,0,1" for k in range(3)])
    assert table_kind(tmp_path / "p.csv", 3) == "truth"


def test_positions_of_rtklib_are_found(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    row = "2020/09/13 12:26:4{}.0 1 2 3 1 9"
    head = "%  GPST  e-baseline(m) n-baseline(m) u-baseline(m) Q ns"
    write_lines(tmp_path / "gnss.pos", ["% program : RTKPOST", head, row.format(0), row.format(1)])
    found = inspect(tmp_path)
    assert found.tables == {"positions": ["gnss.pos"]}
    assert '[positions]  # optional: GNSS; the trajectory is adjusted to it\n# file = "gnss.pos"' in manifest_text(
        found, "."
    )


def test_true_positions_that_cannot_be_read_are_told(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    write_lines(tmp_path / "truth.csv", ["time,x,y", "0,1,2", "1,two,3"])
    found = inspect(tmp_path)
    assert not found.tables
    (line,) = found.unread
    assert "truth.csv, line 3: 'two'" in line


def test_what_is_recognised_and_refused_is_told(tmp_path):
    """A lens that is not read, and decimal commas of a calibration and of a table, once each."""
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    write_lines(tmp_path / "cam0.yaml", ["model_type: MEI", "mirror_parameters: {xi: 1.9}"])
    write_lines(tmp_path / "P.txt", ["P0: 60,5 0 31,5 0 0 60,5 23,5 0 0 0 1 0"])
    write_lines(tmp_path / "times.txt", ["0,00", "0,10"])
    found = inspect(tmp_path)
    assert not found.tables
    assert [line.partition(": ")[0].rpartition("/")[2] for line in found.unread] == ["P.txt", "cam0.yaml", "times.txt"]
    assert "MEI" in found.unread[1]
    assert all("decimal commas" in found.unread[k] for k in (0, 2))


def test_texts_that_seem_to_describe_cameras_are_told_once_with_what_to_write_instead(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    write_lines(tmp_path / "calib_0.txt", ["Pinhole 1 2 3 4 0"])
    write_lines(tmp_path / "transforms.json", ['{"fl_x": 460.0}'])
    write_lines(tmp_path / "notes.txt", ["dusty"])
    found = inspect(tmp_path)
    assert [line.partition(":")[0] for line in found.unread] == [
        "2 calibrations (calib_0.txt and 1 more)",
        "1 file (notes.txt)",
    ]
    assert "of another program write fx, fy, cx, cy and baseline" in found.unread[0]


def test_of_several_resolutions_that_of_the_images_is_taken(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]), (960, 600))
    section = "[{side}_CAM_{name}]\nfx={f}\nfy={f}\ncx={f}\ncy={f}\n"
    sections = [section.format(side=s, name=n, f=f) for n, f in (("SVGA", 240), ("HD", 640)) for s in ("LEFT", "RIGHT")]
    (tmp_path / "SN1.conf").write_text("".join(sections) + "[STEREO]\nBaseline=120\n")
    found = inspect(tmp_path)
    assert found.calibration is not None
    assert (found.calibration.files, found.calibration.cameras) == (("SN1.conf",), 2)
    assert found.calibration.sizes == ((960, 600), (960, 600))
    assert found.calibration.names == ("left SVGA", "right SVGA")
    assert found.calibration.among == ("left SVGA", "right SVGA", "left HD", "right HD")


def test_scenes_of_two_numbered_cameras_are_sequences_of_their_own(tmp_path):
    """As of Booster."""
    scenes = ("bridge", "cellar", "alley")
    write_images(
        tmp_path, [f"{scene}/camera_{side}/im{k}.png" for scene in scenes for side in ("00", "02") for k in range(3)]
    )
    found = inspect(tmp_path)
    assert (found.views.left, found.views.pairs, found.views.trouble) == ("alley/camera_00/im*.png", 3, "")
    assert any(f"rille init {tmp_path}/bridge" in line for line in found.unread), found.unread


def test_calibrations_numbered_as_the_cameras_are_a_pair(tmp_path):
    write_images(tmp_path, [f"cam{side}/{k}.png" for side in (0, 1) for k in range(3)])
    for k in (0, 1):
        text = f"Pinhole 50 50 31 23 0.0\n{SIZE[0]} {SIZE[1]}\ncrop\n{SIZE[0]} {SIZE[1]}\n"
        (tmp_path / f"undistorted_calib_{k}.txt").write_text(text)
    (tmp_path / "undistorted_calib_stereo.txt").write_text("1 0 0 -0.3\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    found = inspect(tmp_path).calibration
    assert found is not None
    assert found.files == ("undistorted_calib_0.txt", "undistorted_calib_1.txt")
    assert found.baseline == pytest.approx(0.3)


def test_of_several_sets_the_plainest_is_taken_and_the_others_are_told(tmp_path):
    names = ["1", "2"]
    write_images(tmp_path, [*both("depth_{side}/{name}.png", names), *both("{side}/{name}.png", names)])
    write_images(tmp_path, both("{side}/{name}.jpg", ["3"]))
    found = inspect(tmp_path)
    assert found.views.left == "left/*.png"
    told = " ".join(found.unread)
    assert "4 images (depth_left/1.png ...): computed" in told
    assert "left/3.jpg" in told


def test_places_in_images_become_a_table(tmp_path):
    from PIL import Image

    write_images(tmp_path, both("{side}/{name}.jpg", ["1", "2", "3"]))
    place = Image.Exif()
    place.get_ifd(0x8825).update({1: "N", 2: (48.0, 6.0, 0.0), 3: "E", 4: (9.0, 0.0, 0.0)})
    for name in ("1", "2"):
        Image.new("L", SIZE).save(tmp_path / f"left/{name}.jpg", exif=place)
    assert any("EXIF of 2 of 3 left images" in line and "exiftool" in line for line in inspect(tmp_path).unread)


def test_kinds_of_images_in_turns_are_one_set(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "3", "5"]) + both("{side}/{name}.jpg", ["2", "4"]))
    views = inspect(tmp_path).views
    assert (views.left, views.right, views.pairs, views.others) == ("left/*", "right/*", 5, ())
    write_images(tmp_path, both("{side}/{name}.jpg", ["1", "3", "5"]))  # each png once more, as a jpg
    assert inspect(tmp_path).views.pairs == 5


@pytest.mark.parametrize(("name", "lost"), [("{at}_cam{side}_{time}{k}", 1), ("{at}_{side}_{time}{k}", 0)])
def test_of_two_pairs_of_cameras_in_one_folder_one_is_taken(tmp_path, name, lost):
    """Their images have times of their own, so that no names are those of both pairs; one lacks an image."""
    every = [(at, k, side) for at in (("Loc", 17), ("Pan", 18)) for k in range(3) for side in (0, 1)]
    names = [name.format(at=at[0], time=at[1], side=side, k=k) for at, k, side in every]
    write_images(tmp_path, [f"{name}.png" for name in names[2 * lost :]] + lost * [f"{names[1]}.png"])
    views = inspect(tmp_path).views
    assert (views.left[:3], views.pairs, len(views.absent)) == (("Pan", 3, 0) if lost else ("Loc", 3, 0))
    assert any("of another set" in line for line in views.others)


def test_a_camera_may_be_numbered_behind_the_frame(tmp_path):
    write_images(tmp_path, [f"img{k:04d}c{camera}.png" for k in range(3) for camera in (0, 1)])
    views = inspect(tmp_path).views
    assert (views.left, views.right, views.pairs) == ("img*c0.png", "img*c1.png", 3)


def test_images_and_their_depths_are_no_pairs(tmp_path):
    write_images(tmp_path, [f"{kind}/{k}.png" for k in range(3) for kind in ("rgb", "depth")])
    with raises("RIL-194", "6 images"):
        inspect(tmp_path)


def test_of_two_sets_in_one_folder_the_first_is_taken(tmp_path):
    days = [f"{day}_{side}_{k}.png" for day in ("day1", "day2") for side in ("left", "right") for k in range(3)]
    write_images(tmp_path, days)
    found = inspect(tmp_path)
    assert (found.views.left, found.views.right, found.views.pairs) == ("day1_left_*.png", "day1_right_*.png", 3)
    assert any(line.startswith("day2_left_*.png and its right images") for line in found.unread)


def test_scenes_beside_each_other_are_named_with_the_command_that_takes_one(tmp_path):
    write_images(tmp_path, [f"{s}/im{k}.png" for s in ("aloe", "teddy bear") for k in (0, 1)])
    assert f"`rille init '{tmp_path}/teddy bear'` would take" in " ".join(inspect(tmp_path).unread)
    write_images(tmp_path / "two", [f"{s}/camera_0{c}/im0.png" for s in ("art", "dolls") for c in (0, 2)])
    views = inspect(tmp_path / "two").views
    assert (views.pairs, f"`rille init {tmp_path}/two/art`" in views.lines[-1]) == (2, True)


def test_images_in_turn_are_refused_with_the_patterns_of_a_manifest(tmp_path):
    write_images(tmp_path, [f"{k:02d}.png" for k in range(6)])
    with raises("RIL-194", "*[02468].png", "*[13579].png"):
        inspect(tmp_path)


@pytest.mark.parametrize("name", ["my.rille.toml", "my.toml"])
def test_a_manifest_in_the_folder_is_neither_calibration_nor_unread(tmp_path, name):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    (tmp_path / name).write_text(
        '[images]\nleft = "left/*"\nright = "right/*"\n[cameras]\nfx = 1\n# a calibration: no\n'
    )
    found = inspect(tmp_path)
    assert (found.calibration, found.unread) == (None, [])


def test_times_with_names_of_images_or_dates_are_times(tmp_path):
    for name, line in (("timestamps.csv", "14000{k},0{k}.png"), ("times.txt", "2011-09-26 13:02:2{k}.964389445")):
        write_lines(tmp_path / name, ["#time,filename", *(line.format(k=k) for k in range(3))])
        assert table_kind(tmp_path / name, 3) == "times"


def test_single_numbers_are_times_whatever_their_count_where_the_name_says_so(tmp_path):
    write_lines(tmp_path / "times.txt", ["0.0", "0.5", "1.0"])
    assert table_kind(tmp_path / "times.txt", 2) == "times"


def test_calibration_of_both_cameras_is_preferred(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    (tmp_path / "rig.yaml").write_text(ORB_SETTINGS.format(*SIZE, bf=6.0))
    (tmp_path / "notes.yaml").write_text("weather: dusty\n")
    calibration = inspect(tmp_path).calibration
    assert calibration is not None
    assert calibration.files == ("rig.yaml",)
    assert calibration.baseline == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("image", "calibration"), [("{k}/im{c}.png", "{k}/calib.yaml"), ("im{c}/{k}.png", "calib/00{k}.yaml")]
)
def test_calibrations_of_each_pair_that_differ_are_told(tmp_path, image, calibration):
    write_images(tmp_path, [image.format(k=k, c=c) for k in range(3) for c in (0, 1)])
    for k, bf in enumerate((6.0, 6.0, 7.0)):
        path = tmp_path / calibration.format(k=k)
        path.parent.mkdir(exist_ok=True)
        path.write_text(ORB_SETTINGS.format(*SIZE, bf=bf))
    (line,) = inspect(tmp_path).unread
    assert line.startswith(f"1 calibration ({calibration.format(k=2)}): unlike {calibration.format(k=0)}")


def test_of_several_scenes_one_is_taken_with_its_own_calibration(tmp_path):
    scenes = ("delivery", "forest", "playground")
    write_images(tmp_path, [f"{scene}/im{c}.png" for scene in scenes for c in (0, 1)])
    for scene in scenes:
        (tmp_path / scene / "calib.yaml").write_text(ORB_SETTINGS.format(*SIZE, bf=6.0 + len(scene)))
    found = inspect(tmp_path)
    assert found.views.left == "forest/im0.png"
    assert found.calibration is not None
    assert found.calibration.files == ("forest/calib.yaml",)
    assert "calib" not in " ".join(found.unread)


def test_both_files_of_opencvs_sample_are_read(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    keys = ("M1", "M2")
    write_lines(tmp_path / "intrinsics.yml", [f"{key}: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]" for key in keys])
    write_lines(tmp_path / "extrinsics.yml", ["R: [1, 0, 0, 0, 1, 0, 0, 0, 1]", "T: [-0.1, 0, 0]"])
    found = inspect(tmp_path)
    assert found.calibration is not None
    assert (found.calibration.baseline, found.unread) == (pytest.approx(0.1), [])


def test_calibration_of_the_images_size_is_preferred(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    for name, size in (("a", (640, 480)), ("b", SIZE), ("c", (128, 96))):
        (tmp_path / f"{name}.yaml").write_text(ORB_SETTINGS.format(*size, bf=6.0))
    found = inspect(tmp_path)
    assert found.calibration is not None
    assert found.calibration.files == ("b.yaml",)
    assert found.others == ["a.yaml", "c.yaml"]


def test_a_calibration_in_millimetres_opens_once_its_unit_is_said(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    (tmp_path / "calib.yaml").write_text(ORB_SETTINGS.format(*SIZE, bf=7200.0))
    path = tmp_path / "m.rille.toml"
    path.write_text(manifest_text(inspect(tmp_path), ".").replace("# unit = 0.001", "unit = 0.001"))
    assert open_manifest(path, Digests()).rig.baseline == pytest.approx(0.12)


@pytest.mark.parametrize(("left", "right"), [("left", "right"), ("cam2", "cam3"), ("port", "starboard")])
def test_two_files_are_left_and_right(tmp_path, left, right):
    write_images(tmp_path, [f"{side}/{k}.png" for side in (left, right) for k in (4, 5, 6)])
    for side, x in ((left, 0.0), (right, 0.1)):
        (tmp_path / f"of_{side}.tsai").write_text(TSAI.format(x=x))
    found = inspect(tmp_path)
    assert found.calibration is not None
    assert found.calibration.files == (f"of_{left}.tsai", f"of_{right}.tsai")
    assert found.calibration.baseline == pytest.approx(0.1)
    text = manifest_text(found, ".")
    assert needs(text) == []
    (tmp_path / "m.rille.toml").write_text(text)
    s = open_manifest(tmp_path / "m.rille.toml", Digests())
    assert s.lenses is not None
    assert s.lenses["left"].coefficients[:2] == (-0.3, 0.1)
    assert s.rig.baseline == pytest.approx(0.1)


def test_a_whole_folder_opens_at_once(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2", "3"]))
    (tmp_path / "rig.yaml").write_text(ORB_SETTINGS.format(*SIZE, bf=-6.0))
    write_lines(tmp_path / "times.txt", ["0.0", "0.5", "1.0"])
    write_lines(tmp_path / "poses.txt", [f"1 0 0 {k} 0 1 0 0 0 0 1 0" for k in range(3)])
    write_lines(tmp_path / "imu.csv", ["#t,gyro_x,gyro_y,gyro_z,ax,ay,az", "0,0,0,0,0,-9.81,0"])
    found = inspect(tmp_path)
    assert found.tables == {"times": ["times.txt"], "truth": ["poses.txt"], "imu": ["imu.csv"]}
    (tmp_path / "m.rille.toml").write_text(manifest_text(found, "."))
    s = open_manifest(tmp_path / "m.rille.toml", Digests())
    assert (s.name, s.frames, s.times) == (derived_name(tmp_path.name), 3, (0.0, 0.5, 1.0))
    assert s.truth is not None
    assert s.truth[2] is not None
    assert s.truth[2].translation[0] == 2.0
    assert s.attitude is None


def test_what_a_run_left_in_the_folder_is_no_truth_and_no_images(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    run = tmp_path / "runs" / "seq" / "20261128T190548Z-22bd21ca"
    write_images(run / "frames", both("{side}_{name}.png", ["1", "2", "3"]))
    write_lines(run / "ledger.jsonl", ["{}"])
    write_lines(run / "trajectory.tum", [f"{k} 0 0 {k} 0 0 0 1" for k in range(2)])
    (run.parent / "latest").symlink_to(run.name)
    write_lines(tmp_path / "seq.rille.toml", ["[images]", "# a: b: c"])
    found = inspect(tmp_path)
    assert (found.tables, found.unread, found.views.pairs) == ({}, [], 2)


def test_the_first_of_several_tables_is_named_and_the_others_stand_in_a_comment(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    for name in ("stamps.txt", "times.txt"):
        write_lines(tmp_path / name, ["0.0", "0.5"])
    for name in ("a.txt", "b.txt"):
        write_lines(tmp_path / name, [f"1 0 0 {k} 0 1 0 0 0 0 1 0" for k in range(2)])
    text = manifest_text(inspect(tmp_path), ".")
    stated = tomllib.loads(text)
    assert (stated["times"], stated["truth"]) == ({"file": "stamps.txt"}, {"file": "a.txt"})
    assert [line for line in text.splitlines() if line.startswith("# Other")] == [
        "# Others: times.txt",
        "# Other tables of poses: b.txt",
    ]


@pytest.mark.parametrize(
    ("settings", "marked", "expected"),
    [
        ("", ["no calibration was found", "nothing says where the right camera stands"], ("RIL-235",)),
        (ORB_SETTINGS.format(640, 480, bf=6.0), ["this calibration is of 640 x 480"], ("RIL-131", "640 x 480")),
        (
            ORB_SETTINGS.format(*SIZE, bf=7200.0),
            ["the baseline of the calibration is 120,"],
            ("RIL-244", "120", "rig.unit", "0.001"),
        ),
    ],
)
def test_what_is_missing_is_marked_and_fails_with_its_line(tmp_path, settings, marked, expected):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    if settings:
        (tmp_path / "calib.yaml").write_text(settings)
    text = manifest_text(inspect(tmp_path), ".")
    found = needs(text)
    assert len(found) == len(marked)
    assert all(line.startswith(start) for line, start in zip(found, marked, strict=True))
    path = tmp_path / "m.rille.toml"
    path.write_text(text)
    with raises(*expected):
        open_manifest(path, Digests())


def test_filling_in_what_is_needed_is_enough(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    text = manifest_text(inspect(tmp_path), ".")
    for key in ("fx", "fy", "cx", "cy", "baseline"):
        text = text.replace(f"# {key} = ", f"{key} = ")
    tomllib.loads(text)
    path = tmp_path / "m.rille.toml"
    path.write_text(text.replace("cx = 320.0", "cx = 30.0").replace("cy = 240.0", "cy = 20.0"))
    assert open_manifest(path, Digests()).rig.baseline == 0.1


@pytest.mark.data
@pytest.mark.parametrize(
    ("folder", "pairs", "files", "needed"),
    [
        ("nasa_k10", 1, ("black_left.tsai", "black_right.tsai"), 0),
        ("devon_island", 10, ("source_config.yaml",), 0),
        ("chessboard_bumblebee2", 11, ("stereo.yaml",), 1),
    ],
)
def test_real_folders(data_dir: Path, folder, pairs, files, needed):
    found = inspect(data_dir / folder)
    assert found.views.pairs == pairs
    assert found.calibration is not None
    assert found.calibration.files == files
    assert len(needs(manifest_text(found, "."))) == needed


P0, P1, P2, P3 = (f"60 0 31.5 {x} 0 60 23.5 0 0 0 1 0" for x in (0, -12, -3, -18))

KITTI_FILES = {
    "odometry": f"P0: {P0}\nP1: {P1}\nP2: {P2}\nP3: {P3}\nTr: {P0}\n",
    "raw": "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.95e-02\n"
    + "".join(
        f"S_0{k}: 80 60\nK_0{k}: 70 0 40 0 70 30 0 0 1\nD_0{k}: -0.3 0.1 0 0 0\nR_0{k}: 1 0 0 0 1 0 0 0 1\n"
        f"T_0{k}: 0 0 0\nS_rect_0{k}: {SIZE[0]} {SIZE[1]}\nR_rect_0{k}: 1 0 0 0 1 0 0 0 1\nP_rect_0{k}: {p}\n"
        for k, p in enumerate((P0, P1, P2, P3))
    ),
    "roi": f"K_01: 70 0 40 0 70 30 0 0 1\nD_01: 0 0 0 0 0\nP1: {P1}\nP1_roi: {P0}\nP2_roi: {P1}\n",
}


@pytest.mark.parametrize(
    ("form", "left", "right", "baseline"),
    [
        ("odometry", "image_2/0000000{}", "image_3/0000000{}", 0.25),
        ("odometry", "image_0/{}", "image_1/{}", 0.2),
        ("raw", "run/image_02/data/000000000{}", "run/image_03/data/000000000{}", 0.25),
        ("roi", "I1_00{}", "I2_00{}", 0.2),
    ],
)
def test_a_manifest_takes_kittis_calibration_of_the_cameras_that_are_there(tmp_path, form, left, right, baseline):
    folder = tmp_path / "drive"
    for name in (left, right):
        write_images(folder, [name.format(k) + ".png" for k in range(2)])
    (folder / "calib.txt").write_text(KITTI_FILES[form])
    text = manifest_text(inspect(folder), "drive")
    assert not needs(text)
    (tmp_path / "m.toml").write_text(text)
    sequence = open_manifest(tmp_path / "m.toml", Digests())
    assert (sequence.rig.left.fx, sequence.rig.baseline) == (60.0, pytest.approx(baseline))
    assert sequence.times is None  # zeros in front: numbers of frames, no times
    assert sequence.frames == 2


@pytest.mark.parametrize("name", ['notes\nroot = "elsewhere".yaml', "caf\udce9.yaml"])
def test_names_that_no_manifest_can_hold_are_refused(tmp_path, name):
    """A line break would end the comment that a name stands in; bytes that are not UTF-8 cannot be written."""
    write_images(tmp_path, [f"{side}/{k}.png" for side in ("left", "right") for k in range(2)])
    (tmp_path / name).write_text("")
    with raises("RIL-185"):
        inspect(tmp_path)


def test_what_is_not_read_is_listed_by_kind_with_the_next_step(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    for name in (
        "a.mp4",
        "b.mp4",
        "x.svo2",
        "d.npy",
        "left/3.heic",
        "r.raw",
        "cameras.bin",
        "nav.IMG",
        "notes.md",
        "more.pdf",
        "drive.bag",
        "s.npz",
        "disparity.npz",
    ):
        (tmp_path / name).write_bytes(b"")
    write_lines(tmp_path / "readme.txt", ["what this is, its calibration and its baseline"])
    write_lines(tmp_path / "gps.txt", ["$GPGGA,120000.00,4751.2,N,01500.0,E,4,12,0.6,500.2,M,46.9,M,1.0,0000*41"])
    (tmp_path / "rig.yaml").write_text("camera_matrix: [1, 2\n")
    found = inspect(tmp_path)
    text = "\n".join(found.unread)
    assert "2 videos (a.mp4 and 1 more): " in text
    assert "ffmpeg -i" in text
    for words in (
        "1 ZED recording (x.svo2): ",
        "1 array (d.npy): python -c",
        "1 image (left/3.heic): ",
        "1 bag (drive.bag)",
        "1 COLMAP file (cameras.bin): colmap model_converter",
        "1 matrix file (s.npz): if it is the calibration, write it as text",
    ):
        assert words in text
    assert "1 headerless image (r.raw): " in text
    assert "1 planetary image (nav.IMG): convert them" in text
    assert "gps.txt is NMEA, no table" in text
    assert "2 files (more.pdf and 1 more): neither images nor" in text
    assert "rig.yaml cannot be parsed" in text
    assert len(found.unread) == 12
    assert all(f"# Not read: {line}" in manifest_text(found, ".") for line in found.unread)


@pytest.mark.parametrize(
    ("files", "step"),
    [
        (["left.mp4", "right.mp4"], "ffmpeg -i FILE left/%06d.png"),
        (["drive.mp4"], "if it shows both views: mkdir left right; ffmpeg"),
        (["left/1.npy", "right/1.npy"], "cv2.imwrite"),
        (["left/1.webp", "right/1.webp"], "magick mogrify"),
    ],
)
def test_a_folder_without_images_says_what_it_holds(tmp_path, files, step):
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    with raises("RIL-194", step):
        inspect(tmp_path)


def test_a_pair_of_pointers_of_git_lfs_is_said(tmp_path):
    for name in ("left/1.png", "right/1.png", "rig.yaml", "imu.csv"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 9\n")
    found = inspect(tmp_path)
    assert "git lfs pull" in found.views.trouble
    assert [line.split(" is a pointer")[0].split("/")[-1] for line in found.unread] == ["rig.yaml", "imu.csv"]


def test_folders_that_are_links_are_looked_into_once(tmp_path):
    write_images(tmp_path / "far", both("{side}/{name}.png", ["1", "2"]))
    for side in ("left", "right"):
        (tmp_path / "here" / "deep").mkdir(parents=True, exist_ok=True)
        (tmp_path / "here" / side).symlink_to(tmp_path / "far" / side)
        (tmp_path / "here" / "deep" / side).symlink_to(tmp_path / "here")
    (tmp_path / "here" / "itself").symlink_to("itself")
    found = inspect(tmp_path / "here").views
    assert (found.left, found.right, found.pairs) == ("left/*.png", "right/*.png", 2)


@pytest.mark.parametrize("error", [PermissionError(errno.EACCES, "Permission denied"), OSError(errno.ENOTCONN, "gone")])
def test_a_folder_that_cannot_be_read_is_not_said_to_hold_nothing(tmp_path, monkeypatch, error):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    (tmp_path / "rig.yaml").write_text(ORB_SETTINGS.format(*SIZE, bf=6.0))
    path = tmp_path / "m.rille.toml"
    path.write_text(manifest_text(inspect(tmp_path), "."))
    scan = os.scandir

    def closed(place):
        if Path(place).name == "right":
            raise error
        return scan(place)

    monkeypatch.setattr(os, "scandir", closed)
    with raises("RIL-194", f"right cannot be read: {error.strerror}"):
        inspect(tmp_path)
    with raises("RIL-217", f"right cannot be read: {error.strerror}"):
        open_manifest(path, Digests())


def test_what_archives_of_a_mac_add_is_passed_over(tmp_path):
    names = both("{side}/{name}.png", ["1", "2", "3"])
    write_images(tmp_path, names)
    for name in names:
        for place in (tmp_path, tmp_path / "__MACOSX"):
            path = (place / name).with_name(f"._{Path(name).name}")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"\0\5\26\7\0\2\0\0Mac OS X")
    found = inspect(tmp_path).views
    assert (found.left, found.pairs, found.trouble) == ("left/*.png", 3, "")
    (tmp_path / "calib.txt").write_text("P0: 60 0 31 0 0 60 23 0 0 0 1 0\nP1: 60 0 31 -6 0 60 23 0 0 0 1 0\n")
    assert open_sequence(str(tmp_path)).frames == 3


def test_a_link_to_nothing_is_named(tmp_path):
    write_images(tmp_path, both("{side}/{name}.png", ["1", "2"]))
    for side in ("left", "right"):
        (tmp_path / side / "3.png").symlink_to("../.git/annex/objects/x.png")
    assert "left/3.png cannot be read: it is a link to" in inspect(tmp_path).views.absent[0]


def test_pairing_by_time_stamps_is_proposed(tmp_path):
    write_images(tmp_path, [f"left/16960598221{k}3456789.png" for k in range(4)])
    write_images(tmp_path, [f"right/16960598221{k}4056789.png" for k in (0, 1, 3)])
    (tmp_path / "rig.yaml").write_text(ORB_SETTINGS.format(*SIZE, bf=6.0))
    text = manifest_text(inspect(tmp_path), ".")
    assert tomllib.loads(text)["images"]["pair"] == "nearest"
    path = tmp_path / "m.rille.toml"
    path.write_text(text)
    sequence = open_manifest(path, Digests())
    assert sequence.frames == 3
    assert sequence.times[2] - sequence.times[0] == pytest.approx(0.03, abs=1e-6)
    assert any("1 image without a partner" in line for line in sequence.warnings)


@pytest.mark.parametrize("place", ["", "left/"])  # those of a video that was taken apart as a left camera's
def test_images_that_may_show_both_views_say_how_they_are_split(tmp_path, place):
    write_images(tmp_path / "wide", [f"{place}1.png", f"{place}2.png"], (128, 48))
    with raises("RIL-194", "if each shows both views: mkdir left right; ffmpeg"):
        inspect(tmp_path / "wide")
    (tmp_path / "videos" / "a" / "b" / "c" / "d" / "e").mkdir(parents=True)
    with raises("RIL-194", "0 images", "(4 folders deep): name the folder that holds the images"):
        inspect(tmp_path / "videos")
    (tmp_path / "videos" / "left.mp4").touch()
    with raises("RIL-194", "(4 folders deep): 1 video (left.mp4): take its images out"):
        inspect(tmp_path / "videos")
    write_images(tmp_path / "one", ["1.png"])
    with pytest.raises(InputError) as caught:
        inspect(tmp_path / "one")
    assert "both views" not in str(caught.value)


def test_the_body_of_the_calibration_is_offered_for_poses_of_it(tmp_path):
    write_images(tmp_path, ["left4.png", "right4.png"])
    for side, x in (("left", 0.5), ("right", 0.6)):
        (tmp_path / f"cam_{side}.tsai").write_text(TSAI.format(x=x))
    write_lines(tmp_path / "poses.txt", ["1 0 0 0 0 1 0 0 0 0 1 0"])
    text = manifest_text(inspect(tmp_path), ".")
    line = "T_body_left = [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0]]"
    assert f"# {line}  # by the calibration" in text
    (tmp_path / "m.rille.toml").write_text(text.replace(f"# {line}", line))
    assert open_manifest(tmp_path / "m.rille.toml", Digests()).truth_mount.translation[0] == 0.5
