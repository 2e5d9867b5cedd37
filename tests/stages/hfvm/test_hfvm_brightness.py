"""Brightness that differs smoothly between the images: found, undone, and without effect on what is matched."""

import numpy as np
import pytest
from matching_scenes import pair, seen

from rille.stages.core.validity import matched
from rille.stages.hfvm import brightness
from rille.stages.hfvm.image import Window
from rille.stages.hfvm.image import as_matched as image_of
from rille.stages.hfvm.level import FREE_BAND, Map, State
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.stage import match
from rille.stages.imaging.pyramid import PyramidParams, build

SHAPE = (160, 220)
RATIO = np.array([0.2, -0.1, 0.15, 0.3, -0.05, 0.2, 0.04])


def as_matched(image):
    return image_of(build(image, PyramidParams()), HfvmParams(denoise_from=1e6))


def state(level, u, ok):
    """Matches of a level along its rows."""
    matches = Map(u, np.zeros(u.shape, np.int16))
    return State(level, matches, matches, ok, ok, FREE_BAND, 0.0)


def logarithm(shape, level=0):
    y, x = np.indices(shape)
    return np.tensordot(RATIO, brightness.terms(x, y, level, SHAPE), 1)


def corners(x, y):
    """Brightness that falls to 0.4 in the corners."""
    p, q = 2 * x / (SHAPE[1] - 1) - 1, 2 * y / (SHAPE[0] - 1) - 1
    return 1 - 0.3 * (p * p + q * q)


def test_terms_mean_the_same_place_on_each_level():
    x = np.array([0.0, 20.0, 54.0])
    fine = brightness.terms(4 * x + 1.5, 4 * x + 1.5, 0, SHAPE)
    np.testing.assert_allclose(brightness.terms(x, x, 2, SHAPE), fine, atol=1e-12)


@pytest.mark.parametrize("level", [0, 2])
def test_levelled_view_is_multiplied_by_the_exponential(level):
    plain = as_matched(np.random.default_rng(0).uniform(10, 200, SHAPE).astype(np.float32))
    found = brightness.levelled(plain, RATIO)
    window = Window(3, 30, 5, 41)
    expected = plain.layers[level].grey * np.exp(logarithm(plain.shapes[level], level))
    np.testing.assert_allclose(found.layers[level].grey, expected, rtol=1e-5)
    np.testing.assert_allclose(found.layers[level].cut(window).grey, expected[window.slices], rtol=1e-5)
    assert brightness.levelled(plain, None) is plain


def test_matches_tell_the_ratio_though_a_third_is_wrong():
    rng = np.random.default_rng(1)
    left = rng.uniform(60, 120, SHAPE).astype(np.float32)
    right = left / np.exp(logarithm(SHAPE)).astype(np.float32)
    u = np.where(rng.random(SHAPE) < 1 / 3, 7, 0).astype(np.int16)
    ok = np.arange(SHAPE[1]) < SHAPE[1] - 7
    found = brightness.ratio_of_matches(
        as_matched(left), as_matched(right), state(0, u, np.broadcast_to(ok, SHAPE).copy())
    )
    y, x = np.indices(SHAPE)
    # a wrong match errs by .28 in the mean of squares; held down by the robust fit and by 2600 others
    off = np.tensordot(found - RATIO, brightness.terms(x, y, 0, SHAPE), 1)
    assert np.abs(off).mean() < 0.02
    assert brightness.ratio_of_matches(as_matched(left), as_matched(right), state(0, u, np.zeros(SHAPE, bool))) is None


def test_guess_of_one_scene_in_two_lights():
    left = np.random.default_rng(2).uniform(60, 120, SHAPE).astype(np.float32)
    right = left / np.exp(logarithm(SHAPE)).astype(np.float32)
    found = brightness.guess(as_matched(left), as_matched(right), 2)
    assert brightness.greatest(found - RATIO) < 0.1 < brightness.greatest(RATIO)


@pytest.mark.parametrize("preset", ["default", "fast"])
def test_dark_corners_of_one_image_cost_no_matches(preset):
    """Texture weaker than the brightness that falls to 0.4: what is matched stays as it is without."""
    left, right, u, v = pair(lambda x, y: (-12 + 3 * np.sin(x / 40), 0 * x), SHAPE)
    left, right = (120 + 0.3 * (image - 128) for image in (left, right))
    y, x = np.indices(SHAPE)
    both = seen(u, v, SHAPE, 12)
    shares = []
    for image in (right, right * corners(x, y)):
        found = match(left, image, HfvmParams(preset=preset))
        error = np.hypot(found.column_disparity - u, found.row_disparity - v)
        shares.append(np.mean((matched(found.validity) & (error < 1))[both]))
    assert shares[0] > 0.9
    assert shares[1] > shares[0] - 0.03


def test_equal_light_is_left_alone():
    left, right, *_ = pair(lambda x, y: (-12 + 3 * np.sin(x / 40), 0 * x), SHAPE)
    views = as_matched(left), as_matched(right)
    level = 2
    shape = views[0].shapes[level]
    u = np.full(shape, -3, np.int16)
    ok = np.zeros(shape, bool)
    ok[:, 6:] = True
    found = brightness.ratio_of_matches(*views, state(level, u, ok))
    assert brightness.greatest(found) < brightness.MIN_LOG_RATIO


@pytest.mark.parametrize("side", [0, 1])
def test_a_known_gain_and_gradient_of_either_image_cost_little_accuracy(side):
    """Light of .35 to 1.05: disparities are about as exact as without; where it is not levelled they are not."""
    truth = pair(lambda x, y: (-12 + 3 * np.sin(x / 40) + y / 60, 0 * x), SHAPE)
    y, x = np.indices(SHAPE)
    light = np.exp(-0.5 + 0.3 * (2 * x / SHAPE[1] - 1) - 0.25 * (2 * y / SHAPE[0] - 1))

    def rms(light, **params):
        images, rng = list(truth[:2]), np.random.default_rng(4)
        images[side] = images[side] * light
        noisy = (np.rint(image + rng.normal(0, 0.6, SHAPE)).clip(0, 255).astype(np.float32) for image in images)
        found = match(*noisy, HfvmParams(**params))
        good = matched(found.validity) & seen(truth[2], truth[3], SHAPE, 12)
        assert params or good.sum() > 0.95 * seen(truth[2], truth[3], SHAPE, 12).sum()
        return np.sqrt(np.mean((found.column_disparity - truth[2])[good] ** 2))

    alike = rms(1.0)
    assert rms(light) < 1.5 * alike
    assert rms(light, without=("even",)) > 3.0 * alike
