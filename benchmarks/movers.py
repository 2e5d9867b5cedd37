"""What does not stand still in a street: are the poses as without it, and is the map free of it?

    RILLE_DATA=... python benchmarks/movers.py          both tables

Into the first frames of ``kitti06_51`` the side of a vehicle is drawn, as both cameras would see it: a plane with a
texture of its own, with noise, that drives ahead of the camera, crosses before it, or comes towards it. The errors are
those of the trajectory against GPS/INS, beside those of the same frames as they are. A cell of the map counts as raised
that is higher by more than 0.3 m than in the run without the vehicle, once a common plane is taken out, and that lies
where the vehicle was. ``ahead`` and ``across`` are what the rules were chosen with; ``towards`` and ``wide`` judge.

The second table has what keeps its place in the image, or has none: the vehicle's own body over the lower part, clouds
of dust that differ in each image, and glare of a low sun. All of it judges.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np

FRAMES = 16
RAISED_M = 0.3
TEXELS_PER_M = 80
NOISE = 1.5


@dataclass(frozen=True)
class Vehicle:
    """Side of a vehicle, m: ``size`` (width, height); ``start`` of its middle in the first left camera; ``step`` in a
    frame."""

    name: str
    size: tuple[float, float]
    start: tuple[float, float, float]
    step: tuple[float, float, float]

    def place(self, frame: int) -> np.ndarray:
        return np.array(self.start) + frame * np.array(self.step)


VEHICLES = (
    Vehicle("ahead", (2.6, 2.4), (0.5, 0.4, 9.0), (0.03, 0.0, 1.1)),
    Vehicle("across", (5.0, 2.4), (-7.0, 0.4, 12.0), (0.9, 0.0, 0.8)),
    Vehicle("towards", (2.6, 2.4), (-3.2, 0.4, 45.0), (0.0, 0.0, -0.9)),
    Vehicle("wide", (7.0, 3.4), (-1.0, 0.0, 8.0), (0.02, 0.0, 1.15)),
)


def texture(size: tuple[float, float]) -> np.ndarray:
    """Grey values of the vehicle's side: noise of several sizes in a dark frame."""
    rng = np.random.default_rng(0)
    cols, rows = (int(n * TEXELS_PER_M) for n in size)
    out = np.full((rows, cols), 110.0, np.float32)
    for side in (2, 6, 20, 60):
        noise = rng.normal(0, 1, (max(rows // side, 2), max(cols // side, 2))).astype(np.float32)
        out += 18 * side**0.3 * cv2.resize(noise, (cols, rows), interpolation=cv2.INTER_CUBIC)
    out[:4] = out[-4:] = 30
    out[:, :4] = out[:, -4:] = 30
    return np.clip(out, 10, 245)


Cover = Callable[[tuple[int, ...], int, int], tuple[np.ndarray, np.ndarray]]
"""Of the shape of an image, its camera (0: left) and its frame: grey values drawn, and the share of each pixel, 0 to 1,
that they cover."""


def drive(good: Path, vehicle: Vehicle) -> Cover:
    """The vehicle as both cameras of a sequence see it."""
    cameras, poses = (np.loadtxt(good / name).reshape(-1, 3, 4) for name in ("calib.txt", "poses.txt"))
    side = texture(vehicle.size)
    rows, cols = side.shape
    corners = np.array([[0, 0], [cols - 1, 0], [cols - 1, rows - 1], [0, rows - 1]], np.float32)
    offsets = np.column_stack([(corners / [cols - 1, rows - 1] - 0.5) * vehicle.size, np.zeros(4)])

    def cover(shape: tuple[int, ...], camera: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        R, t = poses[frame, :, :3], poses[frame, :, 3]
        seen = (vehicle.place(frame) + offsets - t) @ R
        if seen[:, 2].min() <= 1.0:
            return np.zeros(shape), np.zeros(shape)
        pixels = np.column_stack([seen, np.ones(4)]) @ cameras[camera].T
        pixels = (pixels[:, :2] / pixels[:, 2:]).astype(np.float32)
        H = cv2.getPerspectiveTransform(corners, pixels)
        blurred = cv2.GaussianBlur(side, (0, 0), max(0.3, 0.4 * cols / max(float(np.ptp(pixels[:, 0])), 1.0)))
        share = cv2.warpPerspective(np.ones_like(side), H, shape[::-1])
        return cv2.warpPerspective(blurred, H, shape[::-1]), share

    return cover


def body(part: float) -> Cover:
    """The vehicle's own front over the lower ``part`` of both images: the same pixels in each frame."""

    def cover(shape: tuple[int, ...], camera: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        rows, cols = shape
        # Both cameras see the near front from two places: its edge is not the same, nor what is on it.
        edge = rows * (1 - part) + 0.05 * rows * np.sin(np.linspace(0, np.pi, cols) + 0.3 * camera)
        drawn = cv2.resize(texture((6.0, 4.0))[:, 60 * camera :], (cols, rows))
        return drawn, (np.arange(rows)[:, None] > edge).astype(float)

    return cover


def _clouds(rng: np.random.Generator, shape: tuple[int, ...], side: int) -> np.ndarray:
    rows, cols = shape
    noise = rng.random((rows // side + 2, cols // side + 2)).astype(np.float32)
    return np.asarray(cv2.resize(noise, (cols, rows), interpolation=cv2.INTER_CUBIC))


def dust(shape: tuple[int, ...], camera: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Clouds in the lower half of the image, another one in each."""
    rng = np.random.default_rng((7, camera, frame))
    low = np.clip(np.linspace(-1.0, 1.0, shape[0]), 0, 1)[:, None]
    return 150.0 + 30.0 * _clouds(rng, shape, 24), np.clip(1.6 * _clouds(rng, shape, 60) - 0.3, 0, 0.9) * low


def glare(shape: tuple[int, ...], camera: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """A low sun ahead: white around it, a veil over the image, and a row of reflections in the lens."""
    rows, cols = shape
    y, x = np.mgrid[:rows, :cols]
    sun = np.array([0.62 * cols + 4.0 * camera, 0.30 * rows + 2.0 * np.sin(frame)])
    middle = np.array([cols, rows]) / 2
    share = np.exp(-np.hypot(x - sun[0], y - sun[1]) / (0.12 * cols)) + 0.12
    for k in (0.5, 1.2, 1.7):
        at = sun + k * (middle - sun)
        share += 0.35 * (np.hypot(x - at[0], y - at[1]) < 0.02 * cols * k)
    return np.full(shape, 255.0), np.clip(share, 0, 1)


OVER: dict[str, Cover] = {"body, 15 %": body(0.15), "body, 45 %": body(0.45), "dust": dust, "glare": glare}


def draw(good: Path, folder: Path, cover: Cover) -> float:
    """Write the first frames of a sequence with a cover over them; the greatest share of the left image it takes."""
    rng, most = np.random.default_rng(1), 0.0
    for camera, which in enumerate(("image_l", "image_r")):
        (folder / which).mkdir(parents=True)
        for frame, path in enumerate(sorted((good / which).iterdir())[:FRAMES]):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.float32)
            drawn, share = cover(image.shape, camera, frame)
            image = image * (1 - share) + (drawn + rng.normal(0, NOISE, image.shape)) * share
            most = max(most, float(share.mean()))
            cv2.imwrite(str(folder / which / path.name), np.clip(np.rint(image), 0, 255).astype(np.uint8))
    shutil.copyfile(good / "calib.txt", folder / "calib.txt")
    lines = (good / "poses.txt").read_text().splitlines()[:FRAMES]
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    return most


def raised(run: Any, clean: Any, vehicle: Vehicle) -> int:
    """Cells on the vehicle's way that are higher by more than :data:`RAISED_M`, or there alone and as high."""
    ours, theirs = run.terrain.elevation, clean.terrain.elevation
    theirs = theirs.reindex(x=ours.x, y=ours.y, method="nearest", tolerance=float(abs(ours.x[1] - ours.x[0])) / 2)
    x, y = np.meshgrid(np.asarray(ours.x), np.asarray(ours.y))
    z, off = np.asarray(ours), np.asarray(ours) - np.asarray(theirs)
    known = np.isfinite(off)
    design = np.column_stack([x[known], y[known], np.ones(known.sum())])
    plane = np.zeros(3)
    for _ in range(20):
        weight = 1.0 / (1.0 + np.abs(off[known] - design @ plane) / 0.1)
        plane = np.linalg.lstsq(design * weight[:, None], off[known] * weight, rcond=None)[0]
    off = off - (plane[0] * x + plane[1] * y + plane[2])
    R, t = np.asarray(run.trajectory.rotation)[0], np.asarray(run.trajectory.position)[0]
    way = [R @ vehicle.place(k) + t for k in range(FRAMES)]
    near = np.any([np.hypot(x - p[0], y - p[1]) < vehicle.size[0] / 2 + 0.5 for p in way], axis=0)
    alone = np.isfinite(z) & ~known & (z > np.nanmedian(z[near & known]) + 2 * RAISED_M)
    return int((near & ((off > RAISED_M) | alone)).sum())


def main() -> None:
    import rille

    street = Path(os.environ.get("RILLE_DATA") or "-") / "kitti06_51"
    if not street.is_dir():
        raise SystemExit("RILLE_DATA holds no kitti06_51")
    columns = "vehicle", "of the image", "posed", "error a frame, mm", "drift, %", "raised", "with moving.enabled=false"
    print(f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}", sep="\n")
    with tempfile.TemporaryDirectory() as scratch:
        same: dict[str, Any] = {"cache": f"{scratch}/cache", "runs": f"{scratch}/runs", "quiet": True}
        same["crosscheck"] = {"enabled": False}

        def row(name: str, run: Any, *cells: str) -> None:
            posed = int(np.isfinite(np.asarray(run.trajectory.position)).all(1).sum())
            # Of a trajectory of one frame there is no error.
            none = {"value": None}
            figures = (run.metrics.get(f"trajectory_{key}", none) for key in ("rpe_translation_rmse", "drift"))
            error, drift = (np.nan if figure["value"] is None else figure["value"] for figure in figures)
            print(f"| {name} | {posed} | {1e3 * error:.1f} | {drift:.2f} | {' | '.join(cells)} |", flush=True)

        clean = rille.reconstruct(street, frames=f"0:{FRAMES}", **same)
        row("none | 0 %", clean, "-", "-")
        for vehicle in VEHICLES:
            folder = Path(scratch) / vehicle.name
            share = draw(street, folder, drive(street, vehicle))
            runs = [rille.reconstruct(folder, moving={"enabled": on}, **same) for on in (True, False)]
            row(f"{vehicle.name} | {share:.0%}", runs[0], *(str(raised(run, clean, vehicle)) for run in runs))

        print(
            "", "| over the image | share | posed | error a frame, mm | drift, % | exit |", f"|{'---|' * 6}", sep="\n"
        )
        for name, cover in OVER.items():
            folder = Path(scratch) / name.replace(" ", "").replace("%", "").replace(",", "")
            share = draw(street, folder, cover)
            try:
                run = rille.reconstruct(folder, **same)
            except rille.RilleError as error:
                print(f"| {name} | {share:.0%} | - | - | - | refused: {error} |", flush=True)
                continue
            row(
                f"{name} | {share:.0%}",
                run,
                "; ".join(hole["what"] + ": " + hole["why"] for hole in run.missing) or "complete",
            )


if __name__ == "__main__":
    main()
