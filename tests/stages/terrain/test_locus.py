from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest
from raising import raises
from terrain_scenes import (
    Distance,
    ball,
    box,
    disparity,
    interpolation_error,
    nearest,
    pitched,
    plane,
    smooth_noise,
    toed_in_rig,
)

from rille.stages.core.declare import Bundle, check_outputs
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain import ground_frame as level_stage
from rille.stages.terrain.ground import view_ground
from rille.stages.terrain.locus import kernel, stage
from rille.stages.terrain.locus import solve as locus_solve
from rille.stages.terrain.locus.kernel import Dem
from rille.stages.terrain.locus.stage import LocusParams, MatchedPair, reconstruct
from rille.stages.terrain.matches import Matches

RIG = toed_in_rig()
T_LOCAL_LEFT = pitched(30.0, roll_deg=3.0)
HEIGHT = 0.6
LATTICE = Lattice.snap((-0.3, 0.3, 0.5, 1.3), 0.01)
PARAMS = LocusParams()
IMAGE = np.add.outer(np.arange(RIG.left.height), 2.0 * np.arange(RIG.left.width)).astype(np.float32)


def pair(*maps: np.ndarray) -> MatchedPair:
    """Column and row disparity and where they may be used, of a picture that is not looked at."""
    return MatchedPair(IMAGE, Matches(*maps))


def solve(maps: tuple[np.ndarray, np.ndarray, np.ndarray], z: tuple[float, float], rig: Rig = RIG) -> Dem:
    column, row, usable = maps
    return reconstruct(pair(column, row, usable), rig, T_LOCAL_LEFT, LATTICE, z, PARAMS)


def tolerance(maps: tuple[np.ndarray, np.ndarray, np.ndarray], points: np.ndarray) -> np.ndarray:
    """Error of elevation, m, of the bilinear disparity: 3 Z^2 / (f B) of it, and of the solver's own 1e-3 px."""
    errors = interpolation_error(*(np.where(maps[2], m, np.nan) for m in maps[:2])) + 1e-3
    distance2 = (points**2).sum(-1)
    return 3.0 * distance2 / (RIG.left.fx * RIG.baseline) * errors


def on_lattice(z: np.ndarray) -> np.ndarray:
    return np.dstack([LATTICE.xy(), z])


def test_tilted_plane_with_exact_disparity() -> None:
    a, b = 0.15, -0.1
    maps = disparity(RIG, T_LOCAL_LEFT, plane(a, b, -HEIGHT))
    assert np.ptp(maps[1][maps[2]]) > 5.0  # rows differ: this pair is far from rectified
    xy = LATTICE.xy()
    truth = -HEIGHT + a * xy[..., 0] + b * xy[..., 1]
    dem = solve(maps, (-1.0, -0.3))
    seen = np.isfinite(dem.elevation)
    assert seen.mean() > 0.75
    error = np.abs(dem.elevation - truth)[seen]
    assert (error <= tolerance(maps, on_lattice(truth))[seen]).all()
    assert error.max() < 1e-3  # the tolerance is itself a tight one
    # Every cell that both cameras see (a pixel inside) is found.
    points = on_lattice(truth)
    left = RIG.left.project(T_LOCAL_LEFT.inverse().apply(points))
    right = RIG.right.project((RIG.T_right_left @ T_LOCAL_LEFT.inverse()).apply(points))
    size = np.array([RIG.left.width, RIG.left.height])
    both = ((left > 2) & (left < size - 3) & (right > 2) & (right < size - 3)).all(-1)
    assert seen[both].all()


def test_a_rig_whose_right_camera_is_ahead() -> None:
    """Baseline along the optical axis: epipolar lines run radially, disparity has every direction and a zero inside."""
    rig = Rig(RIG.left, RIG.left, RigidTransform(np.eye(3), [0.0, 0.0, -0.1]))
    maps = disparity(rig, T_LOCAL_LEFT, plane(0.1, 0.0, -HEIGHT))
    dem = solve(maps, (-1.0, -0.3), rig)
    truth = -HEIGHT + 0.1 * LATTICE.xy()[..., 0]
    seen = np.isfinite(dem.elevation)
    assert seen.mean() > 0.6
    # Here the baseline that counts is its part across the ray, so the bound is the kernel's own sensitivity.
    errors = interpolation_error(*(np.where(maps[2], m, np.nan) for m in maps[:2])) + 1e-3
    assert (np.abs(dem.elevation - truth) <= 1.5 * dem.elevation_std * errors / PARAMS.sigma_disparity)[seen].all()


@pytest.mark.parametrize("roll_deg", [90.0, 180.0])
def test_a_right_camera_that_is_rolled_sees_no_jumps_of_its_own(roll_deg: float) -> None:
    roll = RigidTransform(rotation_exp([0.0, 0.0, math.radians(roll_deg)]), np.zeros(3))
    square = [Camera(300.0, 300.0, 159.5, 159.5, 320, 320)] * 2
    found = [
        np.isfinite(solve(disparity(one, T_LOCAL_LEFT, plane(0.0, 0.0, -HEIGHT)), (-1.0, -0.3), one).elevation)
        for one in (Rig(*square, RIG.T_right_left), Rig(*square, roll @ RIG.T_right_left))
    ]
    assert (found[0] == found[1]).mean() > 0.98
    assert found[1].mean() > 0.8


def scaled(scale: float) -> Rig:
    """The rig with a right camera of so many times as many pixels a side."""
    c = RIG.right
    centre = ((v + 0.5) * scale - 0.5 for v in (c.cx, c.cy))
    right = Camera(c.fx * scale, c.fy * scale, *centre, round(c.width * scale), round(c.height * scale))
    return Rig(RIG.left, right, RIG.T_right_left)


@pytest.mark.parametrize("scale", [0.5, 4.0])
def test_a_right_camera_of_another_scale_sees_no_jumps_of_its_own(scale: float) -> None:
    rig = scaled(scale)
    found = [
        np.isfinite(solve(disparity(one, T_LOCAL_LEFT, plane(0.0, 0.0, -HEIGHT)), (-1.0, -0.3), one).elevation)
        for one in (RIG, rig)
    ]
    # At its borders the cells that the right image shows differ by a pixel.
    assert (found[0] == found[1]).mean() > 0.98
    assert found[1].mean() > 0.8
    # A jump is one in pixels of the left image.
    seen = found[0] & found[1]
    column, row, usable = disparity(rig, T_LOCAL_LEFT, plane(0.0, 0.0, -HEIGHT))
    rows, cols = np.indices(column.shape)
    odd = np.where((rows + cols) % 2, scale * 4.0, 0.0)
    even = solve((column + odd, row, usable), (-1.0, -0.3), rig)
    assert not np.isfinite(even.elevation[seen]).any()


def test_ortho_image_is_the_grey_value_of_the_left_projection() -> None:
    maps = disparity(RIG, T_LOCAL_LEFT, plane(0.0, 0.0, -HEIGHT))
    dem = solve(maps, (-1.0, -0.3))
    seen = np.isfinite(dem.elevation)
    pixels = RIG.left.project(T_LOCAL_LEFT.inverse().apply(on_lattice(dem.elevation.astype(float))[seen]))
    np.testing.assert_allclose(dem.ortho[seen], pixels[:, 1] + 2.0 * pixels[:, 0], atol=2e-3)


def test_against_the_literal_minimum_of_the_paper() -> None:
    """Oracle: the Z of least |p_l + d - p_r| on a fine grid of Z, in plain NumPy."""
    maps = disparity(RIG, T_LOCAL_LEFT, nearest(plane(0.0, 0.1, -HEIGHT), ball((0.05, 0.9, -0.75), 0.3)))
    dem = solve(maps, (-0.7, -0.3))
    usable = np.where(maps[2], maps[0], np.nan)
    step = 2e-4
    heights = np.arange(-0.7, -0.3, step)
    rng = np.random.default_rng(1)
    cells = np.argwhere(np.isfinite(dem.elevation))
    for r, c in cells[rng.permutation(len(cells))[:200]]:
        x, y = LATTICE.xy()[r, c]
        points = np.column_stack([np.full(heights.size, x), np.full(heights.size, y), heights])
        p = RIG.left.project(T_LOCAL_LEFT.inverse().apply(points))
        q = RIG.right.project((RIG.T_right_left @ T_LOCAL_LEFT.inverse()).apply(points))
        d = np.stack([bilinear(usable, p), bilinear(maps[1], p)], -1)
        g = np.linalg.norm(p + d - q, axis=1)
        assert abs(heights[np.nanargmin(g)] - dem.elevation[r, c]) <= step


def bilinear(a: np.ndarray, p: np.ndarray) -> np.ndarray:
    inside = (p[:, 0] >= 0) & (p[:, 1] >= 0) & (p[:, 0] < a.shape[1] - 1) & (p[:, 1] < a.shape[0] - 1)
    x, y = np.where(inside, p[:, 0], 0.0), np.where(inside, p[:, 1], 0.0)
    c, r = x.astype(int), y.astype(int)
    fx, fy = x - c, y - r
    top, bottom = a[r, c] * (1 - fx) + a[r, c + 1] * fx, a[r + 1, c] * (1 - fx) + a[r + 1, c + 1] * fx
    return np.where(inside, top * (1 - fy) + bottom * fy, np.nan)


def test_dome_with_exact_disparity() -> None:
    centre, radius = np.array([0.05, 0.9, -1.1]), 0.6
    maps = disparity(RIG, T_LOCAL_LEFT, nearest(plane(0.0, 0.0, -HEIGHT), ball(tuple(centre), radius)))
    dem = solve(maps, (-0.8, -0.3))
    xy = LATTICE.xy()
    inner = ((xy - centre[:2]) ** 2).sum(-1) < 0.2**2  # slopes of 19 degrees: both cameras see the far side, too
    truth = centre[2] + np.sqrt(np.maximum(radius**2 - ((xy - centre[:2]) ** 2).sum(-1), 0.0))
    seen = inner & np.isfinite(dem.elevation)
    assert seen.sum() > 0.9 * inner.sum()
    error = np.abs(dem.elevation - truth)[seen]
    # Besides the bare plane's part, the chord of a bilinear cell lies (footprint / 2)^2 / (2 radius) under the dome,
    # in each of two directions; a pixel's footprint grows as the ray grazes.
    points = on_lattice(truth)[seen]
    distance = np.linalg.norm(points, axis=1)
    grazing = -((points - centre) / radius * points).sum(1) / distance
    chord = 2.0 * (distance / (RIG.left.fx * grazing)) ** 2 / (8.0 * radius)
    slope = PARAMS.sigma_disparity / dem.elevation_std[seen]
    assert (error <= (interpolation_error(*smooth_part()) + 1e-3) / slope + chord).all()
    assert np.median(error) < 1e-4


def smooth_part() -> list[np.ndarray]:
    """The disparity of the bare plane: its interpolation error, without edges."""
    flat = disparity(RIG, T_LOCAL_LEFT, plane(0.0, 0.0, -HEIGHT))
    return [np.where(flat[2], m, np.nan) for m in flat[:2]]


def test_nothing_is_invented_where_a_box_hides_the_ground() -> None:
    low, high = (-0.1, 0.8, -HEIGHT), (0.1, 0.95, -0.4)
    maps = disparity(RIG, T_LOCAL_LEFT, nearest(plane(0.0, 0.0, -HEIGHT), box(low, high)))
    visible = maps[2] | np.isfinite(maps[0])  # even with the disparity of pixels that the right camera cannot see
    dem = solve((maps[0], maps[1], visible), (-0.7, -0.3))
    x, y = LATTICE.xy()[..., 0], LATTICE.xy()[..., 1]
    gap = 0.02  # two cells around the walls, where one bilinear cell holds wall and ground
    on_box = (x > low[0] + gap) & (x < high[0] - gap) & (y > low[1] + gap) & (y < high[1] - gap)
    off_box = (x < low[0] - gap) | (x > high[0] + gap) | (y < low[1] - gap) | (y > high[1] + gap)
    truth = np.where(on_box, high[2], -HEIGHT)
    clear = (on_box | off_box) & np.isfinite(dem.elevation)
    points = on_lattice(truth)
    flat = interpolation_error(*smooth_part()) + 1e-3
    bound = 3.0 * (points**2).sum(-1) / (RIG.left.fx * RIG.baseline) * flat
    assert (np.abs(dem.elevation - truth)[clear] <= bound[clear]).all()
    assert np.isfinite(dem.elevation[on_box]).all()
    # Ground that the left camera cannot see: the ray from it meets the box first.
    ground = on_lattice(np.full(LATTICE.shape, -HEIGHT)).reshape(-1, 3)
    hidden = (box(low, high)(np.zeros(3), ground) < 1.0 - 1e-6).reshape(LATTICE.shape) & off_box & (y > high[1])
    assert hidden.sum() > 50
    deep = hidden & np.roll(hidden, 3, 0) & np.roll(hidden, -3, 0) & np.roll(hidden, 3, 1) & np.roll(hidden, -3, 1)
    assert not np.isfinite(dem.elevation[deep]).any()


def test_what_matching_joins_a_stone_to_the_ground_behind_it_with_is_no_ground() -> None:
    """Disparities as means of windows bend from the top of a box down to what is seen behind it: no jump is left."""
    low, high = (-0.1, 0.8, -HEIGHT), (0.1, 0.95, -0.5)
    exact = disparity(RIG, T_LOCAL_LEFT, nearest(plane(0.0, 0.0, -HEIGHT), box(low, high)))[:2]
    known, blank = np.isfinite(exact[0]), np.full_like(IMAGE, 100.0)
    weight = np.maximum(cv2.blur(known.astype(np.float32), (5, 5)), 1e-6)
    column, row = (cv2.blur(np.nan_to_num(m).astype(np.float32), (5, 5)) / weight for m in exact)
    pair = MatchedPair(blank, Matches(column, row, known), blank)
    found = np.isfinite(reconstruct(pair, RIG, T_LOCAL_LEFT, LATTICE, (-0.7, -0.3), PARAMS).elevation)
    ground = on_lattice(np.full(LATTICE.shape, -HEIGHT)).reshape(-1, 3)
    hidden = (box(low, high)(np.zeros(3), ground) < 1.0 - 1e-6).reshape(LATTICE.shape) & (LATTICE.xy()[..., 1] > 0.97)
    assert hidden.sum() > 300
    assert found[hidden].mean() < 0.25
    assert found[cv2.dilate(hidden.astype(np.uint8), np.ones((15, 15))) == 0].mean() > 0.99


def test_elevation_std_is_calibrated() -> None:
    rng = np.random.default_rng(5)
    sigma = PARAMS.sigma_disparity
    column, row, usable = disparity(RIG, T_LOCAL_LEFT, plane(0.1, 0.05, -HEIGHT))
    truth = -HEIGHT + 0.1 * LATTICE.xy()[..., 0] + 0.05 * LATTICE.xy()[..., 1]
    scores = []
    for _ in range(4):
        # Across the epipolar line nothing changes, so only the column carries noise.
        dem = solve((column + smooth_noise(column.shape, sigma, rng), row, usable), (-1.0, -0.3))
        scores.append(((dem.elevation - truth) / dem.elevation_std)[np.isfinite(dem.elevation)])
    z = np.concatenate(scores)
    assert 0.8 < z.std() < 1.25
    assert abs(z.mean()) < 0.2


def test_cells_of_a_great_standard_deviation_of_their_own_are_left_out() -> None:
    column, row, usable = disparity(RIG, T_LOCAL_LEFT, plane(0.0, 0.0, -HEIGHT))
    noisy = np.zeros(column.shape, bool)
    noisy[100:140, 140:180] = True
    std = np.where(noisy, 1.0, 0.1).astype(np.float32)

    def dem(**limits: float) -> Dem:
        params = LocusParams(**limits)
        given = MatchedPair(IMAGE, Matches(column, row, usable, std))
        return reconstruct(given, RIG, T_LOCAL_LEFT, LATTICE, (-1.0, -0.3), params)

    whole = dem()
    seen = np.isfinite(whole.elevation)
    # Ten times the disparity's standard deviation is ten times the elevation's; the bound lies between both.
    low = np.nanmax(whole.elevation_std[whole.elevation_std < 5.0 * np.nanmin(whole.elevation_std)])
    kept = np.isfinite(dem(max_sigma=float(low) * 1.0001 / 1.4).elevation)
    assert np.array_equal(kept, seen & (whole.elevation_std <= low))
    assert 0 < np.count_nonzero(seen & ~kept) < 0.5 * np.count_nonzero(seen)


def test_an_unusable_pixel_takes_the_cells_around_it_and_no_others() -> None:
    column, row, usable = disparity(RIG, T_LOCAL_LEFT, plane(0.0, 0.0, -HEIGHT))
    whole = solve((column, row, usable), (-1.0, -0.3))
    holed = usable.copy()
    holed[120, 160] = False
    dem = solve((column, row, holed), (-1.0, -0.3))
    pixels = RIG.left.project(T_LOCAL_LEFT.inverse().apply(on_lattice(np.full(LATTICE.shape, -HEIGHT))))
    touched = (np.abs(pixels - [160, 120]) < 1).all(-1)
    assert touched.any()
    lost = np.isfinite(whole.elevation) & ~np.isfinite(dem.elevation)
    assert np.array_equal(lost, touched)
    kept = np.isfinite(dem.elevation)
    np.testing.assert_allclose(dem.elevation[kept], whole.elevation[kept], atol=1e-5)


def test_a_search_that_begins_below_the_surface_finds_it_or_nothing() -> None:
    """On the way up pixels are missing, so that many a cell has to go down again from where it began."""
    column, row, usable = maps = disparity(RIG, T_LOCAL_LEFT, plane(0.0, 0.0, -HEIGHT))
    there = usable & (np.random.default_rng(4).random(usable.shape) < 0.85)
    seen = locus_solve.observed(Matches(column, row, there), IMAGE, RIG, LocusParams())
    dem = Dem(*np.full((3, *LATTICE.shape), np.nan, np.float32))
    start = (np.full(LATTICE.shape, -HEIGHT - below, np.float32) for below in (0.05, 0.01))
    cells = kernel.Cells(LATTICE.xs(), LATTICE.ys(), *start)
    kernel.search(cells, (-1.0, -0.3), locus_solve.cameras_of(RIG, T_LOCAL_LEFT), seen, dem)
    found = np.isfinite(dem.elevation)
    assert 0.05 < found.mean() < 0.9
    truth = np.full(LATTICE.shape, -HEIGHT)
    assert (np.abs(dem.elevation - truth) <= tolerance(maps, on_lattice(truth)))[found].all()


@pytest.mark.parametrize("rows", [0.3, 2.0])
def test_disparity_beside_the_epipolar_line_has_the_elevation_along_it(rows: float) -> None:
    column, row, usable = disparity(RIG, T_LOCAL_LEFT, plane(0.0, 0.0, -HEIGHT))
    off = solve((column, row + rows, usable), (-1.0, -0.3))
    seen = np.isfinite(off.elevation)
    assert seen.mean() > 0.95
    assert np.abs(off.elevation[seen] + HEIGHT).max() < 0.005


def test_the_scene_scales_with_the_baseline() -> None:
    """The same images with all lengths doubled: elevation and its error double, ortho stay."""
    maps = disparity(RIG, T_LOCAL_LEFT, nearest(plane(0.0, 0.1, -HEIGHT), ball((0.05, 0.9, -0.75), 0.3)))
    small = solve(maps, (-0.8, -0.3))
    T = RIG.T_right_left
    rig = Rig(RIG.left, RIG.right, RigidTransform(T.rotation, 2.0 * T.translation))
    lattice = Lattice.at(LATTICE.i0, LATTICE.j0, 2 * LATTICE.cell, LATTICE.rows, LATTICE.cols)
    large = reconstruct(pair(*maps), rig, T_LOCAL_LEFT, lattice, (-1.6, -0.6), PARAMS)
    np.testing.assert_allclose(large.elevation, 2.0 * small.elevation, rtol=1e-5)
    np.testing.assert_allclose(large.elevation_std, 2.0 * small.elevation_std, rtol=1e-3)
    np.testing.assert_allclose(large.ortho, small.ortho, rtol=1e-4)


def test_a_reference_plane_of_ones_own() -> None:
    """A slope seen from its own parallel plane 4 cm below it."""
    a, b, below = 0.2, -0.15, 0.04
    maps = disparity(RIG, T_LOCAL_LEFT, plane(a, b, -HEIGHT))
    normal = np.array([-a, -b, 1.0]) / math.sqrt(1.0 + a * a + b * b)
    across = np.cross([0.0, 1.0, 0.0], normal)
    across /= np.linalg.norm(across)
    along = np.cross(normal, across)
    foot = np.array([0.0, 0.9, -HEIGHT + 0.9 * b]) - below * normal
    T = RigidTransform(np.column_stack([across, along, normal]), foot)
    lattice = Lattice.snap((-0.2, 0.2, -0.2, 0.3), 0.01)
    found = reconstruct(pair(*maps), RIG, T.inverse() @ T_LOCAL_LEFT, lattice, (-0.1, 0.2), PARAMS)
    seen = np.isfinite(found.elevation)
    assert seen.mean() > 0.9
    points = T.apply(np.dstack([lattice.xy(), np.full(lattice.shape, below)]).reshape(-1, 3)).reshape(*lattice.shape, 3)
    assert (np.abs(found.elevation - below) <= tolerance(maps, points))[seen].all()


def test_where_coarse_cells_begin_shows_nowhere() -> None:
    maps = disparity(RIG, T_LOCAL_LEFT, plane(0.1, 0.1, -HEIGHT))
    whole = solve(maps, (-1.0, -0.3))
    coarse_start = Lattice.at(LATTICE.i0, LATTICE.j0 - 16, LATTICE.cell, LATTICE.rows - 16, LATTICE.cols)
    part = reconstruct(pair(*maps), RIG, T_LOCAL_LEFT, coarse_start, (-1.0, -0.3), PARAMS)
    for name in ("elevation", "ortho"):
        assert np.allclose(getattr(whole, name)[16:], getattr(part, name), equal_nan=True, atol=2e-3), name


def test_degraded_input() -> None:
    column, row, usable = disparity(RIG, T_LOCAL_LEFT, plane(0.0, 0.0, -HEIGHT))
    nothing = solve((np.full_like(column, np.nan), row, usable), (-1.0, -0.3))
    assert not np.isfinite(nothing.elevation).any()
    assert not np.isfinite(solve((column, row, np.zeros_like(usable)), (-1.0, -0.3)).ortho).any()
    behind = Lattice.snap((-0.3, 0.3, -1.3, -0.5), 0.01)
    dem = reconstruct(
        pair(column, row, usable),
        RIG,
        T_LOCAL_LEFT,
        behind,
        (-1.0, 1.0),
        PARAMS,
    )
    assert not np.isfinite(dem.elevation).any()
    away = Rig(RIG.left, RIG.right, RigidTransform(np.diag([-1.0, 1.0, -1.0]), [0.1, 0.0, 0.0]))
    assert not np.isfinite(solve((column, row, usable), (-1.0, -0.3), away).elevation).any()
    with raises("RIL-377"):
        solve((column, row, usable), (-1.0, -0.3), Rig(RIG.left, RIG.right, RigidTransform.identity()))
    with raises("RIL-376"):
        solve((column[:-1], row, usable), (-1.0, -0.3))


def bundles(
    rig: Rig,
    height: float,
    noise: np.random.Generator,
    seen: tuple[RigidTransform, Distance] | None = None,
    reference: str | None = None,
) -> dict[str, Bundle]:
    column, row, usable = disparity(rig, *(seen or (T_LOCAL_LEFT, plane(0.0, 0.0, -height))))
    column = column + smooth_noise(column.shape, 0.1, noise)
    arrays = {
        "column_disparity": column.astype(np.float32),
        "row_disparity": row.astype(np.float32),
        "validity": np.where(usable, Validity.MATCHED, Validity.INTERPOLATED).astype(np.uint8),
        "backmatch_error": np.where(usable, 0.1, np.nan).astype(np.float32),
    }
    arrays["backmatch_error"][:, :40] = np.nan
    inputs = {"disparity": Bundle(arrays, {}), "rig": Bundle({}, {"rig": rig.to_dict()})}
    up = T_LOCAL_LEFT.rotation[2].tolist()
    given = {"up": up} if reference is None else {"reference": reference}
    level = level_stage.ground_frame_stage.run(level_stage.GroundFrameParams(), given, inputs)
    return inputs | {"level": level, "left": Bundle({"level_0": IMAGE}, {})}


@pytest.mark.parametrize(("scale", "focal"), [(1.0, RIG.left.fx), (2.0, RIG.left.fx), (0.5, 0.5 * RIG.right.fx)])
def test_the_coarser_pixel_tells_what_is_smoothed_away(scale: float, focal: float) -> None:
    inputs = bundles(scaled(scale), HEIGHT, np.random.default_rng(2))
    local = stage.locus_stage.run(LocusParams(cell_size=0.02), {"pair": 3, "frame": "local"}, inputs)
    assert local.meta["pixel_rad"] == pytest.approx(1.0 / focal)


def test_the_surface_of_a_wall() -> None:
    """Seen straight on and 1.5 m away, with a ball that stands out of it: its distances from the wall."""
    facing, out = pitched(90.0), ball((0.1, 0.1, -1.55), 0.2)
    inputs = bundles(RIG, HEIGHT, np.random.default_rng(2), (facing, nearest(plane(0.0, 0.0, -1.5), out)), "scene")
    dem = stage.locus_stage.run(LocusParams(), {"pair": 3, "frame": "local"}, inputs)
    check_outputs(stage.locus_stage, dem)
    lattice, z = Lattice.from_dict(dem.meta["lattice"]), np.asarray(dem["elevation"])
    T_wall = facing @ RigidTransform.from_matrix(inputs["level"].meta["T_local_left"]).inverse()
    at = T_wall.apply(np.column_stack([lattice.xy().reshape(-1, 2), np.zeros(z.size)])).reshape(*z.shape, 3)
    away = np.hypot(at[..., 0] - 0.1, at[..., 1] - 0.1)
    truth = np.where(away < 0.19, np.sqrt(np.maximum(0.04 - away**2, 0.0)) - 0.05, 0.0)
    given = np.isfinite(z) & ((away < 0.15) | (away > 0.3))
    assert given.sum() > 0.8 * ((away < 0.15) | (away > 0.3)).sum() * dem.meta["defined"]
    assert np.median(np.abs(z - truth)[given & (away < 0.1)]) < 0.02
    assert np.mean(np.abs(z - truth)[given] < 2.0 * np.asarray(dem["elevation_std"])[given]) > 0.9
    covered = dem.meta["coverage"]
    assert covered["outside"] + covered["unsure"] < 0.1


def test_limits_that_keep_pixels_off_the_map_are_named_and_bring_them_in() -> None:
    inputs = bundles(RIG, HEIGHT, np.random.default_rng(2))
    narrow = LocusParams(cell_size=0.01, max_sigma=0.004)
    covered = stage.locus_stage.run(narrow, {"pair": 3, "frame": "local"}, inputs).meta["coverage"]
    assert covered["outside"] + covered["unsure"] > 0.3
    wider = narrow.model_copy(update={name.split(".")[1]: value for name, value in covered["settings"].items()})
    dem = stage.locus_stage.run(wider, {"pair": 3, "frame": "local"}, inputs)
    assert dem.meta["coverage"]["outside"] + dem.meta["coverage"]["unsure"] < 0.12
    # Of the matched pixels, which leave out the left border of the image.
    x_min, x_max, y_min, y_max = Lattice.from_dict(dem.meta["lattice"]).bounds
    assert 0.6 * (x_max - x_min) < covered["size"][0] < x_max - x_min
    assert covered["size"][1] == pytest.approx(y_max - y_min, rel=0.2)


def test_stage_in_both_frames() -> None:
    inputs = bundles(RIG, HEIGHT, np.random.default_rng(2))
    local = stage.locus_stage.run(LocusParams(cell_size=0.01), {"pair": 3, "frame": "local"}, inputs)
    check_outputs(stage.locus_stage, local)
    lattice = Lattice.from_dict(local.meta["lattice"])
    assert lattice.cell == 0.01
    assert local.meta["defined"] > 0.3
    turn = RigidTransform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([2.0, 3.0, 0.25]))
    poses = {"poses": np.stack([np.full((3, 4), np.nan), (turn @ T_LOCAL_LEFT).matrix34])}
    covariances = np.arange(72.0).reshape(2, 6, 6)
    exact, world = (
        stage.locus_stage.run(
            LocusParams(cell_size=0.01),
            {"pair": 3, "frame": "world", "row": 1},
            inputs | {"trajectory": Bundle(arrays, {}), "local": local},
        )
        for arrays in (poses, {**poses, "covariance": covariances})
    )
    check_outputs(stage.locus_stage, world)
    json.dumps([local.meta, world.meta], allow_nan=False)
    assert world.meta.pop("pose_covariance") == list(range(36, 72))
    assert world.meta == exact.meta
    assert "pose_covariance" not in local.meta
    # A quarter turn maps cells on cells: the same surface, computed anew, not resampled.
    rows, cols = np.nonzero(np.isfinite(local["elevation"]))
    xyz = turn.apply(np.column_stack([lattice.xy()[rows, cols], local["elevation"][rows, cols]]))
    index = np.round(Lattice.from_dict(world.meta["lattice"]).index(xyz[:, :2])).astype(int)
    found = world["elevation"][index[:, 0], index[:, 1]]
    assert np.isfinite(found).mean() > 0.99
    solved = kernel.SOLVED_PX / LocusParams().sigma_disparity * local["elevation_std"][rows, cols]
    assert np.nanmean(np.abs(found - xyz[:, 2]) <= 2.0 * solved + 1e-6) > 0.99
    # Pixels whose match nothing confirms from the other image are not used.
    p = RIG.left.project(T_LOCAL_LEFT.inverse().apply(np.dstack([lattice.xy(), local["elevation"]])))
    assert np.nanmin(p[..., 0]) >= 40


def test_each_cell_has_the_error_of_its_own_pixel_where_the_matcher_gives_one() -> None:
    inputs = bundles(RIG, HEIGHT, np.random.default_rng(2))
    args, params = {"pair": 0, "frame": "local"}, LocusParams(cell_size=0.01, max_sigma=1.0)
    plain = stage.locus_stage.run(params, args, inputs)
    shape = inputs["disparity"]["column_disparity"].shape
    std = np.full(shape, 0.1, np.float32)
    std[:, shape[1] // 2 :] = 0.6
    disparity = Bundle({**inputs["disparity"].arrays, "disparity_std": std}, {})
    own = stage.locus_stage.run(params, args, inputs | {"disparity": disparity})
    both = np.isfinite(plain["elevation"])
    np.testing.assert_array_equal(own["elevation"][both], plain["elevation"][both])
    lattice = Lattice.from_dict(own.meta["lattice"])
    pixels = RIG.left.project(T_LOCAL_LEFT.inverse().apply(np.dstack([lattice.xy(), own["elevation"]])))
    ratio = own["elevation_std"] / plain["elevation_std"] * LocusParams().sigma_disparity
    for side, expected in ((pixels[..., 0] < shape[1] // 2 - 1, 0.1), (pixels[..., 0] > shape[1] // 2, 0.6)):
        assert np.isfinite(ratio[side]).sum() > 100
        np.testing.assert_allclose(ratio[side & np.isfinite(ratio)], expected, rtol=1e-5)


def test_stage_parameters_of_the_lattice() -> None:
    inputs = bundles(RIG, HEIGHT, np.random.default_rng(2))
    args = {"pair": 0, "frame": "local"}
    auto = stage.locus_stage.run(LocusParams(), args, inputs)
    assert auto.meta["lattice"]["cell"] == inputs["level"].meta["cell_size"]
    first = Bundle({}, inputs["level"].meta | {"cell_size": 0.02})
    shared = stage.locus_stage.run(LocusParams(), args, inputs | {"reference": first})
    assert shared.meta["lattice"]["cell"] == 0.02
    extent = stage.locus_stage.run(LocusParams(cell_size=0.01, extent=(-0.1, 0.1, 0.6, 0.9)), args, inputs)
    assert Lattice.from_dict(extent.meta["lattice"]) == Lattice.snap((-0.1, 0.1, 0.6, 0.9), 0.01)
    with raises("RIL-391"):
        stage.locus_stage.run(LocusParams(max_sigma=1e-6, extent=(-0.1, 0.1, 0.6, 0.9)), args, inputs)
    with raises("RIL-388"):
        stage.locus_stage.run(LocusParams(cell_size=0.01, extent=(-0.3, 0.3, -5.0, -4.0)), args, inputs)
    with raises("RIL-356"):
        stage.locus_stage.run(LocusParams(cell_size=1e-5, extent=(-1, 1, 0, 1)), args, inputs)
    with raises("RIL-383"):
        stage.locus_stage.run(LocusParams(extent=(1, -1, 0, 1)), args, inputs)
    empty = Bundle({"elevation": np.full((3, 3), np.nan, np.float32)}, {"lattice": Lattice.at(0, 0, 1, 3, 3).to_dict()})
    poses = Bundle({"poses": T_LOCAL_LEFT.matrix34[None]}, {})
    with raises("RIL-384"):
        stage.locus_stage.run(
            LocusParams(), {"pair": 0, "frame": "world", "row": 0}, inputs | {"trajectory": poses, "local": empty}
        )


def test_a_pair_that_is_farther_from_its_ground_than_the_first_one_has_a_model_in_its_cells() -> None:
    inputs, args = bundles(RIG, HEIGHT, np.random.default_rng(2)), {"pair": 0, "frame": "local"}
    inputs["reference"] = Bundle({}, inputs["level"].meta | {"cell_size": 0.002})
    local = stage.locus_stage.run(LocusParams(), args, inputs)
    assert local.meta["lattice"]["cell"] == 0.002
    assert local.meta["defined"] > 0.5
    with raises("RIL-344"):  # as accurate as stated
        stage.locus_stage.run(LocusParams(cell_size=0.002), args, inputs)


def test_the_automatic_extent_ends_where_pixels_cover_too_many_cells() -> None:
    """Camera 1.65 m above a street: a pixel at y covers y^2 / (f h) along the range."""
    rig = toed_in_rig()
    straight = Rig(rig.left, rig.left, RigidTransform(np.eye(3), [-0.5, 0.0, 0.0]))
    view = view_ground(straight, pitched(0.0).rotation, [0.0, 0.0, -1.65])
    lattice = stage.local_lattice(view, 0.1, LocusParams(max_range_cells=5.0, max_sigma=0.1))
    assert lattice.bounds[3] == pytest.approx(math.sqrt(5 * 0.1 * rig.left.fy * 1.65), rel=0.05)
    near = 1.65 * rig.left.fy / (rig.left.height - 1 - rig.left.cy)
    assert lattice.bounds[2] == pytest.approx(near, rel=0.05)


def test_pixels_of_the_right_image_that_lead_to_what_moves_are_found() -> None:
    shape, marked = (6, 20), np.zeros((6, 24), bool)
    marked[1:4, 10:13] = True
    usable = np.ones(shape, bool)
    usable[2, 6] = False
    back = Matches(np.full(shape, 5.3, np.float32), np.full(shape, -1.0, np.float32), usable)
    expected = np.zeros(shape, bool)
    expected[2:5, 5:8] = True
    np.testing.assert_array_equal(stage._lead_to(back, marked), expected & usable)
