"""Rigs that are not the usual one: baselines along the columns, bent lines, far cameras, lenses of unlike length."""

import numpy as np
import pytest
from matching_scenes import pair, seen

from rille.stages.core.validity import matched
from rille.stages.geometry.projection import product
from rille.stages.hfvm import epipolar, plane
from rille.stages.hfvm.image import as_matched
from rille.stages.hfvm.level import FREE_BAND, PyramidPair, State, descend, hand_down, sample
from rille.stages.hfvm.matcher import DEFAULT
from rille.stages.hfvm.native.problem import Map
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.plane import Sample
from rille.stages.hfvm.stage import match
from rille.stages.imaging.pyramid import PyramidParams, build

SHAPE = (200, 240)


@pytest.mark.parametrize("upright", [True, False])
def test_relief_of_less_than_half_a_pixel_tells_along_what_lines_matches_lie(upright):
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0, SHAPE[1], 600), rng.uniform(0, SHAPE[0], 600)
    along, across = -30 + rng.uniform(-0.4, 0.4, 600), rng.normal(0, 0.05, 600)
    u, v = (across, along) if upright else (along, across)
    f, spread = epipolar.fit_points(x, y, u, v, SHAPE, SHAPE)
    assert epipolar.along_rows(f, SHAPE) is not upright
    assert spread < 0.06


def test_lines_that_lenses_bend_hold_no_match_of_preset_accurate():
    def bent(x, y):
        p, q = x / SHAPE[1] - 0.5, y / SHAPE[0] - 0.5
        return -12 + 4 * q, 12 * q * (p * p + q * q) + 6 * p**3

    left, right, u, v = pair(bent, SHAPE, noise=1.0)
    found = match(left, right, HfvmParams(preset="accurate"))
    good = matched(found.validity) & seen(u, v, SHAPE, 12)
    assert np.mean(good[seen(u, v, SHAPE, 12)]) > 0.95
    assert np.median(np.hypot(found.column_disparity - u, found.row_disparity - v)[good]) < 0.05


def test_rows_without_any_match_are_predicted_along_their_columns():
    ok = np.ones((6, 8), bool)
    ok[:3] = ok[4, 2] = False
    chance = np.where(ok, 5, 99).astype(np.int16)
    state = State(1, Map(chance, chance), Map(chance, chance), ok, ok, FREE_BAND, -1.0)
    for predicted in hand_down(state, HfvmParams()):
        assert (predicted == 5).all()


def test_lines_are_fitted_to_what_shows_something():
    """Not to the space around a body, which is black in both images and so agrees at no displacement."""
    images = pair(lambda x, y: (-14 + 4 * np.sin(x / 25) * np.sin(y / 30), 9.0 + 0 * x), SHAPE)[:2]
    black = [as_matched(build(np.pad(a, 150), PyramidParams()), HfvmParams()) for a in images]
    images = PyramidPair(*black, HfvmParams(), DEFAULT)
    state = descend(images, 1)
    found = sample(images, state)
    assert (images.left.layers[1].deviation[found.y, found.x] > 0).all()
    assert np.median(found.v) == pytest.approx(4.5, abs=0.1)


@pytest.mark.parametrize(("given", "kept"), [(1.0, 1.0), (0.0, -1.0)])
def test_a_sign_of_depth_that_is_given_stays_where_lines_seem_to_turn(monkeypatch, given, kept):
    """Aligned images do not tell the sign, and a coarse level's lines may seem to run along the columns."""
    fit = epipolar.fit_points

    def turned_at_the_top(*matches):
        found = fit(*matches)
        return found if min(matches[-1]) > 50 else (epipolar.transposed(found[0]), found[1])

    monkeypatch.setattr(epipolar, "fit_points", turned_at_the_top)
    left, right, _, _ = pair(lambda x, y: (-14 + 4 * np.sin(x / 25) * np.sin(y / 30), 0 * x), SHAPE)
    images = PyramidPair(
        *(as_matched(build(a, PyramidParams()), HfvmParams()) for a in (left, right)), HfvmParams(), DEFAULT
    )
    assert descend(images, 2, None, given).upright == (min(images.left.layers[2].shape) <= 50)
    assert descend(images, 1, None, given).near_sign == kept


def on_plane(h, share=1.0, level=2):
    """Matches of a level, a ``share`` of them on the plane of a homography of full resolution; and shapes of levels."""
    h, shape, rng = np.linalg.inv(plane.finer(level)) @ h @ plane.finer(level), (50, 60), np.random.default_rng(5)
    y, x = (a.ravel().astype(float) for a in np.indices(shape))
    p, q, w = product(h, x, y)
    astray = rng.uniform(0, 1, x.size) > share
    u, v = (np.where(astray, d + rng.uniform(-12, 12, x.size), d) for d in (p / w - x, q / w - y))
    return Sample(x, y, u, v), [SHAPE, (100, 120), shape]


def test_an_alignment_is_corrected_by_the_matches_that_it_makes():
    h = np.array([[1.0, 0.4, -9.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    rest = np.array([[1.02, 0.1, 3.0], [0.01, 1.0, -2.0], [0.0, 0.0, 1.0]])
    matches, shapes = on_plane(rest)
    found = plane.refitted(matches, 2, shapes, h)
    wanted = plane.to_original(h, SHAPE) @ rest
    np.testing.assert_allclose(found / found[2, 2], wanted / wanted[2, 2], atol=0.01)


def test_of_few_matches_fewer_need_lie_on_the_plane():
    matches, shapes = on_plane(np.array([[1.0, 0.5, -9.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), share=0.5)
    assert plane.find(matches, 2, shapes) is None
    assert plane.find(matches, 2, shapes, few=True) is not None


def test_a_right_image_of_twice_the_scale_is_averaged_where_it_is_aligned():
    _, x = np.indices((400, 480))
    stripes = np.where(x % 2, 200.0, 50.0).astype(np.float32)
    images = (as_matched(build(a, PyramidParams()), HfvmParams()) for a in (np.full(SHAPE, 125, np.float32), stripes))
    left, right = images
    grey = plane.aligned(right, np.diag([2.0, 2.0, 1.0]), left).layers[0]
    assert np.abs(grey.grey[grey.valid != 0] - 125).max() < 1
