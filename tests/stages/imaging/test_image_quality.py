"""Glances at images: black, blurred, blurred beyond all detail, equal."""

import cv2
import numpy as np
import pytest

from rille.stages.core.declare import Bundle, NoParams, check_outputs
from rille.stages.imaging.image_faults import noise_alone
from rille.stages.imaging.image_quality import glance, image_quality_stage


def picture(seed=1, shape=(200, 300), blur=1.2):
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(0, 1, shape), (0, 0), blur)
    return np.clip(110 + 40 * noise / noise.std() + rng.normal(0, 1.5, shape), 0, 255).astype(np.uint8)


def test_blur_takes_sharpness_and_strong_blur_takes_detail():
    image = picture()
    valid = np.ones(image.shape, np.uint8)
    sharp = glance(image, valid)
    soft = glance(cv2.GaussianBlur(image, (0, 0), 2.5), valid)
    gone = glance(cv2.GaussianBlur(image, (0, 0), 15), valid)
    assert soft["sharpness"] < 0.6 * sharp["sharpness"]
    assert gone["detail"] < 0.3 * sharp["detail"]
    dark = glance((0.3 * image).astype(np.uint8), valid)  # exposure is no blur
    assert dark["sharpness"] > 0.8 * sharp["sharpness"]
    assert dark["detail"] > 0.8 * sharp["detail"]


@pytest.mark.parametrize(("size", "along"), [((9, 1), "rows"), ((1, 9), "columns")])
def test_motion_takes_the_sharpness_along_itself(size, along):
    image = picture(blur=0.7)
    sharp, moved = (glance(of, np.ones(of.shape, np.uint8)) for of in (image, cv2.blur(image, size)))
    across = {"rows": "columns", "columns": "rows"}[along]
    assert moved[f"sharpness_{along}"] < 0.65 * sharp[f"sharpness_{along}"]
    assert moved[f"sharpness_{across}"] > 0.8 * sharp[f"sharpness_{across}"]
    assert moved["sharpness"] > 0.6 * sharp["sharpness"]


@pytest.mark.parametrize(("mean", "deviation"), [(3, 1.5), (60, 25), (128, 3)])
def test_noise_alone_is_told_from_a_faint_photograph_with_noise(mean, deviation):
    rng = np.random.default_rng(2)
    noise, valid = rng.normal(mean, deviation, (200, 300)), np.ones((200, 300), np.uint8)
    assert noise_alone(glance(np.clip(np.rint(noise), 0, 255).astype(np.uint8), valid))
    faint = noise + deviation * (picture() / 40.0 - 2.75)  # landmarks as strong as the noise
    assert not noise_alone(glance(np.clip(np.rint(faint), 0, 255).astype(np.uint8), valid))
    assert not noise_alone(glance(np.zeros((200, 300), np.uint8), valid))


def test_figures_of_a_known_image():
    image = np.full((60, 80), 100, np.uint8)
    image[:, :20] = 255
    image[:, 20:26] = 0
    valid = np.ones(image.shape, np.uint8)
    found = glance(image, valid)
    assert (found["bright"], found["dark"]) == (0.25, 6 / 80)
    assert found["mean"] == pytest.approx((20 * 255 + 54 * 100) / 80)
    assert glance(image.astype(np.uint16) * 257, valid)["mean"] == pytest.approx(found["mean"])
    valid[:, :26] = 0
    assert glance(image, valid)["deviation"] == 0


def test_a_black_image_deviates_by_nothing_and_equal_images_have_one_digest():
    image = picture()
    both = {"left": Bundle({"image": 0 * image, "valid": np.ones_like(image)}, {})}
    both["right"] = Bundle({"image": image, "valid": np.ones_like(image)}, {})
    out = image_quality_stage.run(NoParams(), {"frame": 4}, both)
    check_outputs(image_quality_stage, out)
    assert out.meta["frame"] == 4
    assert out.meta["left"]["deviation"] == out.meta["left"]["mean"] == 0.0
    assert out.meta["right"]["digest"] == glance(image.copy(), np.ones_like(image))["digest"]
    assert out.meta["right"]["digest"] != out.meta["left"]["digest"]
    assert glance(image, np.zeros_like(image))["mean"] is None


def test_pixels_that_are_not_finite_count_as_little_as_masked_ones():
    image = picture().astype(np.float32)
    holes, valid = image.copy(), np.ones(image.shape, np.uint8)
    holes[40:60, 100:140], valid[40:60, 100:140] = np.nan, 0
    found, masked = glance(holes, np.ones_like(valid)), glance(image, valid)
    assert {**found, "digest": ""} == {**masked, "digest": ""}
