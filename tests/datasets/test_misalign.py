"""Knocked right cameras: the warp is that of a turned camera, the mask is honest, everything else stays."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rille.datasets.images import misalign as module
from rille.datasets.images.misalign import MisalignParams, misalign, origins, warp
from rille.datasets.mockup.params import SHORT, MockupParams
from rille.datasets.mockup.sequence import mockup
from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.geometry.geometry import Camera, rotation_exp
from rille.stages.geometry.lens import Lens

CAMERA = Camera(120.0, 118.0, 47.0, 31.0, 96, 64)
PINHOLE = Lens(CAMERA)
ALL = MisalignParams(rows=2.5, roll_deg=3.0, pitch_deg=1.0, yaw_deg=-2.0)


def pattern(x, y):
    """Waves of 12 pixels and more about mid-grey."""
    return 128 + 60 * np.sin(2 * np.pi * x / 17 + 0.3) * np.cos(2 * np.pi * y / 12)


def picture(dtype=np.uint8):
    y, x = np.indices((64, 96))
    scale = 257 if dtype == np.uint16 else 1
    return np.rint(scale * pattern(x, y)).astype(dtype)


def test_whole_rows_are_moved_exactly():
    image, valid = warp(picture(), np.ones((64, 96), np.uint8), PINHOLE, MisalignParams(rows=3.0))
    seen = valid != 0
    np.testing.assert_array_equal(image[3:][seen[3:]], picture()[:-3][seen[3:]])
    # the kernel reads one pixel before and two behind
    assert seen[4:-1, 1:-2].all()
    assert not seen[:4].any()
    assert not seen[:, -2:].any()


@pytest.mark.parametrize("rows", [0.0, 2.5])
def test_turned_camera_sees_a_direction_where_it_should(rows):
    """A ray r of the given camera is at K R r of the knocked one, and then the sensor's shift."""
    params = ALL.model_copy(update={"rows": rows})
    column, row = origins(PINHOLE, params)
    turn = rotation_exp(np.radians([params.pitch_deg, params.yaw_deg, params.roll_deg]))
    for c, r in ((20, 10), (60, 50)):
        given = CAMERA.rays([column[r, c], row[r, c]])
        there = CAMERA.project(turn @ given) + np.array([0.0, rows])
        np.testing.assert_allclose(there, [c, r], atol=1e-9)


def test_contents_move_as_the_parameters_say():
    y, x = 31, 47
    column, row = origins(PINHOLE, MisalignParams(pitch_deg=1.0))
    assert row[y, x] == pytest.approx(y + 118.0 * math.tan(math.radians(1.0)))  # what is seen here was below
    column, row = origins(PINHOLE, MisalignParams(yaw_deg=1.0))
    assert column[y, x] == pytest.approx(x - 120.0 * math.tan(math.radians(1.0)))
    column, row = origins(PINHOLE, MisalignParams(roll_deg=1.0))
    assert row[y, 90] < y  # clockwise: what is right of the centre has come from above


def test_grey_values_are_those_of_the_pattern():
    image, valid = warp(picture(np.uint16), np.ones((64, 96), np.uint8), PINHOLE, ALL)
    column, row = origins(PINHOLE, ALL)
    inner = valid != 0
    inner[:8] = inner[-8:] = inner[:, :8] = inner[:, -8:] = False  # the spline's ends ring
    error = image[inner] / 257.0 - pattern(column[inner], row[inner])
    # a cubic spline misses by 5/384 of the fourth derivative at most (Hall and Meyer 1976), along either axis
    fourth = (2 * np.pi / 12) ** 4 + (2 * np.pi / 17) ** 4
    assert np.abs(error).max() < 60 * fourth * 5 / 384 + 1 / 257


def test_mask_spreads_over_all_that_a_masked_pixel_touches():
    valid = np.ones((64, 96), np.uint8)
    valid[30, 40] = 0
    _, mask = warp(picture(), valid, PINHOLE, MisalignParams(rows=0.5))
    # row r shows r - 0.5 and reads rows r - 2 ... r + 1; columns c - 1 ... c + 2
    hole = np.argwhere(mask[5:-5, 5:-5] == 0) + 5
    assert hole.min(0).tolist() == [29, 38]
    assert hole.max(0).tolist() == [32, 41]


def test_distorted_images_are_turned_along_their_own_rays():
    lens = Lens(CAMERA, "radtan", (-0.2, 0.05, 0.001, -0.001))
    column, row = origins(lens, MisalignParams(roll_deg=10.0))
    at = np.stack([column, row], -1)[20:45:6, 20:80:10].reshape(-1, 2)
    here = np.stack(np.meshgrid(np.arange(20, 80, 10), np.arange(20, 45, 6)), -1).reshape(-1, 2).astype(float)
    turn = rotation_exp([0.0, 0.0, math.radians(10.0)])
    before, after = (CAMERA.rays(lens.undistort(p, CAMERA)) for p in (at, here))
    np.testing.assert_allclose(before @ turn.T, after, atol=1e-6)


def test_only_the_right_images_change():
    plain = mockup(MockupParams(**SHORT))
    bent = misalign(plain, ALL)
    assert bent.image(3, "left") == plain.image(3, "left")
    source = bent.image(3, "right")
    assert source.inputs["image"] == plain.image(3, "right")
    assert (source.module, source.params, source.args["frame"]) == ("rille.datasets.images.misalign", ALL, 3)
    assert bent.rig == plain.rig
    assert bent.truth == plain.truth
    assert bent.truth_disparity is None
    assert "on purpose: 2.5 px" in bent.notes[-1]
    assert bent.parameters["misalign"] is ALL
    assert set(bent.parameters) == {"mockup", "misalign"}


def test_nothing_asked_is_the_same_sequence():
    plain = mockup(MockupParams(**SHORT))
    assert misalign(plain, MisalignParams()) is plain
    later = misalign(plain, MisalignParams(yaw_deg=0.3, since=5))
    assert [later.image(frame, "right") == plain.image(frame, "right") for frame in (4, 5)] == [True, False]
    assert "on purpose from frame 5 on: " in later.notes[-1]


def test_real_optics_are_used_where_there_are_any():
    lens = Lens(CAMERA, "radtan", (-0.2, 0.05, 0.0, 0.0))
    plain = replace(mockup(MockupParams(**SHORT)), lenses={"left": lens, "right": lens})
    assert Lens.from_dict(misalign(plain, ALL).image(0, "right").args["lens"]) == lens


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_stage_keeps_the_depth(dtype):
    stage = module.misalign_stage
    given = Bundle({"image": picture(dtype), "valid": np.ones((64, 96), np.uint8)}, {})
    args = {"frame": 2, "camera": "right", "lens": PINHOLE.to_dict()}
    out = stage.run(ALL, args, {"image": given})
    check_outputs(stage, out)
    assert out.meta == {"frame": 2, "camera": "right"}
    again = stage.run(ALL, args, {"image": given})
    assert again["image"].tobytes() == out["image"].tobytes()
