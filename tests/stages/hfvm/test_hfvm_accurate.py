"""Parts of preset ``accurate``: compact features, propagation along paths, relief; and the whole."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matching_scenes import Texture, pair, seen

from rille.stages.core.errors import RilleError
from rille.stages.core.validity import Validity, has, matched
from rille.stages.geometry.spline import coefficients
from rille.stages.hfvm import epipolar, refinement
from rille.stages.hfvm.finest import lonely
from rille.stages.hfvm.image import Layer, compact
from rille.stages.hfvm.level import FREE_BAND, LevelInput, paths
from rille.stages.hfvm.native import reference
from rille.stages.hfvm.native.problem import CANDIDATES, Field, LevelPair, pack_map, unpacked
from rille.stages.hfvm.native.reference import NO_CANDIDATE
from rille.stages.hfvm.params import PRESETS, HfvmParams
from rille.stages.hfvm.refinement import SplineImages
from rille.stages.hfvm.stage import match
from rille.stages.imaging.pyramid import PyramidParams, build

ACC = HfvmParams(preset="accurate")


def view(image):
    usable = np.ones(image.shape, np.uint8)
    return Layer.of(
        lambda window: (np.ascontiguousarray(image[window.slices]), usable[window.slices]), image.shape, ACC.weights
    )


def propagated(left, right, start):
    """Displacements of two images improved along paths."""
    look = LevelInput(1, view(left), view(right), None, FREE_BAND, 0.0, 1, ACC)
    nothing = np.zeros(left.shape, np.int32)
    return unpacked(paths(look, Field(pack_map(*start), nothing)).shift)


def stairs(shape=(60, 120), near=-12, far=-4, edges=(40, 80)):
    """A near block before a far wall, whole-pixel displacements: left and right image, and true columns."""
    cols = shape[1]
    y, x = np.indices(shape, dtype=np.float64)
    u = np.where((x >= edges[0]) & (x < edges[1]), near, far)
    block, wall = Texture(3), Texture(8)
    left = np.where(u == near, block(x, y), wall(x, y)).astype(np.float32)
    hidden = (x - near >= edges[0]) & (x - near < edges[1])
    right = np.where(hidden, block(x - near, y), wall(x - far, y)).astype(np.float32)
    # Wall pixels whose match lies behind the block in the right image.
    occluded = (u == far) & hidden[np.indices(shape)[0], np.clip(np.indices(shape)[1] + far, 0, cols - 1)]
    return left, right, u, occluded


# -- compact features --------------------------------------------------------------------------------------------------


def test_compact_features_by_hand():
    image = np.full((3, 3), 10.0, np.float32)
    image[1, 0], image[1, 2], image[0, 1], image[2, 1], image[2, 2] = 19.0, 6.0, 10.0, 11.0, 255.0 + 10.0
    word = int(compact(image)[1, 1])
    steps = [9.0, -4.0, 0.0, 1.0, 0.0, 0.0, 0.0, 255.0]
    expected = [min(int(128.5 + 8 * np.sign(s) * np.sqrt(abs(s))), 255) for s in steps]
    assert [(word >> 8 * k) & 255 for k in range(8)] == expected
    assert expected[0] == 152
    assert expected[1] == 112


def test_compact_features_know_no_brightness_and_reach_one_pixel():
    rng = np.random.default_rng(1)
    image = rng.integers(20, 200, (20, 30)).astype(np.float32)
    np.testing.assert_array_equal(compact(image + 30), compact(image))
    other = image.copy()
    other[10, 12] += 40
    rows, cols = np.nonzero(compact(other) != compact(image))
    assert (rows.min(), rows.max(), cols.min(), cols.max()) == (9, 11, 11, 13)


# -- propagation along paths -------------------------------------------------------------------------------------------


def brute_force(cu, cv, cost, grey, small, large, half):
    """Path costs by their definition, one path of pixels at a time."""
    rows, cols, most = cost.shape
    total = np.zeros(cost.shape, np.int64)
    for dy, dx in [(1, 1), (1, 0), (1, -1), (-1, -1), (-1, 0), (-1, 1)]:
        done = {}

        def at(y, x, dy=dy, dx=dx, done=done):
            if (y, x) not in done:
                j, i = y - dy, x - dx
                if not (0 <= j < rows and 0 <= i < cols):
                    done[y, x] = [int(c) for c in cost[y, x]]
                else:
                    before = at(j, i)
                    step = np.float32(abs(grey[y, x] - grey[j, i]))
                    far = int(max(np.float32(large) / (np.float32(1) + step / np.float32(half)), 2 * small))
                    found = []
                    for k in range(most):
                        gaps = [abs(int(cu[j, i, m]) - int(cu[y, x, k])) + abs(int(cv[j, i, m]) - int(cv[y, x, k]))
                                for m in range(most)]  # fmt: skip
                        least = min(b + min(small * g, far) for b, g in zip(before, gaps, strict=True))
                        found.append(int(cost[y, x, k]) + min(least, min(before) + far) - min(before))
                    done[y, x] = found
            return done[y, x]

        for y in range(rows):
            for x in range(cols):
                total[y, x] += at(y, x)
    return total


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 10**6))
def test_path_costs_are_those_of_the_definition(seed):
    rng = np.random.default_rng(seed)
    shape = (4, 5, CANDIDATES)
    cu, cv = rng.integers(-9, 9, (2, *shape)).astype(np.int16)
    cost = rng.integers(0, 16001, shape).astype(np.int32)
    cost[rng.random(shape) < 0.2] = NO_CANDIDATE
    cost[..., 0] = np.minimum(cost[..., 0], 16000)  # a pixel has one candidate at least: its own
    grey = rng.uniform(0, 255, shape[:2]).astype(np.float32)
    total = np.zeros(shape, np.int32)
    for sign in (1, -1):
        reference._sweep(pack_map(cu, cv), cost, grey, sign, total)
    there = cost != NO_CANDIDATE
    np.testing.assert_array_equal(total[there], brute_force(cu, cv, cost, grey, 36, 240, 10.0)[there])


def listed(maps, up, y, x, right_shape):
    """Candidates (u, v) of a pixel by their definition."""
    u, v = maps
    rows, cols = u.shape
    found = [(int(u[y, x]), int(v[y, x]))]
    more = [(u[y, x] + i, v[y, x] + j) for j, i in ((0, -1), (0, 1), (-1, 0), (1, 0))]
    for j, i in reference.AROUND:
        near = min(max(y + j, 0), rows - 1), min(max(x + i, 0), cols - 1)
        more.append((u[near], v[near]))
    for j, i in np.ndindex(3, 3) if up.size else ():
        above = min(max(y // 2 + j - 1, 0), up.shape[1] - 1), min(max(x // 2 + i - 1, 0), up.shape[2] - 1)
        more.append((up[0][above], up[1][above]))
    for a, b in more:
        inside = 0 <= x + a < right_shape[1] and 0 <= y + b < right_shape[0]
        if inside and (int(a), int(b)) not in found and len(found) < CANDIDATES:
            found.append((int(a), int(b)))
    return found


@pytest.mark.parametrize("with_up", [False, True])
@pytest.mark.parametrize("mu", [0.0, 3.0])
def test_candidates_and_their_costs_are_those_of_the_definition(mu, with_up):
    rng = np.random.default_rng(3)
    left, right = (rng.uniform(0, 255, shape).astype(np.float32) for shape in ((11, 14), (12, 17)))
    a, b = view(left), view(right)
    maps = rng.integers(-6, 6, (2, *left.shape)).astype(np.int16)
    f = rng.normal(0, 1, (3, 3))
    lines = epipolar.lines(f, left.shape)
    shift, cost = np.empty((2, *left.shape, CANDIDATES), np.int32)
    up = 2 * rng.integers(-3, 3, (2, 6 * with_up, 7 * with_up)).astype(np.int16)
    for y in range(len(shift)):
        pairs = LevelPair(a.words, b.words, f, mu), LevelPair(a.compact, b.compact)
        reference._list(*pairs, pack_map(*up), pack_map(*maps), y, shift[y], cost[y])
    cu, cv = unpacked(shift)

    def apart(word, other):
        return int(np.abs(bytes_of(word).astype(int) - bytes_of(other)).sum())

    for y, x in np.ndindex(left.shape):
        want = listed(maps, up, y, x, right.shape)
        there = cost[y, x] != NO_CANDIDATE
        assert list(zip(cu[y, x, there].tolist(), cv[y, x, there].tolist(), strict=True)) == want
        for k, (i, j) in enumerate(want):
            expected = reference.OUTSIDE
            if 0 <= x + i < right.shape[1] and 0 <= y + j < right.shape[0]:
                other = y + j, x + i
                expected = 4 * apart(a.words[y, x], b.words[other]) + 8 * apart(a.compact[y, x], b.compact[other])
            n = lines[y, x].astype(np.float64)
            expected += int(12 * mu * abs(n[0] * i + n[1] * j + n[2]))
            assert cost[y, x, k] == min(expected, 2 * reference.OUTSIDE)


def bytes_of(word):
    return np.array([word], np.uint64).view(np.uint8)


def test_paths_find_both_sides_of_a_step_from_a_poor_start():
    left, right, u, occluded = stairs()
    rng = np.random.default_rng(0)
    start = np.where(rng.random(u.shape) < 0.3, u, rng.integers(-15, 3, u.shape)).astype(np.int16)
    found, rows = start, np.zeros_like(start)
    for _ in range(3):
        found, rows = propagated(left, right, (found, rows))
    visible = ~occluded & seen(u, 0 * u, left.shape, 3)
    assert np.mean((found == u)[visible]) > 0.97
    assert np.mean((rows == 0)[visible]) > 0.97
    # Compact features reach a pixel, Table 1's six: the edge is found within two pixels of its place.
    near = np.abs(np.indices(u.shape)[1] - 79.5) < 6
    assert np.mean(np.abs(np.count_nonzero((found <= -8) & near, axis=1) - 6) <= 2) > 0.9


def test_the_true_map_of_equal_images_stays():
    image = Texture(5)(*np.indices((40, 50))[::-1].astype(float))
    nothing = np.zeros(image.shape, np.int16)
    u, v = propagated(image, image, (nothing, nothing))
    assert not u.any()
    assert not v.any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (3, 2)])
def test_paths_on_tiny_images(shape):
    image = np.random.default_rng(0).uniform(0, 255, shape).astype(np.float32)
    start = np.full(shape, 5, np.int16)  # leads out
    u, v = propagated(image, image, (start, start))
    assert u.shape == v.shape == shape


# -- relief ------------------------------------------------------------------------------------------------------------


def slanted(noise):
    displacement = lambda x, y: (-8.0 + 0.15 * x - 0.3 * y, 0.02 * x)  # noqa: E731
    return pair(displacement, (90, 120), (90, 160), noise=noise)


def fitted(left, right, start, keep):
    return refinement.fit_relief(SplineImages(left, coefficients(right), np.ones(right.shape, np.uint8)), *start, keep)


def test_relief_restores_a_slanted_plane():
    left, right, u, v = slanted(noise=2.0)
    keep = seen(u, v, right.shape, 8)
    rng = np.random.default_rng(0)
    start = [(a + rng.normal(0, 0.2, a.shape)).astype(np.float32) for a in (u, v)]
    found_u, found_v = fitted(left, right, start, keep)
    error = np.hypot(found_u - u, found_v - v)
    # A plane bends nowhere. One pixel tells sqrt(2) noise / gradient = .4 px (gradient about 7 a pixel in either
    # direction); stiffness averages some 7 x 7 pixels: .06 px.
    assert np.median(error[keep]) < 0.06
    assert np.median(error[keep]) < 0.3 * np.median(np.hypot(start[0] - u, start[1] - v)[keep])
    np.testing.assert_array_equal(found_u[~keep], start[0][~keep])


def test_matches_far_off_their_line_are_led_to_it():
    left, right, u, v = slanted(noise=1.0)
    keep = seen(u, v, right.shape, 8)
    astray = np.zeros(u.shape, bool)
    astray[30:40, 50:60] = astray[60:63, 80:83] = True
    assert keep[astray].all()
    start = u.astype(np.float32), np.where(astray, v + 2.0, v).astype(np.float32)
    found_u, found_v = fitted(left, right, start, keep)
    # As far off as the others, whose rows the lines fitted to all of them hold.
    assert np.abs(found_v - v)[astray].max() < 0.1
    assert np.hypot(found_u - u, found_v - v)[astray].max() < 1.0


def test_relief_keeps_a_step():
    left, right, u, occluded = stairs()
    keep = ~occluded & seen(u, 0 * u, left.shape, 4)
    start = (u.astype(np.float32), np.zeros(u.shape, np.float32))
    found, _ = fitted(left, right, start, keep)
    # Four times the bend beyond which stiffness gives way; a linear smoother would leave pixels here.
    assert np.abs(found - u)[keep].max() < 0.5
    assert np.median(np.abs(found - u)[keep]) < 0.02


def test_relief_of_nothing_is_nothing():
    left, right, u, v = slanted(noise=0.0)
    start = (u.astype(np.float32), v.astype(np.float32))
    none = np.zeros(u.shape, bool)
    found = fitted(left, right, start, none)
    np.testing.assert_array_equal(found[0], start[0])
    flat = np.full_like(left, 7.0), np.full_like(right, 7.0)
    found = fitted(*flat, start, ~none)
    assert np.isfinite(found[0]).all()
    assert np.abs(found[0] - start[0]).max() < 0.05


# -- matches by themselves ---------------------------------------------------------------------------------------------


def test_lonely_pixels_are_counted_within_the_image():
    keep = np.zeros((20, 20), bool)
    keep[:5, :5] = True  # the corner pixel sees 5 x 5 of the 81 and all of them are kept
    keep[12, 12] = True
    alone = lonely(keep, 0.5)
    assert alone[12, 12]
    assert not alone[0, 0]
    assert not lonely(keep, 0.0).any()


# -- the whole ---------------------------------------------------------------------------------------------------------


def test_preset_sets_its_values_and_gives_way_to_the_users():
    assert {k: getattr(ACC, k) for k in PRESETS["accurate"]} == dict(PRESETS["accurate"])
    assert HfvmParams(preset="accurate", rounds=5).rounds == 5
    with pytest.raises((RilleError, ValueError)):
        HfvmParams(preset="accurat")


def test_accurate_is_better_than_default_on_a_slanted_step_with_occlusion():
    def displacement(x, y):
        near = (x > 60) & (x < 110) & (y > 35) & (y < 100)
        return np.where(near, -18.0, -6.0 - 0.04 * y), 1.5 + 0.01 * x

    left, right, u, v = pair(displacement, noise=2.0)
    both = seen(u, v, right.shape, 8)
    bad, error = {}, {}
    for name in ("default", "accurate"):
        found = match(left, right, HfvmParams(preset=name))
        ok = matched(found.validity) & both
        miss = np.hypot(found.column_disparity - u, found.row_disparity - v)
        bad[name], error[name] = np.mean(miss[ok] > 2), np.median(miss[ok])
        assert ok.sum() / both.sum() > 0.85
    assert bad["accurate"] <= bad["default"]
    assert error["accurate"] < error["default"]


def test_unrelated_images_give_few_matches():
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (150, 200)).astype(np.uint8) for _ in range(2)]
    assert matched(match(*noise, ACC).validity).mean() < 0.01
    left, *_ = pair(lambda x, y: (0.0, 0.0), seed=1)
    _, right, *_ = pair(lambda x, y: (0.0, 0.0), seed=7)
    assert matched(match(left, right, ACC).validity).mean() < 0.05


def test_bits_of_the_mask_agree_with_the_values():
    left, right, *_ = pair(lambda x, y: (-8.0, 1.0), noise=3.0)
    valid = np.ones(left.shape, np.uint8)
    valid[20:40, 30:60] = 0
    found = match(left, right, ACC, valid=(valid, None))
    known = has(found.validity, Validity.MATCHED | Validity.INTERPOLATED)
    np.testing.assert_array_equal(np.isfinite(found.column_disparity), known)
    assert not (matched(found.validity) & has(found.validity, Validity.INTERPOLATED | Validity.SPECKLE)).any()
    assert not known[valid == 0].any()
    again = match(build_back(left), build_back(right), ACC, valid=(valid, None))
    np.testing.assert_array_equal(found.column_disparity, again.column_disparity)


def build_back(image):
    """The same grey values by way of the pyramid's level 0."""
    return build(image, PyramidParams()).images[0]
