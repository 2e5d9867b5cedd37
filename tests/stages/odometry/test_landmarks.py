"""Landmarks: triangulation and ray intersection on analytic surfaces, holes, uncertainty."""

import numpy as np
import pytest

from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.geometry.lattice import Lattice
from rille.stages.odometry.resection.landmarks import (
    intersect,
    landmarks_from_dem,
    landmarks_from_disparity,
    matches_at,
    relief,
)

CAMERA = Camera(400.0, 400.0, 159.5, 119.5, 320, 240)
TOE_IN = RigidTransform(rotation_exp(np.array([0.01, 0.15, 0.02])), np.array([-0.1, 0.003, 0.008]))
RIG = Rig(CAMERA, CAMERA, TOE_IN)
# Looking 40 degrees down from the origin of a levelled frame; the ground is 0.6 m below.
T_LOCAL_LEFT = RigidTransform(rotation_exp(np.array([-np.pi / 2 - np.radians(40), 0, 0])), np.zeros(3))
GROUND = -0.6


def plane_disparity(tilt=0.1):
    """Exact disparity maps of the plane z = GROUND + tilt y, and the points (row, col, 3) seen."""
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    rays = CAMERA.rays(np.stack([x, y], -1)) @ T_LOCAL_LEFT.rotation.T
    depth = GROUND / (rays[..., 2] - tilt * rays[..., 1])
    points = rays * depth[..., None]
    right = CAMERA.project(TOE_IN.apply(T_LOCAL_LEFT.inverse().apply(points)))
    d = (right - np.stack([x, y], -1)).astype(np.float32)
    return d[..., 0].copy(), d[..., 1].copy(), np.ones(x.shape, np.uint8), points


def plane_dem(tilt=0.1, cell=0.005):
    lattice = Lattice.snap((-1.0, 1.0, 0.2, 2.0), cell)
    return (GROUND + tilt * lattice.xy()[..., 1]).astype(np.float32), lattice


def from_disparity(points, maps, sigma=0.1, ratio=0.2):
    return landmarks_from_disparity(
        points, maps[:3], RIG, T_LOCAL_LEFT, np.full(len(points), sigma), max_depth_ratio=ratio
    )


def test_disparity_and_elevation_model_give_the_same_landmarks_on_a_plane():
    maps = plane_disparity()
    elevation, lattice = plane_dem()
    rng = np.random.default_rng(0)
    points = rng.uniform([60, 60], [260, 200], (100, 2))
    a = from_disparity(points, maps)
    b = landmarks_from_dem(points, elevation, lattice, RIG, T_LOCAL_LEFT, np.full(100, 0.1), max_depth_ratio=0.2)
    assert np.isfinite(a.position).all()
    assert np.isfinite(b.position).all()
    # On the plane itself: float32 disparities of about 100 pixels are good to 4e-6 px; times Z^2 / (f B) = 0.02 m/px,
    # plus the disparity's curvature between pixels, below 2e-3 px.
    np.testing.assert_allclose(a.position[:, 2], GROUND + 0.1 * a.position[:, 1], atol=5e-5)
    np.testing.assert_allclose(b.position[:, 2], GROUND + 0.1 * b.position[:, 1], atol=1e-6)
    np.testing.assert_allclose(a.position, b.position, atol=1e-4)
    np.testing.assert_allclose(a.per_pixel, b.per_pixel, rtol=1e-3)


def test_a_pixel_of_disparity_moves_a_landmark_by_z_squared_over_f_b():
    rig = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    d = np.full((240, 320), -20.0, np.float32)  # Z = f B / 20 = 2 m
    zero, valid = np.zeros_like(d), np.ones(d.shape, np.uint8)
    point = np.array([[200.0, 100.0]])
    found = landmarks_from_disparity(
        point, (d, zero, valid), rig, RigidTransform.identity(), np.array([0.25]), max_depth_ratio=0.2
    )
    np.testing.assert_allclose(found.position[0], CAMERA.rays(point)[0] * 2.0, rtol=1e-9)
    np.testing.assert_allclose(found.per_pixel[0], CAMERA.rays(point)[0] * 2.0**2 / (400 * 0.1), rtol=1e-9)
    assert found.sigma[0] == 0.25
    far = landmarks_from_disparity(
        point, (d, zero, valid), rig, RigidTransform.identity(), np.array([5.0]), max_depth_ratio=0.2
    )
    assert np.isnan(far.position).all()
    assert far.lost["too far for the baseline"] == 1


def test_filled_missing_and_torn_disparities_give_no_landmark():
    column, row, valid, _ = plane_disparity()
    valid[100, 100] = 2  # filled
    column[120, 121] = np.nan
    column[140:, 200:] += 5.0  # a depth edge; the shift also breaks the epipolar condition there
    points = np.array(
        [[99.5, 99.5], [100.0, 101.0], [120.5, 119.5], [199.5, 150.0], [150.5, 150.5], [np.nan, 5.0], [-3, 4]]
    )
    found = from_disparity(points, (column, row, valid))
    # The second lies on a pixel below the filled one: the filled one has no weight.
    assert np.isfinite(found.position).all(1).tolist() == [False, True, False, False, True, False, False]
    assert found.lost["without a consistent stereo match"] == 5


def test_the_last_row_and_column_have_disparities_and_nothing_lies_beyond():
    column, row, valid, _ = plane_disparity()
    points = np.array([[319.0, 239.0], [0.0, 0.0], [319.0, 100.5], [319.1, 100.0], [100.0, 239.1]])
    found, ok = matches_at(points, column, row, valid)
    assert ok.tolist() == [True, True, True, False, False]
    middle = np.array([m[100:102, 319].mean(dtype=float) for m in (column, row)])
    np.testing.assert_allclose(found[:3], [[column[-1, -1], row[-1, -1]], [column[0, 0], row[0, 0]], middle])


def test_rays_that_do_not_meet_give_no_landmark():
    column, row, valid, _ = plane_disparity()
    found = from_disparity(np.array([[150.0, 150.0]]), (column, row + np.float32(3.0), valid))
    assert np.isnan(found.position).all()
    assert found.lost["whose rays do not meet"] == 1


def test_relief_is_the_departure_from_a_plane():
    y, x = np.mgrid[:40, :40].astype(np.float32)
    ramp = 0.3 * x - 0.2 * y
    valid = np.ones(ramp.shape, np.uint8)
    at = np.array([[20.0, 20.0], [np.nan, 1.0]])
    flat = relief(at, ramp, np.zeros_like(ramp), valid)
    assert flat[0] == pytest.approx(0.0, abs=1e-5)
    assert np.isnan(flat[1])
    # A step of 1 px through the middle: of the +-0.5 about the mean, a plane through 11 columns explains a part.
    step = np.where(x > 20, 1.0, 0.0).astype(np.float32)
    columns = np.where(np.arange(-5, 6) > 0, 1.0, 0.0)
    expected = np.polyval(np.polyfit(np.arange(-5, 6), columns, 1), np.arange(-5, 6)) - columns
    assert relief(at[:1], step, np.zeros_like(step), valid)[0] == pytest.approx(np.sqrt(np.mean(expected**2)), rel=1e-5)
    assert np.isnan(relief(at[:1], 8 * step, np.zeros_like(step), valid)[0])  # two surfaces
    valid[:, 18:] = 0
    assert np.isnan(relief(at[:1], step, np.zeros_like(step), valid)[0])


def test_ray_meets_the_first_surface_from_above():
    lattice = Lattice.snap((-1.0, 1.0, 0.5, 3.0), 0.01)
    y = lattice.xy()[..., 1]
    elevation = np.where((y > 1.0) & (y < 1.2), -0.2, -0.5).astype(np.float32)  # a wall in front of the ground
    down = np.array([[0.0, 1.0, -0.2], [0.0, 1.0, -0.55], [0.0, 1.0, 0.1], [0.3, -1.0, -0.1]])
    s = intersect(elevation, lattice, np.zeros(3), down)
    assert s[0] == pytest.approx(1.0, abs=0.011)  # on the wall's front or top, within its cell
    assert s[1] == pytest.approx(0.5 / 0.55, abs=1e-6)  # the ground before the wall
    assert np.isnan(s[2:]).all()  # above everything, and away from it


def test_ray_that_enters_from_below_is_rejected_and_a_hole_forgets():
    lattice = Lattice.snap((-1.0, 1.0, 0.5, 3.0), 0.01)
    y = lattice.xy()[..., 1]
    elevation = np.where(y > 2.0, -0.2, -0.5).astype(np.float32)
    ray = np.array([[0.0, 1.0, -0.15]])  # on the high ground at y = 2.0 it is at -0.3: below it
    step = intersect(elevation, lattice, np.zeros(3), ray)[0]
    assert step == pytest.approx(2.0, abs=0.011)  # the step's face is seen
    elevation[(y > 1.5) & (y < 2.1)] = np.nan  # now nobody knows what is there
    assert np.isnan(intersect(elevation, lattice, np.zeros(3), ray)).all()
    elevation[(y > 1.5) & (y < 2.5)] = -0.5
    elevation[y <= 1.0] = np.nan  # a hole before the hit does no harm
    hit = intersect(elevation, lattice, np.zeros(3), np.array([[0.0, 1.0, -0.3]]))[0]
    assert hit == pytest.approx(0.5 / 0.3, abs=1e-5)


def test_every_ray_down_to_flat_ground_meets_it():
    lattice = Lattice.snap((-1.0, 1.0, 0.5, 3.0), 0.1)
    at = np.random.default_rng(1).uniform([-0.9, 0.6], [0.9, 2.9], (500, 2))
    length = np.random.default_rng(2).uniform(0.3, 3.0, 500)
    down = np.column_stack([at, np.full(500, -0.3)]) / length[:, None]
    flat = np.full(lattice.shape, -0.3, np.float32)
    np.testing.assert_allclose(intersect(flat, lattice, np.zeros(3), down), length, rtol=1e-6)


def test_ray_that_meets_the_ground_beyond_the_model_misses_it():
    lattice = Lattice.snap((-1.0, 1.0, 0.5, 3.0), 0.1)
    elevation = np.full(lattice.shape, -0.5, np.float32)
    at = np.array([2.999, 3.001])  # the last row of cells is at y = 3.0
    s = intersect(elevation, lattice, np.zeros(3), np.column_stack([0 * at, 0 * at + 1.0, -0.5 / at]))
    assert s[0] == pytest.approx(2.999, abs=1e-6)
    assert np.isnan(s[1])


def test_empty_model_gives_nothing():
    lattice = Lattice.snap((-1.0, 1.0, 0.5, 3.0), 0.1)
    found = landmarks_from_dem(
        np.array([[100.0, 100.0]]),
        np.full(lattice.shape, np.nan, np.float32),
        lattice,
        RIG,
        T_LOCAL_LEFT,
        np.array([0.1]),
        max_depth_ratio=0.2,
    )
    assert np.isnan(found.position).all()
    assert "1 whose ray misses" in found.summary()
