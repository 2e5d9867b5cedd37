"""Tiles of any size, in any order, give what the whole image gives, bit for bit; windows and rasters by themselves."""

import random
from dataclasses import replace

import numpy as np
import pytest
from matching_scenes import pair

from rille.stages.core.validity import Validity
from rille.stages.hfvm import tiled
from rille.stages.hfvm.finish.finish import Finish
from rille.stages.hfvm.images import plane
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.images.views import Aligned, Plain
from rille.stages.hfvm.images.window import Mosaic, Window, bounded, gather, pick, thinned, tiles, whole
from rille.stages.hfvm.level.window_pair import WindowPair
from rille.stages.imaging.pyramid import PyramidParams, build


def quiet(share, step):
    return None


def misaligned():
    """Waves of 4 px, rows shifted by two, noise, a patch of unlike texture, a masked corner, half the contrast."""
    left, right, *_ = pair(lambda x, y: (-9 + 4 * np.sin(x / 30) * np.cos(y / 25), 2 + np.cos(x / 40)), (150, 211))
    rng = np.random.default_rng(3)
    left, right = (a + rng.normal(0, 1.5, a.shape).astype(np.float32) for a in (left, right))
    right[60:100, 90:150] = rng.normal(128, 30, (40, 60))
    left[:35, 160:] = np.nan
    return left, 0.6 * right


def sheared():
    """Ground that pre-alignment by a plane is made for; the right image is wider."""
    left, right, *_ = pair(lambda x, y: (10.0 - 0.55 * y, 0.01 * x), (160, 200), (160, 220), noise=1.0)
    return left, right


def turned():
    """Views turned by 70 degrees, which keypoints align; the right image is smaller."""
    c, s = np.cos(np.radians(70)), np.sin(np.radians(70))
    turn = lambda x, y: (c * (x - 110) - s * (y - 80) + 90 - x, s * (x - 110) + c * (y - 80) + 90 - y)  # noqa: E731
    left, right, *_ = pair(turn, (160, 220), (180, 180), noise=1.0)
    return left, right


def noisy():
    """A flat and a textured half; the noise of both images is told, so that they are smoothed; a masked corner."""
    left, right, *_ = pair(lambda x, y: (-9 + 4 * np.sin(x / 30) * np.cos(y / 25), 2 + np.cos(x / 40)), (150, 211))
    rng = np.random.default_rng(5)
    contrast = np.where(np.arange(211) < 90, 0.6, 0.1)
    left, right = (128 + contrast * (a - 128) + rng.normal(0, 5, a.shape) for a in (left, right))
    left[:35, 160:] = np.nan
    return left, right


def noisy_ground():
    """The same for ground that pre-alignment by a plane is made for."""
    rng = np.random.default_rng(6)
    left, right = sheared()
    return tuple(128 + 0.3 * (a - 128) + rng.normal(0, 6, a.shape) for a in (left, right))


def vignetted():
    """Weak texture, and a right image that is dark in its corners, which is undone."""
    left, right, *_ = pair(lambda x, y: (-9 + 4 * np.sin(x / 30) * np.cos(y / 25), 0 * x), (150, 211))
    y, x = (np.linspace(-1, 1, n) for n in right.shape)
    left, right = (120 + 0.3 * (a - 128) for a in (left, right))
    return left, right * (1 - 0.3 * (x**2 + y[:, None] ** 2))


def both(scene):
    return [Plain.of(build(image, PyramidParams())) for image in scene()]


def in_tiles(views, params, side, seed):
    shuffle = random.Random(seed)
    return tiled.match(*views, params, None, quiet, side, lambda windows: shuffle.sample(windows, len(windows)))


@pytest.mark.parametrize(
    ("scene", "aligned"),
    [(misaligned, False), (sheared, True), (turned, True), (noisy, False), (noisy_ground, True), (vignetted, False)],
)
@pytest.mark.parametrize("preset", ["default", "fast", "paper"])
def test_tiles_of_any_size_and_order_give_the_bits_of_the_whole(scene, aligned, preset):
    views, params = both(scene), HfvmParams(preset=preset)
    once = tiled.match(*views, params, None, quiet, None)
    assert once.aligned == (aligned and preset != "paper")
    assert scene not in (noisy, noisy_ground) or min(view.noise for view in views) > 2
    # the paper compares grey levels as they are: of half the contrast little matches
    if scene in (misaligned, sheared) or preset != "paper":
        assert np.mean(once.arrays["validity"] & 1) > (0.005 if preset == "paper" else 0.5)
    for side in (64, 100, 37):
        found = in_tiles(views, params, side, side)
        assert found.aligned == once.aligned
        for name, values in once.arrays.items():
            assert values.tobytes() == found.arrays[name].tobytes(), (name, side)


def test_noisy_images_are_smoothed_unless_told_otherwise():
    views = both(noisy)
    assert all(4 < view.noise < 6 for view in views)
    share = [
        np.mean(tiled.match(*views, HfvmParams(denoise_from=limit), None, quiet, None).arrays["validity"] & 1)
        for limit in (1.0, 10.0)
    ]
    assert share[0] > 1.1 * share[1] > 0.1


def test_denoising_averages_noise_and_keeps_texture_on_every_level():
    rng = np.random.default_rng(0)
    y, x = np.indices((160, 208))
    scene = np.where(x < 120, 90.0, 90.0 + 80 * ((x // 8 + y // 8) % 2))
    noisy = replace(Plain.of(build(scene + rng.normal(0, 4, scene.shape), PyramidParams())), noise=4.0)
    quiet = noisy.quiet(HfvmParams())
    assert quiet.removed_noise == 4
    for level in range(3):
        window = whole(noisy.shapes[level])
        before, after = noisy.grey(level, window), quiet.grey(level, window)
        flat = (slice(None), slice(0, 112 >> level))
        # A mean of nine pixels leaves a third.
        assert after[flat].std() < 0.4 * before[flat].std()
        assert after[flat].mean() == pytest.approx(90, abs=0.2)
    checks = (slice(None), slice(128, None))
    assert quiet.grey(0, whole(noisy.shapes[0]))[checks].std() == pytest.approx(40, rel=0.02)


def test_views_without_noise_are_left_as_they_are():
    for view in both(misaligned):
        assert view.quiet(HfvmParams()) is view
        assert view.removed_noise == 0


def test_parameters_that_widen_the_reach_widen_the_surroundings():
    """Rounds, median, refinement and filling reach farther than by default; so do centres far apart."""
    views = both(misaligned)
    more = {"rounds": 6, "fine_rounds": 5, "median": 5, "refine_steps": 3, "refine_radius": 4, "search_columns": 4}
    params = HfvmParams(**more, search_rows=3, fill_reach=15, min_support=0.4, guided_fill=True)
    once = tiled.match(*views, params, None, quiet, None)
    found = in_tiles(views, params, 53, 0)
    for name, values in once.arrays.items():
        assert values.tobytes() == found.arrays[name].tobytes(), name


def test_a_filled_pixel_does_not_depend_on_where_its_surroundings_are_cut():
    """A gap is filled from a match without texture, which pixels beyond the reach of the filling refute."""
    shape, p = (60, 400), HfvmParams()
    view = Plain.of(build(np.random.default_rng(0).uniform(0, 255, shape), PyramidParams()))
    steps = Finish(tiled.prepare(view, view, p, None), view, p, None, -1.0)
    maps = {name: np.zeros(shape, np.float32) for name in ("u", "v", "noise", "distance", "error")}
    bits = np.zeros(shape, np.uint8)
    bits[:, 80:100] = bits[30, 100:] = Validity.BACKMATCH_FAILED
    bits[30, 100] = Validity.NO_TEXTURE

    def final(window):
        return steps.final(window, maps, maps, {**maps, "validity": bits}, np.zeros(shape, np.uint8), None)

    once = final(whole(shape))
    for side in (64, 100 + p.fill_reach):
        for name, values in gather(shape, ((w, final(w)) for w in tiles(shape, side))).items():
            assert values.tobytes() == once[name].tobytes(), (name, side)


def test_an_image_with_fewer_levels_than_alignment_asks_for():
    views, params = both(sheared), HfvmParams(plane_level=6)
    once, found = tiled.match(*views, params, None, quiet, None), in_tiles(views, params, 100, 0)
    assert once.aligned
    for name, values in once.arrays.items():
        assert values.tobytes() == found.arrays[name].tobytes(), name


def test_presets_that_reach_over_the_image_are_matched_whole():
    assert tiled.is_whole(HfvmParams(preset="accurate"))
    assert not any(tiled.is_whole(HfvmParams(preset=p)) for p in ("default", "fast", "paper"))


def test_aligned_windows_are_parts_of_the_aligned_pyramid():
    left, right = both(sheared)
    mask = np.array(right.masks[0])
    mask[40:90, 60:150] = 0
    right = Plain.of(build(right.images[0], PyramidParams(), mask))
    h = np.array([[1.0, -0.5, 12.0], [0.01, 1.0, 0.0], [0.0, 1e-4, 1.0]])
    m = plane.margin(left.shapes[0])
    image = np.empty([n + 2 * m for n in left.shapes[0]], np.float32)
    valid = np.empty(image.shape, np.uint8)
    grey, place = right.filled(0, whole(right.shapes[0])), WindowPair(0, 0, 0, 0, *right.shapes[0])
    plane.warp(grey, right.masks[0], h @ plane.translation(-m), image, valid, place)
    expected = Plain.of(build(image, PyramidParams(levels=len(left.shapes)), valid))
    kept = Aligned.of(right, h, left, 0, None)
    bare = Aligned.again(right, h, left, kept.blank)
    some = Aligned.of(right, h, left, 2, 50)
    assert kept.blank == expected.blank
    for view in (kept, bare, some):
        for level, shape in enumerate(expected.shapes):
            window = Window(shape[0] // 5, shape[0] - 1, shape[1] // 3, shape[1])
            for read in ("grey", "valid", "filled"):
                np.testing.assert_array_equal(
                    getattr(view, read)(level, window), getattr(expected, read)(level, window)
                )


class Elsewhere:
    """A raster that is no array."""

    def __init__(self, array):
        self.array, self.shape = array, array.shape

    def __getitem__(self, at):
        return self.array[at]


def test_mosaic_is_the_image_it_was_cut_from():
    a = np.arange(35 * 52).reshape(35, 52)
    windows = tiles(a.shape, 10)
    mosaic = Mosaic(a.shape, windows, [Elsewhere(a[w.slices]) for w in windows])
    np.testing.assert_array_equal(mosaic[3:28, 9:51], a[3:28, 9:51])
    y, x = np.array([0, 34, 17, 9]), np.array([51, 0, 10, 9])
    np.testing.assert_array_equal(pick(mosaic, y, x), a[y, x])
    np.testing.assert_array_equal(gather(a.shape, [(w, {"a": a[w.slices]}) for w in reversed(windows)])["a"], a)


@pytest.mark.parametrize("up", [False, True])
def test_thinned_pixels_are_every_nth_of_all_however_it_is_read(monkeypatch, up):
    monkeypatch.setattr("rille.stages.hfvm.images.window.BLOCK", 7)
    marked = np.random.default_rng(0).random((45, 31)) < 0.3
    found = thinned(Elsewhere(marked), 50, lambda a: a, up)
    places = np.flatnonzero(marked)
    step = 1 + len(places) // 50 if up else len(places) // 50
    np.testing.assert_array_equal(found, places[::step])
    np.testing.assert_array_equal(thinned(marked, 50, lambda a: a, up), found)


def test_windows():
    assert tiles((5, 7), 4) == [Window(0, 4, 0, 4), Window(0, 4, 4, 7), Window(4, 5, 0, 4), Window(4, 5, 4, 7)]
    assert tiles((5, 7), None) == tiles((5, 7), 7) == [whole((5, 7))]
    assert Window(3, 9, 1, 4).align(4, (10, 7)) == Window(0, 10, 0, 4)
    assert Window(3, 9, 1, 4).grow(2, 5, (10, 7)) == Window(1, 10, 0, 7)
    assert Window(2, 9, 4, 7).parent() == Window(1, 5, 2, 4)
    assert Window(1, 5, 2, 4).child((9, 7)) == Window(2, 9, 4, 7)
    # nothing of it lies in the image: still a pixel, which no place can mean
    assert bounded(-9, -5, 20, 30, (10, 7), 2) == Window(0, 1, 6, 7)
