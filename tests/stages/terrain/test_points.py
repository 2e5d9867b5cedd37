"""Points of a pair: where known disparities put them, how certain they are, and which one stays of a voxel."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises

from rille.stages.core.declare import Bundle
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp
from rille.stages.terrain.points import colours, cubes, one_a_cube, points

LEFT, RIGHT = Camera(210.0, 205.0, 63.0, 40.0, 120, 90), Camera(260.0, 262.0, 50.0, 47.0, 110, 96)
RIG = Rig(LEFT, RIGHT, RigidTransform(rotation_exp([0.02, 0.05, -0.08]), np.array([-0.3, 0.04, 0.02])))


def wall() -> tuple[Bundle, np.ndarray]:
    """Disparity of a tilted wall seen by two unlike cameras, and where its points truly are."""
    v, u = np.mgrid[: LEFT.height, : LEFT.width]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    rays = LEFT.rays(pixels)
    normal = np.array([0.2, -0.1, 1.0])
    X = rays * (4.0 / (rays @ normal))[:, None]
    shift = RIG.right.project(RIG.T_right_left.apply(X)) - pixels
    shape = (LEFT.height, LEFT.width)
    arrays = {
        "column_disparity": shift[:, 0].reshape(shape),
        "row_disparity": shift[:, 1].reshape(shape),
        "disparity_std": np.full(shape, 0.2, np.float32),
        "validity": np.full(shape, Validity.MATCHED, np.uint8),
    }
    return Bundle(arrays, {}), X.reshape(*shape, 3)


def test_points_lie_where_the_rays_of_both_cameras_meet():
    disparity, true = wall()
    found = points(disparity, RIG)
    assert len(found.position) == LEFT.height * LEFT.width
    column, row = found.pixel.T
    np.testing.assert_allclose(found.position, true[row, column], rtol=1e-9)


def test_sigma_is_what_an_error_of_the_disparity_along_the_epipolar_line_moves():
    disparity, _ = wall()
    found = points(disparity, RIG, every=7)
    # Along the line: to where a point a little nearer on the same ray would be seen.
    X = found.position
    pixel = found.pixel.astype(float)
    at, nearer = (RIG.right.project(RIG.T_right_left.apply(p)) for p in (X, X * (1 - 1e-6)))
    step = (nearer - at) / np.linalg.norm(nearer - at, axis=1, keepdims=True)
    moved = Bundle(dict(disparity.arrays), {})
    for k, name in enumerate(("column_disparity", "row_disparity")):
        values = np.array(disparity[name])
        values[found.pixel[:, 1], found.pixel[:, 0]] = (at + 1e-4 * step - pixel)[:, k]
        moved.arrays[name] = values
    shift = np.linalg.norm(points(moved, RIG, every=7).position - X, axis=1)
    np.testing.assert_allclose(found.sigma_along, 0.2 * shift / 1e-4, rtol=2e-3)
    # Across the ray: a point that lies anywhere in its pixel, whose side is the shorter focal length's.
    within = np.linspace(-0.5, 0.5, 10001).std() / LEFT.fy
    np.testing.assert_allclose(found.sigma_across, within * np.linalg.norm(X, axis=1), rtol=1e-3)


def test_only_measured_pixels_give_points_and_none_that_may_be_infinitely_far():
    disparity, _ = wall()
    validity, std = np.array(disparity["validity"]), np.array(disparity["disparity_std"])
    validity[:10] = Validity.INTERPOLATED
    validity[10:20] = 0
    std[20:30] = np.nan
    std[30:40] = 1e3
    found = points(Bundle({**disparity.arrays, "validity": validity, "disparity_std": std}, {}), RIG)
    assert found.pixel[:, 1].min() == 40
    assert len(found.position) == (LEFT.height - 40) * LEFT.width


def test_every_third_row_and_column():
    found = points(wall()[0], RIG, every=3)
    assert not (found.pixel % 3).any()
    assert len(found.position) == 40 * 30


@pytest.mark.parametrize(("dtype", "scale"), [("uint8", 1.0), ("float32", 1.0), ("uint16", 257.0)])
def test_colour_is_that_of_the_left_image(dtype, scale):
    found = points(wall()[0], RIG, every=5)
    grey = np.arange(LEFT.height * LEFT.width).reshape(LEFT.height, LEFT.width) % 251
    column, row = found.pixel.T
    image = Bundle({"image": (grey * scale).astype(dtype)}, {})
    np.testing.assert_array_equal(colours(found.pixel, image), np.repeat(grey[row, column, None], 3, axis=1))
    rgb = np.stack([grey, grey[::-1], grey * 0], axis=2).astype(np.uint8)
    np.testing.assert_array_equal(colours(found.pixel, Bundle({**image.arrays, "colour": rgb}, {})), rgb[row, column])


def test_of_a_voxel_the_most_certain_point_stays():
    rng = np.random.default_rng(5)
    position, sigma = rng.uniform(-1, 1, (500, 3)), rng.uniform(0.1, 1, 500).astype(np.float32)
    best: dict[tuple[int, ...], int] = {}
    for k, place in enumerate(np.floor(position / 0.5).astype(int)):
        known = best.get(tuple(place))
        if known is None or sigma[k] < sigma[known]:
            best[tuple(place)] = k
    np.testing.assert_array_equal(one_a_cube(cubes(position, 0.5), sigma), sorted(best.values()))


def test_points_beyond_a_million_voxels_are_refused():
    with raises("RIL-619"):
        cubes(np.array([[0.0, 0.0, 2e3]]), 1e-3)
