"""Ways from a disparity map to an elevation model, behind one interface, with the same filters.

All of them take the same pixels: measured, matched back to within the same limit, in no bilinear cell with a jump
beyond Locus' own limit, within the same range of elevations; points, beside Locus, within half a pixel of the epipolar
line.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rille.stages.terrain.locus.solve import MAX_JUMP_PX, LocusParams
from rille.stages.terrain.locus.stage import MatchedPair, reconstruct
from rille.stages.terrain.matches import Matches

from .mesh import rasterise, without_jumps
from .scenes import Scene, pixels_of

Floats = NDArray[np.float64]
DEFAULT = LocusParams()
MAX_BACKMATCH_PX = 1.0
MAX_OFF_LINE_PX = 0.5


@dataclass(frozen=True)
class Model:
    """Elevations (row, col), metres, NaN unknown; ``doubt`` of each cell: what a filter may sort them by."""

    elevation: NDArray
    doubt: NDArray


@dataclass(frozen=True)
class Method:
    """``run(scene, max_backmatch, bounded)``; ``bounded``: with the limit on the geometry's error, one cell.

    ``what`` it is, in a line.
    """

    name: str
    run: Callable[[Scene, float, bool], Model]
    what: str


def locus(scene: Scene, max_backmatch: float, bounded: bool, *, images: bool = True) -> Model:
    """Cells first: :mod:`rille.stages.terrain.locus.stage`; ``images``: refined on the surface, as a run does it (not
    true disparities)."""
    params = DEFAULT.model_copy(update={"max_sigma": scene.max_sigma if bounded else None})
    d = scene.disparities
    right = scene.right if images and d.std is not None else None
    pair = MatchedPair(scene.left, Matches(d.column, d.row, d.usable(max_backmatch), d.std), right)
    dem = reconstruct(pair, scene.rig, scene.T_local_left, scene.lattice, scene.z_range, params)
    return Model(dem.elevation, dem.elevation_std)


def locus_alone(scene: Scene, max_backmatch: float, bounded: bool) -> Model:
    """Locus from the disparity alone, which is all that the other methods are given."""
    return locus(scene, max_backmatch, bounded, images=False)


@dataclass(frozen=True)
class Cloud:
    """Triangulated pixels: points (rows, cols, 3) of the surface's frame, which are kept, sigma of z, smooth quads."""

    points: Floats
    kept: NDArray[np.bool_]
    sigma: Floats
    quads: NDArray[np.bool_]


def triangulate(scene: Scene, max_backmatch: float, bounded: bool) -> Cloud:
    """Every usable pixel's point, by OpenCV's linear triangulation."""
    d, rig = scene.disparities, scene.rig
    usable = d.usable(max_backmatch)
    left = pixels_of(d.column.shape)[usable]
    right = left + np.stack([d.column, d.row], axis=-1)[usable]
    T_left_local = scene.T_local_left.inverse()
    P_left = rig.left.matrix @ T_left_local.matrix34
    P_right = rig.right.matrix @ (rig.T_right_left @ T_left_local).matrix34
    h = cv2.triangulatePoints(P_left, P_right, left.T, right.T)
    found = (h[:3] / h[3]).T
    good, sigma = _judge(scene, found, left, right, P_right)
    own = sigma * (DEFAULT.sigma_disparity if d.std is None else d.std[usable])
    good &= (found[:, 2] >= scene.z_range[0]) & (found[:, 2] <= scene.z_range[1])
    if bounded:
        good &= sigma * DEFAULT.sigma_disparity <= scene.max_sigma
    points, sigmas = np.full((*usable.shape, 3), np.nan), np.full(usable.shape, np.nan)
    points[usable], sigmas[usable] = found, own
    kept = usable.copy()
    kept[usable] = good
    quads = without_jumps(d.column, d.row, kept, MAX_JUMP_PX)
    return Cloud(points, kept & _corner_of(quads), sigmas, quads)


def _judge(
    scene: Scene, points: Floats, left: Floats, right: Floats, P_right: Floats
) -> tuple[NDArray[np.bool_], Floats]:
    """Whether each match is near its epipolar line, and metres of elevation that a pixel of disparity makes."""
    rig = scene.rig
    rays = rig.left.rays(left)
    R, t = rig.T_right_left.rotation, rig.T_right_left.translation
    epipole = rig.right.matrix @ t
    depth = scene.T_local_left.inverse().apply(points)[:, 2]
    e = right * epipole[2] - epipole[:2]
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    at = [(rays * (depth * k)[:, None]) @ (rig.right.matrix @ R).T + epipole for k in (1.0, 1.001)]
    near, far = (p[:, :2] / p[:, 2:] for p in at)
    off = right - near
    across = np.abs(off[:, 0] * e[:, 1] - off[:, 1] * e[:, 0])
    moved = np.abs(np.sum((far - near) * e, axis=1))
    rise = np.abs((rays @ scene.T_local_left.rotation.T)[:, 2]) * 0.001 * np.abs(depth)
    return (depth > 0) & (across <= MAX_OFF_LINE_PX), rise / np.maximum(moved, 1e-12)


def _corner_of(quads: NDArray[np.bool_]) -> NDArray[np.bool_]:
    out = np.zeros((quads.shape[0] + 1, quads.shape[1] + 1), bool)
    for part in (out[:-1, :-1], out[1:, :-1], out[:-1, 1:], out[1:, 1:]):
        part |= quads
    return out


def median_in_cell(scene: Scene, max_backmatch: float, bounded: bool) -> Model:
    """Triangulate and grid: the median elevation of a cell's points."""
    cloud = triangulate(scene, max_backmatch, bounded)
    points, sigma = cloud.points[cloud.kept], cloud.sigma[cloud.kept]
    lattice = scene.lattice
    index = np.rint(lattice.index(points[:, :2])).astype(np.intp)
    inside = ((index >= 0) & (index < lattice.shape)).all(axis=1)
    flat = index[inside, 0] * lattice.cols + index[inside, 1]
    z, sigma = points[inside, 2], sigma[inside]
    order = np.lexsort((z, flat))
    cells, start, count = np.unique(flat[order], return_index=True, return_counts=True)
    low, high = start + (count - 1) // 2, start + count // 2
    elevation, doubt = np.full(lattice.rows * lattice.cols, np.nan), np.full(lattice.rows * lattice.cols, np.nan)
    elevation[cells] = 0.5 * (z[order][low] + z[order][high])
    doubt[cells] = sigma[order][low] / np.sqrt(count)
    return Model(elevation.reshape(lattice.shape), doubt.reshape(lattice.shape))


def mesh(scene: Scene, max_backmatch: float, bounded: bool) -> Model:
    """Triangulate and mesh: the triangles between neighbouring pixels at the cells' centres, the highest one."""
    cloud = triangulate(scene, max_backmatch, bounded)
    elevation = rasterise(cloud.points, cloud.quads, scene.lattice)
    with_sigma = np.concatenate([cloud.points[..., :2], cloud.sigma[..., None]], axis=-1)
    return Model(elevation, rasterise(with_sigma, cloud.quads, scene.lattice))


def cars(scene: Scene, max_backmatch: float, bounded: bool, sigma_cells: float = 0.5) -> Model:
    """Triangulate, then CNES's rasteriser of CARS: mean of the points around, with Gaussian weights."""
    import rasterize

    cloud = triangulate(scene, max_backmatch, bounded)
    points, lattice = cloud.points[cloud.kept], scene.lattice
    x0, _, _, y1 = lattice.bounds
    sizes = (lattice.cols, lattice.rows, (lattice.cell,) * 2, 2 * sigma_cells, sigma_cells * lattice.cell)
    xy = np.ascontiguousarray(points[:, :2].T)
    values = np.ascontiguousarray([points[:, 2], cloud.sigma[cloud.kept]])
    found = rasterize.pc_to_dsm(xy, values, np.ones((1, len(points)), np.int32), x0, y1, *sizes)[0]
    elevation, doubt = np.moveaxis(found.reshape(*lattice.shape, 2), -1, 0)
    return Model(elevation, doubt)


def available() -> list[Method]:
    """Locus first, then triangulation with each way of gridding."""
    found = [
        Method("Locus", locus, "as a run does it: refined by both images (with true disparities: not refined)"),
        Method("Locus, disparity alone", locus_alone, "the same without the images: knows what the others know"),
        Method(
            "median in the cell",
            median_in_cell,
            "triangulate and grid: each pixel becomes a point, a cell has the median of the points in it",
        ),
        Method(
            "mesh", mesh, "triangulate and connect neighbouring pixels: the same bilinear surface that Locus samples"
        ),
    ]
    if importlib.util.find_spec("rasterize") is None:
        print("CARS' rasteriser is left out: not installed (pip install cars-rasterize)")
        return found
    return [
        *found,
        Method(
            "CARS, sigma 0.5 cells", cars, "triangulate, then CNES's rasteriser: Gaussian mean of the points around"
        ),
        Method("CARS, sigma 1 cell", lambda s, b, g: cars(s, b, g, 1.0), "the same, smoother"),
    ]
