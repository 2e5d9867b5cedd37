"""Fractions of a pixel: photographs shifted by a quarter and a half of a pixel in columns, rows or both.

    RILLE_DATA=... python benchmarks/shifts.py [--pandora2d FOLDER/bin/pandora2d]

Both images are area means of one photograph, whose windows of 2 x 2 or 4 x 4 pixels begin one pixel or more apart: so
the shift is exact and nothing is interpolated. Both are rounded to bytes. Judged are pixels with a match, 16 pixels and
more from the border, that are right within a pixel, and their share: root mean square and mean of the errors in columns
and rows. No parameter of Rille was chosen with these images.

Peers that match in two dimensions: OpenCV's dense inverse search (DIS, medium preset), which matches every pixel, and
CNES's Pandora2D (correlation over 9 x 9 pixels, dichotomy, bicubic interpolation), a program in its own environment.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
Vectors = tuple[NDArray[Any], NDArray[Any]]
"""Column and row disparity (row, col), pixels, NaN without a match."""
Matcher = Callable[[Grey, Grey], Vectors]

PHOTOGRAPHS = (
    ("desert", "devon_island/left/*"),
    ("field", "nasa_k10/*.*g"),
    ("motorcycle", "motorcycle/motorcycle_left.png"),
    ("Rocks1", "middlebury0506/Rocks1/view1.png"),
    ("Cloth1", "middlebury0506/Cloth1/view1.png"),
    ("Wood1", "middlebury0506/Wood1/view1.png"),
)
LARGE = 900
"""Least side of a photograph that is reduced to a quarter, not to a half."""
BORDER = 16


def photographs() -> Iterator[tuple[str, Grey]]:
    """Name and grey values of each."""
    folder = Path(os.environ.get("RILLE_DATA") or "-")
    for name, pattern in PHOTOGRAPHS:
        found = sorted(folder.glob(pattern))
        if not found:
            raise SystemExit(f"RILLE_DATA holds no {pattern}")
        yield name, np.asarray(cv2.imread(str(found[0]), cv2.IMREAD_GRAYSCALE), np.uint8)


def shifted(image: Grey, factor: int, rows: int, cols: int) -> tuple[Grey, Grey]:
    """Two reductions by ``factor``; the second shows everything ``rows / factor`` and ``cols / factor`` farther on."""
    height, width = ((n - factor) // factor for n in image.shape)

    def reduced(y: int, x: int) -> Grey:
        part = image[y : y + height * factor, x : x + width * factor].astype(np.float64)
        means = part.reshape(height, factor, width, factor).mean(axis=(1, 3))
        return np.rint(means).astype(np.uint8)

    return reduced(rows, cols), reduced(0, 0)


def matchers(pandora2d: Path | None) -> dict[str, Matcher]:
    """By name; Pandora2D where it is given."""
    from rille.stages.core.validity import matched
    from rille.stages.hfvm.params import HfvmParams
    from rille.stages.hfvm.stage import match

    def hfvm(preset: Any) -> Matcher:
        def run(left: Grey, right: Grey) -> Vectors:
            found = match(left, right, HfvmParams(preset=preset))
            good = matched(found.validity)
            return np.where(good, found.column_disparity, np.nan), np.where(good, found.row_disparity, np.nan)

        return run

    def dis(left: Grey, right: Grey) -> Vectors:
        flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(left, right, None)
        return flow[..., 0], flow[..., 1]

    found: dict[str, Matcher] = {f"HFVM {p}": hfvm(p) for p in ("fast", "default", "accurate")} | {"DIS": dis}
    if pandora2d is not None:
        found["Pandora2D"] = lambda left, right: _pandora2d(pandora2d, left, right)
    return found


def _pandora2d(program: Path, left: Grey, right: Grey) -> Vectors:
    import rasterio

    with tempfile.TemporaryDirectory() as folder:
        inputs: dict[str, Any] = {f"{axis}_disparity": {"init": 0, "range": 2} for axis in ("col", "row")}
        for name, image in (("left", left), ("right", right)):
            cv2.imwrite(f"{folder}/{name}.tif", image.astype(np.float32))
            inputs[name] = {"img": f"{folder}/{name}.tif", "nodata": -9999}
        dichotomy = {"refinement_method": "dichotomy", "iterations": 6, "filter": {"method": "bicubic"}}
        pipeline = {
            "matching_cost": {"matching_cost_method": "zncc", "window_size": 9},
            "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
            "refinement": dichotomy,
        }
        plan = Path(folder, "plan.json")
        plan.write_text(json.dumps({"input": inputs, "pipeline": pipeline, "output": {"path": f"{folder}/out"}}))
        subprocess.run([program, plan], check=True, capture_output=True)
        maps = [next(Path(folder, "out").rglob(f"*{axis}_map*.tif")) for axis in ("col", "row")]
        return rasterio.open(maps[0]).read(1), rasterio.open(maps[1]).read(1)


def judged(found: Vectors, rows: float, cols: float) -> tuple[float, ...]:
    """Share of pixels that are right within a pixel; root mean square and mean error of columns, then of rows."""
    inner = np.s_[BORDER:-BORDER, BORDER:-BORDER]
    u, v = found[0][inner] - cols, found[1][inner] - rows
    right = (np.abs(u) < 1) & (np.abs(v) < 1)
    errors = [f(e[right]) for e in (u, v) for f in (lambda e: np.sqrt(np.mean(e**2)), np.mean)]
    return float(right.mean()), *map(float, errors)


def cases() -> Iterator[tuple[str, tuple[float, float], Grey, Grey]]:
    """Photograph, shift in rows and columns (pixels), left and right image."""
    for name, image in photographs():
        factor = 4 if min(image.shape) > LARGE else 2
        for step in (1, 2) if factor == 4 else (1,):
            for rows, cols in ((0, step), (step, 0), (step, step)):
                yield name, (rows / factor, cols / factor), *shifted(image, factor, rows, cols)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pandora2d", type=Path, help="its program, in an environment of its own")
    given = parser.parse_args()
    from rille.pipeline.engine.runtime.environment import prepare_environment

    prepare_environment()
    programs = matchers(given.pandora2d)
    figures: dict[str, list[tuple[float, ...]]] = {name: [] for name in programs}
    print(
        "| image | shift, columns, rows | matcher | right | columns: RMS, mean error, px | rows: RMS, mean error, px |"
    )
    print("|---|---|---|---|---|---|")
    for name, (rows, cols), left, right in cases():
        for program, run in programs.items():
            found = judged(run(left, right), rows, cols)
            figures[program].append(found)
            print(f"| {name} | {cols}, {rows} | {program} | {_row(found)} |", flush=True)
    for program, rounds in figures.items():
        print(f"| medians of magnitudes | | {program} | {_row(np.median(np.abs(rounds), axis=0), '')} |")


def _row(found: Any, sign: str = "+") -> str:
    share, rms_u, mean_u, rms_v, mean_v = found
    return f"{share:.2f} | {rms_u:.3f}, {mean_u:{sign}.3f} | {rms_v:.3f}, {mean_v:{sign}.3f}"


if __name__ == "__main__":
    main()
