"""Locus over a whole lattice: cells from one disparity map, coarse to fine, and models of both directions joined.

The kernel and its equations are in :mod:`rille.stages.terrain.locus.kernel`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from rille.stages.core.declare import Params
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.scale import axes
from rille.stages.terrain.locus.kernel import Cells, Dem, Observed, PairCameras, search
from rille.stages.terrain.matches import Matches

COARSE_CELLS = 8  # cells that a coarse cell is wide: a 64th of the cells search the whole range
MAX_JUMP_PX = 3.0  # range of the four disparities around a cell that are one surface; beyond, ground is hidden there


class LocusParams(Params):
    """Parameters of the stage ``locus``.

    Attributes
    ----------
    cell_size : side of a cell [m]; not set: it follows from the rig.
    extent : x_min, x_max, y_min, y_max [m] in the local frame; not set: what both cameras see well.
    max_range_cells : number of cells that a pixel may cover along the range within the automatic extent.
    max_sigma : largest standard deviation [m], by sigma_disparity; not set: one cell size, or the one that would suit
        the pair if that is greater and cell_size is not set; above a plane that is no ground ten times that of the
        median match.
    sigma_disparity : standard deviation of a typical disparity [pixels].
    refine_steps : number of Gauss-Newton steps that refine the elevations by both images; 6 for matches of preset fast,
        3 for others; 0: none.
    both : also match from right to left and use both elevations; doubles the time of matching.
    least_facing : least area of ground in the image over that of level ground; what is seen more edge-on is left out.
    """

    cell_size: float | None = Field(None, gt=0)
    extent: tuple[float, float, float, float] | None = None
    max_range_cells: float = Field(6.0, gt=0)
    max_sigma: float | None = Field(None, gt=0)
    sigma_disparity: float = Field(0.2, gt=0)
    refine_steps: int = Field(3, ge=0, le=20)
    both: bool = False
    least_facing: float = Field(0.3, ge=0, lt=1)


def observed(matches: Matches, image: ArrayLike, rig: Rig, params: LocusParams) -> Observed:
    """The kernel's input: matches, and the image whose pixels are matched, the left one of ``rig``."""
    shape = np.shape(matches.column)
    rig.check(shape)
    disparity = np.stack([matches.column, matches.row], axis=-1, dtype=np.float32, casting="unsafe")
    # NaN in the arrays, not a mask: the kernel's sums become NaN by themselves where a pixel must not be used.
    disparity[~matches.usable] = np.nan
    std = np.full(shape, params.sigma_disparity) if matches.std is None else matches.std
    grey, std = (np.ascontiguousarray(a, np.float32) for a in (image, std))
    return Observed(disparity, std, grey, MAX_JUMP_PX, axes(rig))


def cameras_of(rig: Rig, T_local_left: RigidTransform) -> PairCameras:
    """Cameras of a rig in the frame of the lattice."""
    T_left_local = T_local_left.inverse()
    left = rig.left.matrix @ T_left_local.matrix34
    right = rig.right.matrix @ (rig.T_right_left @ T_left_local).matrix34
    sizes = np.array([rig.left.width, rig.left.height, rig.right.width, rig.right.height], dtype=np.float64)
    epipole = rig.right.matrix @ rig.T_right_left.translation
    return PairCameras(np.ascontiguousarray(left), np.ascontiguousarray(right), epipole, sizes)


def solve(seen: Observed, cameras: PairCameras, lattice: Lattice, z_range: tuple[float, float]) -> Dem:
    """Every cell of a lattice, coarse to fine: a few coarse cells search the whole ``z_range``, m."""

    def searched(cells: Cells) -> Dem:
        out = Dem(*np.full((3, *cells.low.shape), np.nan, np.float32))
        search(cells, z_range, cameras, seen, out)
        return out

    rows, cols, xs, ys = np.arange(lattice.rows), np.arange(lattice.cols), lattice.xs(), lattice.ys()
    # The last row and column as well, so that every cell lies between coarse ones.
    few, sparse = (np.unique(np.append(n[::COARSE_CELLS], n[-1])) for n in (rows, cols))
    low, high = (np.full((len(few), len(sparse)), z, np.float32) for z in z_range)
    padded = np.pad(searched(Cells(xs[sparse], ys[few], low, high)).elevation, 2, constant_values=np.nan)
    # Of the 4 x 4 coarse cells around; NaN gives way, since one known neighbour is enough to say where to search.
    around = np.lib.stride_tricks.sliding_window_view(padded, (4, 4))
    near = np.ix_(rows // COARSE_CELLS + 1, cols // COARSE_CELLS + 1)
    low, high = (extreme.reduce(around, axis=(2, 3))[near] for extreme in (np.fmin, np.fmax))
    return searched(Cells(xs, ys, low, high))


def join(a: Dem, b: Dem) -> Dem:
    """Elevations read from left to right and from right to left: their weighted mean where both are.

    Its variance is the product of both standard deviations (they share the images: no gain), plus the square of the
    difference. A cell of one direction alone lies mostly beside an occlusion: its standard deviation is doubled. The
    grey value is that of ``a``.
    """
    za, zb, sa, sb = (v.astype(np.float64) for v in (a.elevation, b.elevation, a.elevation_std, b.elevation_std))
    only_a = np.isfinite(za)
    both = only_a & np.isfinite(zb)
    share = sb**2 / (sa**2 + sb**2)
    z = np.where(both, zb + share * (za - zb), np.where(only_a, za, zb))
    # Errors of cells matched one way alone are two to three times as large.
    std = np.where(both, np.sqrt(sa * sb + (za - zb) ** 2), 2.0 * np.where(only_a, sa, sb))
    return Dem(z.astype(np.float32), std.astype(np.float32), a.ortho)
