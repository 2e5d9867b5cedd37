"""Upper bounds of hidden ground: it is no higher than the lines of sight that pass over it.

No camera sees the ground behind a stone, but the ground beyond it was seen. So the hidden ground between lies below the
line from the camera to the first ground seen beyond:

    z(u) <= z_C + (z(k) - z_C) |u - C| / |k - C|

with C the camera's centre, k the cell seen beyond and u any cell between, distances along the ground. Of several models
the least such height holds. There is no lower bound: no wheel may stand on hidden ground, but the belly may pass over
it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.core.declare import Bundle, Params, raster, stage
from rille.stages.core.kernel import kernel
from rille.stages.facts.terrain import BoundsFacts, DemFacts, MergeFacts
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.merge import seen_finely


class OcclusionBoundsParams(Params):
    """Parameters of the stage ``occlusion_bounds``.

    Attributes
    ----------
    sigmas : standard deviations between an elevation and the bounds.
    max_footprint : largest ground [m] of a pixel where a line of sight ends; not set: no limit.
    """

    sigmas: float = Field(1.25, ge=0, le=10)
    max_footprint: float | None = Field(None, gt=0)


@dataclass(frozen=True)
class Bounds:
    """Bounds (row, col) float32, m, of the height of the ground: ``lower``, NaN where it was not seen, and ``upper``,
    NaN where no line of sight bounds it either."""

    upper: Floats32
    lower: Floats32

    @staticmethod
    def of(elevation: Floats32, doubt: Floats32, hidden: Floats32) -> Bounds:
        """From ``elevation`` (NaN: not seen) plus and minus ``doubt``, and ``hidden`` as upper bound elsewhere."""
        return Bounds(np.where(np.isnan(elevation), hidden, elevation + doubt), elevation - doubt)


def ceiling(elevation: Floats32, lattice: Lattice, centre: Floats) -> Floats32:
    """Return the upper bound (row, col), m, of the ground on the unknown cells; NaN where no line of sight passes.

    Parameters
    ----------
    elevation : (row, col) float32, m, upper bound of the ground that was seen; NaN unknown.
    lattice : of the elevation.
    centre : (3,) m, the camera's centre in the frame of the lattice.
    """
    out = np.full(elevation.shape, np.inf, dtype=np.float32)
    row, col = lattice.index((centre[0], centre[1]))
    _below(np.ascontiguousarray(elevation, dtype=np.float32), float(row), float(col), float(centre[2]), out)
    return np.where(np.isfinite(out), out, np.float32(np.nan))


@kernel
def _below(z, row, col, height, out):  # type: ignore[no-untyped-def]
    """Go from each known cell towards the camera, up to the next known one."""
    rows, cols = z.shape
    for r in range(rows):
        for c in range(cols):
            if math.isnan(z[r, c]):
                continue
            dr, dc = row - r, col - c
            far = math.hypot(dr, dc)
            # Two points a cell of the line of sight.
            for k in range(1, int(2.0 * far)):
                part = k / (2.0 * far)
                i, j = math.floor(r + part * dr + 0.5), math.floor(c + part * dc + 0.5)
                if i == r and j == c:
                    continue
                # From ground that was seen again a line of its own begins.
                if i < 0 or j < 0 or i >= rows or j >= cols or not math.isnan(z[i, j]):
                    break
                # By the cell's own distance: the line passes it up to half a cell beside its middle.
                share = math.hypot(row - i, col - j) / far
                out[i, j] = min(out[i, j], np.float32(height + (z[r, c] - height) * min(share, 1.0)))


@stage(
    "occlusion_bounds",
    outputs=[
        raster("upper", "m", "height that the ground does not exceed", frame="world"),
        raster("lower", "m", "height that it does not fall below, where it was seen", frame="world"),
    ],
)
def occlusion_bounds_stage(
    params: OcclusionBoundsParams, merged: Bundle[MergeFacts], dems: Sequence[Bundle[DemFacts]]
) -> Bundle[BoundsFacts]:
    """Between which heights the ground lies: where it was not seen, below the lines of sight over it."""
    lattice = Lattice.from_dict(merged.meta["lattice"])
    z, s = (np.asarray(merged[name], dtype=np.float32) for name in ("elevation", "relief_std"))
    k = np.float32(params.sigmas)
    least = np.full(lattice.shape, np.nan, dtype=np.float32)
    for dem in dems:
        own = Lattice.from_dict(dem.meta["lattice"])
        centre = RigidTransform.from_matrix(dem.meta["T_frame_left"]).translation
        seen, std = (np.asarray(dem[name], dtype=np.float32) for name in ("elevation", "elevation_std"))
        seen = seen_finely(seen, own.xs(), own.ys(), dem.meta, params.max_footprint)
        part = own.intersection(lattice)
        if part is None:
            continue
        highest = ceiling(seen + k * std, own, centre)[own.window(part)]
        here = lattice.window(part)
        least[here] = np.fmin(least[here], highest)
    bounds = Bounds.of(z, k * s, least)
    return Bundle({"upper": bounds.upper, "lower": bounds.lower}, {"lattice": lattice.to_dict(), "frame": "world"})
