"""Distances from epipolar lines, their derivatives, and what corrections do to depth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rig_scenes import bed_depth, bed_rig, knocked, matches, street_depth, street_rig
from terrain_scenes import toed_in_rig

from rille.stages.geometry.epipolar import (
    NAMES,
    angle_along,
    beyond_infinity,
    corrected,
    depth_sensitivity,
    distances,
    far_shift,
    farther,
    turned_along,
)
from rille.stages.geometry.geometry import Rig, RigidTransform, rotation_exp

RIGS = {"street": street_rig(), "bed": bed_rig(), "unequal cameras": toed_in_rig()}
ANGLE = st.floats(-0.1, 0.1)
ZERO = np.zeros(5)


def vertical_rig() -> Rig:
    """Right camera below the left one."""
    rig = street_rig()
    return Rig(rig.left, rig.right, RigidTransform(np.eye(3), np.array([0.0, -0.5, 0.0])))


def test_row_offset_of_a_parallel_rig_is_the_distance():
    left = np.array([[100.0, 50.0], [900.0, 300.0]])
    right = left + np.array([[-30.0, 2.0], [-5.0, -3.0]])
    distance, _ = distances(street_rig(), ZERO, left, right)
    np.testing.assert_allclose(distance, [2.0, -3.0], atol=1e-12)


def test_distance_across_columns_where_the_baseline_is_vertical():
    left = np.array([[100.0, 150.0]])
    distance, _ = distances(vertical_rig(), ZERO, left, left + np.array([[4.0, -30.0]]))
    assert abs(distance[0]) == pytest.approx(4.0)


@pytest.mark.parametrize("name", RIGS)
def test_exact_matches_lie_on_their_lines(name):
    rig = RIGS[name]
    m = matches(rig, bed_depth, noise=0.0)
    np.testing.assert_allclose(distances(rig, ZERO, m.left, m.right)[0], 0.0, atol=1e-9)


def rolled_rig(degrees: float, centre: tuple[float, float, float] = (0.5, 0.0, 0.0)) -> Rig:
    """Right camera at ``centre``, m, of the left one's frame, turned in its image plane."""
    rig, rotation = street_rig(), rotation_exp([0.0, 0.0, math.radians(degrees)])
    return Rig(rig.left, rig.right, RigidTransform(rotation, -rotation @ np.array(centre)))


ODD = {"vertical": vertical_rig(), "rolled": rolled_rig(40.0), "oblique": rolled_rig(0.0, (0.3, 0.4, 0.1))}


@pytest.mark.parametrize("rig", [*RIGS.values(), *ODD.values()], ids=[*RIGS, *ODD])
@given(c=st.tuples(*[ANGLE] * 5))
@settings(max_examples=15, deadline=None)
def test_derivatives_are_those_of_central_differences(rig, c):
    rng = np.random.default_rng(1)
    left = rng.uniform([0, 0], [rig.left.width, rig.left.height], (20, 2))
    right = left + rng.normal(0, 20, (20, 2))
    c = np.array(c)
    _, jacobian = distances(rig, c, left, right)
    h = 1e-5
    for i in range(5):
        ahead, behind = (distances(rig, c + s * h * np.eye(5)[i], left, right)[0] for s in (1, -1))
        scale = np.abs(jacobian[:, i]).max() + 1.0
        np.testing.assert_allclose(jacobian[:, i] / scale, (ahead - behind) / (2 * h) / scale, atol=2e-6)


@given(c=st.tuples(*[ANGLE] * 5))
@settings(max_examples=30, deadline=None)
def test_correction_keeps_the_baseline_and_is_what_distances_mean(c):
    rig = toed_in_rig()
    there = corrected(rig, np.array(c))
    assert there.baseline == pytest.approx(rig.baseline, rel=1e-12)
    left, right = np.array([[10.0, 20.0], [200.0, 150.0]]), np.array([[5.0, 25.0], [180.0, 149.0]])
    here, _ = distances(rig, np.array(c), left, right)
    np.testing.assert_allclose(here, distances(there, ZERO, left, right)[0], atol=1e-9)


@pytest.mark.parametrize(
    ("rig", "name"),
    [
        (street_rig(), "yaw"),
        (vertical_rig(), "pitch"),
        *[
            (rolled_rig(roll), name)
            for roll, name in ((90.0, "pitch"), (-90.0, "pitch"), (180.0, "yaw"), (30.0, "yaw"))
        ],
        *[(rolled_rig(roll), "yaw") for roll in (44.0, 46.0, 60.0, 134.0, -46.0)],
        (rolled_rig(90.0, (0.01, 0.5, 0.0)), "yaw"),
    ],
)
def test_one_angle_moves_the_right_image_along_its_lines_and_one_across(rig, name):
    far = np.array([[600.0, 180.0]])
    right = rig.right.project(rig.T_right_left.apply(rig.left.rays(far) * 1e6))
    slopes = distances(rig, ZERO, far, right)[1][0, :2]
    along = NAMES.index(name)
    assert angle_along(rig) == name
    assert abs(slopes[along]) < 0.02 * abs(slopes[1 - along])
    turned = corrected(rig, 1e-4 * np.eye(5)[along])
    moved = far_shift(rig, turned)
    assert abs(moved @ farther(rig)) == pytest.approx(np.linalg.norm(moved), rel=1e-3)
    assert turned_along(rig, turned) == pytest.approx(1e-4)


def test_where_the_baseline_leads_along_the_view_nothing_is_farther():
    assert not farther(rolled_rig(0.0, (0.0, 0.0, 0.5))).any()


def test_no_correction_is_the_same_rig():
    rig = bed_rig()
    assert corrected(rig, ZERO) is rig


def test_angles_hold_the_centre_and_swings_hold_the_rotation():
    rig = bed_rig()
    turned, swung = knocked(rig, 1.0, -2.0, 3.0), knocked(rig, across_deg=1.0, forward_deg=1.0)
    np.testing.assert_allclose(
        turned.T_right_left.inverse().translation, rig.T_right_left.inverse().translation, atol=1e-15
    )
    np.testing.assert_array_equal(swung.T_right_left.rotation, rig.T_right_left.rotation)
    step = swung.T_right_left.inverse().translation - rig.T_right_left.inverse().translation
    # to first order: down the image and along the axis, by a degree of the baseline each
    assert step[1] == pytest.approx(rig.baseline * math.radians(1.0), rel=0.01)
    assert step[2] > 0


def test_a_hundredth_of_a_degree_of_toe_in_costs_half_a_percent_on_a_street():
    left = np.array([[629.0, 183.0]])
    cost = depth_sensitivity(street_rig(), left, left - [[27.0, 0.0]])
    relative = math.sqrt(cost[1, 1]) * math.radians(0.01)
    assert relative == pytest.approx(707.0 * math.radians(0.01) / 27.0, rel=1e-3)  # 0.457 %


def test_cost_of_depth_is_what_a_knock_does():
    rig = bed_rig()
    m = matches(rig, bed_depth, noise=0.0)
    cost = depth_sensitivity(rig, m.left, m.right)
    step = np.zeros(5)
    step[NAMES.index("yaw")] = math.radians(0.1)
    from rille.stages.geometry.epipolar import inverse_depth

    true, per_pixel = inverse_depth(rig, m.left, m.right - m.left)
    wrong, _ = inverse_depth(corrected(rig, step), m.left, m.right - m.left)
    weight = (true / per_pixel) ** 2
    expected = math.sqrt(np.sum(weight * (wrong / true - 1) ** 2) / np.sum(weight))
    assert math.sqrt(step @ cost @ step) == pytest.approx(expected, rel=0.02)


def test_beyond_infinity_counts_pixels_of_disparity():
    left = np.array([[600.0, 100.0]] * 2)
    right = left + np.array([[3.0, 0.0], [-7.0, 0.0]])
    np.testing.assert_allclose(beyond_infinity(street_rig(), left, right), [3.0, -7.0])


@given(c=st.tuples(*[ANGLE] * 5))
@settings(max_examples=10, deadline=None)
def test_distances_grow_by_the_normals(c):
    rig, c = toed_in_rig(), np.array(c)
    left, right = np.array([[10.0, 20.0], [200.0, 150.0]]), np.array([[5.0, 25.0], [180.0, 149.0]])
    step = np.array([0.3, -0.7])
    here, there = (distances(rig, c, left, r)[0] for r in (right, right + step))
    np.testing.assert_allclose(there - here, (distances(rig, c, left, right)[1][:, 5:] @ step), atol=1e-10)


def test_street_scene_is_in_front():
    m = matches(street_rig(), street_depth, noise=0.0)
    assert (beyond_infinity(street_rig(), m.left, m.right) < 0).all()
