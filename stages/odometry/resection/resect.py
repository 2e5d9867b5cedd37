"""Resection: pose of each frame of a segment from landmarks whose 3-D coordinates are known (section 5.2.2).

Source: Kolesnik, Paar, Bauer, Ulm (1999), section 5.2.2, Eq. 4-8: the six extrinsics that minimise the back-projection
errors, intrinsics fixed; then "the calibration is iterated with the most inconsistent interest points removed, until
this error gets below a certain threshold for all interest points".

Departures: the start need not be good (hypotheses from four landmarks each compete with the prediction); errors are
weighted by how exactly the landmark itself is known (see :mod:`rille.stages.odometry.resection.pnp`), and "error" in
the rule above is that weighted one in units of ``pixel_sigma``; for exact landmarks it is the paper's.

Covariances here are 6 x 6 of ``(dt, dtheta)`` in the destination frame: position error in metres, then the rotation
vector ``R_true = exp(dtheta) R`` in radians. They contain the errors of the measurements and a shared error of the
disparities, but not errors of the calibration (focal length, direction of the camera in the vehicle). They have two
parts:

* what the residuals show: the errors found, times what they go together by (:func:`scatter_of_blocks`). It begins anew
  with the landmarks of every segment;
* what they do not show, and every segment *shares* (``shared``): the error common to all disparities, and what the
  stated errors of tracks and disparities leave once those found are subtracted. An error that all landmarks of a
  neighbourhood have (of sub-pixel interpolation, of relief under a template) bends the pose and leaves no residual; the
  same camera makes the same over the same kind of ground, so along a chain these errors add up, and not their squares.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Bools, Bytes, Floats, Floats32
from rille.stages.core.declare import AnyArray, Array, Bundle, Params, stage
from rille.stages.core.errors import DegenerateError, InputError
from rille.stages.facts.calibration import CalibrationFacts
from rille.stages.facts.odometry import ResectFacts, TrackFacts
from rille.stages.facts.terrain import DemFacts, GroundFacts
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform
from rille.stages.geometry.lattice import Lattice
from rille.stages.geometry.pose_arrays import COVARIANCE, POSES, SHARED
from rille.stages.odometry.resection.landmarks import (
    Landmarks,
    landmarks_from_dem,
    landmarks_from_disparity,
    matches_at,
    relief,
)
from rille.stages.odometry.resection.pnp import (
    Observations,
    Poses,
    back_projection,
    bias_information,
    levenberg_marquardt,
    normal_matrix,
    norms,
)

MINIMUM = 6
"""Fewest landmarks of a pose: twelve equations for six unknowns, so that one wrong landmark shows."""
FEW = "set track.points higher or choose basic pairs closer"
MOST_BLOCKS = 6
"""Blocks along either side of the image whose mean errors show how far neighbours' errors go together."""
PER_BLOCK = 6
"""Least mean number of landmarks per block."""
MOVING = 0.3
"""Share of the landmarks that agree with no pose, above which a warning is given."""
SOURCES = 7
"""Error sources that all segments share: one for each of the six pose parameters, and the bias of the disparities."""
AT_ONCE = 8
"""Per iteration, the worst ceil(n / 8) of n landmarks above the threshold are removed; then the pose is adjusted."""
SEARCHED = 9.0
"""Side [pixels] of the square around a prediction within which tracking finds a point, right or wrong: 2 * 4 + 1."""
PARTS = (0.25, 0.5, 1.0)
"""Shares of the threshold at which agreement is counted."""
FALSE_ALARMS = 0.01
"""Expected number of poses that chance alone makes in a frame whose tracks are all wrong: one in a hundred frames."""
SAMPLE = 4
"""Landmarks of one hypothesis: the fewest that fix a pose uniquely."""
AWAY = 2.0
"""Times the threshold from which on a landmark surely does not move as a pose says."""
SECOND_SHARE = 0.2
"""Share of the landmarks from which on a second motion puts the first in doubt: a vehicle ahead has less."""
BODY_SHARE = 0.1
"""The same where the landmarks that do not move in the image are all nearer, as the vehicle's own body is."""
LEAST_JUMP = 1.0
"""Median departure [pixels] of a basic pair's disparities from the pair's before from which on the rig was knocked;
of sound rigs it stays below 0.2."""
STILL = 0.5
"""Median displacement [pixels] below which landmarks do not move in the image."""


class AmbiguousError(DegenerateError):
    """Two motions have large support: which is the camera's, the landmarks do not tell."""


class ResectParams(Params):
    """Parameters of the stage ``resect``."""

    landmarks: Literal["disparity", "dem"] = Field(
        "disparity",
        description="source of landmark coordinates; disparity: triangulated match (more exact); dem: intersection "
        "with the elevation model, as in the paper",
    )
    pixel_sigma: float = Field(0.2, gt=0, description="standard deviation [pixels] of a tracked position")
    disparity_sigma: float = Field(
        0.2,
        ge=0,
        description="standard deviation [pixels] of the disparity under a landmark; moves the landmark along its ray",
    )
    bias_sigma: float = Field(
        0.1,
        ge=0,
        description="prior standard deviation [pixels] of an error common to all disparities (toe-in of the rig); 0: "
        "no such error",
    )
    threshold: float = Field(
        1.0,
        gt=0,
        description="largest back-projection error [pixels] of an inlier; the worst landmarks are removed until all "
        "are below; 1.0: 5 pixel_sigma",
    )
    max_depth_ratio: float = Field(
        0.2,
        gt=0,
        description="largest standard deviation of a landmark's distance over the distance; beyond, first-order error"
        " propagation fails",
    )
    max_position_ratio: float = Field(
        0.02,
        gt=0,
        description="largest standard deviation of the camera position over the landmarks' median distance; beyond, "
        "the pose counts as degenerate",
    )
    min_share: float = Field(
        0.15,
        ge=0,
        le=1,
        description="share of a frame's landmarks that must agree with its pose; 0.05 agree with a wrong pose by "
        "chance, since all are searched near their predictions",
    )
    hypotheses: int = Field(
        150,
        ge=1,
        description="random samples of four landmarks; 150 contain one without outliers with probability 0.9999 if "
        "half of the landmarks are outliers",
    )
    iterations: int = Field(50, ge=1, description="limit of Levenberg-Marquardt iterations; about 10 suffice")
    seed: int = Field(1999, ge=0, description="seed of the random samples")


@dataclass(frozen=True)
class Resection:
    """Pose of one frame.

    ``T_local_left``; ``covariance`` (6, 6) of (position m, rotation rad) in the local frame, without what is shared;
    ``shared`` (6, 7): pose errors per standard deviation of what all segments have in common; ``inlier`` (n,);
    ``residual`` (n,) back-projection error, pixels, of every landmark (NaN: behind the camera); ``bias`` of the
    disparities, pixels;
    ``condition`` of the normal matrix with unit diagonal; ``together``: how many times as far as independent errors the
    mean errors of image blocks scatter (variance), see :func:`scatter_of_blocks`.
    """

    T_local_left: RigidTransform
    covariance: Floats
    shared: Floats
    inlier: Bools
    residual: Floats
    bias: float
    iterations: int
    condition: float
    together: float

    @property
    def total(self) -> Floats:
        """Covariance (6, 6) of the pose, all errors together."""
        return np.asarray(self.covariance + self.shared @ self.shared.T)


def resect(
    landmarks: Landmarks,
    pixels: Floats,
    camera: Camera,
    starts: Sequence[RigidTransform],
    params: ResectParams,
    rng: np.random.Generator,
    *,
    where: str = "this frame",
) -> Resection:
    """Pose of a camera from landmarks and their image positions (Eq. 4-8), robustly.

    Parameters
    ----------
    landmarks : n of them, in the local frame; all finite.
    pixels : (n, 2) column, row.
    starts : predictions of T_local_left, which decide nothing but where the search starts.
    where : words for error messages ("frame 12").

    Raises
    ------
    DegenerateError
        Fewer than six landmarks (in all, or consistent), all on a line, or a pose that they do not determine.
    """
    _enough(len(pixels), where, "have coordinates and were found", FEW)
    _not_collinear(landmarks.position, where)
    obs = _observations(landmarks, pixels, camera, params)
    # The solver moves T_cam_local, callers speak of T_local_left.
    predictions = [Poses.of(T.inverse()) for T in starts]
    poses, near = _robust_start(obs, predictions, params, rng)
    poses, active, steps = _remove_inconsistent(obs, poses, near, params, where)
    if active.sum() < params.min_share * len(active):
        raise DegenerateError(
            "RIL-419",
            f"{where}: only {int(active.sum())} of {len(active)} landmarks agree with one pose",
            remedy="look at the image; or lower resect.min_share",
        )
    _not_by_chance(obs, poses, int(active.sum()), params, where)
    _not_collinear(landmarks.position[active], where)
    return _result(obs, poses, active, steps, params, where)


def _observations(landmarks: Landmarks, pixels: Floats, camera: Camera, params: ResectParams) -> Observations:
    known = landmarks.position[None], landmarks.per_pixel[None], landmarks.sigma[None]
    return Observations(*known, pixels[None], camera, params.pixel_sigma, params.bias_sigma)


def refuse_second_motion(
    landmarks: Landmarks,
    points: Floats32,
    camera: Camera,
    T_local_key: RigidTransform,
    found: Resection,
    params: ResectParams,
    rng: np.random.Generator,
) -> None:
    """Refuse the pose of a frame where many of the landmarks that it leaves agree with another pose.

    Either the camera moves and part of the view goes with it (the vehicle's own body), or it stands and part of the
    view moves: the images are alike. Landmarks that fit both poses, as those at infinity, speak for neither.

    Parameters
    ----------
    landmarks, points : all of the segment, and where they are (n, frames, 2) up to this frame, without the key; NaN
        none.
    found : by those that have both in this frame.

    Raises
    ------
    AmbiguousError
        Two motions have large support.
    """
    seen = np.asarray(np.isfinite(points).all(2))
    seen[~np.isfinite(landmarks.position).all(1)] = False
    # Of all that were seen: those at rest in the image stay in view while the others leave it.
    total, use = int(seen.any(1).sum()), np.flatnonzero(seen[:, -1])
    known, pixels = landmarks.take(use), points[use, -1].astype(np.float64)
    norm = norms(_observations(known, pixels, camera, params), Poses.of(found.T_local_left.inverse()))[0]
    left = np.flatnonzero(norm > AWAY * params.threshold / params.pixel_sigma)
    if len(left) < max(MINIMUM, BODY_SHARE * total):
        return
    try:
        # A part of the view that does not move in the image has the key's pose.
        other = resect(known.take(left), pixels[left], camera, [found.T_local_left, T_local_key], params, rng)
    except DegenerateError:
        return
    before = T_local_key.inverse().apply(known.position)
    shift = np.sqrt(((camera.project(before) - pixels) ** 2).sum(1))
    parts = [(np.flatnonzero(found.inlier), found), (left[other.inlier], other)]
    (still, rest), (moving, motion) = sorted(parts, key=lambda part: float(np.median(shift[part[0]])))
    stays = bool(np.median(shift[still]) < STILL)
    body = stays and bool(np.quantile(before[still, 2], 0.9) < np.quantile(before[moving, 2], 0.1))
    # The smaller part may be all that shows the motion only where the larger one is the vehicle itself.
    if len(parts[1][0]) < (BODY_SHARE if body and rest is found else SECOND_SHARE) * total:
        return
    moved = [float(np.linalg.norm(one.T_local_left.translation - T_local_key.translation)) for one in (rest, motion)]
    raise AmbiguousError(
        "RIL-770",
        f"two motions: {len(still)} of {total} landmarks ({len(still) / total:.0%}) "
        f"{'do not move in the image' if stays else f'moved by {moved[0]:.3g} m'}, "
        f"{len(moving)} ({len(moving) / total:.0%}) moved by {moved[1]:.3g} m",
        remedy="the still ones are the nearest: cut the vehicle's own body off the images, or mask it"
        if body
        else "leave out frames in which the camera stood, or cut off or mask what moves with it",
    )


def _robust_start(
    obs: Observations, predictions: list[Poses], params: ResectParams, rng: np.random.Generator
) -> tuple[Poses, Bools]:
    """The hypothesis that most landmarks agree with, adjusted to those; and which agree (n,).

    Locally optimised RANSAC (Chum, Matas, Kittler 2003, doi:10.1007/978-3-540-45243-0_31) with truncated squares as
    the score. Each prediction competes with samples of four landmarks that are adjusted from it.
    """
    n = obs.landmarks.shape[1]
    samples = _draw(rng, params.hypotheses, n)
    every, sampled = np.ones(samples.shape, bool), obs.take(samples)
    candidates = []
    for prediction in predictions:
        start = _repeat(prediction, params.hypotheses)
        # Ten loose steps: a hypothesis need only come within the bound, the best one is adjusted again.
        candidates += [prediction, levenberg_marquardt(sampled, start, every, 10, tolerance=1e-3)[0]]
    hypotheses = Poses(
        np.concatenate([c.R for c in candidates]),
        np.concatenate([c.t for c in candidates]),
        np.concatenate([c.bias for c in candidates]),
    )
    # Twice the threshold: four points fix a pose with errors of their own, which must not cost it its landmarks.
    bound = 2.0 * params.threshold / params.pixel_sigma
    # Truncated squares, not a count: of poses that as many landmarks agree with, the one they fit better.
    score = (np.minimum(norms(obs, hypotheses), bound) ** 2).sum(1)
    best = hypotheses.at(int(np.argmin(score)))
    for _ in range(2):
        active = norms(obs, best) <= bound
        if active.sum() >= SAMPLE:
            best, _ = levenberg_marquardt(obs, best, active, 10, tolerance=1e-6)
    return best, norms(obs, best)[0] <= bound


def _draw(rng: np.random.Generator, count: int, n: int) -> NDArray[np.intp]:
    """``count`` samples of :data:`SAMPLE` different numbers below n."""
    drawn = rng.random((count, n))
    least = np.argpartition(drawn, SAMPLE - 1, axis=1)[:, :SAMPLE]
    # A partition leaves the least in any order, which may differ between builds of numpy.
    order = np.argsort(np.take_along_axis(drawn, least, axis=1), axis=1)
    return np.take_along_axis(least, order, axis=1)


def _repeat(poses: Poses, count: int) -> Poses:
    return Poses(*(np.repeat(a, count, axis=0) for a in (poses.R, poses.t, poses.bias)))


def _remove_inconsistent(
    obs: Observations, poses: Poses, active: Bools, params: ResectParams, where: str
) -> tuple[Poses, Bools, int]:
    """The paper's rule: adjust, remove the most inconsistent, again until all are under the threshold."""
    bound = params.threshold / params.pixel_sigma
    steps = 0
    while True:
        _enough(int(active.sum()), where, "agree with one pose", "raise resect.threshold or choose basic pairs closer")
        poses, done = levenberg_marquardt(obs, poses, active[None], params.iterations, tolerance=1e-6)
        steps += done
        usable = _first_order(obs, poses, params)
        if (active & ~usable).any():
            active = active & usable
            continue
        norm = np.where(active, norms(obs, poses)[0], -1.0)
        beyond = int((norm > bound).sum())
        if beyond == 0:
            # Only the last adjustment needs the full accuracy.
            poses, done = levenberg_marquardt(obs, poses, active[None], params.iterations)
            return poses, active, steps + done
        active = active.copy()
        # Not all of them at once: the worst pull the pose, and others agree once these are gone.
        active[np.argsort(-norm, kind="stable")[: math.ceil(beyond / AT_ONCE)]] = False


def _first_order(obs: Observations, poses: Poses, params: ResectParams) -> Bools:
    """Which landmarks (n,) are so far before the camera that first-order errors hold.

    A camera that has come close to a landmark, or passed it, sees its error along the old ray at any size: such a
    landmark agrees with everything, thousands of pixels off.
    """
    depth = (obs.landmarks[0] @ poses.R[0].T + poses.t[0])[:, 2]
    return np.asarray(obs.sigma[0] * np.sqrt((obs.per_pixel[0] ** 2).sum(1)) <= params.max_depth_ratio * depth)


def _result(obs: Observations, poses: Poses, active: Bools, steps: int, params: ResectParams, where: str) -> Resection:
    errors = back_projection(obs, poses)
    normal, _, weight = normal_matrix(obs, errors, active[None])
    # A posteriori variance factor: the errors found, not the ones expected, set the scale.
    squares = (weight[0] * np.where(active, errors.norm[0], 0.0) ** 2).sum()
    factor = max(float(squares / (2 * active.sum() - 6)), 1e-12)
    R = poses.R[0]
    T, prior = RigidTransform(R, poses.t[0]).inverse(), bias_information(obs.bias_sigma)
    stated, bias, condition = _covariance(normal[0] / max(factor, 1.0), prior, R)
    depth = float(np.median((obs.landmarks[0][active] @ R.T + poses.t[0])[:, 2]))
    expected, other, _ = _covariance(normal[0], prior, R)
    position_sigma = float(np.sqrt(np.trace(expected[:3, :3]) + (other[:3] ** 2).sum()))
    if position_sigma > params.max_position_ratio * depth:
        raise DegenerateError(
            "RIL-420",
            f"{where}: {int(active.sum())} landmarks at a median distance of {depth:.3g} m leave the position uncertain"
            f" by {position_sigma:.2g} m (condition {condition:.1e})",
            remedy="they are too far, too few or in one direction: set track.points higher or use nearer texture",
        )
    covariance, _, _ = _covariance(normal[0] / factor, prior, R)
    shared = np.column_stack([root(stated - covariance, depth), bias])
    residual = np.where(np.isfinite(errors.norm[0]), np.sqrt((errors.pixels[0] ** 2).sum(-1)), np.nan)
    together = scatter_of_blocks(obs.pixels[0][active], errors.white[0][active], weight[0][active], obs.camera)
    return Resection(T, covariance, shared, active, residual, float(poses.bias[0]), steps, condition, together)


def scatter_of_blocks(pixels: Floats, white: Floats, weight: Floats, camera: Camera) -> float:
    """Return the ratio of the variance of block means of errors to that of independent errors; 1: independent.

    Neighbouring landmarks share matches, texture and relief, so their errors are correlated, and they determine the
    pose less well than as many independent ones. ``white`` (n, 2): whitened errors after adjustment, at ``pixels``
    (n, 2), with ``weight`` (n,). The six unknowns of the pose take up as many degrees of freedom of the means.
    """
    side = min(MOST_BLOCKS, int(math.sqrt(len(pixels) / PER_BLOCK)))
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


def _covariance(normal: Floats, prior: float, R_cam_local: Floats) -> tuple[Floats, Floats, float]:
    """Of position and rotation in the local frame: covariance (6, 6) by the measurements, error (6,) by the bias.

    The latter is that of one standard deviation of the prior: both together are the covariance of the adjustment. Also
    the condition of its matrix with unit diagonal. ``C = -R^T t`` and ``R^T`` change by ``-R^T v`` and ``-R^T w`` under
    a step (v, w).
    """
    full = normal + np.diag([0.0] * 6 + [prior])
    scale = np.sqrt(np.maximum(np.diag(full), 1e-300))
    values, vectors = np.linalg.eigh(full / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-300)) @ vectors.T / np.outer(scale, scale)
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = R_cam_local.T
    bias = math.sqrt(prior) * inverse[:6, 6]
    noise = inverse[:6, :6] - np.outer(bias, bias)
    return turn @ noise @ turn.T, turn @ bias, float(values[-1] / max(values[0], 1e-300))


def root(covariance: Floats, depth: float) -> Floats:
    """Symmetric root (6, 6) of a covariance, radians counted as what they move at a depth (m)."""
    unit = np.array([1.0] * 3 + [depth] * 3)
    values, vectors = np.linalg.eigh(covariance * np.outer(unit, unit))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T / unit[:, None])


def _enough(count: int, where: str, what: str, remedy: str) -> None:
    if count < MINIMUM:
        raise DegenerateError(
            "RIL-421", f"{where}: too few landmarks: {count} {what}, {MINIMUM} are needed", remedy=remedy
        )


def _not_by_chance(obs: Observations, poses: Poses, agree: int, params: ResectParams, where: str) -> None:
    """Refuse a pose that as many landmarks may agree with though none was found where it is.

    Any three landmarks fix a pose. Where the others were found by mistake, anywhere in what tracking searches, each
    agrees with the share of that area that is below the threshold; the number of false alarms is that of triples times
    the chance that so many others do (Desolneux, Moisan, Morel 2000, doi:10.1023/A:1026593302236), the least of some
    thresholds times their number: right landmarks agree better than they need to. A few landmarks of many tell nothing
    then, however small their residuals are.
    """
    n = obs.landmarks.shape[1]
    along = back_projection(obs, poses).per_pixel[0] * obs.sigma[0][:, None]
    stretch = np.sqrt(1.0 + (along**2).sum(1) / params.pixel_sigma**2)
    stretch = stretch[np.isfinite(stretch)]
    least = math.inf
    for part in PARTS:
        bound = part * params.threshold
        count = int((norms(obs, poses)[0] <= bound / params.pixel_sigma).sum())
        strip = min(2.0 * bound / SEARCHED, 1.0)  # the most that a long ellipse leaves of the square
        share = float(np.minimum(math.pi * (bound / SEARCHED) ** 2 * stretch, strip).mean())
        if share == 1.0:  # a threshold that every place passes was chosen so as to believe everything
            return
        if count >= MINIMUM:
            least = min(least, len(PARTS) * math.comb(n, 3) * float(scipy.special.bdtrc(count - 4, n - 3, share)))
    if least > FALSE_ALARMS:
        raise DegenerateError(
            "RIL-720",
            f"{where}: {agree} of {n} landmarks agree with one pose, which as many may do by chance",
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


@dataclass(frozen=True)
class SegmentPoses:
    """Poses of a segment's frames; see the stage's outputs. A lost frame has NaN, and its fact ``lost`` says why."""

    poses: Floats
    covariance: Floats
    shared: Floats
    inlier: Bytes
    residual: Floats32
    facts: list[dict[str, Any]]


def resect_segment(
    points: Floats32,
    landmarks: Landmarks,
    camera: Camera,
    T_local_key: RigidTransform,
    frames: list[int],
    params: ResectParams,
    reckoned: Sequence[RigidTransform | None] | None = None,
) -> SegmentPoses:
    """Poses of the frames of a segment, the key frame's given. A frame that cannot be posed is lost, the others go on.

    Parameters
    ----------
    points : (n, frames, 2) tracked column, row; NaN lost. Frame 0 is the key frame.
    landmarks : of the same n points, in the local frame of the key; NaN none.
    T_local_key : pose of the key frame's left camera.
    frames : frame numbers, for messages and seeds.
    reckoned : T_key_left of each frame by dead reckoning, where there is one; competes as a start.
    """
    n, count = points.shape[:2]
    out = SegmentPoses(
        np.full((count, 3, 4), np.nan),
        np.full((count, 6, 6), np.nan),
        np.full((count, 6, SOURCES), np.nan),
        np.zeros((n, count), np.uint8),
        np.full((n, count), np.nan, np.float32),
        [],
    )
    known = np.isfinite(landmarks.position).all(1)
    pose, together = T_local_key, list[float]()
    doubt: AmbiguousError | None = None
    out.poses[0], out.covariance[0], out.shared[0] = pose.matrix34, 0.0, 0.0
    for j in range(count):
        use = np.flatnonzero(known & np.isfinite(points[:, j]).all(1))
        if j == 0:
            out.inlier[use, 0], out.residual[use, 0] = 1, 0.0
            out.facts.append(_facts(frames[0], use.size, use.size, 0.0, None))
            continue
        try:
            # What is in doubt stays so: later frames see fewer of the landmarks that told the motions apart.
            if doubt:
                raise doubt
            starts = [T_local_key, pose, *_reckoned(T_local_key, reckoned, j)]
            found = _resect_one(landmarks, points[:, 1 : j + 1], use, camera, starts, params, frames[j])
        except DegenerateError as error:
            cause = error.message.removeprefix(f"frame {frames[j]}: ")
            out.facts.append(_facts(frames[j], use.size, 0, None, None) | {"lost": cause})
            if isinstance(error, AmbiguousError) and not doubt:
                out.facts[-1]["contradiction"] = f"frame {frames[j]} shows {cause}: {error.remedy}"
                doubt = AmbiguousError(error.code, f"two motions since frame {frames[j]}")
            continue
        pose = found.T_local_left
        out.poses[j], out.covariance[j], out.shared[j] = pose.matrix34, found.covariance, found.shared
        out.inlier[use, j], out.residual[use, j] = found.inlier, found.residual
        rms = float(np.sqrt(np.mean(found.residual[found.inlier] ** 2)))
        out.facts.append(_facts(frames[j], use.size, int(found.inlier.sum()), rms, found))
        together.append(found.together)
    # One frame's figure scatters by a fifth, a segment's frames share their landmarks.
    out.covariance[:] *= max(1.0, float(np.mean(together))) if together else 1.0
    out.covariance[:] += out.shared @ np.swapaxes(out.shared, 1, 2)
    return out


def _reckoned(
    T_local_key: RigidTransform, reckoned: Sequence[RigidTransform | None] | None, j: int
) -> list[RigidTransform]:
    return [] if reckoned is None or (T := reckoned[j]) is None else [T_local_key @ T]


def _resect_one(
    landmarks: Landmarks,
    points: Floats32,
    use: NDArray[np.intp],
    camera: Camera,
    starts: Sequence[RigidTransform],
    params: ResectParams,
    frame: int,
) -> Resection:
    """The last frame of ``points`` (n, frames, 2), by those that are used; ``starts``: the key's pose, then others."""
    where = f"frame {frame}"
    if use.size < MINIMUM:
        what = f"of {len(points)} tracked points have coordinates and were found ({landmarks.summary()})"
        _enough(use.size, where, what, FEW)
    # Seeded by the frame: its pose does not depend on how many frames were posed before it.
    rng = np.random.default_rng([params.seed, frame])
    pixels = points[use, -1].astype(np.float64)
    found = resect(landmarks.take(use), pixels, camera, starts[1:], params, rng, where=where)
    refuse_second_motion(landmarks, points, camera, starts[0], found, params, rng)
    return found


def _facts(frame: int, seen: int, inliers: int, rms: float | None, found: Resection | None) -> dict[str, Any]:
    return {
        "frame": frame,
        "landmarks": seen,
        "inliers": inliers,
        "rms_px": rms,
        "iterations": found.iterations if found else 0,
        "condition": found.condition if found else None,
        "disparity_bias_px": found.bias if found else None,
        "errors_together": found.together if found else None,
    }


def moving_tracks(points: Floats32, landmarks: Landmarks, found: SegmentPoses) -> tuple[int, int]:
    """Count the landmarks that were found in two or more frames with a pose, and those of them that fit no pose.

    A point that is tracked well and never fits is not fixed to the ground (the vehicle's own shadow, its wheels, other
    moving things), or its coordinates are wrong (a match on the edge of a rock).
    """
    posed = np.asarray(np.isfinite(found.poses).all(axis=(1, 2)))
    posed[0] = False
    known = np.asarray(np.isfinite(landmarks.position).all(axis=1))
    seen = np.asarray(np.isfinite(points).all(axis=2)) & posed & known[:, None]
    often = seen.sum(axis=1) >= 2
    agrees = (found.inlier != 0) & seen
    return int(often.sum()), int((often & ~agrees.any(axis=1)).sum())


def knocked(
    points: Floats, found: SegmentPoses, landmarks: Landmarks, after: Bundle, rig: Rig
) -> tuple[str, list[float]] | None:
    """A line and a jump, px, where the basic pair at the segment's end contradicts the landmarks: the rig has moved.

    A turn of a camera to the side shows in no row of one pair, but all its disparities jump by as much.

    Parameters
    ----------
    points : (n, 2) column, row in that pair's left image; NaN lost.
    after, rig : disparity and rig of that pair.
    """
    pose = found.poses[-1]
    names = ("column_disparity", "row_disparity", "validity")
    disparity, matched = matches_at(points, *(np.asarray(after[name]) for name in names))
    use = matched & (found.inlier[:, -1] != 0)
    if not np.isfinite(pose).all() or use.sum() < MINIMUM:
        return None
    at = RigidTransform.from_matrix(pose).inverse().apply(landmarks.position[use])
    expected = rig.right.project(rig.T_right_left.apply(at)) - rig.left.project(at)
    jump = np.median(disparity[use] - expected, axis=0)
    if np.linalg.norm(jump) <= LEAST_JUMP:
        return None
    line = (
        f"the rig moved at pair {found.facts[-1]['frame']}: its disparities depart by {jump[0]:+.1f} px in the column, "
        f"{jump[1]:+.1f} px in the row from those of pair {found.facts[0]['frame']}"
    )
    return line, jump.tolist()


def _moving_words(frames: list[int], tracks: int, moving: int) -> list[str]:
    if tracks == 0 or moving < MOVING * tracks:
        return []
    return [
        f"frames {frames[0]}-{frames[-1]}: {moving} of {tracks} tracked landmarks agree with no pose: does something"
        " move in view (a shadow, a wheel)?"
    ]


def coordinates(
    points: Floats,
    rig: Rig,
    T_local_key: RigidTransform,
    params: ResectParams,
    *,
    disparity: Bundle | None,
    dem: Bundle[DemFacts] | None = None,
) -> Landmarks:
    """Landmarks of the key frame's points from the source that the parameters name."""
    source = disparity if params.landmarks == "disparity" else dem
    if source is None:
        raise InputError(
            "RIL-424",
            f"resect.landmarks={params.landmarks!r} but no {params.landmarks} was computed",
            remedy=f"connect the input {params.landmarks!r}",
        )
    sigma = np.full(len(points), params.disparity_sigma)
    if disparity is not None:
        column, row, validity = (np.asarray(disparity[n]) for n in ("column_disparity", "row_disparity", "validity"))
        sigma = np.hypot(sigma, relief(points, column, row, validity))
        if params.landmarks == "disparity":
            return landmarks_from_disparity(
                points, (column, row, validity), rig, T_local_key, sigma, max_depth_ratio=params.max_depth_ratio
            )
    lattice = Lattice.from_dict(source.meta["lattice"])
    elevation = np.asarray(source["elevation"])
    return landmarks_from_dem(
        points, elevation, lattice, rig, T_local_key, sigma, max_depth_ratio=params.max_depth_ratio
    )


@stage(
    "resect",
    version=3,
    outputs=[
        replace(POSES, frame="local"),
        replace(COVARIANCE, frame="local"),
        replace(SHARED, frame="local"),
        Array("inlier", ("point", "frame"), "uint8", "1", "landmark agrees with the pose", nodata="0"),
        Array("landmarks", ("point", "xyz"), "float64", "m", "coordinates of the landmarks", "nan", "local"),
        Array("residual", ("point", "frame"), "float32", "px", "back-projection error", nodata="nan"),
    ],
)
def resect_stage(
    params: ResectParams,
    track: Bundle[TrackFacts],
    level: Bundle[GroundFacts],
    rig: Bundle[CalibrationFacts],
    dem: Bundle[DemFacts] | None = None,
    disparity: Bundle | None = None,
    after: Bundle | None = None,
    rig_after: Bundle[CalibrationFacts] | None = None,
    *,
    prediction: Sequence[Sequence[float] | None] | None = None,
    refused: str | None = None,
) -> Bundle[ResectFacts]:
    """Poses of a segment's frames in the local frame of its basic pair."""
    own = Rig.from_dict(rig.meta["rig"])
    T_local_key = RigidTransform.from_matrix(level.meta["T_local_left"])
    points = np.asarray(track["points"])
    landmarks = coordinates(points[:, 0].astype(np.float64), own, T_local_key, params, disparity=disparity, dem=dem)
    frames = track.meta["frames"]
    reckoned = None
    if prediction is not None:
        reckoned = [None if T is None else RigidTransform.from_matrix(T) for T in prediction]
        if len(reckoned) != len(frames):
            raise InputError("RIL-423", f"{len(frames)} frames need {len(frames)} predicted poses, not {len(reckoned)}")
    if refused is not None:
        # Of a rig that was knocked: what it measures is worth no pose.
        points = np.where(np.arange(len(frames))[:, None] == 0, points, np.float32(np.nan))
    found = resect_segment(points, landmarks, own.left, T_local_key, frames, params, reckoned)
    for fact in found.facts[1:] if refused is not None else ():
        fact["lost"] = refused
    arrays: dict[str, AnyArray] = {
        "poses": found.poses,
        "covariance": found.covariance,
        "shared": found.shared,
        "inlier": found.inlier,
        "landmarks": landmarks.position,
        "residual": found.residual,
    }
    tracks, moving = moving_tracks(points, landmarks, found)
    meta: ResectFacts = {
        "per_frame": found.facts,
        "landmark_source": params.landmarks,
        "without_coordinates": landmarks.lost,
        "tracks": tracks,
        "moving_tracks": moving,
        "warnings": _moving_words(frames, tracks, moving),
    }
    if after is not None and rig_after is not None:
        theirs = Rig.from_dict(rig_after.meta["rig"])
        if (jumped := knocked(points[:, -1].astype(np.float64), found, landmarks, after, theirs)) is not None:
            meta["knocked"], meta["jump"] = jumped
            meta["warnings"] = [f"{jumped[0]}: calibrate anew from there on"]
    for line in [fact["contradiction"] for fact in found.facts if "contradiction" in fact]:
        meta["contradiction"], meta["warnings"] = line, [line]
    return Bundle(arrays, meta)
