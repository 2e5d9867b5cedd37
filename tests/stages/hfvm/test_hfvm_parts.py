"""Consistency, epipolar band, plane, refinement and look-up table of the matcher, each alone."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matching_scenes import convergent_rig, pair, rig_displacement
from scipy import ndimage

from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Rig
from rille.stages.geometry.spline import coefficients
from rille.stages.hfvm import epipolar, level, paper, plane, refinement
from rille.stages.hfvm.finest import FAILED_PX, Ending, Fine, FinestWork, backmatch, complete, isolated, speckles
from rille.stages.hfvm.image import Window, as_matched
from rille.stages.hfvm.image import planes as table_1
from rille.stages.hfvm.level import Map, PyramidPair, Recipe, agree
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.plane import Sample
from rille.stages.imaging.pyramid import PyramidParams, build


def zeros(*shape):
    return np.zeros(shape, np.float32)


def learn(offsets):
    """Table of 17 even offsets at found offsets -0.5 ... 0.5, out of a sample of found offsets.

    The histogram is made symmetric: the sign of an offset is a matter of which image is the left one.
    """
    clipped = np.clip(np.asarray(offsets, dtype=np.float64).ravel(), -0.5, 0.5)
    counts, _ = np.histogram(clipped, bins=16, range=(-0.5, 0.5))
    counts = counts + counts[::-1]
    if counts.sum() == 0:
        return tuple(i / 16 - 0.5 for i in range(16 + 1))
    share = np.cumsum(counts) / counts.sum()
    return (-0.5, *(round(float(s) - 0.5, 4) for s in share))


class TestConsistency:
    def backmatch(self, lu, lv, ru, rv, valid=None):
        error = np.full(lu.shape, FAILED_PX, np.float32)
        valid = np.ones(ru.shape, np.uint8) if valid is None else valid
        backmatch(lu, lv, (ru, rv), valid, error)
        return error

    def test_by_hand(self):
        lu, lv, ru, rv = zeros(1, 4), zeros(1, 4), zeros(1, 4), zeros(1, 4)
        lu[0] = [1, 1, 0.5, 1]
        ru[0] = [0, -1, -3, -1]
        error = self.backmatch(lu, lv, ru, rv)
        # 0 -> 1 -> 0; 1 -> 2 -> -1: two off; 2.5: nearest is 3 (half rounds up), -1 + 0.5; 3 leaves
        np.testing.assert_allclose(error[0, :3], [0, 2, 0.5])
        assert error[0, 3] == FAILED_PX

    def test_rows_count_and_masked_targets_fail(self):
        lu, lv = zeros(2, 2), zeros(2, 2)
        lv[0] = 1
        error = self.backmatch(lu, lv, zeros(2, 2), zeros(2, 2), np.array([[1, 1], [1, 0]], np.uint8))
        np.testing.assert_array_equal(error, [[1, FAILED_PX], [0, FAILED_PX]])

    @settings(max_examples=30, deadline=None)
    @given(st.integers(0, 10**6))
    def test_small_patches_against_scipy(self, seed):
        """Displacements are of two sorts, so that patches hang together where they agree."""
        rng = np.random.default_rng(seed)
        shape = rng.integers(6, 14, 2)
        u, keep = 5 * rng.integers(0, 2, shape).astype(np.int16), rng.random(shape) < 0.7
        sizes = np.zeros(shape, int)
        for value in (0, 5):
            label, _ = ndimage.label(keep & (u == value))
            sizes += np.where(label > 0, np.bincount(label.ravel())[label], 0)
        wanted = min(16 * 3, keep.size // 8)
        rare = np.count_nonzero(sizes >= wanted) < 0.5 * np.count_nonzero(sizes >= 3)
        expected = keep & (sizes < (wanted if rare else 3))
        np.testing.assert_array_equal(isolated(u, keep, 3), expected)

    def test_agreement_is_within_the_limit_and_on_usable_pixels(self):
        own = Map(np.array([[1, 1, 1, 1]], np.int16), np.zeros((1, 4), np.int16))
        other = Map(np.array([[0, -1, -3, -2]], np.int16), np.zeros((1, 4), np.int16))
        usable = np.array([[1, 1, 1, 1]], np.uint8)
        np.testing.assert_array_equal(agree(own, other, usable, usable, 1.0), [[True, False, True, False]])
        np.testing.assert_array_equal(agree(own, other, usable, 1 - usable, 1.0), np.zeros((1, 4), bool))

    @pytest.mark.parametrize(("near_sign", "expected"), [(-1.0, -2), (1.0, -20)])
    def test_an_occlusion_gets_its_background(self, near_sign, expected):
        u, v, filled = np.array([[-2, 9, 9, -20]], np.float32), zeros(1, 4), np.zeros((1, 4), np.uint8)
        level.fill_rows(u, v, np.array([[True, False, False, True]]), 10, near_sign, filled)
        np.testing.assert_array_equal(u[0, 1:3], expected)
        np.testing.assert_array_equal(filled, [[0, 1, 1, 0]])

    def test_a_failed_match_gets_the_line_and_no_value_travels_far(self):
        u, v, filled = zeros(1, 12), zeros(1, 12), np.zeros((1, 12), np.uint8)
        keep = np.zeros((1, 12), bool)
        keep[0, [2, 5]] = True
        u[0, 2], u[0, 5] = 1.0, 2.5
        level.fill_rows(u, v, keep, 3, -1.0, filled)
        np.testing.assert_allclose(u[0, :9], [1, 1, 1, 1.5, 2, 2.5, 2.5, 2.5, 2.5])
        np.testing.assert_array_equal(filled[0], [1, 1, 0, 1, 1, 0, 1, 1, 1, 0, 0, 0])


def rig_matches(rig, seed=0, n=800, outliers=0.2):
    """Displacement maps of random depths with outliers, and the true ones."""
    rng = np.random.default_rng(seed)
    shape = (rig.left.height, rig.left.width)
    y, x = np.indices(shape, dtype=float)
    u, v = rig_displacement(rig, lambda x, y: rng.uniform(0.4, 1.5, shape))(x, y)
    wanted = np.zeros(shape, bool)
    wanted.flat[rng.choice(wanted.size, n, replace=False)] = True
    wild = wanted & (rng.uniform(size=shape) < outliers)
    return np.where(wild, rng.uniform(-40, 40, shape), u), np.where(wild, rng.uniform(-40, 40, shape), v), wanted, u, v


def turned(rig):
    """The rig with both cameras rolled by a right angle: its baseline lies along the columns."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    t = rig.T_right_left
    return Rig(rig.left, rig.right, type(t)(turn @ t.rotation @ turn.T, turn @ t.translation))


def fit(u, v, wanted):
    """Matrix and spread of the wanted pixels of a map."""
    y, x = np.nonzero(wanted)
    return epipolar.fit_points(x, y, u[y, x], v[y, x], wanted.shape, wanted.shape)


class TestEpipolar:
    @pytest.mark.parametrize("change", [lambda r: r, turned], ids=["along rows", "along columns"])
    def test_lines_of_a_convergent_rig_despite_outliers(self, change):
        u, v, wanted, true_u, true_v = rig_matches(change(convergent_rig()))
        f, spread = fit(u, v, wanted)
        line = epipolar.lines(f, wanted.shape)
        off = np.abs(line[..., 0] * true_u + line[..., 1] * true_v + line[..., 2])
        # The weak prior pulls exact matches off by a small part of the half pixel that a match is good for.
        assert np.percentile(off, 95) < 0.1
        assert spread < 0.1

    def test_too_few_matches_give_no_band(self):
        wanted = np.zeros((50, 60), bool)
        wanted[0, :30] = True
        assert fit(zeros(50, 60), zeros(50, 60), wanted) is None

    def test_finer_level_keeps_the_constraint(self):
        u, v, wanted, *_ = rig_matches(convergent_rig(), outliers=0.0)
        f, _ = fit(u, v, wanted)
        y, x = np.nonzero(wanted)
        fine = 2 * np.stack([x + 0.5, y + 0.5]) - 0.5
        fine_right = 2 * np.stack([x + u[wanted] + 0.5, y + v[wanted] + 0.5]) - 0.5
        one = np.ones((1, len(x)))
        a = np.einsum("in,ij,jn->n", np.vstack([x + u[wanted], y + v[wanted], one[0]]), f, np.vstack([x, y, one[0]]))
        b = np.einsum("in,ij,jn->n", np.vstack([fine_right, one]), epipolar.finer(f), np.vstack([fine, one]))
        np.testing.assert_allclose(a, b, atol=1e-9)

    def test_near_things_lie_left_in_the_right_image_also_with_toe_in(self):
        rig = convergent_rig()
        u, v, wanted, *_ = rig_matches(rig, outliers=0.0)
        assert np.median(u[wanted]) > 0  # beyond the crossing of the axes: the sign of u alone would mislead
        f, _ = fit(u, v, wanted)
        assert epipolar.near_sign(f, u[wanted], wanted.shape, wanted.shape) == -1.0
        swapped = Rig(rig.right, rig.left, rig.T_right_left.inverse())
        u, v, wanted, *_ = rig_matches(swapped, outliers=0.0)
        f, _ = fit(u, v, wanted)
        assert epipolar.near_sign(f, u[wanted], wanted.shape, wanted.shape) == 1.0


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_where_lines_run_along_the_columns_gaps_are_filled_as_along_the_rows(sign):
    """Maps whose rows and columns are exchanged: the same of everything, exchanged."""
    rng = np.random.default_rng(6)
    shape, f = (40, 60), np.array([[0.0, 0.0, 0.1], [0.0, 0.0, -1.0], [0.05, 1.02, 0.3]])
    near, validity = rng.random(shape) < 0.3, np.where(rng.random(shape) < 0.4, Validity.BACKMATCH_FAILED, 0)
    u = np.where(near, sign * 9.0, 0.0).astype(np.float32)
    maps = {"u": u, "v": zeros(*shape), "error": zeros(*shape), "distance": zeros(*shape), "noise": zeros(*shape)}
    maps["likeness"] = zeros(*shape)
    maps["validity"] = validity.astype(np.uint8)
    params, outer = HfvmParams(min_support=0.0), Window(0, shape[0], 0, shape[1])
    rows = complete(maps, np.ones(shape, np.uint8), outer, params, Ending(shape, sign, f=f))
    turned = {name: np.ascontiguousarray(a.T) for name, a in maps.items()} | {"u": maps["v"].T, "v": maps["u"].T}
    window, ending = Window(0, shape[1], 0, shape[0]), Ending(shape[::-1], sign, f=epipolar.transposed(f), upright=True)
    cols = complete(turned, np.ones(shape[::-1], np.uint8), window, params, ending)
    assert (rows["validity"] & Validity.INTERPOLATED).any()
    for name, other in {"column_disparity": "row_disparity", "row_disparity": "column_disparity"}.items():
        np.testing.assert_array_equal(cols[name].T, rows[other])
    np.testing.assert_array_equal(cols["validity"].T, rows["validity"])


class TestPlane:
    H = np.array([[0.93, -0.55, 40.0], [-0.01, 1.03, -3.0], [-2e-4, 5e-5, 1.0]])

    def displacement(self, x, y):
        q = np.einsum("ij,j...->i...", self.H, np.stack([x, y, np.ones_like(x)]))
        return q[0] / q[2] - x, q[1] / q[2] - y

    def test_finds_the_plane_of_the_majority(self):
        y, x = np.indices((60, 80), dtype=float)
        u, v = self.displacement(x, y)
        rng = np.random.default_rng(0)
        wild = rng.uniform(size=u.shape) < 0.3
        u, v = np.where(wild, u - rng.uniform(5, 20, u.shape), u), v + rng.normal(0, 0.1, v.shape)
        h, share = plane.fit_points(Sample(*(a.ravel() for a in (x, y, u, v))), u.shape)
        corners = np.array([[0, 79, 0, 79], [0, 0, 59, 59], [1, 1, 1, 1]])
        a, b = h @ corners, self.H @ corners
        # Noise 0.1 px over 3000 matches: hundredths; the robust weights leave a little of the outliers.
        np.testing.assert_allclose(a[:2] / a[2], b[:2] / b[2], atol=0.3)
        assert share == pytest.approx(0.7, abs=0.02)

    def test_level_change_keeps_the_mapping(self):
        h = plane.to_level_0(self.H, 2)
        x = np.array([10.0, 20.0])
        coarse = self.H @ [*((x + 0.5) / 4 - 0.5), 1]
        fine = h @ [*x, 1]
        np.testing.assert_allclose((fine[:2] / fine[2] + 0.5) / 4 - 0.5, coarse[:2] / coarse[2])

    def test_aligned_image_is_the_left_one_and_displacements_compose_back(self):
        left, right, u, v = pair(self.displacement, (100, 120), (120, 170))
        images = [as_matched(build(image, PyramidParams()), HfvmParams()) for image in (left, right)]
        aligned, m = plane.aligned(images[1], self.H, images[0]), plane.margin(left.shape)
        inner, seen = (a[m:-m, m:-m] for a in (aligned.layers[0].grey, aligned.layers[0].valid == 1))
        assert seen.mean() > 0.5
        # Cubic interpolation of wavelengths from 5 px, grey range 200: about a percent of it.
        assert np.abs(inner - left)[seen].mean() < 2.0
        still = np.full(u.shape, m, np.float32)
        h = plane.to_original(self.H, left.shape)
        back_u, back_v = plane.carried(h, still, still)
        np.testing.assert_allclose(back_u, u, atol=1e-3)
        np.testing.assert_allclose(back_v, v, atol=1e-3)
        for found in plane.carried(np.linalg.inv(h), back_u, back_v):
            np.testing.assert_allclose(found, m, atol=1e-3)

    def test_a_window_of_the_aligned_image_is_a_part_of_it(self):
        left, right, *_ = pair(self.displacement, (100, 120), (120, 170))
        mask = np.ones(right.shape, np.uint8)
        mask[40:60, 60:90] = 0
        images = (
            as_matched(build(left, PyramidParams()), HfvmParams()),
            as_matched(build(right, PyramidParams(), mask), HfvmParams()),
        )
        for layer in plane.aligned(images[1], self.H, images[0]).layers:
            window = Window(4, layer.shape[0] - 1, 6, layer.shape[1])
            np.testing.assert_allclose(layer.cut(window).grey, layer.grey[window.slices], atol=1e-3)
            np.testing.assert_array_equal(layer.cut(window).valid, layer.valid[window.slices])

    def test_distortion_is_the_shear(self):
        assert plane.distortion(np.eye(3), (50, 60)) == 0
        assert plane.distortion(np.array([[1, -0.5, 3], [0, 1, 0], [0, 0, 1.0]]), (50, 60)) == pytest.approx(0.5)


def refined(left, right, start, keep, steps=1):
    """Result of Lucas-Kanade steps towards all of a right image, usable everywhere."""
    images = refinement.SplineImages(left, coefficients(right), np.ones(right.shape, np.uint8))
    return refinement.refine(images, lambda u, v: (u, v), start, keep, steps)


def variance(image):
    mean = lambda z: ndimage.uniform_filter(z, 5)  # noqa: E731
    return (mean(image * image) - mean(image) ** 2).astype(np.float32)


def correlation(left, right, noise=(0.0, 0.0)):
    """What the refinement says of images of one size that lie upon each other, but for their borders."""
    keep, deviations = np.ones(left.shape, bool), (np.sqrt(variance(left)), np.sqrt(variance(right)))
    return refinement.surroundings(variance(left - right), deviations, keep, noise)[0][8:-8, 8:-8]


class TestRefine:
    def test_recovers_sub_pixel_displacements_to_the_noise_limit(self):
        noise, window = 1.0, 5
        left, right, u, v = pair(lambda x, y: (-6.0 + 0.05 * y, 1.3 + 0.02 * x), noise=noise)
        start_u, start_v = (u + 0.3).astype(np.float32), (v - 0.3).astype(np.float32)
        keep = np.ones(u.shape, bool)
        found_u, found_v, rest, *_ = refined(left, right, (start_u, start_v), keep, 2)
        inner = np.s_[12:-12, 12:-12]
        gradient = np.sqrt(np.mean(np.gradient(right)[1] ** 2))
        # Least squares over the window: sqrt(2) noise / (gradient * window); the median of |error| is .67 of it, and
        # weakly textured windows cost a factor below two.
        limit = 2 * 0.67 * np.sqrt(2) * noise / (gradient * window)
        assert np.median(np.abs(found_u - u)[inner]) < limit
        assert np.median(np.abs(found_v - v)[inner]) < limit
        assert np.median(rest[inner]) == pytest.approx(2 * noise**2, rel=0.3)

    def test_keeps_what_it_cannot_improve(self):
        left, right, *_ = pair(lambda x, y: (-6.0, 0.0))
        wrong = np.full(left.shape, 20.0, np.float32)
        found_u, *_ = refined(left, right, (wrong, wrong), np.zeros(left.shape, bool))
        np.testing.assert_array_equal(found_u, wrong)

    def test_correlation_tells_noise_from_texture(self):
        rng = np.random.default_rng(0)
        signal, a, b = rng.normal(0, 10, (3, 60, 60))
        cases = {
            "alike": (signal + 0.1 * a, signal + 0.1 * b),
            "of other contrast": (signal + 0.1 * a, 2.5 * signal + 0.1 * b),
            "faint noise": (a, 0.4 * b),
            "noise": (a, b),
        }
        found = {name: correlation(*images) for name, images in cases.items()}
        assert found["alike"].min() > 0.9
        assert found["of other contrast"].min() > 0.9
        # 81 overlapping windows of 25 noise values each: the deviation of a correlation is about a tenth.
        assert np.abs(found["faint noise"]).max() < 0.5
        assert np.abs(found["noise"]).max() < 0.5

    def test_residuals_are_those_around(self):
        a, b = np.random.default_rng(0).normal(0, 10, (2, 60, 60))
        keep, deviations = np.ones((60, 60), bool), (np.sqrt(variance(a)), np.sqrt(variance(b)))
        _, around = refinement.surroundings(variance(a - b), deviations, keep, (0.0, 0.0))
        assert around[30, 30] == pytest.approx(variance(a - b)[26:35, 26:35].mean(), rel=1e-4)

    def test_correlation_leaves_out_the_noise_that_it_is_told(self):
        rng = np.random.default_rng(1)
        signal, other, noise = rng.normal(0, 1, (3, 60, 60))
        # The right image's noise is as strong as what both show, or stronger by half.
        for right, told, low, high in (
            (signal + noise, 0.0, 0.6, 0.8),
            (signal + noise, 1.0, 0.8, 1.1),
            (other, 0.0, -0.3, 0.3),
            (other + 1.5 * noise, 1.5**2, -0.5, 0.5),
        ):
            assert low < correlation(signal, right, (0.0, told)).mean() < high
        # Noise of the left image is in its deviation, too.
        assert abs(correlation(signal + noise, signal, (1.0, 0.0)).mean() - 1) < 0.2


def test_local_mean_takes_only_like_neighbours():
    u, v = zeros(5, 5), zeros(5, 5)
    u[:, 3:] = 10
    u[2, 2] = 0.9
    keep = np.ones((5, 5), bool)
    keep[0, 0] = False
    out_u, _ = refinement.local_mean(u, v, keep, 1, 1)
    assert out_u[2, 2] == pytest.approx(0.9 / 6)
    assert out_u[2, 3] == 10
    assert out_u[0, 0] == 0


class TestLookup:
    def test_learnt_table_makes_its_sample_uniform(self):
        rng = np.random.default_rng(0)
        true = rng.uniform(-0.5, 0.5, 20000)
        found = true - 0.1 * np.sin(2 * np.pi * true)
        even = paper.equalized(found, learn(found))
        counts, _ = np.histogram(even, 10, (-0.5, 0.5))
        assert np.ptp(np.histogram(found, 10, (-0.5, 0.5))[0]) > 1000
        # 2000 a bin, five standard deviations, and linear interpolation inside sixteenths.
        np.testing.assert_allclose(counts, 2000, atol=5 * np.sqrt(2000) + 100)

    def test_table_maps_the_interval_onto_itself_oddly(self):
        x = np.linspace(-0.5, 0.5, 101)
        y = paper.equalized(x)
        assert (y[0], y[50], y[-1]) == (-0.5, 0.0, 0.5)
        assert (np.diff(y) > 0).all()
        np.testing.assert_allclose(y, -y[::-1], atol=1e-7)

    def test_no_sample_no_change(self):
        np.testing.assert_allclose(paper.equalized([0.3], learn([])), [0.3], atol=1e-6)

    def test_default_table_is_what_textured_noise_teaches(self):
        p = HfvmParams(preset="paper", top_columns=0.05, top_rows=0.05)
        rng = np.random.default_rng(5)
        frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(512), np.fft.fftfreq(256)))
        frequency[0, 0] = 1
        spectrum = np.fft.fft2(rng.normal(size=(256, 512))) / frequency**1.3
        y, x = np.indices((256, 512), dtype=float)
        grey = np.fft.ifft2(spectrum).real
        grey = (grey - grey.mean()) / grey.std() * 40 + 128
        moved = ndimage.map_coordinates(grey, [y, x - 2.5 - (x - 256) * 0.012 - (y - 128) * 0.004], mode="nearest")
        images = [(a + rng.normal(0, 1, a.shape)).clip(0, 255)[16:-16, 32:-32] for a in (grey, moved)]
        planes = [table_1(image.astype(np.float32)) for image in images]
        vectors = [paper.weighted(plane, p.weights) for plane in planes]
        ways = (paper._one_way(*way, None, p) for way in (vectors, vectors[::-1]))
        maps = [Map(cv2.medianBlur(way.u, 3), cv2.medianBlur(way.v, 3)) for way in ways]
        usable = np.ones(images[0].shape, np.uint8)
        ok = agree(*maps, usable, usable, p.backmatch)
        table = learn(paper.search(*vectors, maps[0], (0, 0)).offset[..., 0][ok])
        # One of six images of the lesson: a few hundredths.
        np.testing.assert_allclose(table, paper.DEFAULT_TABLE, atol=0.03)


def test_values_and_gradients_are_those_of_scipys_spline():
    image = np.random.default_rng(8).uniform(0, 255, (9, 10)).astype(np.float32)
    x, y = np.random.default_rng(9).uniform(2, 6, (2, 1, 50)).astype(np.float32)
    nothing = np.zeros((1, 50), np.float32)
    images = refinement.SplineImages(nothing, coefficients(image), np.ones(image.shape, np.uint8))
    count, gx, gy, rest = refinement._warped(images, x - np.arange(50, dtype=np.float32), y, nothing == 0)

    def value(dx, dy):
        at = [np.float64(y) + dy, np.float64(x) + dx]
        return ndimage.map_coordinates(image, at, np.float64, order=3, mode="mirror")

    assert count.all()
    np.testing.assert_allclose(-rest, value(0, 0), atol=5e-3)
    np.testing.assert_allclose(gx, (value(1e-4, 0) - value(-1e-4, 0)) / 2e-4, atol=2e-2)
    np.testing.assert_allclose(gy, (value(0, 1e-4) - value(0, -1e-4)) / 2e-4, atol=2e-2)


@pytest.mark.parametrize("upright", [True, False])
def test_patches_differ_in_what_shows_depth(upright):
    odd, even = np.zeros((60, 80), np.int16), np.zeros((60, 80), np.int16)
    odd[20:24, 30:36] = 9
    nothing = np.zeros(odd.shape, np.float32)
    fine = Fine(nothing, nothing, np.zeros(odd.shape, np.uint8), nothing, nothing, nothing, nothing)
    image = as_matched(build(np.full(odd.shape, 90, np.uint8), PyramidParams()), HfvmParams())
    images, layer = PyramidPair(image, image, HfvmParams(), Recipe((), (), (0, 0))), image.layers[0]
    there = Map(even, odd) if upright else Map(odd, even)
    found = speckles(FinestWork(layer, layer, layer, there, there, images, upright=upright), fine)
    np.testing.assert_array_equal(found.validity != 0, odd != 0)
