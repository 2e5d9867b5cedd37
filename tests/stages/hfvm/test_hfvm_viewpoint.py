"""Views that are turned, scaled or slanted against each other; every displacement is known exactly."""

import cv2
import numpy as np
import pytest
from matching_scenes import Texture, pair, seen

from rille.stages.core.validity import matched
from rille.stages.hfvm import plane
from rille.stages.hfvm.image import as_matched
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.stage import match
from rille.stages.imaging.pyramid import PyramidParams, build

SHAPE, RIGHT = (200, 260), (340, 340)


def turned(degrees, scale=1.0, slant=0.0):
    """Scene of two views whose right one is turned about its middle, enlarged, and seen at a slant."""
    c, s = scale * np.cos(np.radians(degrees)), scale * np.sin(np.radians(degrees))

    def displacement(x, y):
        dx, dy = x - SHAPE[1] / 2, y - SHAPE[0] / 2
        w = 1.0 + slant * dx / SHAPE[1]
        return (c * dx - s * dy) / w + RIGHT[1] / 2 - x, (s * dx + c * dy) / w + RIGHT[0] / 2 - y

    return pair(displacement, SHAPE, RIGHT, noise=1.0)


@pytest.mark.parametrize(
    ("degrees", "scale", "slant"),
    [(60, 1.0, 0.0), (180, 1.0, 0.0), (-120, 1.0, 0.3), (35, 1.3, 0.0), (30, 2.2, 0.0), (0, 3.0, 0.0), (0, 0.6, 0.0)],
)
def test_turned_views_are_matched_in_their_own_frame(degrees, scale, slant):
    left, right, u, v = turned(degrees, scale, slant)
    found = match(left, right)
    both = seen(u, v, right.shape, 12)
    error = np.hypot(found.column_disparity - u, found.row_disparity - v)
    assert found.unlike.aligned
    assert np.mean(matched(found.validity)[both]) > 0.9
    # In pixels of the right image, of which one of the left one is as many wide.
    assert np.median(error[both & matched(found.validity)]) < 0.1 * max(scale, 1.0)
    # What was interpolated follows the turned surface, too.
    assert np.mean(error[both] < 1) > 0.97
    assert np.mean(matched(match(left, right, HfvmParams(without=("turn",))).validity)) < 0.02


@pytest.mark.parametrize(("left_px", "right_px"), [(3.0, 4.2), (3.0, 7.2)])
def test_texture_as_fine_as_pixels_is_found_in_views_of_other_scale(left_px, right_px):
    # Means over squares of so many cells of noise without long waves: no level shows what another one does.
    side, cells = 300, 2160
    grey = cv2.GaussianBlur(np.random.default_rng(4).normal(128, 400, (cells, cells)).astype(np.float32), None, 2.5)
    ends = [int(side * px) for px in (left_px, right_px)]
    parts = [grey[(k := (cells - end) // 2) : k + end, k : k + end] for end in ends]
    left, right = (cv2.resize(part, (side, side), interpolation=cv2.INTER_AREA) for part in parts)
    x = np.arange(side)
    there = ((x + 0.5) * left_px + (ends[1] - ends[0]) / 2) / right_px - 0.5
    u, v = np.broadcast_arrays(there - x, (there - x)[:, None])
    found = match(left, right)
    both = seen(u, v, right.shape, 12)
    error = np.hypot(found.column_disparity - u, found.row_disparity - v)
    assert found.unlike.aligned
    assert np.mean((matched(found.validity) & (error < 1))[both]) > 0.6
    assert np.mean(error[both] < 1) > 0.95


@pytest.mark.parametrize("degrees", [90, 150])
def test_a_scene_that_is_brighter_at_one_end_is_turned_with_its_light(degrees):
    left, right, u, v = turned(degrees)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, (rows, cols) = np.indices(SHAPE)[1], np.indices(RIGHT)
    there = (cols - RIGHT[1] / 2) * c + (rows - RIGHT[0] / 2) * s
    lit = [0.6 * a * np.exp(d / 130) for a, d in ((left, x - SHAPE[1] / 2), (right, there))]
    found = match(*(np.clip(a, 0, 255).astype(np.float32) for a in lit))
    assert np.mean(matched(found.validity)[seen(u, v, right.shape, 12)]) > 0.95


@pytest.mark.parametrize(("preset", "degrees", "wide"), [("fast", 180, 0.2), ("accurate", 150, 0.1)])
def test_other_presets_match_turned_views_alike(preset, degrees, wide):
    left, right, u, v = turned(degrees)
    found = match(left, right, HfvmParams(preset=preset))
    both = seen(u, v, right.shape, 12)
    error = np.hypot(found.column_disparity - u, found.row_disparity - v)
    assert np.mean(matched(found.validity)[both]) > 0.9
    # Half the resolution, too, gives each pixel of a square of 2 x 2 its own displacement, else errors reach 1.4.
    assert np.percentile(error[both & matched(found.validity)], 95) < wide


def test_a_plane_fitted_to_chance_matches_does_not_rule_out_a_turn(monkeypatch):
    left, right, u, v = turned(60)
    monkeypatch.setattr(plane, "find", lambda *_: np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    found = match(left, right)
    assert np.mean(matched(found.validity)[seen(u, v, right.shape, 12)]) > 0.9


def test_keypoints_tell_the_homography_at_full_resolution():
    left, right, u, v = turned(75, 1.2)
    large = (build(cv2.resize(image, None, fx=4, fy=4), PyramidParams()) for image in (left, right))
    views = [as_matched(pyramid, HfvmParams()) for pyramid in large]
    assert max(views[1].shapes[0]) > 1024
    h = plane.find_turn(*views)
    x, y, _ = h @ (4 * 100 + 1.5, 4 * 80 + 1.5, 1) / (h[2] @ (4 * 100 + 1.5, 4 * 80 + 1.5, 1))
    np.testing.assert_allclose((x, y), (4 * (100 + u[80, 100]) + 1.5, 4 * (80 + v[80, 100]) + 1.5), atol=1.0)


@pytest.mark.parametrize("right", ["another scene", "noise", "nothing", "mirrored"])
def test_unrelated_views_are_refused(right):
    y, x = np.indices(SHAPE, dtype=np.float64)
    images = {
        "another scene": Texture(9)(x, y),
        "noise": np.random.default_rng(0).normal(128, 30, SHAPE).astype(np.float32),
        "nothing": np.full(SHAPE, 90, np.float32),
        "mirrored": np.ascontiguousarray(Texture(0)(x, y)[:, ::-1]),
    }
    views = [as_matched(build(image, PyramidParams()), HfvmParams()) for image in (Texture(0)(x, y), images[right])]
    assert plane.find_turn(*views) is None


@pytest.mark.data
def test_images_of_unlike_size_are_looked_at_in_their_own_scale_however_many_chance_makes_consistent(data_dir):
    left, right = (
        cv2.imread(str(data_dir / "kitti06_51" / side / "000000.png"), cv2.IMREAD_GRAYSCALE)[:, :800]
        for side in ("image_l", "image_r")
    )
    half = cv2.resize(left, (400, left.shape[0] // 2), interpolation=cv2.INTER_AREA)
    # Of the few coarse pixels of the small image a half is consistent by chance.
    assert matched(match(half, right, HfvmParams(preset="fast")).validity).mean() > 0.6
