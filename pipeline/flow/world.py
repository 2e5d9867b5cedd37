"""The world of a reconstruction: models on one lattice, their seams, merged tiles, hazards and the mission's path.

The world is divided into fixed tiles. The task of a tile reads only the models that have a cell in it. If a pair is
added or gets another pose, only the tiles that its model touches, or touched before, are merged again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Series
from typing import Any

from rille.pipeline.engine.graph import Complete, Handle, Maybe, done
from rille.pipeline.engine.store.artifact import Ref
from rille.pipeline.flow import assessment
from rille.pipeline.flow.assessment import Flow
from rille.pipeline.flow.builders import Builder, Pair
from rille.stages.core.errors import DegenerateError
from rille.stages.facts.odometry import IntrinsicsFacts, TrajectoryFacts
from rille.stages.facts.terrain import DemFacts, MergeFacts, OverlapFacts, TileIndexFacts
from rille.stages.planning.path import path_stage
from rille.stages.terrain.merge import merge_stage
from rille.stages.terrain.overlap_audit import overlap_audit_stage
from rille.stages.terrain.overlap_qa import overlap_qa_stage
from rille.stages.terrain.radiometry import radiometry_stage
from rille.stages.terrain.tile_index import Box, tile_index_stage, tile_lattice

TILE_CELLS = 512
"""Side of a world tile, cells: 512 x 512 float32 is 1 MiB an array, small enough to recompute alone."""


def merged_world(make: Builder, frames: Series[int], pairs: Mapping[int, Pair], posed: Ref[TrajectoryFacts]) -> Flow:
    """Lay out the world of the trajectory's largest piece: models on the world lattice, merged; hazards; the path.

    Raises
    ------
    DegenerateError
        No elevation model has a cell in the world.
    """
    p = make.products
    assert p.trajectory is not None
    positions = dict(zip(frames, posed.meta["positions"], strict=True))
    row = {frame: k for k, frame in enumerate(frames)}
    piece = posed.meta["pieces"][posed.meta["main"]]
    world = set(piece)
    # Pairs of other pieces have poses in frames of their own, whose place in this world is unknown.
    there = [k for k in pairs if k in world and positions[k]]
    for k in there:
        make.world_model(pairs[k], pairs[there[0]], row[k], p.trajectory, p.moving.get(k))
    indexed = [
        make.node(tile_index_stage, f"tile_index/{k}", dem=dem, side=TILE_CELLS) for k, dem in p.world_dem.items()
    ]
    yield Complete(("moving", "pose", "locus", "tile_index"))
    # A pair whose model failed is left out of the world: the others make a map with a hole.
    laid = yield Maybe(indexed)
    footprints = [ref.meta for ref in laid if ref is not None and ref.meta["tiles"]]
    if not footprints:
        remedy = "set locus.cell_size greater, or look at the disparities' validity"
        raise DegenerateError("RIL-051", "no elevation model has a cell in the world", remedy=remedy)

    # Seams are audited, exposures levelled, models merged in world tiles; then hazards and the path over all of it.
    p.seams = overlaps(make, footprints)
    seams = list(p.seams.values())
    p.overlap_audit = make.node(overlap_audit_stage, "overlap_audit", seams=seams)
    centres = {str(f["pair"]): centre(f["box"]) for f in footprints if f["box"] is not None}
    yield Complete(("overlap_qa", "overlap_audit"))
    levelled = yield from done(make.node(radiometry_stage, "radiometry", seams=seams, centres=centres))
    intrinsics: list[Ref[IntrinsicsFacts] | None] = yield Maybe([p.intrinsics] if p.intrinsics else [])
    rig_error = intrinsics[0].meta.get("inverse_depth_std") if intrinsics and intrinsics[0] else None
    p.world_tiles = merge_tiles(make.node, footprints, p.world_dem, levelled.meta["steps"], rig_error)
    yield Complete(("radiometry", "merge"))
    if p.local_risk:
        p.world_risk = make.hazards("risk/world", p.world_tiles)
        begin = positions[piece[0]]
        p.world_path = make.node(path_stage, "path/world", risk=p.world_risk, use="world", begin=begin and begin[:2])
    yield from assessment.of_world(make, [pairs[k] for k in there])


def overlaps(make: Builder, footprints: list[TileIndexFacts]) -> dict[int, Handle[OverlapFacts]]:
    """Compare each model with the earlier ones that share a tile; of many with those of the largest common area."""
    models, seams = make.products.world_dem, dict[int, Handle[OverlapFacts]]()
    present: dict[tuple[int, int], list[tuple[int, list[int]]]] = {}
    for meta in footprints:
        pair, shared = meta["pair"], Counter[int]()
        for tx, ty, *box in meta["tiles"]:
            here = present.setdefault((tx, ty), [])
            for other, theirs in here:
                shared[other] += cells_in_both(box, theirs)
            here.append((pair, box))
        if shared:
            # 24: enough to tell which model is off, however often a place is seen again.
            nearest = sorted(shared, key=lambda other: (-shared[other], -other))[:24]
            others = [models[other] for other in sorted(nearest)]
            seams[pair] = make.node(overlap_qa_stage, f"overlap_qa/{pair}", dem=models[pair], others=others)
    return seams


def cells_in_both(a: Series[int], b: Series[int]) -> int:
    """Number of common cells of two boxes (first column, first line, columns, lines)."""
    columns, lines = (min(a[k] + a[k + 2], b[k] + b[k + 2]) - max(a[k], b[k]) for k in (0, 1))
    return max(columns, 0) * max(lines, 0)


def merge_tiles(
    node: Callable[..., Handle[Any]],
    footprints: Series[TileIndexFacts],
    dems: Mapping[int, Handle[DemFacts]],
    steps: Mapping[str, int],
    inverse_depth_std: float | None = None,
) -> list[Handle[MergeFacts]]:
    """Add one task for each world tile that a model touches; it reads these models and nothing else.

    Parameters
    ----------
    node : adds a task, as :meth:`Builder.node` does.
    footprints : facts of stage ``tile_index``, one a model.
    dems : world models by pair.
    steps : exposure of the pairs whose grey values are levelled, as stage ``radiometry`` gives them.
    inverse_depth_std : of a rig that was repaired, as stage ``intrinsics`` gives it.
    """
    touching: dict[tuple[int, int], list[tuple[int, Box]]] = {}
    for meta in footprints:
        for tx, ty, *box in meta["tiles"]:
            touching.setdefault((ty, tx), []).append((meta["pair"], (box[0], box[1], box[2], box[3])))
    merged: list[Handle[MergeFacts]] = []
    for (ty, tx), here in sorted(touching.items()):
        # In order of the pairs: merging must not depend on the order in which results arrived.
        here.sort()
        lattice = tile_lattice([box for _, box in here], footprints[0]["cell"]).to_dict()
        # Of this tile's pairs alone: a level that changes elsewhere leaves the tile in the cache.
        exposure = {str(pair): steps[str(pair)] for pair, _ in here if str(pair) in steps}
        merged.append(
            node(
                merge_stage,
                f"merge/{tx}_{ty}",
                dems=[dems[pair] for pair, _ in here],
                lattice=lattice,
                exposure=exposure or None,
                inverse_depth_std=inverse_depth_std,
            )
        )
    return merged


def centre(box: Mapping[str, Any]) -> list[float]:
    """Centre x, y of a lattice, metres."""
    half = 0.5 * box["cell"]
    return [box["x0"] + half * (box["cols"] - 1), box["y0"] - half * (box["rows"] - 1)]
