"""Locus reconstruction: elevation model and ortho image straight from the disparity (paper, section 4.4).

The cells come first, not the image points: for each cell of a lattice the straight line perpendicular to it is
projected into both images (the left and right *locus*); the left locus, mapped through the disparity, meets the right
one at the elevation. Nothing is rectified and no point cloud is made: rows and columns are those of the original
images, for any orientation of the cameras. The kernel and its equations are in
:mod:`rille.stages.terrain.locus.kernel`; elevations are then refined by what both images show of the surface
(:mod:`rille.stages.terrain.locus.refinement`).

The disparity's part of an elevation's error is ``sigma_d / |ds/dZ|``, with the disparity's own standard deviation at
the pixel where the matcher gives one; :mod:`rille.stages.terrain.locus.uncertainty` has the other parts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rille.stages.core.arrays import Bools, Floats32
from rille.stages.core.declare import Bundle, Memory, raster, stage
from rille.stages.core.errors import ConfigError, DegenerateError
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.imaging import PyramidFacts
from rille.stages.facts.odometry import MovingFacts, TrajectoryFacts
from rille.stages.facts.terrain import DemFacts, GroundFacts
from rille.stages.geometry.geometry import Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.pose_arrays import REFERENCE_PLANE
from rille.stages.geometry.scale import coarser_focal
from rille.stages.geometry.spline import coefficients
from rille.stages.terrain.ground import PlaneView, view_ground, view_matches
from rille.stages.terrain.ground_frame import sampled
from rille.stages.terrain.ground_frame import z_range as plane_z_range
from rille.stages.terrain.locus.coverage import coverage, explain
from rille.stages.terrain.locus.kernel import Dem
from rille.stages.terrain.locus.refinement import refine
from rille.stages.terrain.locus.solve import LocusParams, cameras_of, join, observed, solve
from rille.stages.terrain.locus.uncertainty import HOLE_SIDE_CELLS, NEAR_SIDE_CELLS, standard_deviation
from rille.stages.terrain.locus.views import SurfaceViews, View, edge_on, facing
from rille.stages.terrain.matches import Matches

NO_LIMIT = {"max_sigma": None}


@dataclass(frozen=True)
class MatchedPair:
    """``left`` image (rows, cols), grey values, and the ``matches`` of its pixels; a cell needs all four usable
    disparities around its projection.

    ``right`` image, to refine the elevations with (:mod:`rille.stages.terrain.locus.refinement`); None: they stay those
    of the disparity. ``back``: matches of the right image, to read elevations from as well (:func:`join`); they need
    ``right``.
    """

    left: ArrayLike
    matches: Matches
    right: ArrayLike | None = None
    back: Matches | None = None


def reconstruct(
    pair: MatchedPair,
    rig: Rig,
    T_local_left: RigidTransform,
    lattice: Lattice,
    z_range: tuple[float, float],
    params: LocusParams,
) -> Dem:
    """Elevation and ortho image of every cell of a lattice.

    Parameters
    ----------
    T_local_left : pose of the left camera in the frame of the lattice.
    z_range : lowest and highest elevation searched, metres.
    params : thresholds, and ``sigma_disparity`` for matches without standard deviations; ``cell_size`` and
        ``extent`` are not used here.

    Returns
    -------
    Dem
        A cell is undefined where a camera does not see it, or sees it edge-on, where the disparity around it was not
        measured or jumps, or where its standard deviation is beyond :func:`greatest_std`.

    Raises
    ------
    InputError
        The disparity's shape differs from its camera's, or the baseline is zero.
    """
    image, right, back = pair.left, pair.right, pair.back
    cameras = cameras_of(rig, T_local_left)
    out = solve(observed(pair.matches, image, rig, params), cameras, lattice, z_range)
    apart = None
    if back is not None:
        assert right is not None
        # The same solver with the cameras exchanged: the right image's disparity is that of a rig whose left camera it
        # is.
        turned = Rig(rig.right, rig.left, rig.T_right_left.inverse())
        behind = cameras_of(turned, T_local_left @ turned.T_right_left)
        other = solve(observed(back, right, turned, params), behind, lattice, z_range)
        apart = out.elevation - other.elevation
        out = join(out, other)
    if right is not None and (params.refine_steps or back is not None):
        one, two = (View(P, coefficients(a)) for P, a in ((cameras.left, image), (cameras.right, right)))
        right_centre = (T_local_left @ rig.T_right_left.inverse()).translation
        seen = SurfaceViews(one, two, T_local_left.translation, right_centre)
        _refine(out, seen, lattice, params, apart)
    leave_out_unsure(out, greatest_std(params, pair.matches.std is not None))
    return out


def leave_out_unsure(dem: Dem, greatest: float | None) -> None:
    """Make the cells of a model undefined, in place, whose standard deviation exceeds ``greatest``, m; None: none."""
    if greatest is not None:
        # Negated, so that NaN is unsure as well.
        _leave_out(dem, ~(dem.elevation_std <= greatest))


def _leave_out(dem: Dem, cells: Bools) -> None:
    """Make cells of a model undefined, in place."""
    for array in dem:
        np.copyto(array, np.nan, where=cells)


def _refine(dem: Dem, views: SurfaceViews, lattice: Lattice, params: LocusParams, apart: Floats32 | None) -> None:
    """Refine a model in place: elevations, their standard deviations, grey values of the left image.

    ``apart``: (rows, cols) difference of both directions of matching, metres; None: there was one.
    """
    elevation, seen = refine(views, lattice, dem.elevation, params.refine_steps)
    moved = elevation - dem.elevation
    turned = facing(elevation, lattice, views.centre, NEAR_SIDE_CELLS)
    dem.elevation_std[...] = standard_deviation(elevation, seen, turned, moved, apart, dem.elevation_std)
    dem.elevation[...] = elevation
    dem.ortho[...] = np.clip(seen.left, 0.0, 255.0)
    _leave_out(dem, edge_on(turned, params.least_facing, HOLE_SIDE_CELLS))


def greatest_std(params: LocusParams, measured: bool) -> float | None:
    """Standard deviation of elevation, m, up to which a cell is accepted; None: any."""
    if params.max_sigma is None:
        return None
    # 1.4: a cell's own standard deviation scatters about the typical one.
    return 1.4 * params.max_sigma if measured else params.max_sigma


def local_lattice(view: PlaneView, cell: float, params: LocusParams) -> Lattice:
    """Lattice of a pair's local model: the stated extent, else the plane that both cameras see well enough."""
    if params.extent is not None:
        x_min, x_max, y_min, y_max = params.extent
        if not (x_min < x_max and y_min < y_max):
            raise ConfigError(
                "RIL-383", f"locus.extent={list(params.extent)} is empty", remedy="give x_min, x_max, y_min, y_max"
            )
        return Lattice.snap(params.extent, cell)
    assert params.max_sigma is not None
    return Lattice.snap(view.footprint(cell, params.max_range_cells, params.sigma_disparity, params.max_sigma), cell)


def _of_ground(rig: Rig, level: Mapping[str, Any]) -> PlaneView:
    """View of the ground of a pair."""
    return view_ground(rig, RigidTransform.from_matrix(level["T_local_left"]).rotation, level["plane"])


def _limited(params: LocusParams, reference: Mapping[str, Any], level: Mapping[str, Any], cell: float) -> LocusParams:
    """The parameters, with the largest standard deviation filled in from the scene where none is given.

    It is the cell. Where that is not given either, and suits the first pair (``reference``), a pair that is farther
    from its ground (``level``) may err by the cell that would suit it: in the merge its cells weigh as little.
    """
    own = level["cell_size"] if params.cell_size is None else 0.0
    return params.model_copy(update={"max_sigma": params.max_sigma or max(reference.get("max_sigma", 0.0), own, cell)})


def world_lattice(elevation: Floats32, lattice: Lattice, T_world_local: RigidTransform) -> tuple[Lattice, list[float]]:
    """Lattice and range of elevations in the world frame that hold a local elevation model.

    Raises
    ------
    DegenerateError
        The local model has no cell.
    """
    seen = np.isfinite(elevation)
    if not seen.any():
        raise DegenerateError(
            "RIL-384",
            "the local elevation model is empty",
            remedy="look at the disparity's validity and at locus.max_sigma",
        )
    points = T_world_local.apply(np.column_stack([lattice.xy()[seen], elevation[seen]]))
    low, high = points.min(axis=0), points.max(axis=0)
    # In the world the same ground lies on other cells, whose elevations may leave the local range by a little.
    margin = 0.05 * (high[2] - low[2]) + lattice.cell
    bounds = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    return Lattice.snap(bounds, lattice.cell), [float(low[2] - margin), float(high[2] + margin)]


def _lead_to(back: Matches, marked: Bools) -> Bools:
    """Which matched pixels of the right image (row, col) lead to marked ones of the left image (row, col)."""
    row, col = np.nonzero(back.usable)
    ends = row + np.asarray(back.row)[row, col], col + np.asarray(back.column)[row, col]
    near = tuple(np.rint(end).astype(np.intp).clip(0, n - 1) for end, n in zip(ends, marked.shape, strict=True))
    out = np.zeros(back.usable.shape, bool)
    out[row, col] = marked[near]
    return out


def _size(params: LocusParams, args: Mapping[str, Any], metas: Mapping[str, Any]) -> float:
    """Bytes of the model's arrays, three of float32, and as many for refining them."""
    if args["frame"] == "world":
        lattice = Lattice.from_dict(metas["local"]["lattice"])
    elif "no_ground" in metas["level"]:
        return 0.0
    else:
        level = metas["level"]
        cell = params.cell_size or metas.get("reference", level)["cell_size"]
        if level["source"] == REFERENCE_PLANE:
            lattice = Lattice.snap(params.extent or level["footprint"], cell)
        else:
            lattice = local_lattice(
                _of_ground(Rig.from_dict(metas["rig"]["rig"]), level), cell, _limited(params, level, level, cell)
            )
    return 24.0 * lattice.rows * lattice.cols


_FRAME = "local or world (meta: frame)"


class LocusInputs(NamedTuple):
    """Ports: ``disparity`` and images of the pair, its ``rig`` and reference plane (``level``), disparity of the right
    image (``back``), and the plane of the first pair (``reference``), whose cells serve all. In the world: the
    ``trajectory``, the pair's ``local`` model, and the pixels that are ``moving``, which are left out."""

    disparity: Bundle
    rig: Bundle[CalibrationFacts]
    left: Bundle[PyramidFacts]
    level: Bundle[GroundFacts]
    right: Bundle[PyramidFacts] | None = None
    back: Bundle | None = None
    reference: Bundle[GroundFacts] | None = None
    trajectory: Bundle[TrajectoryFacts] | None = None
    local: Bundle[DemFacts] | None = None
    moving: Bundle[MovingFacts] | None = None


@stage(
    "locus",
    outputs=[
        raster("elevation", "m", "elevation of the cell centre", frame=_FRAME),
        raster("elevation_std", "m", "standard deviation of the elevation", frame=_FRAME),
        raster("ortho", "grey", "grey value of the left image, 0..255", frame=_FRAME),
    ],
    memory=Memory(lower=("locus.cell_size", "locus.extent"), size=_size),
)
def locus_stage(params: LocusParams, inputs: LocusInputs, *, frame: str, pair: int, row: int = 0) -> Bundle[DemFacts]:
    """Elevation model and ortho image of a basic pair."""
    rig, level, trajectory = Rig.from_dict(inputs.rig.meta["rig"]), inputs.level.meta, inputs.trajectory
    T_local_left = RigidTransform.from_matrix(level["T_local_left"])
    matches = Matches.of(inputs.disparity)
    back = Matches.of(inputs.back) if inputs.back is not None else None
    if inputs.moving is not None:
        moving = np.asarray(inputs.moving["moving"]) != 0
        matches.usable[moving] = False
        if back is not None:
            back.usable[_lead_to(back, moving)] = False
    seen: PlaneView | None = None
    # One cell for the whole run: that which suits the first basic pair, where that pair is connected.
    reference = (inputs.reference or inputs.level).meta
    if frame == "world":
        assert trajectory is not None
        assert inputs.local is not None
        local = Lattice.from_dict(inputs.local.meta["lattice"])
        T = RigidTransform.from_matrix(np.asarray(trajectory["poses"])[row])
        lattice, z_range = world_lattice(np.asarray(inputs.local["elevation"]), local, T @ T_local_left.inverse())
        params = _limited(params, reference, level, local.cell)
    else:
        if level["plane"] is None or level["relief"] is None or ("no_ground" in level and params.cell_size is None):
            raise DegenerateError("RIL-780", f"no elevation model: {level['no_ground']}")
        cell = params.cell_size or reference["cell_size"]
        params = _limited(params, reference, level, cell)
        seen = view_matches(sampled(matches, rig, params.sigma_disparity), T_local_left)
        view = seen if level["source"] == REFERENCE_PLANE else _of_ground(rig, level)
        T, lattice = T_local_left, local_lattice(view, cell, params)
        z_range = plane_z_range(level["plane"], level["relief"], list(lattice.bounds))
    right = None if inputs.right is None else inputs.right["level_0"]
    matched, (low, high) = MatchedPair(inputs.left["level_0"], matches, right, back), z_range
    dem = reconstruct(matched, rig, T, lattice, (low, high), params.model_copy(update=NO_LIMIT))
    greatest = greatest_std(params, matches.std is not None)
    covered = None if seen is None else coverage(seen, dem, lattice, (low, high), greatest or math.inf, params)
    leave_out_unsure(dem, greatest)
    if not np.isfinite(dem.elevation).any():
        raise explain(rig, T, lattice, (low, high), matches.usable)
    meta: DemFacts = {
        "lattice": lattice.to_dict(),
        "frame": frame,
        "pair": pair,
        "z_range": z_range,
        "T_frame_left": T.to_list(),
        "pixel_rad": 1.0 / coarser_focal(rig),
        "defined": float(np.mean(np.isfinite(dem.elevation))),
        "median_elevation_std": float(np.nanmedian(dem.elevation_std)),
    }
    if level["source"] == REFERENCE_PLANE:
        meta["reference"] = REFERENCE_PLANE
    if covered is not None:
        meta["coverage"] = covered
    if trajectory is not None and "covariance" in trajectory.arrays:
        meta["pose_covariance"] = np.asarray(trajectory["covariance"])[row].ravel().tolist()
    return Bundle(dem._asdict(), meta)
