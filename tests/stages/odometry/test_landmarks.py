"""Landmarks: triangulation on analytic surfaces, holes, uncertainty."""

import numpy as np
import pytest

from rille.stages.core.declare import Bundle
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.odometry.resection.landmarks import landmarks_of, matches_at, template_planes

CAMERA = Camera(400.0, 400.0, 159.5, 119.5, 320, 240)
TOE_IN = RigidTransform(rotation_exp(np.array([0.01, 0.15, 0.02])), np.array([-0.1, 0.003, 0.008]))
RIG = Rig(CAMERA, CAMERA, TOE_IN)
# Looking 40 degrees down from the origin of a levelled frame; the ground is 0.6 m below.
T_LOCAL_LEFT = RigidTransform(rotation_exp(np.array([-np.pi / 2 - np.radians(40), 0, 0])), np.zeros(3))
GROUND = -0.6


def plane_disparity(tilt=0.1, rig=RIG):
    """Exact disparity maps of the plane z = GROUND + tilt y, and the points (row, col, 3) seen."""
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    rays = CAMERA.rays(np.stack([x, y], -1)) @ T_LOCAL_LEFT.rotation.T
    depth = GROUND / (rays[..., 2] - tilt * rays[..., 1])
    points = rays * depth[..., None]
    right = rig.right.project(rig.T_right_left.apply(T_LOCAL_LEFT.inverse().apply(points)))
    d = (right - np.stack([x, y], -1)).astype(np.float32)
    return d[..., 0].copy(), d[..., 1].copy(), np.ones(x.shape, np.uint8), points


def pair(column, row, valid):
    """A disparity as the matcher gives it."""
    return Bundle({"column_disparity": column, "row_disparity": row, "validity": valid}, {})


def from_disparity(points, maps, rig=RIG, T=T_LOCAL_LEFT, sigma=0.1):
    return landmarks_of(points, pair(*maps[:3]), rig, T, sigma)


def test_landmarks_lie_on_the_plane_that_was_seen():
    maps = plane_disparity()
    points = np.random.default_rng(0).uniform([60, 60], [260, 200], (100, 2))
    a = from_disparity(points, maps)
    # Float32 disparities of about 100 pixels are good to 4e-6 px; times Z^2 / (f B) = 0.02 m/px, plus the disparity's
    # curvature between pixels, below 2e-3 px.
    np.testing.assert_allclose(a.position[:, 2], GROUND + 0.1 * a.position[:, 1], atol=5e-5)
    assert (a.sigma < 0.2).all()


def test_a_pixel_of_disparity_moves_a_landmark_by_z_squared_over_f_b():
    rig = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    d = np.full((240, 320), -20.0, np.float32)  # Z = f B / 20 = 2 m
    zero, valid = np.zeros_like(d), np.ones(d.shape, np.uint8)
    point = np.array([[200.0, 100.0]])
    level = RigidTransform.identity()
    found = from_disparity(point, (d, zero, valid), rig, level, 0.25)
    np.testing.assert_allclose(found.position[0], CAMERA.rays(point)[0] * 2.0, rtol=1e-9)
    np.testing.assert_allclose(found.per_pixel[0], CAMERA.rays(point)[0] * 2.0**2 / (400 * 0.1), rtol=1e-9)
    assert found.sigma[0] == pytest.approx(0.25)
    shifted = from_disparity(point, (d + 3.0, zero, valid), rig, level, 0.25)
    np.testing.assert_allclose(found.moved(3.0).position, shifted.position, rtol=1e-6)
    np.testing.assert_allclose(found.moved(3.0).per_pixel, shifted.per_pixel, rtol=1e-6)
    np.testing.assert_allclose(found.moved(3.0).inverse_parallax, shifted.inverse_parallax, rtol=1e-6)
    far = from_disparity(point, (d, zero, valid), rig, level, 5.0)
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
    found, ok, _ = matches_at(points, pair(column, row, valid))
    assert ok.tolist() == [True, True, True, False, False]
    middle = np.array([m[100:102, 319].mean(dtype=float) for m in (column, row)])
    np.testing.assert_allclose(found[:3], [[column[-1, -1], row[-1, -1]], [column[0, 0], row[0, 0]], middle])


@pytest.mark.parametrize(
    "rig",
    [
        Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-0.9, 0.0, 0.0]))),
        Rig(CAMERA, Camera(920.0, 920.0, 367.5, 275.5, 736, 552), TOE_IN),
    ],
    ids=["cameras farther apart than they are high", "a right camera of finer pixels"],
)
def test_ground_that_is_steep_in_disparity_has_landmarks(rig):
    column, row, valid, seen = plane_disparity(0.1, rig)
    column[:, 240:] += 5.0  # two surfaces
    found = from_disparity(np.array([[150.0, 150.5], [200.5, 120.5], [239.5, 150.0]]), (column, row, valid), rig)
    assert np.isfinite(found.position).all(1).tolist() == [True, True, False]
    np.testing.assert_allclose(found.position[0], seen[150:152, 150].mean(axis=0), atol=1e-4)


@pytest.mark.parametrize("scale", [1, 4])
def test_what_is_one_surface_counts_in_the_coarser_pixels(scale):
    size = CAMERA.width * scale, CAMERA.height * scale
    right = Camera(400.0 * scale, 400.0 * scale, *((n - 1) / 2 for n in size), *size)
    rig = Rig(CAMERA, right, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    column, row, valid, _ = plane_disparity(0.1, rig)
    column[:, 200:] += 3.0
    found = from_disparity(np.array([[150.0, 150.5], [199.5, 150.5]]), (column, row, valid), rig)
    assert np.isfinite(found.position).all(1).tolist() == [True, scale > 1]
    assert found.sigma[0] == pytest.approx(0.1 * scale, rel=0.01)


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
    slopes, flat = template_planes(at, pair(ramp, np.zeros_like(ramp), valid))
    np.testing.assert_allclose(slopes[0], [[0.3, 0.0], [-0.2, 0.0]], atol=1e-6)
    assert flat[0] == pytest.approx(0.0, abs=1e-5)
    assert np.isnan(flat[1])
    # A step of 1 px through the middle: of the +-0.5 about the mean, a plane through 11 columns explains a part.
    step = np.where(x > 20, 1.0, 0.0).astype(np.float32)
    columns = np.where(np.arange(-5, 6) > 0, 1.0, 0.0)
    expected = np.polyval(np.polyfit(np.arange(-5, 6), columns, 1), np.arange(-5, 6)) - columns
    assert template_planes(at[:1], pair(step, np.zeros_like(step), valid))[1] == pytest.approx(
        np.sqrt(np.mean(expected**2)), rel=1e-5
    )
    assert np.isnan(template_planes(at[:1], pair(8 * step, np.zeros_like(step), valid))[1])  # two surfaces
    valid[:, 18:] = 0
    assert np.isnan(template_planes(at[:1], pair(step, np.zeros_like(step), valid))[1])
