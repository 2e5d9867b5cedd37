"""The README's picture, drawn from a run: stereo pair, disparity, shaded terrain, risk with path.

``python benchmarks/overview.py [RUN_FOLDER] [--output docs/overview.jpg]``; the run is the mockup's latest by default.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import rasterio
from matplotlib import pyplot as plt
from matplotlib.colors import LightSource
from numpy.typing import NDArray

import rille

RISK = np.array([[0.36, 0.72, 0.60], [0.90, 0.80, 0.45], [0.80, 0.28, 0.10], [1.0, 1.0, 1.0]])


def raster(path: Path) -> tuple[NDArray[Any], tuple[float, float, float, float]]:
    with rasterio.open(path) as source:
        box = source.bounds
        return source.read(1), (box.left, box.right, box.bottom, box.top)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?", type=Path, default=Path("runs/mockup/latest"))
    parser.add_argument("--output", type=Path, default=Path("docs/overview.jpg"))
    given = parser.parse_args()
    run = given.run.resolve() if given.run.exists() else rille.reconstruct(given.run.parent.name).folder.resolve()
    pair = rille.open(run.parent.name)[0]
    disparity = rille.match(pair.left, pair.right).column_disparity

    z, extent = raster(run / "dem.tif")
    risk, _ = raster(run / "risk.tif")
    cell = (extent[1] - extent[0]) / z.shape[1]
    filled = np.where(np.isnan(z), np.nanmedian(z), z)
    shade = LightSource(315, 45).hillshade(filled, vert_exag=1.5, dx=cell, dy=cell)
    colour = RISK[risk] * np.where(risk == 3, 1.0, 0.35 + 0.65 * shade)[..., None]
    _, _, (line, *_), _ = pyogrio.raw.read(run / "path.gpkg", layer="path")
    path = np.frombuffer(line[9:], "<f8").reshape(-1, 3)  # behind the head of well-known binary: x, y, z

    figure, axes = plt.subplots(1, 5, figsize=(16, 4.3), width_ratios=(1.1, 1.1, 1.1, 1, 1), layout="constrained")
    for ax, image, title in zip(axes[:2], (pair.left, pair.right), ("left image", "right image"), strict=True):
        ax.imshow(image, cmap="gray")
        ax.set_title(title)
    axes[2].imshow(disparity, cmap="viridis")
    axes[2].set_title("disparity, nothing rectified")
    relief = plt.get_cmap("terrain")((filled - np.nanmin(z)) / np.ptp(z[np.isfinite(z)]))[..., :3]
    axes[3].imshow(np.where(np.isnan(z)[..., None], 1.0, relief * (0.35 + 0.65 * shade)[..., None]), extent=extent)
    axes[3].set_title("terrain, ten pairs merged")
    axes[4].imshow(colour, extent=extent)
    axes[4].plot(*path.T[:2], color="black", linewidth=2)
    axes[4].set_title("safe, caution, hazard; path")
    for ax in axes:
        ax.axis("off")
    given.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(given.output, dpi=100, pil_kwargs={"quality": 88})
    print(given.output)


if __name__ == "__main__":
    main()
