"""A board that drives through a street: are the poses as without it, and is the map free of it?

    RILLE_DATA=... python benchmarks/movers.py          the table

Into the first frames of ``kitti06_51`` the side of a vehicle is drawn, as both cameras would see it: a plane with a
texture of its own, with noise, that drives ahead of the camera, crosses before it, or comes towards it. The errors are
those of the trajectory against GPS/INS, beside those of the same frames as they are. A cell of the map counts as raised
that is higher by more than 0.3 m than in the run without the vehicle, once a common plane is taken out, and that lies
where the vehicle was. ``ahead`` and ``across`` are what the rules were chosen with; ``towards`` and ``wide`` judge.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
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


def draw(good: Path, folder: Path, vehicle: Vehicle) -> float:
    """Write the first frames of a sequence with the vehicle in them; the greatest share of the left image it takes."""
    cameras, poses = (np.loadtxt(good / name).reshape(-1, 3, 4) for name in ("calib.txt", "poses.txt"))
    rng, side = np.random.default_rng(1), texture(vehicle.size)
    rows, cols = side.shape
    most = 0.0
    corners = np.array([[0, 0], [cols - 1, 0], [cols - 1, rows - 1], [0, rows - 1]], np.float32)
    for which, camera in zip(("image_l", "image_r"), cameras, strict=False):
        (folder / which).mkdir(parents=True)
        for frame, path in enumerate(sorted((good / which).iterdir())[:FRAMES]):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.float32)
            offsets = np.column_stack([(corners / [cols - 1, rows - 1] - 0.5) * vehicle.size, np.zeros(4)])
            R, t = poses[frame, :, :3], poses[frame, :, 3]
            seen = (vehicle.place(frame) + offsets - t) @ R
            if seen[:, 2].min() > 1.0:
                pixels = np.column_stack([seen, np.ones(4)]) @ camera.T
                pixels = (pixels[:, :2] / pixels[:, 2:]).astype(np.float32)
                H = cv2.getPerspectiveTransform(corners, pixels)
                blurred = cv2.GaussianBlur(side, (0, 0), max(0.3, 0.4 * cols / max(float(np.ptp(pixels[:, 0])), 1.0)))
                cover = cv2.warpPerspective(np.ones_like(side), H, image.shape[::-1])
                drawn = cv2.warpPerspective(blurred, H, image.shape[::-1]) + rng.normal(0, NOISE, image.shape)
                image = image * (1 - cover) + drawn * cover
                most = max(most, float(cover.mean()))
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
            error, drift = (run.metrics[f"trajectory_{key}"]["value"] for key in ("rpe_translation_rmse", "drift"))
            posed = int(np.isfinite(np.asarray(run.trajectory.position)).all(1).sum())
            print(f"| {name} | {posed} | {1e3 * error:.1f} | {drift:.2f} | {' | '.join(cells)} |", flush=True)

        clean = rille.reconstruct(street, frames=f"0:{FRAMES}", **same)
        row("none | 0 %", clean, "-", "-")
        for vehicle in VEHICLES:
            folder = Path(scratch) / vehicle.name
            share = draw(street, folder, vehicle)
            runs = [rille.reconstruct(folder, moving={"enabled": on}, **same) for on in (True, False)]
            row(f"{vehicle.name} | {share:.0%}", runs[0], *(str(raised(run, clean, vehicle)) for run in runs))


if __name__ == "__main__":
    main()
