"""Error of the intrinsics that both cameras share, from the contributions of all adjusted segments.

A wrong focal length stretches what a stereo pair sees along the optical axis, a wrong principal point shears it. A
straight drive shows neither. Where the camera turns, it sees the same points stretched along another axis, which no
motion explains. Each segment gives the change of its adjustment's cost with each number, its landmarks triangulated and
its tracks undistorted anew; all segments together give the error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.odometry import IntrinsicsFacts, RefineFacts
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.geometry.lens import Lens
from rille.stages.numeric.robust import huber_weight, mad_sigma
from rille.stages.odometry.resection.bundle_adjustment import RefineParams, SegmentState, SegmentTracks, adjust
from rille.stages.odometry.resection.landmarks import triangulated

NAMES = ("focal length", "principal point's column", "principal point's row")

STEP = 0.01
"""Change of each number by which the cost is differentiated, over the focal length, as all errors here."""

MAX_MOVE, MAX_ERROR, MAX_MOVES = 0.03, 0.2, 8
"""Largest move towards a segment's own minimum, largest error over the focal length, and number of moves: far from its
minimum the cost is no parabola."""

MIN_TURN_DEG = 4.0
"""Turn of a segment from which on it counts: errors that all tracks share hide what smaller ones show."""

MIN_SEGMENTS = 3
"""Segments that turn, below which nothing is said."""

MIN_ERROR = 0.0175
"""Error over the focal length up to which calibrations pass for good: what remains of lens distortion looks like it."""

MIN_SIGMAS = 5.0
"""Standard deviations from which on an error is stated."""


class SegmentCameras(NamedTuple):
    """Rig of a segment, its key's pose, and by the camera's name the lenses of images that were undistorted."""

    rig: Rig
    lenses: Mapping[str, Lens]
    T_local_key: RigidTransform


def changed(camera: Camera, name: str, by: float) -> Camera:
    """Camera with another focal length or principal point, by a share of the focal length."""
    if name == NAMES[0]:
        return replace(camera, fx=camera.fx * (1.0 + by), fy=camera.fy * (1.0 + by))
    if name == NAMES[1]:
        return replace(camera, cx=camera.cx + by * camera.fx)
    return replace(camera, cy=camera.cy + by * camera.fy)


def with_change(views: SegmentTracks, cameras: SegmentCameras, name: str, by: float) -> SegmentTracks:
    """Measurements as they would be if both cameras had another number."""
    rig, T_local_key = cameras.rig, cameras.T_local_key
    other = replace(rig, left=changed(rig.left, name, by), right=changed(rig.right, name, by))

    def undistorted_anew(pixels: Floats, side: str, given: Camera, ideal: Camera) -> Floats:
        if (lens := cameras.lenses.get(side)) is None:
            return pixels
        raw = lens.distort(np.nan_to_num(pixels).reshape(-1, 2), given)
        again = replace(lens, camera=changed(lens.camera, name, by))
        return again.undistort(raw, ideal).reshape(pixels.shape)

    key = T_local_key.inverse().apply(views.position)
    left = undistorted_anew(rig.left.project(key), "left", rig.left, other.left)
    right = undistorted_anew(rig.right.project(rig.T_right_left.apply(key)), "right", rig.right, other.right)
    at = triangulated(left, right, other, T_local_key, views.sigma)
    pixels = undistorted_anew(views.pixels, "left", rig.left, other.left)
    return replace(views, position=at.position, along=at.per_pixel, pixels=pixels, camera=other.left)


def contribution(
    views: SegmentTracks, state: SegmentState, cameras: SegmentCameras, params: RefineParams
) -> list[tuple[float, float]]:
    """Information and pull of the error of each of :data:`NAMES` by an adjusted segment, all its unknowns free.

    Both are those of the parabola at the segment's own minimum; 0 where the segment turns too little.
    """
    turns = scipy.spatial.transform.Rotation.from_matrix(state.R @ cameras.T_local_key.rotation).magnitude()
    if turns.max() < math.radians(MIN_TURN_DEG):
        return [(0.0, 0.0)] * len(NAMES)

    def parabola(name: str, by: float) -> tuple[float, float]:
        """Second derivative of the cost by an error, and minus the first, at an error."""
        three = [with_change(views, cameras, name, by + step) for step in (-STEP, 0.0, STEP)]
        finite = [np.isfinite(v.position).all(1) & np.isfinite(v.pixels).all(2) for v in three]
        seen = views.seen & np.all(finite, axis=0)
        below, at, above = (adjust(replace(v, seen=seen), state, params).after for v in three)
        return (below - 2.0 * at + above) / STEP**2, (below - above) / (2.0 * STEP)

    parts = []
    for name in NAMES:
        by = 0.0
        for _ in range(MAX_MOVES):
            information, pull = parabola(name, by)
            move = pull / information if information > 0 else math.copysign(MAX_MOVE, pull)
            if abs(move) <= MAX_MOVE or abs(by) > MAX_ERROR:
                break
            by += math.copysign(MAX_MOVE, move)
        parts.append((information, information * by + pull))
    return parts


def common_error(parts: Floats) -> tuple[float, float]:
    """Error that all segments share and its standard deviation, infinite of too few segments.

    The segments' own values scatter by more than their errors, for their landmarks are few and near each other; the
    scatter decides.

    Parameters
    ----------
    parts : (segment, 2) information and pull of each.
    """
    # Rounding leaves a segment that tells nothing with no or negative information.
    parts = parts[parts[:, 0] > 0]
    if len(parts) < MIN_SEGMENTS:
        return 0.0, float("inf")
    claimed, value = parts[:, 0], parts[:, 1] / parts[:, 0]
    information = claimed
    for _ in range(5):  # of a segment that is far off, no more than of one at two deviations
        error = float((information * value).sum() / information.sum())
        off = np.abs(value - error) * np.sqrt(claimed)
        # At least what the segments claim: few of them may agree by chance.
        spread = max(1.0, mad_sigma(off, 0.0))
        information = claimed * huber_weight(off, 2.0 * spread)
    return error, spread * float(information.sum()) ** -0.5


def contradiction(errors: Sequence[tuple[float, float]], focal: float) -> str:
    """One line on the numbers of :data:`NAMES` that the tracks contradict; empty where they contradict none.

    Where the camera turns about one axis, one wrong number looks like another one: all that it may be are named.

    Parameters
    ----------
    errors : of each, with its standard deviation, over the focal length.
    focal : focal length, pixels.
    """
    wrong = []
    for name, (error, sigma) in zip(NAMES, errors, strict=True):
        if abs(error) > max(MIN_ERROR, MIN_SIGMAS * sigma):
            scale, unit = (100.0, "%") if name == NAMES[0] else (focal, "px")
            wrong.append(f"the {name} by some {scale * error:+.2g} +- {scale * sigma:.1g} {unit}")
    if not wrong:
        return ""
    return (
        "the tracks contradict the calibration of both cameras: where the camera turns they ask for another one, "
        f"{' or '.join(wrong)}; scale and heading are wrong: calibrate anew"
    )


@stage("intrinsics")
def intrinsics_stage(
    params: NoParams, segments: Sequence[Bundle[RefineFacts]], rig: Bundle[CalibrationFacts]
) -> Bundle[IntrinsicsFacts]:
    """Errors of the intrinsics that the tracks of all segments show."""
    parts = np.array([segment.meta["intrinsics"] for segment in segments if segment.meta["intrinsics"]])
    if len(parts) < MIN_SEGMENTS:
        return Bundle({}, {})
    errors = [common_error(parts[:, k]) for k in range(len(NAMES))]
    facts: IntrinsicsFacts = {"intrinsics": dict(zip(NAMES, errors, strict=True))}
    if line := contradiction(errors, Rig.from_dict(rig.meta["rig"]).left.fx):
        facts |= {"contradiction": line, "warnings": [line]}
    return Bundle({}, facts)
