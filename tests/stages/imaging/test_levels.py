"""Samples of 16 bits that use a small part of their range: when they are spread, and how."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rille.stages.imaging.levels import levels_of, levels_of_sides, spread, swapped, words


def scene(low, high, seed=3):
    """A textured image whose samples lie between two values."""
    noise = np.random.default_rng(seed).random((64, 96)).astype(np.float32)
    smooth = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, low, high, cv2.NORM_MINMAX)
    return smooth.astype(np.uint16)


@pytest.mark.parametrize(
    ("low", "high"), [(0, 255), (0, 1023), (20, 4095), (29_000, 29_400), (29_000, 33_000), (64_000, 65_535)]
)
def test_a_small_part_of_the_range_is_spread_over_much_of_it(low, high):
    image = scene(low, high)
    levels = levels_of([image, scene(low, high, 4)])
    assert levels is not None
    out = spread(image, levels)
    assert out.dtype == np.uint16
    assert 0.2 * 65_535 < np.ptp(out.astype(int)) < 0.6 * 65_535
    # Not one sample is clipped, nor are two made one.
    assert len(np.unique(out)) == len(np.unique(image))


@pytest.mark.parametrize(
    "image", [scene(0, 65_535), scene(5000, 40_000), scene(12_000, 22_000), scene(0, 255).astype(np.uint8)]
)
def test_good_images_stay_as_they_are(image):
    assert levels_of([image]) is None
    assert spread(image, None) is image


def test_noise_and_blank_images_are_not_blown_up():
    noise = np.random.default_rng(0).normal(500, 5, (64, 96)).astype(np.uint16)
    assert levels_of([noise, np.full((64, 96), 7, np.uint16), np.zeros((2, 2), np.uint16)]) is None
    # Nor do they decide for others.
    dropped = levels_of([scene(29_000, 29_400), np.zeros((64, 96), np.uint16)])
    assert dropped == levels_of([scene(29_000, 29_400)])


def test_dead_pixels_hide_no_scene():
    """A thermal camera's counts, of which the scene takes a few hundred."""
    image = scene(7400, 7800)
    image[::20, ::20] = 0
    levels = levels_of([image])
    assert levels is not None
    assert levels[1] == levels_of([scene(7400, 7800)])[1] == 64


def test_one_scale_holds_for_dark_and_bright_images():
    dark, bright = scene(100, 900), scene(100, 3600, 4)
    levels = levels_of([dark, bright])
    assert spread(dark, levels).max() < spread(bright, levels).max() / 2


def test_counts_that_drift_are_spread_around_the_middle_of_each_image():
    """As those of a thermal camera that warms up, by more than the scene takes."""
    images = [scene(7000 + 400 * k, 7250 + 400 * k, k) for k in range(3)]
    levels = levels_of(images)
    assert levels == (None, levels_of(images[:1])[1])
    for image in images:
        out = spread(image, levels).astype(int)
        assert abs(np.median(out) - 32_768) <= levels[1]
        assert np.ptp(out) > 0.2 * 65_535
    assert "its image's median" in words((levels, levels))[0]
    assert levels_of([scene(100, 400), scene(100, 3600, 4)])[0] is not None  # by day and by night


@pytest.mark.parametrize("factor", [16, 6, 1.9, 1])
def test_cameras_whose_drivers_shift_bits_unlike_are_spread_each(factor):
    dim, bright = scene(20, 3500), scene(20 * factor, 3500 * factor, 4)
    left, right = levels_of_sides([dim], [bright])
    assert left is not None
    if factor < 4:
        assert left == right == levels_of([dim, bright])
        assert words((left, right))[0].endswith("of all images")
    else:
        assert left == levels_of([dim])
        assert right == levels_of([bright])
        assert words((left, right))[0].endswith("of left images")
        assert spread(dim, left).max() > 0.4 * spread(bright, right).max()
    assert levels_of_sides([dim], []) == levels_of_sides([], [dim]) == (left if factor >= 4 else levels_of([dim]),) * 2


@pytest.mark.parametrize("spread", [3, 300, 20_000])
def test_noise_has_no_order_of_bytes(spread):
    noise = np.random.default_rng(0).normal(30_000, spread, (60, 80)).clip(0, 65535)
    assert not swapped(noise.astype(np.uint16))
    assert not swapped(np.full((9, 9), 7, np.uint16))
