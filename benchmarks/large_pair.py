"""A pair of 25 megapixels matched as tasks per tile: memory of each worker process, time, and error.

``python benchmarks/large_pair.py`` makes the pair (a texture of all wavelengths, displaced by relief with steps, rows
shifted), matches it in tiles and prints one line a step. ``--whole`` matches it untiled too and compares digests.
"""

from __future__ import annotations

import argparse
import hashlib
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

COLS, ROWS = 5800, 4300
NEAR, FAR, SHIFT = -240.0, -90.0, 6.0
"""Pixels: column displacements of the nearest and the farthest thing, row displacement."""

STRIP = 512


def texture(rng: np.random.Generator, rows: int, cols: int) -> NDArray[np.uint8]:
    """Noise of all wavelengths from two pixels on, the longer the stronger."""
    import cv2

    total = np.zeros((rows, cols), np.float32)
    for octave in range(1, 7):
        step = 2**octave
        noise = rng.normal(0.0, 5.0 * step**0.35, (rows // step + 2, cols // step + 2)).astype(np.float32)
        total += cv2.resize(noise, (cols, rows), interpolation=cv2.INTER_CUBIC)
    return np.clip(total + 128.0, 0, 255).astype(np.uint8)


def displacement(y: NDArray[Any], x: NDArray[Any], shape: tuple[int, int]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Ground that rises towards the viewer, waves on it, and boxes that stand out."""
    t = y / shape[0]
    u = FAR + (NEAR - FAR) * t + 12.0 * np.sin(x / 310.0) * np.cos(y / 270.0)
    box = ((x // 700) + (y // 650)) % 3 == 0
    return np.where(box & (x % 700 > 200) & (y % 650 > 200), u - 40.0, u), np.full_like(u, SHIFT) + 3.0 * x / shape[1]


def make_pair(folder: Path, shape: tuple[int, int]) -> dict[str, Path]:
    """PNG files of the left and the right image, ``left(x) = right(x + d(x))``."""
    import cv2

    rng = np.random.default_rng(0)
    right = texture(rng, *shape)
    left = np.empty(shape, np.uint8)
    for start in range(0, shape[0], STRIP):
        y, x = np.mgrid[start : min(start + STRIP, shape[0]), : shape[1]].astype(np.float32)
        u, v = displacement(y, x, shape)
        moved = cv2.remap(
            right,
            (x + u).astype(np.float32),
            (y + v).astype(np.float32),
            cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REFLECT,
        )
        noisy = moved + rng.normal(0.0, 1.0, moved.shape)
        left[start : start + STRIP] = np.clip(noisy, 0, 255).astype(np.uint8)
    paths = {"left": folder / "left.png", "right": folder / "right.png"}
    for name, image in (("left", left), ("right", right)):
        cv2.imwrite(str(paths[name]), image)
    return paths


def lay_out(graph: Any, paths: dict[str, Path], shape: tuple[int, int]) -> dict[str, Any]:
    """Nodes of both pyramids."""
    from rille.stages.core.declare import NoParams
    from rille.stages.imaging.pyramid import PyramidParams

    pyramids = {}
    for camera, path in paths.items():
        args = {"path": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "frame": 0}
        args |= {"camera": camera, "header": {"width": shape[1], "height": shape[0], "depth": 8}}
        image = graph.node("rille.datasets.images.files", f"image/{camera}", NoParams(), args)
        pyramids[camera] = graph.node(
            "rille.stages.imaging.pyramid", f"pyramid/{camera}", PyramidParams(), inputs={"image": image}
        )
    return pyramids


def table(graph: Any, store: Any, jobs: int) -> None:
    """Run; one line a step: tasks, processor seconds, greatest memory of a process until its end."""
    from rille.pipeline.engine.events import read
    from rille.pipeline.engine.run import RunOptions, run

    ledger, steps = store.root / "ledger.jsonl", defaultdict(list)
    result = run(graph, store, RunOptions(jobs=jobs, ledger=ledger))
    result.check()
    names = {h.label: h.spec.args.get("step", h.stage) for h in graph.nodes}
    for row in read(ledger):
        if row["status"] == "computed":
            steps[names[row["label"]]].append(row)
    for step, rows in steps.items():
        peak, total = max(row["peak_rss"] for row in rows) / 1e6, sum(row["seconds"] for row in rows)
        print(f"{step:12s} {len(rows):4d} tasks {total:8.1f} s   process {peak:6.0f} MB", flush=True)
    print(f"elapsed {result.seconds:.0f} s", flush=True)


def judge(store: Any, ref: Any, shape: tuple[int, int]) -> None:
    """Errors against the displacements that the pair was made with."""
    from rille.stages.core.validity import matched

    bundle = store.open(ref)
    u, ok = bundle["column_disparity"], matched(bundle["validity"])
    errors = []
    for start in range(0, shape[0], STRIP):
        part = slice(start, min(start + STRIP, shape[0]))
        y, x = np.mgrid[part, : shape[1]].astype(np.float32)
        errors.append(np.abs(u[part] - displacement(y, x, shape)[0])[ok[part]])
    error = np.concatenate(errors)
    print(
        f"matched {100 * ok.mean():.1f} %, median error {np.median(error):.3f} px, beyond 2 px {np.mean(error > 2):.4f}"
    )


def compare(store: Any, whole: Any, tiled: Any) -> None:
    """Share of the pixels that are within .01 px of the pair matched whole."""
    same = None
    for name in ("column_disparity", "row_disparity"):
        a, b = (store.open(ref)[name] for ref in (whole, tiled))
        alike = (np.abs(a - b) <= 0.01) | (np.isnan(a) & np.isnan(b))
        same = alike if same is None else same & alike
    assert same is not None
    print(f"within .01 px of the pair matched whole: {100 * same.mean():.3f} %")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--preset", default="default")
    parser.add_argument("--tile", type=int, help="pixels; by memory where it is left out")
    parser.add_argument("--memory", type=int, default=1000, help="MB that a task may take")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--scale", type=float, default=1.0, help="of the image's sides")
    parser.add_argument("--whole", action="store_true", help="match it untiled too, and compare")
    options = parser.parse_args()

    from rille.pipeline.engine.graph import Graph
    from rille.pipeline.engine.runtime.environment import prepare_environment
    from rille.pipeline.engine.store.base import Store
    from rille.pipeline.flow import tiles
    from rille.stages.hfvm.params import HfvmParams
    from rille.stages.imaging.pyramid import PyramidParams

    with tempfile.TemporaryDirectory(prefix="rille-large-") as folder:
        prepare_environment()
        shape = int(ROWS * options.scale), int(COLS * options.scale)
        store, params = Store(Path(folder) / "cache"), HfvmParams(preset=options.preset)
        paths = make_pair(Path(folder), shape)
        graph = Graph()
        lay_out(graph, paths, shape)
        table(graph, store, options.jobs)
        side = tiles.side(
            tiles.Tiling(tile=options.tile, memory=options.memory), params, PyramidParams(), (shape, shape)
        )
        print(f"{shape[1]} x {shape[0]}, preset {options.preset}, tiles of {side}", flush=True)
        graph = Graph()
        pyramids = lay_out(graph, paths, shape)
        whole = (
            graph.node("rille.stages.hfvm.stage", "whole", params, inputs=pyramids)
            if options.whole or side is None
            else None
        )
        if side is not None:
            other = Graph()
            tiled = tiles.build(other, params, lay_out(other, paths, shape), shape, side, "hfvm")
            table(other, store, options.jobs)
            judge(store, tiled.ref, shape)
        if whole is not None:
            table(graph, store, 1)
            if side is not None:
                compare(store, whole.ref, tiled.ref)


if __name__ == "__main__":
    main()
