from __future__ import annotations

import numpy as np
from terrain_scenes import disparity, pitched, plane, smooth_noise, toed_in_rig

from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.spline import coefficients, value_and_gradient
from rille.stages.terrain.locus.kernel import Dem
from rille.stages.terrain.locus.refinement import refine
from rille.stages.terrain.locus.solve import join
from rille.stages.terrain.locus.stage import LocusParams, MatchedPair, reconstruct
from rille.stages.terrain.locus.uncertainty import HOLE_VARIANCE_PX2, standard_deviation
from rille.stages.terrain.locus.views import SurfaceViews, View, look
from rille.stages.terrain.matches import Matches

RIG = toed_in_rig()
T_LOCAL_LEFT = pitched(35.0, roll_deg=3.0)
HEIGHT, A, B = 0.6, 0.1, -0.05
LATTICE = Lattice.snap((-0.2, 0.2, 0.5, 0.8), 0.004)
TRUTH = -HEIGHT + A * LATTICE.xy()[..., 0] + B * LATTICE.xy()[..., 1]
MAPS = disparity(RIG, T_LOCAL_LEFT, plane(A, B, -HEIGHT))


def texture(xy: np.ndarray) -> np.ndarray:
    """Grey values of the ground at (n, 2): waves of 20 to 60 mm, so that no pixel (2 to 4 mm) misses one."""
    rng = np.random.default_rng(7)
    value = np.full(len(xy), 120.0)
    for _ in range(24):
        way, length = rng.uniform(0, 2 * np.pi), rng.uniform(0.02, 0.06)
        wave = xy @ np.array([np.cos(way), np.sin(way)]) * 2 * np.pi / length
        value += 8.0 * np.sin(wave + rng.uniform(0, 2 * np.pi))
    return value


def photograph(camera: Camera, T_scene_camera: RigidTransform) -> np.ndarray:
    """Exact image (rows, cols) of the textured plane."""
    cols, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    way = camera.rays(np.stack([cols, rows], -1).reshape(-1, 2).astype(float)) @ T_scene_camera.rotation.T
    o = T_scene_camera.translation
    distance = plane(A, B, -HEIGHT)(o, way)
    points = o + np.where(np.isfinite(distance), distance, 1.0)[:, None] * way
    return texture(points[:, :2]).reshape(camera.height, camera.width).astype(np.float32)


LEFT = photograph(RIG.left, T_LOCAL_LEFT)
RIGHT = photograph(RIG.right, T_LOCAL_LEFT @ RIG.T_right_left.inverse())


def through(T_local_left: RigidTransform = T_LOCAL_LEFT) -> SurfaceViews:
    T_left_local = T_local_left.inverse()
    projections = RIG.left.matrix @ T_left_local.matrix34, RIG.right.matrix @ (RIG.T_right_left @ T_left_local).matrix34
    seen = (View(P, coefficients(image)) for P, image in zip(projections, (LEFT, RIGHT), strict=True))
    return SurfaceViews(*seen, T_local_left.translation, (T_local_left @ RIG.T_right_left.inverse()).translation)


def model(column: np.ndarray, left: np.ndarray = LEFT, right: np.ndarray | None = RIGHT, steps: int = 4) -> Dem:
    params = LocusParams(refine_steps=steps)
    std = np.full(column.shape, 0.2, np.float32)
    pair = MatchedPair(left, Matches(column, MAPS[1], MAPS[2], std), right)
    return reconstruct(pair, RIG, T_LOCAL_LEFT, LATTICE, (-1.0, -0.3), params)


def pixels(dem: Dem) -> np.ndarray:
    """Errors of the known cells as pixels of disparity."""
    error = (dem.elevation - TRUTH) * look(through(), LATTICE, TRUTH).scale
    return error[np.isfinite(error)]


def rms(a: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(a))))


def noisy() -> np.ndarray:
    return MAPS[0] + smooth_noise(MAPS[0].shape, 0.15, np.random.default_rng(1))


def test_both_images_show_the_same_on_the_true_surface() -> None:
    seen = look(through(), LATTICE, TRUTH)
    known = np.isfinite(seen.left)
    assert known.mean() > 0.9
    # A cubic spline through samples six pixels a wave and more: its error is below a hundredth of the amplitudes.
    assert rms((seen.left - seen.right)[known]) < 0.3
    assert rms((seen.left - texture(LATTICE.xy().reshape(-1, 2)).reshape(LATTICE.shape))[known]) < 0.3


def test_derivatives_are_those_of_exact_images() -> None:
    """A point that leaves the ground along one camera's ray shows the other one another place of the ground."""
    dz, views = 1e-4, through()
    seen, points = look(views, LATTICE, TRUTH), np.dstack([LATTICE.xy(), TRUTH])
    known = np.isfinite(seen.left)
    for found, own, other in (
        (seen.left_slope, views.centre, views.right_centre),
        (seen.right_slope, views.right_centre, views.centre),
    ):
        grey = []
        for k in (-1, 1):
            moved = (points + k * dz * (points - other) / (points - other)[..., 2:])[known]
            ahead = moved - own
            grey.append(texture((own + plane(A, B, -HEIGHT)(own, ahead)[:, None] * ahead)[:, :2]))
        change = (grey[1] - grey[0]) / (2 * dz)
        # By the splines of the images, whose gradients are less exact than their grey values.
        assert rms(change - found[known]) < 0.05 * rms(change)


def test_scale_and_area_are_those_of_projections() -> None:
    dz = 1e-4
    seen = look(through(), LATTICE, TRUTH)
    known = np.isfinite(seen.left)
    # Disparity a metre of elevation: the same left pixel, seen on a surface that is dz higher.
    T_left_local = T_LOCAL_LEFT.inverse()
    points = np.dstack([LATTICE.xy(), TRUTH])
    higher = points * (1.0 + dz / points[..., 2:])  # along the ray: the camera's centre is the origin
    moved = [RIG.right.project((RIG.T_right_left @ T_left_local).apply(p)) for p in (points, higher)]
    expected = np.linalg.norm(moved[1] - moved[0], axis=-1) / dz
    np.testing.assert_allclose(seen.scale[known], expected[known], rtol=2e-3)
    # A cell's pixels: the area of its four corners' projections.
    half = 0.5 * LATTICE.cell
    offsets = [np.array([i * half, j * half, 0.0]) for i, j in ((-1, -1), (1, 1), (-1, 1), (1, -1))]
    corners = [RIG.left.project(T_left_local.apply(points + offset)) for offset in offsets]
    d, e = corners[1] - corners[0], corners[3] - corners[2]
    area = 0.5 * np.abs(d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0])
    np.testing.assert_allclose(seen.area[known], area[known], rtol=0.03)


def test_derivatives_along_the_other_ray_are_those_of_finite_differences() -> None:
    """In a frame whose z leans, on a plane of it that cuts the ground at an angle."""
    tilt, dz = RigidTransform(rotation_exp([0.3, 0.2, 0.0]), np.array([0.0, 0.65, -HEIGHT])), 1e-4
    views = through(tilt.inverse() @ T_LOCAL_LEFT)
    lattice = Lattice.snap((-0.1, 0.1, -0.1, 0.1), 0.004)
    seen, cells = (
        look(views, lattice, np.full(lattice.shape, 0.01)),
        np.dstack([lattice.xy(), np.full(lattice.shape, 0.01)]),
    )
    known = np.isfinite(seen.left)
    assert known.mean() > 0.9
    for view, found, other in (
        (views.left, seen.left_slope, views.right_centre),
        (views.right, seen.right_slope, views.centre),
    ):
        ray = (cells - other) / (cells - other)[..., 2:]
        grey = []
        for points in (cells - dz * ray, cells + dz * ray):
            x, y, depth = np.moveaxis(points @ view.projection[:, :3].T + view.projection[:, 3], -1, 0)
            grey.append(
                [
                    value_and_gradient(view.spline, u, v)[0]
                    for u, v in zip((x / depth)[known], (y / depth)[known], strict=True)
                ]
            )
        change = (np.array(grey[1]) - grey[0]) / (2 * dz)
        assert rms(change - found[known]) < 0.01 * rms(found[known])


def test_cells_are_seen_that_lie_inside_both_images() -> None:
    wide = Lattice.snap((-0.6, 0.6, 0.3, 1.2), 0.02)
    points = np.dstack([wide.xy(), np.full(wide.shape, -HEIGHT)])
    seen = look(through(), wide, points[..., 2])
    T_left_local = T_LOCAL_LEFT.inverse()
    left, right = (
        RIG.left.project(T_left_local.apply(points)),
        RIG.right.project((RIG.T_right_left @ T_left_local).apply(points)),
    )
    size = np.array([RIG.left.width, RIG.left.height])
    inside = np.all([(p >= 1) & (p < size - 2) for p in (left, right)], axis=(0, 3))
    assert 0.1 < inside.mean() < 0.9
    for shown in seen:
        np.testing.assert_array_equal(np.isfinite(shown), inside)


def test_errors_of_the_disparity_are_taken_out() -> None:
    column = noisy()
    before, after = pixels(model(column, right=None)), pixels(model(column))
    assert 0.1 < rms(before) < 0.2
    # No noise in the images: what remains is what the smoothness and the sweeps leave of it.
    assert rms(after) < 0.2 * rms(before)
    assert len(after) > 0.9 * len(before)


def test_an_elevation_that_is_right_stays() -> None:
    """The disparity's bilinear cells and the splines of both images agree to a hundredth of a pixel."""
    assert rms(pixels(model(MAPS[0]))) < 0.02


def test_noise_in_the_images_is_averaged() -> None:
    """3 grey levels of noise: the least-squares bound for one pixel is its share of the gradient, about .3 px."""
    rng = np.random.default_rng(3)
    left, right = (image + rng.normal(0, 3.0, image.shape).astype(np.float32) for image in (LEFT, RIGHT))
    found = pixels(model(noisy(), left, right))
    assert rms(found) < 0.1


def test_another_exposure_changes_little() -> None:
    same, brighter = model(noisy()), model(noisy(), right=1.25 * RIGHT - 8.0)
    both = np.isfinite(same.elevation) & np.isfinite(brighter.elevation)
    assert both.sum() > 0.98 * np.isfinite(same.elevation).sum()
    scale = look(through(), LATTICE, TRUTH).scale
    assert rms(((same.elevation - brighter.elevation) * scale)[both]) < 0.01


def test_noise_that_matches_noise_is_not_trusted() -> None:
    """A shadow over the right half: its grey values are noise of two cameras, smooth disparities notwithstanding."""
    rng = np.random.default_rng(4)
    x = LATTICE.xy()[..., 0]
    dark = MAPS[0].shape[1] // 2
    images = []
    for image, shift in ((LEFT, 0), (RIGHT, int(np.nanmedian(MAPS[0])))):
        shadow = image.copy()
        start = dark + shift
        shadow[:, start:] = 10.0 + rng.normal(0, 1.5, shadow[:, start:].shape)
        images.append(shadow)
    params = LocusParams(max_sigma=1.0)
    std = np.full(MAPS[0].shape, 0.2, np.float32)
    args = RIG, T_LOCAL_LEFT, LATTICE, (-1.0, -0.3), params
    dem = reconstruct(MatchedPair(images[0], Matches(*MAPS, std), images[1]), *args)
    column = RIG.left.project(T_LOCAL_LEFT.inverse().apply(np.dstack([LATTICE.xy(), TRUTH])))[..., 0]
    lit, shaded = (np.isfinite(dem.elevation_std) & side for side in (column < dark - 40, column > dark + 40))
    assert lit.sum() > 1000
    assert shaded.sum() > 1000
    assert np.median(dem.elevation_std[shaded]) > 4.0 * np.median(dem.elevation_std[lit])
    assert np.ptp(x[shaded]) > 0.05


def test_undefined_cells_stay_undefined_and_cast_doubt() -> None:
    elevation = TRUTH.astype(np.float32)
    elevation[30:34, 40:44] = np.nan
    found, seen = refine(through(), LATTICE, elevation, 2)
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(elevation))
    none = np.zeros(elevation.shape, np.float32)
    std = standard_deviation(found, seen, none + 1, none, None, none)
    # Twelve of the 49 cells around it.
    assert std[29, 42] > np.sqrt(HOLE_VARIANCE_PX2 * 12 / 49) / seen.scale[29, 42]
    assert std[29, 42] > 2.0 * std[10, 42]


def test_without_steps_or_a_right_image_the_disparity_decides() -> None:
    column = noisy()
    plain, none = model(column, right=None), model(column, steps=0)
    for name, values in plain._asdict().items():
        np.testing.assert_array_equal(values, getattr(none, name))


def flat(elevation: list[float], std: list[float]) -> Dem:
    return Dem(*(np.array([values], np.float32) for values in (elevation, std, [9.0] * len(std))))


def test_both_directions_are_joined_by_hand() -> None:
    nan = float("nan")
    a, b = flat([1.0, 1.0, nan, nan], [0.1, 0.1, nan, nan]), flat([1.3, nan, 2.0, nan], [0.2, nan, 0.3, nan])
    found = join(a, b)
    # Weights 100 and 25; variance .1 x .2 + .3^2.
    np.testing.assert_allclose(found.elevation, [[1.06, 1.0, 2.0, nan]], rtol=1e-6)
    np.testing.assert_allclose(
        found.elevation_std,
        [[np.sqrt(0.02 + 0.09), 0.2, 0.6, nan]],
        rtol=1e-6,
    )


def test_cells_that_one_direction_lost_come_from_the_other() -> None:
    """Exact disparities of both images; of the left one, a band is missing, and another contradicts the right one."""
    turned = Rig(RIG.right, RIG.left, RIG.T_right_left.inverse())
    column, row, usable = disparity(turned, T_LOCAL_LEFT @ RIG.T_right_left.inverse(), plane(A, B, -HEIGHT))
    back = Matches(column, row, usable, np.full(column.shape, 0.2, np.float32))
    params = LocusParams(max_sigma=1.0, refine_steps=0)
    given, known = MAPS[0].copy(), MAPS[2].copy()
    known[:, 140:160] = False
    given[:, 200:240] += 1.0
    args = RIG, T_LOCAL_LEFT, LATTICE, (-1.0, -0.3), params
    std = np.full(given.shape, 0.2, np.float32)
    forth = Matches(given, MAPS[1], known, std)
    alone = reconstruct(MatchedPair(LEFT, forth, RIGHT), *args)
    both = reconstruct(MatchedPair(LEFT, forth, RIGHT, back), *args)
    seen = np.isfinite(look(through(), LATTICE, TRUTH).left)
    x = RIG.left.project(T_LOCAL_LEFT.inverse().apply(np.dstack([LATTICE.xy(), TRUTH])))[..., 0]
    lost, wrong, plain = (seen & (x > a) & (x < b) for a, b in ((143, 157), (205, 235), (60, 130)))
    assert not np.isfinite(alone.elevation[lost]).any()
    scale = look(through(), LATTICE, TRUTH).scale
    assert np.nanmax(np.abs((both.elevation - TRUTH) * scale)[lost]) < 0.05
    assert np.isfinite(both.ortho[lost]).all()
    assert np.abs(both.ortho - texture(LATTICE.xy().reshape(-1, 2)).reshape(x.shape))[lost].max() < 3.0
    np.testing.assert_allclose(np.abs((both.elevation - TRUTH) * scale)[wrong].mean(), 0.5, atol=0.1)
    assert np.median(both.elevation_std[wrong]) > 2.0 * np.median(both.elevation_std[plain])
