"""A vehicle and the pitch of its camera from a URDF, and what of them reaches a sequence."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from raising import raises

from rille.datasets.images.files import Digests
from rille.datasets.manifest.opening import open_manifest
from rille.datasets.urdf import read_urdf


def wheel(name, x, y):
    """A wheel of radius 0.15 whose cylinder lies across."""
    return f"""<link name="{name}"><collision><origin rpy="1.5707963267948966 0 0"/>
<geometry><cylinder radius="0.15" length="0.1"/></geometry></collision></link>
<joint name="{name}_joint" type="continuous"><parent link="base"/><child link="{name}"/>
<origin xyz="{x} {y} 0.05"/><axis xyz="0 1 0"/></joint>"""


def rover(pitch=0.3, roll=0.0):
    """Base 0.2 m above ground; the mast pitches the camera down."""
    wheels = "".join(wheel(f"w{x}{y}", 0.4 * x, 0.25 * y) for x in (-1, 1) for y in (-1, 1))
    optical = f"{-math.pi / 2} 0 {-math.pi / 2}"
    return f"""<?xml version="1.0"?><robot name="tester"><link name="base"><visual><origin xyz="0 0 0.25"/>
<geometry><box size="0.7 0.4 0.2"/></geometry></visual></link>{wheels}<link name="mast"/><link name="left_optical"/>
<joint name="m" type="fixed"><parent link="base"/><child link="mast"/>
<origin xyz="0.2 0.1 0.9" rpy="{roll} {pitch} 0"/></joint>
<joint name="c" type="fixed"><parent link="mast"/>
<child link="left_optical"/><origin rpy="{optical}"/></joint></robot>"""


def put(tmp_path, text):
    path = tmp_path / "rover.urdf"
    path.write_text(text)
    return path


def test_footprint_clearance_and_pitch(tmp_path):
    robot = read_urdf(put(tmp_path, rover()), "left_optical")
    assert robot.vehicle.model_dump(exclude_unset=True) == {
        "name": "tester",
        "wheel_diameter": 0.3,
        "wheel_base": 0.8,
        "track": 0.5,
        "clearance": 0.25,  # ground at -0.1, belly at 0.15
    }
    assert robot.pitch == pytest.approx(0.3)
    assert read_urdf(put(tmp_path, rover())).pitch is None


@pytest.mark.parametrize(
    ("shape", "low"),
    [
        ('<sphere radius="0.1"/>', 0.1),
        ('<cylinder radius="0.1" length="0.2"/>', 0.1 * math.sqrt(2)),
        ('<box size="0.2 0.2 0.2"/>', 0.1 * math.sqrt(2)),
    ],
)
def test_turned_shapes_reach_as_low_as_they_are(tmp_path, shape, low):
    """By 45 degrees about x and 30 about z: the sphere counted as low as the corner of its box, 0.039 m too low."""
    turned = f'<origin rpy="{math.pi / 4} 0 {math.pi / 6}" xyz="0 0 0.25"/>'
    text = rover().replace('<origin xyz="0 0 0.25"/>', turned).replace('<box size="0.7 0.4 0.2"/>', shape)
    assert read_urdf(put(tmp_path, text)).vehicle.clearance == pytest.approx(0.25 - low + 0.1, abs=1e-6)


def test_a_cylinder_turned_about_itself_is_as_low_as_before(tmp_path):
    origin = f'<origin rpy="{math.pi / 2} {math.pi / 4} 0" xyz="0 0 0.25"/>'
    text = rover().replace('<origin xyz="0 0 0.25"/>', origin)
    text = text.replace('<box size="0.7 0.4 0.2"/>', '<cylinder radius="0.1" length="0.4"/>')
    assert read_urdf(put(tmp_path, text)).vehicle.clearance == pytest.approx(0.25, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        (rover().replace("continuous", "fixed"), "0 wheels"),
        (rover().replace('"0.15"', '"wide"'), "wide"),
        (rover().replace('"0.15"', '"${r}"'), "xacro"),
        ("<robot>" + "".join(f'<link name="{k}"/>' for k in range(301)) + "</robot>", "301 links"),
        (
            "<robot>"
            + "".join(f'<joint><parent link="{k + 1}"/><child link="{k}"/></joint>' for k in range(301))
            + "</robot>",
            "301 joints",
        ),
        ("<robot", "parsed"),
        ("<sdf/>", "<sdf>"),
        (rover().replace('<child link="mast"/>', '<child link="base"/>'), "circle"),
        (rover(roll=0.2), "rolled"),
        (rover().replace('xyz="0 0 0.25"', 'xyz="0 0 0.05"'), "belly"),
        (rover().replace("left_optical", "eye_optical"), "eye_optical"),
        (rover().replace('xyz="0 0 0.25"', 'xyz="0 0 -0.1"'), "'base' 0.1 m below the ground"),
        (rover().replace('<cylinder radius="0.15" length="0.1"/>', '<mesh filename="wheel.stl"/>'), "[vehicle]"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path, text, fact):
    with raises("RIL-963" if fact == "belly" else "RIL-959", fact):
        read_urdf(put(tmp_path, text), "left_optical")


def test_a_manifest_takes_what_it_does_not_state_itself(tmp_path):
    put(tmp_path, rover())
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        cv2.imwrite(str(tmp_path / side / "00.png"), np.zeros((48, 64), np.uint8))
    manifest = tmp_path / "m.toml"
    camera = "fx = 50.0\ncx = 31.0\ncy = 24.0\n"
    manifest.write_text(
        '[images]\nleft = "left/*.png"\nright = "right/*.png"\n[cameras]\n'
        f"[cameras.left]\n{camera}[cameras.right]\n{camera}"
        '[rig]\nbaseline = 0.1\n[urdf]\nfile = "rover.urdf"\nleft = "left_optical"\n[vehicle]\ntrack = 0.6\n'
    )
    sequence = open_manifest(manifest, Digests())
    assert (sequence.vehicle.track, sequence.vehicle.wheel_base, sequence.vehicle.name) == (0.6, 0.8, "tester")
    assert sequence.pitch == pytest.approx(0.3)


@pytest.mark.parametrize(("large", "small"), [("-1", "1"), ("1", "-1")])
def test_ground_lies_under_wheels_of_two_sizes(tmp_path, large, small):
    """Wheels of 0.15 and 0.12 m that stand on one ground: it is as far below the smaller axles as those are thick."""
    text = rover()
    for y in (-1, 1):
        before = wheel(f"w{small}{y}", 0.4 * int(small), 0.25 * y)
        text = text.replace(before, before.replace('"0.15"', '"0.12"').replace(" 0.05", " 0.02"))
    assert text.count('"0.12"') == text.count('"0.15"') == 2
    assert read_urdf(put(tmp_path, text)).vehicle.clearance == pytest.approx(0.25)
