"""Pose of one frame from landmarks whose 3-D coordinates are known, robustly, with its covariance (section 5.2.2).

Source: Kolesnik, Paar, Bauer, Ulm (1999), section 5.2.2, Eq. 4-8: the six extrinsics that minimise the back-projection
errors, intrinsics fixed; then "the calibration is iterated with the most inconsistent interest points removed, until
this error gets below a certain threshold for all interest points".

Departures: the start need not be good (a pose by random samples of three landmarks competes with the predictions);
errors are weighted by how exactly the landmark itself is known (see :mod:`rille.stages.odometry.resection.pnp`), and
"error" in the rule above is that weighted one in units of ``pixel_sigma``; for exact landmarks it is the paper's.

Covariances here are 6 x 6 of ``(dt, dtheta)`` in the destination frame: position error in metres, then the rotation
vector ``R_true = exp(dtheta) R`` in radians. They contain the errors of the measurements and a shared error of the
disparities. Errors of the intrinsics come with the adjustment (:mod:`rille.stages.odometry.resection.intrinsics`); the
direction of the camera in the vehicle is in none. They have two parts:

* errors that the residuals show, enlarged for the correlation of neighbours (:func:`scatter_of_blocks`). They are
  independent from segment to segment;
* errors that the residuals do not show, and that every segment *shares* (``shared``): the error common to all
  disparities, and the part of the stated errors of tracks and disparities that exceeds the residuals. An error that all
  landmarks of a neighbourhood have (of sub-pixel interpolation, of relief under a template) bends the pose and leaves
  no residual. The same camera makes it again over the same kind of ground, so along a chain these errors add up, and
  not their squares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from pydantic import Field

from rille.stages.core.arrays import Bools, Floats
from rille.stages.core.declare import Params
from rille.stages.core.errors import DegenerateError
from rille.stages.geometry.geometry import Camera, RigidTransform
from rille.stages.geometry.projection import Pinhole
from rille.stages.numeric.least_squares import levenberg_marquardt
from rille.stages.odometry.resection.landmarks import MAX_RELATIVE_SIGMA, Landmarks
from rille.stages.odometry.resection.pnp import (
    Errors,
    Normal,
    Observations,
    Pose,
    PoseAdjustment,
    PoseCovariances,
    back_projection,
)

MIN_LANDMARKS = 6
"""Fewest landmarks of a pose: twelve equations for six unknowns, so that one wrong landmark shows."""
SHARED_SOURCES = 7
"""Error sources that all segments share: one for each of the six pose parameters, and the bias of the disparities."""
THRESHOLD_SHARES = (0.25, 0.5, 1.0)
"""Shares of the threshold at which agreement is counted."""


class ResectParams(Params):
    """Parameters of the stage ``resect``.

    Attributes
    ----------
    pixel_sigma : standard deviation [pixels] of a tracked position.
    disparity_sigma : standard deviation [pixels] of the disparity under a landmark; moves the landmark along its ray.
    bias_sigma : prior standard deviation [pixels] of an error common to all disparities (toe-in of the rig); 0: no such
        error.
    threshold : largest back-projection error [pixels] of an inlier; the worst landmarks are removed until all are
        below; 1.0: 5 pixel_sigma.
    joint : then adjust all poses and landmark depths of a segment jointly.
    max_position_ratio : largest standard deviation of the camera position over the landmarks' median distance; beyond,
        the pose counts as degenerate.
    """

    pixel_sigma: float = Field(0.2, gt=0)
    disparity_sigma: float = Field(0.2, ge=0)
    bias_sigma: float = Field(0.1, ge=0)
    threshold: float = Field(1.0, gt=0)
    joint: bool = True
    max_position_ratio: float = Field(0.02, gt=0)


@dataclass(frozen=True)
class Resection:
    """Pose of one frame.

    ``T_local_left``; ``covariance`` (6, 6) of (position m, rotation rad) in the local frame, without what is shared;
    ``shared`` (6, 7): pose errors per standard deviation of what all segments have in common; ``inlier`` (n,);
    ``residual`` (n,) back-projection error, pixels, of every landmark (NaN: behind the camera); ``bias`` of the
    disparities, pixels; ``block_scatter``: how many times as far as independent errors the mean errors of image blocks
    scatter (variance), see :func:`scatter_of_blocks`.
    """

    T_local_left: RigidTransform
    covariance: Floats
    shared: Floats
    inlier: Bools
    residual: Floats
    bias: float
    block_scatter: float

    @property
    def total(self) -> Floats:
        """Covariance (6, 6) of the pose, all errors together, neighbours' being alike."""
        return total_covariance(self.covariance, self.shared, [self.block_scatter])

    @property
    def rms_px(self) -> float:
        """RMS back-projection error of the landmarks that agree, pixels."""
        return float(np.sqrt(np.mean(self.residual[self.inlier] ** 2)))


def resect(
    landmarks: Landmarks,
    pixels: Floats,
    camera: Camera,
    starts: Sequence[RigidTransform],
    params: ResectParams,
    frame: int,
) -> Resection:
    """Pose of a camera from landmarks and their image positions (Eq. 4-8), robustly.

    Parameters
    ----------
    landmarks : n of them, in the local frame; all finite.
    pixels : (n, 2) column, row.
    starts : predictions of T_local_left, at which the search starts.
    frame : its number, for messages and for the seed of the random samples.

    Raises
    ------
    DegenerateError
        Fewer than six landmarks (in all, or consistent), all on a line, or a pose that they do not determine.
    """
    where = f"frame {frame}"
    count = f"{where}: too few landmarks: {len(pixels)} have coordinates and were found ({landmarks.summary()})"
    refuse_few(len(pixels), count, "set track.points higher or choose basic pairs closer")
    _not_collinear(landmarks.position, where)
    obs = Observations(landmarks, pixels, camera, params.pixel_sigma)
    predictions = [Pose.of(T.inverse()) for T in starts]
    pose, near = _robust_start(obs, predictions, params, frame)
    pose, active = _without_inconsistent(obs, pose, near, params, where)
    errors = back_projection(obs, pose)
    _not_by_chance(errors, params, where)
    _not_collinear(landmarks.position[active], where)
    depth = float(np.median(obs.landmarks.position[active] @ pose.R[2] + pose.t[2]))
    normal = PoseAdjustment(obs, active, params.bias_sigma).normal(pose)
    covariance, shared = frame_errors(_certainty(errors, normal, depth, params, where), pose.R, depth)
    return Resection(
        RigidTransform(pose.R, pose.t).inverse(),
        covariance,
        shared,
        active,
        np.where(np.isfinite(errors.norm), errors.pixels, np.nan),
        float(pose.bias),
        scatter_of_blocks(obs.pixels[active], errors.error[active], normal.weight[active], camera),
    )


def _robust_start(obs: Observations, predictions: list[Pose], params: ResectParams, frame: int) -> tuple[Pose, Bools]:
    """The pose that most landmarks agree with, adjusted to those; and which agree (n,).

    Locally optimised RANSAC (Chum, Matas, Kittler 2003, doi:10.1007/978-3-540-45243-0_31, by COLMAP) competes with the
    predictions, with truncated squares as the score.
    """
    # Twice the threshold: three points fix a pose with errors of their own, which must not cost it its landmarks.
    bound = 2.0 * params.threshold / params.pixel_sigma
    # Truncated squares, not a count: of poses that as many landmarks agree with, the one they fit better.
    candidates = [*predictions, *_sampled(obs, 2.0 * params.threshold, frame)]
    best = min(candidates, key=lambda pose: float((np.minimum(back_projection(obs, pose).norm, bound) ** 2).sum()))
    for _ in range(2):
        active = back_projection(obs, best).norm <= bound
        if active.sum() >= 4:
            best = _adjusted(obs, active, best, params)
    return best, back_projection(obs, best).norm <= bound


def _adjusted(obs: Observations, active: Bools, start: Pose, params: ResectParams) -> Pose:
    """The pose of least cost for the active (n,) landmarks."""
    # About 10 steps suffice.
    return levenberg_marquardt(PoseAdjustment(obs, active, params.bias_sigma), start, 50).state


def sampled_pose(
    pixels: Floats, landmarks: Floats, camera: Any, bound: float, seed: int, *, focal_length: bool = False
) -> Mapping[str, Any] | None:
    """COLMAP's pose by random samples that most landmarks (n, 3) are within ``bound`` pixels of; None: of too few.

    ``camera`` is COLMAP's; ``focal_length``: find its focal length as well, and set it.
    """
    # Here: the client, which only needs the stages' declarations, is spared its memory.
    from rille.stages.geometry.colmap import pycolmap

    options = pycolmap.AbsolutePoseEstimationOptions(estimate_focal_length=focal_length)
    options.ransac.max_error, options.ransac.random_seed = bound, seed % 2**31
    found: Mapping[str, Any] | None = pycolmap.estimate_absolute_pose(pixels, landmarks, camera, options)
    return found


def _sampled(obs: Observations, bound: float, frame: int) -> list[Pose]:
    """The pose of random samples, if there is one."""
    from rille.stages.geometry.colmap import pycolmap

    # The size plays no part, but must be there.
    camera = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=list(Pinhole.of(obs.camera)))
    found = sampled_pose(obs.pixels, obs.landmarks.position, camera, bound, 1999 * 100_003 + frame)
    return [] if found is None else [Pose.of(RigidTransform.from_matrix(found["cam_from_world"].matrix()))]


def _without_inconsistent(
    obs: Observations, pose: Pose, active: Bools, params: ResectParams, where: str
) -> tuple[Pose, Bools]:
    """Pose and landmarks (n,) that agree, by the paper's rule: adjust, remove the most inconsistent, and again."""
    bound = params.threshold / params.pixel_sigma
    while True:
        count = int(active.sum())
        refuse_few(
            count,
            f"{where}: too few landmarks: {count} agree with one pose",
            "raise resect.threshold or choose basic pairs closer",
        )
        pose = _adjusted(obs, active, pose, params)
        usable = _first_order(obs, pose)
        if (active & ~usable).any():
            active = active & usable
            continue
        norm = np.where(active, back_projection(obs, pose).norm, -1.0)
        beyond = int((norm > bound).sum())
        if beyond == 0:
            return pose, active
        active = active.copy()
        # Not all of them at once: the worst pull the pose, and others agree once these are gone.
        active[np.argsort(-norm, kind="stable")[: math.ceil(beyond / 8)]] = False


def _first_order(obs: Observations, pose: Pose) -> Bools:
    """Which landmarks (n,) are so far before the camera that first-order errors hold.

    A camera that has come close to a landmark, or passed it, sees its error along the old ray at any size: such a
    landmark agrees with everything, thousands of pixels off.
    """
    depth = obs.landmarks.position @ pose.R[2] + pose.t[2]
    spread = obs.landmarks.sigma * np.linalg.norm(obs.landmarks.per_pixel, axis=1)
    return np.asarray(spread <= MAX_RELATIVE_SIGMA * depth)


def _certainty(errors: Errors, normal: Normal, depth: float, params: ResectParams, where: str) -> PoseCovariances:
    """Covariances of a pose; refuse one that is too uncertain by the stated errors."""
    active = normal.weight > 0
    # A posteriori variance factor: the errors found, not the ones expected, set the scale.
    squares = (normal.weight[active] * errors.norm[active] ** 2).sum()
    factor = max(float(squares / (2 * active.sum() - 6)), 1e-12)
    expected = PoseCovariances.of(normal.matrix, params.bias_sigma, 1.0).stated
    position_sigma = float(np.sqrt(np.trace(expected.noise[:3, :3]) + (expected.by_bias[:3] ** 2).sum()))
    if position_sigma > params.max_position_ratio * depth:
        raise DegenerateError(
            "RIL-420",
            f"{where}: {int(active.sum())} landmarks at a median distance of {depth:.3g} m leave the position uncertain"
            f" by {position_sigma:.2g} m (condition {expected.condition:.1e})",
            remedy="they are too far, too few or in one direction: set track.points higher or use nearer texture",
        )
    return PoseCovariances.of(normal.matrix, params.bias_sigma, factor)


def frame_errors(poses: PoseCovariances, R_cam_local: Floats, depth: float, at: int = 0) -> tuple[Floats, Floats]:
    """Covariance (6, 6) of one pose in the local frame by the errors found, and the root (6, 7) of what is shared.

    ``C = -R^T t`` and ``R^T`` change by ``-R^T v`` and ``-R^T w`` under a step (v, w); signs drop out of a covariance.

    Parameters
    ----------
    poses : those that were adjusted together; what the stated errors add to the measured ones is what segments share,
        with the part of the bias.
    depth : median distance of the landmarks, m.
    at : place of the pose among them.
    """
    turn, rows = np.kron(np.eye(2), R_cam_local.T), slice(6 * at, 6 * at + 6)
    covariance = turn @ poses.measured.noise[rows, rows] @ turn.T
    shared = root(turn @ poses.stated.noise[rows, rows] @ turn.T - covariance, depth)
    return covariance, np.column_stack([shared, turn @ poses.stated.by_bias[rows]])


def root(covariance: Floats, depth: float) -> Floats:
    """Symmetric root (6, 6) of a covariance, radians counted as what they move at a depth (m)."""
    unit = np.array([1.0] * 3 + [depth] * 3)
    values, vectors = np.linalg.eigh(covariance * np.outer(unit, unit))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T / unit[:, None])


def scatter_of_blocks(pixels: Floats, white: Floats, weight: Floats, camera: Camera) -> float:
    """Return the ratio of the variance of block means of errors to that of independent errors; 1: independent.

    Neighbouring landmarks share matches, texture and relief, so their errors are correlated, and they determine the
    pose less well than as many independent ones. ``white`` (n, 2): whitened errors after adjustment, at ``pixels``
    (n, 2), with ``weight`` (n,). The six unknowns of the pose take up as many degrees of freedom of the means.
    """
    # At most 6 x 6 blocks, of six landmarks on average at least.
    side = min(6, int(math.sqrt(len(pixels) / 6)))
    if side < 3:
        return 1.0
    col = np.clip(pixels[:, 0] * side / camera.width, 0, side - 1).astype(np.intp)
    row = np.clip(pixels[:, 1] * side / camera.height, 0, side - 1).astype(np.intp)
    block = row * side + col
    root = np.sqrt(weight)
    count = np.bincount(block, minlength=side * side)
    sums = np.stack([np.bincount(block, root * white[:, k], side * side) for k in range(2)])
    used = count > 0
    freedom = 2 * int(used.sum()) - 6
    spread = float((weight[:, None] * white**2).sum()) / max(2 * len(pixels) - 6, 1)
    if freedom < 6 or spread <= 0.0:
        return 1.0
    return float((sums[:, used] ** 2 / count[used]).sum()) / spread / freedom


def correlation(block_scatters: Sequence[float]) -> float:
    """Variance of poses over that by independent errors: the mean of :func:`scatter_of_blocks`, at least 1.

    Of one frame it scatters by a fifth; frames of a segment share their landmarks.
    """
    return max(1.0, float(np.mean(block_scatters))) if block_scatters else 1.0


def total_covariance(covariance: Floats, shared: Floats, block_scatters: Sequence[float]) -> Floats:
    """Covariances (..., 6, 6) with all errors: neighbours' being alike, and those that segments share (..., 6, 7)."""
    return np.asarray(correlation(block_scatters) * covariance + shared @ np.swapaxes(shared, -1, -2))


def refuse_few(count: int, what: str, remedy: str) -> None:
    """Refuse a pose of fewer than :data:`MIN_LANDMARKS` landmarks; ``what`` says of which frame, and how many."""
    if count < MIN_LANDMARKS:
        raise DegenerateError("RIL-421", f"{what}, {MIN_LANDMARKS} are needed", remedy=remedy)


def _not_by_chance(errors: Errors, params: ResectParams, where: str) -> None:
    """Refuse a pose that as many landmarks may agree with though none was found where it is.

    Any three landmarks fix a pose. Where the others were found by mistake, anywhere in what tracking searches, each
    agrees with the share of that area that is below the threshold; the number of false alarms is that of triples times
    the chance that so many others do (Desolneux, Moisan, Morel 2000, doi:10.1023/A:1026593302236), the least of some
    thresholds times their number: right landmarks agree better than they need to. A few landmarks of many tell nothing
    then, however small their residuals are.
    """
    n = len(errors.norm)
    stretch = errors.stretch[np.isfinite(errors.stretch)]
    alarms = math.inf
    for part in THRESHOLD_SHARES:
        bound = part * params.threshold
        count = int((errors.norm <= bound / params.pixel_sigma).sum())
        # Of the side of the square around a prediction within which tracking finds a point: 2 * 4 + 1 pixels.
        reach = bound / 9.0
        strip = min(2.0 * reach, 1.0)  # the most that a long ellipse leaves of the square
        share = float(np.minimum(math.pi * reach**2 * stretch, strip).mean())
        if share == 1.0:  # a threshold that every place passes was chosen so as to believe everything
            return
        if count >= MIN_LANDMARKS:
            chance = float(scipy.special.bdtrc(count - 4, n - 3, share))
            alarms = min(alarms, len(THRESHOLD_SHARES) * math.comb(n, 3) * chance)
    # Of frames whose tracks are all wrong, one in a hundred may pass.
    if alarms > 0.01:
        raise DegenerateError(
            "RIL-720",
            f"{where}: {count} of {n} landmarks agree with one pose, which as many may do by chance",
            remedy="set track.points higher, or choose frames that are closer to each other",
        )


def _not_collinear(landmarks: Floats, where: str) -> None:
    """A line of landmarks leaves the rotation about it free; below 1 % of their spread is a line in practice."""
    spread = np.linalg.svd(landmarks - landmarks.mean(0), compute_uv=False)
    if spread[1] < 0.01 * spread[0]:
        raise DegenerateError(
            "RIL-422",
            f"{where}: the {len(landmarks)} landmarks are collinear, the rotation about their line is free",
            remedy="set track.points higher so that landmarks cover the image",
        )
