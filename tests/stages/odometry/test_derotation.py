"""Undoing a rotation: where pixels go, and back."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from matching_scenes import Texture

from rille.stages.geometry.geometry import Camera, rotation_exp
from rille.stages.imaging.pyramid import PyramidParams, build
from rille.stages.odometry.derotation import MARGIN, Derotation

CAMERA = Camera(150.0, 160.0, 79.0, 61.0, 160, 120)
ANGLE = st.floats(-0.4, 0.4)


def turned(R_b_a):
    """Of a camera that turns by R_b_a."""
    return Derotation(CAMERA.matrix @ R_b_a @ np.linalg.inv(CAMERA.matrix), (CAMERA.height, CAMERA.width))


def test_a_far_point_moves_as_the_cameras_say():
    R_b_a = rotation_exp([0.1, -0.2, 0.3])
    point = np.array([0.2, -0.1, 1.0]) * 1e6
    x, y = CAMERA.project(point)
    p = turned(R_b_a).homography @ [x, y, 1.0]
    np.testing.assert_allclose(p[:2] / p[2], CAMERA.project(R_b_a @ point), rtol=1e-9)


def test_the_later_frame_is_held_like_the_earlier_one():
    """The texture is frame a itself; b shows it turned."""
    R_b_a = rotation_exp([0.05, -0.08, 0.35])
    turn = turned(R_b_a)
    texture = Texture(waves=40)
    rows, cols = np.indices((CAMERA.height, CAMERA.width), dtype=np.float64)
    p = np.einsum("ij,jrc->irc", np.linalg.inv(turn.homography), np.stack([cols, rows, np.ones_like(cols)]))
    b = build(texture(p[0] / p[2], p[1] / p[2]), PyramidParams(levels=3))
    back = turn.apply(b)
    part = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
    ok = back.valid[0][part] != 0
    assert 0.6 < ok.mean() < 0.95
    # Shortest wave 5 pixels, twice through cubic interpolation at most: a few grey levels of 35.
    difference = (back.images[0][part] - texture(cols, rows))[ok]
    assert np.sqrt(np.mean(difference**2)) < 3.0


@settings(deadline=None, max_examples=30)
@given(ANGLE, ANGLE, ANGLE, st.sampled_from([0, 1, 2]))
def test_composed_displacements_lead_where_the_point_is(rx, ry, rz, level):
    turn = turned(rotation_exp([rx, ry, rz]))
    scale = 2**level
    u = np.full((CAMERA.height // scale, CAMERA.width // scale), 5.0, np.float32)
    v = np.full_like(u, -3.0)
    u[0, 0] = np.nan
    column, row = turn.compose(u + MARGIN, v + MARGIN, level)
    assert column.dtype == np.float32
    assert np.isnan(column[0, 0])
    assert np.isnan(row[0, 0])
    r, c = u.shape[0] // 2, u.shape[1] // 3
    x, y = (c + 0.5) * scale - 0.5, (r + 0.5) * scale - 0.5
    p = turn.homography @ [x + 5.0, y - 3.0, 1.0]
    np.testing.assert_allclose([x + column[r, c], y + row[r, c]], p[:2] / p[2], atol=1e-4)
