"""Matches of textureless regions: a wall of little contrast behind a textured thing, and walls that tell nothing."""

import cv2
import numpy as np
import pytest

from rille.stages.core.validity import matched
from rille.stages.hfvm import epipolar, textureless
from rille.stages.hfvm.image import Window, pack, whole
from rille.stages.hfvm.matcher import MatchOptions
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.stage import match
from rille.stages.hfvm.textureless import MIN_DISTINCT_STEPS, WINDOW_SIDE_PX, Planes, Region, search

ROWS, COLS = 220, 300
WALL = -8.0


def texture(seed, deviation, shape=(ROWS, COLS + 80)):
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, shape), (0, 0), 1.5)
    return deviation * noise / noise.std()


def scene(wall=0.3, noise=0.05, tilt=0.0):
    """A thing in front of a wall of little contrast; displacements of both (grey levels, pixels)."""
    y, x = np.indices((ROWS, COLS), np.float32)
    back, thing = texture(1, wall), texture(2, 25.0)

    def shown(x_wall, x_thing):
        """Grey values of the places that are seen on the wall and on the thing."""
        wall, front = (cv2.remap(a, (at + 40).astype(np.float32), y, 1) for a, at in ((back, x_wall), (thing, x_thing)))
        return 130 + np.where((x_thing >= 110) & (x_thing < 230) & (y >= 60), front, wall)

    near = -26 - 8 * np.sin(y / 25)
    left, right = shown(x, x), shown((x - WALL + tilt * COLS / 2) / (1 + tilt), x - near)
    rng = np.random.default_rng(3)
    left, right = (a + rng.normal(0, noise, a.shape) for a in (left, right))
    is_wall = np.ones((ROWS, COLS), bool)
    is_wall[50:, 100:240] = False
    return left.astype(np.float32), right.astype(np.float32), WALL + tilt * (x - COLS / 2), is_wall


@pytest.mark.parametrize("tilt", [0.0, 0.02])
def test_a_wall_of_little_contrast_is_matched_on_its_plane(tilt):
    left, right, u, wall = scene(tilt=tilt)
    found, without = (match(left, right, HfvmParams(without=steps)) for steps in ((), ("planes",)))
    ok = matched(found.validity) & wall
    assert ok[wall].mean() > 0.5 > 0.2 > matched(without.validity)[wall].mean()
    error = np.hypot(found.column_disparity - u, found.row_disparity)[ok]
    assert np.mean(error < 1) > 0.95
    std = found.disparity_std[ok]
    assert np.mean(error < std) > 0.6
    assert np.mean(error < 2 * std) > 0.9
    assert np.isnan(found.backmatch_error[ok & ~matched(without.validity)]).all(), "nothing was matched back"
    filled = np.isfinite(found.column_disparity) & wall
    assert np.mean(np.abs(found.column_disparity - u)[filled] < 2) > 0.95, "its gaps are filled from it"


def test_images_with_a_baseline_along_the_columns_are_matched_alike():
    left, right, u, wall = (np.ascontiguousarray(a.T) for a in scene())
    found = match(left, right, HfvmParams(top_rows=0.5))
    ok = matched(found.validity) & wall
    assert ok[wall].mean() > 0.5
    assert np.mean(np.hypot(found.column_disparity, found.row_disparity - u)[ok] < 1) > 0.95


@pytest.mark.parametrize(("wall", "noise"), [(0.0, 0.0), (0.0, 0.2)], ids=["black", "noise"])
def test_a_wall_that_tells_nothing_has_no_matches(wall, noise):
    left, right, _, on_wall = scene(wall, noise)
    found = match(left, right, HfvmParams())
    assert matched(found.validity)[on_wall].mean() < 0.02


def test_a_wall_whose_displacement_is_beyond_all_that_is_searched_is_left_alone():
    left, right, _, on_wall = scene()
    far = np.roll(right, 60, axis=1)
    right[:, 235:] = far[:, 235:]
    right[:50] = far[:50]
    displaced = on_wall.copy()
    displaced[50:, :235] = False
    found = match(left, right, HfvmParams())
    ok = matched(found.validity)
    assert ok[displaced].mean() < 0.02
    still = ok & on_wall & ~displaced
    assert np.mean(np.abs(found.column_disparity[still] - WALL) < 1) > 0.95


def test_tiles_have_the_planes_of_the_whole():
    left, right, _, wall = scene(tilt=0.02)
    once, tiles = (match(left, right, options=MatchOptions(side=side)) for side in (None, 77))
    assert np.mean(matched(once.validity) == matched(tiles.validity)) > 0.99
    both = matched(once.validity) & matched(tiles.validity) & wall
    assert both[wall].mean() > 0.5
    assert np.mean(np.abs(once.column_disparity - tiles.column_disparity)[both] < 0.05) > 0.99


def test_masked_pixels_and_lonely_matches_have_neither_match_nor_standard_deviation():
    left, right, _, wall = scene()
    usable = np.ones(left.shape, np.uint8)
    usable[:, 60] = 0
    found = match(left, right, HfvmParams(min_support=0.7), valid=(usable, None))
    ok = matched(found.validity)
    assert ok[wall].mean() > 0.3
    assert not ok[:, 60].any()
    np.testing.assert_array_equal(np.isfinite(found.disparity_std), ok)


def test_a_plane_through_two_columns_of_windows():
    y, x = (a.ravel() for a in np.mgrid[0:1000, 0:2])
    step = np.rint(-7 + 0.01 * y + 0.0 * x)
    step[::3] = np.random.default_rng(0).integers(-30, 5, len(step[::3]))
    g, error = textureless._fit(x, y, step, np.ones(len(x)))
    assert g[2] == pytest.approx(0.01, abs=2e-4)
    assert np.mean(error < 1) > 0.65


def test_lines_lead_to_displacements_and_back():
    f = np.array([[1e-6, 2e-5, -0.01], [-3e-5, 1e-6, 1.0], [0.02, -1.0, 1.5]])
    f = epipolar.oriented(-f, (200, 300))
    x, y = np.array([20, 150, 290]), np.array([10, 100, 190])
    along = np.array([-30.0, 4.0, 11.0])
    lines = epipolar.lines_at(f, x, y)
    u, v = epipolar.on_line(lines, along)
    np.testing.assert_allclose(lines[1] * u - lines[0] * v, along, atol=1e-3)
    ends, starts = np.stack([x + u, y + v, np.ones(3)]), np.stack([x, y, np.ones(3)])
    np.testing.assert_allclose(np.sum(ends * (f @ starts), axis=0), 0, atol=1e-3)
    assert (np.diff(u[np.argsort(along)]) > 0).all()
    for i, j, expected in zip(x, y, epipolar.lines_at(f, x, y).T, strict=True):
        line = epipolar.lines(epipolar.moved(f, (i, j), (i, j)), (1, 1))[0, 0]
        np.testing.assert_allclose(line, expected, rtol=1e-4)


@pytest.mark.parametrize("window", [Window(0, 9, 0, 13), Window(3, 8, 5, 12), Window(4, 9, 2, 13)])
def test_a_window_of_planes_is_part_of_the_whole(window):
    region = np.random.default_rng(0).integers(-2, 3, (5, 7)).astype(np.int8)
    f = np.array([[0, 0, 0], [0, 0, 1.0], [0, -1.0, 0.5]])
    planes = Planes(region, [[-8.0, 0.1, 0.0, 0.5], [3.0, 0.0, -0.2, 1.0]], f)
    everything = planes.cut(whole((9, 13)))
    for part, all_of_it in zip(planes.cut(window), everything, strict=True):
        np.testing.assert_array_equal(part, all_of_it[window.slices])
    twice = region.repeat(2, 0).repeat(2, 1)[:9, :13]
    np.testing.assert_array_equal(everything[0], twice)
    is_one = np.abs(twice) == 1
    np.testing.assert_allclose(everything[1][is_one], (-8 + 0.1 * np.indices((9, 13))[1])[is_one], rtol=1e-6)
    np.testing.assert_array_equal(everything[3][is_one], 0.5)


def test_search_and_its_definition_agree():
    rng = np.random.default_rng(5)
    images = [rng.normal(100, 0.4, (40, 60)).astype(np.float32) for _ in range(2)]
    words, others = (pack(image, HfvmParams().weights)[0] for image in images)
    valid = np.ones((40, 60), np.uint8)
    valid[20:, 36:] = 0
    window, steps = Window(5, 31, 12, 50), np.arange(-9, 4, dtype=np.float32)
    region = np.zeros(window.shape, bool)
    region[2:24, 3:36] = True
    region[10:14, 12:20] = False
    lines = epipolar.lines(np.array([[0, 0, 0], [0, 0, 1.0], [0, -1.0, -1.0]]), window.shape)
    left = np.ascontiguousarray(words[window.slices])
    found = search(Region(left, region, lines, others, valid, window.x0, window.y0), steps)
    a, b = (w.view(np.uint8).reshape(*w.shape, 8).astype(int) for w in (words, others))
    inside_region = np.argwhere(region)
    sums, sizes = np.full((*region.shape, len(steps)), np.inf), np.zeros(region.shape)
    for y, x in inside_region:
        around = np.s_[
            max(y - WINDOW_SIDE_PX // 2, 0) : y + WINDOW_SIDE_PX // 2 + 1,
            max(x - WINDOW_SIDE_PX // 2, 0) : x + WINDOW_SIDE_PX // 2 + 1,
        ]
        j, i = (p[around][region[around]] for p in np.indices(region.shape))
        sizes[y, x] = len(j)
        for n, step in enumerate(steps.astype(int)):
            q, p = j + window.y0 + 1, i + window.x0 + step
            if (q < 0).any() or (q >= 40).any() or (p < 0).any() or (p >= 60).any() or not valid[q, p].all():
                continue
            apart = np.abs(a[j + window.y0, i + window.x0] - b[q, p]).sum(axis=1)
            sums[y, x, n] = np.minimum(apart, 60).sum()
    claims = {}
    for n, step in enumerate(steps.astype(int)):
        for y, x in inside_region:
            mean = np.float32(sums[y, x, n]) / np.float32(sizes[y, x])
            if mean < claims.get((y, x + step), (np.inf,))[0]:
                claims[y, x + step] = mean, step
    np.testing.assert_array_equal(found.tried, np.isfinite(sums).sum(axis=2))
    for y, x in inside_region[found.tried[region] > 0]:
        k = int(np.argmin(sums[y, x]))
        before, least, after = np.pad(sums[y, x], 1, constant_values=np.inf)[k : k + 3]
        rise = max(before, after) - least
        fraction = 0.5 * (before - after) / rise if np.isfinite(rise) and rise > 0 else 0.0
        assert found.best[y, x] == pytest.approx(steps[k] + fraction, abs=1e-5)
        assert found.least[y, x] == sums[y, x, k]
        rival = min(total for n, total in enumerate(sums[y, x]) if abs(n - k) > MIN_DISTINCT_STEPS)
        assert found.distinct[y, x] == (rival - sums[y, x, k] if np.isfinite(rival) else 0)
        assert found.mutual[y, x] == (abs(claims[y, x + int(steps[k])][1] - steps[k]) <= MIN_DISTINCT_STEPS)
    assert not found.mutual[found.tried == 0].any()
    tried = found.tried[region]
    assert set(tried) >= {0, 5, len(steps)}
    assert 0.2 < found.mutual[region].mean() < 0.9
