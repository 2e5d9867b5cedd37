import numpy as np
import pytest
from matching_scenes import pair

from rille.stages.imaging.pyramid import PyramidParams, build
from rille.stages.odometry.point_search import match_points


def pyramids(displacement, noise=0.0, valid=None):
    a, b, *_ = pair(displacement, (160, 200), noise=noise)
    return build(a, PyramidParams()), build(b, PyramidParams(), valid)


def find(a, b, points, predicted, affinity=None):
    """Positions, distances, and which were found; without an affinity there is no change of shape."""
    shape = np.tile(np.eye(2), (len(points), 1, 1)) if affinity is None else affinity
    position, distance = match_points(a, b, points, predicted, shape, 4)
    return position, distance, np.isfinite(distance)


def some_points(n=80):
    rng = np.random.default_rng(3)
    return np.stack([rng.uniform(40, 160, n), rng.uniform(40, 120, n)], axis=1)


def test_sub_pixel_positions_from_a_rough_prediction():
    a, b = pyramids(lambda x, y: (7.3, -4.6), noise=1.0)
    points = some_points()
    rough = points + np.array([7.3, -4.6]) + np.random.default_rng(0).uniform(-3, 3, points.shape)
    position, _, found = find(a, b, points, rough)
    error = np.hypot(*(position - points - [7.3, -4.6]).T)
    assert found.mean() > 0.95
    # Linear interpolation of summed distances: .15 px (measured on tracks), both components.
    assert np.median(error[found]) < 0.2
    np.testing.assert_array_equal(np.isfinite(position).all(axis=1), found)


def test_affinity_makes_up_for_a_change_of_scale_and_roll():
    shape = np.array([[1.35, -0.25], [0.25, 1.35]])

    def displacement(x, y):
        dx, dy = x - 100.0, y - 80.0
        return shape[0, 0] * dx + shape[0, 1] * dy - dx, shape[1, 0] * dx + shape[1, 1] * dy - dy

    a, b = pyramids(displacement)
    points = np.array([100.0, 80.0]) + (some_points() - [100.0, 80.0]) * 0.7
    truth = (points - [100, 80]) @ shape.T + [100, 80]
    position, distance, found = find(a, b, points, truth + 0.8, np.tile(shape, (len(points), 1, 1)))
    _, unturned, found_unturned = find(a, b, points, truth + 0.8)
    error = np.hypot(*(position - truth).T)
    assert found.mean() > 0.9
    assert np.median(error[found]) < 0.25
    assert np.mean(unturned[found_unturned]) > 2 * np.mean(distance[found])
    assert found_unturned.mean() < found.mean()


def test_what_cannot_be_found_is_lost():
    valid = np.ones((160, 200), np.uint8)
    valid[:60] = 0
    a, b = pyramids(lambda x, y: (5.0, 0.0), valid=valid)
    points = np.array([[100.0, 30.0], [100.0, 100.0], [199.0, 100.0], [np.nan, 3.0], [60.0, 110.0]])
    shape = np.tile(np.eye(2), (5, 1, 1))
    shape[4] = 0.0
    position, _, found = find(a, b, points, points + np.array([5.0, 0.0]), shape)
    np.testing.assert_array_equal(found, [False, True, False, False, False])
    np.testing.assert_array_equal(np.isnan(position).all(1), ~found)


def test_back_matching_refuses_most_of_what_is_somewhere_else():
    a, b = pyramids(lambda x, y: (5.0, 0.0))
    _, wrong, found_wrong = find(a, b, some_points(), some_points() + np.array([-15.0, 12.0]))
    _, right, found_right = find(a, b, some_points(), some_points() + np.array([5.0, 0.0]))
    # What is left over are valleys of the distance that both directions run into; they are not deep.
    assert found_wrong.mean() < 0.3
    assert np.median(wrong[found_wrong]) > 2 * np.median(right[found_right])


@pytest.mark.parametrize("n", [0, 1])
def test_few_points_and_black_images(n):
    black = build(np.zeros((30, 30), np.uint8), PyramidParams())
    position, _, found = find(black, black, np.full((n, 2), 15.0), np.full((n, 2), 15.0))
    assert position.shape == (n, 2)
    assert not found.any()


def test_tiny_image_loses_every_point():
    tiny = build(np.zeros((3, 3), np.uint8), PyramidParams())
    assert not find(tiny, tiny, np.ones((2, 2)), np.ones((2, 2)))[2].any()
