"""CAHV, CAHVOR and CAHVORE against JPL's own library, against the equations solved point by point, and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cahvore_camera import Cahvore
from scipy.optimize import brentq

from rille.stages.geometry.cahvore import Bending

ORACLE = Path(__file__).parent / "cahvore_pixels.npz"
"""Pixels of :func:`points` by cycahvore 0.0.1a0, which wraps ``cmod_cahvore_3d_to_2d`` of JPL's VICAR."""

C = (0.4, -0.2, 0.1)
A = tuple(np.array([0.9990, 0.0100, -0.0436]) / np.linalg.norm([0.9990, 0.0100, -0.0436]))
ACROSS, DOWN = np.cross(A, (0, 0, 1)), np.cross(A, np.cross(A, (0, 0, 1)))
H = tuple(900 * ACROSS + 0.3 * DOWN + 512 * np.array(A))
V = tuple(901 * DOWN + 511.5 * np.array(A))
AXIS = tuple(np.array([0.9993, 0.0122, -0.0351]) / np.linalg.norm([0.9993, 0.0122, -0.0351]))
R, E = (2e-4, -0.21, 0.05), (0.004, -0.002, 0.001)
WIDE = (-1e-4, 0.01, -0.002)

MODELS = {
    "CAHV": Bending(A),
    "CAHVOR": Bending(AXIS, R),
    "CAHVORE perspective": Bending(AXIS, R, 1.0),
    "CAHVORE fisheye": Bending(AXIS, WIDE, 0.0),
    "CAHVORE general": Bending(AXIS, WIDE, 0.37),
    "CAHVORE negative": Bending(AXIS, WIDE, -0.5),
}


def points():
    """(1000, 3) points from 0.3 to 30 m before the camera, up to 40 degrees off its axis."""
    rng = np.random.default_rng(29)
    angle, turn = np.radians(rng.uniform(0, 40, 1000)), rng.uniform(0, 2 * np.pi, 1000)
    side = np.cos(turn)[:, None] * ACROSS + np.sin(turn)[:, None] * DOWN
    rays = np.cos(angle)[:, None] * A + np.sin(angle)[:, None] * side
    return C + rays * np.exp(rng.uniform(np.log(0.3), np.log(30), 1000))[:, None]


def pupils():
    """(1000, 3) displacements of the entrance pupil of a CAHVORE for the points: (t / sin t - 1) e(t) along its axis,
    e = E0 + E1 t^2 + E2 t^4, for a ray at the angle t to the axis through the moved pupil."""
    moved = []
    for point in points() - C:
        along, across = point @ AXIS, np.linalg.norm(point - (point @ AXIS) * np.array(AXIS))

        def pupil(t):
            return (t / np.sin(t) - 1) * (E[0] + E[1] * t**2 + E[2] * t**4)

        def miss(t, along=along, across=across):
            return np.tan(t) * (along - pupil(t)) - across

        moved.append(pupil(brentq(miss, 1e-9, 1.4, xtol=1e-15)))
    return np.outer(moved, AXIS)


@pytest.mark.parametrize("name", MODELS)
def test_projections_are_those_of_the_oracle(name):
    expected = np.load(ORACLE)[name]
    assert expected.shape == (1000, 2)
    # What the entrance pupil, which moves by E, sees of a point the same camera without E sees of a point beside it.
    there = points() - (pupils() if "CAHVORE" in name else 0.0)
    np.testing.assert_allclose(Cahvore(C, A, H, V, MODELS[name]).project(there), expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_rays_go_through_the_points_they_were_projected_from(name):
    camera, there = Cahvore(C, A, H, V, MODELS[name]), points()
    pixels = camera.project(there)
    rays = camera.rays(pixels)
    distance = np.linalg.norm(there - C, axis=1)
    np.testing.assert_allclose(C + distance[:, None] * rays, there, rtol=0, atol=1e-9)
    further = C + 2.5 * distance[:, None] * rays
    np.testing.assert_allclose(camera.project(further), pixels, rtol=0, atol=1e-6)


@pytest.mark.parametrize("linearity", [1.0, 0.37, 0.0, -0.5])
def test_the_reach_is_where_pixels_turn_back(linearity):
    t = np.linspace(0.0, 1.5, 150_001)
    x = t if linearity == 0 else (np.tan if linearity > 0 else np.sin)(linearity * t) / linearity
    out = (1.01 - 0.2 * x**2 - 0.02 * x**4) * x
    lens = Bending((0.0, 0.0, 1.0), (0.01, -0.2, -0.02), linearity=linearity)
    assert lens.reach() == pytest.approx(t[np.argmax(out)], abs=1e-4)


def test_what_the_lens_does_not_see_has_no_pixel():
    camera = Cahvore(C, A, H, V, Bending(AXIS, (0.0, -0.5, 0.0)))  # 1 - 1.5 x^2 vanishes at 0.816, 39 degrees
    ahead, beyond, behind = (np.array(C) + np.array(A) * d + ACROSS * s for d, s in ((1, 0.5), (1, 0.95), (-1, 0.1)))
    found = camera.project([ahead, beyond, behind])
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1:]).all()
    assert np.isnan(camera.rays([[5000.0, 512.0]])).all()
