"""Views from elsewhere: orbits of the Moon seen at up to 60 degrees, and photographs whose right image is turned.

    RILLE_DATA=... python benchmarks/views.py [--preset default]

Relief of the Moon (``lunar_views``): two views of a scene under one sun, and the same two under different suns; the
truth is the rendered depth, exact. Photographs (``motorcycle``, ``cones``, ``middlebury0506``): the right image is
turned and scaled by bicubic interpolation; the truth is the disparity moved alike, which is given to a quarter or a
third of a pixel, motorcycle's to about a tenth. Columns: share of the left image that the right one sees (photographs:
that falls into it, what is hidden there included); of those pixels, matched, matched within 1 px (of the vector), and
filled within 1 px; median error of the matched ones. The limits of ``stages/hfvm/plane.py`` were chosen on
the Moon's views and on turned copies of one street image; photographs judge.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cv2
import numpy as np

SCENES = {"nadir": 594, "oblique": 432, "dynamic": 1164}
"""First image of each lunar scene; a scene has two views under each of up to three suns."""

TURNS = ((0, 1.0), (60, 1.0), (120, 1.0), (180, 1.0), (30, 1.5), (0, 0.6))
"""Degrees and scale by which the right photograph is turned."""

OCCLUDED = 0.005
"""Share of the depth by which a point must lie behind what the other view shows there, to be hidden from it."""


@np.errstate(invalid="ignore")  # NaN where there is no depth
def lunar(folder: Path, first: int, second: int) -> tuple[Any, ...] | None:
    """Both images, exact displacements (u, v), and which left pixels the right view sees."""
    names = [folder / f"im_{n:05d}" for n in (first, second)]
    if not all(name.with_suffix(".npz").exists() for name in names):
        return None
    images = [cv2.imread(f"{name}.jpg", cv2.IMREAD_GRAYSCALE) for name in names]
    a, b = (np.load(name.with_suffix(".npz")) for name in names)
    depth, other = a["depth_m"].astype(np.float64), b["depth_m"].astype(np.float32)
    y, x = np.indices(depth.shape)
    # Pixel centres of these renderings lie at half-integer coordinates.
    places = np.stack([x.ravel() + 0.5, y.ravel() + 0.5, np.ones(x.size)])
    to_b = np.linalg.inv(b["T_world_camera"]) @ a["T_world_camera"]
    points = to_b[:3, :3] @ (np.linalg.inv(a["K"]) @ places * np.where(depth > 0, depth, np.nan).ravel())
    points += to_b[:3, 3:]
    p, q = ((b["K"] @ points)[k].reshape(depth.shape) / points[2].reshape(depth.shape) - 0.5 for k in (0, 1))
    there = cv2.remap(other, p.astype(np.float32), q.astype(np.float32), cv2.INTER_LINEAR, borderValue=-1)
    distance = points[2].reshape(depth.shape)
    seen = np.isfinite(p) & (there > 0) & (np.abs(there - distance) < OCCLUDED * distance)
    return images[0], images[1], p - x, q - y, seen


def photographs(data: Path) -> Iterator[tuple[str, Any, Any, Any]]:
    """Name, left and right image, and column disparity (right minus left, NaN unknown) of rectified pairs."""
    from stereo.pairs import read_image, read_truth

    names = ["motorcycle_left.png", "motorcycle_right.png", "motorcycle_disp.npz"]
    files: list[tuple[str, list[str], float | None]] = [("motorcycle", names, None)]
    files += [("cones", ["cones_image_02.png", "cones_image_06.png", "cones_disp_02.png"], 4.0)]
    more = sorted((data / "middlebury0506").glob("*/"))
    files += [(f"middlebury0506/{f.name}", ["view1.png", "view5.png", "disp1.png"], 3.0) for f in more]
    for name, (left, right, truth), scale in files:
        if (data / name).is_dir():
            folder = data / name
            yield name, read_image(folder / left), read_image(folder / right), read_truth(folder / truth, scale).u


def turned(right: Any, u: Any, degrees: float, scale: float) -> tuple[Any, Any, Any]:
    """The right image turned about its middle, on a canvas that holds it, and the displacements onto it."""
    rows, cols = right.shape
    matrix = cv2.getRotationMatrix2D(((cols - 1) / 2, (rows - 1) / 2), degrees, scale)
    side = int(np.ceil(np.hypot(rows, cols) * max(scale, 1.0)))
    matrix[:, 2] += (side - 1) / 2 - np.array([(cols - 1) / 2, (rows - 1) / 2])
    how = cv2.INTER_CUBIC if scale >= 1 else cv2.INTER_AREA
    image = cv2.warpAffine(right, matrix, (side, side), flags=how, borderMode=cv2.BORDER_CONSTANT)
    y, x = np.indices(u.shape)
    p = matrix[0, 0] * (x + u) + matrix[0, 1] * y + matrix[0, 2]
    q = matrix[1, 0] * (x + u) + matrix[1, 1] * y + matrix[1, 2]
    return image, p - x, q - y


def judged(found: Any, u: Any, v: Any, seen: Any) -> str:
    """Cells of a row."""
    from rille.stages.core.validity import matched

    ok = matched(found.validity) & seen
    error = np.hypot(found.column_disparity - u, found.row_disparity - v)
    shares = [float(np.count_nonzero(m)) / seen.sum() for m in (ok, ok & (error <= 1), seen & (error <= 1))]
    median = f"{np.median(error[ok]):.2f}" if ok.any() else "-"
    return " | ".join([f"{seen.mean():.2f}", *(f"{s:.3f}" for s in shares), median])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="default")
    given = parser.parse_args()
    from rille.pipeline.engine.runtime.environment import prepare_environment

    prepare_environment()
    from rille.stages.hfvm.params import HfvmParams
    from rille.stages.hfvm.stage import match

    params = HfvmParams(preset=given.preset)
    data = Path(os.environ.get("RILLE_DATA") or "-")
    print("| views | seen | matched | matched right | filled right | median, px |\n|---|---|---|---|---|---|")
    for scene, first in SCENES.items():
        for a, b in ((0, 1), (2, 3), (4, 5), (0, 3), (2, 5)):
            views = lunar(data / "lunar_views" / scene, first + a, first + b)
            if views is not None:
                left, right, u, v, seen = views
                sun = "one sun" if b - a == 1 else "two suns"
                print(f"| {scene} {a}-{b}, {sun} | {judged(match(left, right, params), u, v, seen)} |", flush=True)
    pairs = list(photographs(data))
    for degrees, scale in TURNS if pairs else ():
        rows = []
        for _, left, right, u in pairs:
            image, p, q = turned(right, u, degrees, scale)
            _, x = np.indices(u.shape)
            seen = np.isfinite(u) & (x + u >= 0)
            cells = judged(match(left, image, params), p, q, seen)
            rows.append([float(c) if c != "-" else np.nan for c in cells.split(" | ")])
        means = " | ".join(f"{m:.3f}" for m in np.nanmean(rows, axis=0))
        print(f"| {len(rows)} photographs, turned by {degrees} degrees, x {scale} | {means} |", flush=True)


if __name__ == "__main__":
    main()
