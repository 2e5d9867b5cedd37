"""Depth from a disparity, for any two cameras: nothing is rectified."""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.geometry.geometry import Rig


def inverse_depth(rig: Rig, pixels: Floats, disparity: Floats) -> tuple[Floats, Floats]:
    """Inverse depth 1/Z (n,) along the left camera's axis, 1/m, and its change per pixel of disparity (n,).

    With p_r ~ Z m + epipole, m = K_r R r, the offset from the epipole is linear in 1/Z; the part of the disparity
    across the epipolar line says nothing on depth and is left out.
    """
    to_right = rig.right.matrix @ rig.T_right_left.rotation
    epipole = rig.right.matrix @ rig.T_right_left.translation
    m = rig.left.rays(pixels) @ to_right.T
    p = pixels + disparity
    # Direction of the epipolar line at p, in homogeneous coordinates: right also where the epipole lies at infinity.
    along = p * epipole[2] - epipole[:2]
    offset = p * m[:, 2:] - m[:, :2]
    # At the epipole itself there is no line.
    length2 = np.maximum((along**2).sum(-1), 1e-300)
    return -(offset * along).sum(-1) / length2, np.abs(m[:, 2]) / np.sqrt(length2)
