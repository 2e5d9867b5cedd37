"""The README's picture, drawn from a run: left image, merged ortho image, hillshaded elevation with risk and path.

``python benchmarks/overview.py [RUN_FOLDER] [--output docs/overview.jpg]``; the run is the mockup's latest by default.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from matplotlib import pyplot as plt
from matplotlib.colors import LightSource
from numpy.typing import NDArray

from rille.datasets.protocol import Source
from rille.datasets.registry import open_sequence
from rille.pipeline.commands.options import cache_folder
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.task import Ref, Spec, ensure

RISK = np.array([[0.36, 0.72, 0.60], [0.90, 0.80, 0.45], [0.80, 0.28, 0.10], [1.0, 1.0, 1.0]])


def artifact(source: Source) -> Ref:
    refs = {port: artifact(upstream) for port, upstream in source.inputs.items()}
    spec = Spec(source.module, source.module, source.params, source.args, source.hints)
    return ensure(cache_folder(None), spec, refs).ref


def left_image(name: str) -> NDArray[Any]:
    return np.asarray(Store(cache_folder(None)).open(artifact(open_sequence(name).image(0, "left")))["image"])


def raster(path: Path) -> tuple[NDArray[Any], tuple[float, float, float, float]]:
    with rasterio.open(path) as source:
        box = source.bounds
        return source.read(1), (box.left, box.right, box.bottom, box.top)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?", type=Path, default=Path("runs/mockup/latest"))
    parser.add_argument("--output", type=Path, default=Path("docs/overview.jpg"))
    given = parser.parse_args()
    if not given.run.exists():
        subprocess.run([sys.executable, "-m", "rille.pipeline.cli", "reconstruct", given.run.parent.name], check=True)
    run = given.run.resolve()

    z, extent = raster(run / "dem.tif")
    ortho, _ = raster(run / "ortho.tif")
    risk, _ = raster(run / "risk.tif")
    cell = (extent[1] - extent[0]) / z.shape[1]
    filled = np.where(np.isnan(z), np.nanmedian(z), z)
    shade = LightSource(315, 45).hillshade(filled, vert_exag=1.5, dx=cell, dy=cell)
    colour = RISK[risk.astype(int)] * np.where(risk == 3, 1.0, 0.35 + 0.65 * shade)[..., None]
    features = json.loads((run / "path.geojson").read_text(encoding="utf-8"))["features"]
    line = next(f["geometry"]["coordinates"] for f in features if f["geometry"]["type"] == "LineString")

    figure, axes = plt.subplots(1, 3, figsize=(13, 5.2), width_ratios=(1.5, 1, 1), layout="constrained")
    axes[0].imshow(left_image(run.parent.name), cmap="gray")
    axes[0].set_title("left image of a stereo pair (not rectified)")
    axes[1].imshow(ortho, cmap="gray", extent=extent)
    axes[1].set_title("ortho image, ten pairs merged")
    axes[2].imshow(colour, extent=extent)
    axes[2].plot(*np.array(line).T[:2], color="black", linewidth=2)
    axes[2].set_title("safe, hazardous, path; metres")
    axes[0].axis("off")
    axes[1].axis("off")
    given.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(given.output, dpi=100, pil_kwargs={"quality": 88})
    print(given.output)


if __name__ == "__main__":
    main()
