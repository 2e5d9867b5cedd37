"""A camera that is out of focus: its image shows less detail than the other one's."""

import cv2
import numpy as np
import pytest
from matching_scenes import seen

from rille.stages.calibration.doubt import doubts
from rille.stages.core.validity import matched
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.stage import match

SHAPE = (220, 300)


def views(blur_left=0.0, blur_right=0.0, noise=1.0):
    """Fine texture and coarse one on a slope, each image blurred by its camera before its own noise is added."""
    rng = np.random.default_rng(2)
    scene = sum(
        k * cv2.resize(rng.normal(size=(300 // k, 400 // k)), (400, 300), interpolation=cv2.INTER_CUBIC)
        for k in (1, 2, 4, 8, 16)
    )
    y, x = np.indices(SHAPE, dtype=np.float32)
    u = -8.0 - 0.03 * y
    right = (128 + 5 * scene[: SHAPE[0], : SHAPE[1]]).astype(np.float32)
    left = cv2.remap((128 + 5 * scene).astype(np.float32), x + u, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    out = []
    for image, blur in ((left, blur_left), (right, blur_right)):
        soft = cv2.GaussianBlur(image, None, blur) if blur else image
        out.append(np.clip(soft + rng.normal(0, noise, SHAPE), 0, 255).astype(np.float32))
    return *out, u


@pytest.mark.parametrize("blur", [1.2, 2.0, 3.0])
@pytest.mark.parametrize("left", [True, False])
def test_the_blur_of_one_image_is_found_and_named(blur, left):
    a, b, _ = views(*((blur, 0.0) if left else (0.0, blur)))
    found = match(a, b)
    assert found.unlike.blur == pytest.approx(-blur if left else blur, rel=0.15)
    (line,) = doubts(found, a, b)
    assert line.startswith(f"RIL-710: the {'left' if left else 'right'} image is blurred by")


def test_blur_is_in_pixels_of_the_images_at_half_their_resolution_too():
    a, b, _ = views(0.0, 3.0)
    assert match(a, b, HfvmParams(preset="fast")).unlike.blur == pytest.approx(3.0, rel=0.2)


def test_detail_that_the_scale_takes_is_no_blur():
    a, b, _ = views()
    found = match(a, cv2.resize(b, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA))
    assert found.unlike.aligned
    assert found.unlike.blur == 0


@pytest.mark.parametrize("both", [0.0, 2.0])
def test_images_alike_stay_as_they_are(both):
    a, b, _ = views(both, both)
    assert match(a, b).unlike.blur == 0


def test_few_pixels_tell_no_blur():
    a, b, _ = views(blur_right=2.0)
    assert match(a[:60, :80], b[:60, :80]).unlike.blur == 0


def test_images_without_texture_stay_as_they_are():
    flat = np.full(SHAPE, 90, np.float32)
    assert match(flat, flat).unlike.blur == 0


@pytest.mark.parametrize("preset", ["default", "accurate"])
def test_a_blurred_image_is_matched(preset):
    left, right, u = views(blur_right=2.0)
    found = match(left, right, HfvmParams(preset=preset))
    both = seen(u, np.zeros(SHAPE), SHAPE, 16)
    error = np.hypot(found.column_disparity - u, found.row_disparity)
    usable = both & matched(found.validity)
    assert usable.sum() > 0.9 * both.sum()
    assert np.median(error[usable]) < 0.2
    within = error[usable] < found.disparity_std[usable]
    assert 0.5 < within.mean() < 0.95


@pytest.mark.data
def test_wrong_matches_tell_no_blur(data_dir):
    left, right = (
        cv2.imread(str(data_dir / "middlebury0506" / "Baby1" / f"view{k}.png"), cv2.IMREAD_GRAYSCALE) for k in (1, 5)
    )
    # A row offset of 64 pixels makes more of them: then the left image seemed to be sharper by 1.8 pixels.
    assert match(left, cv2.copyMakeBorder(right, 64, 64, 64, 64, cv2.BORDER_CONSTANT)).unlike.blur == 0
