"""Calibration of two cameras and of their relative pose from views of one flat board.

All corners of all views are adjusted together: both cameras with their distortion, the pose of the right camera in the
left one's frame, and the pose of the board in each view. OpenCV gives the projection with its derivatives and the start
of each camera (Zhang 2000, doi:10.1109/34.888718). The common adjustment is made here, because OpenCV's own gives no
errors of the relative pose, and because a bad view must show in its own residual and not in all others.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.errors import DegenerateError, InputError, warning
from rille.stages.geometry.epipolar import line_distances
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, Sizes, orthonormal, rotation_exp
from rille.stages.geometry.lens import COEFFICIENTS, Lens
from rille.stages.geometry.rigid import angle
from rille.stages.numeric.least_squares import NormalEquations, levenberg_marquardt

MODELS: Mapping[str, tuple[str, ...]] = {name: keys for name, keys in COEFFICIENTS.items() if keys} | {
    "radtan4": COEFFICIENTS["radtan"][:4]
}
"""Names of the coefficients of each model; radtan4 is radtan without k3."""

LEAST_VIEWS = 3
"""Two views just determine a camera: a bad one would not show."""

CORNER_SCALE = 0.5
"""Pixels; larger residuals lose weight in the first adjustment. Corners are located to 0.1 - 0.3 px."""

FOCAL_STARTS = 0.15 * 1.15 ** np.arange(20)
"""Focal lengths tried for a fisheye, over the image's longer side: a diagonal of 220 to 25 degrees."""

MORE_VIEWS = (
    "take ten views or more with the board tilted by up to 45 degrees, near and far, in all parts of both images"
)


@dataclass(frozen=True)
class BoardView:
    """Corners of the board in one pair: ``left, right`` (n, 2) column, row in the raw images, in the same order."""

    name: str
    left: Floats
    right: Floats


@dataclass(frozen=True)
class ViewResidual:
    """RMS residuals of one view, pixels: of the corners in each image, and of their distances from epipolar lines."""

    name: str
    left: float
    right: float
    epipolar: float
    used: bool = True

    @property
    def worst(self) -> float:
        """The larger of both images' residuals."""
        return max(self.left, self.right)


@dataclass(frozen=True)
class RigCalibration:
    """Result of a calibration: both lenses, the relative pose, and their errors.

    ``values`` and ``sigma``: estimates and their standard deviations by name (``baseline`` in metres, ``left fx`` in
    pixels, ``right k1``, ``rotation x`` in radians, ``translation x`` in metres), from the residuals and the geometry
    of the views. ``rms``: of all used corners, pixels. ``residuals``: one a view; for views left out those of the first
    adjustment.
    """

    left: Lens
    right: Lens
    T_right_left: RigidTransform
    values: Mapping[str, float]
    sigma: Mapping[str, float]
    rms: float
    residuals: tuple[ViewResidual, ...]


def calibrate_rig(
    board: Floats, views: Sequence[BoardView], sizes: Sizes, model: str = "radtan", *, keep_bad: bool = False
) -> RigCalibration:
    """Calibrate both cameras and their relative pose from views of a board.

    Parameters
    ----------
    board : (n, 3) corners in the board's own frame, z = 0, metres.
    views : at least ``LEAST_VIEWS``.
    sizes : of the images, which may differ.
    model : one of ``MODELS``.
    keep_bad : use also views whose residuals are far above the others'.

    Raises
    ------
    DegenerateError
        There are too few views, or they do not determine the cameras.
    """
    _enough(views)
    task = Adjustment(board, tuple(views), sizes, model)
    # The robust loss does not converge from far off, and the start of a fisheye is some pixels off.
    x = replace(task, robust=True).solve(task.solve(task.start()) if model == "fisheye" else task.start())
    first = task.residuals(x)
    # A view is bad if its RMS residual exceeds both half a pixel and four times the median of all views: where all fit
    # to a tenth of a pixel, four tenths are still good.
    limit = max(0.5, 4.0 * float(np.median([r.worst for r in first])))
    good = [k for k, r in enumerate(first) if keep_bad or r.worst <= limit]
    used = Adjustment(board, tuple(views[k] for k in good), sizes, model)
    _enough(used.views)
    # From the first solution, without the poses of bad views.
    x = used.solve(np.concatenate([x[: used.shared], *(x[task.pose(k)] for k in good)]))
    rig = used.rig(x)
    final = {r.name: r for r in used.residuals(x)}
    rms, sigma = used.errors(x)
    left, right = used.lenses(x)
    return RigCalibration(
        left,
        right,
        rig.T_right_left,
        {"baseline": rig.baseline, **dict(zip(used.names(), x.tolist(), strict=False))},
        sigma,
        rms,
        tuple(final.get(r.name, ViewResidual(r.name, r.left, r.right, r.epipolar, used=False)) for r in first),
    )


def refuse_one_place(rig: RigCalibration) -> None:
    """Refuse a right camera in the place of the left one (by four sigma); after bad views are out."""
    if rig.values["baseline"] < 4 * rig.sigma["baseline"]:
        text = f"both cameras stand in one place: the baseline is {rig.values['baseline']:.2g} m"
        raise InputError("RIL-313", text, remedy="give images of two cameras: are left and right those of one?")


def _enough(views: Sequence[BoardView]) -> None:
    if len(views) < LEAST_VIEWS:
        text = f"{len(views)} views of the board are too few to calibrate with"
        raise DegenerateError("RIL-309", text, remedy=MORE_VIEWS)


def _undetermined() -> DegenerateError:
    remedy = f"{MORE_VIEWS}, or a model with fewer coefficients"
    return DegenerateError("RIL-311", "the views do not determine the cameras", remedy=remedy)


@dataclass(frozen=True)
class Adjustment:
    """The unknowns of a set of views: left lens, right lens, rig, then the board's pose in each left image.

    A lens has fx fy cx cy and its coefficients; a pose a rotation vector and a translation, of the transform from the
    board to the left camera, or from the left to the right one.
    """

    board: Floats
    views: tuple[BoardView, ...]
    sizes: Sizes
    model: str
    robust: bool = False
    """Cauchy's loss, which limits the influence of a view; else least squares."""

    @property
    def lens(self) -> int:
        """Unknowns of one lens."""
        return 4 + len(MODELS[self.model])

    @property
    def shared(self) -> int:
        """Unknowns that all views share."""
        return 2 * self.lens + 6

    def pose(self, k: int) -> slice:
        """Slice of the unknowns that holds the board's pose in view ``k``."""
        return slice(self.shared + 6 * k, self.shared + 6 * k + 6)

    def start(self) -> Floats:
        """Start values: each camera calibrated on its own, and the relative pose that agrees best with all views'."""
        left, left_poses = self._alone(0, [v.left for v in self.views])
        right, right_poses = self._alone(1, [v.right for v in self.views])
        between = [r @ ll.inverse() for ll, r in zip(left_poses, right_poses, strict=True)]
        middle = min(between, key=lambda T: sum(_apart(T, other) for other in between))
        return np.concatenate([left, right, *(_vector(T) for T in [middle, *left_poses])])

    def _alone(self, side: int, points: list[Floats]) -> tuple[Floats, list[RigidTransform]]:
        if self.model == "fisheye":
            return self._equidistant(side, points)
        boards = [self.board.astype(np.float32).reshape(1, -1, 3)] * len(points)
        flat = [p.astype(np.float32).reshape(1, -1, 2) for p in points]
        size, threads = self.sizes[side], cv2.getNumThreads()
        # Threads add up the views in any order: the last digits, and the keys of all later tasks, would vary.
        cv2.setNumThreads(1)
        try:
            flags = {"rational": cv2.CALIB_RATIONAL_MODEL, "radtan4": cv2.CALIB_FIX_K3}.get(self.model, 0)
            out = cv2.calibrateCamera(boards, flat, size, None, None, flags=flags)
        except cv2.error as error:
            raise _undetermined() from error
        finally:
            cv2.setNumThreads(threads)
        _, k, d, rotations, translations = out
        count = len(MODELS[self.model])
        lens = np.concatenate([[k[0, 0], k[1, 1], k[0, 2], k[1, 2]], np.ravel(d)[:count]])
        both = zip(rotations, translations, strict=True)
        return lens, [RigidTransform(rotation_exp(np.ravel(r)), np.ravel(t)) for r, t in both]

    def _equidistant(self, side: int, points: list[Floats]) -> tuple[Floats, list[RigidTransform]]:
        """Start values of a fisheye: the focal length of least median misfit of the boards, other coefficients zero.

        OpenCV's own starts with one focal length, by which corners lie beyond 90 degrees off the axis, and gives up.
        """
        width, height = self.sizes[side]
        centre = np.array([width - 1, height - 1]) / 2

        def poses(f: float) -> tuple[float, list[RigidTransform]]:
            misses, found = zip(*(_flat_pose(self.board, (p - centre) / f) for p in points), strict=True)
            return f * float(np.median(misses)), list(found)

        f = min(max(width, height) * FOCAL_STARTS, key=lambda f: poses(f)[0])
        return np.array([f, f, *centre, 0.0, 0.0, 0.0, 0.0]), poses(f)[1]

    def evaluate(self, x: Floats) -> tuple[Floats, Floats]:
        """Residuals (4 n views,), projected minus measured, pixels, left before right; and their Jacobian."""
        n = 2 * len(self.board)
        residual, jacobian = np.empty(2 * n * len(self.views)), np.zeros((2 * n * len(self.views), x.size))
        lens, rig = self.lens, x[2 * self.lens : self.shared]
        own, other, between = slice(0, lens), slice(lens, 2 * lens), slice(2 * lens, self.shared)
        for k, view in enumerate(self.views):
            pose, rows = self.pose(k), slice(2 * n * k, 2 * n * k + n)
            residual[rows], by_lens, by_pose = self._project(x[own], x[pose], view.left)
            jacobian[rows, own], jacobian[rows, pose] = by_lens, by_pose
            composed, by_first, by_second = _compose(x[pose], rig)
            rows = slice(rows.stop, rows.stop + n)
            residual[rows], by_lens, by_pose = self._project(x[other], composed, view.right)
            jacobian[rows, other] = by_lens
            jacobian[rows, pose], jacobian[rows, between] = by_pose @ by_first, by_pose @ by_second
        return residual, jacobian

    def _project(self, lens: Floats, pose: Floats, found: Floats) -> tuple[Floats, Floats, Floats]:
        k = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
        d, board = lens[4:], self.board.reshape(1, -1, 3)
        if self.model == "fisheye":
            points, j = cv2.fisheye.projectPoints(board, pose[:3], pose[3:], k, d)
            by_lens, by_pose = j[:, :8], j[:, 8:14]
        else:
            points, j = cv2.projectPoints(board, pose[:3], pose[3:], k, d)
            by_lens, by_pose = j[:, 6 : 10 + d.size], j[:, :6]
        return points.reshape(-1) - found.reshape(-1), by_lens, by_pose

    def normal(self, x: Floats) -> NormalEquations:
        """Normal equations; the cost is in pixels squared, infinite if a corner has no image."""
        residual, jacobian = self.evaluate(x)
        # Squared residual of each corner over the scale of the loss.
        squares = (residual.reshape(-1, 2) ** 2).sum(1) / CORNER_SCALE**2
        weight = np.repeat(1.0 / (1.0 + squares), 2) if self.robust else np.ones(residual.size)
        weighted = (jacobian * weight[:, None]).T
        cost = CORNER_SCALE**2 * float((np.log1p(squares) if self.robust else squares).sum())
        return NormalEquations(weighted @ jacobian, weighted @ residual, cost if math.isfinite(cost) else math.inf)

    def ahead(self, x: Floats, normal: NormalEquations, damping: float) -> Floats:
        """The unknowns after one damped step."""
        damped = normal.matrix + damping * np.diag(np.diag(normal.matrix))
        return np.asarray(x + np.linalg.lstsq(damped, -normal.gradient, rcond=None)[0])

    def solve(self, x: Floats) -> Floats:
        """The unknowns of least cost, starting from ``x``.

        Raises
        ------
        DegenerateError
            The adjustment diverges.
        """
        x = levenberg_marquardt(self, x, 100, 1e-10).state
        if not (np.isfinite(x).all() and min(x[0], x[1], x[self.lens], x[self.lens + 1]) > 0):
            raise DegenerateError("RIL-312", "the adjustment of the cameras diverges", remedy=MORE_VIEWS)
        return x

    def lenses(self, x: Floats) -> tuple[Lens, Lens]:
        """Left and right lens."""
        left, right = (self._lens(k, x[k * self.lens : (k + 1) * self.lens]) for k in range(2))
        return left, right

    def _lens(self, side: int, x: Floats) -> Lens:
        fx, fy, cx, cy, *coefficients = (float(v) for v in x)
        name = "radtan" if self.model == "radtan4" else self.model
        return Lens(Camera(fx, fy, cx, cy, *self.sizes[side]), name, tuple(coefficients))

    def rig(self, x: Floats) -> Rig:
        """The rig of the cameras without their distortion."""
        left, right = self.lenses(x)
        pose = x[2 * self.lens : self.shared]
        return Rig(left.camera, right.camera, RigidTransform(rotation_exp(pose[:3]), pose[3:]))

    def residuals(self, x: Floats) -> tuple[ViewResidual, ...]:
        """Residuals of each view."""
        by_view = self.evaluate(x)[0].reshape(len(self.views), 2, -1, 2)
        rms = np.sqrt((by_view**2).sum(-1).mean(-1))
        rig, (left, right) = self.rig(x), self.lenses(x)
        out = []
        for view, (a, b) in zip(self.views, rms, strict=True):
            ideal = left.undistort(view.left, rig.left), right.undistort(view.right, rig.right)
            seen = np.isfinite(np.hstack(ideal)).all(axis=1)
            off = line_distances(rig, ideal[0][seen], ideal[1][seen])
            epipolar = float(np.sqrt((off**2).mean())) if seen.any() else float("nan")
            out.append(ViewResidual(view.name, float(a), float(b), epipolar))
        return tuple(out)

    def errors(self, x: Floats) -> tuple[float, dict[str, float]]:
        """RMS of a corner, pixels, and standard deviations of the unknowns that all views share, by name.

        Raises
        ------
        DegenerateError
            The views do not determine some unknown.
        """
        residual, jacobian = self.evaluate(x)
        scale = np.linalg.norm(jacobian, axis=0)
        scaled = jacobian / np.where(scale > 0, scale, 1.0)
        normal = scaled.T @ scaled
        if not scale.all() or np.linalg.cond(normal) > 1e15:
            raise _undetermined()
        variance = float(residual @ residual) / (residual.size - x.size)
        covariance = variance * np.linalg.inv(normal) / np.outer(scale, scale)
        deviation = np.sqrt(np.diag(covariance))
        sigma = {name: float(deviation[k]) for k, name in enumerate(self.names())}
        t = slice(self.shared - 3, self.shared)
        direction = x[t] / np.linalg.norm(x[t])
        sigma["baseline"] = float(np.sqrt(direction @ covariance[t, t] @ direction))
        return float(np.sqrt(2.0 * (residual**2).mean())), sigma

    def names(self) -> list[str]:
        """Names of the unknowns that all views share, in order."""
        lens = ("fx", "fy", "cx", "cy", *MODELS[self.model])
        rig = [f"{kind} {axis}" for kind in ("rotation", "translation") for axis in "xyz"]
        return [f"{side} {name}" for side in ("left", "right") for name in lens] + rig


def _flat_pose(board: Floats, angles: Floats) -> tuple[float, RigidTransform]:
    """RMS angle (radians) between the corners of a flat board and the seen directions, and the board's pose.

    Parameters
    ----------
    board : (n, 3), z = 0.
    angles : (n, 2) angle off the axis, in radians, along columns and rows; unlike coordinates of a pinhole camera
        finite at any angle.
    """
    off = np.hypot(angles[:, 0], angles[:, 1])
    seen = np.column_stack([angles * np.sinc(off / np.pi)[:, None], np.cos(off)])
    flat = np.column_stack([board[:, :2] / np.abs(board).max(), np.ones(len(board))])
    # seen x (H flat) = 0, linear in H = [r1 r2 t] up to its scale (Zhang 2000).
    cross = np.array([[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in seen])
    h = np.linalg.svd(np.einsum("nij,nk->nijk", cross, flat).reshape(-1, 9), full_matrices=False)[2][-1].reshape(3, 3)
    h *= np.sign((seen * (flat @ h.T)).sum()) / np.linalg.norm(h[:, :2], axis=0).mean()
    turn = orthonormal(np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])]))
    there = flat @ np.column_stack([turn[:, :2], h[:, 2]]).T
    there /= np.linalg.norm(there, axis=1, keepdims=True)
    miss = float(np.sqrt(((there - seen) ** 2).sum(1).mean()))
    return miss, RigidTransform(turn, h[:, 2] * np.abs(board).max())


def _compose(first: Floats, second: Floats) -> tuple[Floats, Floats, Floats]:
    """Pose ``second @ first`` as (6,), and its derivatives (6, 6) by each."""
    out: tuple[Any, ...] = cv2.composeRT(first[:3], first[3:], second[:3], second[3:])
    r, t, rr1, rt1, rr2, rt2, tr1, tt1, tr2, tt2 = out
    by_first, by_second = np.block([[rr1, rt1], [tr1, tt1]]), np.block([[rr2, rt2], [tr2, tt2]])
    return np.concatenate([r.ravel(), t.ravel()]), by_first, by_second


def _vector(T: RigidTransform) -> Floats:
    return np.concatenate([cv2.Rodrigues(T.rotation)[0].ravel(), T.translation])


def _apart(a: RigidTransform, b: RigidTransform) -> float:
    """Difference of two poses: angle in radians plus difference of positions relative to their size."""
    size = float(np.linalg.norm(a.translation) + np.linalg.norm(b.translation))
    away = float(np.linalg.norm(a.translation - b.translation)) / max(size, 1e-12)
    return float(angle(a.rotation @ b.rotation.T)) + away


def refuse_clutter(rig: RigCalibration, views: Sequence[BoardView], corners: tuple[int, int]) -> None:
    """Refuse corners, so many in columns and rows, that are not those of a flat board.

    Raises
    ------
    InputError
        Their residuals are too large for the distances between them.
    """
    columns, rows = corners
    grids = [p.reshape(rows, columns, 2) for v in views for p in (v.left, v.right)]
    spacing = float(np.median([np.linalg.norm(np.diff(g, axis=1), axis=-1) for g in grids]))
    # 0.1: residual over the spacing of the corners above which they are not those of a flat board, whose print errs by
    # hundredths; at any resolution and distance.
    if rig.rms > 0.1 * spacing:
        text = f"the corners taken for a board of {columns} x {rows} miss by {rig.rms:.1f} px RMS"
        doubt = f"{spacing:.0f} px apart: no flat board, or not the same moment left and right"
        remedy = "give pictures of a chessboard, and its inner corners, e.g. --corners 9x6"
        raise InputError("RIL-800", f"{text}, {doubt}", remedy=remedy)


def cover(points: Sequence[Floats], size: tuple[int, int]) -> float:
    """Share of an image within the convex hull of all corners."""
    hull = cv2.convexHull(np.concatenate(points).astype(np.float32))
    return float(cv2.contourArea(hull)) / (size[0] * size[1])


def doubts(rig: RigCalibration, views: Sequence[BoardView], sizes: Sizes, model: str) -> Iterator[str]:
    """Reasons to doubt the result, one line each with its figure."""
    # 1.0 px: a chessboard on paper leaves less.
    if rig.rms > 1.0:
        text = f"corners miss by {rig.rms:.2f} px RMS: is the board flat, are the images paired rightly?"
        yield warning("RIL-696", text)
    used = [view for view, r in zip(views, rig.residuals, strict=True) if r.used]
    for side, size in zip(("left", "right"), sizes, strict=True):
        share = rig.sigma[f"{side} fx"] / rig.values[f"{side} fx"]
        # 0.01: all depths have this relative error.
        if share > 0.01:
            text = f"{side} focal length is known to {100 * share:.1f} % only; take views with the board tilted"
            yield warning("RIL-697", text)
        seen = cover([getattr(view, side) for view in used], size)
        # Beyond the corners, distortion is extrapolated.
        if seen < 0.5:
            text = f"the corners span {100 * seen:.0f} % of the {side} image; distortion beyond is a guess"
            yield warning("RIL-698", text)
        known = {name: (abs(rig.values[f"{side} {name}"]), rig.sigma[f"{side} {name}"]) for name in MODELS[model]}
        vague = [k for k, (value, sigma) in known.items() if sigma > max(value, 0.1) and k not in ("p1", "p2")]
        if vague:
            # These views may determine a model with fewer terms.
            fewer = "radtan" if model == "rational" else "radtan4"
            text = f"{side} {', '.join(vague)} cannot be told from 0 with these views; try --model {fewer}"
            yield warning("RIL-699", text)
