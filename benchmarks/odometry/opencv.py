"""A plain odometry of OpenCV's parts, from frame to frame, as a fair measure of what an afternoon's work gives.

Depth of every frame by semi-global matching, corners by ``goodFeaturesToTrack``, pyramidal Lucas-Kanade there and back,
``solvePnPRansac`` and a Levenberg-Marquardt refinement on its inliers. No key frames. Images that do not share rows are
rectified first, as that matcher needs; the remapping is part of the time, its maps are not.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from rille.stages.imaging.features import grey_bytes

from .chain import Clock, Images, Navigated

POINTS = 1000
QUALITY = 0.01
APART = 8
"""Pixels between corners."""
BLOCK = 5
WINDOW = (21, 21)
LEVELS = 4
BACK = 0.5
"""Pixels: greatest error after tracking there and back."""
NEAREST_DISPARITY = 2.0
"""Pixels: points farther than this are too uncertain to help."""
REPROJECTION = 1.0
"""Pixels: bound of RANSAC's inliers."""
LEAST = 6


class Odometry:
    """The loop over frames."""

    def __init__(self, images: Images) -> None:
        self.images, self.clock = images, Clock()
        rig = images.sequence.rig
        self.left, self.R_left = _projection(rig.left), np.eye(3)
        self.maps: Any = None
        size = (rig.left.width, rig.left.height)
        if not _in_rows(rig):
            T = rig.T_right_left
            R1, R2, P1, P2, *_ = cv2.stereoRectify(
                rig.left.matrix, None, rig.right.matrix, None, size, T.rotation, T.translation.reshape(3, 1), alpha=0
            )
            self.maps = [
                cv2.initUndistortRectifyMap(c.matrix, None, R, P, size, cv2.CV_16SC2)
                for c, R, P in ((rig.left, R1, P1), (rig.right, R2, P2))
            ]
            self.left, self.R_left, self.baseline, self.offset = P1[:, :3], R1, -P2[0, 3] / P2[0, 0], 0.0
        else:
            self.baseline, self.offset = rig.baseline, rig.left.cx - rig.right.cx
        self.matcher = cv2.StereoSGBM.create(
            0,
            self._range(),
            BLOCK,
            P1=8 * BLOCK**2,
            P2=32 * BLOCK**2,
            disp12MaxDiff=1,
            preFilterCap=31,
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )

    def _range(self) -> int:
        """Disparities searched: a tenth of the width, in steps of 16 (of a rig that converges a fifth)."""
        width = self.images.sequence.rig.left.width
        return 16 * max(1, round(width * (0.1 if self.maps is None else 0.3) / 16))

    def run(self) -> Navigated:
        """Poses of all frames in the first one; a frame that cannot be posed goes on as the one before moved."""
        pose, step, poses, lost = np.eye(4), np.eye(4), [np.eye(4)], 0
        left, depth = self._frame(self.images.frames[0])
        for frame in self.images.frames[1:]:
            before, before_depth = left, depth
            left, depth = self._frame(frame)
            found = self._step(before, before_depth, left)
            lost += found is None
            step = step if found is None else found
            pose = pose @ step
            poses.append(pose)
        turn = np.eye(4)
        turn[:3, :3] = self.R_left
        return Navigated(np.array([turn.T @ p @ turn for p in poses])[:, :3], None, {"lost": lost}, self.clock)

    def _frame(self, frame: int) -> tuple[Any, Any]:
        pair = [
            grey_bytes(np.asarray(self.clock.timed("undistort", self.images.ideal, frame, c)["image"])) for c in SIDES
        ]
        if self.maps is not None:
            pair = self.clock.timed("rectify", self._rectify, pair)
        return pair[0], self.clock.timed("depth", self._depth, *pair)

    def _rectify(self, pair: list[Any]) -> list[Any]:
        return [cv2.remap(image, x, y, cv2.INTER_LINEAR) for image, (x, y) in zip(pair, self.maps, strict=True)]

    def _depth(self, left: Any, right: Any) -> Any:
        disparity = self.matcher.compute(left, right).astype(np.float32) / 16.0 - self.offset
        with np.errstate(divide="ignore"):
            return np.where(disparity >= NEAREST_DISPARITY, self.left[0, 0] * self.baseline / disparity, np.nan)

    def _step(self, a: Any, depth: Any, b: Any) -> Any:
        corners = self.clock.timed("corners", cv2.goodFeaturesToTrack, a, POINTS, QUALITY, APART)
        if corners is None:
            return None
        p, q = self.clock.timed("track", _track, a, b, corners)
        return self.clock.timed("pose", self._pose, p, q, depth)

    def _pose(self, p: Any, q: Any, depth: Any) -> Any:
        """T_before_after from corners (n, 2) of both frames."""
        col, row = np.rint(p).astype(int).T
        z = depth[row.clip(0, depth.shape[0] - 1), col.clip(0, depth.shape[1] - 1)]
        known = np.isfinite(z)
        if known.sum() < LEAST:
            return None
        rays = np.column_stack([p[known], np.ones(known.sum())]) @ np.linalg.inv(self.left).T
        points, q = rays * z[known, None], q[known].astype(np.float64)
        cv2.setRNGSeed(0)
        ok, turn, shift, inliers = cv2.solvePnPRansac(
            points, q, self.left, None, iterationsCount=200, reprojectionError=REPROJECTION, confidence=0.999
        )
        if not ok or inliers is None or len(inliers) < LEAST:
            return None
        use = inliers.ravel()
        turn, shift = cv2.solvePnPRefineLM(points[use], q[use], self.left, None, turn, shift)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        return np.linalg.inv(T)


SIDES = ("left", "right")


def _track(a: Any, b: Any, corners: Any) -> tuple[Any, Any]:
    options: dict[str, Any] = {"winSize": WINDOW, "maxLevel": LEVELS}
    there, found, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, None, **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None, **options)
    p, q = corners.reshape(-1, 2), there.reshape(-1, 2)
    good = (found.ravel() != 0) & (returned.ravel() != 0)
    good &= np.linalg.norm(back.reshape(-1, 2) - p, axis=1) < BACK
    return p[good], q[good]


def _projection(camera: Any) -> Any:
    return np.asarray(camera.matrix, dtype=np.float64)


def _in_rows(rig: Any) -> bool:
    """Whether rows correspond already: parallel cameras of one focal length, displaced along x."""
    T, a, b = rig.T_right_left, rig.left, rig.right
    parallel = np.abs(T.rotation - np.eye(3)).max() < 1e-4
    along = np.abs(T.translation[1:]).max() < 1e-3 * rig.baseline
    return bool(parallel and along and abs(a.fx - b.fx) < 1e-3 * a.fx and abs(a.cy - b.cy) < 0.05)
