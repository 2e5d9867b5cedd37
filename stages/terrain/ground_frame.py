"""Vertical and reference plane of one basic pair: its local frame, without any pose of another frame.

The local frame of a basic pair has its origin at the left camera's centre, z up, y along the horizontal projection of
the optical axis (paper, sections 3.2 and 4.7: the local path is planned heading-aligned). The vertical comes from the
best source at hand: a measured attitude, the rig's stated pitch, else the ground plane that the disparity shows. The
ground plane is fitted in any case: it gives the range of elevations that Locus searches.

A trajectory needs neither. Where no ground is seen (unless ``reference_height`` states it) and nothing gives the
vertical either, the local frame is that of the camera: its own up is z.

Elevations of scenes without ground (walls, views straight down) are distances from another *reference plane*: the
dominant plane of the matched points, or a stated one. The local frame is then that plane's: z = 0 on it, z along its
normal towards the camera, x the right of the image. All that reads elevations works on it as it does on ground.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Bundle, Params, stage
from rille.stages.core.errors import DegenerateError, InputError
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.terrain import GroundFacts
from rille.stages.geometry.epipolar import inverse_depth
from rille.stages.geometry.geometry import Rig, RigidTransform, level_rotation
from rille.stages.geometry.pose_arrays import GROUND_PLANE, NO_VERTICAL, REFERENCE_PLANE
from rille.stages.geometry.scale import coarser_focal
from rille.stages.geometry.sides import refuse_impossible
from rille.stages.terrain.ground import (
    MIN_POINTS,
    CoarseGroundError,
    GroundPlane,
    NoGroundError,
    Samples,
    fit_plane,
    rounded_cell,
    view_ground,
    view_matches,
)
from rille.stages.terrain.matches import Matches
from rille.stages.terrain.points import MIN_DEPTH_SIGMAS
from rille.stages.terrain.reference import MIN_MATCHED_BELOW, MIN_REACH_HEIGHTS, MIN_REFERENCE_SHARE

SCENE = "scene"
"""Instead of a stated reference plane: the scene's own."""

HANGING = (
    "what looks like ground lies above the cameras: are the images of both mirrored top to bottom, which mirrors the "
    "world, or upside down (then turn them by 180 degrees and exchange left and right, or state world.up), has a "
    "stated vertical the wrong sign, or is it a ceiling?"
)

UPRIGHT = np.array([0.0, -1.0, 0.0])
"""Up in the frame of a camera whose vertical is not known."""

RELIEF_MARGIN_SHARE = 0.05  # of the camera's height, that the range of elevations is widened by: a low rock, a kerb
DEFAULT_RANGE_CELLS = 6.0  # of the footprint in meta; the stage locus has its own parameter
MIN_DOMINANT_SHARE = 0.3  # of the matches, from which a plane may be the reference, though tilted beyond the limits


class GroundFrameParams(Params):
    """Parameters of the stage ``ground_frame``.

    Attributes
    ----------
    reference_height : depth [m] of a plane below the camera that stands for ground which is not seen.
    sigma_disparity : standard deviation of a disparity [pixels].
    """

    reference_height: float | None = Field(None, gt=0)
    sigma_disparity: float = Field(0.2, gt=0)


Surface = tuple[list[float], list[float], list[float]]
"""Plane, relief and footprint, as :class:`~rille.stages.facts.terrain.GroundFacts` has them."""


class VerticalHint(NamedTuple):
    """Given sources of the vertical; the first that is not None is used.

    ``up`` (3,) direction of up in the left camera frame, from an attitude; ``pitch`` downward pitch of the optical
    axis, radians, roll 0.
    """

    up: ArrayLike | None = None
    pitch: float | None = None


def level(
    matches: Matches,
    rig: Rig,
    params: GroundFrameParams,
    vertical: VerticalHint | None = None,
    reference: str | Sequence[float] | None = None,
) -> GroundFacts:
    """Local frame and reference plane of one pair.

    Parameters
    ----------
    matches : of the left image.
    vertical : None: it is that of the ground.
    reference : None: the ground; :data:`SCENE`: the scene's own plane; otherwise normal and point (6,) of a plane in
        the left camera's frame, m.

    Raises
    ------
    DegenerateError
        Left and right seem swapped, or the rig has no baseline.
    """
    samples = sampled(matches, rig, params.sigma_disparity)
    if reference is not None:
        try:
            return _on_reference(reference, samples)
        except NoGroundError as error:
            facts = _facts(RigidTransform.identity(), REFERENCE_PLANE, _cell_without_ground(samples, rig))
            return {**facts, "no_ground": str(error)}
    known_up, source = _given_vertical(vertical or VerticalHint())
    rays, rho, ground = samples.rays, samples.rho, None
    try:
        ground = fit_plane(samples, lambda n: _allowed(n, known_up))
        R_local_left = level_rotation(ground.up if known_up is None else known_up)
        return _on_ground(ground, R_local_left, samples, rig, source or GROUND_PLANE)
    except DegenerateError as error:
        below = _matched_below(matches, rig, UPRIGHT if known_up is None else known_up)
        why, other = _explained(error, samples, ground, below)
    up = UPRIGHT if known_up is None else known_up
    # No ground is seen: odometry, which needs none, still gets a frame.
    source, R_local_left = source or NO_VERTICAL, level_rotation(up)
    try:
        if params.reference_height is not None:
            stated = GroundPlane(up, params.reference_height)
            return _on_ground(stated, R_local_left, samples, rig, source)
    except DegenerateError as error:
        why = error
    facts = _facts(RigidTransform(R_local_left, np.zeros(3)), source, _cell_without_ground(samples, rig))
    facts["no_ground"], facts["matched_below"] = str(why), below
    if other is not None:
        facts["other_up"] = other.up.tolist()
    if known_up is not None:
        with suppress(DegenerateError):
            # The images may show ground where the given vertical has none: then one of the two is wrong.
            facts["seen_up"] = fit_plane(samples, lambda n: _allowed(n, None)).up.tolist()
    if ground is not None and isinstance(why, CoarseGroundError) and ground.inliers >= MIN_DOMINANT_SHARE:
        # Larger cells than those that suit the rig may still make a map.
        plane, everywhere = _local_plane(ground, R_local_left), [-math.inf, math.inf] * 2
        points = (rays[rho > 0] / rho[rho > 0, None]) @ R_local_left.T
        facts["plane"], facts["relief"] = plane, _relief(points, plane, everywhere, ground.height)
        facts["ground_share"], facts["ground_reach"] = ground.inliers, ground.reach
    return facts


def _hangs(samples: Samples, up: Floats) -> bool:
    """Whether a plane above the cameras, ``up`` (3,) being the vertical in their frame, would be ground by itself."""
    with suppress(DegenerateError):
        # cos 45 degrees: beyond, cameras look at the plane rather than along it, as backwards down from a drone.
        plane = fit_plane(samples, lambda n: np.asarray(n @ up <= -0.7))
        # 0.1: of the matches; crowns and eaves of a street make far planes above the cameras that hold 0.05 to 0.07.
        far = plane.reach >= MIN_REACH_HEIGHTS and plane.inliers >= 0.1
        return plane.inliers >= MIN_REFERENCE_SHARE or far
    return False


def _matched_below(matches: Matches, rig: Rig, up: Floats) -> float:
    """Share of matched pixels in the lowest quarter of the left image, where ground is seen first."""
    usable = matches.usable[::4, ::4]
    row, col = 4.0 * np.indices(usable.shape).reshape(2, -1)
    rays = rig.left.rays(np.stack([col, row], axis=-1))
    height = rays @ up / np.linalg.norm(rays, axis=1)
    return float(usable.ravel()[height <= np.quantile(height, 0.25)].mean())


def _explained(
    error: DegenerateError, samples: Samples, ground: GroundPlane | None, below: float
) -> tuple[DegenerateError, GroundPlane | None]:
    """Why there is no ground, or none that is seen well enough, with the remedy of that cause; and the other plane that
    dominates, None where none does. ``below``: share of matched pixels where ground is seen first."""
    if not isinstance(error, NoGroundError) or (ground is not None and ground.inliers >= MIN_DOMINANT_SHARE):
        return error, None
    try:
        seen = fit_plane(samples, lambda n: np.ones(len(n), dtype=bool))
    except DegenerateError:
        seen = None
    if seen is None or seen.inliers < MIN_DOMINANT_SHARE:
        seen, message = None, error.message
        remedy = "where the ground is a known surface, state its depth by ground_frame.reference_height"
    else:
        up = ", ".join(f"{v + 0.0:.2f}" for v in seen.up)
        message = f"{error.message}; the plane that it shows has its normal at [{up}] in the camera's frame"
        remedy = "if that is the ground, state it as world.up in a manifest"
    if below < MIN_MATCHED_BELOW:
        message += f"; {below:.0%} of the lowest quarter of the left image is matched"
        remedy = f"look there at both images (dirt or drops on a lens, a torn part, glare, no texture); {remedy}"
    return DegenerateError(error.code, message, remedy=remedy), seen


def _on_ground(ground: GroundPlane, R_local_left: Floats, samples: Samples, rig: Rig, source: str) -> GroundFacts:
    """Result of :func:`level` for a pair whose ground plane is known."""
    plane = _local_plane(ground, R_local_left)
    view = view_ground(rig, R_local_left, plane)
    cell = view.cell_size()
    try:
        footprint = view.footprint(cell, DEFAULT_RANGE_CELLS, samples.sigma_px, cell)
    except CoarseGroundError:
        # Of a short baseline or from high above: what is known to be level is ground, in cells that the depths allow.
        if source == GROUND_PLANE:
            raise
        cell = max(cell, view.sure_cell(samples.sigma_px))
        footprint = view.footprint(cell, DEFAULT_RANGE_CELLS, samples.sigma_px, cell)
    points = (samples.rays / np.maximum(samples.rho, 1e-12)[:, None]) @ R_local_left.T
    relief = _relief(points[samples.rho > 0], plane, footprint, ground.height)
    facts = _facts(RigidTransform(R_local_left, np.zeros(3)), source, cell, (plane, relief, footprint))
    facts["ground_share"], facts["ground_reach"] = ground.inliers, ground.reach
    return facts


def scene_plane(samples: Samples) -> GroundPlane:
    """The plane that the scene lies on, if one dominates it and is not seen along itself; else across the view.

    Across the view, elevations are a depth map: whatever the scene is, each matched pixel has its own place there.
    """
    rays, rho = samples.rays, samples.rho
    view = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
    with suppress(NoGroundError):
        # A plane that is seen along itself makes no map.
        plane = fit_plane(samples, lambda n: np.asarray(-n @ view >= math.cos(math.radians(65.0))))
        if plane.inliers >= MIN_DOMINANT_SHARE:
            return plane
    return GroundPlane(np.array([0.0, 0.0, -1.0]), 1.0 / max(float(np.median(rho)), 1e-9))


def stated_plane(reference: Sequence[float]) -> GroundPlane:
    """The plane with a normal through a point (6,) of the left camera's frame, the normal turned to the camera."""
    normal, point = np.array(reference[:3], dtype=np.float64), np.array(reference[3:], dtype=np.float64)
    length = float(np.linalg.norm(normal))
    height = -float(normal @ point) / length if length > 0 else 0.0
    if height == 0.0:
        raise InputError(
            "RIL-379",
            f"no plane with normal {list(reference[:3])} through {list(reference[3:])} m of the camera's frame is "
            "seen from the camera, which lies on it",
            remedy="set terrain.reference to [normal x, y, z, point x, y, z] (x right, y down, z ahead)",
        )
    return GroundPlane(math.copysign(1.0, height) * normal / length, abs(height))


def _on_reference(reference: str | Sequence[float], samples: Samples) -> GroundFacts:
    if not len(samples.rays):
        remedy = "`rille check` says more of the images, and of the maps of [disparity] if there are any"
        raise NoGroundError("RIL-385", "no pixel is matched, so no surface is seen", remedy=remedy)
    return _on_plane(scene_plane(samples) if isinstance(reference, str) else stated_plane(reference), samples)


def _on_plane(reference: GroundPlane, samples: Samples) -> GroundFacts:
    """Result of :func:`level` for a pair whose reference plane is no ground."""
    z = reference.up
    # Along the plane, right in the image; for a plane that holds that direction's normal alone, along the optical axis.
    right = np.eye(3)[0 if abs(z[0]) < 0.9 else 2]
    x = (right - (right @ z) * z) / np.linalg.norm(right - (right @ z) * z)
    T_local_left = RigidTransform(np.array([x, np.cross(z, x), z]), np.array([0.0, 0.0, reference.height]))
    view = view_matches(samples, T_local_left)
    if not len(view.slant):
        remedy = "let the images show what is nearer, use a longer baseline, or check the baseline's unit"
        raise NoGroundError(
            "RIL-392", "all matches may as well be infinitely far: no surface can be measured", remedy=remedy
        )
    cell = rounded_cell(float(np.median(np.sqrt(view.along * view.across))))
    # A match so uncertain has a hundredth of the median one's weight.
    max_sigma = float(f"{10.0 * np.median(samples.sigma_px / view.slope):.2g}")
    footprint = view.footprint(cell, DEFAULT_RANGE_CELLS, samples.sigma_px, max_sigma)
    relief = _spread(view.xyz, [0.0, 0.0, 0.0], footprint, RELIEF_MARGIN_SHARE * reference.height)
    facts = _facts(T_local_left, REFERENCE_PLANE, cell, ([0.0, 0.0, 0.0], relief, footprint))
    facts["max_sigma"], facts["ground_share"] = max_sigma, reference.inliers
    return facts


def _facts(T_local_left: RigidTransform, source: str, cell: float, surface: Surface | None = None) -> GroundFacts:
    """Facts of a pair on its reference plane; without one: where no ground is seen."""
    plane, relief, footprint = surface or (None, None, None)
    return {
        "T_local_left": T_local_left.to_list(),
        "source": source,
        "plane": plane,
        "relief": relief,
        "cell_size": cell,
        "footprint": footprint,
        "ground_share": 0.0,
    }


def _cell_without_ground(samples: Samples, rig: Rig) -> float:
    """Cell size, m: a pixel at twice the nearest distance."""
    rho = samples.rho[samples.rho > MIN_DEPTH_SIGMAS * samples.sigma]
    # Without any match, 20 baselines stand for the distance.
    # A twentieth of the points may be nearer than the nearest distance: gross mismatches.
    near = 1.0 / float(np.quantile(rho, 0.95)) if rho.size else 20.0 * rig.baseline
    return rounded_cell(2.0 * near / coarser_focal(rig))


def z_range(plane: list[float], relief: list[float], extent: list[float]) -> list[float]:
    """Lowest and highest elevation, m, of a plane with relief over an extent x_min, x_max, y_min, y_max."""
    corners = [plane[2] + plane[0] * x + plane[1] * y for x in extent[:2] for y in extent[2:]]
    return [min(corners) + relief[0], max(corners) + relief[1]]


def sampled(matches: Matches, rig: Rig, sigma_px: float) -> Samples:
    """Samples at a regular sparse grid of usable pixels; ``sigma_px``: standard deviation of a disparity."""
    column, row, usable = np.asarray(matches.column), np.asarray(matches.row), matches.usable
    rig.check(column.shape)
    # Some 5000 of them: three parameters need no more.
    step = max(1, int(math.sqrt(column.size / 10_000)))
    r, c = np.nonzero(usable[::step, ::step])
    r, c = r * step, c * step
    pixels = np.stack([c, r], axis=-1).astype(np.float64)
    disparity = np.stack([column[r, c], row[r, c]], axis=-1).astype(np.float64)
    rho, per_pixel = inverse_depth(rig, pixels, disparity)
    sigma = per_pixel * sigma_px
    if len(pixels) >= MIN_POINTS:
        # Before the ground is fitted: exchanged images show none, and that message would mislead.
        refuse_impossible(rig, pixels, pixels + disparity, float(np.mean(rho < -MIN_DEPTH_SIGMAS * sigma)))
    return Samples(rig.left.rays(pixels), rho, sigma, sigma_px, coarser_focal(rig))


def _given_vertical(hint: VerticalHint) -> tuple[Floats | None, str]:
    up, pitch = hint
    if up is not None:
        v = np.asarray(up, dtype=np.float64)
        length = float(np.linalg.norm(v))
        if v.shape != (3,) or not math.isfinite(length) or length == 0.0:
            text = f"the attitude's direction of up {up} is no direction"
            raise InputError("RIL-378", text, remedy="give three numbers")
        return v / length, "attitude"
    if pitch is not None:
        return np.array([0.0, -math.cos(pitch), -math.sin(pitch)]), "pitch"
    return None, ""


def _allowed(normals: Floats, vertical: Floats | None) -> Bools:
    """Which normals may be the ground's: near the known vertical, else within the limits of roll and pitch."""
    # 30.0 degrees: largest slope of the ground, and largest roll of an unknown attitude.
    tilt = math.radians(30.0)
    if vertical is not None:
        return np.asarray(normals @ vertical >= math.cos(tilt))
    pitch = np.degrees(np.arctan2(-normals[:, 2], -normals[:, 1]))
    level_enough = np.abs(normals[:, 0]) <= math.sin(tilt)
    # Degrees: downward pitch of a rig whose attitude is unknown.
    return np.asarray(level_enough & (pitch >= -20.0) & (pitch <= 75.0))


def _local_plane(ground: GroundPlane, R_local_left: Floats) -> list[float]:
    n = R_local_left @ ground.up
    return [float(-n[0] / n[2]), float(-n[1] / n[2]), float(-ground.height / n[2])]


def _relief(points: Floats, plane: list[float], extent: list[float], height: float) -> list[float]:
    """Robust lowest and highest terrain against the plane within the extent, metres, as far as ground reaches."""
    low, high = _spread(points, plane, extent, RELIEF_MARGIN_SHARE * height)
    # Below, nothing is known that deep but mismatches; two heights above, walls and crowns.
    return [max(low, -height), min(high, 2.0 * height)]


def _spread(points: Floats, plane: list[float], extent: list[float], margin: float) -> list[float]:
    """Robust lowest and highest point against the plane within the extent, m, at least ``margin``, widened by a tenth
    and as much again."""
    x, y, z = points.T
    inside = (x >= extent[0]) & (x <= extent[1]) & (y >= extent[2]) & (y <= extent[3])
    above = z - (plane[2] + plane[0] * x + plane[1] * y)
    low, high = -margin, margin
    if np.count_nonzero(inside) >= 20:
        # Quantiles, not extremes: of thousands of matches some are gross.
        q = np.quantile(above[inside], [0.005, 0.995])
        low, high = min(low, float(q[0])), max(high, float(q[1]))
    more = 0.1 * (high - low) + margin
    return [low - more, high + more]


@stage("ground_frame")
def ground_frame_stage(
    params: GroundFrameParams,
    disparity: Bundle,
    rig: Bundle[CalibrationFacts],
    *,
    up: Sequence[float] | None = None,
    pitch: float | None = None,
    reference: str | Sequence[float] | None = None,
    why: str | None = None,
) -> Bundle[GroundFacts]:
    """Vertical and reference plane of a basic pair; ``why``: the reason for a reference that is no ground."""
    given, matches, hint = Rig.from_dict(rig.meta["rig"]), Matches.of(disparity), VerticalHint(up, pitch)
    facts = level(matches, given, params, hint, reference)
    if why is not None:
        facts["why"] = why
    surely = facts["ground_share"] >= MIN_REFERENCE_SHARE or facts.get("ground_reach", 0.0) >= MIN_REACH_HEIGHTS
    if reference is None and not surely:
        samples, known = sampled(matches, given, params.sigma_disparity), _given_vertical(hint)[0]
        if _hangs(samples, UPRIGHT if known is None else known):
            facts |= {"warnings": [HANGING], **({} if known is None else {"contradiction": HANGING})}
    return Bundle({}, facts)
