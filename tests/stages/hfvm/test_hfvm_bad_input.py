"""What the matcher makes of images that are no good pair: nothing, or what there is to find, and never a crash."""

import cv2
import numpy as np
import pytest
from matching_scenes import pair, seen

from rille.stages.core.errors import InputError
from rille.stages.core.validity import Validity, defined, has, matched
from rille.stages.hfvm.finest import isolated
from rille.stages.hfvm.matcher import MatchOptions
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.stage import match

BORDER = 8
MOST_CHANCE = 0.05
"""Share of pixels of two unrelated images that may claim to be matched."""


def byte(image):
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def share_within(found, u, v, right_shape, pixels):
    both = matched(found.validity) & seen(u, v, right_shape, BORDER)
    error = np.hypot(found.column_disparity - u, found.row_disparity - v)[both]
    return float(np.mean(error < pixels)), both.sum() / seen(u, v, right_shape, BORDER).sum()


@pytest.mark.parametrize("value", [0, 128, 255])
def test_images_without_texture_are_said_to_have_none(value):
    flat = np.full((90, 120), value, np.uint8)
    found = match(flat, flat)
    assert not defined(found.validity).any()
    assert has(found.validity, Validity.NO_TEXTURE).all()
    assert np.isnan(found.disparity_std).all()


def test_one_black_image():
    left, *_ = pair(lambda x, y: (-5.0, 0.0))
    for images in ((left, np.zeros_like(left)), (np.zeros_like(left), left)):
        assert not matched(match(*images).validity).any()


def test_saturated_parts_do_not_match_and_the_rest_does():
    left, right, *_ = pair(lambda x, y: (-6.0, 1.0), (160, 200))
    left[50:110, 70:140] += 250
    right[51:111, 64:134] += 250
    found = match(byte(left), byte(right))
    assert not matched(found.validity)[60:100, 80:130].any()
    assert has(found.validity[60:100, 80:130], Validity.NO_TEXTURE).all()
    ok = matched(found.validity)
    ok[40:120, 60:150] = False
    assert np.mean(np.abs(found.column_disparity + 6.0)[ok] < 0.3) > 0.99
    assert ok.sum() > 0.9 * (144 * 178 - 80 * 90)


@pytest.mark.parametrize("ratio", [0.5, 2.0])
def test_exposure_ratio_of_two(ratio):
    # Mean 64 and contrast 18 on one side, 128 and 35 on the other, a little noise on both.
    left, right, u, v = pair(lambda x, y: (-7.3 + np.sin(x / 25), 0.6))
    dark, bright = (left, right) if ratio == 2.0 else (right, left)
    rng = np.random.default_rng(0)
    dark, bright = (byte(a + rng.normal(0, 1, a.shape)) for a in (0.5 * dark, bright))
    found = match(*((dark, bright) if ratio == 2.0 else (bright, dark)))
    good, complete = share_within(found, u, v, right.shape, 0.5)
    assert good > 0.97
    assert complete > 0.9


@pytest.mark.parametrize("shapes", [((97, 141), (60, 300)), ((40, 40), (200, 220)), ((150, 33), (33, 150))])
def test_sizes_may_differ(shapes):
    left, right, u, v = pair(lambda x, y: (-3.0, 2.0), *shapes)
    found = match(left, right)
    assert found.column_disparity.shape == shapes[0]
    good, _ = share_within(found, u, v, right.shape, 0.5)
    assert good > 0.95


@pytest.mark.parametrize("shape", [(1, 1), (1, 37), (37, 1), (2, 2), (5, 3), (17, 19), (63, 65), (129, 127)])
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_any_size_is_answered(shape, preset):
    texture = byte(pair(lambda x, y: (0.0, 0.0), shape)[0])
    found = match(texture, texture, HfvmParams(preset=preset))
    assert found.validity.shape == shape
    ok = matched(found.validity)
    np.testing.assert_array_equal(np.isfinite(found.disparity_std), ok)
    if ok.any():
        assert np.percentile(np.abs(found.column_disparity[ok]), 90) < 0.5


def test_displacement_beyond_the_width_finds_nothing():
    left, right, *_ = pair(lambda x, y: (-260.0, 0.0), (140, 180))
    assert matched(match(left, right).validity).mean() < MOST_CHANCE


def test_colour_and_integers_are_refused_in_one_line():
    for image in (np.zeros((20, 30, 3), np.uint8), np.zeros((20, 30), np.int32), np.zeros((0, 30), np.uint8)):
        with pytest.raises(InputError) as caught:
            match(image, image)
        assert "\n" not in str(caught.value)


def test_sixteen_bits_are_matched_with_eight():
    left, right, u, v = pair(lambda x, y: (-8.0, 1.0))
    found = match(byte(left), byte(right).astype(np.uint16) * 257)
    good, complete = share_within(found, u, v, right.shape, 0.3)
    assert good > 0.98
    assert complete > 0.95


def test_what_is_not_finite_is_masked():
    left, right, *_ = pair(lambda x, y: (-8.0, 1.0))
    left[50:70, 60:90] = np.nan
    right[20:30, 60:90] = np.inf
    found = match(left, right)
    assert not defined(found.validity[50:70, 60:90]).any()
    assert matched(found.validity).mean() > 0.6


@pytest.mark.parametrize("blur", [0.0, 1.5, 4.0])
def test_two_seeds_of_noise_match_hardly_anywhere(blur):
    rng = np.random.default_rng(0)
    images = []
    for _ in range(2):
        image = rng.uniform(0, 256, (180, 240))
        if blur:
            image = cv2.GaussianBlur(image, (0, 0), blur)
            image = 128 + 45 / image.std() * (image - image.mean())
        images.append(byte(image))
    assert matched(match(*images).validity).mean() < MOST_CHANCE


def test_patches_of_chance_go_where_nearly_all_are_small_and_stay_beside_a_large_one():
    u = np.zeros((160, 200), np.int16)
    keep = np.zeros(u.shape, bool)
    keep[10:20, 10:20] = keep[40:48, 100:110] = keep[90:101, 30:40] = True
    np.testing.assert_array_equal(isolated(u, keep, 40), keep)
    keep[110:150, 60:160] = True
    assert not isolated(u, keep, 40).any()
    assert not isolated(u, keep, 1).any()


def test_progress_grows_from_nothing_to_all():
    left, right, *_ = pair(lambda x, y: (-5.0, 0.0))
    told = []
    match(left, right, options=MatchOptions(lambda share, step: told.append((share, step))))
    shares = [share for share, _ in told]
    assert shares[0] == 0
    assert shares == sorted(shares)
    assert shares[-1] < 1
    assert any("fine levels" in step for _, step in told)


@pytest.mark.data
def test_unrelated_photographs_match_hardly_anywhere(data_dir):
    cones = cv2.imread(str(data_dir / "cones" / "cones_image_02.png"), 0)
    motorcycle = cv2.imread(str(data_dir / "motorcycle" / "motorcycle_right.png"), 0)
    rows, cols = cones.shape
    for row, col in ((0, 0), (60, 140), (120, 280)):
        assert matched(match(cones, motorcycle[row : row + rows, col : col + cols]).validity).mean() < MOST_CHANCE


def test_strips_of_few_rows_that_are_turned_are_matched_at_the_levels_that_they_have():
    rng = np.random.default_rng(0)
    scene = cv2.GaussianBlur(rng.integers(0, 256, (60, 500)).astype(np.uint8), (0, 0), 1.5)
    scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
    turned = cv2.warpAffine(scene, cv2.getRotationMatrix2D((200, 30), 4, 1.0), (500, 60))
    strip = np.s_[20:40, 40:440]
    assert matched(match(scene[strip], turned[strip]).validity).mean() > 0.3
