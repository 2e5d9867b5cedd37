"""Standard deviation of disparities: a hand-computed window, what it must follow, and that it holds against truth."""

import cv2
import numpy as np
import pytest
from matching_scenes import Texture, pair
from scipy import ndimage

from rille.stages.core.validity import matched
from rille.stages.geometry.spline import coefficients
from rille.stages.hfvm import refinement
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.refinement import FLOOR_PX, _likeness, neighbours, standard_deviation
from rille.stages.hfvm.stage import match


def per_noise(left, right):
    """Variance of undisplaced columns for a unit of variance of the grey levels."""
    nothing, keep = np.zeros(left.shape, np.float32), np.ones(left.shape, bool)
    images = refinement.SplineImages(left, coefficients(right), np.ones(right.shape, np.uint8))
    return refinement.refine(images, lambda u, v: (u, v), (nothing, nothing), keep, 1).per_noise


def test_noise_part_is_the_inverse_structure_tensor_of_the_window():
    image = np.random.default_rng(0).uniform(0, 255, (15, 17)).astype(np.float32)
    y, x = 7, 8
    window = np.s_[y - 2 : y + 3, x - 2 : x + 3]
    at = np.indices(image.shape).astype(float)
    low, high = (
        [ndimage.map_coordinates(image, at + np.reshape(d, (2, 1, 1)), float, order=3, mode="mirror") for d in steps]
        for steps in (((-1e-4, 0), (0, -1e-4)), ((1e-4, 0), (0, 1e-4)))
    )
    gy, gx = ((b - a) / 2e-4 for a, b in zip(low, high, strict=True))
    g = np.stack([gx[window].ravel(), gy[window].ravel()])
    tensor = 25 * np.cov(g, bias=True) + 25 * 8.0 * np.eye(2)
    assert per_noise(image, image)[y, x] == pytest.approx(np.linalg.inv(tensor)[0, 0], rel=1e-4)


def test_relief_and_border_parts_by_their_definition():
    rng = np.random.default_rng(1)
    y, x = np.indices((12, 14), dtype=np.float64)
    keep = rng.random(x.shape) < 0.9
    tilted = (rng.normal(0, 0.3, x.shape) + 0.4 * x - 0.7 * y - 50).astype(np.float32)
    relief, border = neighbours(tilted, keep)
    squares = []
    for j, i in np.ndindex(5, 5):
        cross = [(4 + j, 5 + i), (2 + j, 5 + i), (6 + j, 5 + i), (4 + j, 3 + i), (4 + j, 7 + i)]
        if all(keep[p] for p in cross):
            squares.append((tilted[cross[0]] - np.mean([tilted[p] for p in cross[1:]])) ** 2)
    assert 3 < len(squares) < 25
    assert relief[6, 7] == pytest.approx(np.mean(squares), rel=1e-4)
    assert border[6, 7] == pytest.approx(1 - keep[2:11, 3:12].mean(), abs=1e-6)
    plane = (0.4 * x - 0.7 * y - 50).astype(np.float32)
    relief, border = neighbours(plane, np.ones(x.shape, bool))
    assert relief.max() < 1e-9
    np.testing.assert_array_equal(border, 0)


def scaled(scale):
    """A left image, and a right one that shows it nine pixels to the left and in ``scale`` times as many pixels."""
    texture, rng = Texture(), np.random.default_rng(1)
    y, x = np.indices((150, 200), dtype=np.float64)
    yr, xr = np.indices((round(150 * scale), round(200 * scale)), dtype=np.float64)
    images = texture(x, y), texture(xr / scale + 9, yr / scale)
    left, right = (np.clip(a + rng.normal(0, 2, a.shape), 0, 255) for a in images)
    return left, right, scale * (x - 9) - x


def test_in_pixels_of_the_right_image_whatever_its_scale():
    errors, claims = {}, {}
    for scale in (0.5, 1.0, 2.0):
        left, right, u = scaled(scale)
        found = match(left, right)
        ok = matched(found.validity)
        assert ok.mean() > 0.85
        errors[scale] = np.quantile(np.abs(found.column_disparity - u)[ok], 0.68)
        claims[scale] = np.median(found.disparity_std[ok])
    for scale in (0.5, 2.0):
        assert claims[scale] / claims[1.0] == pytest.approx(scale, rel=0.2)
        assert errors[scale] < claims[scale]


def test_undefined_exactly_where_nothing_was_matched():
    left, right, *_ = pair(lambda x, y: (-8.0, 1.0), noise=3.0)
    found = match(left, right)
    np.testing.assert_array_equal(np.isfinite(found.disparity_std), matched(found.validity))
    assert np.nanmin(found.disparity_std) >= FLOOR_PX


def test_no_kept_pixel_gives_no_number_and_no_warning():
    image = np.zeros((6, 7), np.float32)
    std = standard_deviation(image, image, image, np.zeros(image.shape, bool))
    assert np.isnan(std).all()


def beyond_floor(std):
    """What a standard deviation has beside the floor, which no pixel shows."""
    return np.sqrt(max(float(std) ** 2 - FLOOR_PX**2, 0.0))


def test_edges_along_the_rows_leave_the_column_uncertain():
    x = np.indices((60, 60), dtype=np.float64)[1]
    keep, flat = np.ones(x.shape, bool), np.zeros(x.shape, np.float32)
    found = []
    for image in (across := (128 + 60 * np.sin(x)).astype(np.float32), across.T.copy()):
        noise = 150.0 * per_noise(image, image)
        found.append(standard_deviation(noise, flat, flat, keep)[30, 30])
    up, along = found
    assert beyond_floor(along) > 5 * beyond_floor(up)


@pytest.mark.parametrize("upright", [False, True])
def test_residuals_of_neighbours_are_alike_where_noise_is_blurred_along_the_lines(upright):
    rng, used = np.random.default_rng(4), np.ones((120, 160), np.float32)
    white = rng.normal(0, 3, (120, 160)).astype(np.float32)
    alike = (white + np.roll(white, 1, 0 if upright else 1)) / np.float32(np.sqrt(2))
    across = (white + np.roll(white, 1, 1 if upright else 0)) / np.float32(np.sqrt(2))
    inside = np.s_[20:-20, 20:-20]
    for rest, least, most in ((white, -0.15, 0.03), (alike, 0.35, 0.5), (across, -0.15, 0.03)):
        assert least < np.median(_likeness(rest, used, upright)[inside]) < most


@pytest.mark.parametrize("sigma", [8.0, 12.0])
def test_stated_errors_hold_where_noise_is_alike_in_neighbours(sigma):
    """As a camera's own denoising leaves it, or the compression of images."""
    bumps = lambda x, y: (-9.0 + 2.0 * np.sin(x / 25) * np.sin(y / 20), 0.0)  # noqa: E731
    left, right, u, _ = pair(bumps, (180, 240), seed=5)
    rng = np.random.default_rng(6)
    faint = (128 + 0.3 * (a - 128) + cv2.GaussianBlur(rng.normal(0, sigma, a.shape), None, 1.0) for a in (left, right))
    found = match(*faint)
    ok = matched(found.validity)
    ratio = np.abs(found.column_disparity - u)[ok] / found.disparity_std[ok]
    assert 0.62 < (ratio < 1).mean() < 0.9
    assert (ratio < 2).mean() > 0.9


def test_depth_edge_noise_and_weak_texture_are_less_certain():
    step = lambda x, y: (np.where(x < 90, -4.0, -7.0), 0.0)  # noqa: E731
    calm = match(*pair(step)[:2]).disparity_std
    noisy = match(*pair(step, noise=6.0)[:2]).disparity_std
    rng = np.random.default_rng(0)
    weak = match(*(128 + 0.1 * (a - 128) + rng.normal(0, 1.8, a.shape) for a in pair(step)[:2])).disparity_std
    inside = np.s_[20:120, 30:70]
    for worse in (noisy, weak):
        assert beyond_floor(np.nanmedian(worse[inside])) > 5 * beyond_floor(np.nanmedian(calm[inside]))
    assert np.nanmedian(calm[20:120, 80:100]) > 1.5 * np.nanmedian(calm[inside])


def test_stated_errors_hold_against_exact_displacements_on_relief_and_noise():
    bumps = lambda x, y: (-9.0 + 2.0 * np.sin(x / 11) * np.sin(y / 9) + np.where(x > 120, 7.0, 0.0), 0.5)  # noqa: E731
    for seed in (3, 4):
        left, right, u, _ = pair(bumps, (180, 240), seed=seed, noise=4.0)
        found = match(left, right)
        ok = matched(found.validity)
        ratio = np.abs(found.column_disparity - u)[ok] / found.disparity_std[ok]
        # Not the scenes that it was fitted on: never too sure of itself, and no more than twice too careful.
        assert np.mean(ratio <= 1) > 0.61
        assert np.mean(ratio <= 2) > 0.91
        assert np.mean(ratio <= 0.5) < 0.68


@pytest.mark.parametrize("params", [HfvmParams(preset="paper"), HfvmParams(without=("refine",))])
def test_unrefined_disparities_have_one_too(params):
    left, right, u, _ = pair(lambda x, y: (-6.4, 1.3), noise=3.0)
    found = match(left, right, params)
    ok = matched(found.validity)
    inside = np.abs(found.column_disparity - u)[ok] <= found.disparity_std[ok]
    assert 0.55 < inside.mean() < 0.95


def test_of_cameras_one_above_the_other_it_is_that_of_the_rows():
    """As both images turned by a quarter show: the same pixels are as sure."""

    def bumps(x, y):
        return -20 + 0.04 * x + 2.0 * np.sin(x / 5) * np.cos(y / 6), 0.0

    images = pair(bumps, (200, 240), noise=2.0)[:2]
    plain, turned = match(*images), match(*(np.rot90(image, -1).copy() for image in images))
    both = matched(plain.validity) & np.rot90(matched(turned.validity))
    ratio = np.rot90(turned.disparity_std)[both] / plain.disparity_std[both]
    assert both.mean() > 0.7
    assert np.quantile(np.abs(np.log(ratio)), 0.9) < 0.1
