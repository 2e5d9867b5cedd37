"""Whether two basic pairs far apart in time show one place, and the motion between their left cameras.

Features of both left images are matched; those with a disparity are landmarks in either pair. The second camera is
posed by the landmarks of the first (:mod:`rille.stages.odometry.resection.robust_pose`), and the first by those of the
second. Both poses are measured in metres by stereo, each on its own: of one place they are inverse to each other, and a
point is as far away by one pair as by the other. Repeated texture matches in parts of the image, or with few of its
matches in agreement, or at another scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle, NoParams, stage
from rille.stages.core.errors import DegenerateError
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.odometry import LoopFacts
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp, rotation_log
from rille.stages.imaging.features import PIXEL_CENTRE, detected_pixel, match
from rille.stages.odometry.resection.landmarks import Landmarks, landmarks_of
from rille.stages.odometry.resection.robust_pose import Resection, ResectParams, resect
from rille.stages.odometry.resection.trajectory import propagation

MIN_BLOCKS, BLOCKS = 5, 4
"""Parts of either image, of 4 x 4, in which landmarks agree."""
HERE = RigidTransform.identity()


class Features(NamedTuple):
    """Features of a left image: points (n, 2) column, row, and their landmarks in the frame of the camera."""

    points: Floats
    landmarks: Landmarks
    camera: Camera


class Loop(NamedTuple):
    """Pose T_a_b of the second left camera in the frame of the first, its covariance (6, 6), and how many landmarks
    agree with it."""

    T_a_b: RigidTransform
    covariance: Floats
    inliers: int


class NoLoopError(Exception):
    """Two pairs that are alike do not show one place; the text says why."""


def loop_between(a: Features, b: Features, matches: NDArray[np.uint32], seed: int) -> Loop:
    """Motion between two pairs of one place, by ``matches`` (m, 2) of their features.

    Raises
    ------
    NoLoopError
        They do not show one place.
    """
    there, to_b = _posed(a, b, matches, seed)
    back, to_a = _posed(b, a, matches[:, ::-1], seed)
    T_a_b, T_b_a = there.T_local_left, back.T_local_left
    for image, rows in ((b, to_b[there.inlier, 1]), (a, to_a[back.inlier, 1])):
        covered = _blocks(image.points[rows], image.camera)
        if covered < MIN_BLOCKS:
            raise NoLoopError(f"what agrees lies in {covered} of {BLOCKS**2} parts of the image")
    here, other = (one.landmarks.position[rows] for one, rows in zip((a, b), to_b[there.inlier].T, strict=True))
    ratio = float(np.nanmedian(T_b_a.apply(here)[:, 2] / other[:, 2]))
    # 1.1: median ratio of a point's depths by both pairs, either way.
    if not 1.0 / 1.1 < ratio < 1.1:
        raise NoLoopError(f"points are {ratio:.2f} times as far by one pair as by the other")
    # The way there and back: with the errors of both it does not end where it began.
    around = T_a_b @ T_b_a
    lever, turn = propagation(T_a_b, T_a_b, around)
    off = np.concatenate([around.translation, rotation_log(around.rotation)])
    both = lever @ there.total @ lever.T + turn @ back.total @ turn.T
    excess = float(off @ np.linalg.solve(both, off)) / 6.0
    if excess > 4.0**2:
        raise NoLoopError(f"the poses of both directions depart by {np.linalg.norm(off[:3]):.2g} m")
    share = there.total @ lever.T @ np.linalg.solve(both, off)
    T = RigidTransform(rotation_exp(-share[3:]) @ T_a_b.rotation, T_a_b.translation - share[:3])
    # Both directions share their matches: their mean is not said to be better than the first, nor than they agree.
    return Loop(T, max(excess, 1.0) * there.total, int(there.inlier.sum()))


def _posed(a: Features, b: Features, matches: NDArray[np.uint32], seed: int) -> tuple[Resection, NDArray[np.uint32]]:
    """Pose of the second camera by landmarks of the first, and the matches (k, 2) that have one."""
    known = matches[np.isfinite(a.landmarks.position[matches[:, 0], 0])]
    # 0.35: standard deviation of a matched feature's position, in pixels of the image in which features are detected. A
    # track's 0.2 pixels of the full image gave near landmarks too much weight, and errors twice those stated (flight of
    # EuRoC).
    sigma = 0.35 * detected_pixel(b.camera.width, b.camera.height)
    params = ResectParams.model_validate({"pixel_sigma": sigma, "threshold": 4.0 * sigma})
    try:
        posed = resect(a.landmarks.take(known[:, 0]), b.points[known[:, 1]], b.camera, [HERE], params, seed)
    except DegenerateError as error:
        raise NoLoopError(error.message.split(": ", 1)[-1]) from error
    count = int(posed.inlier.sum())
    if count < max(20, 0.4 * len(known)):
        raise NoLoopError(f"{count} of {len(known)} landmarks agree with one pose")
    return posed, known


class Closure(NamedTuple):
    """Correction of the chain by a loop: m, degrees, and ``chi``, the root of the mean squared error over its
    expected standard deviation; all None between pieces. ``left_m`` is what the adjusted trajectory leaves of it, None
    where that has not joined the pieces."""

    move_m: float | None
    turn_deg: float | None
    chi: float | None
    left_m: float | None


def closure(factor: Mapping[str, Any], chained: Bundle, adjusted: Bundle) -> Closure:
    """Departure of both trajectories from a loop that both have poses for."""
    rows = [chained.meta["frames"].index(factor[end]) for end in ("from", "to")]
    measured, loop = RigidTransform.from_matrix(factor["pose"]), np.reshape(factor["covariance"], (6, 6))
    a, b = (RigidTransform.from_matrix(adjusted["poses"][row]) for row in rows)
    left = float(np.linalg.norm(b.translation - (a @ measured).translation))
    if len(set(adjusted["piece"][rows])) > 1:
        return Closure(None, None, None, None)
    if len(set(chained["piece"][rows])) > 1:
        return Closure(None, None, None, left)
    a, b = (RigidTransform.from_matrix(chained["poses"][row]) for row in rows)
    closed = a @ measured
    off = np.concatenate([b.translation - closed.translation, rotation_log(b.rotation @ closed.rotation.T)])
    lever, turn = propagation(a, a, b)
    first, last = (np.asarray(chained["covariance"][row]) for row in rows)
    # The chain's errors since the first frame; errors that all segments share may make it seem negative.
    values, vectors = np.linalg.eigh(last - lever @ first @ lever.T)
    expected = (vectors * np.maximum(values, 0.0)) @ vectors.T + turn @ loop @ turn.T
    move, angle = np.linalg.norm(off[:3]), np.degrees(np.linalg.norm(off[3:]))
    return Closure(float(move), float(angle), float(np.sqrt(off @ np.linalg.solve(expected, off) / 6.0)), left)


def _blocks(points: Floats, camera: Camera) -> int:
    """Number of parts of the image that hold one of the points (n, 2)."""
    part = np.floor((points + 0.5) * BLOCKS / [camera.width, camera.height]).clip(0, BLOCKS - 1)
    return len(np.unique(part, axis=0))


@stage("loop")
def loop_stage(
    params: NoParams,
    features: Sequence[Bundle],
    disparities: Sequence[Bundle],
    rigs: Sequence[Bundle[CalibrationFacts]],
    *,
    pairs: list[int],
) -> Bundle[LoopFacts]:
    """Motions from earlier basic pairs to one that sees their places again."""
    usual = ResectParams.model_validate({})

    @cache
    def view(k: int) -> Features:
        rig, points = Rig.from_dict(rigs[k].meta["rig"]), np.asarray(features[k]["points"], np.float64) - PIXEL_CENTRE
        known = landmarks_of(points, disparities[k], rig, HERE, usual.disparity_sigma)
        return Features(points, known, rig.left)

    factors, refused = list[dict[str, Any]](), list[dict[str, Any]]()
    for k, pair in enumerate(pairs[1:], start=1):
        # Descriptors first: most candidates match so little that their disparities need not be read.
        matches = match(*(np.asarray(features[j]["descriptors"], np.float32) for j in (k, 0)))
        if len(matches) < 30:
            continue
        ends = {"from": pair, "to": pairs[0]}
        try:
            loop = loop_between(view(k), view(0), matches, pairs[0])
        except NoLoopError as error:
            refused.append({**ends, "reason": str(error)})
            continue
        pose, covariance = (values.reshape(-1).tolist() for values in (loop.T_a_b.matrix34, loop.covariance))
        source = f"a place seen again, {loop.inliers} landmarks"
        factors.append({**ends, "pose": pose, "covariance": covariance, "source": source})
    return Bundle({}, {"factors": factors, "refused": refused})
