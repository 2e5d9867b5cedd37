"""Tiles give what the whole image gives, but for a thousandth of the pixels; denoising; windows."""

import cv2
import numpy as np
import pytest
from matching_scenes import pair

from rille.stages.core.validity import matched
from rille.stages.hfvm.image import Window, as_matched, thinned, tiles, whole
from rille.stages.hfvm.matcher import MatchOptions, local
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.stage import match
from rille.stages.imaging.pyramid import PyramidParams, build

SHAPE = (300, 420)


def misaligned():
    """Waves of 4 px, rows shifted by two, noise, a patch of unlike texture, a masked corner."""
    left, right, *_ = pair(lambda x, y: (-9 + 4 * np.sin(x / 30) * np.cos(y / 25), 2 + np.cos(x / 40)), SHAPE)
    rng = np.random.default_rng(3)
    left, right = (a + rng.normal(0, 1.5, a.shape).astype(np.float32) for a in (left, right))
    right[60:100, 90:150] = rng.normal(128, 30, (40, 60))
    left[:35, 320:] = np.nan
    return left, right


def sheared():
    """Ground that pre-alignment by a plane is made for; the right image is wider."""
    left, right, *_ = pair(lambda x, y: (60.0 - 0.5 * y, 0.01 * x), SHAPE, (300, 460), noise=1.0)
    return left, right


def noisy():
    """A flat and a textured half, with noise."""
    left, right, *_ = pair(lambda x, y: (-9 + 4 * np.sin(x / 30) * np.cos(y / 25), 2 + np.cos(x / 40)), SHAPE)
    rng = np.random.default_rng(5)
    contrast = np.where(np.arange(SHAPE[1]) < 180, 0.6, 0.1)
    return tuple(128 + contrast * (a - 128) + rng.normal(0, 5, a.shape) for a in (left, right))


def vignetted():
    """Weak texture, and a right image that is dark in its corners, which is undone."""
    left, right, *_ = pair(lambda x, y: (-9 + 4 * np.sin(x / 30) * np.cos(y / 25), 0 * x), SHAPE)
    y, x = (np.linspace(-1, 1, n) for n in right.shape)
    left, right = (120 + 0.3 * (a - 128) for a in (left, right))
    return left, right * (1 - 0.3 * (x**2 + y[:, None] ** 2))


def unfocused():
    """A left image that is out of focus."""
    left, right, *_ = pair(lambda x, y: (-9 + 4 * np.sin(x / 30) * np.cos(y / 25), 0 * x), SHAPE)
    return cv2.GaussianBlur(left, None, 1.5), right


@pytest.mark.parametrize(
    ("scene", "aligned"),
    [(misaligned, False), (sheared, True), (noisy, False), (vignetted, False), (unfocused, False)],
)
@pytest.mark.parametrize("preset", ["default", "fast"])
def test_tiles_are_within_a_hundredth_of_a_pixel_of_the_whole(scene, aligned, preset):
    left, right = scene()
    params = HfvmParams(preset=preset)
    once, cut = match(left, right, params), match(left, right, params, options=MatchOptions(side=160))
    assert once.unlike.aligned == cut.unlike.aligned == aligned
    assert matched(once.validity).mean() > 0.5
    a, b = (np.stack([found.column_disparity, found.row_disparity]) for found in (once, cut))
    same = (np.abs(a - b) <= 0.01) | (np.isnan(a) & np.isnan(b))
    assert same.all(axis=0).mean() >= 0.999
    assert np.mean(once.validity == cut.validity) >= 0.999


def test_presets_that_reach_over_the_image_are_matched_whole():
    assert [local(HfvmParams(preset=p)) for p in ("default", "fast", "accurate", "paper")] == [1, 1, 0, 0]
    assert local(HfvmParams(preset="accurate", without=("paths", "smooth")))


@pytest.mark.parametrize("side", [None, 160])
def test_threads_change_no_bit(side):
    left, right = misaligned()
    one, three = (match(left, right, options=MatchOptions(side=side, threads=n)) for n in (1, 3))
    for name, values in vars(one).items():
        np.testing.assert_array_equal(values, getattr(three, name))


def test_noisy_images_are_smoothed_unless_told_otherwise():
    share = [matched(match(*noisy(), HfvmParams(denoise_from=limit)).validity).mean() for limit in (1.0, 10.0)]
    assert share[0] > 1.1 * share[1] > 0.1


def test_denoising_averages_noise_and_keeps_texture_on_every_level():
    rng = np.random.default_rng(0)
    y, x = np.indices((160, 208))
    scene = np.where(x < 120, 90.0, 90.0 + 80 * ((x // 8 + y // 8) % 2))
    noisy = build(scene + rng.normal(0, 4, scene.shape), PyramidParams())
    assert noisy.noise > 2
    quiet = as_matched(noisy, HfvmParams())
    assert quiet.noise == noisy.noise
    for level in range(3):
        before, after = noisy.images[level], quiet.layers[level].grey
        flat = (slice(None), slice(0, 112 >> level))
        # A mean of nine pixels leaves a third.
        assert after[flat].std() < 0.45 * before[flat].std()
        assert after[flat].mean() == pytest.approx(90, abs=0.2)
    checks = (slice(None), slice(128, None))
    assert quiet.layers[0].grey[checks].std() == pytest.approx(40, rel=0.02)


def test_views_without_noise_are_left_as_they_are():
    pyramid = build(misaligned()[1], PyramidParams())
    image = as_matched(pyramid, HfvmParams(denoise_from=9.0))
    assert image.noise == 0
    np.testing.assert_array_equal(image.layers[1].grey, pyramid.images[1])


def test_thinned_pixels_hardly_depend_on_the_others():
    rng = np.random.default_rng(0)
    marked = rng.random((90, 120)) < 0.6
    y, x = thinned(marked, 100)
    assert 100 <= len(y) <= 200
    assert marked[y, x].all()
    less = marked.copy()
    less[y[0], x[0]] = False
    assert set(zip(*thinned(less, 100), strict=True)) == set(zip(y, x, strict=True)) - {(y[0], x[0])}
    assert len(thinned(marked, 10**6)[0]) == marked.sum()


def test_windows():
    assert tiles((5, 7), 4) == [Window(0, 4, 0, 4), Window(0, 4, 4, 7), Window(4, 5, 0, 4), Window(4, 5, 4, 7)]
    assert tiles((5, 7), 7) == [whole((5, 7))]
    assert Window(3, 9, 2, 4).grow(2, 5, (10, 7)) == Window(0, 10, 0, 7)
    assert Window(3, 9, 4, 5).grow(0, 0, (20, 20)) == Window(2, 10, 4, 6)
    assert Window(2, 9, 4, 7).parent() == Window(1, 5, 2, 4)
    assert Window(1, 5, 2, 4).child((9, 7)) == Window(2, 9, 4, 7)
    # nothing of it lies in the image: still two pixels, which no place can mean
    assert Window(-9, -5, 20, 30).grow(2, 2, (10, 7)) == Window(0, 2, 4, 7)
