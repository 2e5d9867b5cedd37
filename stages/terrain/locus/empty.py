"""Why Locus found no cell at all: a surface that the cameras do not see asks for another change than bad matches do."""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.errors import DegenerateError
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.geometry.surface import Surface


def explain(
    rig: Rig, T_surface_left: RigidTransform, surface: Surface, z_range: tuple[float, float], usable: Bools
) -> DegenerateError:
    """The error to raise for an elevation model without any cell.

    Parameters
    ----------
    rig, T_surface_left, surface, z_range, usable : as Locus got them.
    """
    pick = [
        # At most 64 cells along either side are looked at.
        np.unique(np.linspace(0, n - 1, 64).astype(np.intp))
        for n in (surface.rows, surface.cols)
    ]
    feet, normals = surface.block(*pick)
    z = np.linspace(*z_range, 9)[:, None, None, None]
    points = T_surface_left.inverse().apply(feet + z * normals)
    seen = [_inside(camera, p) for camera, p in ((rig.left, points), (rig.right, rig.T_right_left.apply(points)))]
    if not (seen[0] & seen[1]).any():
        left, right = (100.0 * float(s.any(axis=0).mean()) for s in seen)
        return DegenerateError(
            "RIL-388",
            f"the cameras look away from the reference surface: the left one sees {left:.0f} %, the right one "
            f"{right:.0f} % of its cells, and no cell is seen by both",
            remedy="check locus.extent (y is ahead), the vertical (world.up, world.pitch_deg), the left/right order, "
            "and T_right_left",
        )
    count, cells = int(usable.sum()), surface.rows * surface.cols
    if not count:
        return DegenerateError(
            "RIL-389",
            f"none of {usable.size} disparities is valid, so no elevation can be found",
            remedy="look at the disparity's validity: exposure, focus, left/right order; or raise locus.max_backmatch",
        )
    return DegenerateError(
        "RIL-391",
        f"none of {cells} cells could be reconstructed from {count} valid disparities of {usable.size}: they "
        f"contradict the calibration, or lie outside of {z_range[0]:.4g} to {z_range[1]:.4g} m of elevation, or the "
        "cells are too coarse for what the cameras see",
        remedy="look at the rig's residuals in the report; or raise locus.max_residual or locus.max_sigma, or lower "
        "locus.cell_size",
    )


def _inside(camera: Camera, points: Floats) -> Bools:
    """Which points (..., 3) of a camera's frame lie in its image."""
    pixels = camera.project(points)
    with np.errstate(invalid="ignore"):
        return np.asarray(((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1])).all(axis=-1))
