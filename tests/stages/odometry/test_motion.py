import cv2
import numpy as np
import pytest
from matching_scenes import Texture, pair

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.core.validity import defined, matched
from rille.stages.geometry.geometry import Camera, rotation_exp
from rille.stages.imaging.pyramid import PyramidParams, build
from rille.stages.odometry import motion
from rille.stages.odometry.motion import MotionParams, coarse_motion


def forward_flow(x, y):
    """Radial flow of a camera that moves forward over a plane, 40 pixels at the edge, and some rotation."""
    return 0.2 * (x - 200) + 6.0, 0.2 * (y - 140) - 4.0


@pytest.mark.parametrize("level", [1, 2])
def test_radial_flow_in_pixels_of_level_0_on_the_grid_of_its_level(level):
    a, b, *_ = pair(forward_flow, (280, 400))
    found = coarse_motion(build(a, PyramidParams()), build(b, PyramidParams()), MotionParams(level=level))
    scale = 2**level
    assert found.level == level
    assert found.column_disparity.shape == (280 // scale, 400 // scale)
    row, col = np.indices(found.validity.shape)
    x, y = (col + 0.5) * scale - 0.5, (row + 0.5) * scale - 0.5
    u, v = forward_flow(x, y)
    ok = matched(found.validity)
    inside = (x + u > 16) & (x + u < 383) & (y + v > 16) & (y + v < 263)
    assert ok[inside].mean() > 0.85
    error = np.hypot(found.column_disparity - u, found.row_disparity - v)
    # Sub-pixel at the coarse level: half of its pixel, as far as windows tell it.
    assert np.percentile(error[ok & inside], 95) < 0.5 * scale
    np.testing.assert_array_equal(np.isnan(found.column_disparity), ~defined(found.validity))


def test_shallow_pyramids_answer_at_their_top():
    a, b, *_ = pair(lambda x, y: (3.0, 0.0), (20, 30))
    found = coarse_motion(build(a, PyramidParams()), build(b, PyramidParams()), MotionParams(level=3))
    assert found.level == 1
    assert found.validity.shape == (10, 15)


def test_black_frames_have_no_motion():
    black = build(np.zeros((64, 64), np.uint8), PyramidParams())
    assert not defined(coarse_motion(black, black, MotionParams()).validity).any()


def run(a, b, **params):
    bundles = []
    for image in (a, b):
        p = build(image, PyramidParams())
        arrays = {f"level_{n}": i for n, i in enumerate(p.images)} | {f"valid_{n}": i for n, i in enumerate(p.valid)}
        bundles.append(Bundle(arrays, {"levels": p.levels}))
    out = motion.motion_stage.run(MotionParams(**params), {}, {"a": bundles[0], "b": bundles[1]})
    check_outputs(motion.motion_stage, out)
    return out


def test_overlap_of_a_frame_that_moved_by_a_quarter():
    a, b, *_ = pair(lambda x, y: (50.0, 0.0), (160, 200))
    out = run(a, b)
    assert out.meta["level"] == 2
    assert np.nanmedian(out["column_disparity"]) == pytest.approx(50, abs=1)
    assert out.meta["overlap"] == pytest.approx(0.75, abs=0.05)
    assert out.meta["overlap"] <= out.meta["match_rate"]


def test_meta_of_nothing_is_none():
    out = run(np.zeros((40, 40), np.uint8), np.zeros((40, 40), np.uint8))
    assert out.meta["median_length"] is None
    assert out.meta["match_rate"] == 0


@pytest.mark.data
def test_street_with_motion_of_tens_of_pixels(data_dir):
    images = [cv2.imread(str(data_dir / "kitti06_51" / "image_l" / f"{n:06d}.png"), 0) for n in (20, 21)]
    found = coarse_motion(*(build(i, PyramidParams()) for i in images), MotionParams())
    corners = cv2.goodFeaturesToTrack(images[0], 400, 0.01, 10)
    # An independent witness: Lucas-Kanade there and back.
    options = {"winSize": (15, 15), "maxLevel": 4}
    there, _, _ = cv2.calcOpticalFlowPyrLK(*images, corners, None, **options)
    back, _, _ = cv2.calcOpticalFlowPyrLK(*images[::-1], there, None, **options)
    good = np.hypot(*(back - corners).reshape(-1, 2).T) < 0.3
    p, flow = corners.reshape(-1, 2)[good], (there - corners).reshape(-1, 2)[good]
    col, row = np.rint((p.T + 0.5) / 4 - 0.5).astype(int)
    row, col = row.clip(0, found.validity.shape[0] - 1), col.clip(0, found.validity.shape[1] - 1)
    error = np.hypot(found.column_disparity[row, col] - flow[:, 0], found.row_disparity[row, col] - flow[:, 1])
    assert np.hypot(*flow.T).max() > 50
    assert np.mean(error < 4) > 0.95
    assert matched(found.validity).mean() > 0.6


CAMERA = Camera(350.0, 350.0, 199.5, 139.5, 400, 280)


def taken(flow):
    """Frames a and b of a flow, with waves up to 360 pixels: natural images have texture on every pyramid level."""
    texture = Texture()
    texture.kx[::2] /= 6.0
    texture.ky[::2] /= 6.0
    y, x = np.indices((CAMERA.height, CAMERA.width), dtype=np.float64)
    u, v = flow(x, y)
    return texture(x + u, y + v), texture(x, y)


def held(rotation, du=3.0, dv=-2.0):
    """Flow of a camera that turns by R_b_a and of some shift behind it."""
    h = CAMERA.matrix @ rotation @ np.linalg.inv(CAMERA.matrix)

    def flow(x, y):
        p = np.einsum("ij,jrc->irc", h, np.stack([x + du, y + dv, np.ones_like(x)]))
        return p[0] / p[2] - x, p[1] / p[2] - y

    return flow


def judge(found, flow):
    """Shares of the pixels whose match is in the image that are matched, and of those that are wrong by a pixel."""
    scale = 2**found.level
    row, col = np.indices(found.validity.shape)
    x, y = (col + 0.5) * scale - 0.5, (row + 0.5) * scale - 0.5
    u, v = flow(x, y)
    inside = (x + u > 24) & (x + u < 375) & (y + v > 24) & (y + v < 255)
    ok = matched(found.validity) & inside
    wrong = np.hypot(found.column_disparity - u, found.row_disparity - v)[ok] > scale
    return ok.sum() / inside.sum(), wrong.mean() if wrong.size else 0.0


def turn_of(rotation):
    return CAMERA.matrix @ rotation @ np.linalg.inv(CAMERA.matrix)


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 0, -1), (0.15, -0.2, 0.9)])
def test_a_turn_of_thirty_degrees_is_undone(axis):
    rotation = rotation_exp(np.radians(30.0) * np.array(axis))
    flow = held(rotation)
    a, b = taken(flow)
    pyramids = build(a, PyramidParams()), build(b, PyramidParams())
    share, wrong = judge(coarse_motion(*pyramids, MotionParams()), flow)
    assert share < 0.4  # upright windows do not match
    # One that is off by three degrees leaves 18 pixels to the search.
    for error in ((0.0, 0.0, 0.0), (0.03, -0.03, 0.03)):
        turn = turn_of(rotation_exp(error) @ rotation)
        share, wrong = judge(coarse_motion(*pyramids, MotionParams(), turn), flow)
        assert share > 0.85
        assert wrong < 0.03


def test_a_turn_by_half_the_field_of_view_is_found_by_keypoints():
    flow = held(rotation_exp(np.radians([3.0, -27.0, 9.0])), 12.0, -7.0)
    images = taken(flow)
    shares = {}
    for below in (0.0, 0.5):
        out = run(*images, turn_below=below)
        shares[below], wrong = judge(motion.Motion.of(out), flow)
    assert shares[0.0] < 0.4
    assert shares[0.5] > 0.8
    assert wrong < 0.03


def test_masked_pixels_of_a_turned_frame_match_nothing():
    rotation = rotation_exp([0.0, 0.0, 0.4])
    flow = held(rotation, 0.0, 0.0)
    a, b = taken(flow)
    valid = np.ones(b.shape, np.uint8)
    valid[:, 250:] = 0
    found = coarse_motion(
        build(a, PyramidParams()), build(b, PyramidParams(), valid), MotionParams(), turn_of(rotation)
    )
    x = (np.indices(found.validity.shape)[1] + 0.5) * 4 - 0.5 + found.column_disparity
    ok = matched(found.validity)
    assert ok.mean() > 0.3
    assert x[ok].max() < 250 + 4
