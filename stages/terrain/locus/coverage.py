"""Share of a pair's matched pixels that its map holds, and limits with which it would hold nearly all.

The map lacks a matched pixel for one of three reasons: the pixel lies outside of it; its cell is too uncertain; or it
is off the surface (hidden from above, or on an upright face), where no limit helps.

:func:`explain` gives the reason of a map without any cell: bad matches ask for another change than a surface that the
cameras do not see.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.errors import DegenerateError
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lattice import MAX_CELLS, Lattice
from rille.stages.terrain.ground import PlaneView
from rille.stages.terrain.locus.kernel import Dem
from rille.stages.terrain.locus.solve import LocusParams


def explain(
    rig: Rig, T_local_left: RigidTransform, lattice: Lattice, z_range: tuple[float, float], usable: Bools
) -> DegenerateError:
    """The error to raise for an elevation model without any cell.

    Parameters
    ----------
    rig, T_local_left, lattice, z_range, usable : as Locus got them.
    """
    # At most 64 cells along either side are looked at.
    y, x = (np.unique(axis[np.linspace(0, len(axis) - 1, 64).astype(np.intp)]) for axis in (lattice.ys(), lattice.xs()))
    points = T_local_left.inverse().apply(np.stack(np.meshgrid(x, y, np.linspace(*z_range, 9)), axis=-1))
    sides = (rig.left, points), (rig.right, rig.T_right_left.apply(points))
    seen = [camera.holds(camera.project(p)) for camera, p in sides]
    if not (seen[0] & seen[1]).any():
        left, right = (100.0 * float(s.any(axis=-1).mean()) for s in seen)
        return DegenerateError(
            "RIL-388",
            f"the cameras look away from the reference surface: the left one sees {left:.0f} %, the right one "
            f"{right:.0f} % of its cells, and no cell is seen by both",
            remedy="check locus.extent (y is ahead), the vertical (world.up, world.pitch_deg), the left/right order, "
            "and T_right_left",
        )
    count, cells = int(usable.sum()), lattice.rows * lattice.cols
    if not count:
        return DegenerateError(
            "RIL-389",
            f"none of {usable.size} disparities is valid, so no elevation can be found",
            remedy="look at the disparity's validity: exposure, focus, left/right order; or raise hfvm.backmatch",
        )
    return DegenerateError(
        "RIL-391",
        f"none of {cells} cells could be reconstructed from {count} valid disparities of {usable.size}: they "
        f"lie outside of {z_range[0]:.4g} to {z_range[1]:.4g} m of elevation, or the cells are too coarse for what the "
        "cameras see",
        remedy="look at the rig's residuals in the report; or raise locus.max_sigma, or lower locus.cell_size",
    )


def coverage(
    view: PlaneView, dem: Dem, lattice: Lattice, z_range: tuple[float, float], greatest: float, params: LocusParams
) -> dict[str, Any]:
    """Shares of the matched pixels that are ``outside``, ``unsure`` and ``off`` the surface; ``settings`` by which the
    map would hold nearly all that lie within the range of elevations (None: no limit keeps them out), and ``size`` m
    wide and high of it then.

    Parameters
    ----------
    view : of the matched pixels.
    dem : all cells, the unsure ones too.
    z_range : of the search, m.
    greatest : largest standard deviation of a cell, m.
    params : limits of the extent; ``max_sigma`` is set.
    """
    assert params.max_sigma is not None
    sigma_d, farthest = params.sigma_disparity, math.inf if params.extent else params.max_range_cells
    x, y, z = view.xyz.T
    x_min, x_max, y_min, y_max = lattice.bounds
    searched = (z >= z_range[0]) & (z <= z_range[1])
    inside = searched & (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
    row, col = np.rint(lattice.index(view.xyz[inside, :2])).astype(np.intp).clip(0, np.array(lattice.shape) - 1).T
    elevation, std = (values[row, col].astype(np.float64) for values in (dem.elevation, dem.elevation_std))
    # Within three standard deviations and a cell.
    on = np.abs(elevation - z[inside]) <= 3.0 * std + lattice.cell
    count = max(len(z), 1)
    shares = {
        "outside": np.count_nonzero(~inside) / count,
        "unsure": np.count_nonzero(on & (std > greatest)) / count,
        "off": np.count_nonzero(~on) / count,
    }
    facts: dict[str, Any] = {**shares, "settings": None, "size": None}
    if not on.any():
        return facts
    # Cells that are too unsure ask for a higher limit in proportion.
    sigma = max(_upper_quantile(std[on]) * params.max_sigma / greatest, _upper_quantile(sigma_d / view.slope[searched]))
    cells = _upper_quantile(view.along[searched] / lattice.cell)
    needs = {"locus.max_sigma": (sigma, params.max_sigma), "locus.max_range_cells": (cells, farthest)}
    wider = {name: need for name, (need, limit) in needs.items() if need > limit}
    if wider:
        good = searched & (sigma_d / view.slope <= max(sigma, params.max_sigma))
        good &= view.along <= max(cells, farthest) * lattice.cell
        low, high = np.quantile(view.xyz[good, :2], [view.stray, 1.0 - view.stray], axis=0)
        facts["size"] = (high - low).tolist()
        if np.prod(high - low) > 0.5 * MAX_CELLS * lattice.cell**2:
            wider = {"locus.cell_size": max(sigma, cells * lattice.cell / farthest)}
        facts["settings"] = {name: float(f"{need:.2g}") for name, need in wider.items()}
    return facts


def _upper_quantile(values: Floats) -> float:
    """Bound that nearly all values do not exceed, with room for rounding."""
    return 1.05 * float(np.quantile(values, 0.95))
