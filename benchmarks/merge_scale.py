"""Merge of many elevation models over a large world: peak memory of the workers, and what a moved model costs.

``python benchmarks/merge_scale.py [--side 10000] [--models 100] [--jobs 2] [--cache FOLDER]``. Models of 1500 x 1500
cells are laid evenly over a square lattice, and merged in world tiles by the chain's own stages and engine. Then
one model is moved and the same run made again: recomputed must be the tiles that it touches and touched, no others.
Exit status 1 if memory exceeds 1 GiB, or other tiles are recomputed.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from rille.stages.core.declare import Bundle, NoParams, raster, stage
from rille.stages.geometry.lattice import Lattice

HERE = Path(__file__).parent
CELLS = 1500
LIMIT = 1 << 30


@stage("synthetic_dem", outputs=[raster(n, "m", n) for n in ("elevation", "elevation_std", "ortho")])
def synthetic_dem(params: NoParams, *, pair: int, i0: int, j0: int, cells: int) -> Bundle:
    """A model: waves, noise of its own, and a border that is not straight."""
    lattice = Lattice.at(i0, j0, 0.01, cells, cells)
    rng = np.random.default_rng(pair)
    x, y = lattice.xs().astype(np.float32)[None], lattice.ys().astype(np.float32)[:, None]
    z = np.sin(x) * np.cos(y) + rng.normal(0, 0.01, lattice.shape).astype(np.float32)
    z[np.abs(x - x.mean()) + 0.2 * np.abs(y - y.mean()) > 0.5 * np.ptp(x)] = np.nan
    even = np.ones(lattice.shape, np.float32)
    maps = {"elevation": z, "elevation_std": 0.01 * even, "ortho": np.rint(100 + 50 * z)}
    return Bundle(maps, {"pair": pair, "lattice": lattice.to_dict(), "frame": "world"})


def places(side: int, models: int, cells: int) -> list[tuple[int, int]]:
    """First column and line of each model, on a square grid that reaches from border to border."""
    n = round(models**0.5)
    step = [round(k * (side - cells) / max(n - 1, 1)) for k in range(n)]
    return [(i, j) for j in step for i in step]


def merged(cache: Path, where: list[tuple[int, int]], cells: int, jobs: int, ledger: Path) -> dict[str, str]:
    """Run the merge of models at ``where``; label to digest of every tile."""
    from rille.pipeline.engine.graph import Graph
    from rille.pipeline.engine.run import RunOptions, run
    from rille.pipeline.engine.store.base import Store
    from rille.pipeline.flow.world import TILE_CELLS, merge_tiles
    from rille.stages.terrain.merge import MergeParams, merge_stage
    from rille.stages.terrain.tile_index import tile_index_stage

    graph = Graph()

    def node(stage: Any, label: str, **given: Any) -> Any:
        return graph.call(stage, label, MergeParams() if stage is merge_stage else NoParams(), **given)

    dems: dict[int, Any] = {}
    for k, (i, j) in enumerate(where):
        args = {"pair": k, "i0": i, "j0": -j, "cells": cells}
        dems[k] = graph.node("benchmarks.merge_scale", f"dem/{k}", NoParams(), args, {}, {})
    prints = [node(tile_index_stage, f"tile_index/{k}", dem=dem, side=TILE_CELLS) for k, dem in dems.items()]

    def follow() -> Any:
        found = yield prints
        merge_tiles(node, [ref.meta for ref in found], dems, {})

    graph.flow(follow())
    begin = time.perf_counter()
    result = run(graph, Store(cache), RunOptions(jobs=jobs, ledger=ledger))
    result.check()
    counts = dict(Counter(f"{h.stage} {h.status}" for h in graph.nodes))
    print(f"{time.perf_counter() - begin:.0f} s, {counts}", flush=True)
    return {h.label: h.ref.digest for h in graph.nodes if h.stage == "merge" and h.ref is not None}


def tiles_of(cells: int, at: tuple[int, int], cache: Path) -> set[str]:
    """Labels of the tiles that a model's cells touch, cell by cell."""
    from rille.pipeline.flow.world import TILE_CELLS

    z = synthetic_dem(NoParams(), pair=0, i0=at[0], j0=-at[1], cells=cells)["elevation"]
    rows, cols = np.nonzero(np.isfinite(z))
    index = np.unique(np.column_stack([(cols + at[0]) // TILE_CELLS, (rows + at[1]) // TILE_CELLS]), axis=0)
    return {f"merge/{tx}_{ty}" for tx, ty in index}


def main() -> int:
    """Run it twice and judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=10_000)
    parser.add_argument("--models", type=int, default=100)
    parser.add_argument("--cells", type=int, default=CELLS)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--cache", type=Path)
    args = parser.parse_args()
    sys.path.insert(0, str(HERE.parent))
    os.environ["PYTHONPATH"] = str(HERE.parent)
    with tempfile.TemporaryDirectory() as temporary:
        from rille.pipeline.engine import events as ledger
        from rille.pipeline.engine.runtime.environment import prepare_environment

        cache = args.cache or Path(temporary) / "cache"
        prepare_environment()
        where = places(args.side, args.models, args.cells)
        print(f"{len(where)} models of {args.cells} x {args.cells} cells over {args.side} x {args.side}")
        before = merged(cache, where, args.cells, args.jobs, Path(temporary) / "first.jsonl")
        peak = max(row["peak_rss"] for row in ledger.read(Path(temporary) / "first.jsonl") if "peak_rss" in row)
        print(f"{len(before)} tiles; peak resident memory of a worker {peak / 2**20:.0f} MiB, of all at most "
              f"{args.jobs * peak / 2**20:.0f} MiB")  # fmt: skip
        middle = len(where) // 2
        moved = [*where]
        moved[middle] = (where[middle][0] + 700, where[middle][1] + 30)
        after = merged(cache, moved, args.cells, args.jobs, Path(temporary) / "second.jsonl")
        again = {
            row["label"]
            for row in ledger.read(Path(temporary) / "second.jsonl")
            if row["stage"] == "merge" and row["status"] == "computed"
        }
        wanted = tiles_of(args.cells, where[middle], cache) | tiles_of(args.cells, moved[middle], cache)
        wanted &= set(after)  # a tile that no model touches any more is gone
        print(f"one model moved: {len(again)} tiles merged again, {len(wanted)} are touched, before or after")
        return int(again != wanted or args.jobs * peak > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
