"""Two motions in view: choice of the camera's, and landmarks that move by themselves.

Landmarks of a vehicle ahead, of a passing lorry, or of the own body agree with another pose than those of the scene.
The scene is the part that lies mostly beside the other in the image, and goes on behind it. If that holds of neither,
the images do not show which of the two is at rest, and the frame has no pose.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.errors import DegenerateError
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.odometry.resection.landmarks import SegmentPoints
from rille.stages.odometry.resection.pnp import Observations, Pose, back_projection
from rille.stages.odometry.resection.robust_pose import MIN_LANDMARKS, Resection, ResectParams, resect

CONTRADICTION = 2.0
"""Times the threshold from which on a landmark surely does not move as a pose says."""
BODY_SHARE = 0.1
"""The same where the landmarks that do not move in the image are all nearer, as the vehicle's own body is."""


class AmbiguousError(DegenerateError):
    """Two motions have large support, and the landmarks do not show which is the camera's."""


class _Part(NamedTuple):
    """Landmarks that agree with one pose: rows in use, pixels, distances in the key frame (m); and that pose."""

    rows: NDArray[np.intp]
    pixels: Floats
    depth: Floats
    pose: Resection


def moving_by_themselves(
    points: SegmentPoints, j: int, trusted: Bools, posed: Resection, params: ResectParams, frame: int
) -> NDArray[np.intp]:
    """Rows of the landmarks that move otherwise than the scene, where many do; none where nearly all have one motion.

    Landmarks that fit both poses, as those at infinity, speak for neither.

    Parameters
    ----------
    j : place of the frame in the segment.
    trusted : which points (n,) do not move by themselves, as far as is known; ``posed`` is of those that are seen.

    Raises
    ------
    AmbiguousError
        Two motions have large support, and of neither the place says that it is the scene.
    """
    camera, key = points.camera, points.T_local_key
    # Of all that were seen: those at rest in the image stay in view while the others leave it.
    seen = points.known()[:, 1 : j + 1] & trusted[:, None]
    total, use = int(seen.any(1).sum()), np.flatnonzero(seen[:, -1])
    known, pixels = points.landmarks.take(use), points.tracks[use, j].astype(np.float64)
    observed = Observations(known, pixels, camera, params.pixel_sigma)

    def contradict(pose: Resection) -> Bools:
        errors = back_projection(observed, Pose.of(pose.T_local_left.inverse()))
        return errors.norm > CONTRADICTION * params.threshold / params.pixel_sigma

    left = np.flatnonzero(contradict(posed))
    if len(left) < max(MIN_LANDMARKS, BODY_SHARE * total):
        return left[:0]
    try:
        # A part of the view that does not move in the image has the key's pose.
        other = resect(known.take(left), pixels[left], camera, [posed.T_local_left, key], params, frame)
    except DegenerateError:
        return left[:0]
    before = key.inverse().apply(known.position)
    shift = np.sqrt(((camera.project(before) - pixels) ** 2).sum(1))
    rows = np.flatnonzero(posed.inlier), left[other.inlier]
    if len(rows[1]) < BODY_SHARE * total:
        return left[:0]
    parts = [_Part(at, pixels[at], before[at, 2], pose) for at, pose in zip(rows, (posed, other), strict=True)]
    still, moving = sorted(parts, key=lambda part: float(np.median(shift[part.rows])))
    stays = bool(np.median(shift[still.rows]) < 0.5)
    body = stays and bool(np.quantile(still.depth, 0.9) < np.quantile(moving.depth, 0.1))
    for scene, rest in (parts, parts[::-1]):
        alone = rest.rows[contradict(scene.pose)[rest.rows]]
        if len(alone) and _is_scene(scene, pixels[alone], before[alone, 2]):
            return use[alone]
    # The smaller part may be all that shows the motion only where the larger one is the vehicle itself.
    # 0.2: share of the landmarks from which on a second motion puts the first in doubt: a vehicle ahead has less.
    if len(parts[1].rows) < (BODY_SHARE if body and still.pose is posed else 0.2) * total:
        return left[:0]
    raise _ambiguity((still, moving), key, total, stays=stays, body=body)


def _ambiguity(
    parts: tuple[_Part, _Part], key: RigidTransform, total: int, *, stays: bool, body: bool
) -> AmbiguousError:
    """The error in words: of the part that moves less in the image, and of the other, among ``total`` landmarks.

    ``stays``: the former does not move in the image; ``body``: it is nearer than all of the other.
    """
    moved = [float(np.linalg.norm(part.pose.T_local_left.translation - key.translation)) for part in parts]
    counts = [len(part.rows) for part in parts]
    return AmbiguousError(
        "RIL-770",
        f"two motions: {counts[0]} of {total} landmarks ({counts[0] / total:.0%}) "
        f"{'do not move in the image' if stays else f'moved by {moved[0]:.3g} m'}, "
        f"{counts[1]} ({counts[1] / total:.0%}) moved by {moved[1]:.3g} m",
        remedy="the still ones are the nearest: cut the vehicle's own body off the images, or mask it"
        if body
        else "leave out frames in which the camera stood, or mask what moves with it or repeats along the way (a fence)"
        if stays
        else (
            "mask what moves by itself, or what repeats along the way (sleepers, tiles); if both are nearly alike, "
            "rows may not be of one time (a rolling shutter on a mount that vibrates)"
        ),
    )


def _is_scene(part: _Part, pixels: Floats, depth: Floats) -> bool:
    """Whether most of a part lies beside the rest in the image, and goes on behind it.

    ``pixels`` (n, 2) and ``depth`` (n,), m, of those of the rest that contradict the part's pose.
    """
    left, right = np.quantile(pixels[:, 0], (0.05, 0.95))
    beside = float(np.mean((part.pixels[:, 0] < left) | (part.pixels[:, 0] > right)))
    # 1.5: times the distance of the far landmarks of what moves that the scene's far ones have; with that lorry 5 to 7.
    behind = np.quantile(part.depth, 0.9) > 1.5 * np.quantile(depth, 0.9)
    # 0.5: share of its landmarks that the scene has in columns of the image beside what moves; with a lorry before the
    # camera 0.7 to 0.9, of parts that lie about alike 0.1.
    return bool(behind) and beside >= 0.5
