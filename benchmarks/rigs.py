"""Rigs of many kinds above rendered flat ground, raw images; beside OpenCV's SGBM on rectified ones.

    python benchmarks/rigs.py [--preset default] [--seeds 11 12]

The ground is noise with as much energy in each octave (``rough``) or more in the longer waves (``soft``), seen by
cameras of 520 x 400 pixels with 3 x 3 rays a pixel and noise of one grey level; the displacements are exact. Of the
left pixels that the right image sees: matched, right within 2 px, filled right within 2 px; median error of the right
ones. SGBM (3WAY, windows of 5 x 5) has images rectified by the exact calibration, 1.6 times as large so that little is
cut off, and the range of the truth; its disparities are carried back to the raw images. Where the baseline lies along
the view nothing can be rectified. Seeds 5 and 6 of ``soft`` and the ground of photographs served to choose.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]
SHAPE = (400, 520)
PIXELS_A_METRE = 400.0
RAYS = 3


@dataclass(frozen=True)
class Kind:
    """A rig: pitch below the horizon and roll of both cameras and toe-in and roll of the right one, degrees; height,
    baseline (column, row, along the view), metres; focal lengths, pixels; blur of the right image, pixels."""

    pitch: float = 30.0
    height: float = 1.0
    baseline: tuple[float, float, float] = (0.12, 0.0, 0.0)
    focal: tuple[float, float] = (450.0, 450.0)
    toe_in: float = 0.0
    roll: tuple[float, float] = (0.0, 0.0)
    shape: tuple[int, int] = SHAPE
    blur: float = 0.0


RIGS = {
    "usual": Kind(),
    "straight down": Kind(pitch=90.0, baseline=(0.15, 0.0, 0.0)),
    "0.3 m above the ground": Kind(pitch=15.0, height=0.3),
    "0.15 m above the ground": Kind(pitch=10.0, height=0.15),
    "toe-in of 10 degrees": Kind(toe_in=10.0, baseline=(0.2, 0.0, 0.0)),
    "baseline 0.3 of the distance": Kind(pitch=45.0, toe_in=15.0, baseline=(0.4, 0.0, 0.0)),
    "baseline 0.6 of the distance": Kind(pitch=45.0, toe_in=31.0, baseline=(0.85, 0.0, 0.0)),
    "one above the other": Kind(baseline=(0.0, -0.12, 0.0)),
    "one behind the other": Kind(baseline=(0.0, 0.0, 0.15)),
    "right turned by 10 degrees": Kind(roll=(0.0, 10.0)),
    "right turned by 40 degrees": Kind(roll=(0.0, 40.0)),
    "right turned by 90 degrees": Kind(roll=(0.0, 90.0)),
    "left focal length x 1.4": Kind(focal=(500.0, 360.0)),
    "left focal length x 2": Kind(focal=(700.0, 350.0)),
    "left focal length x 4": Kind(focal=(900.0, 225.0)),
    "right focal length x 2": Kind(focal=(350.0, 700.0)),
    "right image of half the size": Kind(focal=(450.0, 225.0), shape=(200, 260)),
    "right image blurred by 1.2 px": Kind(blur=1.2),
    "right image blurred by 2 px": Kind(blur=2.0),
}


@dataclass(frozen=True)
class View:
    """A camera: matrix, rotation from the world (z up) and place."""

    K: Floats
    R: Floats
    C: Floats
    shape: tuple[int, int]

    def ground(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Where the rays through pixels meet the ground, metres; NaN: they do not."""
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(self.K).T @ self.R
        with np.errstate(divide="ignore"):
            far = -self.C[2] / rays[..., 2]
        far = np.where(far > 0, far, np.nan)
        return self.C[0] + far * rays[..., 0], self.C[1] + far * rays[..., 1]

    def pixels(self, X: Floats, Y: Floats) -> tuple[Floats, Floats]:
        """Pixels of points of the ground; NaN behind the camera."""
        p = np.stack([X - self.C[0], Y - self.C[1], np.full_like(X, -self.C[2])], -1) @ self.R.T @ self.K.T
        p[p[..., 2] <= 0] = np.nan
        return p[..., 0] / p[..., 2], p[..., 1] / p[..., 2]


def views(kind: Kind) -> tuple[View, View]:
    """Both cameras of a rig."""

    def turned(toe_in: float, roll: float) -> Floats:
        pitch, yaw, about = np.radians([kind.pitch, -toe_in, roll])
        axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        down = [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
        aside = [[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]]
        round_ = [[np.cos(about), np.sin(about), 0], [-np.sin(about), np.cos(about), 0], [0, 0, 1]]
        return np.array(round_) @ down @ aside @ axes

    def matrix(focal: float, shape: tuple[int, int]) -> Floats:
        return np.array([[focal, 0, (shape[1] - 1) / 2], [0, focal, (shape[0] - 1) / 2], [0, 0, 1]])

    left = View(matrix(kind.focal[0], SHAPE), turned(0.0, kind.roll[0]), np.array([0.0, 0.0, kind.height]), SHAPE)
    there = left.C + left.R.T @ kind.baseline
    return left, View(matrix(kind.focal[1], kind.shape), turned(kind.toe_in, sum(kind.roll)), there, kind.shape)


def texture(seed: int, longer: float) -> list[Floats]:
    """Levels of a ground whose next longer octave is ``longer`` times as strong."""
    rng, side, grey = np.random.default_rng(seed), 4096, 0.0
    for octave in range(9):
        waves = rng.normal(size=(side >> octave, side >> octave)).astype(np.float32)
        grey = grey + cv2.resize(waves, (side, side), interpolation=cv2.INTER_CUBIC) * longer**octave
    levels = [np.clip(128 + 40 * (grey - np.mean(grey)) / np.std(grey), 0, 255).astype(np.float32)]
    while levels[-1].shape[0] > 16:
        levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    return levels


def image(view: View, levels: list[Floats], seed: int, blur: float) -> NDArray[np.uint8]:
    """What a camera shows: each ray reads the levels of the ground about as coarse as it is wide there."""
    rows, cols = view.shape
    y, x = ((a + 0.5) / RAYS - 0.5 for a in np.mgrid[0 : rows * RAYS, 0 : cols * RAYS].astype(np.float64))
    X, Y = (a * PIXELS_A_METRE for a in view.ground(x, y))
    wide = [np.hypot(np.gradient(X, axis=axis), np.gradient(Y, axis=axis)) for axis in (0, 1)]
    level = np.nan_to_num(np.clip(0.5 * np.log2(wide[0] * wide[1]), 0, len(levels) - 1), nan=len(levels) - 1.0)
    grey = np.zeros_like(level)
    for n, ground in enumerate(levels):
        share, side = np.clip(1 - np.abs(level - n), 0, 1), ground.shape[0]
        u, v = (np.mod((np.nan_to_num(a) + 0.5) / 2**n - 0.5, side).astype(np.float32) for a in (X, Y))
        if share.any():
            grey += share * cv2.remap(np.pad(ground, (0, 1), mode="wrap"), u, v, cv2.INTER_LINEAR)
    # Sky.
    grey[np.isnan(X)] = 200
    grey = grey.reshape(rows, RAYS, cols, RAYS).mean((1, 3))
    grey = cv2.GaussianBlur(grey, None, blur) if blur else grey
    noise = np.random.default_rng(seed).normal(0, 1, grey.shape)
    return np.clip(np.rint(grey + noise), 0, 255).astype(np.uint8)


def sgbm(a: View, b: View, images: tuple[Any, Any], truth: tuple[Floats, Floats]) -> tuple[Floats, Floats] | None:
    """Displacements (row, col) of SGBM on rectified images, in the raw ones; None where they cannot be rectified."""
    R, none = b.R @ a.R.T, np.zeros(5)
    t = (b.R @ (a.C - b.C)).reshape(3, 1)
    size = (int(1.6 * SHAPE[1]), int(1.6 * SHAPE[0]))
    if abs(t[2, 0]) > np.hypot(t[0, 0], t[1, 0]):
        return None
    R1, R2, P1, P2 = cv2.stereoRectify(a.K, none, b.K, none, SHAPE[::-1], R, t, alpha=-1, newImageSize=size)[:4]
    flat = [
        cv2.remap(of, *cv2.initUndistortRectifyMap(v.K, none, r, p, size, cv2.CV_32FC1), cv2.INTER_LINEAR)
        for of, v, r, p in zip(images, (a, b), (R1, R2), (P1, P2), strict=True)
    ]
    upright = abs(P2[1, 3]) > abs(P2[0, 3])
    if upright:
        flat = [np.ascontiguousarray(of.T) for of in flat]
    y, x = np.indices(SHAPE).astype(float)

    def rectified(K: Floats, r: Floats, p: Floats, x: Floats, y: Floats) -> Floats:
        places = np.stack([x.ravel(), y.ravel()], -1)[:, None]
        return cv2.undistortPoints(places, K, none, None, r, p)[:, 0].reshape(*x.shape, 2)

    here = rectified(a.K, R1, P1, x, y)
    there = rectified(b.K, R2, P2, *(np.nan_to_num(s + d) for s, d in zip((x, y), truth, strict=True)))
    shift = (here - there)[np.isfinite(truth[0]), int(upright)]
    low = int(np.floor(np.quantile(shift, 0.002))) - 4
    count = int(np.ceil((np.quantile(shift, 0.998) + 4 - low) / 16) * 16)
    if count > 1200:
        return None
    matcher = cv2.StereoSGBM.create(low, count, 5, 200, 800, 1, 63, 10, 100, 2, cv2.STEREO_SGBM_MODE_SGBM_3WAY)
    found = matcher.compute(*flat).astype(np.float32) / 16
    found[found < low] = np.nan
    found = np.ascontiguousarray(found.T) if upright else found
    columns, lines = np.ascontiguousarray(here.astype(np.float32).transpose(2, 0, 1))
    read = cv2.remap(found, columns, lines, cv2.INTER_NEAREST, borderValue=np.nan)
    end = here - np.stack([np.zeros(SHAPE), read] if upright else [read, np.zeros(SHAPE)], -1)
    back = np.concatenate([end, np.ones((*SHAPE, 1))], -1) @ (b.K @ R2.T @ np.linalg.inv(P2[:, :3])).T
    return back[..., 0] / back[..., 2] - x, back[..., 1] / back[..., 2] - y


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12])
    given = parser.parse_args()
    from rille.pipeline.engine.runtime.environment import prepare_environment

    prepare_environment()
    from rille.stages.core.validity import matched
    from rille.stages.hfvm.params import HfvmParams
    from rille.stages.hfvm.stage import match

    grounds = [texture(seed, longer) for longer in (1.0, 1.4) for seed in given.seeds]
    print(f"{len(grounds)} grounds, of seeds {given.seeds}, rough and soft; means\n")
    print("| rig | seen | matched | right | filled right | median, px | SGBM matched | right | median, px |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name, kind in RIGS.items():
        a, b = views(kind)
        y, x = np.indices(SHAPE).astype(float)
        p, q = b.pixels(*a.ground(x, y))
        rows, cols = b.shape
        seen = (p >= 0) & (q >= 0) & (p <= cols - 1) & (q <= rows - 1)
        truth, cells = (np.where(seen, p - x, np.nan), np.where(seen, q - y, np.nan)), []
        for k, levels in enumerate(grounds):
            left, right = image(a, levels, 2 * k, 0.0), image(b, levels, 2 * k + 1, kind.blur)
            found = match(left, right, HfvmParams(preset=given.preset))
            error = np.hypot(found.column_disparity - truth[0], found.row_disparity - truth[1])[seen]
            ok = matched(found.validity)[seen]
            row = [seen.mean(), ok.mean(), (ok & (error < 2)).mean(), (error < 2).mean()]
            row.append(np.median(error[ok & (error < 2)]) if ok.any() else np.nan)
            other = sgbm(a, b, (left, right), truth)
            if other is not None:
                error = np.hypot(other[0] - truth[0], other[1] - truth[1])[seen]
                row += [np.isfinite(error).mean(), (error < 2).mean(), np.median(error[error < 2])]
            cells.append(row)
        means = [f"{mean:.3f}" for mean in np.mean(cells, axis=0)]
        print(f"| {name} | {' | '.join(means + ['-'] * (8 - len(means)))} |", flush=True)


if __name__ == "__main__":
    main()
