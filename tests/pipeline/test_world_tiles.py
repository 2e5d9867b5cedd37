"""World tiles in the engine: what a model that moves or is added costs, and that nothing else changes a bit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from toys import dem

from rille.pipeline.engine import events
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store.base import Store
from rille.pipeline.flow.world import merge_tiles
from rille.stages.core.declare import NoParams
from rille.stages.terrain.merge import MergeParams, merge_stage
from rille.stages.terrain.tile_index import tile_index_stage

SIDE = 16
PLACES = {0: (0, 0), 4: (9, 3), 8: (22, -5), 12: (40, 2), 16: (-14, -30), 20: (33, -28)}


def run(
    cache: Path,
    places: dict[int, tuple[int, int]],
    *,
    steps: dict[str, int] | None = None,
    executor: str = "inline",
) -> tuple[set[str], dict[str, str], dict[str, Any]]:
    """Labels of the tiles merged by this run, digest of each tile, and all nodes by label."""
    graph, merging = Graph(), MergeParams()

    def node(stage: Any, label: str, **given: Any) -> Any:
        return graph.call(stage, label, merging if stage is merge_stage else NoParams(), **given)

    dems = {k: node(dem.STAGE, f"dem/{k}", pair=k, i0=i, j0=j) for k, (i, j) in places.items()}
    prints = [node(tile_index_stage, f"tile_index/{k}", dem=model, side=SIDE) for k, model in dems.items()]

    def follow() -> Iterator[Any]:
        found: Any = yield prints
        merge_tiles(node, [f.meta for f in found], dems, steps or {})

    graph.flow(follow())  # type: ignore[arg-type]
    driver.run(graph, Store(cache), driver.RunOptions(executor=executor, jobs=2, ledger=cache / "ledger.jsonl")).check()
    rows = events.read(cache / "ledger.jsonl")
    again = {r["label"] for r in rows if r["stage"] == "merge" and r["status"] == "computed"}
    return again, {r["label"]: r["digest"] for r in rows if r["stage"] == "merge"}, {h.label: h for h in graph.nodes}


def touched(place: tuple[int, int]) -> set[str]:
    """Tiles that the disk of a model touches, cell by cell."""
    r, c = np.mgrid[:20, :20]
    seen = (r - 9.5) ** 2 + (c - 9.5) ** 2 <= 81
    columns, lines = place[0] + c[seen], r[seen] - place[1]
    return {f"merge/{x}_{y}" for x, y in zip(columns // SIDE, lines // SIDE, strict=True)}


def test_a_moved_model_costs_the_tiles_that_it_touches_and_touched(cache: Path) -> None:
    first, before, _ = run(cache, PLACES)
    assert first == set(before) == set().union(*map(touched, PLACES.values()))
    assert run(cache, PLACES)[0] == set()
    moved = PLACES | {8: (52, -20)}  # partly beyond what the world was
    again, after, nodes = run(cache, moved)
    assert again | {t for t in before if t not in after} == touched(PLACES[8]) | touched(moved[8])
    assert again & touched(PLACES[0])  # a neighbour's tile is among them
    assert {t for t in after if after[t] != before.get(t)} <= again
    reasons = {nodes[label].reason for label in again if label in before}
    assert all("dems" in reason or "lattice" in reason for reason in reasons), reasons


def test_an_added_model_costs_its_own_tiles(cache: Path) -> None:
    run(cache, PLACES)
    again, _, _ = run(cache, PLACES | {24: (5, 5)})
    assert again == touched((5, 5))


def test_an_exposure_costs_the_tiles_of_its_model(cache: Path) -> None:
    run(cache, PLACES)
    again, _, _ = run(cache, PLACES, steps={"12": 5})
    assert again == touched(PLACES[12])


def test_order_of_models_and_number_of_workers_change_no_bit(tmp_path: Path) -> None:
    first = run(tmp_path / "a", PLACES)[1]
    backwards = dict(reversed(PLACES.items()))
    assert run(tmp_path / "b", backwards, executor="dask")[1] == first
