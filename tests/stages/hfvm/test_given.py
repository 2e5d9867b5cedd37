"""Disparities of another program: what the check keeps and rejects of a scene with occlusion and wrong patches."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from matching_scenes import Texture

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.core.validity import Validity, has, matched
from rille.stages.hfvm.given import check, hfvm_given_stage
from rille.stages.hfvm.map_reading import better_reading
from rille.stages.hfvm.params import HfvmParams
from rille.stages.imaging import pyramid
from rille.stages.imaging.pyramid import PyramidParams, pyramid_stage

SHAPE = ROWS, COLS = 140, 200
FAR, NEAR = -6.25, -24.5
"""Column displacements of the background, and of a plate before it."""

PLATE = np.s_[40:100, 80:130]
HIDDEN = np.s_[40:100, 63:80]
"""Background that the plate hides from the right camera, which stands to the right: as wide as they are apart."""

WRONG = ((np.s_[10:30, 100:120], -14.0), (np.s_[110:130, 120:150], -2.0), (np.s_[55:75, 95:115], -17.0))
"""Patches and their displacements: before the background, behind it, and on the plate."""


def scene(row=0.0, noise=1.0, gain=1.0):
    """Left and right image: the plate and what is behind it have textures of their own; ``row``: of the right image."""
    behind, plate = Texture(3), Texture(4)
    y, x = np.indices(SHAPE, dtype=np.float64)
    left = behind(x, y)
    left[PLATE] = plate(x, y)[PLATE]
    right = behind(x - FAR, y - row)
    over = (y - row >= 40) & (y - row < 100) & (x - NEAR >= 80) & (x - NEAR < 130)
    right[over] = plate(x - NEAR, y - row)[over]
    rng = np.random.default_rng(5)
    return [np.clip(g * a + rng.normal(0, noise, SHAPE), 0, 255) for g, a in ((1.0, left), (gain, right))]


def truth():
    u = np.full(SHAPE, FAR, np.float32)
    u[PLATE] = NEAR
    return u


def foreign(off=0.0):
    """Another program's map: the plate's displacement where it hides the background, too, and wrong patches.

    ``off``: standard deviation of its errors, alike in blocks of 8 x 8 pixels.
    """
    u = truth()
    u[HIDDEN] = NEAR
    blocks = np.random.default_rng(6).normal(0, off, (-(-ROWS // 8), -(-COLS // 8))) if off else np.zeros((18, 25))
    u += cv2.resize(blocks, (COLS, ROWS), interpolation=cv2.INTER_NEAREST).astype(np.float32)
    for where, value in WRONG:
        u[where] = value
    u[100:104, 20:60] = np.nan
    return u


def checked(images, u, **params):
    left, right = (pyramid.build(image, PyramidParams(), None) for image in images)
    return check(left, right, u, HfvmParams(**params))


def right_pixels():
    """Pixels whose given displacement is true, a window's reach away from the others and from the border."""
    good = np.nan_to_num(np.abs(foreign() - truth()), nan=9.0) < 0.1
    good[:, :30] = False  # they leave the right image
    return cv2.erode(good.astype(np.uint8), np.ones((13, 13), np.uint8), borderValue=0).astype(bool)


@pytest.mark.parametrize("preset", ["default", "accurate", "fast", "paper"])
def test_true_displacements_stay_and_wrong_ones_go(preset):
    u = foreign()
    found = checked(scene(), u, preset=preset)
    ok = matched(found["validity"])
    np.testing.assert_array_equal(found["column_disparity"][ok], u[ok])
    assert ok[right_pixels()].mean() > 0.97
    assert ok[HIDDEN].mean() < 0.15
    for where, _ in WRONG:
        assert ok[where].mean() < 0.1
    assert not ok[np.isnan(u)].any()
    std = found["disparity_std"]
    np.testing.assert_array_equal(np.isfinite(std), ok)


def test_bits_say_why():
    validity = checked(scene(), foreign())["validity"]
    assert has(validity, Validity.BACKMATCH_FAILED)[HIDDEN].mean() > 0.6
    assert has(validity, Validity.OVER_THRESHOLD)[100:104, 20:60].all()
    assert has(validity, Validity.OUT_OF_IMAGE)[:, :6].all()


def test_a_blank_wall_is_no_match():
    left, right = scene(noise=0.1)
    for image in (left, right):
        image[:60] = 128.0
    validity = checked((left, right), foreign())["validity"]
    assert has(validity, Validity.NO_TEXTURE)[5:50].mean() > 0.95
    assert matched(validity)[5:50].mean() < 0.02


def test_nothing_of_unlike_images_is_believed():
    left, _ = scene()
    right = Texture(9)(*np.indices(SHAPE, dtype=np.float64)[::-1])
    assert matched(checked((left, right), foreign())["validity"]).mean() < 0.02


def test_an_unlike_exposure_is_evened():
    ok = [matched(checked(scene(gain=gain), foreign())["validity"])[right_pixels()].mean() for gain in (1.0, 0.7)]
    assert ok[1] > ok[0] - 0.03


@pytest.mark.parametrize("row", [0.0, 0.4, -0.8])
def test_rows_are_those_of_the_images(row):
    found = checked(scene(row), foreign())
    ok = matched(found["validity"]) & right_pixels()
    assert ok.sum() > 0.9 * right_pixels().sum()
    assert np.median(found["row_disparity"][ok]) == pytest.approx(row, abs=0.06)


def test_standard_deviations_follow_the_errors_of_the_map():
    """A map that errs more gets greater ones, without being told."""
    medians = []
    for off in (0.1, 0.3, 0.5):
        found = checked(scene(), foreign(off))
        ok = matched(found["validity"]) & right_pixels()
        assert ok.sum() > 0.8 * right_pixels().sum()
        error = np.abs(found["column_disparity"] - truth())[ok] / found["disparity_std"][ok]
        assert (error < 1).mean() > 0.62
        assert (error < 2).mean() > 0.9
        medians.append(np.median(found["disparity_std"][ok]))
    assert medians[2] > 1.2 * medians[1] > 1.4 * medians[0]


def test_a_stated_standard_deviation_counts_where_it_is_stated():
    usable = np.ones(SHAPE, np.uint8)
    images = ({"image": image.astype(np.uint8), "valid": usable} for image in scene())
    left, right = (pyramid_stage(PyramidParams(), Bundle(arrays, {})) for arrays in images)
    u = foreign()
    sigma = np.full(SHAPE, 0.25, np.float32)
    sigma[:, 150:] = np.nan
    given = [
        Bundle(arrays, {}) for arrays in ({"column_disparity": u}, {"column_disparity": u, "disparity_std": sigma})
    ]
    estimated, stated = (hfvm_given_stage(HfvmParams(), left, right, one) for one in given)
    check_outputs(hfvm_given_stage, stated)
    ok = matched(stated["validity"])
    assert (stated["disparity_std"][:, :150][ok[:, :150]] == 0.25).all()
    np.testing.assert_array_equal(stated["disparity_std"][:, 150:], estimated["disparity_std"][:, 150:])
    assert np.isnan(stated["disparity_std"][~ok]).all()
    assert stated.meta["match_rate"] == pytest.approx(ok.mean())


@pytest.mark.parametrize(
    ("wrong", "fit"),
    [
        (lambda u: -u, "their values times -1"),
        (lambda u: 16 * u, "their values times 0.0625"),
        (lambda u: u / 256, "their values times 256"),
        (lambda u: u / 2, "their values times 2"),
        (lambda u: u[::-1], "their rows in reverse"),
        (lambda u: u - 31, ""),
        (lambda u: u * np.nan, ""),
    ],
)
def test_a_map_that_fits_otherwise_is_named_with_how(wrong, fit):
    """Ground, which is the nearer the lower it lies."""
    left = cv2.GaussianBlur(np.random.default_rng(5).uniform(0, 255, SHAPE).astype(np.float32), (0, 0), 1.0)
    nearer = 4 + np.arange(ROWS) // 8
    right = np.array([np.roll(row, -by) for row, by in zip(left, nearer, strict=True)])
    u = np.repeat(-nearer[:, None], COLS, axis=1).astype(np.float32)
    assert better_reading(left, right, wrong(u)) == fit


def warnings_of(images, u):
    usable = np.ones(SHAPE, np.uint8)
    images = ({"image": image.astype(np.uint8), "valid": usable} for image in images)
    left, right = (pyramid_stage(PyramidParams(), Bundle(arrays, {})) for arrays in images)
    given = Bundle({"column_disparity": np.asarray(u, np.float32)}, {})
    return hfvm_given_stage(HfvmParams(), left, right, given).meta.get("warnings", [])


@pytest.mark.parametrize(("factor", "said"), [(1, []), (np.nan, []), (16, ["their values times 0.0625"])])
def test_maps_that_the_images_contradict_are_a_warning(factor, said):
    lines = warnings_of(scene(), factor * foreign())
    assert len(lines) == len(said)
    assert all(words in line for words, line in zip(said, lines, strict=True))


def test_maps_of_the_right_images_are_named():
    left, x = scene()[0], np.arange(COLS, dtype=np.float64)
    by = -12.0 - 6.0 * np.sin(x / 9.0)
    right = np.array([np.interp(x, x + by, row) for row in left])
    assert warnings_of((left, right), np.tile(by, (ROWS, 1))) == []
    (line,) = warnings_of((left, right), np.tile(np.interp(x, x + by, by), (ROWS, 1)))
    assert "are those of the right images" in line


def test_absurd_values_count_as_unknown():
    u = foreign()
    u[50:60] = 1e30
    found = checked(scene(), u)
    assert not matched(found["validity"])[50:60].any()


def test_a_tiny_pair_has_no_coarser_level():
    images = [image[:12, :14] for image in scene()]
    left, right = (pyramid.build(image, PyramidParams(), None) for image in images)
    assert left.levels == 1
    u = np.full((12, 14), FAR, np.float32)
    arrays = check(left, right, u, HfvmParams())
    assert {array.shape for array in arrays.values()} == {(12, 14)}
