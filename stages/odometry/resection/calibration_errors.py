"""Errors of the calibration as one segment shows them: its part of the normal equations, and how its poses change.

A wrong focal length stretches what a stereo pair sees along the optical axis, a wrong principal point shears it. A
straight drive shows neither. Where the camera turns, it sees the same points stretched along another axis, which no
motion explains. Each segment gives the part of its normal equations that is left for these numbers when its own
unknowns (poses, depths, bias) are eliminated, and the change of its poses with each number.

The rig's yaw is an error that all disparities share: near and far landmarks ask for different motions. A straight
drive shows that as well, by the common error of its disparities. Toe-in is a yaw whose shift in the middle of the image
a wrong principal point takes back: disparities at the sides are off, which a straight drive shows, too. Where one
camera stands above the other, pitch takes the place of yaw. A rolling shutter reads the rows one after the other: a
point that wanders down the image moved for longer than one that does not. The length of the baseline is held, because
no image shows it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.geometry import epipolar, rigid
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.geometry.lens import Lens
from rille.stages.odometry.resection.bundle_adjustment import (
    SegmentAdjustment,
    SegmentNormal,
    SegmentState,
    SegmentTracks,
)
from rille.stages.odometry.resection.landmarks import triangulated
from rille.stages.odometry.resection.pnp import bias_information

NUMBERS = ("focal length", "principal point's column", "principal point's row", "radial distortion", "toe-in")
"""What the errors are of: both cameras, over the focal length, and their coefficient k1; and the rig's toe-in, rad. The
rows of all pairs show its other angles far better (:mod:`rille.stages.calibration.rig`)."""

CORRECTED = 3
"""Number of these that are corrected: those of the camera without distortion."""

STEP = 1e-4
"""Change of each number by which the tracks are differentiated."""


class SegmentCameras(NamedTuple):
    """Rig of a segment, its key's pose, and by the camera's name the lenses of images that were undistorted."""

    rig: Rig
    lenses: Mapping[str, Lens]
    T_local_key: RigidTransform


class IntrinsicsPart(NamedTuple):
    """Contribution of a segment to k errors: ``information`` (k, k), ``pull`` (k,).

    ``by_error`` (frame, 6, k): changes of its poses (position m, rotation vector rad of T_local_left) with each.
    ``yaw``: information and pull of the rig's yaw, rad, by the common error of its disparities, without the prior of
    that, which would draw it towards zero; and how the pull changes with the toe-in. ``read_out``: information and pull
    of the time from the first to the last row, in intervals between frames.
    """

    information: Floats
    pull: Floats
    by_error: Floats
    yaw: tuple[float, float, float]
    read_out: tuple[float, float]


def corrected(camera: Camera, errors: Sequence[float] | Floats) -> Camera:
    """Camera whose focal length and principal point are changed by the first of ``errors``."""
    larger, column, row = 1.0 + errors[0], camera.cx + errors[1] * camera.fx, camera.cy + errors[2] * camera.fy
    return replace(camera, fx=camera.fx * larger, fy=camera.fy * larger, cx=column, cy=row)


def corrected_like(side: str, camera: Camera, rig: Rig, errors: Sequence[float] | Floats) -> Camera:
    """Camera of a ``side`` of a rig, changed by the first of ``errors``, which are stated for the left camera.

    Both cameras err alike as the left image shows it, so that disparities stay: what errs along the columns of the one
    does along the rows of the other, if that lies on its side.
    """
    larger, *centre = errors[:CORRECTED]
    if side == "right":
        (cosine, _, _), (sine, _, _), _ = rig.T_right_left.rotation
        turned = complex(*centre) * complex(cosine, sine) / math.hypot(cosine, sine)
        centre = [turned.real, turned.imag]
    return corrected(camera, [larger, *centre])


def corrected_rig(rig: Rig, errors: Sequence[float] | Floats, yaw: float) -> Rig:
    """Rig whose cameras are changed by the first of ``errors``, and its yaw, rad; of cameras one above the other, the
    pitch, which moves all disparities, takes the place of the yaw."""
    turned = epipolar.corrected(rig, yaw * (np.array(epipolar.NAMES) == epipolar.angle_along(rig)))
    left, right = (corrected_like(side, getattr(rig, side), rig, errors) for side in ("left", "right"))
    return replace(turned, left=left, right=right)


def toed_in(rig: Rig, angle: float) -> Rig:
    """Rig whose right camera has a yaw, rad, that its principal point takes back for what is far ahead."""
    turned = corrected_rig(rig, np.zeros(CORRECTED), angle)
    cx, cy = np.array([rig.right.cx, rig.right.cy]) - epipolar.far_shift(rig, turned)
    return replace(turned, right=replace(turned.right, cx=cx, cy=cy))


def calibrated_anew(rig: Rig, correction: Sequence[float]) -> Rig:
    """Rig whose cameras are changed by the first :data:`CORRECTED` of a correction, and whose yaw by the last, rad."""
    return corrected_rig(rig, correction, correction[-1])


def composed(before: Sequence[float] | Floats, correction: Sequence[float] | Floats) -> Floats:
    """One correction in place of two that follow each other."""
    larger = 1.0 + before[0]
    scale = np.array([larger, larger, larger, 1.0])  # those of the cameras are over the focal length
    return np.array(before) + scale * correction


def with_errors(tracks: SegmentTracks, cameras: SegmentCameras, errors: Floats) -> SegmentTracks:
    """Measurements as they would be if the calibration were changed by ``errors`` (k + 1,), the yaw last."""
    rig, T_local_key = cameras.rig, cameras.T_local_key
    toe_in, yaw = errors[CORRECTED + 1 :]
    other = toed_in(corrected_rig(rig, errors, yaw), toe_in)

    def undistorted_anew(pixels: Floats, side: str, given: Camera, ideal: Camera) -> Floats:
        if (lens := cameras.lenses.get(side)) is not None:
            raw = lens.distort(np.nan_to_num(pixels).reshape(-1, 2), given)
            again = replace(lens, camera=corrected_like(side, lens.camera, rig, errors))
            pixels = again.undistort(raw, ideal).reshape(pixels.shape)
        focal, centre = np.array([ideal.fx, ideal.fy]), np.array([ideal.cx, ideal.cy])
        ray = (pixels - centre) / focal
        return np.asarray(pixels - errors[CORRECTED] * focal * ray * (ray**2).sum(-1, keepdims=True))

    key = T_local_key.inverse().apply(tracks.landmarks.position)
    left = undistorted_anew(rig.left.project(key), "left", rig.left, other.left)
    right = undistorted_anew(rig.right.project(rig.T_right_left.apply(key)), "right", rig.right, other.right)
    landmarks = triangulated(left, right, other, T_local_key, tracks.landmarks.sigma)
    pixels = undistorted_anew(tracks.pixels, "left", rig.left, other.left)
    return replace(tracks, landmarks=landmarks, pixels=pixels, camera=other.left)


def read_late(tracks: SegmentTracks, cameras: SegmentCameras, time: float) -> SegmentTracks:
    """Measurements as they would be if the last row were read ``time``, in intervals between frames, later."""
    key = cameras.rig.left.project(cameras.T_local_key.inverse().apply(tracks.landmarks.position))
    moved = tracks.pixels - key
    mean = moved / np.arange(1, len(moved) + 1)[:, None, None]
    speed = np.diff(tracks.pixels, axis=0, prepend=key[None])
    speed = np.where(np.isfinite(speed), speed, mean)  # where the frame before does not show it
    return replace(tracks, pixels=tracks.pixels - time * moved[..., 1:] / cameras.rig.left.height * speed)


def turn_deg(state: SegmentState, T_local_key: RigidTransform) -> float:
    """Largest turn of a frame of the segment from its key, degrees."""
    return math.degrees(rigid.angle(state.R @ T_local_key.rotation).max())


def contribution(problem: SegmentAdjustment, state: SegmentState, cameras: SegmentCameras) -> IntrinsicsPart:
    """Contribution of an adjusted segment to the errors of :data:`NUMBERS`, its unknowns free, by the stated errors."""
    tracks, normal, k = problem.tracks, problem.normal(state), len(NUMBERS)
    *changed, turned = (with_errors(tracks, cameras, STEP * one) for one in np.eye(k + 1))
    steps = [replace(problem, tracks=one) for one in (*changed, read_late(tracks, cameras, STEP))]
    (p, n), m = normal.between.shape, len(steps)
    by_pose, by_depth, squares, gradient = np.zeros((p, m)), np.zeros((m, n)), np.zeros((m, m)), np.zeros(m)
    for f in range(len(state.R)):
        errors, others = problem.errors(state, f), [one.errors(state, f) for one in steps]
        usable = np.isfinite([one.norm for one in (errors, *others)]).all(0)
        slope = np.stack([one.error - errors.error for one in others], axis=-1) / STEP
        weighted = slope * np.where(usable, problem.weights(errors, f), 0.0)[:, None, None]
        by_pose[6 * f : 6 * f + 6] = np.einsum("nai,nak->ik", errors.jacobian[..., :6], weighted, optimize=True)
        by_depth += np.einsum("nak,na->kn", weighted, errors.jacobian[..., 6])
        squares += np.einsum("nai,nak->ik", slope, weighted, optimize=True)
        gradient += np.einsum("nak,na->k", weighted, errors.error)
    # A shift of one depth and that of all depths move a pixel alike.
    by_pose[-1] = by_depth.sum(1)
    matrix, right = SegmentNormal(
        np.block([[normal.poses, by_pose], [by_pose.T, squares]]),
        np.vstack([normal.between, by_depth]),
        normal.depths,
        np.concatenate([normal.pose_gradient, gradient]),
        normal.depth_gradient,
        normal.cost,
    ).without_depths()
    prior = bias_information(problem.params.bias_sigma)
    read_out = _of_read_out(matrix, right, prior, state.bias)
    matrix, right = matrix[:-1, :-1], right[:-1]
    inverse = np.linalg.inv(matrix[:p, :p])
    step = -inverse @ matrix[:p, p:]
    # Of C = -R^T t and of R^T, by the left perturbation of T_cam_local.
    by_error = np.swapaxes(state.R, 1, 2)[:, None] @ -step[:-1].reshape(-1, 2, 3, k)
    information = matrix[p:, p:] + matrix[p:, :p] @ step
    moved, ray = turned.landmarks.position - tracks.landmarks.position, tracks.landmarks.per_pixel
    along = (moved * ray).sum(1) / (ray**2).sum(1)
    px_per_rad, of_bias = float(np.nanmedian(along)) / STEP, 1.0 / float(inverse[-1, -1])
    by_toe_in = of_bias * step[p - 1, -1] * px_per_rad
    yaw = max(of_bias - prior, 0.0) * px_per_rad**2, of_bias * state.bias * px_per_rad, by_toe_in
    return IntrinsicsPart(information, right[p:] + step.T @ right[:p], by_error.reshape(-1, 6, k), yaw, read_out)


def _of_read_out(matrix: Floats, right: Floats, prior: float, bias: float) -> tuple[float, float]:
    """Information and pull of the last unknown, the time between the rows: poses and the bias before the errors of
    :data:`NUMBERS` are free, the bias without the ``prior`` of its own, for it is the yaw."""
    k = len(NUMBERS) + 1
    # The errors are those of a usual calibration, the bias one of 10 px.
    hold = np.zeros(len(right))
    hold[-k - 1 : -1] = [0.01 - prior, *[0.005**-2.0] * (k - 1)]
    free, pull = matrix + np.diag(hold), right.copy()
    pull[-k - 1] += prior * bias
    answer = np.linalg.solve(free[:-1, :-1], free[:-1, -1])
    return float(free[-1, -1] - answer @ free[:-1, -1]), float(pull[-1] - answer @ pull[:-1])
