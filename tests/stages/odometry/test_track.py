"""Tracks on synthetic sequences: shift, zoom, masks, re-seeding; the affinity of neighbours."""

import itertools

import cv2
import numpy as np
import pytest

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.geometry.scale import common_similarity
from rille.stages.imaging.pyramid import PyramidParams, build
from rille.stages.odometry import track as tracking
from rille.stages.odometry.displacements import Motion, fit_affinity, known_median
from rille.stages.odometry.track import (
    TrackParams,
    track,
    track_stage,
)

ROWS, COLS = 200, 260
PARAMS = TrackParams(points=80)


def texture(x, y):
    """Grey values at any position: waves of 5 to 60 pixels."""
    rng = np.random.default_rng(0)
    out = np.full(np.shape(x), 110.0)
    for _ in range(60):
        k = 2 * np.pi / rng.uniform(5.0, 60.0)
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        out = out + 7.0 * np.sin(k * (np.cos(angle) * x + np.sin(angle) * y) + phase)
    return out


def sequence(scales, shifts, noise=1.0, valid=None):
    """Pyramids of frames in which point p of the first lies at ``centre + scale (p - centre) + shift``."""
    x, y = np.meshgrid(np.arange(float(COLS)), np.arange(float(ROWS)))
    centre = np.array([COLS / 2, ROWS / 2])
    rng = np.random.default_rng(1)
    frames, places = [], []
    for scale, shift in zip(scales, shifts, strict=True):
        image = texture((x - centre[0] - shift[0]) / scale + centre[0], (y - centre[1] - shift[1]) / scale + centre[1])
        image = image + noise * rng.standard_normal(image.shape)
        frames.append(build(image.astype(np.float32), PyramidParams(levels=4), valid))
        places.append(lambda p, s=scale, d=shift: centre + s * (p - centre) + np.array(d))
    return frames, places


def on_level_2(column, row):
    return Motion(2, column.astype(np.float32), row.astype(np.float32), np.zeros(column.shape, np.uint8))


def motions(places, error=0.0):
    """Exact coarse motion on level 2, plus an error in pixels, between successive frames."""
    cols, rows = np.meshgrid((np.arange(COLS // 4) + 0.5) * 4 - 0.5, (np.arange(ROWS // 4) + 0.5) * 4 - 0.5)
    grid = np.stack([cols, rows], -1)
    centre = np.array([COLS / 2, ROWS / 2])
    out = []
    for here, there in itertools.pairwise(places):
        scale = here(centre + 1.0)[0] - here(centre)[0]  # undo "here" to reach the first frame
        first = centre + (grid - here(centre)) / scale
        d = (there(first) - grid + error).astype(np.float32)
        out.append(on_level_2(d[..., 0], d[..., 1]))
    return out


def errors(found, places):
    """Distance (n, frames) of each track to the truth, pixels; the truth starts at the tracked key position."""
    truth = np.stack([place(found.points[:, 0].astype(float)) for place in places], 1)
    return np.linalg.norm(found.points - truth, axis=-1)


@pytest.mark.parametrize("sigma", [1.0, 2.5, 4.0])
def test_points_are_found_in_a_blurred_frame(sigma):
    """At least four fifths of those of a sharp frame, where a blur of 2.5 px left none, to a quarter of a pixel."""
    frames, places = sequence([1.0, 1.0, 1.0], [(0, 0), (5.3, -2.6), (9.1, -6.2)])
    blurred = build(cv2.GaussianBlur(frames[1].images[0], (0, 0), sigma), PyramidParams(levels=4))
    found = track([frames[0], blurred, frames[2]], motions(places), PARAMS)
    sharp = track(frames, motions(places), PARAMS)
    both = [np.isfinite(t.points[:, 1, 0]) for t in (sharp, found)]
    assert np.count_nonzero(both[1]) > 0.8 * np.count_nonzero(both[0])
    assert np.median(errors(found, places)[both[1], 1]) < 0.25


def test_shifted_frames_are_tracked_to_a_fraction_of_a_pixel():
    frames, places = sequence([1.0, 1.0, 1.0], [(0, 0), (5.3, -2.6), (9.1, -6.2)])
    found = track(frames, motions(places, error=1.5), PARAMS)
    off = errors(found, places)
    seeds = found.birth == 0
    assert seeds.sum() == 80
    assert np.isfinite(off[seeds, 2]).mean() > 0.8  # what leaves the image is lost
    # Noise of 1 grey level (1.4 in the difference), gradient about 10 a pixel, 121 pixels: 0.013 px, times two for the
    # other unknowns; the worst of hundreds is at four sigma.
    assert np.nanmedian(off[:, 1:]) < 0.03
    assert np.nanmax(off[:, 1:]) < 0.15


def test_errors_do_not_accumulate_under_zoom():
    frames, places = sequence([1.0, 1.08, 1.17, 1.26, 1.36], [(0, 0), (1, 0.5), (2, 1), (3, 1.5), (4, 2)])
    found = track(frames, motions(places), PARAMS)
    off = errors(found, places)
    assert np.isfinite(off[:, 4]).sum() > 30  # the zoom alone leaves 54 % of the area in view
    assert np.nanmedian(off[:, 4]) < 2.0 * np.nanmedian(off[:, 1]) + 0.02
    assert np.nanmedian(off[:, 4]) < 0.06


def test_empty_buckets_get_points_that_are_known_in_the_key_frame(monkeypatch):
    frames, places = sequence([1.0, 1.15, 1.3], [(0, 0)] * 3)
    with_new = track(frames, motions(places), PARAMS)
    monkeypatch.setattr(tracking, "_reseed", lambda state, *given: state)
    without = track(frames, motions(places), PARAMS)
    assert (without.birth == 0).all()
    born = with_new.birth == 1
    assert born.sum() > 5
    assert np.isfinite(with_new.points[born, 0]).all()
    assert (with_new.points[born, 1] == np.rint(with_new.points[born, 1])).all()  # seeds lie on pixels
    assert np.nanmedian(errors(with_new, places)[born]) < 0.06
    assert np.isfinite(with_new.points[:, 2, 0]).sum() > np.isfinite(without.points[:, 2, 0]).sum()


def test_masked_regions_hold_no_point_in_any_frame():
    valid = np.ones((ROWS, COLS), np.uint8)
    valid[:, :90] = 0
    frames, places = sequence([1.0, 1.0], [(0, 0), (-4.0, 0.0)], valid=valid)
    found = track(frames, motions(places), PARAMS.model_copy(update={"points": 600}))
    known = found.points[np.isfinite(found.points).all(-1)]
    assert len(known) > 60
    assert (found.points[:, 0, 0] < 99).any()  # some would move to where their template touches the mask
    assert known[:, 0].min() >= 94.5


def test_holes_in_the_motion_are_bridged_or_lose_the_point():
    frames, places = sequence([1.0, 1.0], [(0, 0), (6.0, 3.0)])
    motion = motions(places)[0]
    motion.column_disparity[::2], motion.row_disparity[::2] = np.nan, np.nan
    motion.column_disparity[:, 40:] = np.nan
    found = track(frames, [motion], PARAMS)
    tracked = np.isfinite(found.points[:, 1]).all(-1)
    assert tracked[(found.points[:, 0, 0] < 155)].mean() > 0.8
    assert not tracked[found.points[:, 0, 0] > 175].any()


def test_untextured_frames_give_no_track_and_no_error():
    flat = build(np.full((ROWS, COLS), 90.0, np.float32), PyramidParams(levels=3))
    still = on_level_2(np.zeros((50, 65)), np.zeros((50, 65)))
    found = track([flat, flat], [still], PARAMS)
    assert found.points.shape == (0, 2, 2)


def test_frames_of_little_contrast_and_noise_are_tracked():
    frames, places = sequence([1.0, 1.0], [(0.0, 0.0), (6.0, -4.0)], noise=2.0)
    faint = [build(100.0 + 0.15 * frame.images[0], PyramidParams(levels=4)) for frame in frames]
    found = track(faint, motions(places), PARAMS).points
    error = found[:, 1] - places[1](found[:, 0])
    assert np.isfinite(error[:, 0]).sum() >= 40
    assert np.nanmedian(np.abs(error)) < 0.1


def test_displacement_is_looked_up_at_the_pixel_centre_of_the_coarse_level():
    column = np.full((5, 5), 7.0, np.float32)
    column[2, 2] = np.nan
    motion = on_level_2(column, np.arange(25).reshape(5, 5))
    # Coarse pixel 2 reaches from 7.5 to 11.5.
    at = np.array([[7.6, 7.6], [1.5, 1.5], [np.nan, 3.0]])
    found = motion.at(at)
    np.testing.assert_array_equal(found[0], [7.0, 12.0])  # median of the eight neighbours of row value 12
    assert found[1, 0] == 7.0
    assert np.isnan(found[2]).all()


def test_affinity_of_neighbours_resists_an_outlier_and_few_points():
    rng = np.random.default_rng(3)
    p = rng.uniform(0, 200, (60, 2))
    A = np.array([[1.1, 0.05], [-0.08, 0.95]])
    q = p @ A.T + [3.0, -2.0]
    q[::10] += 15.0
    affinity, shift = fit_affinity(p, q, np.ones(60, bool), p)
    inner = (np.abs(p - 100) < 60).all(1)
    # The pull towards no change is 25 square pixels against spacings of about 25 pixels: a few per cent of A - I.
    assert np.abs(affinity - A)[inner].max() < 0.03
    assert np.median(np.abs(shift - (p @ A.T + [3.0, -2.0] - p))) < 0.2
    few, none = fit_affinity(p[:5], q[:5], np.ones(5, bool), p)
    np.testing.assert_array_equal(few, np.tile(np.eye(2), (60, 1, 1)))
    assert not none.any()


def test_stage_writes_what_it_declares_and_the_same_bits_twice():
    frames, places = sequence([1.0, 1.05, 1.1], [(0, 0), (2, 0), (4, 0)])
    inputs = {
        "pyramids": [
            Bundle(
                {f"level_{i}": a for i, a in enumerate(f.images)} | {f"valid_{i}": v for i, v in enumerate(f.valid)},
                {"levels": f.levels},
            )
            for f in frames
        ],
        "motions": [
            Bundle({name: values for name, values in vars(m).items() if name != "level"}, {"level": 2})
            for m in motions(places)
        ],
    }
    first, second = (track_stage.run(PARAMS, {"frames": [4, 5, 6]}, inputs) for _ in range(2))
    check_outputs(track_stage, first)
    assert first.meta["frames"] == [4, 5, 6]
    for name, array in first.arrays.items():
        np.testing.assert_array_equal(array, second[name])


def in_plane(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def turning(angles):
    """Pyramids of a texture that turns about the image's middle, and where points of the first frame go."""
    x, y = np.meshgrid(np.arange(float(COLS)), np.arange(float(ROWS)))
    centre = np.array([COLS / 2, ROWS / 2])
    rng = np.random.default_rng(2)
    frames, places = [], []
    for angle in angles:
        c, s = np.cos(angle), np.sin(angle)
        dx, dy = x - centre[0], y - centre[1]
        image = texture(c * dx + s * dy + centre[0], -s * dx + c * dy + centre[1]) + rng.standard_normal(x.shape)
        frames.append(build(image.astype(np.float32), PyramidParams(levels=4)))
        places.append(lambda p, a=angle: (p - centre) @ in_plane(a).T + centre)
    return frames, places


def test_a_turn_that_goes_on_does_not_lose_the_points():
    """25 degrees a frame, 100 in all; motions as an attitude and a search give them, off by a pixel."""
    angles = np.radians([0.0, 25.0, 50.0, 75.0, 100.0])
    frames, places = turning(angles)
    cols, rows = np.meshgrid((np.arange(COLS // 4) + 0.5) * 4 - 0.5, (np.arange(ROWS // 4) + 0.5) * 4 - 0.5)
    grid = np.stack([cols, rows], -1).reshape(-1, 2)
    steps = []
    for a, b in itertools.pairwise(angles):
        middle = np.array([COLS / 2, ROWS / 2])
        d = ((grid - middle) @ in_plane(b - a).T + middle - grid + 1.0).reshape(*cols.shape, 2)
        steps.append(on_level_2(d[..., 0], d[..., 1]))
    found = track(frames, steps, PARAMS)
    off = errors(found, places)
    first = found.birth == 0
    true = np.stack([place(found.points[:, 0].astype(float)) for place in places], 1)
    inside = ((true > 20) & (true < [COLS - 20, ROWS - 20])).all((1, 2))  # in view all the time
    assert (first & inside).sum() > 20
    assert np.isfinite(off[first & inside, 4]).mean() > 0.85
    assert np.nanmedian(off[:, 4]) < 0.06


@pytest.mark.parametrize("scale", [1.0, 1.4, 0.6])
def test_affinity_of_a_large_turn_and_zoom_is_not_pulled_towards_none(scale):
    rng = np.random.default_rng(5)
    p = rng.uniform(0, 200, (60, 2))
    A = scale * in_plane(1.2)
    q = p @ A.T + [8.0, -5.0]
    affinity, shift = fit_affinity(p, q, np.ones(60, bool), p)
    np.testing.assert_allclose(affinity, np.tile(A, (60, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(shift, q - p, atol=1e-4)
    q[::6] += 40.0  # on another surface
    assert np.abs(common_similarity(p, q) - A).max() < 0.15
    affinity, _ = fit_affinity(p, q, np.ones(60, bool), p)
    assert np.median(np.abs(affinity - A)) < 0.02


def test_pairs_in_one_place_share_no_change():
    np.testing.assert_array_equal(common_similarity(np.ones((9, 2)), np.ones((9, 2))), np.eye(2))


def test_affinity_of_the_nearest_by_arrays():
    """The same estimate, point by point, from the formulas as they are written."""
    rng = np.random.default_rng(21)
    p = rng.uniform(0, 400, (50, 2))
    q = p @ np.array([[1.02, -0.1], [0.1, 1.02]]).T + 5.0 + rng.normal(0, 0.3, p.shape)
    q[:5] += 20.0
    at = rng.uniform(0, 400, (7, 2))
    common = common_similarity(p, q)
    affinity, shift = fit_affinity(p, q, np.ones(50, bool), at)
    for k in range(7):
        near = np.argsort(((p - at[k]) ** 2).sum(1), kind="stable")[:12]
        offset = p[near] - at[k]
        rest = (q - p)[near] - offset @ (common - np.eye(2)).T
        basis, weight = np.column_stack([offset, np.ones(12)]), np.ones(12)
        for _ in range(4):
            pull = np.diag([25.0 * weight.sum(), 25.0 * weight.sum(), 0.0])
            x = np.linalg.solve(basis.T @ (basis * weight[:, None]) + pull, basis.T @ (rest * weight[:, None]))
            weight = 1.0 / (1.0 + ((rest - basis @ x) ** 2).sum(1))
        np.testing.assert_allclose(affinity[k], common + x[:2].T, atol=1e-10)
        np.testing.assert_allclose(shift[k], x[2], atol=1e-8)


def test_median_of_what_is_known_is_numpys():
    rng = np.random.default_rng(8)
    values = rng.normal(size=(60, 9))
    values[rng.random(values.shape) < 0.4] = np.nan
    values[3] = np.nan
    values[4] = 1.5
    known = np.isfinite(values).sum(axis=1)
    found = known_median(values, known)
    assert np.isnan(found[3])
    rest = known > 0
    np.testing.assert_array_equal(found[rest], np.nanmedian(values[rest], axis=1))


def test_points_are_found_in_frames_of_other_exposure():
    frames, places = sequence([1.0, 1.0, 1.0, 1.0], [(0, 0), (5.3, -2.6), (9.1, -6.2), (13.0, -9.0)])
    bright = [1.0, 1.4, 0.6, 1.05]
    other = [
        build(np.clip(frame.images[0] * np.float32(factor), 0, 255), PyramidParams(levels=4))
        for frame, factor in zip(frames, bright, strict=True)
    ]
    same, found = (track(f, motions(places, error=1.5), PARAMS) for f in (frames, other))
    known = [np.isfinite(t.points[..., 0]).sum(axis=0) for t in (same, found)]
    assert (known[1][1:] > 0.9 * known[0][1:]).all()
    assert np.nanmedian(errors(found, places)[:, 1:]) < 0.03
