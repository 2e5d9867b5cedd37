from functools import lru_cache

import numpy as np
import pytest
from raising import raises

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.geometry.geometry import Camera
from rille.stages.geometry.lens import Lens
from rille.stages.imaging import undistort

RAW = Camera(230.0, 229.0, 184.0, 124.0, 376, 240)
LENSES = {
    "radtan": Lens(RAW, "radtan", (-0.283, 0.074, 2e-4, -3e-4)),
    "rational": Lens(RAW, "rational", (0.3, 0.02, 1e-4, 2e-4, 0.001, 0.6, 0.1, 0.005)),
    "fisheye": Lens(Camera(400.0, 399.0, 188.0, 119.0, 376, 240), "fisheye", (0.0035, 0.0007, -0.0021, 0.0002)),
}
AMPLITUDE = 60.0


def pattern(x, y, period):
    turn = 2 * np.pi / period
    return 128 + AMPLITUDE * np.sin(turn * x) + AMPLITUDE * np.sin(turn * y)


@lru_cache
def ideal_pixels(lens):
    """Where each raw pixel lies in the ideal image."""
    y, x = np.mgrid[0 : lens.camera.height, 0 : lens.camera.width].astype(float)
    return lens.undistort(np.stack([x.ravel(), y.ravel()], 1))


def taken(lens, period):
    """Raw image of the pattern as ``lens`` takes it."""
    image = pattern(*ideal_pixels(lens).T, period)
    return image.reshape(lens.camera.height, lens.camera.width).astype(np.float32)


def displacements(image, valid, period, block=40):
    """Column and row shift of each whole block against the pattern, by least squares."""
    y, x = np.mgrid[0 : image.shape[0], 0 : image.shape[1]].astype(float)
    turn = 2 * np.pi / period
    slopes = [AMPLITUDE * turn * np.cos(turn * p) for p in (x, y)]
    missing = image - pattern(x, y, period)
    shifts = []
    for i in range(0, image.shape[0] - block, block):
        for j in range(0, image.shape[1] - block, block):
            at = np.s_[i : i + block, j : j + block]
            if valid[at].all():
                a = np.stack([s[at].ravel() for s in slopes], 1)
                shifts.append(np.linalg.lstsq(a, missing[at].ravel(), rcond=None)[0])
    return np.array(shifts)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("period", [8.0, 16.0])
def test_content_lies_where_the_ideal_camera_sees_it(lens, period):
    ideal = lens.ideal_camera()
    image, valid = undistort.undistort(taken(lens, period), lens, ideal)
    shifts = displacements(image, valid, period)
    assert len(shifts) > 20
    assert np.abs(shifts).max() < 0.005


def test_principal_point_a_quarter_pixel_further_right():
    lens, moved = Lens(RAW), Camera(RAW.fx, RAW.fy, RAW.cx + 0.25, RAW.cy, RAW.width, RAW.height)
    image, valid = undistort.undistort(taken(lens, 12.0), lens, moved)
    y, x = np.mgrid[0 : RAW.height, 0 : RAW.width].astype(float)
    ok = valid == 1
    # A cubic spline at a 12-pixel period: error of the fourth order, below a tenth of a grey value.
    np.testing.assert_allclose(image[ok], pattern(x - 0.25, y, 12.0)[ok], atol=0.2)


def test_without_distortion_the_inside_stays_and_the_border_is_masked():
    raw = np.random.default_rng(1).integers(0, 256, (240, 376)).astype(np.uint8)
    image, valid = undistort.undistort(raw, Lens(RAW), RAW)
    np.testing.assert_allclose(image[valid == 1], raw[valid == 1].astype(np.float32), atol=1e-3)
    inside = np.zeros(raw.shape, np.uint8)
    inside[2:-3, 2:-3] = 1
    np.testing.assert_array_equal(valid, inside)
    assert not image[valid == 0].any()


def test_mask_takes_all_that_touches_it():
    raw, mask = np.full((240, 376), 90, np.uint8), np.ones((240, 376), np.uint8)
    mask[100, 200] = 0
    raw[100, 200] = 255
    image, valid = undistort.undistort(raw, Lens(RAW), RAW, mask)
    # Taps 2 before to 3 behind: pixels 3 before to 2 behind the masked one use it.
    np.testing.assert_array_equal(np.argwhere(valid[2:-3, 2:-3] == 0).min(axis=0) + 2, [97, 197])
    np.testing.assert_array_equal(np.argwhere(valid[2:-3, 2:-3] == 0).max(axis=0) + 2, [102, 202])
    np.testing.assert_allclose(image[valid == 1], 90, atol=1e-3)


def test_not_finite_is_not_usable():
    raw = np.full((240, 376), 90, np.float32)
    raw[100, 200] = np.nan
    image, valid = undistort.undistort(raw, Lens(RAW), RAW)
    assert np.isfinite(image).all()
    assert valid[100, 200] == 0


def test_where_the_model_folds_back_nothing_is_seen():
    lens = Lens(RAW, "radtan", (-0.9, 0.0, 0.0, 0.0))
    raw = np.full((240, 376), 90, np.uint8)
    _, valid = undistort.undistort(raw, lens, RAW)
    y, x = np.mgrid[0:240, 0:376].astype(float)
    # r (1 - 0.9 r^2) turns at r = sqrt(1 / 2.7); beyond it the ghost would read pixels inside the raw image.
    r = np.hypot((x - RAW.cx) / RAW.fx, (y - RAW.cy) / RAW.fy)
    assert not valid[r > np.sqrt(1 / 2.7)].any()
    ghost = (r > np.sqrt(1 / 2.7)) & (r * (1 - 0.9 * r**2) > 0)
    assert ghost.sum() > 1000
    assert valid[r < 0.4].all()


def test_sixteen_bits_are_the_same_grey():
    raw = np.random.default_rng(2).integers(0, 256, (240, 376)).astype(np.uint8)
    lens = LENSES["radtan"]
    eight, valid = undistort.undistort(raw, lens, RAW)
    sixteen, same = undistort.undistort(raw.astype(np.uint16) * 257, lens, RAW)
    np.testing.assert_allclose(sixteen, eight, atol=1e-3)
    np.testing.assert_array_equal(valid, same)
    assert eight.min() >= 0
    assert eight.max() <= 255


def run(image, lens, camera):
    inputs = {"image": Bundle({"image": image, "valid": np.ones(image.shape, np.uint8)}, {})}
    args = {"lens": lens.to_dict(), "camera": camera.to_dict(), "frame": 7, "camera_name": "right"}
    return undistort.undistort_stage.run(NoParams(), args, inputs)


def test_stage():
    out = run(np.full((240, 376), 90, np.uint8), LENSES["radtan"], RAW)
    check_outputs(undistort.undistort_stage, out)
    assert out["image"].shape == (240, 376)
    assert np.mean(out["valid"]) == pytest.approx(1.0, abs=0.05)


def test_image_of_another_size_is_named():
    with raises("RIL-454", "frame 7", "300 x 200", "376 x 240"):
        run(np.zeros((200, 300), np.uint8), LENSES["radtan"], RAW)
    with raises("RIL-413"):
        undistort.undistort(np.zeros((240, 376), np.uint8), Lens(RAW), RAW, np.ones((3, 3)))
