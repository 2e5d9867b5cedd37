"""Joint refinement of a segment: all its poses and the depths of its landmarks at once, and the next pair's stereo.

Resection poses each frame by itself, with landmarks as the key pair's disparity has them. Here the landmarks' depths
are unknowns, too, each held by its disparity: a point that four frames see from four places says more of its depth than
its disparity alone. Where the segment ends at another basic pair, that pair's disparity at the tracked points is a
second measurement of their depths. What all disparities share is one unknown of a window of segments, since one rig
made them.

Another error that they share shows over the whole sequence only. A right image whose rows lie too low may have been
turned (pitch), or have its principal point there; epipolar lines hardly tell the two apart, and a rig that is repaired
takes the turn. The wrong choice tilts disparities: by ``f x y`` a radian, nothing along both axes of the image and most
in its corners, which bends the path to one side. Tracks see depth once more, by parallax, so all segments together
measure the tilt; where it is beyond doubt, all are adjusted once more without it.

Least squares with Huber's weights, by Levenberg-Marquardt. A landmark has one unknown (along its ray), so that its
elimination (Schur's complement) is a division, and the system has the size of the poses (Triggs, McLauchlan, Hartley,
Fitzgibbon 2000, doi:10.1007/3-540-44480-7_21). The result is never worse than its input by the same cost: where no step
lowers it, the input is returned.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stages import refine_kernel as kernel
from stages.declare import Array, Bundle, Inputs, Params, Stage
from stages.errors import ConfigError
from stages.geometry import Camera, Rig, RigidTransform
from stages.landmarks import Landmarks, matches_at, relief
from stages.reprojection import HUBER, Observations, Poses, cross_matrix, exponential, norms
from stages.resect import ResectParams, coordinates

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

FIRST_DAMPING, MOST_DAMPING = 1e-4, 1e8
AGREES = 5.0
"""Standard deviations within which the next pair's disparity must agree with the start to be used at all."""


class RefineParams(Params):
    """Parameters of the joint refinement."""

    enabled: bool = Field(
        default=True,
        description="refine the poses of segments jointly with their landmarks, where these are of the disparity",
    )
    window: int = Field(
        default=1,
        ge=0,
        description="segments that are adjusted together, the last of them for good; 0: all of the sequence at once",
    )
    stereo: bool = Field(
        default=False,
        description="use the disparity of the basic pair at a segment's end as a second measurement; it shares its"
        " errors with the first one, and gains little",
    )
    iterations: int = Field(default=20, ge=1, description="limit of Levenberg-Marquardt steps; five are usual")
    pixel_sigma: float = Field(default=0.2, gt=0, description="pixels; expected error of a tracked position")
    disparity_sigma: float = Field(default=0.2, gt=0, description="pixels; expected error of the next pair's disparity")
    bias_sigma: float = Field(
        default=0.1, ge=0, description="pixels; prior of the error that all disparities share (toe-in of the rig)"
    )
    tilt_sigma_deg: float = Field(
        default=0.3,
        ge=0,
        description="degrees; prior of the pitch that may stand for a principal point's row: 0.5 % of the focal length,"
        " as in rig.prior_principal; 0: none is looked for",
    )
    tilt_significance: float = Field(
        default=4.0, ge=0, description="standard deviations, by the scatter of segments, from which on it is undone"
    )


@dataclass(frozen=True)
class Views:
    """Measurements of one segment.

    ``position``, ``along`` (n, 3) of the landmarks in the local frame, and how they move with their disparity, m and
    m/pixel; ``sigma`` (n,) of it, pixels. ``pixels`` (frame, n, 2) of the frames behind the key, ``seen`` (frame, n)
    whether they count. ``right`` (n, 2) of the last frame, pixels, ``right_sigma`` (n,); NaN none. ``tilt`` (n,) pixels
    of disparity a radian of pitch that stands for a principal point's row.
    """

    position: Floats
    along: Floats
    sigma: Floats
    pixels: Floats
    seen: Bools
    right: Floats
    right_sigma: Floats
    camera: Camera
    rig: Rig
    tilt: Floats

    def without_tilt(self, tilt: float) -> Views:
        """With landmarks where they are if the disparities are tilted by so many radians."""
        return replace(self, position=self.position + (tilt * self.tilt)[:, None] * self.along)


@dataclass(frozen=True)
class State:
    """``R`` (frame, 3, 3), ``t`` (frame, 3) of T_cam_local behind the key; ``depth`` (n,) corrections, pixels."""

    R: Floats
    t: Floats
    depth: Floats

    def moved(self, pose: Floats, depth: Floats) -> State:
        """After steps (frame, 6) ``v, w`` as in :mod:`stages.reprojection`, and (n,)."""
        turn = exponential(pose[:, 3:])
        t = np.einsum("fij,fj->fi", turn, self.t) + pose[:, :3]
        return State(turn @ self.R, t, self.depth + depth)


Segment = tuple[Views, State, list[int]]
"""Measurements of a segment, where its adjustment starts, and which of its frames have a pose."""


def _camera_errors(x: Floats, moves: Floats, camera: Camera, pixels: Floats) -> tuple[Floats, Floats, Floats]:
    """Errors (..., 2), derivatives (..., 2, 3) by camera coordinates ``x``, and along ``moves`` (..., 2)."""
    z = np.where(x[..., 2] > 1e-6, x[..., 2], np.nan)
    u, v = x[..., 0] / z, x[..., 1] / z
    error = np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], -1) - pixels
    P = np.zeros((*z.shape, 2, 3))
    P[..., 0, 0], P[..., 0, 2] = camera.fx / z, -camera.fx * u / z
    P[..., 1, 1], P[..., 1, 2] = camera.fy / z, -camera.fy * v / z
    return error, P, np.einsum("...ij,...j->...i", P, moves)


def _stereo_rows(views: Views, state: State, bias: float) -> tuple[Floats, Floats, Floats, Floats, Bools]:
    """Disparities (along their epipolar lines) of the last frame's pair: only its right minus its left image counts.

    Whitened errors (n,), derivatives by the last pose (n, 6), by depth and by bias (n,), use.
    """
    use = np.isfinite(views.right_sigma)
    R = state.R[-1]
    x = (views.position + (state.depth + bias)[:, None] * views.along) @ R.T + state.t[-1]
    moves = views.along @ R.T
    T, pixels = views.rig.T_right_left, views.pixels[-1]
    left, P, g = _camera_errors(x, moves, views.camera, pixels)
    right, Q, h = _camera_errors(x @ T.rotation.T + T.translation, moves @ T.rotation.T, views.rig.right, views.right)
    rays = (x / np.where(x[:, 2:] > 0, x[:, 2:], np.nan)) @ T.rotation.T
    _, _, slope = _camera_errors(x @ T.rotation.T + T.translation, rays, views.rig.right, views.right)
    unit = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    s = np.where(use, views.right_sigma, 1.0)
    change = Q @ T.rotation - P
    by_pose = np.concatenate([change, np.einsum("nij,njk->nik", change, -cross_matrix(x))], -1)
    error = ((right - left) * unit).sum(-1) - bias
    by_depth = ((h - g) * unit).sum(-1)
    by_pose = np.einsum("ni,nij->nj", unit, by_pose) / s[:, None]
    good = use & np.isfinite(error) & np.isfinite(by_pose).all(-1)
    rows = (np.where(good, a, 0.0) for a in (error / s, by_depth / s, (by_depth - 1.0) / s))
    error, by_depth, by_bias = rows
    return error, np.where(good[:, None], by_pose, 0.0), by_depth, by_bias, good


def _tracks(views: Views, state: State, bias: float, sigma: float) -> tuple[Any, ...]:
    """What the compiled loops want of the tracks."""
    camera = views.camera
    cam = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
    given = (views.position, views.along, views.pixels, views.seen, cam, float(sigma), HUBER)
    return (*given, state.R, state.t, state.depth + bias)


def cost_of(views: Views, state: State, bias: float, sigma: float) -> float:
    """Huber's cost of a segment with its depths' priors (that of the bias is the window's)."""
    total = 0.5 * float(((state.depth / views.sigma) ** 2).sum())
    total += float(kernel.cost(*_tracks(views, state, bias, sigma)))
    if np.isfinite(views.right_sigma).any():
        error, *_, use = _stereo_rows(views, state, bias)
        norm = np.abs(error[use])
        total += float(np.where(norm <= HUBER, 0.5 * norm**2, HUBER * norm - 0.5 * HUBER**2).sum())
    return total


def _normal(views: Views, state: State, bias: float, sigma: float) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """``A`` (p, p), ``B`` (p, n), ``d`` (n,), gradients (p,) and (n,): p of the poses and the bias, n depths."""
    m, n = len(state.R), len(state.depth)
    A, B, d = np.zeros((6 * m + 1, 6 * m + 1)), np.zeros((6 * m + 1, n)), views.sigma**-2.0
    ga, gd = np.zeros(6 * m + 1), state.depth * d
    kernel.normal(*_tracks(views, state, bias, sigma), A, B, d, ga, gd)
    if np.isfinite(views.right_sigma).any():
        error, pose, g, c, use = _stereo_rows(views, state, bias)
        w = np.where(use, HUBER / np.maximum(np.abs(error), HUBER), 0.0)
        J = np.zeros((n, 6 * m + 1))
        J[:, 6 * (m - 1) : 6 * m], J[:, -1] = pose, c
        weighted = J * w[:, None]
        A += weighted.T @ J
        B += weighted.T * g
        ga += weighted.T @ error
        d, gd = d + w * g**2, gd + w * g * error
    return A, B, d, ga, gd


def adjust(segments: Sequence[tuple[Views, State]], params: RefineParams) -> tuple[list[State], float, float, float]:
    """Minimise the cost of some segments with one bias; states, bias (pixels), cost before and after."""
    prior, sigma = 1.0 / max(params.bias_sigma, 1e-4) ** 2, params.pixel_sigma
    views, states = [v for v, _ in segments], [s for _, s in segments]
    bias, damping = 0.0, FIRST_DAMPING

    def cost(at: Sequence[State], b: float) -> float:
        return 0.5 * prior * b * b + sum(cost_of(v, s, b, sigma) for v, s in zip(views, at, strict=True))

    first = now = cost(states, bias)
    for _ in range(params.iterations):
        parts = [_normal(v, s, bias, sigma) for v, s in zip(views, states, strict=True)]
        while damping < MOST_DAMPING:
            step_bias, steps = _step(parts, prior, bias, damping)
            ahead = [s.moved(pose, depth) for s, (pose, depth) in zip(states, steps, strict=True)]
            then = cost(ahead, bias + step_bias)
            if then < now:
                break
            damping *= 10.0
        else:
            break
        finished = now - then <= 1e-9 * now
        states, bias, now, damping = ahead, bias + step_bias, then, max(0.1 * damping, 1e-12)
        if finished:
            break
    return states, bias, first, now


def _step(
    parts: Sequence[tuple[Floats, Floats, Floats, Floats, Floats]], prior: float, bias: float, damping: float
) -> tuple[float, list[tuple[Floats, Floats]]]:
    """Damped steps: of the bias, and of poses (frame, 6) and depths (n,) of each segment."""
    corner, right, kept = prior * (1.0 + damping), -prior * bias, []
    for A, B, d, ga, gd in parts:
        d = d * (1.0 + damping)
        S = A + damping * np.diag(np.diag(A)) - (B / d) @ B.T
        r = -(ga - B @ (gd / d))
        solved = np.linalg.solve(S[:-1, :-1], np.column_stack([S[:-1, -1], r[:-1]]))
        corner += S[-1, -1] - S[-1, :-1] @ solved[:, 0]
        right += r[-1] - S[-1, :-1] @ solved[:, 1]
        kept.append((solved, B, d, gd))
    common = right / corner
    steps = []
    for solved, B, d, gd in kept:
        pose = np.append(solved[:, 1] - common * solved[:, 0], common)
        steps.append((pose[:-1].reshape(-1, 6), -(gd + B.T @ pose) / d))
    return float(common), steps


def common_tilt(adjusted: Sequence[tuple[Views, State, float]], params: RefineParams) -> tuple[float, float]:
    """Tilt that all disparities share and its standard deviation, radians, by adjusted segments and their biases.

    To first order about the adjusted states. The segments' own values scatter by more than their errors, for their
    landmarks are few and near each other; the scatter decides. Infinite deviation: fewer than three segments.
    """
    parts = np.array([_tilt_of(*one, params) for one in adjusted]).reshape(-1, 2)
    parts = parts[parts[:, 0] > 0]
    if len(parts) < 3:
        return 0.0, float("inf")
    information, value = parts[:, 0], parts[:, 1] / parts[:, 0]
    for _ in range(5):  # of a segment that is far off, no more than of one at two deviations
        tilt = float((information * value).sum() / information.sum())
        off = np.abs(value - tilt) * np.sqrt(information)
        spread = max(1.0, 1.4826 * float(np.median(off)))
        information = parts[:, 0] * np.minimum(1.0, 2.0 * spread / np.maximum(off, 1e-12))
    total = float(information.sum()) / spread**2
    prior = math.radians(params.tilt_sigma_deg) ** -2.0
    return tilt * total / (total + prior), (total + prior) ** -0.5


def _tilt_of(views: Views, state: State, bias: float, params: RefineParams) -> tuple[float, float]:
    """Information and pull of the tilt by one segment, its poses, depths and bias free."""
    A, B, d, ga, gd = _normal(views, state, bias, params.pixel_sigma)
    prior = 1.0 / max(params.bias_sigma, 1e-4) ** 2
    A[-1, -1] += prior
    ga[-1] += prior * bias
    held, g = views.sigma**-2.0, views.tilt
    by_depth = g * (d - held)
    column = np.append(B @ g, g @ by_depth)
    A = np.column_stack([np.vstack([A, column[:-1]]), column])
    B = np.vstack([B, by_depth])
    S = A - (B / d) @ B.T
    r = -(np.append(ga, g @ (gd - held * state.depth)) - B @ (gd / d))
    solved = np.linalg.solve(S[:-1, :-1], np.column_stack([S[:-1, -1], r[:-1]]))
    information, pull = S[-1, -1] - S[-1, :-1] @ solved[:, 0], r[-1] - S[-1, :-1] @ solved[:, 1]
    return float(information), float(pull)


def views_of(
    track: Bundle, resection: Bundle, landmarks: Landmarks, rig: Rig, after: Bundle | None, params: RefineParams
) -> Segment | None:
    """Measurements and start of a segment, and which of its frames are posed; None: fewer than one behind the key.

    Parameters
    ----------
    landmarks : of all points of the track, in the local frame.
    after : disparity of the pair at the segment's end, where there is one.
    """
    poses = np.asarray(resection["poses"])
    frames = [j for j in range(1, len(poses)) if np.isfinite(poses[j]).all()]
    inlier = np.asarray(resection["inlier"]) != 0
    which = (
        np.flatnonzero(np.isfinite(landmarks.position).all(1) & inlier[:, frames].any(1))
        if frames
        else np.zeros(0, np.intp)
    )
    if not len(which):
        return None
    points = np.asarray(track["points"], dtype=np.float64)[which]
    known, pixels = landmarks.take(which), np.ascontiguousarray(np.swapaxes(points[:, frames], 0, 1))
    right, sigma = np.full((len(which), 2), np.nan), np.full(len(which), np.nan)
    if after is not None and params.stereo and frames[-1] == len(poses) - 1:
        right, sigma = _stereo(pixels[-1], inlier[which, frames[-1]], after, params)
    T = [RigidTransform.from_matrix(poses[j]).inverse() for j in frames]
    state = State(np.array([p.rotation for p in T]), np.array([p.translation for p in T]), np.zeros(len(which)))
    seen = np.ascontiguousarray(inlier[which][:, frames].T)
    camera, tilt = rig.left, _tilt_pattern(known.position, RigidTransform.from_matrix(poses[0]), rig)
    held = np.maximum(known.sigma, 1e-3)
    views = Views(known.position, known.per_pixel, held, pixels, seen, right, sigma, camera, rig, tilt)
    if np.isfinite(sigma).any():  # what disagrees altogether lies on another surface
        error, *_, use = _stereo_rows(views, state, 0.0)
        views.right_sigma[~(use & (np.abs(error) < AGREES))] = np.nan
    return views, state, frames


def _tilt_pattern(position: Floats, T_local_key: RigidTransform, rig: Rig) -> Floats:
    """Pixels (n,) along its line that a landmark's right image moves for a radian across it: ``f x y``."""
    x, y, z = rig.T_right_left.apply(T_local_key.inverse().apply(position)).T
    return np.asarray(np.where(z > 0, rig.right.fx * x * y / np.where(z > 0, z, 1.0) ** 2, 0.0))


def _stereo(pixels: Floats, use: Bools, after: Bundle, params: RefineParams) -> tuple[Floats, Floats]:
    """Right image (n, 2) of points of the last frame by its own pair's disparity, and the standard deviation of it."""
    maps = [np.asarray(after[name]) for name in ("column_disparity", "row_disparity", "validity")]
    shift, matched = matches_at(pixels, maps[0], maps[1], maps[2])
    sigma = np.hypot(params.disparity_sigma, relief(pixels, maps[0], maps[1], maps[2]))
    good = use & matched & np.isfinite(sigma)
    return np.where(good[:, None], pixels + shift, np.nan), np.where(good, sigma, np.nan)


def _run(params: RefineParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    resect = ResectParams.model_validate(args["resect"])
    if resect.landmarks != "disparity":
        raise ConfigError(
            "refine needs landmarks of the disparity", remedy="set resect.landmarks=disparity or refine.enabled=false"
        )
    disparity = {int(k): b for k, b in zip(args["pairs"], inputs["disparities"], strict=True)}
    rigs = {int(k): Rig.from_dict(b.meta["rig"]) for k, b in zip(args["pairs"], inputs["rigs"], strict=True)}
    given: list[_Given] = []
    poses: list[Floats] = []
    for track, resection, level in zip(inputs["tracks"], inputs["resections"], inputs["levels"], strict=True):
        frames = [int(f) for f in track.meta["frames"]]
        rig, T = rigs[frames[0]], RigidTransform.from_matrix(level.meta["T_local_left"])
        points = np.asarray(track["points"])[:, 0].astype(np.float64)
        landmarks = coordinates(points, {"disparity": disparity[frames[0]]}, rig, T, resect)
        given.append(_Given(track, resection, landmarks, rig, disparity.get(frames[-1])))
        poses.append(np.array(resection["poses"], dtype=np.float64))
    found = [views_of(*vars(one).values(), params) for one in given]
    facts, states = _adjusted(found, poses, params)
    tilt, sigma = 0.0, float("inf")
    if params.tilt_sigma_deg > 0:
        tilt, sigma = common_tilt([(found[k][0], *state) for k, state in states.items()], params)
    undone = abs(tilt) > params.tilt_significance * sigma
    if undone:
        again = [one and (one[0].without_tilt(tilt), states[k][0], one[2]) for k, one in enumerate(found)]
        _adjusted(again, poses, params)
        judged = [_anew(*pair, tilt, resect, params) for pair in zip(given, poses, strict=True)]
        facts, _ = _adjusted(judged, poses, params)
    same = sum(f["cost_after"] >= f["cost_before"] for f in facts)
    words = [f"refinement lowers the residuals of {same} of {len(facts)} windows no further: they stay as resected"]
    meta: dict[str, Any] = {"frames": [len(p) for p in poses], "adjustments": facts, "notes": words if same else []}
    if math.isfinite(sigma):
        meta["tilt"] = {"deg": math.degrees(tilt), "sigma_deg": math.degrees(sigma), "undone": undone}
    if undone:
        meta["warnings"] = [_tilted(tilt, sigma, next(iter(rigs.values())))]
    return Bundle({"poses": np.concatenate(poses)}, meta)


@dataclass(frozen=True)
class _Given:
    """What :func:`views_of` wants of a segment."""

    track: Bundle
    resection: Bundle
    landmarks: Landmarks
    rig: Rig
    after: Bundle | None


def _anew(given: _Given, poses: Floats, tilt: float, resect: ResectParams, params: RefineParams) -> Segment | None:
    """A segment without the tilt, its landmarks judged once more by poses: the tilt had made good ones inconsistent."""
    tracked = np.isfinite(np.asarray(given.track["points"])).all(-1)
    resection = Bundle({"poses": poses, "inlier": tracked.astype(np.uint8)}, {})
    one = views_of(given.track, resection, given.landmarks, given.rig, given.after, params)
    if one is None:
        return None
    (views, state, rows), most = one, resect.threshold / resect.pixel_sigma
    views = views.without_tilt(tilt)
    for f in range(len(rows)):
        data = (views.position, views.along, views.sigma, views.pixels[f])
        seen = Observations(*(a[None] for a in data), views.camera, resect.pixel_sigma, resect.bias_sigma)
        views.seen[f] &= norms(seen, Poses(state.R[f : f + 1], state.t[f : f + 1], np.zeros(1)))[0] <= most
    return views, state, rows


def _tilted(tilt: float, sigma: float, rig: Rig) -> str:
    return (
        f"the tracks contradict the disparities: {math.degrees(abs(tilt)):.2f} +- {math.degrees(sigma):.2f} degrees of"
        f" pitch stand for a principal point that is {abs(tilt) * rig.right.fy:.1f} rows off; undone in the trajectory,"
        " not in elevations: calibrate anew"
    )


def _adjusted(
    found: Sequence[Segment | None], poses: list[Floats], params: RefineParams
) -> tuple[list[dict[str, float]], dict[int, tuple[State, float]]]:
    """Windows adjusted, ``poses`` written to; facts of the windows, and state and bias of each segment."""
    facts: list[dict[str, float]] = []
    last: dict[int, tuple[State, float]] = {}
    for group, kept in _windows([k for k, one in enumerate(found) if one is not None], params.window):
        parts = [one for k in group if (one := found[k]) is not None]
        states, bias, before, after = adjust([(views, state) for views, state, _ in parts], params)
        for k, (_, _, rows), state in zip(group, parts, states, strict=True):
            if k in kept:
                last[k] = state, bias
                for row, R, t in zip(rows, state.R, state.t, strict=True):
                    poses[k][row] = RigidTransform(R, t).inverse().matrix34
        facts.append({"bias_px": bias, "cost_before": before, "cost_after": after})
    return facts, last


def _windows(segments: list[int], window: int) -> list[tuple[list[int], list[int]]]:
    """Segments that are adjusted together, and those of them that are kept: the last, or all of the one window."""
    if window == 0:
        return [(segments, segments)] if segments else []
    return [(segments[max(0, k + 1 - window) : k + 1], [s]) for k, s in enumerate(segments)]


STAGE = Stage(
    name="refine",
    version=1,
    summary="poses of segments adjusted jointly with their landmarks",
    params=RefineParams,
    inputs=("tracks*", "resections*", "levels*", "disparities*", "rigs*"),
    outputs=(
        Array(
            "poses",
            ("frame", "row", "col"),
            "float64",
            "m",
            "poses of all segments, one after the other",
            "nan",
            "local",
        ),
    ),
    requires=("numpy", "numba"),
    run=_run,
)
