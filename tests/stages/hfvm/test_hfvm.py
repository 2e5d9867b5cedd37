"""Dense matching of whole images: exactly known displacements, degraded input, and pairs with true disparity."""

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from matching_scenes import convergent_rig, pair, rig_displacement, seen
from raising import raises

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.core.validity import Validity, defined, has, matched
from rille.stages.hfvm import stage as hfvm
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.stage import match
from rille.stages.imaging import pyramid
from rille.stages.imaging.pyramid import PyramidParams

BORDER = 8
"""Pixels: features and windows reach over the edge of an image there."""


def score(found, u, v, right_shape):
    """Median error of matched pixels, pixels, and the matched share of those that both images see."""
    both = seen(u, v, right_shape, BORDER)
    ok = matched(found.validity) & both
    error = np.hypot(found.column_disparity - u, found.row_disparity - v)[ok]
    return float(np.median(error)), float(np.mean(error < 0.5)), ok.sum() / both.sum()


@pytest.mark.parametrize("shift", [(-7.0, 3.0), (0.0, 0.0), (24.0, -15.0), (-6.5, 0.25), (3.3, -2.8)])
def test_known_shifts_in_both_directions(shift):
    left, right, u, v = pair(lambda x, y: shift)
    median, good, complete = score(match(left, right), u, v, right.shape)
    # No noise: what is left is the cubic interpolation of wavelengths from 5 pixels, a few hundredths.
    assert median < 0.05
    assert good > 0.99
    assert complete > 0.97


def test_a_shift_of_the_right_image_is_added_to_the_disparity():
    displacement = lambda x, y: (-6.0 + 2.0 * np.sin(x / 30) * np.cos(y / 25), 0.5 * np.cos(x / 40))  # noqa: E731
    left, right, *_ = pair(displacement)
    _, moved, *_ = pair(displacement, seed=0, right_shape=(150, 200))
    first, second = match(left, right), match(left, np.ascontiguousarray(moved[4:, 9:]))
    both = matched(first.validity) & matched(second.validity)
    both[:, :24] = both[:18] = both[-18:] = both[:, -24:] = False
    assert both.sum() > 5000
    # The pyramids differ in phase, so whole pixels are searched anew; sub-pixel results agree within their error.
    du = (second.column_disparity - first.column_disparity)[both]
    dv = (second.row_disparity - first.row_disparity)[both]
    assert np.percentile(np.abs(du + 9.0), 95) < 0.1
    assert np.percentile(np.abs(dv + 4.0), 95) < 0.1


def test_row_offset_and_roll():
    angle = np.radians(4.0)

    def displacement(x, y):
        dx, dy = x - 90.0, y - 70.0
        return np.cos(angle) * dx - np.sin(angle) * dy - dx - 8.0, np.sin(angle) * dx + np.cos(angle) * dy - dy + 12.0

    left, right, u, v = pair(displacement)
    median, good, complete = score(match(left, right), u, v, right.shape)
    assert median < 0.06
    assert good > 0.98
    assert complete > 0.93


def bumpy_ground(x, y):
    """Depth, metres, of a camera that looks obliquely at ground with bumps."""
    return 0.9 - 0.0035 * (y - 70) + 0.012 * np.sin(x / 9.0) * np.sin(y / 8.0)


def test_convergent_cameras_over_oblique_ground():
    rig = convergent_rig()
    left, right, u, v = pair(rig_displacement(rig, bumpy_ground), noise=1.0)
    found = match(left, right)
    median, good, complete = score(found, u, v, right.shape)
    # 5 x 5 windows over a texture of 35 grey levels and noise of one: .03 px; the bumps bend windows by as much again.
    assert median < 0.12
    assert good > 0.95
    assert complete > 0.9


def test_alignment_by_a_plane_is_what_makes_sheared_ground_match():
    left, right, u, v = pair(lambda x, y: (10.0 - 0.55 * y, 0.01 * x), (160, 200), (160, 220), noise=1.0)
    aligned = match(left, right)
    plain = match(left, right, HfvmParams(without=("align",)))
    assert aligned.unlike.aligned
    assert not plain.unlike.aligned
    error, _, complete = score(aligned, u, v, right.shape)
    plain_error, _, plain_complete = score(plain, u, v, right.shape)
    # Noise alone costs .03 px; the right image lies 0.55 columns a row askew in the last, refining windows.
    assert error < 0.08
    assert complete > 0.95
    assert plain_error > 2 * error
    assert plain_complete < complete


def test_swapped_images_give_the_inverse_map():
    left, right, *_ = pair(lambda x, y: (-9.0 + 3 * np.sin(y / 30), 1.0))
    found = match(right, left)
    ok = matched(found.validity)
    y, x = np.nonzero(ok)
    back_x = x + found.column_disparity[ok]
    truth = -9.0 + 3 * np.sin((y - 1.0) / 30)
    assert ok.mean() > 0.8
    assert np.median(np.abs(back_x + truth - x)) < 0.05


def test_images_of_different_size():
    left, right, u, v = pair(lambda x, y: (-5.0, 2.0), (97, 141), (131, 118))
    found = match(left, right)
    assert found.column_disparity.shape == (97, 141)
    median, _, complete = score(found, u, v, right.shape)
    assert median < 0.05
    assert complete > 0.95
    y, x = np.indices(u.shape)
    outside = (x - 5 < -1) | (x - 5 > 118) | (y + 2 > 131)  # by more than the pixel that back-matching allows
    # Beside the border single pixels match by chance: of twenty other displacements 3 in a thousand.
    assert matched(found.validity)[outside].mean() < 0.002


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (3, 3), (2, 300), (33, 17), (64, 64)])
@pytest.mark.parametrize("preset", ["default", "fast", "paper"])
def test_black_images_of_any_size_match_nowhere(shape, preset):
    found = match(np.zeros(shape, np.uint8), np.zeros(shape, np.uint8), HfvmParams(preset=preset, texture=0.5))
    assert found.column_disparity.shape == shape
    assert not defined(found.validity).any()
    assert has(found.validity, Validity.NO_TEXTURE).all()
    assert np.isnan(found.column_disparity).all()


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (2, 90)])
def test_tiny_textured_images_do_not_crash(shape):
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 255, (2, *shape)).astype(np.uint8)
    found = match(a, b[:, ::-1])
    np.testing.assert_array_equal(np.isnan(found.row_disparity), ~defined(found.validity))


def test_flat_half_is_not_matched_but_said_to_lack_texture():
    left, right, *_ = pair(lambda x, y: (-5.0, 0.0))
    left[:, 90:], right[:, 85:] = 50.0, 50.0
    found = match(left, right)
    flat = np.s_[10:-10, 105:-10]
    assert has(found.validity[flat], Validity.NO_TEXTURE).all()
    assert not matched(found.validity[flat]).any()
    assert matched(found.validity[10:-10, 20:75]).mean() > 0.95


def test_unrelated_images_give_few_matches():
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (150, 200)).astype(np.uint8) for _ in range(2)]
    assert matched(match(*noise).validity).mean() < 0.01
    left, *_ = pair(lambda x, y: (0.0, 0.0), seed=1)
    _, right, *_ = pair(lambda x, y: (0.0, 0.0), seed=7)
    assert matched(match(left, right).validity).mean() < 0.05


def test_noise_is_not_matched_where_a_shadow_hides_the_texture():
    left, right, *_ = pair(lambda x, y: (-5.0, 0.0), (160, 200))
    left[40:120, 60:160] = 8.0
    right[40:120, 55:155] = 8.0
    rng = np.random.default_rng(0)
    found = match(*(a + rng.normal(0, 1.5, a.shape).astype(np.float32) for a in (left, right)))
    shadow = np.s_[50:110, 70:150]
    assert matched(found.validity[shadow]).mean() < 0.1
    assert matched(found.validity[10:30, 20:180]).mean() > 0.95


def test_texture_half_as_strong_as_the_right_images_noise_is_matched():
    left, right, u, v = pair(lambda x, y: (-9 + 4 * np.sin(x / 30) * np.cos(y / 25), 0.0), (150, 211))
    # Contrast 2.5 grey levels; only the right image has noise, so that the windows of no match look alike.
    left, right = (128 + 0.07 * (a - 128) for a in (left, right))
    found = match(left, right + np.random.default_rng(5).normal(0, 5, right.shape).astype(np.float32))
    inside = seen(u, v, right.shape, BORDER)
    near = np.hypot(found.column_disparity - u, found.row_disparity - v) < 1
    assert np.mean((matched(found.validity) & near)[inside]) > 0.6
    assert np.mean(near[inside & matched(found.validity)]) > 0.85


def test_random_dots_match_at_fractions_of_a_pixel_though_they_look_like_noise():
    left = np.random.default_rng(0).integers(0, 256, (120, 160)).astype(np.uint8)
    moved = cv2.warpAffine(left, np.array([[1.0, 0.0, 0.4], [0.0, 1.0, 0.0]]), (160, 120), flags=cv2.INTER_CUBIC)
    found = match(left, np.roll(moved, (2, -7), (0, 1)))
    assert matched(found.validity).mean() > 0.8
    assert np.median(found.column_disparity[matched(found.validity)]) == pytest.approx(-6.6, abs=0.05)


def test_masked_pixels_are_never_matched_nor_matched_to():
    left, right, u, v = pair(lambda x, y: (-8.0, 1.0))
    left_valid, right_valid = np.ones(left.shape, np.uint8), np.ones(right.shape, np.uint8)
    left_valid[30:60, 40:80] = 0
    right_valid[80:110, 100:140] = 0
    found = match(left, right, valid=(left_valid, right_valid))
    assert not defined(found.validity)[left_valid == 0].any()
    y, x = np.nonzero(matched(found.validity))
    xr = np.rint(x + found.column_disparity[y, x]).astype(int)
    yr = np.rint(y + found.row_disparity[y, x]).astype(int)
    assert (right_valid[yr, xr] == 1).all()
    away = seen(u, v, right.shape, BORDER) & (left_valid == 1) & ~np.roll(right_valid == 0, (-1, 8), (0, 1))
    assert matched(found.validity)[away].mean() > 0.93


def test_validity_says_one_thing_about_each_pixel():
    left, right, *_ = pair(lambda x, y: (-8.0, 1.0), noise=3.0)
    bits = match(left, right).validity
    reasons = Validity.BACKMATCH_FAILED | Validity.OVER_THRESHOLD | Validity.OUT_OF_IMAGE | Validity.NO_TEXTURE
    assert not (matched(bits) & has(bits, reasons | Validity.SPECKLE | Validity.INTERPOLATED)).any()
    assert (matched(bits) | has(bits, reasons | Validity.SPECKLE)).all()
    assert np.array_equal(matched(bits) | has(bits, Validity.INTERPOLATED), defined(bits))


def test_same_result_in_every_thread():
    left, right, *_ = pair(lambda x, y: (-8.0, 1.0 + 0.02 * x), noise=2.0)
    once = match(left, right)
    with ThreadPoolExecutor(2) as pool:
        for again in pool.map(lambda _: match(left, right), range(3)):
            for name in ("column_disparity", "row_disparity", "validity", "backmatch_error", "distance"):
                np.testing.assert_array_equal(getattr(again, name), getattr(once, name))


def test_sixteen_bit_and_eight_bit_images_match_alike():
    left, right, *_ = pair(lambda x, y: (-8.0, 1.0))
    left, right = (a.clip(0, 255).astype(np.uint8) for a in (left, right))
    eight, sixteen = match(left, right), match(left.astype(np.uint16) * 257, right.astype(np.uint16) * 257)
    assert np.mean(eight.validity == sixteen.validity) > 0.999
    np.testing.assert_allclose(np.nanmedian(np.abs(eight.column_disparity - sixteen.column_disparity)), 0, atol=1e-4)


def test_preset_paper_matches_and_its_values_yield_to_the_users():
    left, right, u, v = pair(lambda x, y: (-6.4, 1.3), noise=1.0)
    median, good, complete = score(match(left, right, HfvmParams(preset="paper")), u, v, right.shape)
    # One pixel's distances: about .3 px (measured on true disparities), no averaging.
    assert median < 0.3
    assert good > 0.8
    assert complete > 0.7
    assert HfvmParams(preset="paper").weights == (2, 2, 3, 3, 3, 3, 10, 4)
    assert HfvmParams(preset="paper", threshold=3.0).threshold == 3.0
    strict = match(left, right, HfvmParams(preset="paper", threshold=1.0))
    assert has(strict.validity, Validity.OVER_THRESHOLD).mean() > 0.5


def test_preset_fast_matches_at_half_the_resolution():
    shape = (151, 203)
    left, right, u, v = pair(lambda x, y: (-6.4, 1.3), shape=shape, right_shape=shape, noise=1.0)
    valid = np.ones(left.shape, np.uint8)
    valid[40:50, 60:81] = 0
    found = match(left, right, HfvmParams(preset="fast"), valid=(valid, None))
    median, good, complete = score(found, u, v, right.shape)
    assert found.column_disparity.shape == shape
    # The shortest wavelengths, 5 pixels, are 2.5 at half the resolution: a tenth of a pixel there, two tenths here.
    assert median < 0.3
    assert good > 0.9
    assert complete > 0.85
    assert not defined(found.validity)[valid == 0].any()
    y, x = np.nonzero(matched(found.validity))
    xr, yr = x + found.column_disparity[y, x], y + found.row_disparity[y, x]
    assert xr.min() >= 0
    assert yr.min() >= 0
    assert xr.max() <= shape[1] - 1
    assert yr.max() <= shape[0] - 1


@pytest.mark.parametrize("preset", ["default", "fast"])
def test_matches_in_two_threads_are_those_of_one(preset):
    pairs = [pair(lambda x, y: (-5.3, 0.7), seed=seed)[:2] for seed in (1, 2, 3)]
    alone = [match(*p, HfvmParams(preset=preset)) for p in pairs]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(lambda p: match(*p, HfvmParams(preset=preset)), pairs))
    for a, b in zip(alone, together, strict=True):
        for name in ("column_disparity", "row_disparity", "validity", "backmatch_error", "distance"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_refuses_colour():
    with raises("RIL-411"):
        match(np.zeros((5, 5, 3), np.uint8), np.zeros((5, 5), np.uint8))


def test_stage_gives_what_it_declares():
    left, right, *_ = pair(lambda x, y: (-8.0, 1.0))
    valid = np.ones(left.shape, np.uint8)
    bundles = [
        pyramid.pyramid_stage.run(PyramidParams(), {}, {"image": Bundle({"image": a, "valid": valid}, {})})
        for a in (left, right)
    ]
    out = hfvm.hfvm_stage.run(HfvmParams(), {}, {"left": bundles[0], "right": bundles[1]})
    check_outputs(hfvm.hfvm_stage, out)
    assert 0.8 < out.meta["match_rate"] < 1
    np.testing.assert_array_equal(out["column_disparity"], match(left, right).column_disparity)


def bad_2(found, truth):
    """Share of all true pixels that are off by more than 2 px or undefined (fills included)."""
    return float(np.mean(~(np.abs(found.column_disparity - truth) <= 2)[np.isfinite(truth)]))


@pytest.fixture
def motorcycle(data_dir):
    folder = data_dir / "motorcycle"
    with np.load(folder / "motorcycle_disp.npz") as z:
        truth = z[z.files[0]].astype(np.float32)
    left, right = (cv2.imread(str(folder / f"motorcycle_{side}.png"), 0) for side in ("left", "right"))
    return left, right, np.where(np.isfinite(truth) & (truth > 0), -truth, np.nan)


@pytest.fixture
def cones(data_dir):
    folder = data_dir / "cones"
    truth = cv2.imread(str(folder / "cones_disp_02.png"), 0).astype(np.float32) / 4
    left, right = (cv2.imread(str(folder / f"cones_image_0{n}.png"), 0) for n in (2, 6))
    return left, right, np.where(truth > 0, -truth, np.nan)


@pytest.mark.data
def test_motorcycle_error_and_completeness(motorcycle):
    left, right, truth = motorcycle
    found = match(left, right)
    ok = matched(found.validity) & np.isfinite(truth)
    assert bad_2(found, truth) <= 0.09
    assert ok.sum() / np.isfinite(truth).sum() >= 0.85
    assert np.median(np.abs(found.column_disparity - truth)[ok]) <= 0.15
    assert np.median(np.abs(found.row_disparity)[ok]) <= 0.15


@pytest.mark.data
def test_motorcycle_with_a_roll_of_two_degrees(motorcycle):
    left, right, truth = motorcycle
    rows, cols = right.shape
    turn = cv2.getRotationMatrix2D(((cols - 1) / 2, (rows - 1) / 2), 2.0, 1.0)
    size = (cols, rows)
    rolled = cv2.warpAffine(right, turn, size, flags=cv2.INTER_CUBIC)
    valid = cv2.warpAffine(np.ones_like(right), turn, size, flags=cv2.INTER_NEAREST)
    found = match(left, rolled, valid=(None, valid))
    y, x = np.indices(truth.shape, dtype=np.float32)
    u = turn[0, 0] * (x + truth) + turn[0, 1] * y + turn[0, 2] - x
    ok = matched(found.validity) & np.isfinite(truth)
    # A semi-global matcher that trusts the rows is off at 56 % of the pixels here.
    assert bad_2(found, u) <= 0.13
    assert ok.sum() / np.isfinite(truth).sum() >= 0.8


@pytest.mark.data
def test_cones_error_and_completeness(cones):
    left, right, truth = cones
    found = match(left, right)
    ok = matched(found.validity) & np.isfinite(truth)
    assert bad_2(found, truth) <= 0.105
    assert ok.sum() / np.isfinite(truth).sum() >= 0.84
    assert np.median(np.abs(found.column_disparity - truth)[ok]) <= 0.15


@pytest.mark.data
def test_pair_that_is_neither_rectified_nor_undistorted(data_dir):
    left, right = (cv2.imread(str(data_dir / "nasa_k10" / f"{side}4.png"), 0) for side in ("left", "right"))
    found = match(left, right)
    assert matched(found.validity).mean() >= 0.7
    assert -17 < np.median(found.row_disparity[matched(found.validity)]) < -8


@pytest.mark.data
def test_unrelated_photographs_give_few_matches(cones, motorcycle):
    assert matched(match(cones[0], motorcycle[1][60:435, 200:650]).validity).mean() <= 0.02
