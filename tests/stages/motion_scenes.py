"""Coarse displacements of known flows, as the stage ``motion`` gives them."""

from __future__ import annotations

import numpy as np

from rille.stages.core.declare import Bundle, NoParams
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Camera
from rille.stages.odometry import steps

CAMERA = Camera(300.0, 300.0, 239.5, 159.5, 480, 320)
LEVEL = 2


def grid():
    """Positions (column, row) of level 0 of the coarse pixels, each (row, col)."""
    scale = 2**LEVEL
    row, col = np.indices((CAMERA.height // scale, CAMERA.width // scale), dtype=np.float64)
    return (col + 0.5) * scale - 0.5, (row + 0.5) * scale - 0.5


def motion(flow, *, unmatched=None, wrong=(0.0, 0.0)):
    """Result of stage ``motion`` for ``flow(x, y) -> (u, v)``.

    What leaves the image, and what ``unmatched(x, y)`` says, is interpolated with the ``wrong`` displacement.
    """
    x, y = grid()
    u, v = (np.broadcast_to(d, x.shape).astype(np.float32).copy() for d in flow(x, y))
    gone = (x + u < 0) | (x + u > CAMERA.width - 1) | (y + v < 0) | (y + v > CAMERA.height - 1)
    if unmatched is not None:
        gone |= unmatched(x, y)
    validity = np.where(gone, Validity.INTERPOLATED | Validity.BACKMATCH_FAILED, Validity.MATCHED).astype(np.uint8)
    u[gone], v[gone] = wrong
    return Bundle({"column_disparity": u, "row_disparity": v, "validity": validity}, {"level": LEVEL})


def shift(u, v=0.0):
    """Every point by the same."""
    return lambda x, y: (u, v)


def zoom(scale):
    """About the principal point."""
    return lambda x, y: ((scale - 1) * (x - CAMERA.cx), (scale - 1) * (y - CAMERA.cy))


def turned(rotation):
    """Flow of a camera that turns by R_b_a."""
    h = CAMERA.matrix @ rotation @ np.linalg.inv(CAMERA.matrix)

    def flow(x, y):
        p = np.einsum("ij,jrc->irc", h, np.stack([x, y, np.ones_like(x)]))
        return p[0] / p[2] - x, p[1] / p[2] - y

    return flow


def drive(step, height=1.0, pitch=0.5):
    """Flow over the ground of a camera that looks down by ``pitch`` radians and drives ``step`` metres ahead."""
    c, s = np.cos(pitch), np.sin(pitch)
    down, ahead = np.array([0.0, c, s]), np.array([0.0, -s, c])

    def flow(x, y):
        rays = CAMERA.rays(np.stack([x, y], -1))
        below = rays @ down
        assert (below > 0).all()  # no horizon in view
        q = CAMERA.project(rays * (height / below)[..., None] - step * ahead)
        return q[..., 0] - x, q[..., 1] - y

    return flow


def share_kept(flow):
    """Share of the coarse pixels that stay in the image, pixel by pixel."""
    x, y = grid()
    u, v = flow(x, y)
    return np.mean((x + u > -0.5) & (x + u < CAMERA.width - 0.5) & (y + v > -0.5) & (y + v < CAMERA.height - 0.5))


def tables(motions, rows=3):
    """Tables of steps of so many motions each, as the flow cuts them."""
    cuts = range(0, len(motions), rows)
    return [steps.step_table_stage.run(NoParams(), {}, {"motions": motions[k : k + rows]}) for k in cuts]
